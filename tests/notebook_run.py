"""Executing a notebook, and what is to be found in what it showed."""

import base64
import io
import re
import sys
import warnings
from pathlib import Path

import numpy as np
from PIL import Image

OURS = tuple(str(Path(__file__).parents[1] / name) for name in ("diffopt", "kernels", "fitting"))
# What Python keeps from readers unless they ask, wherever it comes from.
HIDDEN = ("DeprecationWarning", "PendingDeprecationWarning", "ImportWarning", "ResourceWarning")
WARNING = re.compile(r"^(?P<file>.+?):\d+: (?P<kind>\w*Warning): (?P<text>.*)$", re.MULTILINE)
EMBEDDED = re.compile(r"data:image/png;base64,([A-Za-z0-9+/=\s]+)")


def execute(notebook, folder, timeout=300):
    """Run all cells in a kernel of this interpreter, whatever kernels are installed."""
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


def _outputs(notebook):
    for cell in notebook.cells:
        if cell.cell_type == "code":
            yield from cell.outputs


def pictures(notebook):
    """All PNG images shown, those inside HTML too, as arrays [h, w, 4] of 0 .. 1."""
    found = []
    for output in _outputs(notebook):
        data = output.get("data", {})
        found += [data["image/png"]] if "image/png" in data else []
        found += EMBEDDED.findall("".join(data.get("text/html", "")))
    return [decoded(base64.b64decode(text)) for text in found]


def decoded(png):
    """A PNG file on white, as an array [h, w, 3] of 0 .. 1."""
    image = Image.open(io.BytesIO(png)).convert("RGBA")
    white = Image.new("RGBA", image.size, "white")
    return np.asarray(Image.alpha_composite(white, image).convert("RGB")) / 255.0


def is_blank(picture):
    """Whether an image shows nothing: one colour, or axes with their labels and no data.

    What Matplotlib draws around data is black and grey on a background that fills more than
    nine tenths; data are coloured, or fill an area.
    """
    if picture.std() < 1e-3:
        return True
    coloured = (np.ptp(picture, axis=-1) > 0.1).sum()
    background = (np.abs(picture - picture[0, 0]).max(axis=-1) < 1e-3).mean()
    return bool(coloured < 20 and background > 0.9)


def warnings_shown(notebook):
    """Warnings among the outputs that a reader would see, or that come from our code."""
    text = "".join(
        "".join(output.text)
        for output in _outputs(notebook)
        if output.output_type == "stream" and output.name == "stderr"
    )
    found = []
    for match in WARNING.finditer(text):
        ours = match["file"].startswith(OURS) or "ipykernel_" in match["file"]
        # A program that another process is just writing is compiled again: no fault of ours.
        harmless = "Error reading persistent compilation cache" in match["text"]
        if (ours or match["kind"] not in HIDDEN) and not harmless:
            found.append(match[0])
    return found
