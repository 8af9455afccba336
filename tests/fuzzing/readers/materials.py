"""Tables of materials, lobes, what lobes are fitted to, and measured reflectance."""

import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from fuzzing.readers.base import Seed, npy, npz, single, sky, written


def load_small_merl(path: Path) -> Any:
    from diffopt.materials.merl import load_merl

    return load_merl(path, shape=(4, 3, 4))


def merl() -> dict[str, Seed]:
    planes = np.random.default_rng(1).uniform(0.1, 2.0, (3, 4, 3, 4))
    return {"merl": single("a.binary", struct.pack("<3i", 4, 3, 4) + planes.tobytes())}


def load_named(path: Path) -> Any:
    from diffopt.materials import naming

    return naming.load(path)


def tensors() -> dict[str, Seed]:
    from diffopt.materials.tensorfile import write_tensors

    rng = np.random.default_rng(2)
    turn = np.float32(np.pi)
    polarised = {
        "phi_d": np.linspace(-turn, turn, 3)[None],
        "theta_d": np.linspace(0, turn / 2, 3)[None],
        "theta_h": np.zeros((1, 0)),
        "wvls": np.array([450, 600], np.uint16),
        "M": rng.uniform(0.1, 1.0, (3, 3, 2, 2, 4, 4)),
    }

    def rgl(phi: np.ndarray) -> dict[str, np.ndarray]:
        n = len(phi)
        return {
            "phi_i": phi,
            "theta_i": np.linspace(0, turn / 2, 3),
            "ndf": rng.uniform(0.5, 2.0, (3, 4)),
            "sigma": rng.uniform(0.5, 1.0, (3, 3)),
            "vndf": rng.uniform(0.3, 2.0, (n, 3, 3, 4)),
            "rgb": rng.uniform(0.1, 1.0, (n, 3, 3, 2, 2)),
            "jacobian": np.array([1], np.uint8),
        }

    def seed(name: str, fields: dict[str, np.ndarray]) -> Seed:
        kept = {k: v.astype(np.float32) if v.dtype.kind == "f" else v for k, v in fields.items()}
        return written(name, lambda path: write_tensors(path, kept))

    return {
        "rgl": seed("a.bsdf", rgl(np.linspace(-turn, -turn / 2, 3))),
        "rgl isotropic": seed("a.bsdf", rgl(np.zeros(1))),
        "pbsdf": seed("a.pbsdf", polarised),
    }


def goniometer() -> dict[str, np.ndarray]:
    i, o, turn = np.meshgrid([0.0, 30.0], [10.0, 60.0], [0.0, 180.0])
    i, o, turn = i.ravel(), o.ravel(), turn.ravel()
    return {"theta_i": i, "phi_i": 0 * i, "theta_o": o, "phi_o": turn, "f": 0.1 + 0.001 * o}


def columns(names: dict[str, np.ndarray], mark: str = ",") -> str:
    rows = [mark.join(f"{value:g}" for value in row) for row in zip(*names.values(), strict=True)]
    return "# seed\n" + mark.join(names) + "\n" + "\n".join(rows) + "\n"


def tables() -> dict[str, Seed]:
    table = goniometer()
    values = table.pop("f")
    spectrum = table | {"450nm_cos": values, "600nm_cos": values}
    return {
        "csv": single("a.csv", columns(table | {"f": values})),
        "csv spectrum": single("a.csv", columns(spectrum, ";")),
        "npz": single("a.npz", npz(**table, r=values, g=values, b=values)),
    }


def load_lobes(path: Path) -> Any:
    from diffopt.lobes import Lobes

    return Lobes.load(path)


def lobes() -> dict[str, Seed]:
    from diffopt.lobes import Lobes

    found = Lobes(np.ones((2, 3)), np.array([[0.0, 0.6, 0.8], [0.0, 0.0, 1.0]]), np.array([3.0, 9]))
    return {f"lobes {s}": written(f"a.{s}", found.save) for s in ("npz", "json")}


def load_target(path: Path) -> Any:
    from diffopt.cli import fit_targets

    return fit_targets.read(str(path), {})


def targets() -> dict[str, Seed]:
    ways = np.array([[0.0, 0.6, 0.8], [0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.0, -0.6, 0.8]])
    return {
        "npy": single("a.npy", npy(np.c_[ways, np.ones(4)])),
        "npz": single("a.npz", npz(directions=ways, weights=np.ones(4))),
        "csv": single("a.csv", columns(dict(zip("xyz", ways.T, strict=True)))),
        "map": single("a.npy", npy(sky())),
    }


def load_measured(path: Path) -> Any:
    from diffopt.fitting import measured_files

    measured_files.is_measured(path)
    with warnings.catch_warnings():
        # Documented: rows of sRGB that were clipped are left out with a warning.
        warnings.filterwarnings("ignore", "(?s).*rows were left out")
        return measured_files.load(path)


def reflectance() -> dict[str, Seed]:
    from diffopt.fitting.measured import Measured

    wi = np.array([0.0, 0.6, 0.8])
    wo = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.0, 0.6, 0.8]])
    values = np.array([[0.1, 0.2], [0.3, 0.1], [0.2, 0.2]])
    data = Measured(wi, wo, np.array([0.45, 0.6]), values, 2.0, noise=0.01, noise_known=True)
    angles = "theta_i_deg;phi_i_deg;theta_o_deg;phi_o_deg;R;G;B\n"
    colours = "# coherence: 2.0 um\n# quantity: srgb\n# scale: 255\n# illuminant: A\n" + angles
    colours += "10;0;20;0;20;30;40\n10;0;30;0;25;35;1\n10;0;40;90;10;20;30\n"
    tri = "# coherence: 2 um\n# wavelengths: 500 550 600 nm\n# gain: free\n# blur: 0.01\n"
    tri += angles.replace("R;G;B", "X;Y;Z") + "10;0;20;0;.2;.3;.4\n10;0;30;0;.2;.3;.1\n"
    return {
        "npz": written("a.npz", data.save),
        "csv": written("a.csv", data.save),
        "csv srgb": single("a.csv", colours),
        "csv xyz": single("a.csv", tri),
    }
