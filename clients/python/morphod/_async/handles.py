"""Evaluations, campaigns, trainings and controllers of the service, as objects."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import anyio
import numpy as np

from ..checks import check_results
from ..errors import JobError, MorphodError, WaitError, printable, reading
from ..frames import frame, frame_of_columns, pandas
from ..phylogenies import Phylogeny
from ..player import Player, player_of
from ..progress import Bar, doing
from ..results import Controller, Result, Svg, losses_of, measures_of, units_of, values_of
from ..scenes import MEDIA_TYPE, Scene, read_npy
from .._wire import WAIT_S, Request, given
from .connection import AsyncConnection

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray

_ENDED = ("succeeded", "failed", "cancelled")
_STATES = ("queued", "running", "paused", *_ENDED)
_POLL_S = 1.0
AT_ONCE_S = 0.5
"""If a request that should have waited gets its reply earlier, it is not repeated at once."""

_ELEMENTS = {"float32-le": "<f4", "int8": "i1", "uint8": "u1"}


def interrupted(*jobs: AsyncJob) -> KeyboardInterrupt:
    """Returns the exception for an interrupt, which lists the jobs that continue."""
    words = "; ".join(f"{job.noun} {job.id} continues: {job.finder}({job.id!r}).cancel(), or "
                      f"morphoctl job cancel {job.id}, ends it" for job in jobs if not job.ended)
    return KeyboardInterrupt(*([words] if words else []))


class AsyncJob:
    """What evaluations, campaigns and trainings have in common.

    `data` is the job as last reported by the service, with the names of the contract.
    """

    _list = "/v1/jobs"
    noun = "job"
    finder = "client.job"

    def __init__(self, connection: AsyncConnection, data: dict[str, Any]) -> None:
        self._connection = connection
        self.data = data
        with reading():
            data["id"], data["state"]

    @property
    @reading()
    def id(self) -> str:
        """The number of the job, as text."""
        return str(self.data["id"])

    @property
    @reading()
    def state(self) -> str:
        """queued, running, paused, succeeded, failed or cancelled, as last reported."""
        return _STATES[_STATES.index(self.data["state"])]

    @property
    @reading()
    def label(self) -> str | None:
        """A text that identifies it; `edit` changes it."""
        label: str | None = self.data["label"]
        return label

    @property
    @reading()
    def experiment(self) -> str | None:
        """The experiment that it belongs to, with other jobs."""
        experiment: str | None = self.data["experiment"]
        return experiment

    @property
    @reading()
    def note(self) -> str | None:
        """A remark by a user."""
        note: str | None = self.data["note"]
        return note

    @property
    @reading()
    def core_seconds(self) -> float:
        """Core seconds spent on it, as last reported."""
        return float(self.data["core_seconds"])

    @property
    def ended(self) -> bool:
        """Whether it has succeeded, failed or been cancelled, as last reported."""
        return self.state in _ENDED

    @property
    @reading()
    def warnings(self) -> list[str]:
        """Caveats about the result, as last reported; for example, that every robot diverged, or
        that the time step is too large to be stable. `wait` and `live` issue each as a
        `UserWarning`; `data["warnings"]` has their codes."""
        return [printable(warning["detail"]) for warning in self.data["warnings"]]

    @reading()
    def __repr__(self) -> str:
        codes = "".join(f", {printable(warning['code'])}" for warning in self.data["warnings"])
        label = f", label={self.label!r}" if self.label else ""
        return f"<{type(self).__name__} {self.id}: {self.state}{codes}{label}>"

    async def refresh(self) -> None:
        """Fetches the job's state from the service."""
        self.data = await self._connection.json(Request.get(f"{self._list}/{self.id}"))

    async def wait(self, timeout_s: float | None = None) -> None:
        """Waits until the job has succeeded. Raises `JobError` if it failed or was cancelled, and
        `WaitError` after `timeout_s`; the job then continues. It does not matter if the service
        restarts in the meantime."""
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        try:
            while not self.ended:
                asked = time.monotonic()
                left = WAIT_S if deadline is None else min(WAIT_S, int(deadline - asked))
                if deadline is not None and asked >= deadline:
                    raise WaitError(
                        f"job {self.id} is {self.state} after {timeout_s} s; it continues")
                self.data = await self._connection.json(
                    Request.get(f"{self._list}/{self.id}", wait_s=max(left, 1)))
                if not self.ended and time.monotonic() - asked < AT_ONCE_S:
                    await anyio.sleep(AT_ONCE_S)
        except KeyboardInterrupt:
            raise interrupted(self) from None
        self._conclude()

    def _conclude(self) -> None:
        """Called at the end of a wait."""
        self._require_success()
        for detail in self.warnings:
            warnings.warn(f"job {self.id}: {detail}", stacklevel=3)

    def _require_success(self) -> None:
        if self.state == "succeeded":
            return
        error = self.data.get("error")
        detail = error.get("detail") if isinstance(error, Mapping) else None
        why = f": {printable(detail)}" if detail else ""
        raise JobError(f"job {self.id} {'failed' if self.state == 'failed' else 'was cancelled'}"
                       f"{why}", self.data)

    async def _watch(self, title: str, unit: str) -> None:
        try:
            with Bar(title, self._steps()[1], unit) as bar:
                while True:
                    done, total = self._steps()
                    with reading():
                        bar.update(done, total, doing(self.data), **self._numbers())
                    if self.ended:
                        break
                    await anyio.sleep(_POLL_S)
                    await self.refresh()
        except KeyboardInterrupt:
            raise interrupted(self) from None
        self._conclude()

    @reading()
    def _steps(self) -> tuple[int, int]:
        return int(self.data["rollouts_done"]), int(self.data["rollouts_total"])

    @reading()
    def _numbers(self) -> dict[str, float | None]:
        return {}

    async def _act(self, action: str, value: Mapping[str, Any] | None = None) -> None:
        await self._connection.send(Request.post(f"/v1/jobs/{self.id}/{action}", value))
        await self.refresh()

    async def pause(self) -> None:
        """Pauses it; after `resume` it ends with the same bits."""
        await self._act("pause")

    async def resume(self) -> None:
        """Resumes a paused or failed job."""
        await self._act("resume")

    async def cancel(self) -> None:
        """Cancels it permanently. Results that a campaign or training has committed stay."""
        await self._act("cancel")

    async def weigh(self, weight: float) -> None:
        """Sets its share of the computing threads relative to other jobs; no result changes."""
        await self._act("weight", {"weight": weight})

    async def edit(self, **changes: str | bool | None) -> None:
        """Changes `label`, `experiment` or `note` (None removes it) and `archived`: an archived job
        is hidden from lists. `job.edit(note="for the paper", archived=True)`."""
        await self._connection.send(Request.post(f"/v1/jobs/{self.id}", changes,
                                                 method="PATCH"))
        await self.refresh()

    async def delete(self) -> dict[str, Any]:
        """Deletes it permanently, once it has ended, with everything that belongs only to it:
        results, recordings, curves, phylogeny. Returns what `stays`, and why. Raises `ApiError`
        (409) if another job needs it."""
        reply: dict[str, Any] = await self._connection.json(
            Request("DELETE", f"/v1/jobs/{self.id}"))
        return reply


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
                               "table() reads their results, table(whole=True) the best ones")
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
        """(designs, environments): the scores in the units of the tasks, larger is better; for
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
        or keep the same robots, use `robots`: an id without an orientation means the one with the
        best stored score.
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
        task with the mean value in its unit, larger is better (NaN if a rollout diverged or the
        body was skipped), and `mean_loss`, over the tasks that have a loss; `left_out` names the
        others."""
        with reading():
            if "suite" not in self.data:
                raise MorphodError(f"evaluation {self.id} is not in a suite: table() reads its "
                                   "results")
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
        notebooks show: an axis for each task, and a polygon for each of up to 6 designs (default:
        those with the least mean loss)."""
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

        Designs differ in masses and springs. The array is as large as the largest design needs;
        entries that a design does not use, and skipped designs, are NaN, -128 in actuation, or 255
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


@reading()
def world_of(worlds: Mapping[str, Any], environment: int) -> dict[str, Any]:
    """One of the environments that the service lists."""
    items = worlds["items"]
    if not -len(items) <= environment < len(items):
        raise MorphodError(f"there is no environment {environment}: there are {len(items)}, "
                           "counted from 0")
    return {name: value for name, value in items[environment].items() if name != "sha256"}


async def player(connection: AsyncConnection, scene: Scene, title: str) -> Player:
    """Returns a player for a scene, made from the modules of the service's own dashboard."""
    index = await connection.send(Request.get("/", accept="text/html"))
    with reading():
        making = player_of(index.content.decode(), scene, title)
        step = next(making)
    while isinstance(step, str):
        content = (await connection.send(Request.get(step, "*/*"))).content
        with reading():
            step = making.send(content.decode())
    return step


