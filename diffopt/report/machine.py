"""What the figures were computed with: versions, processor, precision."""

import datetime
import importlib.metadata
import os
import platform
from pathlib import Path

import jax

from diffopt import __version__

# Whose versions matter to figures.
_PACKAGES = ("jax", "jaxlib", "equinox", "optimistix", "numpy", "embreex", "colour-science")


def figures() -> list[tuple[str, str]]:
    """Names and values."""
    devices = jax.devices()
    allowed = getattr(os, "sched_getaffinity", None)
    cores = len(allowed(0)) if allowed else os.cpu_count() or 1
    now = datetime.datetime.now().astimezone()
    return [
        ("date", now.strftime("%Y-%m-%d %H:%M %Z")),
        ("diffopt", __version__),
        *((name, _version(name)) for name in _PACKAGES),
        ("Python", platform.python_version()),
        ("system", f"{platform.system()} {platform.machine()}"),
        ("processor", f"{_processor()}, {cores} cores"),
        ("JAX computes on", ", ".join(f"{d.platform} {d.device_kind}" for d in devices)),
        ("precision", "float64 enabled" if jax.config.read("jax_enable_x64") else "float32"),
    ]


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _processor() -> str:
    """Its name, where the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return platform.processor() or "unknown"
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or "unknown"
