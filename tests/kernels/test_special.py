"""The Dirichlet kernel of finite repetition."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffopt.kernels import special


@pytest.mark.parametrize("copies", [1, 2, 7, 101])
def test_against_the_sum(copies, rng):
    turns = np.concatenate([rng.uniform(-3, 3, 200), np.arange(-2.0, 3.0), [1e-9, 0.5, 1 + 1e-7]])
    re, im = jax.jit(special.dirichlet, static_argnums=1)(jnp.asarray(turns), copies)
    expected = np.exp(2j * np.pi * turns[:, None] * np.arange(copies)).mean(1)
    # The sum's own phases round by 1e-16 x 3 turns x copies.
    np.testing.assert_allclose(np.asarray(re) + 1j * np.asarray(im), expected, atol=1e-12)


def test_gradient_at_and_near_an_order(dtype):
    """d|D|^2/dt = 0 at an order and finite around it, where the quotient form is 0/0."""

    def square(t):
        re, im = special.dirichlet(t, 26)
        return re**2 + im**2

    for offset in (0.0, 1e-8, 1e-4, 1e-3):
        t = jnp.asarray(2.0 + offset, dtype)
        exact_offset = float(t) - 2.0
        expected = -2 * (np.pi**2) * (26**2 - 1) / 3 * exact_offset  # leading order at small t
        got = float(jax.grad(square)(t))
        # 5 % at 1e-3, where the next term of the series enters; rounding 26^2 eps.
        assert got == pytest.approx(
            expected, rel=0.05, abs=26**2 * (1e-6 if dtype == "float32" else 1e-12)
        )
