"""README and pages: every block runs, every link leads somewhere, the site builds and is whole.

By day the blocks of README run and those of all other pages are parsed; by night all run.
"""

import functools
import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from html.parser import HTMLParser
from pathlib import Path

import doc_blocks
import doc_commands
import pytest
from doc_blocks import ROOT, agrees, blocks, commands, pages, said
from lengths import but

from diffopt.accuracy import studies

TESTS = Path(__file__).parent
# The reference is made from docstrings, and the notebooks are run by a test of their own.
WRITTEN = [page for page in pages() if "api" not in page.parts]
WITH_BLOCKS = [page for page in WRITTEN if blocks(page)]
# Tags of HTML that load what they refer to; other links are for the reader to follow.
LOADING = {"link": "href", "script": "src", "img": "src", "iframe": "src", "source": "src"}

_LINK = re.compile(r"(?<!`)\[[^\]\n]*\]\(([^)\s]+)\)|<img[^>]*src=\"([^\"]+)\"")


def name(page):
    return page.relative_to(ROOT).as_posix()


def text_of(found):
    return "\n".join(page.read_text(encoding="utf-8") for page in found)


@functools.cache
def links(page):
    """Targets of links and pictures of a page, without those in blocks of code."""
    text = page.read_text(encoding="utf-8")
    for block in blocks(page):
        text = text.replace(block.text, "")
    return [one or other for one, other in _LINK.findall(text)]


