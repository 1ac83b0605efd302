#!/usr/bin/env python3
"""Controllers between this project and the `safetensors` package of the PyTorch world, in both
directions.

    interop.py PROGRAM        PROGRAM reads its first argument as a controller and writes it to its
    second (round-trip.c).
    interop.py --header FILE  writes the header that the package writes for a 1x1x1 controller: the
    fixture of safetensors.c.

Skipped (status 77) if the package is not installed; the fixture then covers reading its files.
"""
import os
import struct
import subprocess
import sys
import tempfile

try:
    import numpy as np
    from safetensors import safe_open
    from safetensors.numpy import save_file
except ImportError:
    print("the packages safetensors and numpy are not installed")
    sys.exit(77)

HIDDEN = 256


def make(nx, ny, nz):
    """Tensors and metadata of a controller with made-up values."""
    masses = (nx + 1) * (ny + 1) * (nz + 1)
    edges = nx * (ny + 1) * (nz + 1) + (nx + 1) * ny * (nz + 1) + (nx + 1) * (ny + 1) * nz
    faces = nx * ny * (nz + 1) + nx * (ny + 1) * nz + (nx + 1) * ny * nz
    springs = edges + 2 * faces
    shapes = {
        "net.0.weight": (HIDDEN, masses + 5), "net.9.weight": (springs, HIDDEN),
        "net.9.bias": (springs, )
    }
    for layer in (3, 6):
        shapes[f"net.{layer}.weight"] = (HIDDEN, HIDDEN)
    for layer in (0, 1, 3, 4, 6, 7):
        shapes[f"net.{layer}.bias"] = (HIDDEN, )
    for layer in (1, 4, 7):
        shapes[f"net.{layer}.weight"] = (HIDDEN, )
    rng = np.random.default_rng(1)
    tensors = {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}
    metadata = {
        "mass_order": f"x-major lattice (x*{ny + 1}+y)*{nz + 1}+z",
        "spring_order": "lexicographic endpoint pairs",
        "sensor": "inverse_square",
        "workspace": f"{nx}x{ny}x{nz}",
        "note": 'quotes " and \\ and µ and 語',
    }
    return tensors, metadata


def load(path):
    with safe_open(path, framework="numpy") as file:
        return {name: file.get_tensor(name) for name in file.keys()}, file.metadata()


def check(program, size):
    tensors, metadata = make(*size)
    with tempfile.TemporaryDirectory() as folder:
        theirs, ours = os.path.join(folder,
                                    "theirs.safetensors"), os.path.join(folder, "ours.safetensors")
        save_file(tensors, theirs, metadata=metadata)
        subprocess.run([program, theirs, ours], check=True)
        back, back_metadata = load(ours)
        again = os.path.join(folder, "again.safetensors")
        subprocess.run([program, ours, again], check=True)
        with open(ours, "rb") as a, open(again, "rb") as b:
            assert a.read() == b.read(), "the same controller was written as different bytes"
    assert back.keys() == tensors.keys(), sorted(back)
    for name, value in tensors.items():
        assert back[name].dtype == np.float32 and np.array_equal(back[name], value), name
    assert back_metadata == metadata, back_metadata


def main():
    if sys.argv[1] == "--header":
        tensors, metadata = make(1, 1, 1)
        with tempfile.TemporaryDirectory() as folder:
            path = os.path.join(folder, "controller.safetensors")
            save_file(tensors, path, metadata=metadata)
            with open(path, "rb") as file:
                prefix = file.read(8)
                header = file.read(struct.unpack("<Q", prefix)[0])
        with open(sys.argv[2], "wb") as out:
            out.write(prefix + header)
        return
    for size in ((1, 1, 1), (6, 6, 4), (2, 3, 1)):
        check(sys.argv[1], size)


main()
