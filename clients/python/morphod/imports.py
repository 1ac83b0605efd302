"""Bodies from the files of other programs."""

from __future__ import annotations

import base64
import binascii
import dataclasses
import hashlib
import json
import os
import pathlib
import zipfile
import zlib
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

from . import evogym
from .bodies import Body, OnFault
from .errors import BodyError

if TYPE_CHECKING:
    from numpy.typing import NDArray

_SIDES = ("X_Voxels", "Y_Voxels", "Z_Voxels")
_ASCII_ZERO = 48
_SIDE_MAX = 1000  # maximum side of a file's box; a robot is smaller
_NAMES_MAX = 3  # in a sentence about what was left out


def read_bodies(path: str | os.PathLike[str], names: str | Iterable[str] | None = None, *,
                on_fault: OnFault = "refuse") -> list[Body]:
    """Returns the bodies in a file of another program, each with its `name` in the file:

    - `.json`: an EvoGym world; each of its objects is a body. Fixed objects, such as the ground,
      are left out unless they are named.
    - `.vxd`, `.vxa`, `.vxc`: the structure of voxcraft or VoxCAD, in one piece or not
    - `.h5`, `.hdf5`: a population of the paper's authors (`robots/polycubes`, `robots/pc_hashes`).
      Needs h5py.
    - `.npy`: an array of bodies, such as their `polycubes.npy`; all axes except the last three
      number them
    - `.npz`: an EvoGym robot, as `np.savez(path, body, connections)` saves it, or arrays of bodies

    `names` selects the bodies to read; without it all are read. Anything that is not a body or does
    not fit the workspace is refused or, with `on_fault="skip"`, left out. `Body.lost` says what was
    left out, and which materials were merged. Raises `BodyError`, which reports the axis on which a
    body is larger than the workspace.
    """
    path = pathlib.Path(path)
    kind = path.suffix.lower()
    if kind == ".json":
        found = _world(path)
    elif kind in (".vxd", ".vxa", ".vxc"):
        found = [_voxcraft(path)]
    elif kind in (".h5", ".hdf5"):
        found = _places(_population(path))
    elif kind in (".npy", ".npz"):
        found = _arrays(path)
    else:
        raise BodyError(f"{path.name} is not a file of bodies: its suffix must be .json, .vxd, "
                        ".vxa, .vxc, .h5, .hdf5, .npy or .npz")
    return _bodies(found, names, on_fault)


@dataclasses.dataclass
class _Found:
    """An item of a file: rows of EvoGym, or voxels [x, y, z]."""

    name: str
    array: NDArray[Any]
    lost: tuple[str, ...] = ()
    connections: NDArray[Any] | None = None
    is_evogym: bool = False
    is_fixed: bool = False

    def body(self) -> Body:
        made = (Body.evogym(self.array, self.connections) if self.is_evogym else
                Body.of(self.array))
        return Body(made.voxels, made.lost + self.lost, self.name)


def _bodies(found: Sequence[_Found], names: str | Iterable[str] | None,
            on_fault: OnFault) -> list[Body]:
    left_out: list[str] = []
    if names is not None:
        wanted = [names] if isinstance(names, str) else list(names)
        by_name = {one.name: one for one in found}
        missing = [name for name in wanted if name not in by_name]
        if missing:
            raise BodyError(f"the file has no body {missing[0]!r}; it has {_some(list(by_name))}")
        found = [by_name[name] for name in wanted]
    else:
        left_out = [f"{one.name} (fixed)" for one in found if one.is_fixed]
        found = [one for one in found if not one.is_fixed]
        if left_out and not found:
            raise BodyError(f"this file has only fixed objects: {_some(left_out)}; use names= to "
                            "read one anyway")
    bodies: list[Body] = []
    for one in found:
        try:
            bodies.append(one.body())
        except BodyError as error:
            if on_fault != "skip" or not bodies and one is found[-1]:
                raise BodyError(f"{one.name}: {error}" + (
                    '; use names= or on_fault="skip" to read the others' if len(found) > 1 and
                    on_fault != "skip" else "")) from None
            left_out.append(f"{one.name} ({error})")
    if left_out:
        lost = f"left out of the file: {_some(left_out)}"
        bodies = [Body(body.voxels, (*body.lost, lost), body.name) for body in bodies]
    return bodies


