"""Damaged files for every reader, in a child process with limits on memory and time.

Case k of a reader is made of nothing but the reader's name and k, so that a report names the
file: ``python tests/fuzzing.py READER K [FOLDER]`` makes it again, and says what comes out.

The child loads one file after another. It answers for each what came out; where it dies or says
nothing for long, the parent names the file it was at and starts another one. Beside the kind of
exception it sees, through the interpreter's audit events, what the load opened for writing,
started or unpickled.
"""

import contextlib
import dataclasses
import gc
import importlib
import io
import json
import os
import re
import select
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from fuzz_crafted import CRAFTED, PIPE
from fuzz_readers import READERS, Reader, Seed

#: Most address space beyond that of the idle child, bytes: an allocation that a header promises
#: fails, instead of being granted by a system that overcommits.
SPACE = 3 * 2**30
#: Most memory that one file of a few kilobytes may take, bytes.
MEMORY = 256 * 2**20
#: Longest load of one, seconds of the processor; tables of new shapes compile. By the clock,
#: which counts what other processes do and what waits for ever, four times that.
SECONDS = 5.0
#: Silence after which the parent kills the child: native code does not see the alarm.
SILENCE = 30.0

_SPECIAL_INTS = (0, 1, -1, 2**7, 2**15 - 1, 2**16 - 1, 2**31 - 1, -(2**31), 2**32 - 1, 2**62, 2**63)
_SPECIAL_FLOATS = (0.0, -0.0, np.nan, np.inf, -np.inf, 1e308, -1e308, 5e-324, 1e39, 1e-39)
_WORDS = (
    *("0", "-1", "1e999", "-1e999", "nan", "inf", "1e308", "1e-320", "-0", "0x10", "1_0", "1e", ""),
    *("9" * 30, "9" * 400, "9" * 5000, "4294967296", "9223372036854775808", "0.1.2", "1,5", "true"),
    *("null", "[]", "{}", '""', "''", '"' + "a" * 3000 + '"', "\u0663", "\u00b5", "\ud7ff", "\x00"),
    *("[[0]]", "{ a = 1 }", "2026-01-01", "../../../../etc/passwd", "/dev/zero", "~", "."),
    *('"../a"', '"/dev/zero"', '"/proc/self/environ"', '"."', "[nan, inf, 1]", "[1e300, 1, 1]"),
    *("1e300", "1e-300", "-5", "2147483648", "-2147483649", '"nan"', "[1, 2]", "[1, 2, 3]"),
)
_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
_VALUE = re.compile(rb"(?m)(?<==)\s*[^\n]+$")


# --- damage --------------------------------------------------------------------------------

Damage = Callable[[bytes, np.random.Generator], bytes]


def _span(data: bytes | bytearray, rng: np.random.Generator, most: int = 64) -> tuple[int, int]:
    """A piece; half of them start in the first 256 bytes, where headers are."""
    end = len(data) if rng.random() < 0.5 else min(len(data), 256)
    at = int(rng.integers(0, max(end, 1)))
    return at, min(len(data), at + int(rng.integers(1, most)))


def _flipped(data: bytes, rng: np.random.Generator) -> bytes:
    out = bytearray(data or b"\0")
    for _ in range(int(rng.integers(1, 9))):
        at, _ = _span(out, rng)
        out[at] ^= 1 << int(rng.integers(8))
    return bytes(out)


def _overwritten(data: bytes, rng: np.random.Generator) -> bytes:
    at, end = _span(data, rng)
    fill = (rng.bytes(end - at), b"\0" * (end - at), b"\xff" * (end - at), b"9" * (end - at))
    return data[:at] + fill[int(rng.integers(4))] + data[end:]


def _numbered(data: bytes, rng: np.random.Generator) -> bytes:
    """A special number in place of some bytes, most often aligned."""
    at, _ = _span(data, rng)
    size = int(rng.choice([1, 2, 4, 8]))
    at -= at % size if rng.random() < 0.7 else 0
    order = rng.choice(["<", ">"])
    if size >= 4 and rng.random() < 0.4:
        with np.errstate(over="ignore"):
            value = np.array(rng.choice(_SPECIAL_FLOATS), f"{order}f{size}").tobytes()
    else:
        number = _SPECIAL_INTS[int(rng.integers(len(_SPECIAL_INTS)))] % 2 ** (8 * size)
        value = number.to_bytes(size, "little" if order == "<" else "big")
    return data[:at] + value + data[at + size :]


