"""The client: everything begins here."""

from __future__ import annotations

import copy
import datetime
import os
import pathlib
import warnings
from collections.abc import AsyncIterator, Callable, Iterable, Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal

from ..bodies import (BodyLike, OnFault, Repair, designs_of, packed, requests_of, voxels_of,
                      warn_of_ids, warn_of_lost)
from ..comparisons import CampaignComparison, ControllerComparison
from ..errors import MorphodError, reading
from ..frames import frame, pandas
from ..objectives import Plan
from ..player import Player
from ..results import Controller
from ..scenes import MEDIA_TYPE, Environments, Scene
from ..scores import Entered, blocks
from ..weights import write_safetensors
from .._wire import WAIT_S, Request, given as _given, without_none
from . import comparing
from .connection import AsyncConnection
from .fleet import AsyncFleet
from .handles import (AsyncCampaign, AsyncCampaigns, AsyncEvaluation, AsyncTraining, curves,
                      curves_of, interrupted, player, world_of)
from .studies import AsyncStudy

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd
    from numpy.typing import NDArray
    from typing_extensions import Self

Physics = Mapping[str, Any] | Literal["paper"]
"""Physics settings of a request: some of them, or all of those of the paper."""
_DESIGNS_MAX = 10000
_LARGE_MAX = 1000000
_RANDOM_BODIES_MAX = 1000000
_LOOK_UP_S = 5.0
"""How long an interrupted call looks for the job that continues."""


def _measures(measures: Literal[True] | Sequence[str] | None) -> Any:
    """As the service wants them, which refuses a single text."""
    return measures if measures is None or isinstance(measures, (bool, str)) else list(measures)


