"""Bodies: voxel robots in the workspace of 6 × 6 × 4 voxels.

Anything that people keep bodies in becomes a `Body`: boolean arrays, arrays of materials (EvoGym,
voxcraft), lists of cells, genotypes and ids. morphod has one material, so other materials become
that one; `Body.lost` tells what a conversion left out.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, Union

import numpy as np

from .errors import BodyError

if TYPE_CHECKING:
    from numpy.typing import NDArray

WORKSPACE = (6, 6, 4)
"""Voxels of the workspace along x, y and z."""

VOXEL_M = 0.1
"""Side of a voxel in meters."""

_AXES = "xyz"
_VOXELS = 144

BodyLike = Union["Body", str, Mapping[str, Any], "NDArray[Any]", Sequence[Any]]
"""What stands for a body; see `Body.of`."""

Repair = Literal["largest"]
"""How a body that is not in one piece is repaired: its largest piece stays."""

OnFault = Literal["refuse", "skip"]
"""What something that is no body does to the others: they are refused, or it is left out."""

_EMPTY = "a body needs at least one voxel, and this one has none"


@dataclasses.dataclass(frozen=True, eq=False)
class Body:
    """A body in the workspace.

    `voxels` is a boolean array of the shape (6, 6, 4) with indices [x, y, z], z upwards. `lost` has
    a sentence for each thing that the conversion from another format could not keep.
    """

    voxels: NDArray[np.bool_]
    lost: tuple[str, ...] = ()

    @classmethod
    def of(cls, body: BodyLike, repair: Repair | None = None) -> Body:
        """The body that a value stands for.

        - a NumPy array of 3 dimensions: voxels [x, y, z], nonzero where there is one. It may be
          smaller than the workspace, and larger if what is outside is empty.
        - a NumPy array of 2 dimensions: a body of EvoGym, rows of materials from the top. It gets a
          depth of two voxels, as in the dashboard.
        - a list of cells `[[x, y, z], …]`, or one of the service's `{"cells": …}`, `{"voxels": …}`
          and `{"id": …}`
        - a text: a genotype of 144 digits, or an id of 36 hexadecimal digits; the letters g and d
          that CSV puts in front are taken off.

        `repair="largest"` keeps the largest piece of a body that is not in one piece, and says so
        in `lost`. Raises `BodyError`, which names the axis or the place at fault.
        """
        made = _convert(body)
        if not made.voxels.any():
            raise BodyError(_EMPTY)
        if repair is None:
            return made
        if repair != "largest":
            raise BodyError(f'repair is "largest" or None, not {repair!r}')
        kept = largest_pieces(made.voxels[np.newaxis])[0]
        return cls(kept, made.lost + dropped(int(made.voxels.sum() - kept.sum())))

    @property
    def genotype(self) -> str:
        """144 digits, one per voxel, index (x·6 + y)·4 + z."""
        return genotypes_of(self.voxels[np.newaxis])[0]

    @property
    def cells(self) -> list[tuple[int, int, int]]:
        """The voxels as (x, y, z)."""
        return [(int(x), int(y), int(z)) for x, y, z in np.argwhere(self.voxels)]

    def __len__(self) -> int:
        """Number of voxels."""
        return int(self.voxels.sum())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Body) and bool((self.voxels == other.voxels).all())

    def __hash__(self) -> int:
        return hash(self.voxels.tobytes())

    def __repr__(self) -> str:
        lost = f", lost={list(self.lost)!r}" if self.lost else ""
        return f"Body(cells={self.cells!r}{lost})"

    def footprint(self) -> int:
        """Columns (x, y) that hold a voxel."""
        return int(self.voxels.any(axis=2).sum())


def dropped(voxels: int) -> tuple[str, ...]:
    """What a repair adds to `lost`."""
    return (f"{voxels} voxels that did not belong to the largest piece", ) if voxels else ()


def genotypes_of(voxels: NDArray[np.bool_]) -> list[str]:
    """The genotypes of an array of bodies of the shape (n, 6, 6, 4)."""
    digits = (voxels.reshape(len(voxels), _VOXELS).astype(np.uint8) + ord("0")).tobytes()
    text = digits.decode("ascii")
    return [text[at:at + _VOXELS] for at in range(0, len(text), _VOXELS)]


def largest_pieces(voxels: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The largest piece of each of n bodies (n, 6, 6, 4): voxels that are joined through faces. Of
    pieces of one size the one with the voxel of the lowest index stays, as the service does it."""
    places = np.arange(_VOXELS, 0, -1, dtype=np.uint8).reshape(WORKSPACE)
    label = np.where(voxels, places, np.uint8(0))
    left = np.arange(len(voxels))  # bodies whose labels still spread
    while left.size:
        before = label[left]
        after = before.copy()
        for axis in (1, 2, 3):
            near, here = np.moveaxis(after, axis, 0), np.moveaxis(before, axis, 0)
            np.maximum(near[1:], here[:-1], out=near[1:])
            np.maximum(near[:-1], here[1:], out=near[:-1])
        after *= voxels[left]
        label[left] = after
        left = left[(after != before).any(axis=(1, 2, 3))]
    flat = label.reshape(len(voxels), _VOXELS)
    row = np.arange(len(voxels))[:, np.newaxis] * (_VOXELS + 1)
    sizes = np.bincount((row + flat).ravel(), minlength=len(voxels) * (_VOXELS + 1))
    sizes = sizes.reshape(len(voxels), _VOXELS + 1)
    sizes[:, 0] = 0
    # The last of the largest: argmax finds the first.
    best = _VOXELS - np.argmax(sizes[:, ::-1], axis=1)
    largest: NDArray[np.bool_] = (flat == best[:, np.newaxis]).reshape(voxels.shape) & voxels
    return largest


