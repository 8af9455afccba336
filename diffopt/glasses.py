"""Transparent materials by Sellmeier's formula, with published coefficients."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.errors import InputError
from diffopt.fresnel import Reflectance
from diffopt.kernels import fresnel

# (strengths B, squared resonances C in um^2). N-BK7: Schott, data sheet of 2014. Fused silica:
# Malitson, JOSA 55, 1205 (1965), 0.21-3.7 um. Water at 20 degrees: Daimon and Masumura, Applied
# Optics 46, 3811 (2007), relative to vacuum, 0.18-1.13 um. Diamond: Peter, Z. Phys. 15, 358 (1923).
_SELLMEIER = {
    "n-bk7": (
        (1.03961212, 0.231792344, 1.01046945),
        (0.00600069867, 0.0200179144, 103.560653),
    ),
    "silica": (
        (0.6961663, 0.4079426, 0.8974794),
        (0.0684043**2, 0.1162414**2, 9.896161**2),
    ),
    "water": (
        (0.5684027565, 0.1726177391, 0.02086189578, 0.1130748688),
        (0.005101829712, 0.01821153936, 0.02620722293, 10.69792721),
    ),
    "diamond": ((0.3306, 4.3356), (0.175**2, 0.106**2)),
}
GLASSES = tuple(_SELLMEIER)


class Sellmeier(Reflectance):
    """Transparent material with n^2 = 1 + sum B lambda^2 / (lambda^2 - C).

    Parameters
    ----------
    strengths
        B, [K].
    resonances
        C, squares of wavelengths of resonance in square micrometres, [K]. Wavelengths are to
        stay between them.
    """

    strengths: Float[Array, " K"] = eqx.field(converter=lambda v: jnp.asarray(v, float))
    resonances: Float[Array, " K"] = eqx.field(converter=lambda v: jnp.asarray(v, float))

    def index(self, wavelengths: Float[Array, " L"]) -> Float[Array, " L"]:
        """Refractive index at wavelengths in micrometres."""
        square = (wavelengths * wavelengths)[:, None]
        b, c = (v.astype(wavelengths.dtype)[None, :] for v in (self.strengths, self.resonances))
        return jnp.sqrt(1.0 + (b * square / (square - c)).sum(-1))

    def __call__(
        self, cos_h: Float[Array, "*batch"], wavelengths: Float[Array, " L"]
    ) -> Float[Array, "*batch L"]:
        """See `Reflectance`."""
        n = self.index(wavelengths).astype(cos_h.dtype)
        n = n.reshape((1,) * cos_h.ndim + (-1,))
        return fresnel.dielectric(*jnp.broadcast_arrays(cos_h[..., None], n))


def glass(name: str) -> Sellmeier:
    """A transparent material by name.

    Parameters
    ----------
    name
        One of `GLASSES`: ``n-bk7`` (crown glass), ``silica``, ``water`` (20 degrees Celsius),
        ``diamond``.

    Raises
    ------
    InputError
        For an unknown name.
    """
    key = name.lower()
    if key not in _SELLMEIER:
        raise InputError(f"glass must be one of {', '.join(GLASSES)}; received {name!r}")
    return Sellmeier(*(np.array(v) for v in _SELLMEIER[key]))