def _reworded(data: bytes, rng: np.random.Generator) -> bytes:
    """A number of a text, or what stands behind an equals sign, replaced."""
    found = list((_NUMBER if rng.random() < 0.7 else _VALUE).finditer(data))
    if not found:
        return _overwritten(data, rng)
    match = found[int(rng.integers(len(found)))]
    word = _WORDS[int(rng.integers(len(_WORDS)))].encode()
    return data[: match.start()] + word + data[match.end() :]


def _inserted(data: bytes, rng: np.random.Generator) -> bytes:
    at = int(rng.integers(0, len(data) + 1))
    pieces = (
        *(b"\0", b"\xff\xfe", b"\xef\xbb\xbf", b"\n", b"\r", b"#", b'"', b"[", b"{", b"=", b"\\"),
        *(b" " * 20_000, b"1" * 20_000, b"[" * 20_000, b"1 " * 20_000, b"\n" * 20_000),
        *(b"a." * 5000, b'"' + b"x" * 20_000, b"0," * 20_000),
        *("\u2028\u0301\U0001f525".encode(), b"\xc3\x28", rng.bytes(int(rng.integers(1, 300)))),
    )
    return data[:at] + pieces[int(rng.integers(len(pieces)))] + data[at:]


def _duplicated(data: bytes, rng: np.random.Generator) -> bytes:
    at, end = _span(data, rng, 400)
    return data[:end] + data[at:end] * int(rng.choice([1, 2, 50])) + data[end:]


def _removed(data: bytes, rng: np.random.Generator) -> bytes:
    at, end = _span(data, rng, 400)
    return data[:at] + data[end:]


def _moved(data: bytes, rng: np.random.Generator) -> bytes:
    at, end = _span(data, rng, 200)
    rest = data[:at] + data[end:]
    to = int(rng.integers(0, len(rest) + 1))
    return rest[:to] + data[at:end] + rest[to:]


def _truncated(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: int(rng.integers(0, max(len(data), 1)))]


def _extended(data: bytes, rng: np.random.Generator) -> bytes:
    more = rng.bytes(int(rng.integers(1, 2000))) if rng.random() < 0.5 else data
    return data + more


def _lines(data: bytes, rng: np.random.Generator) -> bytes:
    """Lines of a text left out, doubled, or in another order."""
    lines = data.split(b"\n")
    at, other = (int(rng.integers(len(lines))) for _ in range(2))
    kind = int(rng.integers(3))
    if kind == 0:
        del lines[at]
    elif kind == 1:
        lines.insert(other, lines[at])
    else:
        lines[at], lines[other] = lines[other], lines[at]
    return b"\n".join(lines)


PLAIN: dict[str, Damage] = {
    "bits flipped": _flipped,
    "bytes overwritten": _overwritten,
    "special number": _numbered,
    "word replaced": _reworded,
    "bytes inserted": _inserted,
    "block doubled": _duplicated,
    "block removed": _removed,
    "block moved": _moved,
    "truncated": _truncated,
    "extended": _extended,
    "lines": _lines,
}


def _plain(data: bytes, rng: np.random.Generator) -> bytes:
    return list(PLAIN.values())[int(rng.integers(len(PLAIN)))](data, rng)


