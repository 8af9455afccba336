"""Tables of a scene file: values taken with their kinds, faults collected with their lines."""

import contextlib
import dataclasses
import math
import re
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from diffopt import checks
from diffopt.errors import InputError
from diffopt.io.files import one_line
from diffopt.scenes.toml_lines import Where, line_numbers

# Time and memory that a parser of TOML takes grow with the square of a key's parts.
_DEEP_KEY = re.compile(
    r"""(?<![\w"'.-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){64}"""
)


@dataclasses.dataclass(frozen=True)
class Fault:
    """Something wrong in a file.

    Attributes
    ----------
    line
        Its line, counted from 1; None where that is not known.
    place
        Table and key in words; empty for the whole file.
    text
        What was received and what was expected.
    """

    line: int | None
    place: str
    text: str


class SceneFileError(InputError):
    """All faults of a scene file, one a line.

    Attributes
    ----------
    path
        The file.
    faults
        In the order of their lines.
    """

    def __init__(self, path: Path, faults: Sequence[Fault]) -> None:
        self.path = path
        self.faults = tuple(sorted(faults, key=lambda fault: fault.line or 0))
        super().__init__("\n".join(self.lines))

    @property
    def lines(self) -> list[str]:
        """Each fault with file, line and place."""
        return [
            f"{self.path}{f':{fault.line}' if fault.line else ''}: "
            f"{fault.place}{': ' if fault.place else ''}{fault.text}"
            for fault in self.faults
        ]


class Source:
    """A file's text as a table of tables, with the faults found in it so far.

    Attributes
    ----------
    path
        The file.
    content
        The table.
    faults
        What is wrong.
    outside
        Files that are read from outside of the file's folder, one sentence each.
    """

    def __init__(self, path: Path, text: str) -> None:
        self.path = path
        self.faults: list[Fault] = []
        self.outside: list[str] = []
        deep = _DEEP_KEY.search(text)
        if deep is not None:
            line = text.count("\n", 0, deep.start()) + 1
            raise SceneFileError(path, [Fault(line, "", "not a scene: a key of 65 parts or more")])
        try:
            self.content = tomllib.loads(text)
        except RecursionError:
            fault = Fault(None, "", "not TOML: tables or lists lie too deep in each other")
            raise SceneFileError(path, [fault]) from None
        except tomllib.TOMLDecodeError as error:
            words, _, place = str(error).partition(" (at ")
            found = re.search(r"line (\d+)", place)
            # Of an unfinished table the end is named as such.
            line = int(found[1]) if found else max(text.count("\n"), 1)
            fault = Fault(line, "", f"not TOML: {words[0].lower()}{words[1:]}")
            raise SceneFileError(path, [fault]) from None
        except ValueError as error:  # of a number with thousands of digits, a date that is none
            fault = Fault(None, "", f"not TOML: {one_line(error)}")
            raise SceneFileError(path, [fault]) from None
        self._lines = line_numbers(text)

    def line(self, where: Where) -> int | None:
        """Line of a value, or of the nearest table around it."""
        for count in range(len(where), 0, -1):
            if where[:count] in self._lines:
                return self._lines[where[:count]]
        return None

    def say(self, where: Where, text: str) -> None:
        """Note a fault."""
        self.faults.append(Fault(self.line(where), self.place(where), text))

    def place(self, where: Where) -> str:
        """Table and key in words, with the name of an object or light."""
        words, inside = "", self.content
        for k, part in enumerate(where):
            with contextlib.suppress(KeyError, IndexError, TypeError):
                inside = inside[part]  # type: ignore[index]
            if isinstance(part, int) and k == 1:
                name = inside.get("name") if isinstance(inside, dict) else None
                words = f"[[{where[0]}]] {part + 1}" + (f" ({name})" if name else "")
            elif isinstance(part, int):
                words += f"[{part}]"
            elif k == 0:
                words = f"[{part}]"
            elif k == 1 and where[0] == "materials":
                words = f"[materials.{part}]"
            else:
                words += f"{', ' if words.endswith((']', ')')) or k == 2 else '.'}{part}"
        return words

    @contextlib.contextmanager
    def at(self, where: Where, keys: Sequence[str] = ()) -> Iterator[None]:
        """Turn bad input inside into a fault, at the key that its text begins with."""
        try:
            yield
        except SceneFileError:
            raise
        except (InputError, ValueError, OSError) as error:
            text = " ".join(str(error).split())
            named = [key for key in keys if re.match(rf"{re.escape(key)}\b", text)]
            # The place says the key already.
            self.say((*where, *named[:1]), text[len(named[0]) :].lstrip(": ") if named else text)


