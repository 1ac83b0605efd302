"""Tasks: how the light moves, and what the score is (docs/tasks.md)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Union

from ._wire import given


Goal = Union[str, Mapping[str, float]]
"""An objective: a word, or weights of objectives and measures whose sum is the score."""


class Task(dict[str, Any]):
    """A task as it is sent and as the service reports it: a dictionary of `guide` and `objective`.

        morphod.Task.ahead(heading_rad=math.pi)                       # walk along -x
        morphod.Task.path([[3.5, 2.5], [3.5, 3.5]]).environment()     # for environments=[…]
        morphod.Task.fixed("approach").environment(light_xy_m=[4, 2.5])
        morphod.Task.ahead(objective={"travel": 1, "work_j": -2e-5})  # a weighted sum

    Besides the objectives named at each guide, `climb`, `efficient` (displacement per work) and
    `jump` fit every guide. A weighted sum has up to 8 terms: objectives that fit the guide, and
    measures. Training runs need terms that have a gradient.

    Whatever is left out has the service's default. The service refuses a task that makes no sense,
    and says why.
    """

    @classmethod
    def _of(cls, kind: str, objective: Goal | None, **members: Any) -> Task:
        if isinstance(objective, Mapping):
            objective = dict(objective)
        return cls(given(guide={"kind": kind, **given(**members)}, objective=objective))

    @classmethod
    def fixed(cls, objective: Goal | None = None) -> Task:
        """The light is fixed at `light_xy_m` of the environment. Objectives: reach, approach."""
        return cls._of("fixed", objective)

    @classmethod
    def ahead(cls, heading_rad: float = 0.0, *, distance_m: float | None = None,
              objective: Goal | None = None) -> Task:
        """The light leads in one direction, from the x axis toward the y axis. Objective:
        travel."""
        return cls._of("ahead", objective, heading_rad=heading_rad, distance_m=distance_m)

    @classmethod
    def turning(cls, turn_rad_per_s: float, *, heading_rad: float = 0.0,
                distance_m: float | None = None, objective: Goal | None = None) -> Task:
        """The same, in a direction that turns. Objective: travel."""
        return cls._of("turning", objective, heading_rad=heading_rad,
                       turn_rad_per_s=turn_rad_per_s, distance_m=distance_m)

    @classmethod
    def path(cls, points_m: Iterable[Sequence[float]], *, distance_m: float | None = None,
             objective: Goal | None = None) -> Task:
        """The light leads along a polyline with 1 to 16 waypoints (x, y), and waits at each.
        Objective: follow."""
        return cls._of("path", objective, points_m=[list(point) for point in points_m],
                       distance_m=distance_m)

    @classmethod
    def moving(cls, light_xy_m: Sequence[float], *, velocity_m_per_s: Sequence[float] | None = None,
               turn_rad_per_s: float | None = None, center_m: Sequence[float] | None = None,
               objective: Goal | None = None) -> Task:
        """The light moves on its own, on a line or around a center. Objectives: pursue, reach,
        approach."""
        return cls._of("moving", objective, light_xy_m=light_xy_m,
                       velocity_m_per_s=velocity_m_per_s, turn_rad_per_s=turn_rad_per_s,
                       center_m=center_m)

    def environment(self, **place: Any) -> dict[str, Any]:
        """Returns an environment with this task: `light_xy_m` for a fixed light, and, unless the
        ground is flat, `terrain` ({"kind": "slope"}), `terrain_heights_m`, or `terrain_sigma_m`
        and `seed`. `damage={"octant": 3, "time_s": 2}` cuts the springs of an octant then,
        `factors={"friction": 0.5}` multiplies constants of the physics, and `drop_m` lifts the
        robot at the start."""
        return {"task": self, **place}
