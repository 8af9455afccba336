"""What is seen past the surfaces of a scene: the environment itself, not averaged over lobes."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from diffopt.scenes import lights
from diffopt.scenes.channels import Channels
from diffopt.scenes.sky import Map

# Directions at a time: the densities of all lobes of an environment are held for them.
_BLOCK = 2**14


class Background(eqx.Module):
    """Radiance from directions; parallel and ambient light is not seen, as in path tracing.

    Parameters
    ----------
    sources
        Lights of a scene.
    channels
        Of the scene.
    """

    even: Float[Array, " C"]
    image: Map | None
    lobes: lights.LobeEnvironment | None
    channels: Channels

    def __init__(self, sources: Sequence[lights.Light], channels: Channels) -> None:
        """See the class."""
        self.even, self.image, self.lobes = jnp.zeros(channels.count, jnp.float32), None, None
        self.channels = channels
        for light in sources:
            if isinstance(light, lights.LobeEnvironment):
                self.lobes = light
            elif isinstance(light, lights.Environment) and light.is_map:
                self.image = Map(light, channels, jnp.float32)
            elif isinstance(light, lights.Environment):
                value = channels.values("radiance", light.radiance).astype(jnp.float32)
                self.even = self.even + value * light.scale.astype(jnp.float32)

    @eqx.filter_jit
    def __call__(
        self, towards: Float[Array, "n 3"], turn: Float[Array, "3 3"] | None = None
    ) -> Float[Array, "n C"]:
        """Radiance from unit vectors in the world.

        Parameters
        ----------
        towards
            float32.
        turn
            Rotation matrix by which the environment is turned in the world.
        """
        there = towards if turn is None else jnp.matmul(towards, turn, precision="highest")
        value = jnp.broadcast_to(self.even, (len(there), len(self.even)))
        if self.image is not None:
            value = value + self.image.radiance(there)
        if self.lobes is not None:
            value = value + jax.lax.map(self._of_lobes, there, batch_size=_BLOCK)
        return value

    def _of_lobes(self, towards: Array) -> Array:
        assert self.lobes is not None
        found = self.lobes.lobes(towards)
        found = found[..., None] if found.ndim == 0 else found
        return self.channels.converted(found).astype(towards.dtype)