class Table:
    """A table from which values are taken one by one; what is left over is unknown.

    Values of the wrong kind are noted as faults and given as None.
    """

    def __init__(self, source: Source, where: Where, content: dict[str, Any]) -> None:
        self.source, self.where, self.content = source, where, content
        self._asked: set[str] = set()
        self._before = len(source.faults)

    def __contains__(self, name: str) -> bool:
        return name in self.content

    @property
    def sound(self) -> bool:
        """Whether nothing in it was wrong so far."""
        return len(self.source.faults) == self._before

    def say(self, name: str, text: str) -> None:
        """Note a fault of a value."""
        self.source.say((*self.where, name), text)

    def raw(self, name: str) -> Any:
        """A value of any kind; None where there is none."""
        self._asked.add(name)
        return self.content.get(name)

    def number(self, name: str) -> float | None:
        """A finite number."""
        value = self._checked(name, is_number, "a number")
        return None if value is None else float(value)

    def text(self, name: str) -> str | None:
        """A string that is not empty."""
        return self._checked(name, lambda v: isinstance(v, str) and v != "", "a string")

    def choice(self, name: str, options: Sequence[str], default: str | None = None) -> str | None:
        """One of some words; a missing one is a fault unless there is a default."""
        value = self.raw(name)
        if value is None and default is not None:
            return default
        if value is None:
            self.source.say(self.where, f"needs {name}: one of {', '.join(options)}")
            return None
        if not isinstance(value, str) or value not in options:
            self.say(
                name,
                f"expected one of {', '.join(options)}; received {value!r}{near(value, options)}",
            )
            return None
        return value

    def numbers(self, name: str, *counts: int) -> list[float] | None:
        """A list of finite numbers, so many of them."""
        words = " to ".join(str(count) for count in sorted({min(counts), max(counts)}))
        value = self._checked(
            name,
            lambda v: isinstance(v, list) and len(v) in counts and all(map(is_number, v)),
            f"{words} numbers",
        )
        return None if value is None else [float(each) for each in value]

    def colour(self, name: str) -> float | list[float] | None:
        """A number, [r, g, b], or channels of the scene."""
        value = self._checked(
            name,
            lambda v: (
                is_number(v) or (isinstance(v, list) and len(v) > 0 and all(map(is_number, v)))
            ),
            "a number, [r, g, b] or a number for each channel",
        )
        if isinstance(value, list):
            return [float(each) for each in value]
        return None if value is None else float(value)

    def file(self, name: str) -> Path | None:
        """A file, by a path relative to that of the scene; one that is not there is a fault.

        One outside of the scene's folder, by its name or by a link, is noted as such.
        """
        value = self.text(name)
        if value is None:
            return None
        try:
            folder = self.source.path.parent
            path = folder / Path(value).expanduser()
            if not path.is_file():
                reason = "is a folder; expected a file" if path.is_dir() else "no such file"
                self.say(name, f"{path}: {reason}")
                return None
            real, home = path.resolve(), folder.resolve()
        except (OSError, RuntimeError, ValueError) as error:  # too long, a user that is none, NUL
            self.say(name, f"{shown(value)} is no path: {one_line(error)}")
            return None
        if not real.is_relative_to(home):
            said = f"{value} is outside of the scene's folder: read from {real}"
            self.source.outside.append(said)
        return path

    def table(self, name: str) -> "Table | None":
        """A table inside."""
        value = self._checked(name, lambda v: isinstance(v, dict), "a table")
        return None if value is None else Table(self.source, (*self.where, name), value)

    def tables(self, name: str) -> list["Table"]:
        """Tables inside a list, as of ``[[objects]]``."""
        value = self._checked(
            name,
            lambda v: isinstance(v, list) and all(isinstance(each, dict) for each in v),
            f"tables, each under [[{name}]]",
        )
        return [
            Table(self.source, (*self.where, name, k), each) for k, each in enumerate(value or [])
        ]

    def given(self, *names: str) -> dict[str, Any]:
        """Those of some values that are there, of any kind."""
        return {name: self.raw(name) for name in names if name in self.content}

    def done(self, *more: str) -> bool:
        """Note keys that nothing asked for (beside `more`); whether all was sound."""
        known = sorted(self._asked | set(more))
        for name in self.content:
            if name not in known:
                self.say(name, f"unknown key{near(name, known)}; expected {', '.join(known)}")
        return self.sound

    def _checked(self, name: str, fits: Any, expected: str) -> Any:
        value = self.raw(name)
        if value is None or fits(value):
            return value
        self.say(name, f"expected {expected}; received {shown(value)}")
        return None


def is_number(value: Any) -> bool:
    """Whether a value is a finite number (true and false are none)."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # a whole number beyond every float
        return False


def shown(value: Any) -> str:
    """A value in words, shortened."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def near(word: Any, options: Sequence[str]) -> str:
    """A hint at the nearest of some words; empty if none is near."""
    found = checks.nearest(word, options)
    return f" (did you mean {found}?)" if found else ""
