"""Checks that results are for the requested bodies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .bodies import voxels_of
from .errors import MorphodError, reading

if TYPE_CHECKING:
    from numpy.typing import NDArray


@reading()
def check_results(evaluation: str, rows: Sequence[Mapping[str, Any]],
                  designs: Sequence[Mapping[str, str]]) -> None:
    """Compares the results of an evaluation with the designs of its request, except those that were
    given by an id, repaired or skipped. Raises `MorphodError`."""
    asked = [design.get("voxels") for design in designs]
    found = [None if row["repaired"] or row["fault"] else row["genotype"] for row in rows]
    if len(found) != len(asked):
        raise MorphodError(f"evaluation {evaluation} has {len(found)} results, but "
                           f"{len(asked)} were requested")
    known = [place for place, (one, other) in enumerate(zip(asked, found)) if one and other]
    if not known:
        return
    first, second = (_at_corner(voxels_of(texts[place] for place in known))
                     for texts in (asked, found))
    wrong = np.flatnonzero((first != second).any(axis=(1, 2, 3)))
    if wrong.size:
        raise MorphodError(f"result {known[wrong[0]]} of evaluation {evaluation} is not "
                           "for the requested body")


def _at_corner(voxels: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Moves each body (n, 6, 6, 4) to the corner of the workspace, because the service moves
    them."""
    for axis in (1, 2, 3):
        others = tuple({1, 2, 3} - {axis})
        first = voxels.any(axis=others).argmax(axis=1)
        places = (first[:, None] + np.arange(voxels.shape[axis])) % voxels.shape[axis]
        shape = [len(voxels), 1, 1, 1]
        shape[axis] = -1
        voxels = np.take_along_axis(voxels, places.reshape(shape), axis=axis)
    return voxels
