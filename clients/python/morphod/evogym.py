"""EvoGym robots: rows of materials from the top, with the connections of their voxels; and EvoGym
worlds, JSON files with robots and their surroundings."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .arrays import first, materials, numbers
from .errors import BodyError, counted

if TYPE_CHECKING:
    from numpy.typing import NDArray

ACTUATORS = (3, 4)  # materials
FIXED = 5  # the material of ground and walls
_SIDE_MAX = 1000  # maximum side of an object; a robot is smaller


def is_pair(body: Any) -> bool:
    """Returns whether this is a pair (body, connections), as returned by EvoGym's `sample_robot`:
    nested three levels deep."""
    many = (list, tuple, np.ndarray)
    return isinstance(body, (list, tuple)) and len(body) == 2 and isinstance(body[0], many) and (
        len(body[0]) > 0 and isinstance(body[0][0], many))


def rows_of(body: Any) -> NDArray[Any]:
    """Returns the materials of a robot as an array [row, column]: integers, or booleans."""
    if not isinstance(body, np.ndarray):
        if not isinstance(body, Sequence) or isinstance(body, (str, bytes)):
            raise BodyError(f"{type(body).__name__} is not an EvoGym robot: give rows of "
                            "materials, from the top")
        try:
            body = np.array(body)
        except ValueError:
            raise BodyError("the rows of an EvoGym robot have different lengths") from None
    rows = numbers(body)
    if rows.ndim != 2:
        raise BodyError(f"an EvoGym robot has 2 dimensions [row, column], not {rows.ndim}")
    if rows.dtype.kind == "b":
        return rows
    wrong = ~((rows >= 0) & (rows <= FIXED))  # also for NaN
    if rows.dtype.kind == "f":
        wrong |= rows != np.floor(rows)
    if wrong.any():
        raise BodyError(f"{first(rows, wrong)}: EvoGym materials are 0 (empty) to "
                        f"{FIXED} (fixed)")
    return rows.astype(np.int64)


def upright(rows: NDArray[Any]) -> NDArray[np.bool_]:
    """Returns the voxels [x, y, z] of a robot, which gets a depth of two voxels."""
    plane = (rows[::-1] != 0).T  # [x, z]
    deep = np.zeros((plane.shape[0], 4, plane.shape[1]), dtype=np.bool_)
    deep[:, 2:4] = plane[:, np.newaxis]
    return deep


def lost_of(rows: NDArray[Any], connections: Any = None) -> tuple[str, ...]:
    """Returns what a robot loses: its materials, and where adjacent voxels are not connected."""
    lost = () if rows.dtype.kind == "b" else materials(rows)
    if connections is None:
        return lost
    try:
        pairs = np.asarray(connections)
    except ValueError:
        pairs = np.empty(0)  # of different lengths
    if pairs.ndim != 2 or pairs.shape[0] != 2 or pairs.dtype.kind not in "iuf":
        raise BodyError("connections must have the shape (2, n), not "
                        f"{pairs.shape}: pairs of indices into the flat body, from 0")
    if pairs.size and ((pairs != np.floor(pairs)) | (pairs < 0) | (pairs >= rows.size)).any():
        raise BodyError(f"connections must be indices from 0 to {rows.size - 1}")
    joined = {frozenset(pair) for pair in pairs.astype(np.int64).T.tolist()}
    touching = _touching(rows)
    if not joined <= touching:
        pair = sorted(min(joined - touching, key=sorted))
        raise BodyError(f"connections join the indices {pair[0]} and {pair[-1]}, which are not "
                        "adjacent voxels of this body")
    return lost + _apart(len(touching - joined))


def _touching(rows: NDArray[Any]) -> set[frozenset[int]]:
    """Returns the pairs of adjacent voxels, by their positions in the flat array."""
    places = np.arange(rows.size).reshape(rows.shape)
    there = rows != 0
    right, down = there[:, 1:] & there[:, :-1], there[1:] & there[:-1]
    return {frozenset(pair) for one, other in
            ((places[:, :-1][right], places[:, 1:][right]), (places[:-1][down], places[1:][down]))
            for pair in zip(one.tolist(), other.tolist())}


def _apart(n: int) -> tuple[str, ...]:
    if n == 0:
        return ()
    was, is_now = ("was", "is") if n == 1 else ("were", "are")
    return (f"{counted(n, 'pair')} of adjacent voxels that {was} not connected {is_now} now "
            "connected",)


# ---- worlds: voxels by index in a grid; its rows go upward ----


class Thing:
    """An object in a world."""

    def __init__(self, width: int, data: Mapping[str, Any]) -> None:
        indices = _whole(data["indices"], "indices")
        types = _whole(data["types"], "types")
        if len(indices) != len(types) or not len(indices):
            raise ValueError("indices and types of an object do not match")
        if indices.min() < 0 or len(np.unique(indices)) != len(indices):
            raise ValueError("an index is negative or duplicate")
        z, x = np.divmod(indices, width)
        self.place = (int(x.min()), int(z.min()))
        """Its first column, and its lowest row from the bottom."""
        z, x = z - z.min(), x - x.min()
        if max(z.max(), x.max()) >= _SIDE_MAX:
            raise ValueError("an object is too large")
        grid = np.zeros((z.max() + 1, x.max() + 1), dtype=np.int64)
        grid[z, x] = types
        self.rows = rows_of(grid[::-1])
        """Materials from the top, like EvoGym's arrays."""
        self.is_fixed = set(types.tolist()) - {0} == {FIXED}
        self.lost = _apart(self._unjoined(indices, x, z, data))

    def has(self, *kinds: int) -> bool:
        """Returns whether it has one of these materials."""
        return bool(np.isin(self.rows, kinds).any())

    def _unjoined(self, indices: NDArray[np.int64], x: NDArray[np.int64], z: NDArray[np.int64],
                  data: Mapping[str, Any]) -> int:
        """Pairs of adjacent voxels that `neighbors` does not connect; a file without it connects
        all."""
        neighbors = data.get("neighbors")
        if not neighbors:
            return 0
        height, width = self.rows.shape
        place_of = dict(zip(indices.tolist(), ((height - 1 - z) * width + x).tolist()))
        joined = {frozenset((place_of.get(int(one), -1), place_of.get(int(other), -1)))
                  for one, others in neighbors.items() for other in others}
        return len(_touching(self.rows) - joined)


def things(world: Any) -> dict[str, Thing]:
    """Returns the objects of a world by name."""
    if not isinstance(world, Mapping) or not {"grid_width", "objects"} <= set(world):
        raise BodyError("this JSON is not an EvoGym world: it has no grid_width and objects")
    try:
        width = int(_whole([world["grid_width"]], "grid_width")[0])
        if width < 1:
            raise ValueError("grid_width is not positive")
        return {name: Thing(width, data) for name, data in dict(world["objects"]).items()}
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        raise BodyError(f"this JSON is not an EvoGym world: {error}") from None


def _whole(values: Iterable[Any], what: str) -> NDArray[np.int64]:
    """Returns whole numbers from a file."""
    values = list(values)
    if any(isinstance(value, bool) or not isinstance(value, (int, float)) or value != int(value)
           for value in values):
        raise ValueError(f"{what} are not whole numbers")
    return np.array([int(value) for value in values], dtype=np.int64)
