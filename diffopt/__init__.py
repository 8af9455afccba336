"""Differentiable optics in JAX."""
