"""Bodies from the files of other programs."""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import os
import pathlib
import zlib
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

from .bodies import Body
from .errors import BodyError

if TYPE_CHECKING:
    from numpy.typing import NDArray

_SIDES = ("X_Voxels", "Y_Voxels", "Z_Voxels")
_ASCII_ZERO = 48
_SIDE_MAX = 1000  # of a file's box; what is larger is no robot


def read_bodies(path: str | os.PathLike[str]) -> list[Body]:
    """The bodies in a file of another program:

    - `.json`: a world or a robot of EvoGym; each of its objects is a body
    - `.vxd`, `.vxa`, `.vxc`: the structure of voxcraft or VoxCAD, in one piece or not
    - `.h5`, `.hdf5`: a population of the paper's authors (`robots/polycubes`, `robots/pc_hashes`).
      Needs h5py.
    - `.npy`: an array of bodies, such as their `polycubes.npy`; all but its last three axes number
      them

    Materials become one, as `Body.lost` tells. Raises `BodyError`, which names the axis of a body
    that is larger than the workspace.
    """
    path = pathlib.Path(path)
    kind = path.suffix.lower()
    if kind == ".json":
        return _bodies(_evogym(json.loads(path.read_text(encoding="utf-8"))))
    if kind in (".vxd", ".vxa", ".vxc"):
        return _bodies({path.name: _voxcraft(path.read_bytes())})
    if kind in (".h5", ".hdf5"):
        return _bodies(_places(_population(path)))
    if kind == ".npy":
        array = np.load(path, allow_pickle=False)
        if array.ndim < 3:
            raise BodyError(f"{path.name} has {array.ndim} axes; an array of bodies has 3 or more")
        return _bodies(_places(array.reshape(-1, *array.shape[-3:])))
    raise BodyError(f"{path.name} is not a file of bodies: .json, .vxd, .vxa, .vxc, .h5, .hdf5 or "
                    ".npy is expected")


def _places(arrays: NDArray[Any]) -> dict[str, NDArray[Any]]:
    return {f"body {place}": array for place, array in enumerate(arrays)}


def _bodies(found: dict[str, NDArray[Any]]) -> list[Body]:
    bodies = []
    for name, array in found.items():
        try:
            bodies.append(Body.of(array))
        except BodyError as error:
            raise BodyError(f"{name}: {error}") from None
    return bodies


# ---- EvoGym: voxels by index in a grid whose rows go upwards ----


def _evogym(world: Any) -> dict[str, NDArray[np.int64]]:
    try:
        width, objects = int(world["grid_width"]), dict(world["objects"])
        return {name: _rows(width, thing["indices"], thing["types"])
                for name, thing in objects.items()}
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise BodyError(f"this JSON is not a world of EvoGym: {error!r}") from None


def _rows(width: int, indices: list[int], types: list[int]) -> NDArray[np.int64]:
    """Rows of materials from the top, as the arrays of EvoGym."""
    if len(indices) != len(types) or not indices or width < 1 or min(indices) < 0:
        raise ValueError("indices and types of an object do not fit")
    z, x = np.divmod(np.array(indices, dtype=np.int64), width)
    z, x = z - z.min(), x - x.min()
    if max(z.max(), x.max()) >= _SIDE_MAX:
        raise ValueError("an object is too large")
    grid = np.zeros((z.max() + 1, x.max() + 1), dtype=np.int64)
    grid[z, x] = types
    return grid[::-1]


# ---- voxcraft: a layer per z, in it rows of x ----


def _voxcraft(text: bytes) -> NDArray[np.uint8]:
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise BodyError(f"this is not XML: {error}") from None
    structure = next(root.iter("Structure"), None)
    data = structure.find("Data") if structure is not None else None
    if structure is None or data is None:
        raise BodyError("the file has no Structure with Data: a VXD without one has the body of "
                        "its VXA")
    try:
        sides = [int(structure.findtext(side, "1")) for side in _SIDES]
    except ValueError:
        sides = [0]
    if not all(0 < side <= _SIDE_MAX for side in sides):
        raise BodyError(f"{', '.join(_SIDES)} are not 1 to {_SIDE_MAX}")
    layers = data.findall("Layer")
    if len(layers) != sides[2]:
        raise BodyError(f"the file has {len(layers)} layers for Z_Voxels = {sides[2]}")
    compression = structure.get("Compression", "BASE64")
    values = [_layer(layer.text or "", compression, sides[0] * sides[1]) for layer in layers]
    return np.stack(values).reshape(sides[2], sides[1], sides[0]).transpose(2, 1, 0)