def anchors(page):
    """What headings of a page can be linked to as, by the rule of Markdown's table of contents."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    plain = (re.sub(r"[^\w\s-]", "", heading).strip().lower() for heading in headings)
    return {re.sub(r"[-\s]+", "-", heading) for heading in plain}


@pytest.mark.parametrize("page", WRITTEN, ids=name)
def test_blocks_are_of_known_kinds(page):
    for block in blocks(page):
        assert block.kind in doc_blocks.KINDS, f"{block.place}: {block.kind!r} is not run"
        assert block.text.strip(), f"{block.place}: empty"


def parsed(block):
    """Read a block as it is read before it is run."""
    try:
        _parsed(block)
    except Exception as error:
        raise AssertionError(f"{block.place}: {error}") from error


def _parsed(block):
    if block.kind == "python":
        compile(block.text, str(block.page), "exec")
    for line in commands(block) if block.kind == "console" else ():
        words = shlex.split(line)
        if words[0] == "diffopt":
            doc_commands.parse(words[1:])
        else:
            doc_commands.check_other(line, words)
    if block.kind in ("toml", "json"):
        {"toml": tomllib, "json": json}[block.kind].loads(block.text)


@pytest.mark.parametrize("page", WITH_BLOCKS, ids=name)
def test_blocks_are_parsed(page):
    for block in blocks(page):
        parsed(block)


# Pages that call for the same programs share a process; the rest stand under "others".
TOGETHER = {
    "README": ("README.md",),
    "diffraction": ("docs/planning.md", "docs/diffraction.md", "docs/formats.md"),
    "pictures": ("docs/scenes.md", "docs/transfer.md", "docs/extending.md", "docs/surfaces.md"),
}
_NAMED = {page for group in TOGETHER.values() for page in group}
TOGETHER["others"] = tuple(name(p) for p in WITH_BLOCKS if name(p) not in _NAMED)


@pytest.mark.slow
@pytest.mark.parametrize("group", but({"README"}, TOGETHER))
def test_blocks_run(group, tmp_path):
    """In a process with the defaults of a user: float32, lenient promotion."""
    assert set(TOGETHER[group]) <= {name(page) for page in WITH_BLOCKS}
    done = subprocess.run(
        [sys.executable, str(TESTS / "doc_run.py"), *TOGETHER[group]],
        cwd=tmp_path,
        env={**os.environ, "MPLBACKEND": "agg", "COLUMNS": "160"},
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert done.returncode == 0, done.stderr[-5000:]


WRONG = {
    "python": "print(1.25)  # -> 1.5",
    "more": "print(1)\nprint(2)  # -> 2",
    "console": "diffopt samples --nothing",
    "target": "make everything",
    "extra": "pip install '.[everything]'",
    "toml": "[camera]\neyes = [0, 0, 1]",
    "csv": "theta_i,phi_i,theta_o,f\n0,0,0,1",
}


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        ("python", "print(1.25"),
        ("console", "diffopt samples --nothing"),
        ("console", "diffopt sample"),
        ("console", "make everything"),
        ("toml", "[camera"),
        ("json", "{'file': 1}"),
    ],
)
def test_a_block_that_cannot_be_parsed_is_found(kind, text):
    with pytest.raises(AssertionError, match=r"README\.md:1: "):
        parsed(doc_blocks.Block(ROOT / "README.md", kind, text + "\n", 1))


@pytest.mark.parametrize("fault", WRONG)
def test_a_wrong_block_is_found(fault, tmp_path, monkeypatch):
    import doc_run

    monkeypatch.chdir(tmp_path)
    kind = {"more": "python", "target": "console", "extra": "console"}.get(fault, fault)
    block = doc_blocks.Block(ROOT / "README.md", kind, WRONG[fault] + "\n", 1)
    with pytest.raises((AssertionError, ValueError)):
        doc_run.RUNNERS[kind](block, {})


def test_blocks_that_are_not_closed_are_found(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# Page\n\n```python\nprint(1)\n", encoding="utf-8")
    with pytest.raises(ValueError, match="not closed"):
        blocks(page)


@pytest.mark.parametrize(
    ("expected", "printed", "same"),
    [
        ("1.25", "1.2549", True),
        ("1.25", "1.27", False),
        ("3e-4 True", "0.00035 True", True),
        ("True", "False", False),
        ("{'terms': 3}", "{'terms': 3}", True),
        ("2 3", "2", False),
    ],
)
def test_what_is_printed_is_compared_to_its_last_digit(expected, printed, same):
    assert agrees(expected, printed) is same


def test_expected_values_are_found_in_order():
    assert said("print(1)  # -> 1\nx = 2  # a comment\n# the next: # -> 2 3\n") == ["1", "2 3"]


@pytest.mark.parametrize("page", WRITTEN, ids=name)
def test_links_lead_somewhere(page):
    for link in links(page):
        if "://" in link or link.startswith("mailto:"):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), f"{name(page)}: {link}"
        assert target.is_relative_to(ROOT), f"{name(page)}: {link} leads out of the project"
        if anchor and target.suffix == ".md":
            assert anchor in anchors(target), f"{name(page)}: no heading for {link}"


def test_every_page_is_led_to():
    """From README or the navigation."""
    config = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    led = {
        (page.parent / link.partition("#")[0]).resolve() for page in WRITTEN for link in links(page)
    }
    for page in (ROOT / "docs").rglob("*.md"):
        inside = page.relative_to(ROOT / "docs").as_posix()
        if inside != "examples/README.md":
            assert f"- {inside}\n" in config or page in led, f"{inside}: nothing leads there"


def test_every_command_is_shown_on_a_page():
    text = text_of(WRITTEN)
    for command in sorted(doc_commands.names()):
        assert re.search(rf"{re.escape(command)}\b", text), f"{command} is on no page"


def test_commands_of_the_tables_exist():
    """Of `docs/commands.md` and of README, whose first columns name them."""
    known = doc_commands.names()
    for page in (ROOT / "docs" / "commands.md", ROOT / "README.md"):
        for line in page.read_text(encoding="utf-8").splitlines():
            cells = line.split("|")
            for shown in re.findall(r"`(diffopt [^`]+)`", cells[1] if len(cells) > 2 else ""):
                words = re.sub(r" [A-Z].*$", "", shown)  # without what stands for names
                groups = [one for one in known if f"{one} ".startswith(f"{words} ")]
                assert groups, f"{name(page)}: no command {shown}"


def test_every_extra_is_shown_on_a_page():
    text = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    for extra in doc_commands.extras():
        assert f"`{extra}`" in text, f"{extra}: no line in docs/commands.md"


def test_every_study_is_on_the_page_of_accuracy():
    text = (ROOT / "docs" / "accuracy.md").read_text(encoding="utf-8")
    for study in studies.NAMES:
        assert f"`{study}`" in text, f"{study}: no line in docs/accuracy.md"


def test_command_lines_that_are_not_run_are_still_on_a_page():
    """No reason outlives its line."""
    lines = {
        f"{name(page)}: {line}"
        for page in WITH_BLOCKS
        for block in blocks(page)
        if block.kind == "console"
        for line in doc_blocks.commands(block)
    }
    for start in (*doc_commands.PARSED, *doc_commands.CHEAP):
        assert any(f": {start}" in line for line in lines), f"{start}: on no page"


class References(HTMLParser):
    """What a page of HTML loads."""

    def __init__(self):
        super().__init__()
        self.found = []

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        loads = tag != "link" or given.get("rel") in ("stylesheet", "icon", "preload", "preconnect")
        if tag in LOADING and loads and given.get(LOADING[tag]):
            self.found.append(given[LOADING[tag]])


@pytest.mark.slow
def test_the_site_builds_without_warnings_and_needs_no_network(tmp_path):
    site = tmp_path / "site"
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-q", "-d", str(site)]
    # The theme announces on every run that it will change.
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    said = [line for line in done.stderr.splitlines() if line.strip()]
    assert done.returncode == 0, done.stderr[-3000:]
    assert not said, "\n".join(said)

    built = sorted(site.rglob("*.html"))
    assert site / "index.html" in built
    assert site / "api" / "kernels.html" in built
    for page in built:
        parser = References()
        parser.feed(page.read_text(encoding="utf-8"))
        assert parser.found, page
        for reference in parser.found:
            assert not re.match(r"(https?:)?//", reference), f"{page.name} loads {reference}"
            path = (page.parent / reference.partition("?")[0]).resolve()
            # The page for addresses that do not exist has paths from the top.
            assert path.exists() or page.name == "404.html", f"{page.name}: no {reference}"
    for style in site.rglob("*.css"):
        loaded = re.findall(r"@import|url\(['\"]?(?:https?:)?//[^)]*", style.read_text("utf-8"))
        assert not loaded, f"{style.name} loads {loaded}"

    # Of the reference: functions of every area, from their docstrings.
    kernels = (site / "api" / "kernels.html").read_text(encoding="utf-8")
    fits = (site / "api" / "fitting.html").read_text(encoding="utf-8")
    assert 'id="diffopt.kernels.vmf.log_peak"' in kernels
    assert 'id="diffopt.fitting.heightfield.fit_heightfield"' in fits
