"""Bodies: voxel robots in the workspace of 6 × 6 × 4 voxels.

Arrays of booleans or materials, lists of cells, genotypes, ids and EvoGym robots become a `Body`.
Ambiguous input is refused. morphod has only one material, so all materials are merged into it;
`Body.lost` says what a conversion left out.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, Union

import numpy as np

from .arrays import numbers, occupied
from .errors import BodyError, counted
from .evogym import is_pair, lost_of, rows_of, upright

if TYPE_CHECKING:
    from numpy.typing import NDArray

WORKSPACE = (6, 6, 4)
"""Voxels of the workspace along x, y and z."""

VOXEL_M = 0.1
"""Side of a voxel in meters."""

_AXES = "xyz"
_VOXELS = 144
_MATERIAL_MAX = 4  # for an EvoGym robot

BodyLike = Union["Body", str, Mapping[str, Any], "NDArray[Any]", Sequence[Any]]
"""Anything that can be passed as a body; see `Body.of`."""

Repair = Literal["largest"]
"""How a body that is not in one piece is repaired: by keeping its largest piece."""

OnFault = Literal["refuse", "skip"]
"""The effect of an invalid body in a list: all are refused, or it is skipped."""

_EMPTY = "a body needs at least one voxel, but this one is empty"
_BRACKETS = "expected a list of bodies: put this one in brackets"
_TWO_WAYS = ('Body.evogym(it) reads EvoGym rows, and {"cells": it} reads cells [x, y, z]')


@dataclasses.dataclass(frozen=True, eq=False)
class Body:
    """A body in the workspace.

    `voxels` is a boolean array of shape (6, 6, 4) with indices [x, y, z], where z points up. `lost`
    has a sentence for each thing that the conversion from another format could not keep. `name` is
    the body's name in the file that it was read from.
    """

    voxels: NDArray[np.bool_]
    lost: tuple[str, ...] = ()
    name: str | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.voxels, np.ndarray) or self.voxels.shape != WORKSPACE or (
                self.voxels.dtype != np.bool_):
            raise BodyError(f"Body(voxels) takes a boolean array of shape {WORKSPACE}; "
                            "Body.of reads other forms")

    @classmethod
    def of(cls, body: BodyLike, repair: Repair | None = None) -> Body:
        """Converts a value to a body.

        - a NumPy array of 3 dimensions: voxels [x, y, z]. Booleans, materials (integers, 0 is
          empty), or floats that are exactly 0 or 1; for a density give `density > 0.5`. It may be
          smaller than the workspace, and larger if what is outside is empty.
        - a list of cells `[[x, y, z], …]`, or one of the service's `{"cells": …}`, `{"voxels": …}`
          and `{"id": …}`. In `{"cells": …}` the cells can be an array (n, 3), as returned by
          `np.argwhere`.
        - a text: a genotype of 144 digits, a robot as in `Result.robot` (ID@K: an id and an
          orientation), or an id of 36 hexadecimal digits, which becomes the body in its canonical
          orientation; the prefixes g and d that CSV files have are removed.

        Only `Body.evogym` reads EvoGym robots. Arrays with 2 dimensions, and lists of rows that
        could be either cells or a robot, are refused.

        `repair="largest"` keeps the largest piece of a body that is not in one piece, and says so
        in `lost`. Raises `BodyError`, which reports the axis or the position of the fault.
        """
        return cls._kept(_convert(body), repair)

    @classmethod
    def evogym(cls, body: Any, connections: Any = None, *, repair: Repair | None = None) -> Body:
        """Returns the body of an EvoGym robot: rows of materials 0 to 5, from the top. It gets a
        depth of two voxels, as in the dashboard.

        `connections` are its pairs of connected voxels, as EvoGym stores them; without them all
        adjacent voxels are connected. `Body.evogym(sample_robot((4, 4)))` accepts both as a pair.
        `lost` lists the materials, and reports voxels that are connected now but were not in
        EvoGym.
        """
        if connections is None and is_pair(body):
            body, connections = body
        rows = rows_of(body)
        made = Body(_fitted(upright(_lowered(rows))), lost_of(rows, connections))
        return cls._kept(made, repair)

    @classmethod
    def _kept(cls, made: Body, repair: Repair | None) -> Body:
        """Returns the body, or its largest piece."""
        if not made.voxels.any():
            raise BodyError(_EMPTY)
        if repair is None:
            return made
        if repair != "largest":
            raise BodyError(f'repair must be "largest" or None, not {repair!r}')
        kept = largest_pieces(made.voxels[np.newaxis])[0]
        return cls(kept, made.lost + dropped(int(made.voxels.sum() - kept.sum())), made.name)

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
        name = f", name={self.name!r}" if self.name else ""
        lost = f", lost={list(self.lost)!r}" if self.lost else ""
        return f"Body(cells={self.cells!r}{name}{lost})"

    def footprint(self) -> int:
        """Columns (x, y) that contain a voxel."""
        return int(self.voxels.any(axis=2).sum())


def dropped(voxels: int) -> tuple[str, ...]:
    """Returns what a repair adds to `lost`."""
    if voxels == 0:
        return ()
    were = "was" if voxels == 1 else "were"
    return (f"{counted(voxels, 'voxel')} that {were} not part of the largest piece", )


def genotypes_of(voxels: NDArray[np.bool_]) -> list[str]:
    """Returns the genotypes of an array of bodies of shape (n, 6, 6, 4)."""
    digits = (voxels.reshape(len(voxels), _VOXELS).astype(np.uint8) + ord("0")).tobytes()
    text = digits.decode("ascii")
    return [text[at:at + _VOXELS] for at in range(0, len(text), _VOXELS)]


def packed(designs: list[dict[str, str]]) -> list[dict[str, str]]:
    """Returns the same designs with four voxels per hexadecimal digit, the format of long lists."""
    return [{"voxels": f"{int(design['voxels'].lstrip('g'), 2):036x}"}
            if "voxels" in design else design for design in designs]


def largest_pieces(voxels: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Returns the largest piece of each of n bodies (n, 6, 6, 4): voxels that are connected through
    faces. Of pieces of equal size, the one with the lowest voxel index stays, as in the service."""
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
    """Returns bodies as designs of a request, what each conversion lost, and the faults of the
    bodies to be skipped, by position.

    Raises `BodyError`, which reports the position of the body, unless it is to be skipped.
    """
    whole = _whole_array(bodies)
    if whole is not None:
        empty = np.flatnonzero(~whole.any(axis=(1, 2, 3)))
        if empty.size and on_fault != "skip":
            raise BodyError(f"body {empty[0]}: {_EMPTY}")
        return [{"voxels": genotype} for genotype in genotypes_of(whole)], [()] * len(whole), {}
    designs = []
    lost: list[tuple[str, ...]] = []
    faults: dict[int, str] = {}
    for place, body in enumerate(_listed(bodies)):
        try:
            design, made = _design(body)
        except BodyError as error:
            if on_fault != "skip":
                raise BodyError(f"body {place}: {error}") from None
            faults[place] = str(error)
            design, made = {"voxels": "0" * _VOXELS}, ()  # which the service skips
        designs.append(design)
        lost.append(made)
    return designs, lost, faults


