"""Standard deviations of free heights, by Laplace's approximation."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from diffopt.fitting.freeform.priors import filtered
from diffopt.fitting.freeform.problem import Problem

# Information on what is fixed by convention, in units of that of the prior.
_HELD = 1e4


@eqx.filter_jit
def posterior_deviation(
    made: Problem,
    heights: Float[Array, "ny nx"],
    root: Float[Array, "ny half"],
    weight: Float[Array, ""],
    fixed: Float[Array, "count ny nx"],
    key: Array,
    *,
    rank: int,
) -> Float[Array, "ny nx"]:
    """Standard deviation of each height in Laplace's approximation, from above.

    With A the Gauss-Newton matrix of the misfit in white unknowns the covariance is
    C (weight + A)^-1 C^T. A is replaced by its Nystroem approximation on the range of A applied
    to `rank` random vectors, which is never larger than A (Halko, Martinsson and Tropp, SIAM
    Rev. 53, 217, 2011): too small a rank makes deviations too large, never too small.

    Parameters
    ----------
    made, heights
        The problem, and where it is linearised.
    root
        Root spectrum of the prior.
    weight
        Of the prior.
    fixed
        Changes of the heights that are excluded by convention, as translations are.
    key
        Of the random vectors.
    rank
        Their number; time grows in proportion (twice a forward and an adjoint product each),
        memory by two fields each.
    """
    shape, dtype = heights.shape, heights.dtype

    def along(z):
        return made.residuals(heights + filtered(z, root))[0]

    zero = jnp.zeros(shape, dtype)
    _, adjoint = jax.vjp(along, zero)

    known = jax.vmap(lambda field: filtered(field, root).reshape(-1))(fixed)
    known = jnp.linalg.qr(known.T)[0]

    def product(z):
        _, change = jax.jvp(along, (zero,), (z,))
        held = jnp.matmul(known, jnp.matmul(z.reshape(-1), known, precision="highest"))
        return adjoint(change)[0] + _HELD * weight * held.reshape(shape)

    def products(rows):
        return jax.lax.map(product, rows.reshape(rank, *shape)).reshape(rank, -1)

    def dot(a, b):
        return jnp.matmul(a, b, precision="highest")

    spanned = products(jax.random.normal(key, (rank, heights.size), dtype))
    basis = jnp.linalg.qr(spanned.T)[0].T
    image = products(basis)
    core = dot(basis, image.T)
    core = 0.5 * (core + core.T)
    values, turns = jnp.linalg.eigh(core)
    # A shift by rounding keeps the small eigenvalues away from zero, and the result below A.
    floor = values[-1] * rank * jnp.finfo(dtype).eps
    factor = dot(turns.T, image) / jnp.sqrt(jnp.maximum(values, floor))[:, None]
    # A ~ factor^T factor; its eigenpairs by the small Gram matrix.
    gram, turns = jnp.linalg.eigh(dot(factor, factor.T))
    gram = jnp.maximum(gram, 0.0)
    vectors = dot(turns.T, factor) / jnp.sqrt(jnp.maximum(gram, floor))[:, None]
    share = gram / (weight + gram)

    def gained(total, pair):
        vector, share = pair
        return total + share * filtered(vector.reshape(shape), root) ** 2, None

    total, _ = jax.lax.scan(gained, zero, (vectors, share))
    unit = zero.at[0, 0].set(1.0)
    prior = jnp.sum(filtered(unit, root) ** 2)
    return jnp.sqrt(jnp.maximum(prior - total, 0.0) / weight)
