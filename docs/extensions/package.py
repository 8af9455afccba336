"""The folders of the package put together as they are installed, for the reference.

`kernels/` is diffopt.kernels and `fitting/` is diffopt.fitting. The reference reads sources
without importing them, and follows neither the mapping in pyproject.toml nor links.
"""

import shutil
import tempfile
from pathlib import Path
from typing import Any

from mkdocs.plugins import event_priority

ROOT = Path(__file__).resolve().parents[2]
PARTS = {"diffopt": "diffopt", "kernels": "diffopt/kernels", "fitting": "diffopt/fitting"}

_copy: list[tempfile.TemporaryDirectory] = []


@event_priority(100)  # before the reference is set up
def on_config(config: Any) -> Any:
    """Copy the sources, and have the reference read the copy."""
    _copy.append(tempfile.TemporaryDirectory(prefix="diffopt-sources-"))
    folder = Path(_copy[-1].name)
    for source, target in PARTS.items():
        skipped = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / source, folder / target, ignore=skipped)
    config.plugins["mkdocstrings"].config.handlers["python"]["paths"] = [str(folder)]
    return config


def on_post_build(config: Any) -> None:
    """Remove the copy."""
    del config
    _copy.pop().cleanup()
