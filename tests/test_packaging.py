"""The wheel holds the tree, the arrows between the folders hold, a stray import is caught."""

import ast
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FOLDERS = {
    "diffopt": ROOT / "diffopt",
    "diffopt.kernels": ROOT / "kernels",
    "diffopt.fitting": ROOT / "fitting",
}
# Below them all stands kernels; only the command line and the report may look up to fitting.
ALLOWED = {
    "kernels": {"kernels"},
    "diffopt": {"kernels", "diffopt"},
    "fitting": {"kernels", "diffopt", "fitting"},
}


def modules():
    """(package, path) of every module of the three folders."""
    for name, folder in FOLDERS.items():
        for path in sorted(folder.rglob("*.py")):
            yield name, path


def imported(path):
    """Absolute names that a module imports, also inside functions."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def room(name):
    """Which of the three a dotted name belongs to, or None for other packages."""
    if name == "diffopt.kernels" or name.startswith("diffopt.kernels."):
        return "kernels"
    if name == "diffopt.fitting" or name.startswith("diffopt.fitting."):
        return "fitting"
    return "diffopt" if name == "diffopt" or name.startswith("diffopt.") else None


def test_arrows_between_the_folders():
    seen = 0
    for package, path in modules():
        here = package.rpartition(".")[2]
        if any(path.is_relative_to(ROOT / "diffopt" / top) for top in ("cli", "report")):
            continue
        targets = list(imported(path))
        for name in targets:
            # `from diffopt import kernels` names the package itself as well.
            if name == "diffopt" and any(t.startswith("diffopt.") for t in targets):
                continue
            target = room(name)
            assert target is None or target in ALLOWED[here], f"{path} imports {name}"
            seen += target is not None
    assert seen > 20


def test_kernels_need_only_jax_and_numpy():
    allowed = {"jax", "numpy", "jaxtyping", "diffopt"}
    for package, path in modules():
        if package == "diffopt.kernels":
            roots = {name.partition(".")[0] for name in imported(path)}
            assert roots <= allowed | set(sys.stdlib_module_names), path


def test_no_module_bears_the_name_of_a_public_function():
    import diffopt

    files = {p.stem for p in (ROOT / "diffopt").glob("*.py")}
    functions = {n for n in dir(diffopt) if callable(getattr(diffopt, n)) and n[0].islower()}
    assert not files & functions


@pytest.mark.parametrize("folder", ["kernels", "fitting"])
def test_a_folder_cannot_be_imported_by_its_own_name(folder):
    done = subprocess.run(
        [sys.executable, "-c", f"import {folder}"], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 1
    assert f"import it as `diffopt.{folder}`" in done.stderr


@pytest.mark.slow
def test_wheel_holds_the_tree(tmp_path):
    subprocess.run(
        [sys.executable, "-m", "build", "--wheel", "--no-isolation", "-o", tmp_path, ROOT],
        check=True,
        capture_output=True,
    )
    (wheel,) = tmp_path.glob("diffopt_optics-*.whl")
    held = {n for n in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in n}
    expected = {"diffopt/py.typed"}
    for package, path in modules():
        relative = path.relative_to(FOLDERS[package]).as_posix()
        expected.add(f"{package.replace('.', '/')}/{relative}")
    assert held == expected


def test_import_is_light():
    """Heavy libraries come in where they are used, not at `import diffopt`."""
    code = (
        "import sys, diffopt; heavy = {'colour', 'matplotlib', 'skimage', 'scipy.ndimage', "
        "'SurfaceTopography', 'tifffile', 'typer', 'rich', 'optimistix'} & set(sys.modules); "
        "assert not heavy, heavy"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