class AsyncTraining(AsyncJob):
    """A controller that learns."""

    _list = "/v1/trainings"
    noun = "training"
    finder = "client.training"

    @reading()
    def _steps(self) -> tuple[int, int]:
        progress = self.data["progress"]
        return progress["step"], progress["steps"]

    @reading()
    def _numbers(self) -> dict[str, float | None]:
        validation = self.data["validation"] or {}
        return {"loss": self.data["progress"]["mean_loss"],
                "validation": validation.get("mean_score")}

    async def live(self) -> AsyncTraining:
        """Shows its progress until it has ended."""
        await self._watch(f"training {self.id}", " steps")
        return self

    async def steps(self) -> pd.DataFrame:
        """Returns a table with a row per step."""
        path = f"/v1/trainings/{self.id}/steps"
        return frame([row async for row in self._connection.pages(path)])

    async def validations(self) -> pd.DataFrame:
        """Returns a table with a row per validation."""
        path = f"/v1/trainings/{self.id}/validations"
        return frame([row async for row in self._connection.pages(path)])

    async def controller(self, step: int | None = None) -> Controller:
        """Returns the result, or while it learns the controller of the newest checkpoint, or the
        controller of the checkpoint at `step`."""
        reply = await self._connection.send(Request.get(
            f"/v1/trainings/{self.id}/controller", accept="application/octet-stream", step=step))
        return Controller({"name": self.data["name"]}, reply.content)