def _some(names: Sequence[str]) -> str:
    """Returns names for a message, limited in number."""
    more = len(names) - _NAMES_MAX
    return ", ".join(names[:_NAMES_MAX]) + (f" and {more} more" if more > 0 else "")


def _places(arrays: NDArray[Any], name: str = "body") -> list[_Found]:
    return [_Found(f"{name} {place}", array) for place, array in enumerate(arrays)]


# ---- EvoGym and NumPy ----


def _world(path: pathlib.Path) -> list[_Found]:
    try:
        world = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise BodyError(f"{path.name} is not JSON: {error}") from None
    return [_Found(name, thing.rows, thing.lost, is_evogym=True, is_fixed=thing.is_fixed)
            for name, thing in evogym.things(world).items()]


def _arrays(path: pathlib.Path) -> list[_Found]:
    """Returns the arrays of a NumPy file. Pickled objects are not loaded, because they can
    run code."""
    try:
        loaded = np.load(path, allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            arrays = {path.name: loaded}
        else:
            with loaded:
                arrays = {name: loaded[name] for name in loaded.files}
    except (ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise BodyError(f"{path.name} cannot be read: {error}") from None
    pair = list(arrays.values())
    if len(pair) == 2 and pair[0].ndim == pair[1].ndim == 2 and len(pair[1]) == 2:
        return [_Found(path.name, pair[0], connections=pair[1], is_evogym=True)]
    found = []
    for name, array in arrays.items():
        if array.ndim < 3:
            raise BodyError(f"{name} has {array.ndim} axes; an array of bodies has 3 or more. "
                            "Load an EvoGym robot with np.load, and pass it to Body.evogym")
        found += _places(array.reshape(-1, *array.shape[-3:]),
                         "body" if len(arrays) == 1 else name)
    return found


# ---- voxcraft: one layer per z, with rows along x ----


_OF_VOXCRAFT = {
    "phase offsets": ("PhaseOffset", "TempPhase", "MaterialTempPhase"),
    "stiffness": ("Stiffness", "Elastic_Mod"),
    "cilia": ("Cilia", "CiliaForce", "BaseCiliaForce", "ShiftCiliaForce"),
    "density": ("Density", ),
    "friction": ("uStatic", "uDynamic"),
    "thermal expansion": ("CTE", ),  # by which materials move
}
"""What these programs store about a body besides its materials, by XML tag."""


def _voxcraft(path: pathlib.Path) -> _Found:
    try:
        root = ElementTree.fromstring(path.read_bytes())
    except ElementTree.ParseError as error:
        raise BodyError(f"this is not XML: {error}") from None
    structure = next(root.iter("Structure"), None)
    data = structure.find("Data") if structure is not None else None
    if structure is None or data is None:
        raise BodyError("the file has no Structure with Data; a VXD without one uses the body of "
                        "its VXA")
    try:
        sides = [int(structure.findtext(side, "1")) for side in _SIDES]
    except ValueError:
        sides = [0]
    if not all(0 < side <= _SIDE_MAX for side in sides):
        raise BodyError(f"{', '.join(_SIDES)} must be 1 to {_SIDE_MAX}")
    layers = data.findall("Layer")
    if len(layers) != sides[2]:
        raise BodyError(f"the file has {len(layers)} layers for Z_Voxels = {sides[2]}")
    compression = structure.get("Compression", "BASE64")
    values = [_layer(layer.text or "", compression, sides[0] * sides[1]) for layer in layers]
    array = np.stack(values).reshape(sides[2], sides[1], sides[0]).transpose(2, 1, 0)
    lost = [what for what, tags in _OF_VOXCRAFT.items()
            if any(_says(element) for tag in tags for element in root.iter(tag))]
    known = {*_SIDES, "Data", *(tag for tags in _OF_VOXCRAFT.values() for tag in tags)}
    lost += [child.tag for child in structure if child.tag not in known and _says(child)]
    return _Found(path.name, array, (f"left out of the file: {', '.join(lost)}", ) if lost else ())


def _says(element: ElementTree.Element) -> bool:
    """Returns whether an element has anything other than zeros."""
    return any(set(text) - set("0., \t\r\n") for text in element.itertext())


def _layer(text: str, compression: str, n: int) -> NDArray[np.uint8]:
    """Returns the materials of a layer."""
    text = text.strip()
    try:
        if compression == "ASCII_READABLE":
            digits = np.frombuffer(text.encode("latin-1"), np.uint8) - np.uint8(_ASCII_ZERO)
            if (digits > 9).any():
                raise BodyError("an ASCII_READABLE layer has characters other than digits")
            return _sized(digits, n)
        content = base64.b64decode("".join(text.split()), validate=True)
        if compression in ("ZLIB", "QT_ZLIB"):  # Qt puts the size in front
            unpacker = zlib.decompressobj()
            content = unpacker.decompress(content[4 * (compression == "QT_ZLIB"):], n + 1)
        elif compression != "BASE64":
            raise BodyError(f"layers with the compression {compression} cannot be read")
    except (UnicodeEncodeError, binascii.Error, zlib.error) as error:
        raise BodyError(f"a layer is not {compression}: {error}") from None
    return _sized(np.frombuffer(content, np.uint8), n)


def _sized(values: NDArray[np.uint8], n: int) -> NDArray[np.uint8]:
    if len(values) != n:
        raise BodyError(f"a layer has {len(values)} voxels; X_Voxels times Y_Voxels is {n}")
    return values


# ---- the paper's authors: HDF5 ----


def _population(path: pathlib.Path) -> NDArray[Any]:
    try:
        import h5py
    except ImportError:
        raise ImportError("reading .h5 needs h5py: pip install h5py") from None
    with h5py.File(path, "r") as file:
        if "robots/polycubes" not in file or "robots/pc_hashes" not in file:
            raise BodyError(f"{path.name} has no robots/polycubes with robots/pc_hashes")
        polycubes = np.asarray(file["robots/polycubes"])
        hashes = [bytes(text).decode("ascii", "replace") for text in file["robots/pc_hashes"]]
    return check_hashes(polycubes, hashes)


def check_hashes(polycubes: NDArray[Any], hashes: list[str]) -> NDArray[Any]:
    """Returns the bodies (n, X, Y, Z) of a population, after checking the hashes of the first
    bodies: they show whether the axes have the expected order. Each check takes 0.1 ms."""
    if polycubes.ndim != 4 or len(polycubes) != len(hashes):
        raise BodyError(f"robots/polycubes has the shape {polycubes.shape}, but there are "
                        f"{len(hashes)} hashes")
    for place, (polycube, stored) in enumerate(zip(polycubes[:100], hashes)):
        if _hash(polycube) != stored:
            raise BodyError(f"body {place} does not match its hash in robots/pc_hashes: the file "
                            "has a different format")
    return polycubes


def _hash(polycube: NDArray[Any]) -> str:
    """Returns the authors' name of a form. Of the images under rotations about z and reflections,
    cropped to the body, it takes the one whose voxels come first, and hashes its sides and
    voxels."""
    cells = np.argwhere(polycube == 1)
    if not cells.size:
        raise BodyError("a body in the population is empty")
    low, high = cells.min(axis=0), cells.max(axis=0) + 1
    cut = (polycube == 1)[low[0]:high[0], low[1]:high[1], low[2]:high[2]].astype(np.uint8)
    mirrored = (cut, cut[::-1], cut[:, ::-1])
    images = [np.rot90(image, -turns) for image in mirrored for turns in range(4)]  # in this order
    first = min(images, key=lambda image: image.tobytes())
    sides = np.array(first.shape, dtype="<i8").tobytes()
    return hashlib.sha256(sides + first.tobytes()).hexdigest()
