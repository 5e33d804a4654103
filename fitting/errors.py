"""The two ways in which a request to `fitting` is refused."""


class InputError(ValueError):
    """Bad usage or bad input; the command line ends with exit code 2.

    The message is one sentence that names the file, the column or key, and the remedy.
    """


class DataError(ValueError):
    """Data that are well formed but cannot support the request; exit code 1.

    The message is one sentence that names the file, what was seen, and the remedy.
    """
