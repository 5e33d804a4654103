"""The two ways in which a request to `fitting` is refused."""


class InputError(ValueError):
    """Bad usage or bad input; the command line ends with exit code 2.

    The message is one sentence that names the file, the column or key, and the remedy.
    """

    def __init__(self, message: object):
        ValueError.__init__(self, _one_line(message))


class DataError(ValueError):
    """Data that are well formed but cannot support the request; exit code 1.

    The message is one sentence that names the file, what was seen, and the remedy.
    """

    def __init__(self, message: object):
        ValueError.__init__(self, _one_line(message))


def _one_line(message: object) -> str:
    """Names in logs and drive files may hold line ends and control characters; a message may not."""
    return "".join(c if c.isprintable() else " " for c in " ".join(str(message).split()))