def designs_of(bodies: Iterable[BodyLike] | NDArray[Any], on_fault: OnFault = "refuse"
               ) -> list[dict[str, str]]:
    """Returns bodies as designs of a request whose result has no place for what a conversion lost,
    or for why a body could not be read. Both become warnings, unless the caller's `Body` already
    says what was lost, or the service notes that a body is empty."""
    given = bodies if isinstance(bodies, np.ndarray) else list(_listed(bodies))
    designs, lost, faults = requests_of(given, on_fault)
    _warn("", {place: "; ".join(sentences) for place, sentences in enumerate(lost)
               if sentences and not isinstance(given[place], Body)})
    _warn("skipped, ", {place: fault for place, fault in faults.items() if fault != _EMPTY})
    return designs


def warn_of_lost(lost: Sequence[tuple[str, ...]]) -> None:
    """Warns about what conversions lost, if no result has a place for it."""
    _warn("", {place: "; ".join(sentences) for place, sentences in enumerate(lost) if sentences})


def _warn(kind: str, said: Mapping[int, str]) -> None:
    if said:
        place, text = next(iter(said.items()))
        more = f" (and {len(said) - 1} more bodies)" if len(said) > 1 else ""
        warnings.warn(f"body {place}: {kind}{text}{more}", stacklevel=4)


