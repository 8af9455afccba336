"""The film of a deforming object over its soft shadow: frames, times of their stages, files."""

import dataclasses
import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np

    from diffopt.shadows.animations import Animation
    from diffopt.shadows.settings import ShadowSettings

#: Table 1 of Zhou et al.: vertices, milliseconds of sampling, conversion and shadowing, frames per
#: second (2.8 GHz Pentium IV and GeForce 6800 GT).
PAPER = {
    "creature": ("Dragon", 1151, 11.0, 5.0, 37.7, 21.3),
    "egg": ("Egg", 482, 7.4, 5.0, 36.7, 22.5),
    "sheet": ("Plane", 8382, 72.4, 5.0, 47.9, 13.5),
}
# Of a comparison with the truth: frames, and receivers on a side.
_CHECKED, _CHECK_SIZE = 3, 40
# A loop of the animated picture, and its least and most for a frame: milliseconds.
_LOOP, _LEAST, _MOST = 3600, 40, 200


@dataclasses.dataclass(frozen=True)
class Frame:
    """One frame: its phase, and seconds of its stages.

    Attributes
    ----------
    error
        Root of the mean square difference from the truth, over the open light; None unchecked.
    """

    number: int
    phase: float
    sampling: float
    conversion: float
    shadowing: float
    picture: float
    error: float | None = None


