"""What a plan is: which effects are in a picture, why, at what settings, at what cost."""

import dataclasses
from typing import Any

from diffopt.planning.reductions import reduced
from diffopt.rendering.effects import Composition
from diffopt.rendering.settings import PathSettings, Settings
from diffopt.scenes.scene import Scene


@dataclasses.dataclass(frozen=True)
class Row:
    """One effect in a plan.

    Attributes
    ----------
    effect
        Its name, see `diffopt.planning.reductions.EFFECTS`.
    included
        Whether it is in.
    because
        Why: a number against what the plan may leave out.
    bound
        Relative difference of the picture without this effect alone, at most; None where it
        was not estimated.
    settings
        At which it is computed, in words.
    share
        Predicted share of the time of the picture.
    """

    effect: str
    included: bool
    because: str
    bound: float | None
    settings: str = ""
    share: float = 0.0


@dataclasses.dataclass(frozen=True)
class Plan:
    """Effects of a picture: static and hashable; equal plans are equal programs.

    Attributes
    ----------
    tolerance
        Mean difference of luminance over the picture, relative to its mean, that was asked for.
    rows
        Each effect.
    composition
        What paths and rays are followed.
    settings
        Of the level that the picture is rendered by.
    bias
        Bound of the difference that all excluded effects make together.
    noise
        Predicted mean magnitude of noise, or of the error of even samples, over the mean
        luminance.
    seconds
        Predicted time of the picture, without compilation, on the two cores on which the
        model was calibrated.
    paths
        Settings by which layers are told apart: the cheapest path tracing.
    """

    tolerance: float
    rows: tuple[Row, ...]
    composition: Composition
    settings: Settings
    bias: float
    noise: float
    seconds: float
    paths: PathSettings

    @property
    def excluded(self) -> frozenset[str]:
        """Names of what is out."""
        return frozenset(row.effect for row in self.rows if not row.included)

    def row(self, effect: str) -> Row:
        """The row of an effect."""
        return next(row for row in self.rows if row.effect == effect)

    def scene(self, scene: Scene) -> Scene:
        """A scene without what is out: see `diffopt.planning.reductions.reduced`."""
        return reduced(scene, self.excluded)

    def table(self) -> Any:
        """A `rich.table.Table` of the effects."""
        from rich.table import Table

        found = Table(
            title=f"Plan for a tolerance of {self.tolerance:g}",
            caption=f"Left out together: at most {self.bias:.2%}; noise {self.noise:.2%}; "
            f"level {self.settings.level}, some {_duration(self.seconds)}.",
        )
        found.add_column("effect", no_wrap=True)
        found.add_column("in")
        for name in ("because", "settings"):
            found.add_column(name)
        found.add_column("without it", justify="right")
        found.add_column("cost", justify="right")
        for row in self.rows:
            found.add_row(
                row.effect,
                "in" if row.included else "-",
                row.because,
                row.settings,
                f"{row.bound:.2%}" if row.bound else "",
                f"{row.share:.0%}" if row.included and row.share else "",
            )
        return found

    def __str__(self) -> str:
        from diffopt.accuracy import output

        return output.as_text(self.table())

    def summary(self) -> dict[str, Any]:
        """Numbers and words for records."""
        return {
            "tolerance": self.tolerance,
            "bias": self.bias,
            "noise": self.noise,
            "seconds": self.seconds,
            "level": self.settings.level,
            "settings": dataclasses.asdict(self.settings),
            "effects": [dataclasses.asdict(row) for row in self.rows],
        }

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, str]:
        from diffopt.previews import bundles, plans

        return bundles.bundle(self, plans.card)


def _duration(seconds: float) -> str:
    if seconds < 0.1:
        return "0.1 s at most"
    return f"{seconds:.2g} s" if seconds < 120.0 else f"{seconds / 60.0:.0f} min"
