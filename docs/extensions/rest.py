"""Docstrings hold tables and blocks as reStructuredText has them; pages are Markdown."""

import re
from typing import Any

import griffe

_RULE = re.compile(r"^(=+)\s+(=+)$")


class Rest(griffe.Extension):
    """Rewrite simple tables of two columns, doctests and literal blocks of every docstring."""

    def on_instance(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Rewrite one docstring."""
        del kwargs
        if obj.docstring is not None:
            obj.docstring.value = markdown(obj.docstring.value)


def markdown(text: str) -> str:
    """A docstring as Markdown."""
    out: list[str] = []
    lines = iter(text.splitlines())
    for line in lines:
        rule = _RULE.match(line)
        if rule is not None:
            out += _table(lines, len(rule[1]))
        elif line.lstrip().startswith(">>>"):
            out += ["```python", line.strip()]
            for code in lines:
                if not code.strip():
                    break
                out.append(code.strip())
            out += ["```", ""]
        elif line.rstrip().endswith("::"):
            out.append(line.rstrip()[:-1] if line.strip() != "::" else "")
        else:
            out.append(line)
    return "\n".join(out)


def _table(lines: Any, width: int) -> list[str]:
    """Rows up to the closing rule; a row without a first cell goes on with the one before."""
    rows: list[list[str]] = []
    for line in lines:
        if _RULE.match(line):
            break
        first, rest = line[:width].strip(), line[width:].strip()
        if first or not rows:
            rows.append([first, rest])
        else:
            rows[-1][1] += " " + rest
    body = [f"| {a} | {b.replace('|', chr(92) + '|')} |" for a, b in rows]
    return ["", "| Name | What it holds |", "|---|---|", *body, ""]
