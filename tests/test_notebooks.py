"""Every notebook runs from its first cell to its last, and shows what it says it does.

By day three of them; the others, whose features have tests of their own, by night.

A notebook is kept twice: as text (``.md``, which people edit) and as ``.ipynb`` without
outputs, made from the text by ``jupytext --to ipynb``.
"""

import ast
import io
import json
import re
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from lengths import but
from notebook_run import decoded, execute, is_blank, pictures, warnings_shown

FOLDER = Path(__file__).parent.parent / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
SETTING = 'QUICK = os.environ.get("DIFFOPT_NOTEBOOKS") == "quick"'

BY_DAY = {"jit_benchmark", "colours_of_a_scan", "soft_shadows"}

each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)


def read(path):
    """A notebook of either form. Its libraries warn of things that are not ours."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import jupytext
        import nbformat

        if path.suffix == ".md":
            return jupytext.read(path, fmt="md:myst")
        notebook = nbformat.read(path, as_version=4)
        nbformat.validate(notebook)
        return notebook


def test_there_are_notebooks():
    assert NOTEBOOKS
    texts = {p.stem for p in FOLDER.glob("*.md")} - {"README"}
    assert {p.stem for p in NOTEBOOKS} == texts


def test_the_readme_lists_them_all():
    rows = re.findall(
        r"^\| \[(\w+)\]\((\w+)\.ipynb\) \|", (FOLDER / "README.md").read_text(), re.MULTILINE
    )
    assert all(name == file for name, file in rows)
    assert sorted(name for name, _ in rows) == [p.stem for p in NOTEBOOKS]


@each_notebook
def test_both_forms_hold_the_same_cells(path):
    text, notebook = read(path.with_suffix(".md")), read(path)
    assert text.metadata.kernelspec == notebook.metadata.kernelspec
    for number, (a, b) in enumerate(zip(text.cells, notebook.cells, strict=True)):
        place = f"{path.stem}, cell {number}: run jupytext --to ipynb notebooks/{path.stem}.md"
        assert a.cell_type == b.cell_type, place
        assert a.source == b.source, place
        assert a.metadata == b.metadata, place


@each_notebook
def test_outputs_are_cleared(path):
    notebook = json.loads(path.read_text(encoding="utf-8"))
    assert notebook["metadata"]["kernelspec"]["name"] == "python3"
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == [], f"{path.name}: a cell holds outputs"
            assert cell["execution_count"] is None, f"{path.name}: a cell holds its count"


@each_notebook
def test_it_asks_and_ends_with_your_own_data(path):
    cells = read(path).cells
    assert cells[0].cell_type == "markdown"
    first = cells[0].source
    assert re.match(r"# \S", first), "the first cell is to begin with the title"
    assert "?" in first, "the first cell is to hold the question that the notebook answers"
    prose = [c.source for c in cells if c.cell_type == "markdown"]
    headings = re.findall(r"^#+ (.*)$", "\n".join(prose), re.MULTILINE)
    assert headings[-1].strip() == "Your own data"
    code = "\n".join(c.source for c in cells if c.cell_type == "code")
    assert SETTING in code, "a cell near the top is to choose between the settings"
    # Set and used.
    lines = [line for line in code.splitlines() if not line.lstrip().startswith("%")]
    tree = ast.parse("\n".join(lines))
    assert sum(isinstance(n, ast.Name) and n.id == "QUICK" for n in ast.walk(tree)) > 1


@pytest.mark.slow
@pytest.mark.parametrize("name", but(BY_DAY, [p.stem for p in NOTEBOOKS]))
def test_notebook_runs(name, tmp_path, monkeypatch):
    notebook = read(FOLDER / f"{name}.ipynb")
    # As a reader runs it: with the defaults of JAX, not with those of this suite. What the
    # environment says of compiled programs and of the compiler stays.
    for name in ("JAX_ENABLE_X64", "MPLBACKEND"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("DIFFOPT_NOTEBOOKS", "quick")
    monkeypatch.setenv("PYTHONWARNINGS", "default")
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    monkeypatch.setenv("JUPYTER_RUNTIME_DIR", str(tmp_path / "runtime"))
    # In a folder of its own: a notebook may not rely on files beside it, nor leave any.
    folder = tmp_path / "reader"
    folder.mkdir()
    execute(notebook, folder)
    assert all(c.execution_count for c in notebook.cells if c.cell_type == "code")
    assert list(folder.iterdir()) == []
    assert warnings_shown(notebook) == []
    shown = pictures(notebook)
    assert shown, "a notebook is to show a figure"
    blank = [number for number, picture in enumerate(shown) if is_blank(picture)]
    assert not blank, f"of {len(shown)} figures these are blank: {blank}"


@pytest.mark.slow
def test_failing_cells_warnings_and_figures_are_found(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONWARNINGS", "default")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from nbclient.exceptions import CellExecutionError
        from nbformat import v4

        sources = [
            "import sys; print(sys.executable)",
            "import warnings\nwarnings.warn('a cell warns')",
            "from diffopt import errors\n"
            "warnings.warn_explicit('deprecated', DeprecationWarning, errors.__file__, 1)\n"
            "warnings.warn_explicit('deprecated', DeprecationWarning, '/elsewhere/x.py', 1)",
            "import matplotlib.pyplot as plt\n%matplotlib inline\nplt.plot([1, 2]);",
            "1 / 0",
        ]
        notebook = v4.new_notebook(cells=[v4.new_code_cell(text) for text in sources])
    with pytest.raises(CellExecutionError, match="ZeroDivisionError"):
        execute(notebook, tmp_path, timeout=60)
    assert notebook.cells[0].outputs[0].text.strip() == sys.executable
    found = warnings_shown(notebook)
    assert len(found) == 2
    assert "UserWarning: a cell warns" in found[0]
    assert "errors.py:1: DeprecationWarning: deprecated" in found[1]
    (picture,) = pictures(notebook)
    assert not is_blank(picture)


def test_blank_figures_are_known():
    from matplotlib.figure import Figure

    def drawn(*draw):
        figure = Figure()
        for step in draw:
            step(figure.subplots(1, 2))
        file = io.BytesIO()
        figure.savefig(file, format="png")
        return decoded(file.getvalue())

    assert is_blank(drawn())
    assert is_blank(drawn(lambda axes: axes[0].set(xlabel="x / um", title="nothing in it")))
    assert is_blank(np.full((8, 8, 3), 0.3))
    assert not is_blank(drawn(lambda axes: axes[1].plot([1, 2, 1])))
    assert not is_blank(drawn(lambda axes: axes[0].imshow(np.eye(9), cmap="gray")))