def warn_of_ids(notes: Iterable[Mapping[str, Any]]) -> None:
    """Warns about designs of a request that were given by an id without an orientation, if no
    result says which orientation was used. `notes` are those of the reply."""
    why = {"best": "its best stored score of all orientations",
           "canonical": "the canonical orientation, because none has a stored score"}
    taken = [note for note in notes if note["orientation"] is not None]
    if taken:
        first = taken[0]
        more = f" (and {len(taken) - 1} more)" if len(taken) > 1 else ""
        warnings.warn(f"body {first['place']} was given by an id without an orientation: "
                      f"using {first['robot']}, {why[first['orientation']]}{more}", stacklevel=3)


def _whole_array(bodies: Any) -> NDArray[np.bool_] | None:
    """Returns an array (n, 6, 6, 4) of zeros and ones, which is the fastest to read, or None if it
    is a different array or not an array."""
    if not isinstance(bodies, np.ndarray) or isinstance(bodies, np.ma.MaskedArray) or (
            bodies.ndim != 4 or bodies.shape[1:] != WORKSPACE or bodies.dtype.kind not in "biuf"):
        return None
    voxels: NDArray[np.bool_] = bodies == 1
    return voxels if bool((voxels | (bodies == 0)).all()) else None


def _listed(bodies: Any) -> Iterable[Any]:
    """Yields the bodies one by one. Raises `BodyError` for a single body, or for something without
    order."""
    if isinstance(bodies, (str, bytes, Mapping, Body)):
        raise BodyError(_BRACKETS)
    if isinstance(bodies, (set, frozenset)):
        raise BodyError("a set of bodies has no order: give a list")
    dimensions = getattr(bodies, "ndim", None)
    if isinstance(bodies, np.ndarray):
        if dimensions == 3:
            raise BodyError(_BRACKETS)
        if dimensions != 4 and (dimensions != 1 or bodies.dtype.kind not in "OU"):
            raise BodyError(f"an array of bodies must have the shape (n, 6, 6, 4), not "
                            f"{bodies.shape}" + (
                f"; for one body, {_TWO_WAYS}" if dimensions == 2 else ": reshape it"))
    elif isinstance(bodies, memoryview):
        raise BodyError("memoryview is not a list of bodies: give a NumPy array, as from "
                        "np.asarray(it)")
    elif dimensions == 2:
        raise BodyError("a table is not a list of bodies: give its genotype column, such as "
                        'table["genotype"]')
    if isinstance(bodies, (list, tuple)) and bodies and all(map(_is_cell, bodies)):
        raise BodyError(_BRACKETS)
    if not isinstance(bodies, Iterable):
        raise BodyError(f"{type(bodies).__name__} is not a list of bodies")
    return bodies


def _is_triple(value: Any) -> bool:
    is_flat = value.ndim == 1 if isinstance(value, np.ndarray) else (
        isinstance(value, Sequence) and not isinstance(value, (str, bytes, memoryview)))
    return is_flat and len(value) == 3


def _is_cell(value: Any) -> bool:
    return _is_triple(value) and all(map(_is_integer, value))


def _design(body: Any) -> tuple[dict[str, str], tuple[str, ...]]:
    """Returns a body as a design of a request, and what its conversion lost. Ids stay ids, which
    the service checks."""
    if isinstance(body, str) and _is_id(body):
        return {"id": body}, ()
    if isinstance(body, Mapping) and "id" in body:
        Body.of(body)
        return {"id": body["id"]}, ()
    made = Body.of(body)
    return {"voxels": made.genotype}, made.lost


def voxels_of(genotypes: Iterable[str | None]) -> NDArray[np.bool_]:
    """Returns the array of bodies of shape (n, 6, 6, 4) for genotypes; None becomes an empty
    one."""
    digits = "".join(genotype or "0" * _VOXELS for genotype in genotypes).encode()
    voxels: NDArray[np.bool_] = np.frombuffer(digits, dtype=np.uint8) == ord("1")
    return voxels.reshape(-1, *WORKSPACE)


