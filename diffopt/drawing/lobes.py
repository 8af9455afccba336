"""Pictures of a material: lobes in the plane of incidence, a hemisphere, a sphere, albedos.

Coloured materials are drawn by the luminance of f, in 1/sr, or in the colours that D65 gives
them. Angles are in degrees to the normal; in the plane of incidence those on the side of the
light are positive and drawn on the left.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt import colour, fresnel
from diffopt.drawing import bands, pictures, shapes, tones, views
from diffopt.materials.base import Material, Sample
from diffopt.materials.interfaces import Dielectric
from diffopt.materials.naming import Subject
from diffopt.materials.report import Properties, carrying_power, direction

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.projections.polar import PolarAxes

#: Samples on each axis of a pixel of the sphere.
SUPERSAMPLING = 2
#: Decades of the logarithmic scales, at least and at most.
DECADES = (3, 6)
#: Angles of the swatches, degrees.
SWATCHES = (0.0, 30.0, 60.0, 80.0)

# Towards the light of the sphere: from the upper left.
_LIGHT = (-0.45, 0.50, 0.75)
# Linear RGB of the sky from horizon to zenith, of the ground from horizon to nadir, and of a
# round lamp in the light's direction with its radius in radians.
_SKY = ((0.80, 0.88, 1.0), (0.16, 0.32, 0.75))
_GROUND = ((0.30, 0.25, 0.20), (0.10, 0.08, 0.06))
_LAMP, _LAMP_RADIUS = 4.0, 0.16


def radiance(
    subject: Subject, wi: Float[np.ndarray, "n 3"], wo: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """XYZ of f, in 1/sr, for pairs in the local frame, computed in float32."""
    out = np.zeros((len(wi), 3))
    for first in range(0, len(wi), tones.BLOCK):
        part = slice(first, first + tones.BLOCK)
        count = len(wi[part])
        # Filled up with the normal: one shape, one compilation.
        pairs = np.zeros((2, tones.BLOCK, 3), np.float32)
        pairs[..., 2] = 1.0
        pairs[0, :count], pairs[1, :count] = wi[part], wo[part]
        out[part] = subject.xyz(np.asarray(subject.material.f(*pairs))[:count])
    return out


def in_plane(subject: Subject, angles: Sequence[float]) -> "Figure":
    """Polar plots of f in the plane of incidence, over each peak and logarithmic.

    Delta lobes are drawn as lines of the share of light that they carry.

    Parameters
    ----------
    subject
        The material.
    angles
        Of the light, degrees in [0, 90).
    """
    if subject.material.delta:
        return _stems(subject, angles)
    from matplotlib.ticker import FuncFormatter

    titles = ("f over its peak", "f in 1/sr, logarithmic")
    figure, (linear, logarithmic) = _polar_axes(subject, titles)
    curves = [_curve(subject, angle) for angle in angles]
    # A material may be black.
    largest = max(float(values.max()) for _, values in curves) or 1.0
    least = min(float(values[values > 0.0].min(initial=largest)) for _, values in curves)
    high = math.ceil(math.log10(largest) - 1e-6)
    low = max(min(math.floor(math.log10(least)) - 1, high - DECADES[0]), high - DECADES[1])
    for k, (angle, (at, values)) in enumerate(zip(angles, curves, strict=True)):
        peak = float(values.max())
        label = f"light at {angle:g}°: peak {peak:.3g} /sr"
        linear.plot(np.radians(at), values / (peak or 1.0), color=f"C{k}", lw=1.4, label=label)
        radius = np.log10(np.maximum(values, 10.0**low)) - low
        logarithmic.plot(np.radians(at), radius, color=f"C{k}", lw=1.4)
        for axes, top in ((linear, 1.0), (logarithmic, float(high - low))):
            _incident(axes, angle, top, f"C{k}")
    linear.set(rlim=(0.0, 1.05), rticks=[0.25, 0.5, 0.75, 1.0])
    logarithmic.set(rlim=(0.0, high - low), rticks=range(high - low + 1))
    decades = FuncFormatter(lambda r, _: f"$10^{{{round(r) + low}}}$")
    logarithmic.yaxis.set_major_formatter(decades)
    figure.legend(loc="lower center", ncols=_columns(len(angles)), frameon=False, fontsize=9)
    return figure


def hemisphere(subject: Subject, angle: float, *, size: int = 512) -> "Figure":
    """Map of f over the viewing directions for light at an angle, logarithmic.

    A material that transmits has a second map, of the viewers below, seen from above.
    """
    from matplotlib.colors import LogNorm
    from matplotlib.patches import Circle

    wi = direction(angle)
    line = (np.arange(size) + 0.5) / size * 2.0 - 1.0
    x, y = np.meshgrid(line, line)
    inside = x * x + y * y < 1.0
    z = np.sqrt(np.maximum(1.0 - x * x - y * y, 0.0))
    sides = (1.0, -1.0) if subject.material.transmits else (1.0,)
    maps = []
    for side in sides:
        wo = np.stack([x, y, side * z], -1)[inside]
        found = np.full((size, size), np.nan)
        found[inside] = radiance(subject, np.broadcast_to(wi, wo.shape), wo)[:, 1]
        maps.append(found)
    values = np.concatenate([m[inside] for m in maps])
    high = float(values.max())
    high = high if high > 0.0 else 1.0
    low = max(float(np.percentile(values, 1.0)), high * 10.0 ** -DECADES[1])
    low = min(low, high / 10.0)
    figure = pictures._figure(7.2 if len(sides) == 1 else 12.0, 6.2 if len(sides) == 1 else 5.6)
    panels = np.atleast_1d(figure.subplots(1, len(sides)))
    picture = None
    for axes, found, side in zip(panels, maps, sides, strict=True):
        picture = axes.imshow(
            np.maximum(found, low),
            extent=(-1.0, 1.0, -1.0, 1.0),
            origin="lower",
            norm=LogNorm(low, high),
            cmap="magma",
            clip_path=Circle((0.0, 0.0), 1.0, transform=axes.transData),
        )
        axes.add_patch(Circle((0.0, 0.0), 1.0, fc="none", ec="0.4", lw=1.0))
        for ring in (15, 30, 45, 60, 75):
            radius = math.sin(math.radians(ring))
            axes.add_patch(Circle((0.0, 0.0), radius, fc="none", ec="white", lw=0.5, alpha=0.35))
            spot = (0.0, radius)
            axes.text(*spot, f"{ring}°", color="white", fontsize=7, ha="center", va="center")
        marks = (("light", "*", wi), ("mirror", "+", -wi)) if side > 0 else ()
        for word, mark, at in marks:
            if word == "mirror" and angle == 0.0:
                continue
            axes.plot(at[0], at[1], mark, ms=10, mfc="none", mec="cyan", mew=1.0)
            axes.annotate(
                word, at[:2], (0, -16), textcoords="offset points", color="cyan", ha="center"
            )
        axes.set(xlim=(-1.03, 1.03), ylim=(-1.03, 1.03), xlabel="direction cosine x of the viewer")
        if len(sides) > 1:
            axes.set_title("Reflected" if side > 0 else "Transmitted (viewer below)", fontsize=10)
    panels[0].set_ylabel("direction cosine y")
    assert picture is not None
    figure.colorbar(picture, ax=list(panels), label=f"{_quantity(subject)} / (1/sr)", shrink=0.85)
    figure.suptitle(f"{subject.name}: light at {angle:g}°")
    return figure


def albedo(subject: Subject, report: Properties) -> "Figure":
    """Share of the light that leaves again against its angle, in linear RGB if coloured."""
    figure = pictures._figure(8.0, 4.6)
    axes = figure.subplots()
    grey = subject.material.channels in ((), (1,))
    rgb = subject.rgb(report.albedo)
    lines = [(1, "black", "")] if grey else list(zip(range(3), "rgb", _CHANNELS, strict=True))
    azimuths = [(0, "-", "")]
    if np.abs(rgb[:, 0] - rgb[:, 1]).max() > 2e-3:
        along = (f", azimuth {a:g}°" for a in report.azimuths)
        azimuths = list(zip((0, 1), ("-", "--"), along, strict=True))
    for b, style, suffix in azimuths:
        for c, shade, word in lines:
            label = f"{word}{suffix}".removeprefix(", ") or "all that leaves"
            axes.plot(report.angles, rgb[:, b, c], style, color=shade, label=label)
    if subject.material.transmits:
        reflected = _reflected_share(subject, report.angles)
        axes.plot(report.angles, reflected, "C0", label="reflected")
        axes.plot(report.angles, rgb[:, 0, 1] - reflected, "C1", label="transmitted")
    axes.axhline(1.0, color="0.5", lw=0.8, ls=":")
    axes.set(xlim=(0.0, 90.0), ylim=(0.0, 1.08 * max(1.0, float(rgb.max()))))
    axes.set_xticks(range(0, 91, 15))
    axes.set_xlabel("angle of the light to the normal / degrees")
    axes.set_ylabel("albedo" if grey else "albedo, linear RGB under D65")
    axes.set_title(f"{subject.name}: albedo against angle")
    axes.grid(alpha=0.3)
    if len(axes.lines) > 2:
        axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def swatch(subject: Subject, report: Properties) -> "Figure":
    """Colour of the albedo under D65 at `SWATCHES`, white being a perfect reflector."""
    from matplotlib.patches import Rectangle

    figure = pictures._figure(8.0, 2.7)
    axes = figure.subplots()
    xyz = _albedo_at(subject, report, np.array(SWATCHES))
    shown = tones.encode(tones.display(xyz))
    linear = _linear(xyz)
    for k, angle in enumerate(SWATCHES):
        shade = shown[k]
        axes.add_patch(Rectangle((k, 0.0), 0.94, 1.0, fc=tuple(shade), ec="0.6", lw=0.8))
        code = "#" + "".join(f"{round(255 * float(c)):02x}" for c in shade)
        numbers = ", ".join(f"{c:.3f}" for c in linear[k])
        words = f"{angle:g}°\nsRGB {code}\nlinear {numbers}"
        axes.text(k + 0.47, -0.06, words, ha="center", va="top", fontsize=8)
    axes.set(xlim=(-0.03, len(SWATCHES)), ylim=(-0.36, 1.02))
    axes.axis("off")
    axes.set_title(f"{subject.name}: colour of the albedo under D65, by angle of the light")
    return figure


def sphere(subject: Subject, report: Properties, *, size: int = 512) -> Float[np.ndarray, "h w 3"]:
    """SRGB picture of a sphere: under one light, or reflecting a sky for delta lobes.

    Glass is a massive ball; light that is reflected inside it is left out. Rough glass is
    seen as a surface alone.
    """
    shape = (SUPERSAMPLING * size, SUPERSAMPLING * size)

    def lit(rows: slice) -> views.Image:
        return _lit(subject, report, shapes.sphere(shape, rows=rows))

    if not subject.material.delta:
        image = bands.gathered(shape, lit)
        return pictures.photograph(image, supersampling=SUPERSAMPLING)
    parts = (shapes.sphere(shape, rows=rows) for rows in bands.bands(shape))
    return np.concatenate([_under_sky(subject, report, part) for part in parts])


def _lit(subject: Subject, report: Properties, view: shapes.View) -> views.Image:
    light = shapes.unit(np.array(_LIGHT))
    wi, wo = view.local(light), view.local(view.eye)
    lit = view.covered & (wi[..., 2] > 0.0) & (wo[..., 2] > 1e-3)
    xyz = np.zeros((*view.covered.shape, 3))
    xyz[lit] = radiance(subject, wi[lit], wo[lit]) * wi[lit][:, 2:]
    return views.Image(xyz, _relative_albedo(subject, report, view), view.covered, view.neutral)


_CHANNELS = ("red", "green", "blue")


def _columns(count: int) -> int:
    """Columns of a legend in at most three rows, filled evenly."""
    return math.ceil(count / math.ceil(count / 4))


def _quantity(subject: Subject) -> str:
    return "f" if subject.material.channels in ((), (1,)) else "luminance of f"


def _curve(subject: Subject, angle: float) -> tuple[np.ndarray, np.ndarray]:
    """Viewing angles in degrees and the luminance of f there."""
    end = 180.0 if subject.material.transmits else 89.9
    # Close to the peaks in the mirror direction and the straight one.
    fine = np.geomspace(0.01, 5.0, 60)
    near = np.concatenate([-fine[::-1], [0.0], fine])
    at = np.concatenate([np.linspace(-end, end, 1441), near - angle, near + 180.0 - angle])
    at = np.unique(at[np.abs(at) <= end])
    wo = np.stack([np.sin(np.radians(at)), np.zeros_like(at), np.cos(np.radians(at))], -1)
    wi = np.broadcast_to(direction(angle), wo.shape)
    return at, np.maximum(radiance(subject, wi, wo)[:, 1], 0.0)


def _polar_axes(subject: Subject, titles: Sequence[str]) -> "tuple[Figure, list[PolarAxes]]":
    """Polar plots side by side, half discs unless the material transmits."""
    from matplotlib.figure import Figure

    whole = subject.material.transmits
    # Matplotlib centres a half disc in the square of the whole one. The squares are placed by
    # hand, in inches, so that the empty quarters lie under the titles and the legend.
    side, foot = (4.2, 1.1) if whole else (4.6, 0.1)
    width, height = 5.6 * len(titles), foot + side + (1.1 if whole else 0.0)
    figure = Figure(figsize=(width, height))
    panels: list[PolarAxes] = []
    for k, title in enumerate(titles):
        left = 5.6 * k + 0.5 * (5.6 - side)
        box = (left / width, foot / height, side / width, side / height)
        axes: PolarAxes = figure.add_axes(box, projection="polar")  # type: ignore[assignment]
        axes.set_theta_zero_location("N")
        at = np.arange(0, 360, 30) if whole else np.arange(-90, 91, 30)
        words = [f"{t if t <= 180 else t - 360}°".replace("-", "−") for t in at]
        axes.set_xticks(np.radians(at), words)
        if not whole:
            axes.set(thetamin=-90.0, thetamax=90.0)
        axes.set_axisbelow(True)
        axes.tick_params(axis="y", labelsize=7)
        figure.text((k + 0.5) / len(titles), 1.0 - 0.62 / height, title, ha="center", fontsize=11)
        panels.append(axes)
    what = "shares of power" if len(titles) == 1 else _quantity(subject)
    words = f"{subject.name}: {what} in the plane of incidence" + ", by viewing angle" * (
        len(titles) > 1
    )
    figure.text(0.5, 1.0 - 0.3 / height, words, ha="center", fontsize=12)
    return figure, panels


def _incident(axes: "PolarAxes", angle: float, top: float, shade: str) -> None:
    """The light's direction: a dotted line, and an arrow head on it."""
    at = math.radians(angle)
    axes.plot([at, at], [0.0, top], ls=":", color=shade, lw=1.0)
    axes.annotate(
        "",
        (at, 0.80 * top),
        xytext=(at, 0.98 * top),
        arrowprops={"arrowstyle": "->", "color": shade, "lw": 1.2},
    )


