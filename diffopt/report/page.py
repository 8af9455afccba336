"""The page: sections with pictures and tables, styles and the sorting of tables inside."""

import dataclasses
from collections.abc import Sequence

from diffopt.previews import markup
from diffopt.previews.markup import Markup


@dataclasses.dataclass(frozen=True)
class Section:
    """A part of the page.

    Attributes
    ----------
    name
        One word, for links.
    title
        A question or a statement.
    text
        What was computed, and what is to be seen.
    parts
        HTML of `diffopt.previews.markup`.
    command
        That computes more of it; empty for none.
    """

    name: str
    title: str
    text: str
    parts: tuple[Markup, ...]
    command: str = ""


def figure(picture: Markup, title: str, text: str) -> Markup:
    """A picture with what it shows."""
    return Markup(
        f"<figure>{picture}<figcaption><b>{markup.escape(title)}.</b> {markup.escape(text)}"
        "</figcaption></figure>"
    )


def grid(figures: Sequence[Markup]) -> Markup:
    """Figures side by side where there is room."""
    return Markup(f'<div class="grid">{"".join(figures)}</div>')


def page(title: str, lead: str, sections: Sequence[Section], foot: Sequence[Markup]) -> str:
    """The whole page.

    Parameters
    ----------
    title, lead
        Heading, and a paragraph under it.
    sections
        In order.
    foot
        After them.
    """
    links = " · ".join(f'<a href="#{one.name}">{markup.escape(one.name)}</a>' for one in sections)
    body = "\n".join(_section(one) for one in sections)
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{markup.escape(title)}</title>
<style>{_STYLE}</style>
</head>
<body>
<header><h1>{markup.escape(title)}</h1>
<p>{markup.escape(lead)}</p>
<nav>{links}</nav></header>
<main>
{body}
</main>
<footer>{"".join(foot)}</footer>
<script>{_SORT}</script>
</body>
</html>
"""


def _section(one: Section) -> str:
    command = f"<pre><code>{markup.escape(one.command)}</code></pre>" if one.command else ""
    return (
        f'<section id="{one.name}"><h2>{markup.escape(one.title)}</h2>'
        f"<p>{markup.escape(one.text)}</p>{''.join(one.parts)}{command}</section>"
    )


_STYLE = """
:root { color-scheme: light dark; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 70rem; padding: 1rem 1.2rem 3rem; background: #fff;
  color: #1b1b1f; font: 16px/1.55 system-ui, sans-serif; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 1rem 0 0.5rem; }
h2 { font-size: 1.25rem; line-height: 1.3; margin: 0 0 0.4rem; }
section { border-top: 1px solid rgba(128,128,128,0.35); padding: 1.6rem 0 1rem; }
p { max-width: 46rem; margin: 0.4rem 0 0.9rem; }
nav, footer { font-size: 0.9rem; }
footer { border-top: 1px solid rgba(128,128,128,0.35); padding-top: 1.2rem; overflow-x: auto; }
.grid { display: grid; gap: 1.2rem;
  grid-template-columns: repeat(auto-fit, minmax(min(20rem, 100%), 1fr)); margin: 0.6rem 0; }
figure { margin: 0; min-width: 0; max-width: 42rem; }
figure img { width: 100% !important; border-radius: 4px; }
figcaption { font-size: 0.85rem; margin-top: 0.35rem; opacity: 0.85; }
img { max-width: 100%; height: auto; }
pre { overflow-x: auto; font-size: 0.85rem; padding: 0.6rem 0.8rem; border-radius: 4px;
  background: rgba(128,128,128,0.14); }
a { color: #0b63b5; }
th.sorts { cursor: pointer; user-select: none; }
th.sorts::after { content: " \\2195"; opacity: 0.45; }
th.sorts[aria-sort="ascending"]::after { content: " \\2191"; opacity: 1; }
th.sorts[aria-sort="descending"]::after { content: " \\2193"; opacity: 1; }
@media (prefers-color-scheme: dark) {
  body { background: #16171a; color: #e3e3e6; }
  a { color: #7db8f0; }
}
"""

# Heads of tables sort their rows: numbers by value with their units (s, ms, us, ns), text by text.
_SORT = """
(function () {
  var units = { ns: 1e-9, us: 1e-6, "\\u00b5s": 1e-6, ms: 1e-3, s: 1, min: 60, "%": 1e-2 };
  function value(cell) {
    var text = cell.textContent.trim().replace(/\\u2212/g, "-").replace(/(\\d),(?=\\d{3})/g, "$1");
    var found = text.match(/^[<>~\\u2264\\u2265\\u00b1 ]*([-+]?[\\d.]+(?:e[-+]?\\d+)?) ?(\\S*)/i);
    return found ? parseFloat(found[1]) * (units[found[2]] || 1) : text.toLowerCase();
  }
  function compare(a, b) {
    if (typeof a === typeof b) { return a < b ? -1 : a > b ? 1 : 0; }
    return typeof a === "number" ? -1 : 1;
  }
  document.querySelectorAll("table").forEach(function (table) {
    if (!table.tHead || table.tBodies[0].rows.length < 2) { return; }
    Array.from(table.tHead.rows[0].cells).forEach(function (head, column) {
      head.classList.add("sorts");
      head.tabIndex = 0;
      function sort() {
        var down = head.getAttribute("aria-sort") === "ascending";
        var rows = Array.from(table.tBodies[0].rows);
        rows.sort(function (a, b) {
          var order = compare(value(a.cells[column]), value(b.cells[column]));
          return down ? -order : order;
        });
        rows.forEach(function (row) { table.tBodies[0].appendChild(row); });
        Array.from(table.tHead.rows[0].cells).forEach(function (other) {
          other.removeAttribute("aria-sort");
        });
        head.setAttribute("aria-sort", down ? "descending" : "ascending");
      }
      head.addEventListener("click", sort);
      head.addEventListener("keydown", function (event) {
        if (event.key === "Enter" || event.key === " ") { event.preventDefault(); sort(); }
      });
    });
  });
})();
"""