def _is_id(text: str) -> bool:
    """Returns whether a text is an id, with or without an orientation: ID@K."""
    digits, at, k = text.partition("@")
    digits = digits[1:] if digits[:1] == "d" and len(digits) == 37 else digits
    return (len(digits) == 36 and all(digit in "0123456789abcdefABCDEF" for digit in digits) and
            (not at or k in tuple("01234567")))


def _of_id(text: str) -> NDArray[np.bool_]:
    """Returns the voxels of ID@K, image K of the canonical form in a corner; for an id, that
    form."""
    digits, _, k = text.partition("@")
    packed = np.frombuffer(bytes.fromhex(digits[-36:]), dtype=np.uint8)
    form = np.unpackbits(packed).astype(np.bool_).reshape(WORKSPACE)
    if not form.any():
        return form
    x, y = (np.flatnonzero(form.any(axis=axes)) for axes in ((1, 2), (0, 2)))
    image = form[x[0]:x[-1] + 1, y[0]:y[-1] + 1]
    turns = int(k or "0")
    if turns & 4:
        image = image.swapaxes(0, 1)
    image = image[::-1 if turns & 1 else 1, ::-1 if turns & 2 else 1]
    voxels = np.zeros(WORKSPACE, dtype=np.bool_)
    voxels[:image.shape[0], :image.shape[1]] = image
    return voxels


def _convert(body: BodyLike) -> Body:
    if isinstance(body, Body):
        return body
    if isinstance(body, str):
        return Body(_from_text(body))
    if isinstance(body, Mapping):
        return _from_mapping(body)
    if isinstance(body, np.ndarray):
        return _from_array(body)
    if isinstance(body, Sequence) and not isinstance(body, (bytes, bytearray, memoryview)):
        return Body(_from_list(body))
    how = ("a NumPy array, as from np.asarray(it)" if getattr(body, "ndim", 0) > 0 else
           "an array, a list of cells, a genotype or an id")
    raise BodyError(f"{type(body).__name__} is not a body: give {how}")


def _from_array(array: NDArray[Any]) -> Body:
    if array.ndim == 4:
        raise BodyError("an array with 4 dimensions has many bodies: pass one of them, such as "
                        "array[0]")
    if array.ndim == 2:
        if array.shape[1] == 3:
            raise BodyError(f"an array with 3 columns is ambiguous: {_TWO_WAYS}")
        raise BodyError("the array of a body has 3 dimensions [x, y, z], not 2; Body.evogym(it) "
                        "reads EvoGym rows")
    if array.shape == (_VOXELS, ):
        raise BodyError(f"the array of a body has 3 dimensions; for {_VOXELS} numbers, give "
                        "array.reshape(6, 6, 4)")
    if array.ndim != 3:
        raise BodyError(f"the array of a body has 3 dimensions [x, y, z], not {array.ndim}")
    if array.shape != WORKSPACE and sorted(array.shape) == sorted(WORKSPACE):
        raise BodyError(f"the shape {array.shape} has the sides of the workspace in a different "
                        f"order; axes are [x, y, z] with the shape {WORKSPACE}: transpose the "
                        "array")
    voxels, lost = occupied(array)
    return Body(_fitted(voxels), lost)


def _from_text(text: str) -> NDArray[np.bool_]:
    if _is_id(text):
        return _of_id(text)
    digits = text[1:] if text[:1] == "g" else text
    if len(digits) != _VOXELS or set(digits) - {"0", "1"}:
        raise BodyError(f"a text of {len(text)} characters is neither a genotype (144 digits 0 or "
                        "1) nor an id (36 hexadecimal digits, optionally with @0 to @7)")
    voxels: NDArray[np.bool_] = voxels_of([digits])[0]
    return voxels


def _from_mapping(body: Mapping[str, Any]) -> Body:
    kinds = set(body) & {"cells", "voxels", "id"}
    others = sorted(map(str, set(body) - {"cells", "voxels", "id", "name", "description"}))
    if len(kinds) != 1 or others:
        raise BodyError('a body object must have exactly one of "cells", "voxels" and "id"' + (
            f", optionally a name, but no {others[0]!r}" if others else ""))
    kind = kinds.pop()
    value = body[kind]
    if kind == "cells":
        return Body(_from_cells(value))
    if not isinstance(value, str) or _is_id(value) != (kind == "id"):
        raise BodyError('"voxels" must be a genotype of 144 digits' if kind == "voxels" else
                        '"id" must be an id of 36 hexadecimal digits, optionally with @0 to @7')
    return Body(_from_text(value))


