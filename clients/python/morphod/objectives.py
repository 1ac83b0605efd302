"""How solutions of an optimizer become bodies, and scores become what it is told."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .bodies import WORKSPACE, Body, BodyLike
from .errors import BodyError

_PATH = "path_length_m"
_OF_BODY: dict[str, Callable[[Body], float]] = {
    "voxels": lambda body: float(len(body)),
    "footprint": lambda body: float(body.footprint()),
    "height": lambda body: float(body.voxels.any(axis=(0, 1)).sum()),
}


class Plan:
    """What an `Objective` does besides asking the service."""

    def __init__(self, measures: Sequence[Any] | None,
                 decode: Callable[[Any], BodyLike] | None, worst: float, maximize: bool) -> None:
        for measure in measures or ():
            if not callable(measure) and measure != _PATH and measure not in _OF_BODY:
                raise ValueError(f"measure {measure!r} is neither a function nor one of "
                                 f"{', '.join([*_OF_BODY, _PATH])}")
        self.measures = measures
        self.decode = decode
        self.worst = worst
        self.maximize = maximize
        self.needs_path = _PATH in (measures or ())

    def read(self, solutions: Any) -> tuple[list[Body | None], bool]:
        """The bodies, None for a solution without a voxel, and whether there is one solution that
        is not in a list."""
        single = self._is_single(solutions)
        return [self._body(solution) for solution in ([solutions] if single else solutions)], single

    def _is_single(self, solutions: Any) -> bool:
        if self.measures is not None:
            return False
        if isinstance(solutions, np.ndarray):
            return solutions.ndim == 1 or solutions.shape == WORKSPACE
        if isinstance(solutions, (str, Body, dict)):
            return True
        # A list of numbers is one vector, a list of cells one body.
        first = solutions[0] if len(solutions) else None
        return np.isscalar(first) or (isinstance(first, (list, tuple)) and len(first) == 3 and
                                      all(np.isscalar(part) for part in first))

    def _body(self, solution: Any) -> Body | None:
        if self.decode is not None:
            solution = self.decode(solution)
        elif not isinstance(solution, (str, Body, dict)) and np.size(solution) == 144 and (
                np.ndim(solution) == 1):
            solution = np.asarray(solution, dtype=float).reshape(WORKSPACE) > 0.5
        if isinstance(solution, np.ndarray) and not solution.any():
            return None
        try:
            return Body.of(solution, repair="largest")
        except BodyError as error:
            raise BodyError(f"a solution is no body: {error}; give decode= a function that makes "
                            "one") from None

    def write(self, bodies: list[Body | None], scores: NDArray[np.float64] | None, paths: Any,
              single: bool) -> Any:
        """What the optimizer is told; scores and paths are of the bodies that are there."""
        there = np.array([body is not None for body in bodies], dtype=np.bool_)
        losses = np.full(len(bodies), self.worst)
        if scores is not None:
            losses[there] = np.where(np.isnan(scores), self.worst, scores)
        told = -losses if self.maximize else losses
        if self.measures is None:
            return float(told[0]) if single else told
        table = self.values(bodies)
        if paths is not None:
            table[there, list(self.measures).index(_PATH)] = paths
        return told, table

    @property
    def names(self) -> list[str]:
        """The measures by name; functions have theirs, but for those without a plain one."""
        given = [getattr(measure, "__name__", "") if callable(measure) else measure
                 for measure in self.measures or ()]
        return [name if name.isidentifier() and name not in given[:place] else f"measure_{place}"
                for place, name in enumerate(given)]

    def values(self, bodies: Sequence[Body | None]) -> NDArray[np.float64]:
        """The measures (n, measures) of bodies; 0 for a path, and for what is no body."""
        measures = self.measures or ()
        table = np.zeros((len(bodies), len(measures)))
        for column, measure in enumerate(measures):
            if measure != _PATH:
                count = measure if callable(measure) else _OF_BODY[measure]
                table[:, column] = [0.0 if body is None else float(count(body)) for body in bodies]
        return table
