"""From exceptions to one line on the error stream and an exit code."""

import contextlib
import os
import sys
from collections.abc import Iterator

from diffopt.errors import InputError

#: Exit code for what the user can put right: arguments, files, folders.
BAD_INPUT = 2
#: Set to 1 to see the traceback of such errors as well.
DEBUG = "DIFFOPT_DEBUG"


@contextlib.contextmanager
def user_input() -> Iterator[None]:
    """Take ValueError, OSError and MemoryError inside for faults of the input.

    Wrap the reading and checking of input in it, not the computation: there the same
    exceptions are bugs and keep their traceback.

    Raises
    ------
    InputError
        In their place.
    """
    try:
        yield
    except InputError:
        raise
    except (ValueError, OSError) as error:
        raise InputError(_words(error)) from error
    except MemoryError as error:
        raise InputError(f"not enough memory for this input: {_words(error)}") from error


def report(error: BaseException) -> int:
    """Print ``diffopt: error: ...`` on one line and return the exit code.

    Raises
    ------
    BaseException
        The error itself, if the environment variable DIFFOPT_DEBUG is 1.
    """
    if os.environ.get(DEBUG) == "1":
        raise error
    print(f"diffopt: error: {_words(error)}", file=sys.stderr)
    return BAD_INPUT


def _words(error: BaseException) -> str:
    """Text of an exception without line breaks."""
    if isinstance(error, OSError) and error.strerror:
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{error.strerror[0].lower()}{error.strerror[1:]}"
    return " ".join(str(error).split()) or type(error).__name__