def _from_list(rows: Sequence[Any]) -> NDArray[np.bool_]:
    """Returns the voxels of a list of cells. It is refused if it is not in one piece and could be
    an EvoGym robot with three columns."""
    if any(isinstance(row, np.ndarray) and row.ndim > 1 for row in rows):
        raise BodyError("a list of arrays is not a body: give one of them; for an EvoGym pair "
                        "(body, connections), give Body.evogym(pair)")
    try:
        voxels = _from_cells(rows)
    except BodyError as error:
        if not _can_be_rows(rows):
            raise
        raise BodyError(f"{error}; Body.evogym(it) reads EvoGym rows") from None
    if _can_be_rows(rows) and (voxels != largest_pieces(voxels[np.newaxis])[0]).any():
        raise BodyError(f"this list is ambiguous: {_TWO_WAYS}")
    return voxels


def _can_be_rows(rows: Sequence[Any]) -> bool:
    """Returns whether rows can be an EvoGym robot: materials up to 4, with at least one in the
    highest row."""
    return len(rows) > 1 and all(map(_is_cell, rows)) and any(rows[0]) and all(
        0 <= material <= _MATERIAL_MAX for row in rows for material in row)


def _is_integer(value: Any) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def _from_cells(cells: Any) -> NDArray[np.bool_]:
    voxels = np.zeros(WORKSPACE, dtype=np.bool_)
    if isinstance(cells, np.ndarray):
        if numbers(cells).dtype.kind not in "iu" or cells.ndim != 2:
            raise BodyError("an array of cells must have the shape (n, 3) and integers")
    elif not isinstance(cells, Sequence) or isinstance(cells, (str, bytes)):
        raise BodyError(f"cells must be a list [[x, y, z], …], not {type(cells).__name__}")
    places: dict[tuple[int, ...], int] = {}
    for place, cell in enumerate(cells):
        if not _is_triple(cell):
            raise BodyError(f"cell {place} is not [x, y, z]: {_short(cell)}; np.array(…) makes "
                            "voxels of nested lists, and Body.evogym(…) reads EvoGym rows")
        for axis, (at, side) in enumerate(zip(cell, WORKSPACE)):
            if not _is_integer(at):
                raise BodyError(f"cell {place} has {_AXES[axis]} = {_short(at)}; a coordinate must "
                                f"be an integer from 0 to {side - 1}")
            if not 0 <= at < side:
                raise BodyError(f"cell {place} has {_AXES[axis]} = {_short(at)}; the workspace has "
                                f"0 to {side - 1}")
        x, y, z = (int(at) for at in cell)
        if voxels[x, y, z]:
            raise BodyError(f"cell {place} is a duplicate of cell {places[x, y, z]}")
        voxels[x, y, z] = True
        places[x, y, z] = place
    return voxels


def _short(value: Any) -> str:
    try:
        text = str(value) if isinstance(value, (float, np.generic)) else repr(value)
    except Exception:  # such as lists nested too deeply
        return f"of type {type(value).__name__}"
    return text if len(text) <= 40 else text[:39] + "…"


def _fitted(voxels: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Returns the voxels in an array of the workspace; empty margins are removed if necessary."""
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


def _lowered(rows: NDArray[Any]) -> NDArray[Any]:
    """Returns the rows of an EvoGym robot, without empty rows if there are too many."""
    used = np.flatnonzero((rows != 0).any(axis=1))
    if rows.shape[0] <= WORKSPACE[2] or not used.size:
        return rows
    height = int(used[-1] - used[0]) + 1
    if height > WORKSPACE[2]:
        raise BodyError(f"the EvoGym body is {height} voxels high (axis 0 of the array); the "
                        f"workspace has {WORKSPACE[2]} along z: leave out rows")
    return rows[used[0]:used[-1] + 1]