def _zipped(data: bytes, rng: np.random.Generator) -> bytes:
    """A member of an archive damaged, its checksums made to fit."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = list(members)[int(rng.integers(len(members)))]
    kind = int(rng.integers(8))
    if kind == 0:
        del members[name]
    elif kind == 1:
        members[_WORDS[int(rng.integers(len(_WORDS)))]] = members[name]
    else:
        members[name] = _plain(members[name], rng)
    out = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        warnings.simplefilter("ignore")
        for key, content in members.items():
            # No names with zero bytes: zipfile cuts them itself.
            archive.writestr(key.replace("\0", "_") or "empty", content)
    return out.getvalue()


def _chunked(data: bytes, rng: np.random.Generator) -> bytes:
    """A chunk of a PNG damaged, its checksum made to fit."""
    chunks, at = [], 8
    while at + 12 <= len(data):
        (size,) = struct.unpack(">I", data[at : at + 4])
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    k = int(rng.integers(len(chunks)))
    name, body = chunks[k]
    if name == b"IDAT" and rng.random() < 0.5:
        body = zlib.compress(_plain(zlib.decompress(body), rng))
    else:
        body = _plain(body, rng)
    chunks[k] = name, body
    out = data[:8]
    for name, body in chunks:
        whole = name + body
        out += struct.pack(">I", len(body)) + whole + struct.pack(">I", zlib.crc32(whole))
    return out


def _rewritten(data: bytes, rng: np.random.Generator) -> bytes:
    """A value of a JSON text replaced by one of another kind or size."""
    content = json.loads(data)
    places: list[tuple[Any, Any]] = []

    def walk(value: Any) -> None:
        for key in value if isinstance(value, dict) else range(len(value)):
            places.append((value, key))
            if isinstance(value[key], dict | list):
                walk(value[key])

    walk(content)
    values = (
        *(0, -1, 1, 2**31, 2**63, 10**30, 1.5, 1e308, float("nan"), float("inf"), None, True, ""),
        *([], {}, [[]], "x" * 2000, "../../etc/passwd", "/dev/zero", [1] * 50, [10**9] * 4, "NaN"),
    )
    holder, key = places[int(rng.integers(len(places)))]
    kind = int(rng.integers(6))
    if kind == 0:
        del holder[key]
    elif kind == 1 and isinstance(holder, list):
        holder.insert(key, holder[key])
    else:
        holder[key] = values[int(rng.integers(len(values)))]
    return json.dumps(content).encode()


def _summed(data: bytes, rng: np.random.Generator) -> bytes:
    """A chunk of a store damaged, its checksum (CRC-32C, the last four bytes) made to fit."""
    import google_crc32c

    body = _plain(data[:-4], rng)
    return body + struct.pack("<I", google_crc32c.value(body))


def special(data: bytes) -> list[tuple[str, Damage]]:
    """Damage that keeps the outer shell of a format sound."""
    found: list[tuple[str, Damage]] = []
    if data[:4] == b"PK\x03\x04":
        found.append(("archive repacked", _zipped))
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        found.append(("PNG chunk", _chunked))
    if data[:1] == b"{":
        found.append(("JSON value", _rewritten))
    if data[:1] == b"\x02" and len(data) > 20:
        found.append(("chunk with checksum", _summed))
    return found


# --- cases ---------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Case:
    """One damaged folder.

    Attributes
    ----------
    label
        Seed, file and damage in words.
    seed
        The folder, damaged.
    others
        What is no plain file in it, see `fuzz_crafted.Crafted`.
    harmless
        Whether it may be read.
    """

    label: str
    seed: Seed
    others: dict[str, str | int] = dataclasses.field(default_factory=dict)
    harmless: bool = True


def case(name: str, seeds: dict[str, Seed], number: int) -> Case:
    """Case `number` of a reader; nothing else enters. Below 0: the crafted ones, from -1 down."""
    if number < 0:
        label, found = list(CRAFTED[name](seeds).items())[-1 - number]
        return Case(f"made to harm: {label}", found.seed, found.others, found.harmless)
    rng = np.random.default_rng([zlib.crc32(name.encode()), number])
    labels = list(seeds)
    label = labels[number % len(labels)]
    seed = seeds[label]
    names = list(seed.files)
    # Of a scene most often the scene, of a store all files alike.
    main = seed.main in seed.files and rng.random() < 0.7
    file = seed.main if main else names[int(rng.integers(len(names)))]
    data = seed.files[file]
    roll = rng.random()
    own = special(data)
    if roll < 0.01:
        what, damaged = "empty", b""
    elif roll < 0.04:
        other = list(FOREIGN)[int(rng.integers(len(FOREIGN)))]
        what, damaged = f"replaced by {other}", FOREIGN[other]
    elif roll < 0.07 and len(names) > 1:
        what, damaged = "deleted", None
    elif own and roll < 0.5:
        what, change = own[int(rng.integers(len(own)))]
        damaged = change(data, rng)
    else:
        what, damaged = "", data
        for _ in range(1 if rng.random() < 0.7 else int(rng.integers(2, 5))):
            word = list(PLAIN)[int(rng.integers(len(PLAIN)))]
            what += f"{', ' if what else ''}{word}"
            damaged = PLAIN[word](damaged, rng) if damaged else damaged
    files = {key: value for key, value in seed.files.items() if key != file}
    if damaged is not None:
        files[file] = damaged
    return Case(f"{label}, {file}: {what}", dataclasses.replace(seed, files=files))


def _pickled() -> bytes:
    out = io.BytesIO()
    np.save(out, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    return out.getvalue()


#: Contents that stand under other names.
FOREIGN: dict[str, bytes] = {
    "a pickle": b"\x80\x04\x95\x10\x00\x00\x00\x00\x00\x00\x00\x8c\x02os\x8c\x06getcwd\x93)R.",
    "an object array": _pickled(),
    "a ZIP archive": b"PK\x05\x06" + bytes(18),
    "a GIF": b"GIF89a\x01\x00\x01\x00\x00\x00\x00;",
    "HTML": b"<!DOCTYPE html><html><body>404 Not Found</body></html>",
    "zeros": bytes(5000),
    "spaces": b" " * 5000,
    "HDF5": b"\x89HDF\r\n\x1a\n" + bytes(100),
    "XML": b'<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]><a>&b;</a>',
    "JSON nested deep": b"[" * 50_000,
    "an ELF file": b"\x7fELF\x02\x01\x01" + bytes(200),
}


def lay(folder: Path, seed: Seed, others: dict[str, str | int] | None = None) -> Path:
    """Write a seed into a folder; gives what is to be loaded."""
    for name, kind in (others or {}).items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if kind == PIPE:
            os.mkfifo(path)
        elif isinstance(kind, str):
            path.symlink_to(kind)
        else:
            path.touch()
            os.truncate(path, kind)
    for name, content in seed.files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return folder / seed.main


# --- the child -----------------------------------------------------------------------------


class TooLong(BaseException):
    """The alarm; no reader may swallow it."""


class Watch:
    """What a load does beside giving a result, by audit events of the interpreter."""

    _WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
    _DOING = (
        *("os.remove", "os.rename", "os.mkdir", "os.rmdir", "os.symlink", "os.link", "os.truncate"),
        *("os.system", "os.exec", "os.posix_spawn", "subprocess.Popen", "socket.connect"),
        *("pickle.find_class", "shutil.rmtree", "urllib.Request", "tempfile.mkstemp"),
    )

    def __init__(self) -> None:
        self.seen: list[str] = []
        self.opened: set[str] = set()
        self._on = False
        self._patched: dict[str, Any] = {}
        sys.addaudithook(self._hook)
        self._pickles()

    def _hook(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self._on:
            return
        if event == "open":
            path, _, flags = arguments
            if isinstance(flags, int) and flags & self._WRITING:
                self.seen.append(f"opened {path!r} for writing")
            elif isinstance(path, str | bytes):
                self.opened.add(os.path.abspath(os.fsdecode(path)))
        elif event in self._DOING:
            self.seen.append(f"{event} {arguments[:2]!r}")

    def _pickles(self) -> None:
        import pickle

        for name in ("load", "loads", "Unpickler", "_load", "_loads", "_Unpickler"):
            made = getattr(pickle, name)

            def called(*arguments: Any, _made: Any = made, _name: str = name, **more: Any) -> Any:
                if self._on:
                    self.seen.append(f"pickle.{_name}")
                return _made(*arguments, **more)

            if not isinstance(made, type):
                self._patched[name] = made
                setattr(pickle, name, called)

    def close(self) -> None:
        """Give `pickle` its functions back; the hook stays, and is still."""
        import pickle

        for name, made in self._patched.items():
            setattr(pickle, name, made)

    @contextlib.contextmanager
    def watching(self) -> Iterator[None]:
        self.seen, self.opened, self._on = [], set(), True
        try:
            yield
        finally:
            self._on = False


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


def _limited(extra: int) -> None:
    import resource

    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (_status("VmSize") + extra, hard))


def _alarm(*_: Any) -> None:
    raise TooLong


def _quiet(number: int) -> int:
    """A copy of a file descriptor, whose place is taken by nothing: native code prints."""
    kept = os.dup(number)
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, number)
    os.close(nothing)
    return kept


def child() -> None:
    """Answer requests ``[reader, first, end, folder]``, a line each, until there are no more.

    Without an end all crafted cases from the first on are loaded.
    """
    answers = os.fdopen(_quiet(1), "w", buffering=1)
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    signal.signal(signal.SIGALRM, _alarm)
    signal.signal(signal.SIGPROF, _alarm)
    with contextlib.suppress(ImportError), warnings.catch_warnings():
        # Asks the system for its processor when it is imported.
        warnings.simplefilter("ignore")
        importlib.import_module("SurfaceTopography.IO")
    watch = Watch()
    made: dict[str, dict[str, Seed]] = {}
    for line in sys.stdin:
        name, first, end, folder = json.loads(line)
        reader = READERS[name]
        if name not in made:
            made[name] = reader.seeds()
        _warm(watch, reader, made[name], Path(folder))
        _limited(SPACE)
        if end is None:
            numbers = range(first, -len(CRAFTED[name](made[name])) - 1, -1)
        else:
            numbers = range(first, end)
        for number in numbers:
            print(json.dumps({"at": number}), file=answers)
            found = case(name, made[name], number)
            with tempfile.TemporaryDirectory(dir=folder, prefix="case-") as place:
                answer = attempt(watch, reader.load, Path(place), found)
            print(json.dumps({"case": number, "label": found.label, **answer}), file=answers)
        _limited(2**46)
        gc.collect()
        print(json.dumps({"done": True}), file=answers)


def _warm(watch: Watch, reader: Reader, seeds: dict[str, Seed], folder: Path) -> None:
    """Load what is sound: imports and programs are paid for, and the seeds are seeds."""
    for label, seed in seeds.items():
        with tempfile.TemporaryDirectory(dir=folder, prefix="sound-") as place:
            path = lay(Path(place), seed)
            try:
                reader.load(path, **seed.options)
            except Exception as error:
                raise AssertionError(f"the seed {label} is not sound: {error}") from error


# --- the parent ----------------------------------------------------------------------------


@dataclasses.dataclass
class Report:
    """What came of the cases of a reader.

    Attributes
    ----------
    outcomes
        How many were read, refused, or failed.
    faults
        One line each: case, file, damage, what was wrong.
    seconds, memory
        Most of a single file: seconds of the processor, bytes.
    whole
        Seconds of all.
    """

    outcomes: dict[str, int] = dataclasses.field(default_factory=dict)
    faults: list[str] = dataclasses.field(default_factory=list)
    seconds: float = 0.0
    memory: int = 0
    whole: float = 0.0

    def add(self, name: str, answer: dict[str, Any]) -> None:
        outcome = answer["outcome"]
        self.outcomes[outcome] = self.outcomes.get(outcome, 0) + 1
        self.seconds = max(self.seconds, answer.get("seconds", 0.0))
        self.memory = max(self.memory, answer.get("memory", 0))
        label = answer.get("label", "")
        self.faults += [f"{name} {answer['case']} ({label}): {f}" for f in answer["faults"]]


class Child:
    """The process that loads; started again where it died."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._process: subprocess.Popen[bytes] | None = None
        self._rest = b""

    def run(self, name: str, count: int | None, first: int = 0) -> Report:
        """Load cases of a reader, so many from the first on; without a number the crafted ones."""
        report, began = Report(), time.monotonic()
        end = None if count is None else first + count
        first = -1 if count is None else first
        whole = False
        while not whole:
            process = self._started()
            assert process.stdin is not None
            request = json.dumps([name, first, end, str(self.folder)])
            with contextlib.suppress(BrokenPipeError):  # what it says then is nothing
                process.stdin.write(request.encode() + b"\n")
                process.stdin.flush()
            at: int | None = None
            while True:
                answer = self._answer(SILENCE if at is not None else 10.0 * SILENCE)
                if not answer:
                    how = self._stopped(silent=answer is not None)
                    if at is None:
                        raise RuntimeError(f"{name}: the child {how} before its first file")
                    report.add(name, {"case": at, "outcome": "died", "faults": [f"child {how}"]})
                    first = at - 1 if end is None else at + 1
                    break
                if "at" in answer:
                    at = answer["at"]
                elif "case" in answer:
                    report.add(name, answer)
                else:
                    whole = True
                    break
        report.whole = time.monotonic() - began
        return report

    def close(self) -> None:
        """End the process."""
        if self._process is not None and self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
            self._stopped()

    def _started(self) -> "subprocess.Popen[bytes]":
        if self._process is None:
            environment = dict(os.environ, JAX_PLATFORMS="cpu", JAX_ENABLE_X64="1")
            # A cache of programs is written to, which no load may do.
            environment.pop("JAX_COMPILATION_CACHE_DIR", None)
            self._rest = b""
            with (self.folder / "child.log").open("wb") as log:
                self._process = subprocess.Popen(
                    [sys.executable, __file__],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    env=environment,
                    cwd=self.folder,
                )
        return self._process

    def _answer(self, patience: float) -> dict[str, Any] | None:
        """A line; None at the end of the child, empty after a silence."""
        assert self._process is not None
        assert self._process.stdout is not None
        until = time.monotonic() + patience
        while b"\n" not in self._rest:
            ready, _, _ = select.select([self._process.stdout], [], [], until - time.monotonic())
            more = os.read(self._process.stdout.fileno(), 65536) if ready else None
            if not more:
                return None if more == b"" else {}
            self._rest += more
        line, _, self._rest = self._rest.partition(b"\n")
        return json.loads(line)

    def _stopped(self, silent: bool = False) -> str:
        """End it, if it has not ended; how it did."""
        process, self._process = self._process, None
        assert process is not None
        code = None
        if silent:
            process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            code = process.wait(SILENCE)
        if code is None:
            process.kill()
            process.wait()
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):  # what was not sent cannot be any more
                    pipe.close()
        log = (self.folder / "child.log").read_text(errors="replace").strip().splitlines()
        last = f": {log[-1][:300]}" if log else ""
        if silent:
            return f"said nothing for long, and was killed{last}"
        if code is None:
            return f"did not end, and was killed{last}"
        return f"died of signal {-code}{last}" if code < 0 else f"ended with {code}{last}"


