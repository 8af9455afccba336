"""Adaptive precomputed transfer on the surfaces of a scene."""
