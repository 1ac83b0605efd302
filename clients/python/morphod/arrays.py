"""Arrays as voxels: which values are voxels, and which arrays are refused because they are
ambiguous."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from .errors import BodyError

if TYPE_CHECKING:
    from numpy.typing import NDArray

_SHOWN = 5  # of many materials

_UNREADABLE = {
    "U": "texts: convert it, as in array.astype(int)",
    "S": "texts: convert it, as in array.astype(int)",
    "O": "objects: convert it, as in array.astype(int)",
    "c": "complex numbers: give booleans, as in abs(array) > 0.5",
    "M": "dates: give booleans or materials as integers",
    "m": "durations: give booleans or materials as integers",
    "V": "records: take the field with the voxels, as in array[\"voxels\"]",
}


def numbers(array: NDArray[Any]) -> NDArray[Any]:
    """Returns an array of booleans, integers or floats unchanged. Raises `BodyError` for any
    other."""
    if isinstance(array, np.ma.MaskedArray):
        raise BodyError("a masked array does not define its masked voxels: fill it, as in "
                        "array.filled(0)")
    if array.dtype.kind not in "biuf":
        what = _UNREADABLE.get(array.dtype.kind, f"{array.dtype}: give booleans")
        raise BodyError(f"this is an array of {what}")
    return np.asarray(array)


def occupied(array: NDArray[Any]) -> tuple[NDArray[np.bool_], tuple[str, ...]]:
    """Returns where an array has voxels, and what the conversion loses. Integers are materials;
    floats must be 0 or 1, because the threshold at which a density becomes a voxel is unknown."""
    array = numbers(array)
    if array.dtype.kind == "b":
        return array, ()
    if array.dtype.kind == "f":
        wrong = (array != 0) & (array != 1)
        if wrong.any():
            raise BodyError(f"{first(array, wrong)}: a float is a voxel if it is exactly 1, and "
                            "empty if it is exactly 0; give booleans, such as array > 0.5")
        return array == 1, ()
    if (array < 0).any():
        raise BodyError(f"{first(array, array < 0)}: 0 is empty, and materials are positive; give "
                        "booleans, such as array > 0")
    return array != 0, materials(array, plain=1)


def above_half(array: NDArray[Any]) -> NDArray[np.bool_]:
    """Returns the voxels for an optimizer's numbers: those above 0.5."""
    array = numbers(array)
    wrong = ~np.isfinite(array)
    if wrong.any():
        raise BodyError(f"{first(array, wrong)}: the numbers must be finite; a value "
                        "above 0.5 is a voxel")
    voxels: NDArray[np.bool_] = array > 0.5
    return voxels


def materials(values: NDArray[Any], plain: int | None = None) -> tuple[str, ...]:
    """Returns what is lost when materials are merged. `plain`: the material that corresponds to
    morphod's."""
    kinds = [kind for kind in np.unique(values).tolist() if kind != 0]
    if not kinds or kinds == [plain]:
        return ()
    if len(kinds) == 1:
        return (f"material {kinds[0]} became morphod's only material",)
    shown = ", ".join(str(kind) for kind in kinds[:_SHOWN])
    if len(kinds) > _SHOWN:
        return (f"{len(kinds)} materials ({shown}, …) were merged into one",)
    return (f"materials {shown} were merged into one",)


def first(array: NDArray[Any], wrong: NDArray[np.bool_]) -> str:
    """Returns the first wrong value and its position, for a message."""
    place = tuple(int(at) for at in np.argwhere(wrong)[0])
    return f"the value at [{', '.join(map(str, place))}] is {array[place]}"