def scratch() -> "tempfile.TemporaryDirectory[str]":
    """A folder in memory, where there is such a one: cases make and remove many."""
    memory = Path("/dev/shm")
    return tempfile.TemporaryDirectory(dir=memory if os.access(memory, os.W_OK) else None)


def again(name: str, number: int, folder: Path | None = None) -> None:
    """Make a case once more and say what comes out."""
    signal.signal(signal.SIGALRM, _alarm)
    signal.signal(signal.SIGPROF, _alarm)
    reader = READERS[name]
    seeds = reader.seeds()
    found = case(name, seeds, number)
    print(found.label)
    watch = Watch()
    place = Path(tempfile.mkdtemp()) if folder is None else folder
    _warm(watch, reader, seeds, place)
    _limited(SPACE)
    print(json.dumps(attempt(watch, reader.load, place, found), indent=1))
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        print("read:", type(reader.load(place / found.seed.main, **found.seed.options)).__name__)
    except Exception:
        traceback.print_exc()
    if folder is None:
        shutil.rmtree(place)


def survey(count: int, names: list[str], first: int = 0) -> None:
    """Many cases of some readers (0: the crafted ones), and a table."""
    with scratch() as folder:
        worker = Child(Path(folder))
        for name in names:
            found = worker.run(name, count or None, first)
            done = ", ".join(f"{n} {word}" for word, n in sorted(found.outcomes.items()))
            print(
                f"{name}: {done}; {found.whole:.1f} s, longest {found.seconds:.2f} s, most "
                f"{found.memory / 2**20:.0f} MiB; {len(found.faults)} faults",
                flush=True,
            )
            kinds: dict[str, list[str]] = {}
            for fault in found.faults:
                kind = re.sub(r"[\d.]+", "#", fault.partition("): ")[2])[:90]
                kinds.setdefault(kind, []).append(fault)
            for group in kinds.values():
                print(f"   {len(group)} x {group[0][:420]}", flush=True)
        worker.close()


if __name__ == "__main__":
    if len(sys.argv) == 1:
        child()
    elif sys.argv[1] == "--survey":
        chosen = [n for n in READERS if any(word in n for word in sys.argv[3:] or [""])]
        survey(int(sys.argv[2]), chosen, int(os.environ.get("FUZZ_FIRST", "0")))
    else:
        again(sys.argv[1], int(sys.argv[2]), *map(Path, sys.argv[3:4]))