class AsyncClient:
    """A client of a morphod service.

    `server` is `http://host:port`, `https://…` or `unix:/path`; the default is $MORPHOD_SERVER, or
    else http://127.0.0.1:8765. `token` is needed if the service requires one; the default is
    $MORPHOD_TOKEN. While the service is unavailable (a restart, an upgrade), busy or full, requests
    are retried for `retry_s` seconds. Submissions have a key, so none is accepted twice.

    Refused requests raise `morphod.ApiError`, which lists the faults that the service found.
    """

    def __init__(self, server: str | None = None, token: str | None = None, *,
                 retry_s: float = 60.0) -> None:
        self._connection = AsyncConnection(server, token, retry_s)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, kind: type[BaseException] | None, error: BaseException | None,
                        trace: TracebackType | None) -> None:
        await self.close()

    async def close(self) -> None:
        """Closes the connections."""
        await self._connection.close()

    def __repr__(self) -> str:
        address = self._connection.address
        return f"{type(self).__name__}({'unix:' + address.unix if address.unix else address.url!r})"

    # ---- scores ----

    async def evaluate(self, bodies: Iterable[BodyLike] | NDArray[Any],
                       environments: Environments = "paper-test", *,
                       controller: str = "default",
                       record: Sequence[str] = (), record_stride: int = 10,
                       physics: Physics | None = None,
                       precision: Literal["float32", "float64"] = "float32",
                       priority: Literal["interactive", "batch"] | None = None,
                       weight: float = 1.0, device: Literal["auto", "cpu", "cuda"] = "auto",
                       label: str | None = None, experiment: str | None = None,
                       verify: bool = False, best: int | None = None, error: bool = False,
                       measures: Literal[True] | Sequence[str] | None = None,
                       tolerance: float | None = None,
                       repair: Repair | None = None, on_fault: OnFault = "refuse",
                       wait: bool = True) -> AsyncEvaluation:
        """Scores up to 1,000,000 bodies (see `Body.of`; an array (n, 6, 6, 4) is fastest). With
        more than 10,000, no body is skipped or repaired, ids need an orientation, nothing is
        recorded, and `table()` reads the results in pages. To score random bodies without sending
        them, see `evaluate_random`.

        `wait=False` returns at once, when the evaluation is durable. `record` accepts "com" and
        "masses", which are recorded every `record_stride` steps. `physics` overrides single
        settings, such as `{"dt_s": 0.001, "n_steps": 4000}`, or is "paper" for those of the paper.
        `repair="largest"` keeps the largest piece of bodies that are not in one piece.
        `on_fault="skip"` skips invalid bodies; their results have a `fault` and NaN. `best=10`
        computes complete scores only for the ten best; the others are cut short, and have lower
        bounds. `error=True` estimates the error of each score, at six times the cost: see
        `Result.error`. `tolerance=0.01` chooses time step and precision for each design, so that
        its score has at most that estimated error: see `Result.tolerance`. `measures` requests
        numbers that describe each rollout, such as `["displacement_m", "work_j"]`, or all with
        True: see `measures` of the evaluation and of `Result`. An id without an orientation is
        scored in the orientation with the best stored score, or else in the canonical one;
        `Result.orientation` says which.
        """
        designs, lost, faults = requests_of(bodies, on_fault)
        if not 0 < len(designs) <= _LARGE_MAX:
            raise ValueError(f"an evaluation needs 1 to {_LARGE_MAX} bodies, got {len(designs)}")
        is_large = len(designs) > _DESIGNS_MAX
        if is_large:
            designs = packed(designs)
            warn_of_lost(lost)  # results in pages do not have it
        value: dict[str, Any] = {
            "designs": designs, "environments": environments, "controller": controller,
            "precision": precision, "weight": weight, "device": device, "verify": verify,
            "on_fault": on_fault,
            **_given(physics=physics, priority=priority, label=label, experiment=experiment,
                     repair=repair, best=best, error=error or None, tolerance=tolerance,
                     measures=_measures(measures)),
        }
        if record:
            value.update(record=list(record), record_stride=record_stride)
        request = Request.submit("/v1/evaluations", value, wait_s=WAIT_S if wait else 0)
        try:
            data = await self._connection.json(request)
        except KeyboardInterrupt:
            raise await self._interrupted(request) from None
        evaluation = AsyncEvaluation(self._connection, data, lost, faults)
        if wait:
            await evaluation.wait()
            if not is_large and "results" in evaluation.data:
                evaluation._check(designs)
        return evaluation

    async def _interrupted(self, request: Request) -> KeyboardInterrupt:
        """Returns the exception for an interrupted submission. The key finds the job, if there is
        one."""
        connection = copy.copy(self._connection)
        connection.retry_s, request.timeout_s = 0.0, _LOOK_UP_S
        request.headers.pop("Prefer", None)
        try:
            found = AsyncEvaluation(connection, await connection.json(request))
            return interrupted(found)
        except MorphodError:
            return KeyboardInterrupt("if the evaluation was accepted, it continues: client.jobs() "
                                     "or morphoctl job list shows it")
        finally:
            await connection.close()

    async def suite(self, bodies: Iterable[BodyLike] | NDArray[Any], *, held_out: bool = False,
                    controller: str = "default", physics: Physics | None = None,
                    weight: float = 1.0, device: Literal["auto", "cpu", "cuda"] = "auto",
                    label: str | None = None, experiment: str | None = None) -> pd.DataFrame:
        """Scores bodies in all tasks of the suite morpho-12 (docs/suite.md), as one evaluation.
        Returns its `suite_table()`: the mean values in the unit of each task, larger is better, and
        the mean loss. `held_out` takes the 64 held-out worlds of each task, for reports, in place
        of the ten to select with. To submit it without waiting, use
        `evaluate(bodies, "morpho-12", wait=False)`; for a campaign's champions, the campaign's
        `evaluate_champions("morpho-12")`."""
        done = await self.evaluate(bodies, "morpho-12-held-out" if held_out else "morpho-12",
                                   controller=controller, physics=physics, weight=weight,
                                   device=device, label=label, experiment=experiment)
        return await done.suite_table()

    async def evaluate_random(self, count: int, seed: int = 1, *, first: int = 0,
                              environments: Environments = "paper-test",
                              controller: str = "default",
                              physics: Physics | None = None,
                              precision: Literal["float32", "float64"] = "float32",
                              weight: float = 1.0, device: Literal["auto", "cpu", "cuda"] = "auto",
                              label: str | None = None, experiment: str | None = None,
                              best: int | None = None, error: bool = False,
                              measures: Literal[True] | Sequence[str] | None = None,
                              tolerance: float | None = None,
                              wait: bool = True) -> AsyncEvaluation:
        """Scores the bodies of `random_bodies(count, seed, first=first)` without sending them: up
        to 1,000,000 in one evaluation, with one `best` for all. The service first draws and stores
        them; until then the evaluation is queued. `error`, `tolerance` and `measures` as in
        `evaluate`.

        With more than 10,000 bodies, `table()` reads the results in pages; `table(whole=True)`
        reads only those that are not lower bounds.
        """
        value: dict[str, Any] = {
            "random": {"count": count, "seed": seed, "first": first},
            "environments": environments, "controller": controller, "precision": precision,
            "weight": weight, "device": device,
            **_given(physics=physics, label=label, experiment=experiment, best=best,
                     error=error or None, tolerance=tolerance, measures=_measures(measures)),
        }
        request = Request.submit("/v1/evaluations", value, wait_s=WAIT_S if wait else 0)
        try:
            data = await self._connection.json(request)
        except KeyboardInterrupt:
            raise await self._interrupted(request) from None
        evaluation = AsyncEvaluation(self._connection, data)
        if wait:
            await evaluation.wait()
        return evaluation

    async def evaluation(self, id: str | int) -> AsyncEvaluation:
        """Returns the evaluation with an id."""
        data = await self._connection.json(Request.get(f"/v1/evaluations/{id}"))
        return AsyncEvaluation(self._connection, data)

    async def rollouts(self, bodies: Iterable[BodyLike] | NDArray[Any],
                       environments: Environments = "paper-test", *,
                       controller: str = "default", record: Sequence[str] = ("masses", ),
                       record_stride: int = 10, physics: Physics | None = None,
                       precision: Literal["float32", "float64"] = "float32",
                       repair: Repair | None = None) -> Scene:
        """Computes up to 64 rollouts and their recordings without storing them, for viewers and
        editors. The losses are the same as in an evaluation, bit for bit. A warning about the
        physics is issued as a `UserWarning`."""
        request = Request.post("/v1/rollouts", without_none({
            "designs": designs_of(bodies), "environments": environments, "controller": controller,
            "record": list(record), "record_stride": record_stride, "precision": precision,
            "physics": physics, "repair": repair,
        }), accept=MEDIA_TYPE)
        scene = Scene((await self._connection.send(request)).content)
        for warning in scene.warnings:
            warnings.warn(warning, stacklevel=2)
        return scene

    async def show(self, bodies: Iterable[BodyLike] | NDArray[Any],
                   environments: Environments = "paper-test", *,
                   environment: int = 0, controller: str = "default",
                   physics: Physics | None = None, repair: Repair | None = None,
                   title: str = "Robots of morphod") -> Player:
        """Returns robots that walk in one environment: a player for notebooks, which `save` writes
        as one HTML file."""
        if isinstance(environments, str):
            known = await self._connection.json(Request.get(f"/v1/environment-sets/{environments}"))
            world: Mapping[str, Any] = world_of(known, environment)
        elif -len(environments) <= environment < len(environments):
            world = environments[environment]
        else:
            raise MorphodError(f"there is no environment {environment}: {len(environments)} are "
                               "given, counted from 0")
        scene = await self.rollouts(bodies, [world], controller=controller,
                                    record_stride=8, physics=physics, repair=repair)
        return await player(self._connection, scene, title)

    async def random_bodies(self, count: int, seed: int | None = None, *,
                            first: int = 0) -> NDArray[np.bool_]:
        """Returns distinct random bodies (count, 6, 6, 4), as trainings draw them, none a rotation
        or reflection of another; nothing is stored. A seed (1 by default) has 1,000,000 bodies,
        always the same; this returns number `first`, `first + 1`, … of them. Two seeds share
        bodies: for more bodies, increase `first`."""
        if count < 1 or first < 0 or first + count > _RANDOM_BODIES_MAX:
            raise ValueError(f"a seed has the bodies 0 to {_RANDOM_BODIES_MAX - 1}, got {first} to "
                             f"{first + count - 1}; count is at least 1")
        made: list[dict[str, Any]] = []
        for place in range(first, first + count, _DESIGNS_MAX):
            made += await self._make("random", {
                "first": place, "count": min(first + count - place, _DESIGNS_MAX), "seed": seed})
        return self._voxels(made)

    async def mutate(self, bodies: Iterable[BodyLike] | NDArray[Any], seed: int | None = None, *,
                     children: int = 1, rate: float | None = None) -> NDArray[np.bool_]:
        """Returns mutants as campaigns make them: `children` of each body, (bodies · children, 6,
        6, 4), in the order of the bodies. Each differs from all bodies and all other mutants.
        `rate` is the probability that a voxel flips (default: 1/144). `seed` is 1 by default."""
        return self._voxels(await self._make("mutate", {
            "designs": designs_of(bodies), "seed": seed, "children": children, "rate": rate}))

    async def cross(self, bodies: Iterable[BodyLike] | NDArray[Any],
                    others: Iterable[BodyLike] | NDArray[Any]) -> NDArray[np.bool_]:
        """Returns the children (n, 6, 6, 4) of n bodies and n others: the largest piece of the
        voxels that exactly one parent has. The child of equal parents is empty."""
        first, second = designs_of(bodies), designs_of(others)
        if len(first) != len(second):
            raise ValueError(f"{len(first)} bodies cannot be crossed with {len(second)}")
        pairs = [[place, len(first) + place] for place in range(len(first))]
        return self._voxels(await self._make(
            "cross", {"designs": first + second, "pairs": pairs}))

    async def canonical(self, bodies: Iterable[BodyLike] | NDArray[Any]) -> list[str]:
        """Returns the ids of bodies: their canonical forms, which rotations about z and reflections
        in x and y do not change. `Body.of` converts an id to the body in its canonical orientation.
        For scoring, an id without an orientation means the orientation with the best stored
        score."""
        made = await self._make("canonical", {"designs": designs_of(bodies)})
        with reading():
            return [row["id"] for row in made]

    @staticmethod
    @reading()
    def _voxels(made: Iterable[Mapping[str, Any]]) -> NDArray[np.bool_]:
        return voxels_of(row["genotype"] for row in made)

    async def _make(self, how: str, value: Mapping[str, Any]) -> list[dict[str, Any]]:
        made = await self._connection.json(Request.post(f"/v1/bodies/{how}", without_none(value)))
        with reading():
            items: list[dict[str, Any]] = made["items"]
            if not all(isinstance(item, dict) for item in items):
                raise TypeError("a body of the list is not an object")
            return items

    def objective(self, measures: Sequence[Any] | None = None, *,
                  decode: Callable[[Any], BodyLike] | None = None,
                  maximize: bool | None = None, worst: float = 10.0,
                  **settings: Any) -> AsyncObjective:
        """Returns a function that an optimizer calls with its solutions; see `Objective`."""
        return AsyncObjective(self, measures, decode, maximize, worst, settings)

    async def designs(self, *, sort: Literal["id", "score"] = "score", limit: int = 100,
                      **filters: Any) -> pd.DataFrame:
        """Returns a table of designs that were ever scored; sorted by score, the best come first.
        `filters` are those of GET /v1/designs, such as `controller`."""
        rows = []
        async for row in self._connection.pages("/v1/designs", limit=min(limit, 1000), sort=sort,
                                                **filters):
            rows.append(row)
            if len(rows) >= limit:
                break
        return frame(rows)

    # ---- campaigns ----

    async def campaign(self, mode: Literal["zero-shot", "few-shot", "simultaneous"], *,
                       preset: Literal["paper", "workstation", "demo"] | None = None,
                       replicates: int = 1, label: str | None = None,
                       initial: Iterable[BodyLike] | NDArray[Any] | AsyncCampaign | None = None,
                       repair: Repair | None = None, on_fault: OnFault = "refuse",
                       **settings: Any) -> AsyncCampaigns:
        """Starts a campaign, or `replicates` of them with the seeds `seed`, `seed + 1`, …

        `initial` is a list of bodies for the first population, or a campaign whose population is
        copied. Of that campaign, designs that do not fit the workspace are left out, with a warning
        (`left_out`). `repair` and `on_fault` are as in `evaluate`. `settings` are those of the
        contract (docs/evolution.md), such as `population`, `generations`, `seed`, `selection`,
        `mutation`, `physics`. With `measures`, such as `["work_j"]` or True, tables of designs have
        a column for the mean of each measure; with `select_by`, such as `{"measure":
        "displacement_m", "direction": "max"}`, the campaign selects by one.
        """
        value: dict[str, Any] = {"mode": mode, "replicates": replicates,
                                 **_given(preset=preset, label=label), **settings}
        if isinstance(initial, AsyncCampaign):
            value["initial"] = {"campaign": initial.id}
        elif initial is not None:
            value["initial"] = {"designs": designs_of(initial, on_fault),
                                "on_fault": on_fault, **_given(repair=repair)}
        first = await self._connection.json(Request.submit("/v1/campaigns", value))
        members = [AsyncCampaign(self._connection, first)]
        if replicates > 1:
            group = [AsyncCampaign(self._connection, data) async for data in
                     self._connection.pages("/v1/campaigns", group=first["id"])]
            with reading():
                members = sorted(group, key=lambda member: int(member.data["group"]["replicate"]))
                for member in members:  # lists do not have it; all campaigns share it
                    member.data["founders"] = first["founders"]
        with reading():
            warn_of_ids(first["founders"])
        if isinstance(initial, AsyncCampaign) and members[0].left_out:
            warnings.warn(f"{len(members[0].left_out)} designs of campaign {initial.id} do not fit "
                          "the workspace and are left out; random bodies take their places",
                          stacklevel=2)
        return AsyncCampaigns(self._connection, members)

    async def study(self, name: str, *, population: int | None = None,
                    environments: Environments | None = None, controller: str | None = None,
                    physics: Physics | None = None,
                    own_score: Mapping[str, str] | None = None, **settings: Any) -> AsyncStudy:
        """Returns a study that your search drives: the one with this name that has not ended, or a
        new one. The service finds or creates it in one step, so processes that open the same name
        at the same time share one study.

        The name is the label of its campaign. `population` is the maximum number of living designs
        (512). With `own_score`, such as `{"name": "work_per_meter", "unit": "J/m"}`, the study
        ranks by the scores that you pass to `AsyncStudy.tell`. With `measures`, each `Batch` has
        them, so that you can compute a score of your own. `settings` are those of the contract
        (docs/studies.md), such as `selection`, `mutation`, `seed`. Raises `ConflictError`, which
        lists each setting that differs from the study's.
        """
        value = {"mode": "study", "label": name, "if_exists": "return", **settings,
                 **_given(population=population, environments=environments, controller=controller,
                          physics=physics, own_score=own_score)}
        return AsyncStudy(self._connection, await self._connection.json(
            Request.submit("/v1/campaigns", value)))

    async def campaigns(self, *, label: str | None = None, experiment: str | None = None,
                        state: str | None = None, group: str | None = None,
                        archived: Literal["true", "all"] | None = None) -> AsyncCampaigns:
        """Returns campaigns with this label (`"gait*"` matches a prefix), experiment, state and
        group, newest first."""
        return AsyncCampaigns(self._connection, [
            AsyncCampaign(self._connection, data) async for data in
            self._connection.pages("/v1/campaigns", label=label, experiment=experiment,
                                   state=state, group=group, archived=archived)])

    async def get_campaign(self, id: str | int) -> AsyncCampaign:
        """Returns the campaign with an id."""
        data = await self._connection.json(Request.get(f"/v1/campaigns/{id}"))
        return AsyncCampaign(self._connection, data)

    async def curves(self, *, label: str | None = None, experiment: str | None = None,
                     group: str | None = None,
                     ids: Iterable[str | int] | None = None, stride: int = 1) -> pd.DataFrame:
        """Returns one tidy table of the generations of many campaigns, selected by label,
        experiment, group or ids. With a `stride`, only generations that are multiples of it."""
        if ids is not None:
            return await curves_of(self._connection, ids, stride)
        return await curves(self._connection, stride, **_given(label=label, experiment=experiment,
                                                               group=group))

    async def compare_campaigns(self, *campaigns: str | int | AsyncCampaign | AsyncCampaigns
                                ) -> CampaignComparison:
        """Compares the best scores of campaigns with those of the first one, at the newest
        generation that all have reached. A campaign stands for its replicates, and their spread
        gives the interval. `compare_campaigns(m.campaigns(experiment="B"))` compares each group of
        an experiment.

        Raises `MorphodError` if campaigns differ in physics or environments, because their scores
        are not comparable; the result lists other settings that differ.
        """
        return await comparing.compare_campaigns(self._connection, comparing.sides_of(campaigns))

    async def bundle(self, path: str | os.PathLike[str], *,
                     ids: Iterable[str | int] | None = None, label: str | None = None,
                     experiment: str | None = None, group: str | None = None,
                     recordings: bool = False) -> pathlib.Path:
        """Saves up to 100 campaigns that have ended as one file, a .tar.zst with everything that
        belongs to them, selected by ids, label, experiment or group. `recordings`: also include
        evaluations' recordings of the designs of campaigns that do not learn."""
        named = None if ids is None else ",".join(str(id) for id in sorted({int(id) for id in ids}))
        target = pathlib.Path(path)
        await self._connection.save(Request.get("/v1/bundles", accept="application/zstd",
                                                campaigns=named, label=label,
                                                experiment=experiment, group=group,
                                                recordings=recordings or None), target)
        return target

    async def import_bundle(self, path: str | os.PathLike[str]) -> AsyncCampaigns:
        """Imports the campaigns of a bundle; those that the service already has do not change. A
        damaged bundle is refused with `InvalidError`, and nothing of it is stored."""
        entered = await self._connection.json(self._bundle_request(path, "enter"))
        with reading():
            ids = [str(row["campaign"]) for row in entered["items"]]
        return AsyncCampaigns(self._connection, [await self.get_campaign(id) for id in ids])

    async def verify_bundle(self, path: str | os.PathLike[str]) -> pd.DataFrame:
        """Checks every hash and line of a bundle, and stores nothing. Returns a table of its
        campaigns: campaign (its id in this service, or None), source_store, source_campaign,
        designs, …"""
        reply = await self._connection.json(self._bundle_request(path, "verify"))
        with reading():
            return frame(reply["items"]).drop(columns="entered")

    @staticmethod
    def _bundle_request(path: str | os.PathLike[str], mode: str) -> Request:
        return Request("POST", "/v1/bundles", params={"mode": mode},
                       content=pathlib.Path(path).read_bytes(),
                       headers={"Content-Type": "application/zstd"}, timeout_s=600.0)

    # ---- scores ----

    async def save_scores(self, path: str | os.PathLike[str], *, controller: str | None = None,
                          fingerprint: str | None = None,
                          since: datetime.datetime | None = None) -> pathlib.Path:
        """Saves stored scores as one file, with everything they depend on, for another service: all
        of them, or only those with a controller, in a class, or computed since a time."""
        if since is not None and since.tzinfo is None:
            raise ValueError("since needs a time zone")
        moment = since and since.astimezone(datetime.timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ")
        target = pathlib.Path(path)
        await self._connection.save(Request.get("/v1/scores", accept="application/zstd",
                                                controller=controller, since=moment,
                                                **_given(**{"class": fingerprint})), target)
        return target

    async def import_scores(self, path: str | os.PathLike[str]) -> Entered:
        """Imports the scores in a file, block by block. Existing scores do not change, so an
        interrupted import can be repeated. A damaged block is refused with `InvalidError`, and
        nothing of it is stored."""
        entered, is_last = Entered(), False
        for block in blocks(path):
            reply = await self._connection.json(Request(
                "POST", "/v1/scores", content=block, timeout_s=600.0,
                headers={"Content-Type": "application/zstd"}))
            with reading():
                entered.add(reply)
                is_last = reply["last"]
        if not is_last:
            raise MorphodError(f"{path} ends early: its last block is missing")
        return entered

    # ---- trainings and controllers ----

    async def pretrain(self, *, preset: Literal["workstation", "phototaxis", "paper"] | None = None,
                       environments: Environments | None = None, name: str | None = None,
                       label: str | None = None, **settings: Any) -> AsyncTraining:
        """Starts the training of a controller on an endless stream of random bodies, in random
        worlds or in these `environments`, of which each robot of a step gets one. `settings` are
        those of the contract (docs/learning.md), such as `steps`, `batch`, `tasks=["walk"]`."""
        return await self._train("pretrain", settings, preset=preset, environments=environments,
                                 name=name, label=label)

    async def finetune(self, bodies: Iterable[BodyLike] | NDArray[Any] | None = None, *,
                       preset: Literal["workstation", "paper"] | None = None,
                       environments: Environments | None = None, name: str | None = None,
                       label: str | None = None, **settings: Any) -> AsyncTraining:
        """Starts the training of a controller on bodies, or on a `population` of the service such
        as `{"campaign": "12"}`; `environments` as in `pretrain`."""
        if bodies is not None:
            settings["designs"] = designs_of(bodies)
        return await self._train("finetune", settings, preset=preset, environments=environments,
                                 name=name, label=label)

    async def _train(self, kind: str, settings: dict[str, Any], **given: Any) -> AsyncTraining:
        value = {"kind": kind, **_given(**given), **settings}
        data = await self._connection.json(Request.submit("/v1/trainings", value))
        with reading():
            warn_of_ids(data.get("notes") or ())
        return AsyncTraining(self._connection, data)

    async def training(self, id: str | int) -> AsyncTraining:
        """Returns the training with an id."""
        data = await self._connection.json(Request.get(f"/v1/trainings/{id}"))
        return AsyncTraining(self._connection, data)

    async def controllers(self) -> pd.DataFrame:
        """Returns a table of the controllers that have a name."""
        return frame([row async for row in self._connection.pages("/v1/controllers")])

    async def controller(self, name: str = "default") -> Controller:
        """Returns a controller by its name, or by `sha256:` and its hash."""
        data = await self._connection.json(Request.get(f"/v1/controllers/{name}"))
        reply = await self._connection.send(
            Request.get(f"/v1/controllers/{name}/file", accept="application/octet-stream"))
        return Controller(data, reply.content)

    async def put_controller(self, name: str,
                             source: (str | os.PathLike[str] | bytes | Mapping[str, Any] |
                                      Controller),
                             metadata: Mapping[str, str] | None = None) -> Controller:
        """Stores a controller under a name: a safetensors file, its bytes, or its tensors by name,
        such as the `state_dict` of `Controller.torch()` (with `metadata`, which includes the
        `sensor`)."""
        if isinstance(source, Controller):
            content = source.content
        elif isinstance(source, bytes):
            content = source
        elif isinstance(source, Mapping):
            content = write_safetensors(source, metadata)
        else:
            content = pathlib.Path(source).read_bytes()
        request = Request("PUT", f"/v1/controllers/{name}/file", content=content,
                          headers={"Content-Type": "application/octet-stream"})
        return Controller(await self._connection.json(request), content)

    async def held_out(self, seed: int = 1, *, designs: int = 64, environments: int = 16
                       ) -> tuple[NDArray[np.bool_], list[dict[str, Any]]]:
        """Returns bodies (designs, 6, 6, 4) and environments that no training draws; always the
        same for a seed."""
        found = await self._connection.json(Request.get(
            "/v1/held-out", seed=seed, designs=designs, environments=environments))
        with reading():
            return (voxels_of(design["voxels"] for design in found["designs"]),
                    list(found["environments"]))

    async def compare_controllers(self, a: str | AsyncTraining, b: str | AsyncTraining, *,
                                  seed: int = 1, designs: int = 64, environments: int = 16,
                                  **settings: Any) -> ControllerComparison:
        """Compares two controllers, or the results of two trainings, on the same held-out bodies
        and environments. `settings` are passed to `evaluate` for both controllers, for example
        `physics`."""
        return await comparing.compare_controllers(self, a, b, (seed, designs, environments),
                                                   settings)

    # ---- the service ----

    async def jobs(self, *, state: str | None = None, label: str | None = None,
                   experiment: str | None = None, kind: str | None = None,
                   archived: Literal["true", "all"] | None = None) -> pd.DataFrame:
        """Returns a table of jobs, newest first."""
        return frame([row async for row in self._connection.pages(
            "/v1/jobs", state=state, label=label, experiment=experiment, kind=kind,
            archived=archived)])

    async def usage(self, by: Literal["label", "experiment", "submitted_by", "kind"] = "label"
                    ) -> pd.DataFrame:
        """Returns a table of the usage of jobs, including deleted ones: name, jobs, core_seconds,
        device_seconds; largest usage first."""
        reply = await self._connection.json(Request.get("/v1/usage", by=by, limit=1000))
        with reading():
            return frame(reply["items"])

    async def fleet(self) -> AsyncFleet:
        """Returns the workers on other machines."""
        return await AsyncFleet(self._connection, {}).refresh()

    async def export(self, what: str, path: str | os.PathLike[str], *,
                     format: Literal["csv", "ndjson", "newick", "columns"] | None = None,
                     **params: Any) -> pathlib.Path:
        """Saves a list, a curve or a phylogeny in a file, without holding it in memory:
        `export("campaigns/7/phylogeny", "born.csv")`, `export("jobs", "jobs.ndjson", label="B")`.

        `what` is a path of the contract after /v1/, `params` are its parameters. The file's suffix
        determines the format: .csv, .ndjson or .jsonl, .nwk; `format` overrides it.
        """
        target = pathlib.Path(path)
        ends = {".csv": "csv", ".ndjson": "ndjson", ".jsonl": "ndjson", ".nwk": "newick"}
        form = format or ends.get(target.suffix)
        if form is None:
            raise ValueError(f"{target.name}: the suffix must be .csv, .ndjson, .jsonl or .nwk; "
                             "or give format")
        request = Request.get(f"/v1/{what.removeprefix('/v1/').lstrip('/')}", accept="*/*",
                              format=form, **params)
        await self._connection.save(request, target)
        return target

    async def events(self, after: str | int | None = None, job: str | int | None = None
                     ) -> AsyncIterator[dict[str, Any]]:
        """Yields events of one job or of all jobs as they happen, starting after the event `after`,
        or now. None are lost when the service restarts. If events are no longer kept, an event of
        type "reset" takes their place."""
        if after is None:
            page = await self._connection.json(Request.get("/v1/events", format="json", limit=1))
            with reading():
                after = page["newest"]
        events = self._connection.events(str(after), None if job is None else str(job))
        async for event in events:
            yield event

    async def version(self) -> str:
        """Returns the version of the service."""
        health = await self._connection.json(Request.get("/healthz"))
        with reading():
            return str(health["version"])

    async def request(self, method: str, path: str, value: Mapping[str, Any] | None = None,
                      **params: Any) -> Any:
        """Sends any request of the contract, and returns the JSON of its reply."""
        if value is None and method == "GET":
            return await self._connection.json(Request.get(path, **params))
        request = Request.post(path, value)
        request.method, request.params = method, params
        request.repeatable = method != "POST"
        reply = await self._connection.send(request)
        return reply.json() if reply.content else None


class AsyncObjective:
    """An objective for optimizers: solutions in, numbers out.

    When it is called with many solutions, it scores them in one evaluation and returns an array
    (n,); with one solution, it returns a number. With `measures` it returns two arrays, the
    objective (n,) and the measures (n, measures), as pyribs expects them:
    `scheduler.tell(*objective(scheduler.ask()))`.

    A solution is a vector of 144 finite numbers or an array [x, y, z], with a voxel where a value
    is above 0.5, or any other form that `Body.of` accepts; `decode` converts others to one of
    these. Only the largest piece counts. A solution without voxels, or one that diverges, gets the
    loss `worst`. Losses are to be minimized; `maximize=True`, the default with measures, returns
    them with the opposite sign.

    Measures are "voxels", "footprint", "height", "path_length_m" (mean path length of the center of
    mass over the environments), or functions of a `Body`.
    """

    def __init__(self, client: AsyncClient, measures: Sequence[Any] | None,
                 decode: Callable[[Any], BodyLike] | None, maximize: bool | None, worst: float,
                 settings: dict[str, Any]) -> None:
        self._client = client
        self._plan = Plan(measures, decode, worst,
                          measures is not None if maximize is None else maximize)
        self._settings = settings

    async def __call__(self, solutions: Any) -> Any:
        plan = self._plan
        bodies, single = plan.read(solutions)
        present = [body for body in bodies if body is not None]
        settings = dict(self._settings)
        if plan.needs_path:
            settings["record"] = ["com"]
        if not present:
            return plan.write(bodies, None, None, single)
        evaluation = await self._client.evaluate(present, **settings)
        with reading():
            paths = [row.data["path_length_m"] for row in evaluation] if plan.needs_path else None
        return plan.write(bodies, evaluation.scores, paths, single)
