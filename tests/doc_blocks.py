"""Fenced blocks of the pages, and what of them is compared with what came out."""

import dataclasses
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
#: Kinds of blocks that are executed or loaded; others are a fault.
KINDS = ("python", "console", "toml", "csv", "json")

_OPENING = re.compile(r"^(?P<indent> *)(?P<fence>`{3,}|~{3,})(?P<info>.*)$")
_SAID = re.compile(r"#\s*->\s*(.+?)\s*$")
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")


@dataclasses.dataclass(frozen=True)
class Block:
    """A fenced block: its kind, its text, and the number of its first line in the page."""

    page: Path
    kind: str
    text: str
    line: int

    @property
    def place(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"


def pages() -> list[Path]:
    """Every page with blocks or links: README, contributing, changes, and all of docs."""
    front = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]
    return front + sorted((ROOT / "docs").rglob("*.md"))


def blocks(page: Path) -> list[Block]:
    """The fenced blocks of a page in order."""
    found = []
    lines = page.read_text(encoding="utf-8").splitlines()
    number = 0
    while number < len(lines):
        opening = _OPENING.match(lines[number])
        number += 1
        if opening is None:
            continue
        first, indent, fence = number, len(opening["indent"]), opening["fence"]
        while number < len(lines) and lines[number].strip() != fence:
            number += 1
        if number == len(lines):
            raise ValueError(f"{page}:{first}: a block that is not closed")
        text = "\n".join(line[indent:] for line in lines[first:number]) + "\n"
        found.append(Block(page, opening["info"].strip(), text, first + 1))
        number += 1
    return found


def commands(block: Block) -> list[str]:
    """The command lines of a console block, without comments."""
    lines = (re.sub(r"(^|\s)#.*$", "", line).strip() for line in block.text.splitlines())
    return [line for line in lines if line]


def said(text: str) -> list[str]:
    """What the comments ``# -> value`` of a Python block say that it prints, in order."""
    return [match[1] for line in text.splitlines() if (match := _SAID.search(line))]


def agrees(expected: str, printed: str) -> bool:
    """Whether a line is as expected: words equal, numbers to one unit of their last digit."""
    if _NUMBER.sub("#", expected).split() != _NUMBER.sub("#", printed).split():
        return False
    pairs = zip(_NUMBER.findall(expected), _NUMBER.findall(printed), strict=True)
    return all(abs(float(a) - float(b)) <= 1.001 * unit(a) for a, b in pairs)


def unit(number: str) -> float:
    """One unit of the last digit of a number as it is written."""
    mantissa, _, power = number.lower().partition("e")
    decimals = len(mantissa.partition(".")[2])
    return 10.0 ** (int(power or 0) - decimals)
