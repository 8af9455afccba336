"""Tensor files, tables, lobes and measured reflectance."""

import struct

import numpy as np

from fuzzing.crafted.base import Crafted, arrays_of, strange
from fuzzing.readers.base import npz, single
from fuzzing.readers.materials import goniometer


def tensor_files() -> dict[str, Crafted]:
    def field(name: bytes, axes: int, kind: int, offset: int, shape: tuple[int, ...]) -> bytes:
        head = struct.pack("<H", len(name)) + name + struct.pack("<HBQ", axes, kind, offset)
        return head + struct.pack(f"<{len(shape)}Q", *shape)

    def file(count: int, *fields: bytes) -> bytes:
        return struct.pack("<12s2BI", b"tensor_file\0", 1, 0, count) + b"".join(fields) + bytes(64)

    found = {
        "terabytes": file(1, field(b"phi_i", 2, 11, 40, (2**20, 2**20))),
        "100 axes": file(1, field(b"phi_i", 100, 11, 40, (1,) * 100)),
        "nothing, of terabytes": file(1, field(b"phi_i", 2, 11, 40, (0, 2**63))),
        "4 10^9 fields": file(2**32 - 1, field(b"phi_i", 1, 11, 40, (1,))),
        "place beyond the file": file(1, field(b"phi_i", 1, 11, 2**63, (0,))),
    }
    cases = {k: Crafted(single("a.bsdf", v)) for k, v in found.items()}
    return cases | strange("a.bsdf") | strange("a.pbsdf")


def tables() -> dict[str, Crafted]:
    head = "theta_i,phi_i,theta_o,phi_o,f\n"
    found = {
        "a cell of megabytes": head + "1" * 200_000 + ",0,0,0,1\n30,0,30,0,1\n",
        "an open quote": head + '30,0,30,180,"1\n60,0,30,180,.1\n"\n',
        "an open quote at the end": head + '30,0,30,180,.1\n60,0,30,180,"1\n1,1,1,1,1\n',
        "columns": ",".join(f"c{k}" for k in range(50_000)) + "\n" + "1," * 49_999 + "1\n",
        "wavelengths": "theta_i,phi_i,theta_o,phi_o," + "9" * 400 + "nm\n0,0,0,0,1\n1,0,1,0,1\n",
    }
    cases = {k: Crafted(single("a.csv", v)) for k, v in found.items()}
    names = (*goniometer(),)
    return cases | arrays_of(".npz", names) | strange("a.csv") | strange("a.npz")


def lobes() -> dict[str, Crafted]:
    deep = '{"lobes": {"alpha": ' + "[" * 100_000
    found = {
        "nested deep": deep,
        "numbers of digits": '{"lobes": {"alpha": [' + "9" * 100_000 + "]}}",
        "ragged": '{"lobes": {"alpha": [[1], 2], "mu": [[0, 0, 1]], "kappa": [1]}}',
    }
    cases = {k: Crafted(single("a.json", v)) for k, v in found.items()}
    return cases | arrays_of(".npz", ("alpha", "mu", "kappa")) | strange("a.json")


def reflectance() -> dict[str, Crafted]:
    head = "# coherence: 2.0 um\n# quantity: spectral\n"
    names = "theta_i_deg,phi_i_deg,theta_o_deg,phi_o_deg,450 nm\n"
    found = {
        "a key of blanks": "# a: x" + " " * 60_000 + "x\n" + head + names + "10,0,20,0,1\n",
        "a cell of megabytes": head + names + "1" * 200_000 + ",0,20,0,1\n",
        "an open quote": head + names + '10,0,20,0,"1\n10,0,30,0,1\n',
        "exponent": head.replace("2.0", "1e999999999") + names + "10,0,20,0,1\n",
        "wavelength": head + names.replace("450", "1e99999999") + "10,0,20,0,1\n",
        "infinite": head.replace("2.0", "1e400") + names + "10,0,20,0,1\n",
    }
    cases = {k: Crafted(single("a.csv", v)) for k, v in found.items()}
    ways = np.array([[0.0, 0.0, 1.0]])
    deep = npz(wi=ways, wo=ways, values=np.ones((1, 1)), attributes=np.array("[" * 100_000))
    cases["attributes nested deep"] = Crafted(single("a.npz", deep))
    return cases | arrays_of(".npz", ("wi", "wo", "values")) | strange("a.csv") | strange("a.npz")
