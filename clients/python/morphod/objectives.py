"""How solutions of an optimizer become bodies, and scores become its objectives."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .arrays import above_half
from .bodies import WORKSPACE, Body, BodyLike
from .errors import BodyError

_PATH = "path_length_m"
_VOXELS = 144
_SHAPES = "(144,) or (6, 6, 4) for one solution, (n, 144) or (n, 6, 6, 4) for many"
_OF_BODY: dict[str, Callable[[Body], float]] = {
    "voxels": lambda body: float(len(body)),
    "footprint": lambda body: float(body.footprint()),
    "height": lambda body: float(body.voxels.any(axis=(0, 1)).sum()),
}


class Plan:
    """The parts of an `Objective` that do not send requests."""

    def __init__(self, measures: Sequence[Any] | None,
                 decode: Callable[[Any], BodyLike] | None, worst: float, maximize: bool) -> None:
        for measure in measures or ():
            if not callable(measure) and measure != _PATH and measure not in _OF_BODY:
                raise ValueError(f"measure {measure!r} must be a function or one of "
                                 f"{', '.join([*_OF_BODY, _PATH])}")
        self.measures = measures
        self.decode = decode
        self.worst = worst
        self.maximize = maximize
        self.needs_path = _PATH in (measures or ())

    def read(self, solutions: Any) -> tuple[list[Body | None], bool]:
        """Returns the bodies, with None for a solution without voxels, and whether there is a
        single solution that is not in a list."""
        if self.decode is None:
            solutions = _listed(solutions)
        single = self._is_single(solutions)
        bodies: list[Body | None] = []
        for place, solution in enumerate([solutions] if single else solutions):
            try:
                bodies.append(self._body(solution))
            except BodyError as error:
                raise BodyError(f"solution {place} is not a body: {error}" + (
                    "" if self.decode else "; pass decode=, a function that makes one")) from None
        return bodies, single

    def _is_single(self, solutions: Any) -> bool:
        single = _is_one(solutions)
        if self.measures is not None:
            if single and self.decode is None:
                raise BodyError("with measures, an objective needs many solutions: put this one in "
                                "brackets")
            return False
        return single

    def _body(self, solution: Any) -> Body | None:
        if self.decode is not None:
            solution = self.decode(solution)
        if isinstance(solution, (list, tuple)) and solution and all(map(_is_number, solution)):
            solution = np.array(solution)
        elif getattr(solution, "ndim", 0) > 0 and not isinstance(solution, np.ndarray):
            solution = np.asarray(solution)  # of a table or a tensor
        if isinstance(solution, np.ndarray):
            if solution.ndim != 3 and solution.shape != (_VOXELS, ):
                raise BodyError(f"an array has shape {solution.shape}; it must be "
                                f"{_SHAPES}")
            voxels = above_half(solution)
            solution = voxels.reshape(WORKSPACE) if voxels.ndim == 1 else voxels
            if not voxels.any():
                return None
        return Body.of(solution, repair="largest")

    def write(self, bodies: list[Body | None], scores: NDArray[np.float64] | None, paths: Any,
              single: bool) -> Any:
        """Returns what the optimizer needs; scores and paths are those of the bodies that are not
        None."""
        there = np.array([body is not None for body in bodies], dtype=np.bool_)
        losses = np.full(len(bodies), self.worst)
        if scores is not None:
            losses[there] = np.where(np.isnan(scores), self.worst, scores)
        objectives = -losses if self.maximize else losses
        if self.measures is None:
            return float(objectives[0]) if single else objectives
        table = self.values(bodies)
        if paths is not None:
            table[there, list(self.measures).index(_PATH)] = paths
        return objectives, table

    @property
    def names(self) -> list[str]:
        """Returns the measures by name. Functions have their own names, except those without a
        plain name."""
        given = [getattr(measure, "__name__", "") if callable(measure) else measure
                 for measure in self.measures or ()]
        return [name if name.isidentifier() and name not in given[:place] else f"measure_{place}"
                for place, name in enumerate(given)]

    def values(self, bodies: Sequence[Body | None]) -> NDArray[np.float64]:
        """Returns the measures (n, measures) of bodies, with 0 for a path and for an invalid
        body."""
        measures = self.measures or ()
        table = np.zeros((len(bodies), len(measures)))
        for column, measure in enumerate(measures):
            if measure != _PATH:
                count = measure if callable(measure) else _OF_BODY[measure]
                table[:, column] = [0.0 if body is None else float(count(body)) for body in bodies]
        return table


def _listed(solutions: Any) -> Any:
    """Returns one solution, or solutions with a length and an order."""
    if getattr(solutions, "ndim", 0) > 0 and not isinstance(solutions, np.ndarray):
        solutions = np.asarray(solutions)  # of a table or a tensor
    if isinstance(solutions, np.ndarray) and solutions.ndim == 1 and solutions.dtype.kind in "OU":
        return list(solutions)
    if isinstance(solutions, (set, frozenset)):
        raise BodyError("a set of solutions has no order: give a list")
    if isinstance(solutions, (str, bytes, Body, Mapping, Sequence)) or (
            isinstance(solutions, np.ndarray) and solutions.ndim > 0):
        return solutions
    if not isinstance(solutions, Iterable) or isinstance(solutions, np.ndarray):
        raise BodyError(f"{type(solutions).__name__} is not a solution: give an array of shape "
                        f"{_SHAPES}")
    return list(solutions)


def _is_one(solutions: Any) -> bool:
    if isinstance(solutions, np.ndarray):
        return solutions.ndim == 1 or solutions.shape == WORKSPACE
    if isinstance(solutions, (str, bytes, Body, Mapping)):
        return True
    # A list of numbers is one vector; a list of cells is one body.
    first = solutions[0] if len(solutions) else None
    return _is_number(first) or (isinstance(first, (list, tuple)) and len(first) == 3 and
                                 all(map(_is_number, first)))


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float, np.bool_, np.number))
