"""The page of ``diffopt demo``: what it says, that it needs nothing else, and its sorting."""

import re
from html.parser import HTMLParser

import browsing
import numpy as np
import pytest

from diffopt.cli import main
from diffopt.cli.demo import SECTIONS
from diffopt.previews import markup
from diffopt.report import machine, numbers, page

VOID = {"img", "meta", "br", "hr", "input", "link"}


class Checked(HTMLParser):
    """Every element is closed; addresses, and text by element."""

    def __init__(self):
        super().__init__()
        self.open, self.links, self.seen = [], [], []

    def handle_starttag(self, tag, attrs):
        self.seen.append(tag)
        self.links += [value for name, value in attrs if name in ("src", "href")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag


def checked(text):
    found = Checked()
    found.feed(text)
    assert found.open == []
    for link in found.links:
        assert link.startswith(("#", "data:image/")), link[:60]
    return found


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The quick sections; the whole page is that of `make demo`."""
    folder = tmp_path_factory.mktemp("demo") / "page"
    only = "lobes,stability,shadows"
    assert main(["demo", "-o", str(folder), "--size", "64", "--only", only]) == 0
    return folder


def test_a_page_holds_its_sections():
    section = page.Section("one", "A < b", "x & y", (markup.table(["n"], [["1"]]),), "diffopt <x>")
    text = page.page("Title & more", "Lead", [section], [])
    found = checked(text)
    assert "#one" in found.links
    assert "A &lt; b" in text
    assert "diffopt &lt;x&gt;" in text
    assert 'name="viewport"' in text


def test_the_machine_is_named():
    facts = dict(machine.figures())
    assert facts["jax"].startswith("0.")
    assert "cores" in facts["processor"]
    assert facts["JAX computes on"].startswith("cpu")


def test_figures_of_stability_are_right():
    """As written some are wrong or not numbers; ours are right to rounding."""
    rows = {(what, at): rest for what, at, *rest in map(tuple, _rows(numbers._cases()))}
    ours = [(float(row[1]), float(row[3])) for row in rows.values()]
    assert max(value for value, _ in ours) < 1e-5
    assert max(slope for _, slope in ours) < 1e-3
    written = [row[0] for row in rows.values()] + [row[2] for row in rows.values()]
    assert "NaN" in written
    assert max(float(v) for v in written if v not in ("NaN", "∞")) > 1e-2


def _rows(cases):
    for what, at, naive, ours, exact in cases:
        said = [numbers._said(f, k, exact) for k in (0, 1) for f in (naive, ours)]
        yield what, at, said[0], said[1], said[2], said[3]


@pytest.mark.slow
@pytest.mark.long
def test_the_page_is_whole(made):
    text = (made / "index.html").read_text(encoding="utf-8")
    found = checked(text)
    assert found.seen.count("section") == 3
    assert found.seen.count("img") >= 4
    assert text.count("computed by diffopt") == 1
    assert re.search(r"in \d+ s, \d+ s of them compilation", text)
    assert "EM, then least squares" in text
    errors = [float(e) for e in re.findall(r">([\d.]+) %</td>", text)][:8]
    assert errors[-1] < 0.3 * errors[0]  # eight lobes and one
    assert len(text) < 3_000_000


@pytest.mark.slow
@pytest.mark.long
def test_tables_sort_and_nothing_is_asked_of_the_network(made):
    with browsing.browser() as found:
        for size in ((1200, 900), (390, 800)):
            shown, outside = browsing.opened(found, f"file://{made / 'index.html'}", size)
            assert outside == []
            width = shown.evaluate("document.documentElement.scrollWidth")
            assert width <= size[0]  # nothing is cut off on a phone
            head = shown.locator("#lobes th.sorts", has_text="time").first
            cells = "#lobes table:first-of-type tbody tr td:last-child"
            for order in (1, -1):
                head.click()
                words = shown.locator("#lobes table").first.locator("tbody tr td:last-child")
                values = [_seconds(word) for word in words.all_inner_texts()]
                assert len(values) == 8, cells
                assert values == sorted(values, reverse=order < 0)
            pictures = browsing.pixels(shown)
            assert np.ptp(pictures) > 100
            shown.close()


def _seconds(text):
    value, unit = text.split()
    return float(value) * {"us": 1e-6, "ms": 1e-3, "s": 1.0}[unit]


def test_an_unknown_section_is_named(tmp_path, capsys):
    assert main(["demo", "-o", str(tmp_path / "x"), "--only", "lobes,poetry"]) == 2
    error = capsys.readouterr().err
    assert "--only must be one of" in error
    assert "'poetry'" in error
    assert all(name in error for name in SECTIONS)
    assert not (tmp_path / "x").exists()
