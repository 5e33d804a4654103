"""Errors for bad input and insufficient data."""


class InputError(ValueError):
    """Bad usage or bad input; the command line ends with exit code 2.

    The message is one sentence that names the file, the column or key, and the remedy.
    """

    def __init__(self, message: object):
        ValueError.__init__(self, _one_line(message))


class DataError(ValueError):
    """Data that are well formed but cannot support the request; exit code 1.

    The message is one sentence that names the file, the observation, and the remedy.
    """

    def __init__(self, message: object):
        ValueError.__init__(self, _one_line(message))


def _one_line(message: object) -> str:
    """Replace line ends and control characters, which names in logs and drive files may contain."""
    return "".join(c if c.isprintable() else " " for c in " ".join(str(message).split()))