class AsyncCampaign(AsyncJob):
    """A population that evolves."""

    _list = "/v1/campaigns"
    noun = "campaign"
    finder = "client.get_campaign"

    @reading()
    def _steps(self) -> tuple[int, int]:
        progress = self.data["progress"]
        return (progress["generation"] or 0), progress["generations"]

    @reading()
    def _numbers(self) -> dict[str, float | None]:
        newest = self.data["newest"]
        if newest is None:
            return {}
        return {"best": newest["score"]["quantiles"]["p0"], "mean": newest["score"]["mean"],
                "diversity": newest["diversity"]}

    @property
    @reading()
    def left_out(self) -> list[dict[str, Any]]:
        """The initial designs that are not in generation 0, each with its `place` and `fault`:
        designs of another campaign that do not fit the workspace, and listed designs that were
        skipped.
        """
        if "founders" not in self.data:
            raise MorphodError("a list of campaigns does not have their founders: refresh() first")
        return [note for note in self.data["founders"] if note["fault"] is not None]

    async def live(self) -> AsyncCampaign:
        """Shows its progress until it has ended."""
        await self._watch(f"campaign {self.id}", " generations")
        return self

    @reading()
    def _constant(self) -> dict[str, Any]:
        return {"campaign": self.id, "group": self.data["group"]["id"],
                "replicate": self.data["group"]["replicate"], "label": self.label,
                "mode": self.data["mode"], "seed": self.data["settings"]["seed"]}

    async def curve(self, stride: int = 1) -> pd.DataFrame:
        """Returns a table with a row per generation: campaign, group, replicate, label, mode,
        state, seed, own_score (its name, in a study that has one), generation, and every statistic
        (`score_mean`, `score_quantiles_p0`, `diversity`, …). With a `stride` only generations that
        are multiples of it."""
        return await curves(self._connection, stride, campaigns=self.id)

    async def learning(self) -> pd.DataFrame:
        """Returns a table with a row per step of learning; empty in a zero-shot campaign."""
        path = f"/v1/campaigns/{self.id}/learning"
        rows = [row async for row in self._connection.pages(path)]
        return frame(rows, **self._constant())

    async def population(self, generation: int | None = None) -> pd.DataFrame:
        """Returns a table of the population after a generation (default: the newest), best
        first."""
        path = f"/v1/campaigns/{self.id}/population"
        # A cursor includes its generation.
        return frame([row async for row in self._connection.pages(path, generation=generation)])

    async def champions(self, count: int = 12) -> pd.DataFrame:
        """Returns a table of the best design and a sample of the others, most distinct first."""
        found = await self._connection.json(
            Request.get(f"/v1/campaigns/{self.id}/champions", count=count))
        with reading():
            return frame(found["items"])

    async def evaluate_champions(self, environments: str = "morpho-12", count: int = 12, *,
                                 controller: str | None = None, label: str | None = None,
                                 wait: bool = True) -> AsyncEvaluation:
        """Scores the champions in a named set of environments or a suite, with the physics of the
        campaign and, unless `controller` is given, the controller that scored them. With
        `wait=False` it returns at once, when the evaluation is durable."""
        request = Request.submit(f"/v1/campaigns/{self.id}/champions", given(
            count=count, environments=environments, controller=controller, label=label),
            wait_s=WAIT_S if wait else 0)
        evaluation = AsyncEvaluation(self._connection, await self._connection.json(request))
        if wait:
            await evaluation.wait()
        return evaluation

    async def phylogeny(self, lineages: bool = False) -> Phylogeny:
        """Returns every design ever born; with `lineages`, only the living and their ancestors."""
        reply = await self._connection.send(Request.get(
            f"/v1/campaigns/{self.id}/phylogeny", accept=MEDIA_TYPE, format="columns",
            keep="lineages" if lineages else "all"))
        return Phylogeny(reply.content)

    async def extend(self, generations: int) -> None:
        """Adds generations; a campaign that has succeeded continues."""
        request = Request.submit(f"/v1/campaigns/{self.id}/extend", {"generations": generations})
        self.data = await self._connection.json(request)

    async def show(self, count: int = 4, environment: int = 0) -> Player:
        """Shows the champions side by side, as they walk now: a player for notebooks."""
        champions = await self._connection.json(
            Request.get(f"/v1/campaigns/{self.id}/champions", count=count))
        world = world_of(await self._connection.json(
            Request.get(f"/v1/campaigns/{self.id}/environments")), environment)
        with reading():
            result = self.data["result"]
            controller = (result["controller"] if result else self.data["controller"]) or {}
            if "sha256" not in controller:
                raise MorphodError(f"campaign {self.id} has no controller yet: wait() for its end")
            request = Request.post("/v1/rollouts", {
                "designs": [{"voxels": row["genotype"]} for row in champions["items"]],
                "environments": [world],
                "controller": f"sha256:{controller['sha256']}",
                "physics": self.data["settings"]["physics"],
                "record": ["masses"], "record_stride": 8,
            }, accept=MEDIA_TYPE)
        scene = Scene((await self._connection.send(request)).content)
        return await player(self._connection, scene, f"Champions of campaign {self.id}")


