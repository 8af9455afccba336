"""Radiosity: light between surfaces that scatter it evenly, from a system of equations.

The irradiance H of patches is the direct light E and what the form factors F bring of the
light that patches scatter, B = rho H = rho (E + F B). It is solved for all channels at once.
(Goral et al., "Modeling the interaction of light between diffuse surfaces", SIGGRAPH 1984.)

Differentiable in albedos, emission and lights: form factors, what hides lights, and points on
lights that shine on patches are found once, by `prepare`, and held fixed.
"""

from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.errors import InputError
from diffopt.rendering import formfactors, illumination, patches, smoothing, sources
from diffopt.rendering.families import Beams, LobeSky, Points, Sky, Surfaces
from diffopt.rendering.formfactors import FormFactors
from diffopt.rendering.illumination import Illumination
from diffopt.rendering.patches import Patches
from diffopt.rendering.radiosity_settings import MOST, RadiositySettings
from diffopt.rendering.smoothing import Field, Smoother
from diffopt.rendering.stage import Stage
from diffopt.scenes import raycasting, shapes
from diffopt.scenes.scene import Scene

# What is left of the system, relative to its right-hand side, in roundings.
_ROUNDINGS = 64.0
# Rays by which insides of closed shapes are sought that light reaches, and their least share.
_PROBES, _LEAST = 4096, 1e-3
# Patches in all after refinement, in those wanted.
_GROWTH = 4


class Transport(eqx.Module):
    """What is known of a scene's light transport without its lights' and materials' numbers.

    Attributes
    ----------
    patches, factors
        The patches and their form factors, on the host.
    exchange, area, escaped
        As of `FormFactors`, [P, P], [P], [P].
    light
        Direct light.
    smoother
        Makes fields of values of patches.
    """

    patches: Patches = eqx.field(static=True)
    factors: FormFactors = eqx.field(static=True)
    exchange: Float[Array, "P P"]
    area: Float[Array, " P"]
    escaped: Float[Array, " P"]
    light: Illumination
    smoother: Smoother

    @property
    def closure(self) -> float:
        """Share of the light that leaves surfaces which meets a surface again."""
        area = self.factors.area
        return float(1.0 - (area * self.factors.escaped).sum() / max(area.sum(), 1e-300))


class Energy(eqx.Module):
    """Where power goes, [C] each: area times irradiance, pi times the radiance of even light.

    Attributes
    ----------
    emitted, received
        By surfaces that emit light; from all other lights.
    absorbed, escaped
        By surfaces; to where there are none.
    error
        Of the balance, relative to the sum of both that come in.
    """

    emitted: Float[Array, " C"]
    received: Float[Array, " C"]
    absorbed: Float[Array, " C"]
    escaped: Float[Array, " C"]

    @property
    def error(self) -> Float[Array, " C"]:
        """See the class."""
        whole = self.emitted + self.received
        lack = whole - self.absorbed - self.escaped
        return jnp.abs(lack) / jnp.where(whole > 0.0, whole, 1.0)


class Radiosity(eqx.Module):
    """Light on patches, [P, C] each, pi times the radiance of even light.

    Attributes
    ----------
    transport
        Of the scene.
    emission
        Emitted, pi times the radiance.
    albedo
        Of the patches.
    from_surfaces, from_lights
        Direct irradiance from surfaces that emit, and from all other lights.
    indirect
        Irradiance by light that other patches scatter.
    """

    transport: Transport
    emission: Float[Array, "P C"]
    albedo: Float[Array, "P C"]
    from_surfaces: Float[Array, "P C"]
    from_lights: Float[Array, "P C"]
    indirect: Float[Array, "P C"]

    @property
    def irradiance(self) -> Float[Array, "P C"]:
        """All of it."""
        return self.from_surfaces + self.from_lights + self.indirect

    @property
    def scattered(self) -> Float[Array, "P C"]:
        """Radiosity without what is emitted."""
        return self.albedo * self.irradiance

    @property
    def radiosity(self) -> Float[Array, "P C"]:
        """What leaves the patches."""
        return self.emission + self.scattered

    @property
    def energy(self) -> Energy:
        """The balance of power."""
        dtype = self.albedo.dtype
        area, escaped = (
            a.astype(dtype)[:, None] for a in (self.transport.area, self.transport.escaped)
        )
        return Energy(
            emitted=(area * self.emission).sum(0),
            received=(area * self.from_lights).sum(0),
            absorbed=(area * (1.0 - self.albedo) * self.irradiance).sum(0),
            escaped=(area * escaped * self.radiosity).sum(0),
        )

    def field(self, values: Float[Array, "P C"]) -> Field:
        """Values of patches, smooth over the surfaces."""
        return self.transport.smoother.field(values, self.transport.area.astype(values.dtype))


