"""What the models that compete for a scan share: the scan, how to fit, and what is found."""

import dataclasses
import math
from typing import Any

import numpy as np

from diffopt.fitting.scans import noise as scan_noise
from diffopt.fitting.scans.noise import Field
from diffopt.fitting.scans.register import Scan
from diffopt.fitting.scans.squares import Squares
from diffopt.gratings import Parametric, Surface


@dataclasses.dataclass(frozen=True)
class Setting:
    """What all candidates share."""

    scan: Scan
    coarse: Scan
    factor: int
    vectors: list[tuple[float, float]]
    drift: bool
    robust: bool
    edges: str
    max_steps: int
    dtype: Any
    shared: dict[str, Field] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Candidate:
    """A fitted model; `ScanFit` says what the parts are. Without a model: why there is none.

    `coarse` is the fit to averaged pixels, of a model that was not fitted to all of them.
    """

    name: str
    reason: str
    converged: bool = False
    model: Parametric | None = None
    names: tuple[str, ...] = ()
    covariance: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 0)))
    tilt: tuple[float, float] = (0.0, 0.0)
    lines: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))
    residual: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 0)))
    noise: dict[str, float] = dataclasses.field(default_factory=dict)
    criterion: float = math.inf
    parameters: int = 0
    rms: float = math.nan
    goodness: float = 0.0
    deterministic: bool = True
    curve: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))
    coarse: Squares | None = None

    @property
    def title(self) -> str:
        """In words."""
        return {"crossed": "two crossed gratings", "compactdisc": "the tracks of a disc"}.get(
            self.name, f"a {self.name} grating"
        )


def noise_alone(setting: Setting) -> float:
    """Criterion of noise without any surface."""
    if "none" not in setting.shared:
        setting.shared["none"] = law(setting.coarse.flat, None, setting)
    found = setting.shared["none"]
    return found.deviance + scan_noise.NOISE * math.log(found.count)


def law(rest: np.ndarray, surface: Surface | None, setting: Setting, starts: Any = None) -> Field:
    """Noise, and a random surface, of heights on the averaged pixels."""
    return scan_noise.fit(
        rest,
        setting.coarse,
        surface,
        drift=setting.drift,
        dtype=setting.dtype,
        starts=starts,
        max_steps=setting.max_steps,
    )
