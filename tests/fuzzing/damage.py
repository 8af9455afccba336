"""Damage to bytes: bits flipped, numbers and words replaced, pieces moved, doubled, left out."""

import re
from collections.abc import Callable

import numpy as np

_SPECIAL_INTS = (0, 1, -1, 2**7, 2**15 - 1, 2**16 - 1, 2**31 - 1, -(2**31), 2**32 - 1, 2**62, 2**63)
_SPECIAL_FLOATS = (0.0, -0.0, np.nan, np.inf, -np.inf, 1e308, -1e308, 5e-324, 1e39, 1e-39)
#: Put in place of numbers, values and names.
WORDS = (
    *("0", "-1", "1e999", "-1e999", "nan", "inf", "1e308", "1e-320", "-0", "0x10", "1_0", "1e", ""),
    *("9" * 30, "9" * 400, "9" * 5000, "4294967296", "9223372036854775808", "0.1.2", "1,5", "true"),
    *("null", "[]", "{}", '""', "''", '"' + "a" * 3000 + '"', "\u0663", "\u00b5", "\ud7ff", "\x00"),
    *("[[0]]", "{ a = 1 }", "2026-01-01", "../../../../etc/passwd", "/dev/zero", "~", "."),
    *('"../a"', '"/dev/zero"', '"/proc/self/environ"', '"."', "[nan, inf, 1]", "[1e300, 1, 1]"),
    *("1e300", "1e-300", "-5", "2147483648", "-2147483649", '"nan"', "[1, 2]", "[1, 2, 3]"),
)
_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
_VALUE = re.compile(rb"(?m)(?<==)\s*[^\n]+$")

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
    word = WORDS[int(rng.integers(len(WORDS)))].encode()
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


def plain(data: bytes, rng: np.random.Generator) -> bytes:
    """One of them."""
    return list(PLAIN.values())[int(rng.integers(len(PLAIN)))](data, rng)
