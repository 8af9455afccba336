"""A load of one case within limits, and what came out of it."""

import contextlib
import signal
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from fuzzing.cases import Case, lay
from fuzzing.readers.base import Reader, Seed
from fuzzing.watch import Watch

#: Most address space beyond that of the idle child, bytes: an allocation that a header promises
#: fails, instead of being granted by a system that overcommits.
SPACE = 3 * 2**30
#: Most memory that one file of a few kilobytes may take, bytes.
MEMORY = 256 * 2**20
#: Longest load of one, seconds of the processor; tables of new shapes compile. By the clock,
#: which counts what other processes do and what waits for ever, four times that.
SECONDS = 5.0


class TooLong(BaseException):
    """The alarm; no reader may swallow it."""


def _listing(folder: Path) -> dict[str, tuple[int, int]]:
    """What is in a folder: sizes and times of change."""
    found = {}
    for path in sorted(folder.rglob("*")):
        state = path.lstat()
        found[path.relative_to(folder).as_posix()] = (state.st_size, state.st_mtime_ns)
    return found


def _status(name: str) -> int:
    """Bytes, as the kernel states them for this process."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(name + ":"):
            return 1024 * int(line.split()[1])
    return 0


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def attempt(watch: Watch, load: Callable[..., Any], folder: Path, found: Case) -> dict[str, Any]:
    """Load a folder; what came out, and what must not have."""
    from diffopt.errors import InputError
    from diffopt.scenes.tables import SceneFileError

    seed = found.seed
    path = lay(folder, seed, found.others)
    before = _listing(folder)
    faults: list[str] = []
    outcome = "read"
    # From here on the greatest memory in use is counted anew.
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    at_rest = _status("VmRSS")
    began = time.process_time()
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    signal.setitimer(signal.ITIMER_REAL, 4.0 * SECONDS)
    try:
        with warnings.catch_warnings(), watch.watching():
            warnings.simplefilter("error")
            load(path, **seed.options)
        if not found.harmless:
            faults.append("it was read")
    except InputError as error:
        outcome, lines = "refused", str(error).splitlines()
        whole = error.lines if isinstance(error, SceneFileError) else lines[:1]
        if len(lines) != len(whole) or not lines:
            faults.append(f"the message is not one line: {str(error)[:300]!r}")
        if folder.name not in str(error):
            faults.append(f"the message does not name the file: {str(error)[:300]!r}")
        if any(isinstance(cause, MemoryError) for cause in _chain(error)):
            faults.append(f"only the limit on memory stopped it: {str(error)[:200]!r}")
    except TooLong:
        faults.append(f"longer than {SECONDS:g} s")
        outcome = "too long"
    except BaseException as error:
        place = traceback.extract_tb(error.__traceback__)
        inside = [f for f in place if "/diffopt/" in f.filename or "/fitting/" in f.filename]
        last = (inside or place)[-1]
        where = f"{Path(last.filename).name}:{last.lineno}"
        faults.append(f"{type(error).__name__} at {where}: {str(error)[:300]}")
        outcome = "failed"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)
    seconds = time.process_time() - began
    memory = _status("VmHWM") - at_rest
    if memory > MEMORY:
        faults.append(f"{memory / 2**20:.0f} MiB of memory")
    if _listing(folder) != before:
        faults.append(f"the folder was changed: {sorted(set(_listing(folder)) ^ set(before))}")
    faults += sorted(set(watch.seen))
    return {"outcome": outcome, "faults": faults, "seconds": seconds, "memory": memory}


def limited(extra: int) -> None:
    """Limit the address space to what is in use and so much more, bytes."""
    import resource

    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (_status("VmSize") + extra, hard))


def alarmed() -> None:
    """Let alarms end a load."""
    signal.signal(signal.SIGALRM, _alarm)
    signal.signal(signal.SIGPROF, _alarm)


def _alarm(*_: Any) -> None:
    raise TooLong


def warm(reader: Reader, seeds: dict[str, Seed], folder: Path) -> None:
    """Load what is sound: imports and programs are paid for, and the seeds are seeds."""
    for label, seed in seeds.items():
        with tempfile.TemporaryDirectory(dir=folder, prefix="sound-") as place:
            path = lay(Path(place), seed)
            try:
                reader.load(path, **seed.options)
            except Exception as error:
                raise AssertionError(f"the seed {label} is not sound: {error}") from error
