"""What ``diffopt relight`` writes and prints: frames, figures, and how long they took."""

import dataclasses
import json
import statistics
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diffopt.cli.film import frame_name, write_gif
from diffopt.errors import InputError

if TYPE_CHECKING:
    from diffopt.scenes import Camera, Scene
    from diffopt.transfer.pictures import Compared
    from diffopt.transfer.result import Transfer

# Frames that a rate is the median of, and degrees between two of them.
_TIMED, _STEP = 5, 11.0
# Samples on a side of a pixel beside path tracing: edges would be a large part of the error.
_COMPARED = 4
# Pixels of the shorter side of figures of the mesh, at least.
_FIGURE = 640


@dataclasses.dataclass(frozen=True)
class Settings:
    """What was asked for.

    Attributes
    ----------
    method
        Of the lights.
    turn
        Of the lights, degrees.
    frames, orbit
        Of the loop, and whether the camera goes round in it instead of the lights.
    stops
        Of exposure.
    samples
        On a side of each pixel.
    per_pixel
        Or at vertices.
    layers, mesh, levels
        Whether their pictures are written.
    spp
        Paths a pixel of the reference; None for none.
    quiet
        Whether no bar is shown, and nothing printed.
    """

    method: str
    turn: float
    frames: int
    orbit: bool
    stops: float
    samples: int
    per_pixel: bool
    layers: bool
    spp: int | None
    mesh: bool
    levels: bool
    quiet: bool


def orbited(camera: "Camera", degrees: float) -> "Camera":
    """A camera moved about its target, counter-clockwise as seen from above."""
    target, up = np.asarray(camera.target), np.asarray(camera.up)
    k = up / np.linalg.norm(up)
    arm = np.asarray(camera.eye) - target
    angle = np.radians(degrees)
    arm = (
        np.cos(angle) * arm
        + np.sin(angle) * np.cross(k, arm)
        + (1.0 - np.cos(angle)) * (k @ arm) * k
    )
    return dataclasses.replace(camera, eye=tuple((target + arm).tolist()))