def solve(
    scene: Scene,
    settings: RadiositySettings | None = None,
    *,
    transport: Transport | None = None,
    dtype: Any = "float32",
) -> Radiosity:
    """Light on the patches of a scene.

    Parameters
    ----------
    scene
        The scene.
    settings
        How it is solved.
    transport
        Of `prepare` for the same shapes and kinds of lights; with it this is a differentiable
        function of the scene.
    dtype
        "float32" or "float64".

    Raises
    ------
    InputError
        For a scene without shapes, or one being differentiated without a `transport`.
    """
    if transport is None:
        transport = prepare(scene, RadiositySettings() if settings is None else settings)
    return solve_on(transport, Stage(scene, dtype))


def prepare(scene: Scene, settings: RadiositySettings) -> Transport:
    """Patches, form factors and what hides lights; see `solve` for the errors."""
    if not scene.objects:
        raise InputError("radiosity needs surfaces; the scene has no objects")
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(scene)):
        raise InputError(
            "the scene is being differentiated: call radiosity.prepare on it outside, "
            "and pass solve its transport"
        )
    found = sources.gather(scene, "float32")
    caster = raycasting.caster(scene.geometry, settings.backend)
    seen = _backs(scene, found, caster, settings.seed)
    cut = patches.cut(scene, settings.patches, settings.refinements, seen)
    if cut.count > MOST:
        raise InputError(
            f"the scene has {cut.count} separate surfaces; radiosity takes up to {MOST} patches"
        )
    shapes_, rays = scene.geometry.typed("float32"), settings.rays_per_patch
    casts = formfactors.cast(cut, shapes_, caster, rays, settings.seed)
    round_ = 0
    while True:
        factors = formfactors.form_factors(cut, casts)
        samples, seed = settings.light_samples, settings.seed
        light = illumination.illuminate(found, cut, factors, casts, caster, samples, seed)
        transport = Transport(
            cut,
            factors,
            jnp.asarray(factors.exchange),
            jnp.asarray(factors.area, jnp.float32),
            jnp.asarray(factors.escaped, jnp.float32),
            light,
            smoothing.smoother(scene, cut),
        )
        if round_ == settings.refinements:
            break
        rough = _rough(solve_on(transport, Stage(scene)), scene, settings)
        if not len(rough):
            break
        kept = cut.count
        cut, before = cut.split(rough)
        if cut.count == kept:
            break
        new = np.flatnonzero(before < 0)
        more = formfactors.cast(cut, shapes_, caster, rays, settings.seed, new)
        casts = casts.after(before, more)
        round_ += 1
    return transport


def solve_on(transport: Transport, stage: Stage) -> Radiosity:
    """Light on patches, for a scene that is prepared for rendering."""
    cut, lights, primitive = transport.patches, stage.sources, transport.patches.primitive
    albedo = patches.albedo(stage, cut)
    emission = jnp.zeros_like(albedo)
    family, _ = lights.family(Surfaces)
    if family is not None:
        entry = lights.entry[jnp.asarray(primitive)]
        lit = (entry >= 0) & jnp.asarray(cut.side == 0)
        emission = jnp.where(lit[:, None], np.pi * family.radiance[jnp.maximum(entry, 0)], 0.0)
    surfaces, other = _direct(transport.light, lights)
    # Patches inside bodies: rays say nothing of them.
    outside = (transport.area > 0.0)[:, None]
    surfaces, other = (jnp.where(outside, a, 0.0) for a in (surfaces, other))
    indirect = _between(transport.exchange, transport.area, albedo, surfaces + other)
    return Radiosity(transport, emission, albedo, surfaces, other, indirect)


@eqx.filter_jit
def _direct(light: Illumination, lights: sources.Sources) -> tuple[Array, Array]:
    return light.irradiance(lights)


@eqx.filter_jit
def _between(
    exchange: Float[Array, "P P"],
    area: Float[Array, " P"],
    albedo: Float[Array, "P C"],
    direct: Float[Array, "P C"],
) -> Float[Array, "P C"]:
    """Indirect irradiance F B, with B = rho (E + F B)."""
    import lineax  # takes a tenth of a second, which only this needs

    dtype = direct.dtype
    weight = jnp.where(area > 0.0, 1.0 / jnp.where(area > 0.0, area, 1.0), 0.0).astype(dtype)

    def arriving(scattered: Array) -> Array:
        found = jnp.matmul(exchange.astype(dtype), scattered, precision="highest")
        return weight[:, None] * found

    def left(scattered: Array) -> Array:
        return scattered - albedo * arriving(scattered)

    shape = jax.ShapeDtypeStruct(direct.shape, dtype)
    operator = lineax.FunctionLinearOperator(left, shape)
    near = _ROUNDINGS * float(jnp.finfo(dtype).eps)
    right = albedo * direct
    size = jax.lax.stop_gradient(jnp.abs(right).max())
    unit = jnp.where(size > 0.0, size, 1.0)
    solver = lineax.GMRES(rtol=near, atol=near, restart=30, max_steps=600)
    found = lineax.linear_solve(operator, right / unit, solver, throw=False)
    return arriving(found.value * unit)


