"""Hard inputs of `diffopt.kernels.tabulated`, hooked into `hard_cases.rows`."""

from functools import partial

import numpy as np
from hard_cases import LD, PI, Hard

from diffopt.kernels import tabulated


def tabulated_rows():
    """Hard cases of the tables."""
    yield from _roots()
    yield from _angles()
    yield from _places()
    yield from _lookups()
    yield from _warps()


def _roots():
    for x in (-1.0, 0.0, 1e-30, 2.0):
        yield Hard(
            "tabulated.root",
            f"x={x}",
            tabulated.root,
            (x,),
            lambda x: np.sqrt(max(x, LD(0))),
            smooth=x in (-1.0, 2.0),
        )
    for y, x in ((0.0, 0.0), (0.0, -1.0), (1e-15, 0.0), (-1e-9, -1.0), (0.3, 0.4)):
        yield Hard(
            "tabulated.angle",
            f"y={y},x={x}",
            tabulated.angle,
            (y, x),
            np.arctan2,
            smooth=y == 0.3,  # at 0 the circle has its cut, and no slope at the origin
        )


def _direction(theta, phi):
    theta, phi = LD(theta), LD(phi)
    return np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])


def _rusinkiewicz(wi, wo):
    """Turns of wi by the half vector's angles, as the parameterization is defined."""
    h = wi + wo
    across = np.hypot(h[0], h[1])
    theta_h = np.arctan2(across, h[2])
    phi_h = np.arctan2(h[1], h[0]) if across else LD(0)
    d = wi - wo
    x = np.cos(phi_h) * d[0] + np.sin(phi_h) * d[1]
    y = np.cos(phi_h) * d[1] - np.sin(phi_h) * d[0]
    x = np.cos(theta_h) * x - np.sin(theta_h) * d[2]
    theta_d = np.arctan2(np.sqrt((d * d).sum()), np.sqrt((h * h).sum()))
    if not across or not (d * d).sum():
        return theta_h, theta_d, LD(0)
    return theta_h, theta_d, np.arctan2(y, x)


def _angles():
    pairs = {
        "plain": ((0.4, 0.3), (0.9, 2.1)),
        "grazing": ((1.57, 0.3), (1.5, 2.9)),
        "oneatnormal": ((0.8, 1.0), (0.0, 0.0)),
        "nearlyequal": ((0.7, 0.3), (0.7005, 0.3002)),
        "acrosshalf": ((0.5, 0.2), (0.5, 0.2 + 3.0)),
    }
    for label, (a, b) in pairs.items():
        yield Hard(
            "tabulated.rusinkiewicz",
            label,
            tabulated.rusinkiewicz,
            (_direction(*a), _direction(*b)),
            _rusinkiewicz,
            # The difference of directions 5e-4 apart has a unit of rounding 2000 times its own.
            ulps=16,
            smooth=label != "nearlyequal",
            gradient_ulps=1e4,
        )
    normal = np.array([0.0, 0.0, 1.0])
    for label, a, b in (
        ("equal", _direction(0.6, 0.4), _direction(0.6, 0.4)),
        ("bothnormal", normal, normal),
        ("halfatnormal", np.array([0.6, 0.0, 0.8]), np.array([-0.6, 0.0, 0.8])),
    ):
        yield Hard(
            "tabulated.rusinkiewicz",
            label,
            tabulated.rusinkiewicz,
            (a, b),
            _rusinkiewicz,
            smooth=False,
        )
    for angles in ((0.0, 0.0, 0.0), (0.3, 0.5, -2.0), (1.5707963, 1e-9, 3.0)):
        yield Hard(
            "tabulated.half_difference",
            f"{angles}",
            tabulated.half_difference,
            angles,
            _from_angles,
        )


def _from_angles(theta_h, theta_d, phi_d):
    out = []
    for sign in (1, -1):
        d = np.array(
            [sign * np.sin(theta_d) * np.cos(phi_d), sign * np.sin(theta_d) * np.sin(phi_d)]
        )
        z = np.cos(theta_d)
        x = np.cos(theta_h) * d[0] + np.sin(theta_h) * z
        out.append(np.array([x, d[1], np.cos(theta_h) * z - np.sin(theta_h) * d[0]]))
    return tuple(out)


