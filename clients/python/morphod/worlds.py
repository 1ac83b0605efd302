"""Worlds of EvoGym as terrains."""

from __future__ import annotations

import json
import math
import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from . import evogym
from .bodies import Body
from .errors import BodyError, MorphodError, counted

if TYPE_CHECKING:
    from numpy.typing import NDArray

CELL_M = 0.1  # of EvoGym's grid; a voxel of morphod has the same size
START_M = 2.5  # x at which a rollout starts
START_CELL = 3.5  # most tasks of EvoGym put robots of 5 cells on the cells 1 to 5
HEIGHTS_MAX = 64
_SIDE_MAX = 4096  # cells of a world that is read
_NAMES_MAX = 3  # in a sentence about what was left out
_Room = tuple[float, float]  # free cells of a column: from the floor, to the ceiling


class World(dict[str, Any]):
    """A terrain from a file, as `terrain` of an environment: a profile of heights along x, which
    are the same for every y.

    `lost` lists what the file has and the terrain lacks. `bodies` are the robots in the file.
    `ditches` are the ranges of cells without ground.
    """

    def __init__(self, profile: Mapping[str, Any], bodies: Sequence[Body], lost: Sequence[str],
                 ditches: Sequence[tuple[int, int]], name: str) -> None:
        super().__init__(profile)
        self.bodies = list(bodies)
        self.lost = tuple(lost)
        self.ditches = list(ditches)
        self.name = name

    def environment(self, task: Any = "walk", **place: Any) -> dict[str, Any]:
        """Returns an environment with this terrain and a task (docs/tasks.md); with `task=None`,
        `light_xy_m` is the position of the light."""
        return {**({} if task is None else {"task": task}), "terrain": dict(self), **place}

    def __repr__(self) -> str:
        return (f"<World {self.name}: {counted(len(self['heights_m']), 'height')}, "
                f"{counted(len(self.bodies), 'body', 'bodies')}>")


def read_world(path: str | os.PathLike[str], *, start_cell: float | None = None,
               start_row: int | None = None, spacing_m: float = CELL_M,
               ditch_m: float = CELL_M) -> World:
    """Returns the ground of an EvoGym world (JSON) as a terrain, with its robots.

    Everything fixed is ground: the terrain is the surface that a robot walks on from its start,
    with a height for each cell. Heights count from the ground at the start. Rollouts start at x =
    2.5 m; `start_cell` is the cell of the file that is there, from the left, and `start_row` the
    row of a robot's feet, from the bottom, which matters where floors are stacked: by default the
    middle and the lowest row of the file's first robot or, without one, 3.5, as in most tasks of
    EvoGym, and the lowest floor. A terrain has up to 64 heights, `spacing_m` apart. With 0.1 m,
    which is exact, it ends 3.8 m after the start; with more, each height is a mean over
    `spacing_m`. Where there is no ground, it has a ditch, `ditch_m` deeper than the lower of its
    sides.

    Objects with actuators and without a fixed voxel are robots: `bodies`, as from `read_bodies`.
    `lost` of the result says what could not be kept. Raises `BodyError` if the file is not a world,
    and `MorphodError` if it has no ground.
    """
    path = pathlib.Path(path)
    if not 0.02 <= spacing_m <= 1 or not ditch_m >= 0 or math.isinf(ditch_m):
        raise ValueError("spacing_m must be 0.02 to 1, and ditch_m finite and at least 0")
    try:
        world = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise BodyError(f"{path.name} is not JSON: {error}") from None
    things = evogym.things(world)
    solid = _solid(world, things)
    ground = {name: thing for name, thing in things.items() if thing.has(evogym.FIXED)}
    robots = {name: thing for name, thing in things.items()
              if name not in ground and thing.has(*evogym.ACTUATORS)}
    loose = [name for name in things if name not in ground and name not in robots]
    if not ground:
        raise MorphodError(f"{path.name} has no ground: no object is fixed (material "
                           f"{evogym.FIXED}); use read_bodies to read its robots")
    start, row = _start(start_cell, start_row, robots)
    columns = np.flatnonzero(solid.any(axis=0))
    if not columns[0] <= start <= columns[-1] + 1:
        raise MorphodError(f"the start is at cell {start:g}, but the ground extends from "
                           f"{columns[0]} to {columns[-1] + 1}; give another start_cell")
    lost: list[str] = []
    surface, ditches = _surface(solid, start, row, lost)
    _report_objects(ground, loose, lost)
    heights = _filled(surface, ditches, ditch_m / CELL_M, lost)
    profile = _profile(heights - heights[min(int(start), columns[-1]) - columns[0]], columns[0],
                       start, spacing_m, lost)
    return World(profile, _bodies(robots, surface, lost), lost, ditches, path.name)


