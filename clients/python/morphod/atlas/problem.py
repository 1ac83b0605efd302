"""A benchmark for search: an atlas as a problem with a known optimum."""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from ..bodies import BodyLike
from ..errors import MorphodError
from .reader import Atlas, OutsideError, Where

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

Outside = Literal["infinite", "raise"]
"""The loss of a body outside the atlas: +infinity, or an `OutsideError`."""


class BudgetError(MorphodError):
    """The budget of a problem is exhausted."""


class Measures(NamedTuple):
    """A body's descriptors, for archives of diverse bodies: its voxels, its footprint (columns with
    a voxel) and its height in voxels."""

    voxels: int
    footprint: int
    height: int


class Problem:
    """Find the body with the lowest loss in an atlas.

    Every evaluated body counts, including repeated ones and ones outside the atlas.
    `evaluations` is their number, `distinct` the number of different bodies in the atlas among
    them, and `outside` how many were outside. A body outside (too large, in several pieces, empty)
    has the loss +infinity or, with `outside="raise"`, is an `OutsideError`; it is never repaired.
    `decode` makes a body of the atlas from any vector of numbers.

    `regret` is exact: how much the best loss so far is above the optimum.
    """

    def __init__(self, atlas: Atlas, *, outside: Outside = "infinite",
                 budget: int | None = None) -> None:
        if outside not in ("infinite", "raise"):
            raise ValueError(f'outside must be "infinite" or "raise", not {outside!r}')
        self.atlas = atlas
        self.budget = budget
        self._raises = outside == "raise"
        self.optimum = int(atlas.best(1)[0])
        """Position of the best body."""
        self.optimum_loss = atlas.score(self.optimum)
        nx, ny, nz = atlas.workspace
        self.dimensions = nx * ny * nz
        """How many numbers `decode` takes."""
        voxels = np.arange(self.dimensions).reshape(nx, ny, nz)
        self._near: list[list[int]] = [[] for _ in range(self.dimensions)]
        for axis in range(3):
            below, above = (np.take(voxels, range(first, voxels.shape[axis] - 1 + first), axis)
                            for first in (0, 1))
            for one, other in zip(below.ravel().tolist(), above.ravel().tolist()):
                self._near[one].append(other)
                self._near[other].append(one)
        self.reset()

    def reset(self) -> None:
        """Forgets all evaluations."""
        self.evaluations = 0
        self.outside = 0
        self._seen: set[int] = set()
        self.best: int | None = None
        """Position of the best body so far; None if all were outside."""
        self.best_loss = math.inf
        self.improvements: list[tuple[int, float]] = []
        """The number of evaluations and the best loss at each improvement."""

    # ---- evaluating ----

    def evaluate(self, body: BodyLike) -> float:
        """Returns the loss of a body: anything that `Body.of` accepts."""
        self._spend(1)
        try:
            position = self.atlas.find(body)
        except OutsideError:
            if self._raises:
                raise
            self.outside += 1
            return math.inf
        self._seen.add(position)
        loss = self.atlas.score(position)
        if loss < self.best_loss:
            self._improve(self.evaluations, loss, position)
        return loss

    __call__ = evaluate

    def evaluate_all(self, bodies: NDArray[np.bool_] | Sequence[BodyLike]) -> NDArray[np.float64]:
        """Returns the losses of many bodies, fastest for an array (n, x, y, z) of booleans. With
        `outside="raise"`, the first body outside raises the error, and all count."""
        before = self.evaluations
        self._spend(len(bodies))
        positions = self.atlas.find_all(bodies)
        outside = positions < 0
        if self._raises and outside.any():
            self.atlas.find(bodies[int(np.argmax(outside))])
        self.outside += int(outside.sum())
        self._seen.update(positions[~outside].tolist())
        losses = np.where(outside, np.inf, self.atlas.scores()[positions]).astype(np.float64)
        least = np.minimum.accumulate(np.append(self.best_loss, losses))
        for i in np.flatnonzero(least[1:] < least[:-1]).tolist():
            self._improve(before + i + 1, float(losses[i]), int(positions[i]))
        return losses

    def _spend(self, n: int) -> None:
        if self.budget is not None and self.evaluations + n > self.budget:
            raise BudgetError(f"the budget of {self.budget} evaluations is exhausted: "
                              f"{self.evaluations} were used, and {n} more are requested")
        self.evaluations += n

    def _improve(self, evaluations: int, loss: float, position: int) -> None:
        self.best, self.best_loss = position, loss
        self.improvements.append((evaluations, loss))

    @property
    def distinct(self) -> int:
        """How many bodies of the atlas were evaluated, each counted once."""
        return len(self._seen)

    @property
    def regret(self) -> float:
        """How much the best loss so far is above the optimum; 0 when it is found."""
        return self.best_loss - self.optimum_loss

    def regrets(self, evaluations: ArrayLike) -> NDArray[np.float64]:
        """Returns the regret after each of these numbers of evaluations; +infinity before the first
        body inside."""
        at = [0, *(n for n, _ in self.improvements)]
        losses = np.array([math.inf, *(loss for _, loss in self.improvements)])
        regrets: NDArray[np.float64] = losses[
            np.searchsorted(at, np.asarray(evaluations), side="right") - 1] - self.optimum_loss
        return regrets

    # ---- bodies ----

    def measures(self, where: Where) -> Measures:
        """Returns the measures of a body of the atlas. This does not count as an evaluation."""
        cells = self.atlas.cells(where)
        return Measures(len(cells), len({(x, y) for x, y, _ in cells}),
                        1 + max(z for _, _, z in cells))

    def random(self, rng: np.random.Generator) -> str:
        """Draws a body, each with the same probability: a genotype."""
        return self.atlas.genotype(int(rng.integers(len(self.atlas))))

    def decode(self, values: ArrayLike) -> str:
        """Returns the body of a vector of `dimensions` numbers, one per voxel of the workspace: a
        genotype.

        It grows from the voxel with the largest number. The free voxel with the largest number next
        to it is added while that number is positive and the body has fewer than the most voxels. So
        every vector makes a body of the atlas, and every body can be made from some vector.
        """
        numbers = np.asarray(values, dtype=np.float64).ravel()
        if numbers.shape != (self.dimensions, ) or np.isnan(numbers).any():
            raise ValueError(f"decode takes {self.dimensions} numbers, none of them NaN")
        first = int(numbers.argmax())
        listed = numbers.tolist()
        digits = bytearray(b"0" * self.dimensions)
        seen = {first}
        edge = [(-math.inf, first)]
        left = self.atlas.voxels_max
        while edge and left and edge[0][0] < 0:
            voxel = heapq.heappop(edge)[1]
            digits[voxel] = ord("1")
            left -= 1
            for near in self._near[voxel]:
                if near not in seen:
                    seen.add(near)
                    heapq.heappush(edge, (-listed[near], near))
        return digits.decode()
