"""Cards of lobes: polar plot of each and of their sum, and a row for each lobe."""

import math

import numpy as np
from jaxtyping import Float

from diffopt.brdf_lobes import BRDFLobes
from diffopt.drawing import lobe_fits
from diffopt.lobes import Lobes
from diffopt.previews import markup, polar
from diffopt.previews.bundles import NoCardError

#: Lobes drawn one by one and listed; functions of a batch that are listed.
DRAWN, LISTED = 10, 16
#: Angles of the viewer for which lobes over views are drawn, degrees.
VIEWS = (0.0, 30.0, 60.0)

_TITLES = ("linear, 1/sr", "logarithmic, 1/sr")


def card(lobes: Lobes) -> markup.Markup:
    """HTML of lobes; of a batch that of the first function, and the spread of all."""
    _refuse(lobes)
    if lobes.kappa.ndim == 1:
        return markup.card(_title(lobes), *single(lobes))
    flat = _flat(lobes)
    batch = "×".join(map(str, lobes.kappa.shape[:-1]))
    pairs = [("functions", batch), ("lobes of each", str(lobes.count)), *spread(flat)]
    picture, *rest = single(flat[0])
    title = f"Lobes: {batch} sums of {lobes.count}"
    words = markup.note("Picture and table are those of the first function.")
    return markup.card(title, picture, markup.key_figures(pairs), *rest, words)


def single(lobes: Lobes) -> list[markup.Markup]:
    """Picture, table of the lobes, and a note, for lobes without a batch."""
    azimuth = _azimuth(lobes)
    plane = f"of azimuth {_whole_degrees(math.degrees(azimuth))}"
    whole = _whole(lobes)
    # The plane is turned into x, z, where the drawing of fits has it.
    at, each = _in_plane(lobes, azimuth)
    if not whole:
        seen = np.abs(at) <= 0.5 * math.pi
        at, each = at[seen], each[:, seen]
    order = _order(lobes)
    drawn = order[:DRAWN] if lobes.count > 1 else order[:0]
    curves = [polar.Curve(at, each.sum(0), "0.65" if len(drawn) else "C0", width=3.0)]
    curves += [polar.Curve(at, each[j], f"C{k}", width=1.1) for k, j in enumerate(drawn)]
    alt = f"Polar plot of {lobes.count} lobes in the plane {plane}"
    figure = polar.plot(curves, _TITLES, whole=whole)
    words = f"Drawn in the plane through the normal {plane}"
    words += ", towards which angles are positive (left)."
    if len(drawn):
        words += " The wide grey line is the sum."
    if lobes.channels:
        words += f" The mean of {lobes.channels[0]} channels."
    return [
        markup.picture(figure, alt, most=markup.MOST),
        table(lobes),
        markup.note(words),
    ]


def table(lobes: Lobes) -> markup.Markup:
    """A row for each lobe without a batch, the heaviest first."""
    from matplotlib.colors import to_hex

    alpha, mu, kappa = _numbers(lobes)
    total = float(np.abs(alpha).sum()) or 1.0
    order, rows = _order(lobes), []
    for k, j in enumerate(order[:LISTED]):
        theta = math.degrees(math.atan2(math.hypot(mu[j, 0], mu[j, 1]), mu[j, 2]))
        phi = math.degrees(math.atan2(mu[j, 1], mu[j, 0])) if theta > 0.05 else 0.0
        phi = 180.0 if phi < -179.5 else phi
        key = markup.spot(to_hex(f"C{k}")) if lobes.count > 1 and k < DRAWN else ""
        rows.append(
            (
                markup.Markup(f"{key}{j + 1}"),
                markup.number(alpha[j]),
                f"{100.0 * alpha[j] / total:.3g} %".replace("-", "−"),
                f"{theta:.1f}°",
                _whole_degrees(phi),
                markup.number(kappa[j]),
                half_width(float(kappa[j])),
            )
        )
    columns = ("lobe", "weight α", "share", "θ", "φ", "κ", "half width")
    found = markup.table(columns, rows)
    if lobes.count > LISTED:
        found = markup.Markup(found + markup.note(f"and {lobes.count - LISTED} lighter ones"))
    return found


def half_width(kappa: float) -> str:
    """Angle from the axis at which a lobe has half its peak, degrees: cos = 1 - ln 2 / kappa."""
    square = 0.5 * math.log(2.0) / kappa if kappa > 0.0 else math.inf
    if square >= 1.0:
        return "none"  # more than half the peak everywhere
    return f"{math.degrees(2.0 * math.asin(math.sqrt(square))):.3g}°"


def spread(lobes: Lobes) -> list[tuple[str, str]]:
    """Ranges over a batch, as pairs."""
    _, _, kappa = _numbers(lobes)
    whole = np.asarray(lobes.integral(), np.float64)
    return [
        ("integrals", _range(whole)),
        ("concentrations κ", _range(kappa)),
    ]


