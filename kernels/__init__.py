"""Pure array functions of the forward model; import as ``diffopt.kernels``.

Arrays in, arrays out, jax and numpy only: no files, no objects, no settings.
"""

if __name__ != "diffopt.kernels":
    raise ImportError(
        f"this folder was imported as {__name__!r}: import it as `diffopt.kernels` "
        "(install the project with `make demo` or `pip install -e .`), or a second copy "
        "of every module would be loaded"
    )