def _solid(world: Mapping[str, Any], things: Mapping[str, evogym.Thing]) -> NDArray[np.bool_]:
    """Returns which cells [row from the bottom, column] the ground has."""
    width = int(world["grid_width"])
    height = max((thing.place[1] + thing.rows.shape[0] for thing in things.values()), default=0)
    given = world.get("grid_height", height)
    if isinstance(given, bool) or not isinstance(given, (int, float)) or given < height:
        raise BodyError(f"this JSON is not an EvoGym world: grid_height is {given!r}, but its "
                        f"objects have {height} rows")
    if width > _SIDE_MAX or height > _SIDE_MAX:
        raise BodyError(f"this world has {width} × {height} cells; at most {_SIDE_MAX} in each "
                        "direction are supported")
    solid = np.zeros((height, width), dtype=np.bool_)
    for thing in things.values():
        if thing.has(evogym.FIXED):
            (x, z), (rows, columns) = thing.place, thing.rows.shape
            solid[z:z + rows, x:x + columns] |= thing.rows[::-1] != 0
    return solid


def _start(cell: float | None, row: int | None, robots: Mapping[str, evogym.Thing]
           ) -> tuple[float, int | None]:
    """Returns the cell of the start, and the row of a robot's feet there, if it is known."""
    first = next(iter(robots.values()), None)
    if cell is not None or first is None:
        return START_CELL if cell is None else cell, row
    x, z = first.place
    return x + first.rows.shape[1] / 2, z if row is None else row


# ---- the surface ----


def _surface(solid: NDArray[np.bool_], start: float, row: int | None, lost: list[str]
             ) -> tuple[dict[int, int], list[tuple[int, int]]]:
    """Returns the height of the ground by column, where there is ground, along the way from the
    start to both sides; and the ranges of columns between them that have none."""
    columns = np.flatnonzero(solid.any(axis=0)).tolist()
    rooms = {x: _rooms(solid[:, x]) for x in range(columns[0], columns[-1] + 1)}
    first: int = min(columns, key=lambda x: float(abs(x + 0.5 - start)))
    floors = [room for room in rooms[first] if room[0] > -math.inf]
    if row is None and len(floors) > 1:
        lost.append(f"other floors at the start: rows {', '.join(f'{z:g}' for z, _ in floors[1:])} "
                    "of its column; start_row chooses one")
    here = next((room for room in floors if row is not None and room[0] <= row < room[1]),
                floors[0])
    surface, closed = {first: int(here[0])}, []
    for way in (range(first + 1, columns[-1] + 1), range(first - 1, columns[0] - 1, -1)):
        at = here
        for x in way:
            open_to = [room for room in rooms[x] if max(room[0], at[0]) < min(room[1], at[1])]
            floors = [room for room in open_to if room[0] > -math.inf]
            if not open_to:  # a wall up to the ceiling
                closed.append(x)
                floors = sorted((room for room in rooms[x] if room[0] > -math.inf),
                                key=lambda room: abs(room[0] - at[0]))
            if floors:
                at = floors[0]
                surface[x] = int(at[0])
    if closed:
        lost.append(f"the way is blocked at cell {min(closed)}: the terrain continues above it")
    _report_cells(solid, surface, lost)
    return surface, _ranges([x for x in rooms if x not in surface])


def _rooms(column: NDArray[np.bool_]) -> list[_Room]:
    """Returns the free ranges of a column, from the lowest. The first one has no floor if the
    bottom row is free."""
    rooms: list[_Room] = []
    floor = -math.inf
    for z, is_solid in enumerate([*column.tolist(), False]):
        if is_solid:
            if floor < z:
                rooms.append((floor, z))
            floor = z + 1
    return [*rooms, (floor, math.inf)]


def _ranges(columns: Sequence[int]) -> list[tuple[int, int]]:
    """Returns consecutive numbers as ranges: first, and last plus one."""
    ranges: list[tuple[int, int]] = []
    for x in columns:
        if ranges and ranges[-1][1] == x:
            ranges[-1] = (ranges[-1][0], x + 1)
        else:
            ranges.append((x, x + 1))
    return ranges


def _filled(surface: Mapping[int, int], ditches: Sequence[tuple[int, int]], deep: float,
            lost: list[str]) -> NDArray[np.float64]:
    """Returns the heights of all columns from the first to the last, in cells."""
    first, last = min(surface), max(surface)
    heights = np.array([surface.get(x, 0) for x in range(first, last + 1)], dtype=np.float64)
    for begin, end in ditches:
        heights[begin - first:end - first] = min(surface[begin - 1], surface[end]) - deep
    if ditches:
        gaps = counted(len(ditches), "gap")
        lost.append(f"{gaps} without ground (the first from cell {ditches[0][0]} to "
                    f"{ditches[0][1]}): a ditch {deep * CELL_M:g} m deep, not a fall")
    return heights