def _backs(scene: Scene, found: sources.Sources, caster: Any, seed: int) -> np.ndarray:
    """Which objects have backs that light reaches: open ones, and closed ones around lights."""
    out = np.array([not shapes.is_closed(one.place.shape) for one in scene.objects])
    if out.all():
        return out
    random = np.random.default_rng(seed)
    geometry = scene.geometry
    ways = []
    for family in found.families:
        all_around = random.normal(size=(_PROBES, 3))
        all_around /= np.linalg.norm(all_around, axis=1, keepdims=True)
        if isinstance(family, Points):
            at = np.resize(np.arange(len(family.position)), _PROBES)
            ways.append((np.asarray(family.position)[at], all_around))
        elif isinstance(family, Surfaces):
            u = jnp.asarray(random.random((_PROBES, 2)), jnp.float32)
            at = jnp.asarray(np.resize(np.arange(len(family.radius)), _PROBES))
            origin, normal = (np.asarray(a) for a in family.place(at, u))
            # Towards the front, by the cosine law.
            towards = normal + 0.999 * all_around
            towards /= np.linalg.norm(towards, axis=1, keepdims=True)
            ways.append((origin + caster.offset * normal, towards))
    outside = isinstance(found.constant, jax.Array) or any(
        isinstance(f, Beams | Sky | LobeSky) for f in found.families
    )
    if outside:
        all_around = random.normal(size=(2, _PROBES, 3))
        all_around /= np.linalg.norm(all_around, axis=2, keepdims=True)
        start = geometry.centre + 1.01 * geometry.radius * all_around[0]
        aim = geometry.centre + 0.7 * geometry.radius * all_around[1]
        towards = aim - start
        ways.append((start, towards / np.linalg.norm(towards, axis=1, keepdims=True)))
    blank = patches.charts.sheets(scene, np.ones(len(out), bool)).charts
    for origin, towards in ways:
        hits = caster.first(origin, towards)
        rows = np.flatnonzero(hits.primitive >= 0)
        if not len(rows):
            continue
        values = (a[rows] for a in (hits.primitive, hits.u, hits.v, origin, towards))
        moved = [np.asarray(a, a.dtype if a.dtype.kind == "i" else np.float32) for a in values]
        typed = geometry.typed("float32")
        *_, arrival = formfactors.in_blocks(
            lambda *a, typed=typed: formfactors.arrive(blank, typed, *a),
            *moved,
            hits.distance[rows],
        )
        behind = np.bincount(
            geometry.owner[hits.primitive[rows[arrival < 0.0]]], minlength=len(out)
        )
        out |= behind > _LEAST * len(origin)
    return out


def _rough(found: Radiosity, scene: Scene, settings: RadiositySettings) -> np.ndarray:
    """Patches that differ from a neighbour on the same sheet, the roughest first."""
    cut = found.transport.patches
    value = np.asarray(found.scattered, np.float64) @ scene.channels.luminance()
    area = found.transport.factors.area
    mean = (value * area).sum() / max(area.sum(), 1e-300)
    cells = cut.cells(cut.depth)
    scale = 2**cut.cap
    wide, high = (cut.columns * scale)[cells.sheet], (cut.rows * scale)[cells.sheet]
    worst = np.zeros(cut.count)
    for step, inside in ((1, cells.column + 1 < wide), (wide, cells.row + 1 < high)):
        here = np.flatnonzero(inside)
        one = cut.table[here]
        two = cut.table[here + np.broadcast_to(step, inside.shape)[here]]
        both = (area[one] > 0.0) & (area[two] > 0.0)
        differ = np.where(both, np.abs(value[one] - value[two]), 0.0)
        np.maximum.at(worst, one, differ)
        np.maximum.at(worst, two, differ)
    worst[cut.level[cut.first] >= cut.cap[cut.sheet[cut.first]]] = 0.0
    rough = np.flatnonzero(worst > settings.tolerance * mean)
    most = min(_GROWTH * settings.patches, MOST) - cut.count
    order = np.argsort(-worst[rough], kind="stable")
    return rough[order][: max(most // 3, 0)]
