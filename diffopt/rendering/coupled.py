"""Radiosity as a level of image synthesis: light of the patches at what the rays meet.

The rays are those of recursive ray tracing, with mirrors and glass or without; see `Direct`.
"""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from diffopt.rendering import radiosity
from diffopt.rendering.albedos import Albedos
from diffopt.rendering.direct import Direct
from diffopt.rendering.effects import EVERYTHING, Composition
from diffopt.rendering.radiosity import Transport
from diffopt.rendering.radiosity_settings import RadiositySettings
from diffopt.rendering.settings import RecursiveSettings
from diffopt.rendering.stage import Stage
from diffopt.rendering.standins import StandIns


class Coupled(Direct):
    """Radiosity as a level; see `Level` of `diffopt.rendering.driver`.

    Parameters
    ----------
    settings
        How the picture is gathered.
    transport
        Of the scene, from `radiosity.prepare`.
    composition
        As of `Direct`.
    """

    def __init__(
        self,
        settings: RadiositySettings,
        transport: Transport,
        composition: Composition = EVERYTHING,
    ) -> None:
        rays = RecursiveSettings(
            spp=settings.spp,
            seed=settings.seed,
            rays=settings.rays,
            backend=settings.backend,
            light_samples=settings.light_samples,
            depth=settings.depth if settings.coherent else 0,
        )
        super().__init__(rays, None, composition)
        self.transport, self.gather = transport, settings.gather

    def _prepare(self, stage: Stage) -> tuple[StandIns, list[Albedos | None]]:
        """Abstract lights and albedos of a stage, and the light of its patches, made once."""
        if self._prepared is not None and self._prepared[0] is stage:
            return self._prepared[1:]
        found = radiosity.solve_on(self.transport, stage)
        wanted = found.indirect if self.gather == "direct" else found.irradiance
        self.field = found.field(wanted / np.pi)
        lights, tables = super()._prepare(stage)
        if self.gather == "patches":
            lights = _none(lights)
            self._prepared = stage, lights, tables
        return lights, tables


def _none(lights: StandIns) -> StandIns:
    """No abstract lights: the patches have received theirs."""

    def empty(array: Any) -> Any:
        return array[:0]

    beams, points = (
        type(family)(*(empty(a) for a in vars(family).values()))
        for family in (lights.beams, lights.points)
    )
    zero = jnp.zeros_like(lights.ambient)
    return dataclasses.replace(lights, beams=beams, points=points, ambient=zero, soft=())