class Session:
    """One run of the command: what it draws, and what it measured."""

    def __init__(
        self,
        transfer: "Transfer",
        scene: "Scene",
        camera: "Camera",
        settings: Settings,
        name: str,
    ) -> None:
        from diffopt.transfer.interactive import Relit

        self.transfer, self.scene, self.camera = transfer, scene, camera
        self.settings, self.name = settings, name
        self.files: list[str] = []
        self.layer_means: dict[str, float] = {}
        self.numbers: dict[str, Any] = {}
        self.interrupted = False
        began = time.perf_counter()
        try:
            self.relit = Relit(
                transfer,
                scene,
                camera,
                method=settings.method,
                samples=settings.samples,
                per_pixel=settings.per_pixel,
            )
        except InputError as error:
            text = str(error)
            raise InputError(f"--{text}" if text.startswith("method ") else text) from None
        self.relit.turn(settings.turn)
        ready = time.perf_counter()
        self.first = self.relit.frame()
        self.seconds = {"prepare": ready - began, "first frame": time.perf_counter() - ready}
        self.factor = self._factor()
        self.relit.expose(settings.stops)
        self._measure()

    def _factor(self) -> float:
        """Exposure of all pictures: by the first frame, as `Image.exposure` does."""
        from diffopt.drawing import tones

        return tones.exposure(np.maximum(self.first, 0.0).reshape(-1, 3).astype(np.float64))

    def _measure(self) -> None:
        """Medians of frames with the lights turned, and with a new view for each."""
        relit, settings = self.relit, self.settings
        turned, viewed, found = [], [], []
        for k in range(_TIMED):
            began = time.perf_counter()
            relit.turn(settings.turn + _STEP * (k + 1))
            relit.frame()
            turned.append(time.perf_counter() - began)
        views = [orbited(self.camera, _STEP * (k + 1)) for k in range(_TIMED)]
        for view in views:  # what is compiled for the largest of them does for all
            relit.look(view)
        relit.frame()
        for view in views:
            began = time.perf_counter()
            relit.look(view)
            found.append(time.perf_counter() - began)
            relit.frame()
            viewed.append(time.perf_counter() - began)
        relit.look(self.camera)
        relit.turn(settings.turn)
        self.seconds |= {
            "relight": statistics.median(turned),
            "raster": statistics.median(found),
            "raster and relight": statistics.median(viewed),
        }
        # The first frame less one like it.
        compiled = self.seconds["first frame"] - self.seconds["relight"]
        self.seconds["compile"] = max(compiled, 0.0)

    def _shown(self, rgb: np.ndarray) -> np.ndarray:
        from diffopt.transfer.pictures import displayed

        return displayed(rgb, self.factor)

    def _png(self, path: Path, rgb: np.ndarray) -> None:
        """Write linear RGB."""
        import PIL.Image

        from diffopt.io.files import replacing

        pixels = np.round(255.0 * self._shown(rgb)).astype(np.uint8)
        with replacing(path) as file:
            PIL.Image.fromarray(pixels).save(file, format="PNG")
        self.files.append(path.name)

    def save(self, path: Path) -> None:
        """Write the picture alone."""
        self._png(path, self.relit.frame())

    def shoot(self, folder: Path) -> None:
        """Write the picture or the frames, and what else was asked for."""
        settings = self.settings
        if settings.frames == 1:
            self._png(folder / "picture.png", self.relit.frame())
        else:
            self._film(folder)
        if settings.layers:
            self._layers(folder)
        if settings.mesh or settings.levels:
            self._figures(folder)
        if settings.spp is not None:
            self._check(folder, settings.spp)

    def _film(self, folder: Path) -> None:
        from diffopt.cli.progress import stages

        relit, settings = self.relit, self.settings
        done = 0
        with stages(1, left=True) as progress, progress.stage("frames") as report:
            try:
                for number in range(settings.frames):
                    degrees = 360.0 * number / settings.frames
                    if settings.orbit:
                        relit.look(orbited(self.camera, degrees))
                    else:
                        relit.turn(settings.turn + degrees)
                    self._png(folder / frame_name(number), relit.frame())
                    done = number + 1
                    if not settings.quiet:
                        report(done, settings.frames)
            except KeyboardInterrupt:
                if not done:
                    raise
                self.interrupted = True
        write_gif(folder, done, settings.frames)
        last = frame_name(done - 1)
        self.files = [last if done == 1 else f"{frame_name(0)} .. {last}", "animation.gif"]
        relit.look(self.camera)
        relit.turn(settings.turn)

    def _layers(self, folder: Path) -> None:
        """A picture of each kind of path, and of what is behind the scene."""
        from diffopt.transfer.layers import LAYERS, layer

        relit, channels = self.relit, self.scene.channels
        whole = np.asarray(relit.radiance())
        parts = {}
        for name in LAYERS:
            found = np.asarray(relit.radiance(layer(relit.tables, name), background=False))
            parts[name] = found
        parts["background"] = whole - np.asarray(relit.radiance(background=False))
        for name, found in parts.items():
            rgb = found if channels.wavelengths is None else channels.rgb(found)
            file = f"layer_{name.replace(' ', '_').replace('-', '_')}.png"
            self._png(folder / file, rgb * 2.0**self.settings.stops)
            self.layer_means[name] = float(found.mean() / max(float(whole.mean()), 1e-30))

    def _figures(self, folder: Path) -> None:
        from diffopt.drawing.pictures import save
        from diffopt.transfer import pictures

        columns, rows = self.camera.resolution
        times = max(1, -(-_FIGURE // min(columns, rows)))
        camera = dataclasses.replace(self.camera, resolution=(times * columns, times * rows))
        if self.settings.mesh:
            self.relit.look(camera)
            shaded = self._shown(self.relit.frame())
            title = f"{self.name}: {len(self.transfer.axes):,} vertices"
            figure = pictures.wireframe(self.transfer, camera, shaded, title=title)
            self.files.append(save(figure, folder / "mesh.png").name)
            self.relit.look(self.camera)
        if self.settings.levels:
            title = f"{self.name}: {self.transfer.slices:,} slices"
            figure = pictures.levels(self.transfer, camera, title=title)
            self.files.append(save(figure, folder / "levels.png").name)

    def _check(self, folder: Path, spp: int) -> None:
        """Beside path tracing of the same light."""
        from diffopt.drawing.pictures import save
        from diffopt.transfer.pictures import comparison

        compared = self._compared(spp)
        self.numbers = dict(
            zip(("found", "initial"), (n._asdict() for n in compared.numbers), strict=True)
        )
        figure = comparison(compared, title=f"{self.name}, light by {self.settings.method}")
        self.files.append(save(figure, folder / "check.png").name)

    def _compared(self, spp: int) -> "Compared":
        from diffopt.cli.progress import stages
        from diffopt.rendering import render
        from diffopt.scenes import Scene
        from diffopt.transfer import infinity, pictures

        relit, settings = self.relit, self.settings
        before, samples = relit.raster, relit.samples
        relit.samples = max(samples, _COMPARED)
        relit.look(self.camera)
        found = relit.frame()
        relit.raster = pictures.initial(self.transfer)
        relit.look(self.camera)
        coarse = relit.frame()
        relit.raster, relit.samples = before, samples
        relit.look(self.camera)
        lights = infinity.turned(self.scene.lights, settings.turn)
        lam = self.scene.channels.wavelengths
        scene = Scene(self.scene.objects, lights, wavelengths=lam)
        depth = self.transfer.settings.depth
        words: dict[str, Any] = {"spp": spp, "depth": depth}
        with stages(1, left=True) as progress, progress.stage("path tracing") as report:
            told = None if settings.quiet else report
            image = render(scene, self.camera, "path", progress=told, **words)
        if image.interrupted:
            raise KeyboardInterrupt
        brighter = 2.0**settings.stops
        error = image.error if lam is None else np.full_like(image.rgb, np.nan)
        return pictures.Compared(
            found=found.astype(np.float64),
            coarse=coarse.astype(np.float64),
            expected=brighter * image.rgb,
            error=brighter * error,
            surface=image.object >= 0,
            factor=self.factor,
            reference=f"path tracing, {spp} paths a pixel over {depth} surfaces",
        )

    def summary(self) -> dict[str, Any]:
        """Everything of ``result.json``."""
        return {
            "scene": self.name,
            "vertices": len(self.transfer.axes),
            "slices": self.transfer.slices,
            "resolution": list(self.camera.resolution),
            "settings": dataclasses.asdict(self.settings),
            "seconds": self.seconds,
            "frames_a_second": {
                name: 1.0 / self.seconds[name] for name in ("relight", "raster and relight")
            },
            "layers": self.layer_means,
            "differences": self.numbers,
        }

    def write(self, folder: Path) -> None:
        """Write the numbers."""
        text = json.dumps(_plain(self.summary()), indent=2)
        (folder / "result.json").write_text(text + "\n", encoding="utf-8")
        self.files.append("result.json")

    def tell(self, output: Path, notes: list[str]) -> None:
        """Print rates, numbers and files."""
        from diffopt.cli.progress import terminal
        from diffopt.transfer.pictures import percent

        console = terminal()

        def say(text: str) -> None:
            console.print(text, markup=False, soft_wrap=True)

        seconds = self.seconds
        columns, rows = self.camera.resolution
        say(
            f"{self.name}: {len(self.transfer.axes):,} vertices, {self.transfer.slices:,} slices; "
            f"{columns} x {rows} pixels, {self.settings.samples**2} samples each"
        )
        say(
            f"{1.0 / seconds['relight']:.3g} frames/s with the lights turned "
            f"({1e3 * seconds['relight']:.3g} ms), "
            f"{1.0 / seconds['raster and relight']:.3g} with a new view for each "
            f"({1e3 * seconds['raster']:.3g} ms of it to see it): medians of {_TIMED}; before the "
            f"first {seconds['prepare']:.2g} s to prepare and {seconds['compile']:.2g} s to compile"
        )
        if self.layer_means:
            shares = (f"{name} {percent(x)}" for name, x in self.layer_means.items())
            say(f"of the light: {', '.join(shares)}")
        for name, found in self.numbers.items():
            rmse, noise, worst = (percent(found[key]) for key in ("rmse", "noise", "worst"))
            who = "all vertices" if name == "found" else "initial ones"
            say(
                f"against path tracing, {who}: RMSE {rmse} of the mean (standard error of the "
                f"reference {noise}), SSIM {found['ssim']:.3f}, worst 1 % above {worst}"
            )
        if self.interrupted:
            say("interrupted: the animation holds the frames that are finished")
        alone = len(self.files) == 1 and output.suffix.lower() == ".png"
        say(str(output) if alone else f"{output}: {', '.join(self.files)}")
        for note in notes:
            say(f"note: {note}")


def _plain(value: Any) -> Any:
    """What JSON can hold: NaN becomes null."""
    if isinstance(value, dict):
        return {name: _plain(each) for name, each in value.items()}
    return None if isinstance(value, float) and value != value else value