class Film:
    """The frames of an animation, one after the other."""

    def __init__(
        self,
        animation: "Animation",
        settings: "ShadowSettings",
        parts: int,
        size: int,
        resolution: tuple[int, int],
        spp: int,
        *,
        lamp: bool = True,
    ) -> None:
        from diffopt.shadows import animations, distant_light, pictures, plane

        self.animation, self.settings, self.parts, self.lamp = animation, settings, parts, lamp
        self.ground = plane(animations.GROUND, size)
        self.sky = distant_light(animations.sky, settings.bands)
        self.stage = pictures.Stage(resolution, spp)
        self.frames: list[Frame] = []
        self.occluder = self._occluder()

    def _occluder(self) -> Any:
        from diffopt.shadows import Occluder

        limbs = self.animation.limbs
        parts = limbs if limbs and len(limbs) == self.parts else self.parts
        return Occluder(self.animation.faces, self.settings, parts=parts)

    def prepare(self, count: int) -> None:
        """Compile what frames need, so that their times are those of running."""
        import numpy as np

        first = self._occluder()
        for occluder in (first, self.occluder):
            # Backwards: the first frame stands at the end.
            for t in np.arange(count)[::-1] / count:
                occluder.move(*self.animation.pose(float(t)))
                occluder.foresee(self.animation.shape(float(t)), self.ground)
        first.update(self.animation.shape(0.0), self.ground)
        self.light(first.fields, 0.0)

    def light(self, fields: Any, t: float) -> "np.ndarray":
        """Irradiance of the ground."""
        import numpy as np

        from diffopt.shadows import animations, irradiance

        lights = [self.sky, animations.lamp(t)] if self.lamp else [self.sky]
        up = np.array([0.0, 0.0, 1.0])
        return np.asarray(irradiance(self.ground, up, fields, lights, self.settings))

    def shoot(self, number: int, count: int, folder: Path, *, check: bool = False) -> None:
        """Make a frame and write it."""
        import PIL.Image

        from diffopt.io.files import replacing
        from diffopt.shadows import animations

        t = number / count
        self.occluder.move(*self.animation.pose(t))
        self.occluder.update(self.animation.shape(t), self.ground)
        begun = time.perf_counter()
        light = self.light(self.occluder.fields, t)
        shaded = time.perf_counter()
        image = self.stage.draw(
            self.occluder.vertices,
            self.animation.faces,
            self.animation.colour,
            light,
            animations.lamp(t) if self.lamp else None,
        )
        with replacing(folder / frame_name(number)) as file:
            PIL.Image.fromarray(image).save(file, format="PNG")
        drawn = time.perf_counter()
        step = -(-count // _CHECKED)
        error = self.error() if check and number % step == 0 else None
        times = self.occluder.times
        self.frames.append(
            Frame(
                number, t, times.sampling, times.conversion, shaded - begun, drawn - shaded, error
            )
        )

    def error(self) -> float:
        """Of the light of the sky on the ground: RMS over what comes without the object."""
        import numpy as np

        from diffopt.shadows import animations, irradiance, plane, truth

        points = plane(animations.GROUND, min(_CHECK_SIZE, self.ground.shape[0])).reshape(-1, 3)
        up = np.array([0.0, 0.0, 1.0])
        found = np.asarray(irradiance(points, up, self.occluder.fields, self.sky, self.settings))
        mesh = self.occluder.vertices, self.animation.faces
        expected, clear = truth.irradiance(points, [mesh], animations.sky)
        return float(np.sqrt((((found - expected) / clear) ** 2).mean()))

    def median(self, stage: str) -> float:
        """Seconds of a stage in the middle one of the frames."""
        import statistics

        return statistics.median(getattr(frame, stage) for frame in self.frames)

    @property
    def rate(self) -> float:
        """Frames per second of sampling, conversion and shadowing, one after the other."""
        import statistics

        sums = [frame.sampling + frame.conversion + frame.shadowing for frame in self.frames]
        return 1.0 / max(statistics.median(sums), 1e-9)

    @property
    def worst(self) -> float | None:
        """Error of the worst frame that was checked."""
        return max((f.error for f in self.frames if f.error is not None), default=None)

    def rows(self) -> list[tuple[str, int, float, float, float, float]]:
        """Of this run and of the paper: name, vertices, milliseconds of three stages, frames/s."""
        own = (
            self.animation.name,
            len(self.occluder.vertices),
            *(1e3 * self.median(stage) for stage in ("sampling", "conversion", "shadowing")),
            self.rate,
        )
        paper = PAPER.get(self.animation.name)
        theirs = PAPER.values() if paper is None else [paper]
        return [own, *((f"{name} (paper)", *rest) for name, *rest in theirs)]  # type: ignore[list-item]

    def write(self, folder: Path, count: int) -> None:
        """Animation, table and numbers."""
        import csv

        write_gif(folder, len(self.frames), count)
        (folder / "times.txt").write_text("\n".join(self.text()) + "\n", encoding="utf-8")
        with (folder / "times.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            names = ("sampling", "conversion", "shadowing", "picture")
            writer.writerow(["frame", "phase", *(f"{name}_ms" for name in names), "error"])
            for frame in self.frames:
                spent = (f"{1e3 * getattr(frame, name):.4f}" for name in names)
                error = "" if frame.error is None else f"{frame.error:.6g}"
                writer.writerow([frame.number, f"{frame.phase:.6g}", *spent, error])
        summary = json.dumps(self.summary(count), indent=2)
        (folder / "result.json").write_text(summary + "\n", encoding="utf-8")

    def text(self) -> list[str]:
        """The table as lines."""
        head = ("", "vertices", "sampling", "conversion", "shadowing", "frames/s")
        rows = [
            (name, str(vertices), *(f"{ms:.1f} ms" for ms in spent), f"{rate:.1f}")
            for name, vertices, *spent, rate in self.rows()
        ]
        widths = [max(len(row[i]) for row in [head, *rows]) for i in range(len(head))]
        lines = []
        for row in [head, *rows]:
            cells = [cell.rjust(width) for cell, width in zip(row, widths, strict=True)]
            lines.append("  ".join([row[0].ljust(widths[0]), *cells[1:]]))
        return lines

    def summary(self, count: int) -> dict[str, Any]:
        """Everything of ``result.json``."""
        columns = ("name", "vertices", "sampling_ms", "conversion_ms", "shadowing_ms", "frames_s")
        receivers = self.ground.shape[0] ** 2
        return {
            "scene": self.animation.name,
            "frames": len(self.frames),
            "frames_of_the_loop": count,
            "receivers": receivers,
            "fields": len(self.occluder.fields),
            "lights": ["sky and sun", "lamp"] if self.lamp else ["sky and sun"],
            "settings": dataclasses.asdict(self.settings),
            "times": [dict(zip(columns, row, strict=True)) for row in self.rows()],
            "ns_per_receiver": 1e9 * self.median("shadowing") / receivers,
            "errors": {f.number: f.error for f in self.frames if f.error is not None},
        }


def frame_name(number: int) -> str:
    """File of a frame."""
    return f"frame_{number:04d}.png"


def write_gif(folder: Path, done: int, count: int) -> None:
    """All frames in one set of colours, so that nothing flickers."""
    import numpy as np
    import PIL.Image

    from diffopt.io.files import replacing

    def frame(number: int) -> Any:
        with PIL.Image.open(folder / frame_name(number)) as image:
            return image.convert("RGB")

    # Colours count alike, however large their areas: those of small things stay.
    some = [np.asarray(frame(k)).reshape(-1, 3) & 0xFC for k in range(0, done, -(-done // 6))]
    colours = np.unique(np.concatenate(some), axis=0)
    palette = PIL.Image.fromarray(colours[None]).quantize(
        255, method=PIL.Image.Quantize.MEDIANCUT, kmeans=1
    )
    dither = PIL.Image.Dither.FLOYDSTEINBERG
    first, *rest = (frame(k).quantize(palette=palette, dither=dither) for k in range(done))
    duration = min(max(_LOOP // count, _LEAST), _MOST)
    with replacing(folder / "animation.gif") as file:
        first.save(file, format="GIF", save_all=True, append_images=rest, duration=duration, loop=0)
