"""Mitsuba 3 in processes of its own: a variant holds for a whole process.

Run as a module it is such a process: it takes a description, says how it went, and renders a
picture for each line that it is sent.
"""

import base64
import importlib.util
import os
import pickle
import subprocess
import sys
from typing import Any

#: Variants: one ray after the other on all cores, and vectorised by LLVM.
VARIANTS = ("scalar_rgb", "llvm_ad_rgb")


class Renderer:
    """A scene in a process that waits; calling it renders a picture.

    Parameters
    ----------
    description
        See `diffopt.accuracy.mitsuba_scenes.describe`.
    variant
        Of `VARIANTS`.

    Raises
    ------
    RuntimeError
        If the variant does not start, with what the process said last.
    """

    def __init__(self, description: dict[str, Any], variant: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "diffopt.accuracy.mitsuba_process", variant],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        self._ask(base64.b64encode(pickle.dumps(description)).decode())

    def __call__(self) -> Any:
        """Render once; the mean of all pixels and channels."""
        return float(self._ask("render"))

    def close(self) -> None:
        """End the process."""
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
        self._process.wait()

    def __del__(self) -> None:
        """End the process with the last reference."""
        if self._process.returncode is None:
            self.close()

    def _ask(self, line: str) -> str:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            self._process.stdin.write(line + "\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            pass
        while answer := self._process.stdout.readline():
            # Anything else is said by Mitsuba itself.
            if answer.startswith("answer "):
                return answer.removeprefix("answer ").strip()
        self.close()
        raise RuntimeError("Mitsuba ended")


def variants() -> tuple[str, ...]:
    """Variants that may start here: none without Mitsuba, LLVM's only where one is named."""
    if importlib.util.find_spec("mitsuba") is None:
        return ()
    # With an LLVM too old the process ends, so that one is not looked for.
    return VARIANTS if os.environ.get("DRJIT_LIBLLVM_PATH") else VARIANTS[:1]


def _serve(variant: str) -> None:
    mi = importlib.import_module("mitsuba")
    mi.set_variant(variant)
    import numpy as np

    from diffopt.accuracy import mitsuba_scenes

    scene = mitsuba_scenes.load(mi, pickle.loads(base64.b64decode(sys.stdin.readline())))
    print("answer ready", flush=True)
    for seed, _ in enumerate(sys.stdin):
        image = np.array(mi.render(scene, seed=seed))
        print(f"answer {image.mean()}", flush=True)


if __name__ == "__main__":
    _serve(sys.argv[1])