def _stems(subject: Subject, angles: Sequence[float]) -> "Figure":
    """Lines in the directions of delta lobes, as long as their share of the power."""
    title = "reflected + transmitted" if subject.material.transmits else "reflected"
    figure, (axes,) = _polar_axes(subject, (title,))
    material = carrying_power(subject.material)
    key = jax.random.key(0)
    for k, angle in enumerate(angles):
        wo = np.broadcast_to(direction(angle).astype(np.float32), (256, 3))
        sample = material.sample(key, wo)
        weights = np.asarray(sample.weight)
        weights = subject.xyz(weights)[:, 1] * np.asarray(sample.pdf)
        lobes, first = np.unique(np.asarray(sample.wi).round(4), axis=0, return_index=True)
        ends = [(math.atan2(w[0], w[2]), float(weights[n])) for w, n in zip(lobes, first)]  # noqa: B905
        shares = " + ".join(f"{share:.3f}" for _, share in sorted(ends, key=lambda e: abs(e[0])))
        for m, (at, share) in enumerate(ends):
            label = f"light at {angle:g}°: {shares}" if m == 0 else None
            axes.plot([at, at], [0.0, share], "-o", ms=4, color=f"C{k}", lw=1.6, label=label)
        _incident(axes, angle, 1.0, f"C{k}")
    axes.set(rlim=(0.0, 1.05), rticks=[0.25, 0.5, 0.75, 1.0])
    figure.legend(loc="lower center", ncols=2, frameon=False, fontsize=9)
    return figure