def brdf_card(brdf: BRDFLobes, *more: tuple[str, str], name: str = "BRDFLobes") -> markup.Markup:
    """HTML of lobes over viewing directions, with further pairs of figures."""
    _refuse(brdf.lobes)
    lobes = brdf.lobes
    count = lobes.kappa.shape[0]
    pairs = [
        ("views", str(count)),
        ("lobes of each", str(lobes.count)),
        *spread(lobes),
        *more,
    ]
    picture = markup.picture(
        views_figure(brdf),
        f"Polar plots of the sum of {lobes.count} lobes for viewers at three angles",
        most=markup.MOST,
    )
    words = (
        "The sum of the lobes, f cos θ of the light, in the plane of incidence; dotted lines: the "
        "viewers. Between views the parameters are interpolated."
    )
    title = f"{name}: {lobes.count} lobes at each of {count} views"
    return markup.card(title, picture, markup.key_figures(pairs), markup.note(words))


def views_figure(brdf: BRDFLobes):
    """Sums of lobes for viewers at `VIEWS` in the plane y = 0."""
    angles = np.radians(VIEWS)
    wo = np.stack([np.sin(angles), np.zeros_like(angles), np.cos(angles)], -1)
    found = brdf.at(wo.astype(brdf.views.dtype))
    curves, whole = [], False
    for k, angle in enumerate(VIEWS):
        one = found[k]
        at, each = _in_plane(one, 0.0)
        seen = np.abs(at) <= 0.5 * math.pi
        values = each.sum(0)
        # Lobes of a reflecting BRDF reach below the horizon by their tails alone.
        whole = whole or bool(values[~seen].max() > 0.5 * values.max())
        label = f"viewer at {angle:g}°: peak {values[seen].max():.3g}"
        curves.append(polar.Curve(at, values, f"C{k}", label, mark=math.radians(angle)))
    if not whole:
        cut = np.pi / 2
        curves = [
            polar.Curve(
                c.at[np.abs(c.at) <= cut], c.values[np.abs(c.at) <= cut], c.colour, c.label, c.mark
            )
            for c in curves
        ]
    return polar.plot(curves, ("over each peak", _TITLES[1]), whole=whole, relative=True)


def _title(lobes: Lobes) -> str:
    total = np.asarray(lobes.integral(), np.float64).ravel()
    said = ", ".join(markup.number(value) for value in total[:4])
    more = ", …" if len(total) > 4 else ""
    return f"Lobes: {lobes.count}, integral {said}{more}"


def _refuse(lobes: Lobes) -> None:
    if not lobes.kappa.size:
        raise NoCardError("there are no lobes")
    for name, array in zip(("alpha", "mu", "kappa"), lobes.arrays, strict=True):
        if not np.isfinite(np.asarray(array)).all():
            raise NoCardError(f"{name} is not finite")


def _numbers(lobes: Lobes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weights as the mean of their channels, axes, concentrations."""
    kappa = np.asarray(lobes.kappa, np.float64)
    alpha = np.asarray(lobes.alpha, np.float64).reshape(*kappa.shape, -1).mean(-1)
    return alpha, np.asarray(lobes.mu, np.float64), kappa


def _flat(lobes: Lobes) -> Lobes:
    """One axis of batch."""
    count = lobes.count
    return Lobes(
        lobes.alpha.reshape(-1, count, *lobes.channels),
        lobes.mu.reshape(-1, count, 3),
        lobes.kappa.reshape(-1, count),
    )


def _order(lobes: Lobes) -> np.ndarray:
    """Numbers of the lobes, the heaviest first."""
    return np.argsort(-np.abs(_numbers(lobes)[0]), kind="stable")


def _azimuth(lobes: Lobes) -> float:
    """Of the plane to draw: that of the mean axis, weighted; 0 if that is the normal."""
    alpha, mu, _ = _numbers(lobes)
    x, y, _ = (np.abs(alpha)[:, None] * mu).sum(0)
    total = float(np.abs(alpha).sum()) or 1.0
    if math.hypot(x, y) <= 0.02 * total:
        return 0.0
    # Of both ways to name a plane the one nearer to x, whose side is positive.
    azimuth = math.remainder(math.atan2(y, x), math.pi)
    return azimuth if azimuth > -0.5 * math.pi + 1e-6 else 0.5 * math.pi


def _whole(lobes: Lobes) -> bool:
    """Whether a lobe that counts points below the horizon."""
    alpha, mu, _ = _numbers(lobes)
    counts = np.abs(alpha) > 0.01 * np.abs(alpha).sum()
    return bool((mu[counts, 2] < -0.05).any())


def _in_plane(lobes: Lobes, azimuth: float) -> tuple[np.ndarray, Float[np.ndarray, "K N"]]:
    """Angles in a plane through the normal and the values of each lobe there."""
    cos, sin = math.cos(azimuth), math.sin(azimuth)
    turn = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    alpha, mu, kappa = _numbers(lobes)
    turned = Lobes(alpha, mu @ turn.T, kappa)
    at = lobe_fits._angles(turned)
    ways = np.stack([np.sin(at), np.zeros_like(at), np.cos(at)], -1)
    return at, np.asarray(lobe_fits._each(turned, ways), np.float64)


def _whole_degrees(angle: float) -> str:
    return f"{round(angle):d}°".replace("-", "−")


def _range(values: np.ndarray) -> str:
    low, high = float(values.min()), float(values.max())
    if low == high:
        return markup.number(low)
    return f"{markup.number(low)} to {markup.number(high)}"