# ---- what is lost ----


def _report_cells(solid: NDArray[np.bool_], surface: Mapping[int, int], lost: list[str]) -> None:
    above = below = 0
    for x in range(min(surface), max(surface) + 1):
        z = surface.get(x, 0)
        above += int(solid[z:, x].sum())
        below += int((~solid[:z, x]).sum())
    if above:
        lost.append(f"{counted(above, 'cell')} above the ground: ceilings, overhangs or other "
                    "levels")
    if below:
        lost.append(f"{counted(below, 'cell')} of free space under the ground")


def _report_objects(ground: Mapping[str, evogym.Thing], loose: Sequence[str], lost: list[str]
                    ) -> None:
    for name, thing in ground.items():
        others = int(((thing.rows != 0) & (thing.rows != evogym.FIXED)).sum())
        if others:
            lost.append(f"{name}: {counted(others, 'voxel')} of other materials became rigid "
                        "ground")
    if loose:
        more = len(loose) - _NAMES_MAX
        lost.append(f"moving objects: {', '.join(loose[:_NAMES_MAX])}" +
                    (f" and {more} more" if more > 0 else ""))


def _bodies(robots: Mapping[str, evogym.Thing], surface: Mapping[int, int], lost: list[str]
            ) -> list[Body]:
    bodies = []
    for name, thing in robots.items():
        try:
            body = Body.evogym(thing.rows)
        except BodyError as error:
            lost.append(f"robot {name}: {error}")
            continue
        bodies.append(Body(body.voxels, body.lost + thing.lost, name))
        x, z = thing.place
        under = [surface[k] for k in range(x, x + thing.rows.shape[1]) if k in surface]
        if len(bodies) > 1:
            lost.append(f"the position of robot {name}: every rollout has one robot, at the start")
        elif under and z > max(under):
            lower = counted(z - max(under), "cell")
            lost.append(f"robot {name} starts on the ground, {lower} lower")
    return bodies


# ---- the profile ----


def _profile(heights: NDArray[np.float64], first: int, start: float, spacing_m: float,
             lost: list[str]) -> dict[str, Any]:
    """Returns the profile of the columns from `first` on. Each height is the mean over the cells
    within half a spacing."""
    is_exact = spacing_m == CELL_M
    if is_exact and start != math.floor(start) + 0.5:  # heights are those of the cells
        start = math.floor(start) + 0.5 if start % 1 else start - 0.5
        lost.append(f"half a cell of the start: the middle of cell {int(start)} is at x = "
                    f"{START_M:g} m")
    last = first + len(heights) - 1
    half = spacing_m / CELL_M / 2
    reach = START_M + (last + 0.5 - start) * CELL_M
    n = min(max(math.ceil(reach / spacing_m - 1e-9) + 1, 2), HEIGHTS_MAX)
    middles = start + (np.arange(n) * spacing_m - START_M) / CELL_M
    shown = (_area(heights, first, middles + half) -
             _area(heights, first, middles - half)) / (2 * half)
    cut = {"before": heights[:max(math.ceil(middles[0] - half - first - 1e-9), 0)],
           "after": heights[max(math.floor(middles[-1] + half - first + 1e-9), 0):]}
    for where, cells in cut.items():
        end = shown[0 if where == "before" else -1]
        x = 0 if where == "before" else (n - 1) * spacing_m
        if len(cells) and np.abs(cells - end).max() > 1e-9:
            lost.append(f"{counted(len(cells), 'cell')} {where} x = {x:g} m, because a terrain has "
                        f"{HEIGHTS_MAX} heights; a larger spacing_m keeps more")
    steps = np.abs(np.diff(shown)) * CELL_M
    if steps.max() > 1e-9:
        steep = math.degrees(math.atan(steps.max() / spacing_m))
        lost.append(f"vertical walls: steps are ramps {spacing_m:g} m long, up to {steep:.0f}° "
                    "steep")
    if not is_exact:
        lost.append(f"details shorter than {spacing_m:g} m: each height is a mean")
    lost.append("the ends: the ground continues at the height of its first and last cell")
    return {"kind": "profile", "heights_m": [round(float(h) * CELL_M, 9) + 0.0 for h in shown],
            "spacing_m": spacing_m}


def _area(heights: NDArray[np.float64], first: int, cells: NDArray[np.float64]
          ) -> NDArray[np.float64]:
    """Integrates the heights from column `first` to each position, in cells. They continue
    unchanged beyond both ends."""
    edges = first + np.arange(len(heights) + 1)
    sums = np.concatenate([[0], np.cumsum(heights)])
    area: NDArray[np.float64] = (np.interp(cells, edges, sums) +
                                 heights[0] * np.minimum(cells - edges[0], 0) +
                                 heights[-1] * np.maximum(cells - edges[-1], 0))
    return area
