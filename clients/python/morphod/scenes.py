"""Scenes and columns: replies of the type application/vnd.morphod.scene.

A scene is a JSON header followed by arrays (docs/scenes.md of morphod). Arrays are views into the
reply's bytes: nothing is copied, and they are read-only.
"""

from __future__ import annotations

import ast
import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .errors import MorphodError, printable, reading

if TYPE_CHECKING:
    from numpy.typing import NDArray

Environments = str | Mapping[str, Any] | Sequence[Mapping[str, Any]]
"""The name of a set ("paper-test"); an object that varies its worlds ({"of": "paper-test", "vary":
{"friction": [0.5, 1.5], "drop_m": [0, 0.2]}, "count": 64}); or a list of environments: each with
`light_xy_m` and either `terrain_heights_m` (64 numbers, or an array (8, 8) as in scenes, with row y
and column x), `terrain_sigma_m` and `seed`, or `terrain` ({"kind": "stairs-up"}, a profile, or a
grid whose heights may be an array: docs/tasks.md); or with `task` ("walk", or spelled out), which
may move the light and needs no terrain. `factors` ({"friction": 0.5}) multiplies constants of the
physics, and `drop_m` lifts the robot at the start."""

MEDIA_TYPE = "application/vnd.morphod.scene"

_TYPES: dict[str, np.dtype[Any]] = {
    "int8": np.dtype(np.int8),
    "uint8": np.dtype(np.uint8),
    "uint16": np.dtype("<u2"),
    "uint32": np.dtype("<u4"),
    "uint64": np.dtype("<u8"),
    "float32": np.dtype("<f4"),
    "float64": np.dtype("<f8"),
}


@reading()
def read_envelope(data: bytes) -> dict[str, Any]:
    """Returns the header, with an array wherever it describes one. Raises `MorphodError` for bytes
    that are not a scene, or that end early."""
    length = int.from_bytes(data[:4], "little")
    if len(data) < 4 or len(data) < 4 + length:
        raise MorphodError("the scene is truncated: it ends before its header does")
    try:
        header = json.loads(data[4:4 + length])
    except ValueError:
        raise MorphodError("not a scene: the header is not JSON") from None
    if not isinstance(header, dict):
        raise MorphodError("not a scene: the header is not an object")
    read: dict[str, Any] = _with_arrays(header, data, 4 + length)
    return read


@reading()
def read_npy(data: bytes) -> NDArray[Any]:
    """Returns the array in a .npy file. It is a view into the bytes, and read-only."""
    if data[:8] != b"\x93NUMPY\x01\x00":
        raise MorphodError("not a NumPy array file of version 1")
    start = 10 + int.from_bytes(data[8:10], "little")
    header = ast.literal_eval(data[10:start].decode("latin-1"))
    return np.frombuffer(data, header["descr"], offset=start).reshape(header["shape"])


def _with_arrays(value: Any, data: bytes, first: int) -> Any:
    if isinstance(value, dict):
        if set(value) == {"offset", "type", "shape"}:
            return _array(value, data, first)
        return {key: _with_arrays(item, data, first) for key, item in value.items()}
    if isinstance(value, list):
        return [_with_arrays(item, data, first) for item in value]
    return value


def _array(described: dict[str, Any], data: bytes, first: int) -> NDArray[Any]:
    kind = _TYPES.get(described["type"])
    if kind is None:
        raise MorphodError(f"the scene has an array of type {described['type']!r}, which this "
                           "version of the package does not support: upgrade it")
    count = int(np.prod(described["shape"], dtype=np.int64))
    start = first + described["offset"]
    if start + count * kind.itemsize > len(data):
        raise MorphodError("the scene is truncated: it ends before its arrays do")
    array: NDArray[Any] = np.frombuffer(data, kind, count, start)
    return array.reshape(described["shape"])


@dataclasses.dataclass(frozen=True, eq=False)
class Rollout:
    """One robot in one environment.

    `masses_m` has the shape (frames, masses, 3), `com_m` (frames, 3), in meters; None if not
    recorded. `value` and `unit` are those of the task; None for `photo`. `state` is the one in
    which it ends, if requested; None if it diverged. `more` has every other array,
    by name.
    """

    design: int
    environment: int
    loss: float | None
    diverged_step: int
    masses_m: NDArray[np.float32] | None
    com_m: NDArray[np.float64] | None
    more: dict[str, NDArray[Any]]
    value: float | None = None
    unit: str | None = None
    state: dict[str, Any] | None = None


class Scene:
    """Bodies, environments and rollouts of one reply.

    `header` has everything with the names of docs/scenes.md, including the arrays; `data` is the
    reply itself, which the players in the dashboard and in notebooks read.
    """

    @reading()
    def __init__(self, data: bytes) -> None:
        self.data = data
        self.header = read_envelope(data)
        self.frame_s = float(self.header["frame_s"])
        self.designs: list[dict[str, Any]] = self.header["designs"]
        self.environments: list[dict[str, Any]] = self.header["environments"]
        self.warnings = [printable(each["detail"]) for each in self.header.get("warnings", ())]
        known = {"design", "environment", "loss", "diverged_step", "masses_m", "com_m",
                 "value", "unit", "state"}
        self.rollouts = [
            Rollout(row["design"], row["environment"], row["loss"], row["diverged_step"],
                    row.get("masses_m"), row.get("com_m"),
                    {name: value for name, value in row.items() if name not in known},
                    row.get("value"), row.get("unit"), row.get("state"))
            for row in self.header["rollouts"]
        ]

    def __iter__(self) -> Iterator[Rollout]:
        return iter(self.rollouts)

    def __len__(self) -> int:
        return len(self.rollouts)

    def __getitem__(self, place: int) -> Rollout:
        return self.rollouts[place]

    @property
    def states(self) -> list[dict[str, Any] | None]:
        """The states in which the rollouts end, for `states` of the next call; None where it
        diverged, or if the request did not ask for them."""
        return [rollout.state for rollout in self.rollouts]

    @property
    def scores(self) -> NDArray[np.float64]:
        """Mean loss of each design (designs,); NaN if a rollout diverged."""
        return np.array([np.nan if design["score"] is None else design["score"]
                         for design in self.designs])

    def __repr__(self) -> str:
        return f"Scene({len(self.designs)} designs, {len(self.rollouts)} rollouts)"
