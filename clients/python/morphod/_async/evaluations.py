"""Evaluations of the service, as objects."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ..checks import check_results
from ..errors import MorphodError, reading
from ..frames import pandas
from ..player import Player
from ..results import Result, Svg, losses_of, measures_of, units_of, values_of
from ..scenes import MEDIA_TYPE, Scene, read_npy
from .._wire import Request
from .connection import AsyncConnection
from .jobs import AsyncJob
from .showing import player, world_of

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray

_ELEMENTS = {"float32-le": "<f4", "int8": "i1", "uint8": "u1"}
_CLIMB = ("reached", "estimated_error", "dt_s", "precision")
_ERRORS = ("low", "high", "discretization", "rounding", "standard_error", "bifurcates")


class AsyncEvaluation(AsyncJob):
    """Designs scored in environments. `len`, `[…]` and iteration apply to the designs."""

    _list = "/v1/evaluations"
    noun = "evaluation"
    finder = "client.evaluation"

    def __init__(self, connection: AsyncConnection, data: dict[str, Any],
                 lost: Sequence[tuple[str, ...]] = (),
                 faults: Mapping[int, str] | None = None) -> None:
        super().__init__(connection, data)
        self._faults = faults or {}
        self.lost = lost
        """For each design, what the conversion of its body left out; empty if unknown."""

    @property
    @reading()
    def _results(self) -> list[dict[str, Any]]:
        if not self.ended:
            raise MorphodError(f"evaluation {self.id} is {self.state}: wait() for its results")
        self._require_success()
        if "results" not in self.data:
            raise MorphodError(f"evaluation {self.id} has {len(self):,} designs, too many at once: "
                               "use table() to read all results, or table(whole=True) for the "
                               "best ones")
        results: list[dict[str, Any]] = self.data["results"]
        return results

    @property
    @reading()
    def scores(self) -> NDArray[np.float64]:
        """Mean losses (designs,), lower is better; NaN if a rollout diverged."""
        return np.array([row["score"] for row in self._results], dtype=np.float64)

    @property
    @reading()
    def lower_bound(self) -> NDArray[np.bool_]:
        """(designs,): with `best`, whether the score is a lower bound because the design cannot be
        among the best."""
        return np.array([row["lower_bound"] for row in self._results], dtype=np.bool_)

    @property
    @reading()
    def losses(self) -> NDArray[np.float64]:
        """(designs, environments); NaN if the rollout diverged or, with `best`, was not needed.
        """
        return losses_of([row["losses"] for row in self._results])

    @property
    @reading()
    def values(self) -> NDArray[np.float64]:
        """(designs, environments): the scores in the units of the tasks, higher is better; for
        `photo`, 1 minus the loss. NaN where `losses` is."""
        return values_of([row["losses"] for row in self._results])

    @property
    @reading()
    def units(self) -> list[str]:
        """The unit of each environment's value: "m", "m/kJ", or "" for a number without
        a unit."""
        return units_of(self._results[0]["losses"]) if self._results else []

    @property
    @reading()
    def measures(self) -> dict[str, NDArray[np.float64]]:
        """The requested measures by name, each (designs, environments); NaN where a measure has no
        value, or the rollout diverged or was not needed. Empty without `measures`."""
        return measures_of([row["losses"] for row in self._results])

    @property
    @reading()
    def ids(self) -> list[str | None]:
        """The designs' ids: their canonical forms; None if there was no body.

        A score belongs to one orientation of a design, but an id stands for all of them. To rescore
        or keep the same robots, use `robots`, because an id without an orientation means the one
        with the best stored score.
        """
        return [row["id"] for row in self._results]

    @property
    @reading()
    def robots(self) -> list[str | None]:
        """The scored robots: the designs in the orientations that were simulated, as ID@K, which is
        accepted wherever a body is; None if there was no body."""
        return [row["robot"] for row in self._results]

    @reading()
    def __len__(self) -> int:
        return int(self.data["n_designs"])

    def __getitem__(self, place: int) -> Result:
        row = self._results[place]
        lost = tuple(self.lost[place]) if self.lost else ()
        return Result(row, lost, self._faults.get(place % len(self)))

    def _check(self, designs: Sequence[Mapping[str, str]]) -> None:
        check_results(self.id, self._results, designs)

    def __iter__(self) -> Iterator[Result]:
        return (self[place] for place in range(len(self)))

    async def suite_table(self) -> pd.DataFrame:
        """Returns the scores of an evaluation in a suite: a row for each robot, a column for each
        task with the mean value in its unit, higher is better (NaN if a rollout diverged or the
        body was skipped), and `mean_loss`, over the tasks that have a loss; `left_out` names the
        others."""
        with reading():
            if "suite" not in self.data:
                raise MorphodError(f"evaluation {self.id} is not in a suite: use table() to read "
                                   "its results")
            names = [task["task"] for task in self.data["suite"]["tasks"]]
        if not self.ended:
            raise MorphodError(f"evaluation {self.id} is {self.state}: wait() for its results")
        self._require_success()
        rows = self.data["results"] if "results" in self.data else [
            row async for row in self._connection.pages(f"{self._list}/{self.id}/results")]
        with reading():
            columns: dict[str, Any] = {
                name: np.array([row["tasks"][name]["value"] for row in rows], dtype=np.float64)
                for name in names}
            columns["mean_loss"] = np.array([row["tasks_mean"]["loss"] for row in rows],
                                            dtype=np.float64)
            columns["left_out"] = [tuple(row["tasks_mean"]["left_out"]) for row in rows]
            table: pd.DataFrame = pandas().DataFrame(columns, index=[row["robot"] for row in rows])
        return table.rename_axis("robot")

    async def picture(self, designs: Sequence[int] | None = None, *,
                      theme: Literal["light", "dark"] = "light", width: int = 760) -> Svg:
        """Returns a picture of an evaluation in a suite, as the text of an SVG file, which
        notebooks show: one axis per task, and one polygon for each of up to 6 designs (default:
        those with the lowest mean loss)."""
        reply = await self._connection.send(Request.get(
            f"{self._list}/{self.id}/picture.svg", accept="image/svg+xml",
            designs=None if designs is None else ",".join(map(str, designs)), theme=theme,
            width=width))
        return Svg(reply.content.decode())

    async def table(self, *, whole: bool = False) -> pd.DataFrame:
        """Returns the results of any number of designs, read in pages: number (of the design, from
        0), then the columns of `frame`. `whole`: with `best`, only those that are not lower bounds,
        best first."""
        if not self.ended:
            raise MorphodError(f"evaluation {self.id} is {self.state}: wait() for its results")
        self._require_success()
        rows = [row async for row in self._connection.pages(
            f"{self._list}/{self.id}/results", whole="true" if whole else None)]
        part = type(self)(self._connection, {**self.data, "results": rows, "n_designs": len(rows)})
        table = part.frame()
        table.insert(0, "number", [row["number"] for row in rows])
        return table.sort_values("score", kind="stable", ignore_index=True) if whole else table

    def frame(self) -> pd.DataFrame:
        """Returns a table with a row per design: id, robot (the scored orientation), genotype,
        score, lower_bound (with `best`: whether the score is one), diverged (rollouts), voxels,
        masses, springs, footprint, repaired (dropped voxels), path_length_m (if com is recorded),
        fault (None, or why there was no body), with `error` the numbers of `ScoreError`, with
        `tolerance` reached, estimated_error, dt_s and precision of `Climb`, and a column loss_0,
        loss_1, … per environment. With `measures` also their means, as measures_displacement_m and
        so on, and flags. With tasks or measures also value and unit (if all values have the same
        unit), and value_0, value_1, … per environment."""
        results = self._results
        losses = self.losses
        with reading():
            return self._table(results, losses)

    def _table(self, results: list[dict[str, Any]], losses: NDArray[np.float64]) -> pd.DataFrame:
        errors = [result.error for result in self if result.error is not None]
        climbs = [result.tolerance for result in self if result.tolerance is not None]
        table: pd.DataFrame = pandas().DataFrame({
            "id": [row["id"] for row in results],
            "robot": [row["robot"] for row in results],
            "orientation": [row["orientation"] for row in results],
            "genotype": [row["genotype"] for row in results],
            "score": self.scores,
            "lower_bound": self.lower_bound,
            "diverged": [len(row["diverged"]) for row in results],
            **{name: [row[name] for row in results]
               for name in ("voxels", "masses", "springs", "footprint", "repaired",
                            "path_length_m")},
            "fault": [result.fault for result in self],
            **{name: [getattr(error, name) for error in errors] for name in _ERRORS if errors},
            **{name: [getattr(climb, name) for climb in climbs] for name in _CLIMB if climbs},
            **{f"loss_{place}": losses[:, place] for place in range(losses.shape[1])},
        })
        for name in self.measures:
            table[f"measures_{name}"] = [result.measures[name] for result in self]
        if "measures" in self.data:
            table["flags"] = [result.flags for result in self]
        if any(isinstance(loss, dict) for row in results for loss in row["losses"]):
            values = self.values
            if len(set(self.units)) == 1:
                table["value"] = values.mean(axis=1)
                table["unit"] = self.units[0]
            for place in range(values.shape[1]):
                table[f"value_{place}"] = values[:, place]
        return table

    def _repr_html_(self) -> str | None:
        """In a notebook: the table of an evaluation that has succeeded."""
        if self.state != "succeeded":
            return None
        try:
            table: str = self.frame()._repr_html_()
        except MorphodError:  # pandas is not installed
            return None
        return f"<p>evaluation {self.id}</p>{table}"

    async def live(self) -> AsyncEvaluation:
        """Shows its progress until it has ended."""
        await self._watch(f"evaluation {self.id}", " rollouts")
        return self

    async def recording(self, place: int, environment: int = 0,
                        array: Literal["masses", "com", "actuation", "contacts"] = "masses"
                        ) -> NDArray[Any]:
        """Returns the recording of one design: masses (frames, masses, 3) or com, the center of
        mass, (frames, 3), in meters; actuation (frames, springs), contacts (frames, masses). They
        must have been requested with `record`."""
        reply = await self._connection.send(Request.get(
            f"/v1/evaluations/{self.id}/trajectories/{place}/file",
            accept="application/octet-stream", environment=environment, array=array))
        with reading():
            shape = [int(side) for side in reply.headers["Morphod-Shape"].split(",")]
            kind = _ELEMENTS[reply.headers["Morphod-Type"]]
            return np.frombuffer(reply.content, dtype=kind).reshape(shape)

    async def recordings(self,
                         array: Literal["masses", "com", "actuation", "contacts"] = "com"
                         ) -> NDArray[Any]:
        """Returns all recordings as one array, with one request: com (designs, environments,
        frames, 3), masses (designs, environments, frames, masses, 3) in meters, actuation (designs,
        environments, frames, springs), contacts (designs, environments, frames, masses).

        Designs differ in masses and springs. The array is as large as the largest design
        needs; unused entries, and skipped designs, are NaN, -128 in actuation, or 255
        in contacts.
        """
        reply = await self._connection.send(Request.get(
            f"/v1/evaluations/{self.id}/trajectories", accept="application/octet-stream",
            array=array))
        return read_npy(reply.content)

    async def show(self, place: int = 0, environment: int = 0) -> Player:
        """Shows the robot walking: in a notebook as a player, elsewhere `show().save(path)` writes
        an HTML file. Recomputes the rollout, so nothing needs to be recorded."""
        world = world_of(await self._connection.json(
            Request.get(f"/v1/evaluations/{self.id}/environments")), environment)
        result = self[place]
        with reading():
            request = Request.post("/v1/rollouts", {
                "designs": [{"voxels": result.genotype}],
                "environments": [world],
                "controller": f"sha256:{self.data['controller']['sha256']}",
                "physics": self.data["physics"], "precision": self.data["precision"],
                "record": ["masses"], "record_stride": 8,
            }, accept=MEDIA_TYPE)
        scene = Scene((await self._connection.send(request)).content)
        return await player(self._connection, scene, f"Design {place} of evaluation {self.id}")