class AsyncCampaigns:
    """Campaigns that were started together: replicates that differ only in their seeds. A
    sequence."""

    def __init__(self, connection: AsyncConnection, members: Sequence[AsyncCampaign]) -> None:
        self._connection = connection
        self._members = list(members)

    def __len__(self) -> int:
        return len(self._members)

    def __getitem__(self, place: int) -> AsyncCampaign:
        return self._members[place]

    def __iter__(self) -> Iterator[AsyncCampaign]:
        return iter(self._members)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self._members!r}>"

    async def wait(self, timeout_s: float | None = None) -> None:
        """Waits until all have succeeded; see `wait` of one."""
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        try:
            for member in self._members:
                await member.wait(
                    None if deadline is None else max(0.0, deadline - time.monotonic()))
        except KeyboardInterrupt:
            raise interrupted(*self._members) from None

    async def live(self) -> AsyncCampaigns:
        """Shows the progress of all of them until they have ended."""
        total = sum(member._steps()[1] for member in self._members)
        try:
            with Bar(f"{len(self)} campaigns", total, " generations") as bar:
                while True:
                    bests = [member._numbers().get("best") for member in self._members]
                    known = [best for best in bests if best is not None]
                    # The phase of the first running one: while one draws bodies, the others wait
                    # for it.
                    active = next((member.data for member in self._members
                                   if member.state == "running"), None)
                    with reading():
                        bar.update(sum(member._steps()[0] for member in self._members), total,
                                   doing(active) if active else "",
                                   best=min(known) if known else None)
                    if all(member.ended for member in self._members):
                        break
                    await anyio.sleep(_POLL_S)
                    for member in self._members:
                        if not member.ended:
                            await member.refresh()
        except KeyboardInterrupt:
            raise interrupted(*self._members) from None
        for member in self._members:
            member._conclude()
        return self

    async def curves(self, stride: int = 1) -> pd.DataFrame:
        """Returns one tidy table of all their generations; see `curve` of one."""
        return await curves_of(self._connection, [member.id for member in self._members], stride)


async def curves(connection: AsyncConnection, stride: int = 1, **which: Any) -> pd.DataFrame:
    """Returns one tidy table of the generations of campaigns, with one request."""
    reply = await connection.send(Request.get(
        "/v1/campaigns/generations", accept=MEDIA_TYPE, stride=stride, **which))
    return frame_of_columns(reply.content)


async def curves_of(connection: AsyncConnection, ids: Iterable[str | int], stride: int = 1
                    ) -> pd.DataFrame:
    """Does the same by ids, with as many in a request as fit in an address."""
    ascending = sorted({int(id) for id in ids})
    tables = [await curves(connection, stride, campaigns=",".join(map(str, ascending[at:at + 40])))
              for at in range(0, len(ascending), 40)]
    joined: pd.DataFrame = pandas().concat(tables, ignore_index=True) if tables else frame([])
    return joined
