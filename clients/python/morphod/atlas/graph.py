"""All bodies of an atlas as a graph: neighbors by adding and removing a voxel, and the basins of
its local optima."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Protocol

import numpy as np

from .forms import stays_whole

if TYPE_CHECKING:
    from numpy.typing import NDArray

_CHUNK = 1 << 15  # bodies whose changes are in memory at one time


class Bodies(Protocol):
    """The parts of an atlas that are used here."""

    @property
    def voxels_max(self) -> int: ...

    def __len__(self) -> int: ...

    def positions(self, voxels: int | None = None) -> range: ...

    def cells_of(self, positions: NDArray[np.int64], voxels: int) -> NDArray[np.int16]: ...

    def find_cells(self, cells: NDArray[np.int16]) -> NDArray[np.int64]: ...


@dataclasses.dataclass(frozen=True, eq=False)
class Steps:
    """Pairs of neighbors by adding and removing a voxel, each once: the positions of the body with
    more voxels and of the one with fewer."""

    larger: NDArray[np.uint32]
    smaller: NDArray[np.uint32]

    def __len__(self) -> int:
        return len(self.larger)


@dataclasses.dataclass(frozen=True, eq=False)
class Basins:
    """By position: `optimum` is the local optimum that steepest ascent ends at, `steps` the number
    of steps to it, and `size` the number of bodies whose ascent ends here, 0 if it is no local
    optimum."""

    optimum: NDArray[np.int64]
    steps: NDArray[np.int64]
    size: NDArray[np.int64]

    @property
    def is_optimum(self) -> NDArray[np.bool_]:
        is_optimum: NDArray[np.bool_] = self.size > 0
        return is_optimum


def steps_of(bodies: Bodies) -> Steps:
    """Finds all pairs, from their larger bodies, which have few voxels to remove."""
    found: list[NDArray[np.uint64]] = []
    for n in range(2, bodies.voxels_max + 1):
        span = bodies.positions(n)
        for begin in range(span.start, span.stop, _CHUNK):
            positions = np.arange(begin, min(begin + _CHUNK, span.stop))
            cells = bodies.cells_of(positions, n)
            body, gone = np.nonzero(stays_whole(cells))
            rest = np.broadcast_to(np.arange(n), (len(body), n))
            rest = rest[rest != gone[:, np.newaxis]].reshape(-1, n - 1)
            smaller = bodies.find_cells(cells[body[:, np.newaxis], rest])
            pairs = positions[body].astype(np.uint64) << np.uint64(32) | smaller.astype(np.uint64)
            found.append(np.unique(pairs[smaller >= 0]))
    pairs = np.concatenate(found) if found else np.empty(0, dtype=np.uint64)
    return Steps((pairs >> np.uint64(32)).astype(np.uint32), pairs.astype(np.uint32))


def basins_of(steps: Steps, scores: NDArray[np.float32], order: NDArray[np.int64]) -> Basins:
    """order: all positions, the best first."""
    n = len(scores)
    place = np.empty(n, dtype=np.int64)
    place[order] = np.arange(n)
    best = np.full(n, n, dtype=np.int64)  # the place of the best neighbor
    np.minimum.at(best, steps.larger, place[steps.smaller])
    np.minimum.at(best, steps.smaller, place[steps.larger])
    here = np.arange(n)
    neighbor = np.where(best < n, order[np.minimum(best, n - 1)], here)
    optimum = np.where(scores[neighbor] < scores, neighbor, here)
    walked = (optimum != here).astype(np.int64)
    # Each round doubles the steps that are known.
    while (optimum[optimum] != optimum).any():
        walked = walked + walked[optimum]
        optimum = optimum[optimum]
    return Basins(optimum, walked, np.bincount(optimum, minlength=n))
