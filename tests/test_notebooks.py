"""Every notebook runs from its first cell to its last, and is kept without outputs."""

import json
import sys
import warnings
from pathlib import Path

import pytest

NOTEBOOKS = sorted((Path(__file__).parent.parent / "notebooks").glob("*.ipynb"))


def test_there_are_notebooks():
    assert NOTEBOOKS


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_outputs_are_cleared(path):
    notebook = json.loads(path.read_text(encoding="utf-8"))
    assert notebook["metadata"]["kernelspec"]["name"] == "python3"
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == [], f"{path.name}: a cell holds outputs"
            assert cell["execution_count"] is None, f"{path.name}: a cell holds its count"


def run(notebook, folder, timeout):
    """Execute in a kernel of this interpreter, whatever kernels are installed."""
    # The event loop and the sockets of jupyter_client warn of things that are not ours.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from jupyter_client.kernelspec import KernelSpec
        from jupyter_client.manager import AsyncKernelManager
        from nbclient import NotebookClient

        class ThisInterpreter(AsyncKernelManager):
            @property
            def kernel_spec(self):
                command = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
                return KernelSpec(argv=command, display_name="this interpreter", language="python")

        client = NotebookClient(
            notebook,
            timeout=timeout,
            kernel_manager_class=ThisInterpreter,
            resources={"metadata": {"path": str(folder)}},
        )
        client.execute()


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook_runs(path, tmp_path, monkeypatch):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import nbformat

        notebook = nbformat.read(path, as_version=4)
        nbformat.validate(notebook)
    # As a reader runs it: with the defaults of JAX, not with those of this suite.
    for name in ("JAX_ENABLE_X64", "MPLBACKEND"):
        monkeypatch.delenv(name, raising=False)
    # In a folder of its own: a notebook may not rely on files beside it, nor leave any.
    run(notebook, tmp_path, timeout=300)
    ran = [c for c in notebook.cells if c.cell_type == "code"]
    assert all(cell.execution_count for cell in ran)


@pytest.mark.slow
def test_a_failing_cell_fails(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from nbclient.exceptions import CellExecutionError
        from nbformat import v4

        cells = [v4.new_code_cell("import sys; print(sys.executable)"), v4.new_code_cell("1 / 0")]
        notebook = v4.new_notebook(cells=cells)
    with pytest.raises(CellExecutionError, match="ZeroDivisionError"):
        run(notebook, tmp_path, timeout=60)
    assert notebook.cells[0].outputs[0].text.strip() == sys.executable