def _layer(text: str, compression: str, n: int) -> NDArray[np.uint8]:
    """The materials of a layer."""
    text = text.strip()
    try:
        if compression == "ASCII_READABLE":
            digits = np.frombuffer(text.encode("latin-1"), np.uint8)
            return _sized((digits - _ASCII_ZERO).astype(np.uint8), n)
        content = base64.b64decode("".join(text.split()), validate=True)
        if compression in ("ZLIB", "QT_ZLIB"):  # Qt puts the size in front
            unpacker = zlib.decompressobj()
            content = unpacker.decompress(content[4 * (compression == "QT_ZLIB"):], n + 1)
        elif compression != "BASE64":
            raise BodyError(f"layers of the compression {compression} cannot be read")
    except (UnicodeEncodeError, binascii.Error, zlib.error) as error:
        raise BodyError(f"a layer is not {compression}: {error}") from None
    return _sized(np.frombuffer(content, np.uint8), n)


def _sized(values: NDArray[np.uint8], n: int) -> NDArray[np.uint8]:
    if len(values) != n:
        raise BodyError(f"a layer has {len(values)} voxels; X_Voxels times Y_Voxels is {n}")
    return values


# ---- the paper's authors: HDF5 ----


def _population(path: pathlib.Path) -> NDArray[np.uint8]:
    try:
        import h5py
    except ImportError:
        raise ImportError("reading .h5 needs h5py: pip install 'morphod[hdf5]'") from None
    with h5py.File(path, "r") as file:
        if "robots/polycubes" not in file or "robots/pc_hashes" not in file:
            raise BodyError(f"{path.name} has no robots/polycubes with robots/pc_hashes")
        polycubes = np.asarray(file["robots/polycubes"])
        hashes = [bytes(text).decode("ascii", "replace") for text in file["robots/pc_hashes"]]
    return check_hashes(polycubes, hashes)


def check_hashes(polycubes: NDArray[Any], hashes: list[str]) -> NDArray[np.uint8]:
    """The bodies (n, X, Y, Z) of a population, after a look whether the axes are those that its
    hashes were made with: of the first bodies, since each takes 0.1 ms."""
    if polycubes.ndim != 4 or len(polycubes) != len(hashes):
        raise BodyError(f"robots/polycubes has the shape {polycubes.shape}, and there are "
                        f"{len(hashes)} hashes")
    for place, (polycube, told) in enumerate(zip(polycubes[:100], hashes)):
        if _hash(polycube) != told:
            raise BodyError(f"body {place} has another hash than robots/pc_hashes tells: the file "
                            "has another format")
    return polycubes.astype(np.uint8)


def _hash(polycube: NDArray[Any]) -> str:
    """The authors' name of a form: of the images under rotations about z and reflections, cut to
    the body, the one whose voxels come first; its sides and voxels hashed."""
    cells = np.argwhere(polycube == 1)
    if not cells.size:
        raise BodyError("a body of the population is empty")
    low, high = cells.min(axis=0), cells.max(axis=0) + 1
    cut = (polycube == 1)[low[0]:high[0], low[1]:high[1], low[2]:high[2]].astype(np.uint8)
    mirrored = (cut, cut[::-1], cut[:, ::-1])
    images = [np.rot90(image, -turns) for image in mirrored for turns in range(4)]  # in this order
    first = min(images, key=lambda image: image.tobytes())
    sides = np.array(first.shape, dtype="<i8").tobytes()
    return hashlib.sha256(sides + first.tobytes()).hexdigest()