def requests_of(bodies: Iterable[BodyLike] | NDArray[Any], on_fault: OnFault = "refuse"
                ) -> tuple[list[dict[str, str]], list[tuple[str, ...]], dict[int, str]]:
    """Bodies as designs of a request, for each what its conversion lost, and what is wrong with
    those that have to be skipped, by place.

    An array of the shape (n, 6, 6, 4) is converted as a whole. Raises `BodyError`, which names the
    place of the body, unless it is to be skipped.
    """
    if isinstance(bodies, np.ndarray) and bodies.ndim == 4 and bodies.shape[1:] == WORKSPACE:
        voxels = bodies != 0
        empty = np.flatnonzero(~voxels.reshape(len(voxels), -1).any(axis=1))
        if empty.size and on_fault != "skip":
            raise BodyError(f"body {empty[0]}: {_EMPTY}")
        designs = [{"voxels": genotype} for genotype in genotypes_of(voxels)]
        return designs, [_materials(bodies)] * len(bodies), {}
    if isinstance(bodies, (str, Mapping, Body)):
        raise BodyError("a list of bodies is expected: put this one in brackets")
    designs = []
    lost: list[tuple[str, ...]] = []
    faults: dict[int, str] = {}
    for place, body in enumerate(bodies):
        if isinstance(body, str) and _is_id(body):
            designs.append({"id": body})
            lost.append(())
            continue
        try:
            made = Body.of(body)
        except BodyError as error:
            if on_fault != "skip":
                raise BodyError(f"body {place}: {error}") from None
            faults[place] = str(error)
            made = Body(np.zeros(WORKSPACE, dtype=np.bool_))  # which the service skips
        designs.append({"voxels": made.genotype})
        lost.append(made.lost)
    return designs, lost, faults


def voxels_of(genotypes: Iterable[str | None]) -> NDArray[np.bool_]:
    """The array of bodies of the shape (n, 6, 6, 4) of genotypes; None gives an empty one."""
    digits = "".join(genotype or "0" * _VOXELS for genotype in genotypes).encode()
    voxels: NDArray[np.bool_] = np.frombuffer(digits, dtype=np.uint8) == ord("1")
    return voxels.reshape(-1, *WORKSPACE)


def _is_id(text: str) -> bool:
    digits = text[1:] if text[:1] == "d" and len(text) == 37 else text
    return len(digits) == 36 and all(digit in "0123456789abcdefABCDEF" for digit in digits)