def _places():
    for angles in ((0.0, 0.0, 0.0), (1e-6, 0.3, -1.0), (1.5, 1.57, 3.1)):
        yield Hard(
            "tabulated.merl_places",
            f"{angles}",
            partial(tabulated.merl_places, shape=(90, 90, 180)),
            angles,
            lambda h, d, p: (
                90 * np.sqrt(h / (PI / 2)) - LD(0.5),
                90 * d / (PI / 2) - LD(0.5),
                180 * p / PI - LD(0.5),
            ),
            smooth=angles[0] > 1e-3,
        )
    nodes = np.array([0.0, 0.25, 1.0, 1.125])
    for x in (-1.0, 0.0, 0.1, 0.25, 0.75, 1.0625, 1.125, 7.0):
        yield Hard(
            "tabulated.place",
            f"x={x}",
            tabulated.place,
            (nodes, x),
            _piecewise,
            smooth=x in (0.1, 0.75),
            ulps=16,
        )


def _piecewise(nodes, x):
    x = min(max(x, nodes[0]), nodes[-1])
    i = min(int((nodes <= x).sum()) - 1, len(nodes) - 2)
    return i + (x - nodes[i]) / (nodes[i + 1] - nodes[i])


def _trilinear(table, y, x):
    """Rows clamped, columns periodic, negative entries left out."""
    rows, columns = table.shape
    y = min(max(y, LD(0)), LD(rows - 1))
    j, i = min(int(np.floor(y)), rows - 2), int(np.floor(x))
    total, weight = LD(0), LD(0)
    for b, wy in ((j, 1 - (y - j)), (j + 1, y - j)):
        for a, wx in ((i % columns, 1 - (x - i)), ((i + 1) % columns, x - i)):
            if table[b, a] >= 0:
                total, weight = total + wy * wx * table[b, a], weight + wy * wx
    return total / weight if weight else LD(0)


def _lookups():
    table = np.array([[1.0, 2.5, 0.25], [4.0, -1.0, 3.0], [-1.0, -1.0, 0.5], [2.0, -1.0, 1.5]])
    for y, x in ((0.25, 0.5), (-3.0, 2.75), (1.5, 0.625), (2.5, -0.375), (9.0, 4.5), (2.25, 0.75)):
        yield Hard(
            "tabulated.linear",
            f"y={y},x={x}",
            lambda t, y, x: tabulated.linear(t, (y, x), periodic=(False, True)),
            (table, y, x),
            _trilinear,
            smooth=(0 < y < 3) and (y, x) != (2.25, 0.75),
            gradient_ulps=100,
        )
    yield Hard(
        "tabulated.corners",
        "weights",
        lambda x: [w for _, w in tabulated.corners((5, 5), (x, 2.0 * x), (False, True))],
        (1.3,),
        lambda x: [a * b for a in (2 - x, x - 1) for b in (3 - 2 * x, 2 * x - 2)],
    )


_DENSITY = np.array([[[0.5, 1.0, 0.0], [2.0, 1.5, 0.25]], [[1.0, 1.0, 1.0], [1.0, 1.0, 1.0]]])


def _bilinear(table, x, y):
    """The second slice at a weight of a quarter; three columns, two rows."""
    rows = (table[..., 1:] + table[..., :-1]).sum(-1) / 4
    mixed = (table / (rows.sum(-1) / 2)[:, None, None] * np.array([[[0.75]], [[0.25]]])).sum(0)
    line = (1 - y) * mixed[0] + y * mixed[1]
    i = min(int(2 * x), 1)
    t = 2 * x - i
    density = (1 - t) * line[i] + t * line[i + 1]
    share = [LD(0), (line[0] + line[1]) / 4, (line[0] + 2 * line[1] + line[2]) / 4]
    u = (share[i] + t * (line[i] + t * (line[i + 1] - line[i]) / 2) / 2) / share[2]
    ends = (mixed[:, 0] + 2 * mixed[:, 1] + mixed[:, 2]) / 4
    return u, y * (ends[0] + y * (ends[1] - ends[0]) / 2), density


def _slices(x):
    # Beyond one: the place 0.25 between two slices.
    return tabulated.corners((2,), (0.25 + 0.0 * x,), (False,))


def _warps():
    for x, y in ((0.3, 0.6), (0.0, 0.0), (1.0, 1.0), (0.9, 1e-6)):
        yield Hard(
            "tabulated.invert_bilinear",
            f"x={x},y={y}",
            lambda t, x, y: tabulated.invert_bilinear(t, _slices(x), x, y),
            (_DENSITY, x, y),
            _bilinear,
            smooth=x == 0.3,
        )
        yield Hard(
            "tabulated.sample_bilinear",
            f"x={x},y={y}",
            lambda t, x, y: tabulated.sample_bilinear(
                t, _slices(x), *tabulated.invert_bilinear(t, _slices(x), x, y)[:2]
            ),
            (_DENSITY, x, y),
            lambda t, x, y: (x, y),
            ulps=64,  # the share of an end where the density is small moves x by its inverse
            smooth=x == 0.3,
        )
