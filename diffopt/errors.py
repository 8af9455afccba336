"""Errors that a caller can act upon."""


class InputError(ValueError):
    """A file or an argument that cannot be used.

    The message is one line: it names the file or the argument, what was received and what
    was expected. The command line prints it as it is and exits with status 2.
    """


def missing(what: str, package: str, extra: str, instead: str = "") -> InputError:
    """That a package of an extra is not installed, and how to get it.

    Parameters
    ----------
    what
        That needs it; for a file its name first.
    package, extra
        Of the package index, and of this project.
    instead
        What else can be done.
    """
    return InputError(f"{what} needs {package}: pip install {package} (extra {extra}){instead}")
