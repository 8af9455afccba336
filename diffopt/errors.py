"""Errors that a caller can act upon."""


class InputError(ValueError):
    """A file or an argument that cannot be used.

    The message is one line: it names the file or the argument, what was received and what
    was expected. The command line prints it as it is and exits with status 2.
    """
