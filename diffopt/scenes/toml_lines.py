"""Lines of the tables and keys of a TOML file, for texts about faults."""

import re

#: Keys and numbers from the top of a file to a value, as ``("objects", 1, "radius")``.
Where = tuple[str | int, ...]

_HEADER = re.compile(r"\s*(\[\[?)\s*([^\[\]]+?)\s*\]\]?\s*(#.*)?$")
_KEY = re.compile(r"""\s*((?:[A-Za-z0-9_-]+|"[^"]*"|'[^']*')(?:\s*\.\s*[\w"'-]+)*)\s*=""")


def line_numbers(text: str) -> dict[Where, int]:
    """Lines of the tables and keys of a TOML file, counted from 1.

    A small scan that knows headers, keys at the start of a line, and values that go on over
    several lines; keys within inline tables have the line of the outer one.
    """
    lines: dict[Where, int] = {}
    table: Where = ()
    counts: dict[Where, int] = {}
    depth, quote = 0, ""
    for number, line in enumerate(text.splitlines(), 1):
        if not depth and not quote:
            header, key = _HEADER.match(line), _KEY.match(line)
            if header:
                table = _named(header[2], counts)
                if header[1] == "[[":
                    counts[table] = counts.get(table, -1) + 1
                    table = (*table, counts[table])
                lines.setdefault(table, number)
                continue
            if key:
                parts = tuple(part.strip().strip("\"'") for part in key[1].split("."))
                for count in range(1, len(parts) + 1):
                    lines.setdefault((*table, *parts[:count]), number)
        depth, quote = _open(line, depth, quote)
    return lines


def _named(header: str, counts: dict[Where, int]) -> Where:
    """A header's table, its parents that are lists by their last entry."""
    parts = [part.strip().strip("\"'") for part in re.findall(r"\"[^\"]*\"|'[^']*'|[^.]+", header)]
    found: Where = ()
    for k, part in enumerate(parts):
        found = (*found, part)
        if k < len(parts) - 1 and found in counts:
            found = (*found, counts[found])
    return found


def _open(line: str, depth: int, quote: str) -> tuple[int, str]:
    """Brackets, and a string of several lines, that are open at the end of a line."""
    at = 0
    while at < len(line):
        if quote:
            end = line.find(quote, at)
            if end < 0:
                return depth, quote if len(quote) == 3 else ""
            at, quote = end + len(quote), ""
        elif line[at] == "#":
            break
        elif line[at] in "\"'":
            quote = line[at] * 3 if line.startswith(line[at] * 3, at) else line[at]
            at += len(quote)
        else:
            depth += (line[at] in "[{") - (line[at] in "]}")
            at += 1
    return depth, quote if len(quote) == 3 else ""