def _reflected_share(subject: Subject, angles: np.ndarray) -> np.ndarray:
    """Luminance of the power that stays on the light's side, by midpoints of the unit cube."""
    material = carrying_power(subject.material)
    steps = [(np.arange(n) + 0.5) / n for n in (12, 12, 256)]
    points = np.stack(np.meshgrid(*steps, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)
    out = []
    for angle in angles:
        wo = np.broadcast_to(direction(float(angle)).astype(np.float32), points.shape)
        sample = _scatter(material, jnp.asarray(points), jnp.asarray(wo))
        stays = np.asarray(sample.wi)[:, 2] > 0.0
        out.append((subject.xyz(sample.weight)[:, 1] * stays).mean())
    return np.array(out)


@eqx.filter_jit
def _scatter(material: Material, u: Float[Array, "n 3"], wo: Float[Array, "n 3"]) -> Sample:
    return material.typed(u.dtype).scatter(u, wo)


def _albedo_at(
    subject: Subject, report: Properties, angles: Float[np.ndarray, "*batch"]
) -> Float[np.ndarray, "*batch 3"]:
    """XYZ of the albedo at angles in degrees, the mean over the azimuths."""
    xyz = subject.xyz(report.albedo).mean(axis=1)
    return np.stack([np.interp(angles, report.angles, xyz[:, c]) for c in range(3)], -1)


def _linear(xyz: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    white = colour.white_point("D65", colour.wavelengths(tones.STEP_NM))
    return xyz @ colour.rgb_matrix(white).T


def _relative_albedo(subject: Subject, report: Properties, view: shapes.View) -> np.ndarray:
    """Albedo towards the camera over white, 0 outside the object."""
    cos = np.clip((view.normal * view.eye).sum(-1), 0.0, 1.0)
    white = colour.white_point("D65", colour.wavelengths(tones.STEP_NM))
    found = _albedo_at(subject, report, np.degrees(np.arccos(cos))) / white
    return np.where(view.covered[..., None], found, 0.0)


def _under_sky(subject: Subject, report: Properties, view: shapes.View) -> np.ndarray:
    """A mirror or a massive ball of glass under the sky, the ground and a lamp."""
    normal, eye = view.normal, view.eye
    cos = np.clip((normal * eye).sum(-1, keepdims=True), 1e-6, 1.0)
    back = _sky(2.0 * cos * normal - eye)
    if isinstance(subject.material, Dielectric):
        eta = float(subject.material.eta)
        facet = fresnel.Dielectric(eta)(
            jnp.asarray(cos[..., 0], "float32"), jnp.asarray([0.5893], "float32")
        )
        share = np.asarray(facet, np.float64)
        inner = np.sqrt(np.maximum(1.0 - (1.0 - cos * cos) / eta**2, 0.0))
        inside = -eye / eta + (cos / eta - inner) * normal
        # The chord meets the far side at the same angle, and bends by the same again.
        far = normal + 2.0 * inner * inside
        rgb = share * back + (1.0 - share) ** 2 * _sky(eta * inside + (cos - eta * inner) * far)
    else:
        angles = np.degrees(np.arccos(cos[..., 0]))
        rgb = _linear(_albedo_at(subject, report, angles)) * back
    rgb = np.where(view.covered[..., None], rgb, pictures.BACKGROUND)
    rgb = tones.tone(rgb.reshape(-1, 3), 2.0).reshape(rgb.shape)
    step = SUPERSAMPLING
    h, w = (count // step for count in view.covered.shape)
    return tones.encode(rgb.reshape(h, step, w, step, 3).mean(axis=(1, 3)))


def _sky(rays: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Linear RGB seen along unit vectors; y is up."""
    up = rays[..., 1:2]
    parts = [
        np.array(low) + np.sqrt(np.abs(up)) * (np.array(high) - np.array(low))
        for low, high in (_SKY, _GROUND)
    ]
    rgb = np.where(up > 0.0, parts[0], parts[1])
    lamp = (rays * shapes.unit(np.array(_LIGHT))).sum(-1, keepdims=True) > math.cos(_LAMP_RADIUS)
    return np.where(lamp, _LAMP, rgb)
