"""Fits over the forward model; import as ``diffopt.fitting``.

Inverse problems solved with optimistix.
"""

if __name__ != "diffopt.fitting":
    raise ImportError(
        f"this folder was imported as {__name__!r}: import it as `diffopt.fitting` "
        "(install the project with `make demo` or `pip install -e .`), or a second copy "
        "of every module would be loaded"
    )