def _convert(body: BodyLike) -> Body:
    if isinstance(body, Body):
        return body
    if isinstance(body, str):
        return Body(_from_text(body))
    if isinstance(body, Mapping):
        return _from_mapping(body)
    if isinstance(body, np.ndarray):
        if body.ndim == 3:
            return Body(_fitted(body != 0), _materials(body))
        if body.ndim == 2:
            return _from_evogym(body)
        raise BodyError(f"an array of a body has 3 dimensions, or 2 for EvoGym, not {body.ndim}")
    if isinstance(body, Sequence):
        return Body(_from_cells(body))
    raise BodyError(f"{type(body).__name__} is not a body: give an array, a list of cells, a "
                    "genotype or an id")


def _from_text(text: str) -> NDArray[np.bool_]:
    if _is_id(text):
        packed = np.frombuffer(bytes.fromhex(text[-36:]), dtype=np.uint8)
        return np.unpackbits(packed).astype(np.bool_).reshape(WORKSPACE)
    digits = text[1:] if text[:1] == "g" else text
    if len(digits) != _VOXELS or set(digits) - {"0", "1"}:
        raise BodyError(f"a text of {len(text)} characters is neither a genotype (144 digits 0 or "
                        "1) nor an id (36 hexadecimal digits)")
    voxels: NDArray[np.bool_] = voxels_of([digits])[0]
    return voxels


def _from_mapping(body: Mapping[str, Any]) -> Body:
    kinds = set(body) & {"cells", "voxels", "id"}
    if len(kinds) != 1:
        raise BodyError('an object of a body has one of "cells", "voxels" and "id"')
    value = body[kinds.pop()]
    return Body(_from_text(value) if isinstance(value, str) else _from_cells(value))


def _from_cells(cells: Sequence[Any]) -> NDArray[np.bool_]:
    voxels = np.zeros(WORKSPACE, dtype=np.bool_)
    for place, cell in enumerate(cells):
        if not isinstance(cell, (Sequence, np.ndarray)) or len(cell) != 3:
            raise BodyError(f"cell {place} is not [x, y, z]: {cell!r}")
        for axis, (at, side) in enumerate(zip(cell, WORKSPACE)):
            if not 0 <= at < side or at != int(at):
                raise BodyError(f"cell {place} has {_AXES[axis]} = {at}; the workspace has 0 to "
                                f"{side - 1}")
        x, y, z = (int(at) for at in cell)
        voxels[x, y, z] = True
    return voxels


def _fitted(voxels: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The voxels in an array of the workspace; empty margins are cut where they must be."""
    for axis, side in enumerate(WORKSPACE):
        if voxels.shape[axis] <= side:
            continue
        used = np.flatnonzero(voxels.any(axis=tuple(other for other in range(3) if other != axis)))
        first, last = (int(used[0]), int(used[-1])) if used.size else (0, 0)
        if last - first >= side:
            raise BodyError(f"the body is {last - first + 1} voxels long on axis {axis} "
                            f"({_AXES[axis]}); the workspace has {side}")
        voxels = np.take(voxels, range(first, last + 1), axis=axis)
    fitted = np.zeros(WORKSPACE, dtype=np.bool_)
    fitted[tuple(slice(side) for side in voxels.shape)] = voxels
    return fitted


def _from_evogym(rows: NDArray[Any]) -> Body:
    upright = (rows[::-1] != 0).T  # [x, z]
    if upright.shape[1] > WORKSPACE[2]:
        used = np.flatnonzero(upright.any(axis=0))
        if used.size and used[-1] - used[0] >= WORKSPACE[2]:
            raise BodyError(f"the EvoGym body is {used[-1] - used[0] + 1} voxels high (axis 0 of "
                            f"the array); the workspace has {WORKSPACE[2]} along z")
    deep = np.zeros((upright.shape[0], 4, upright.shape[1]), dtype=np.bool_)
    deep[:, 2:4] = upright[:, np.newaxis]
    return Body(_fitted(deep), _materials(rows))


def _materials(values: NDArray[Any]) -> tuple[str, ...]:
    if values.dtype == np.bool_:
        return ()
    kinds = [value for value in np.unique(values).tolist() if value != 0]
    if len(kinds) < 2:
        return ()
    return (f"materials {', '.join(str(kind) for kind in kinds)} became one",)
