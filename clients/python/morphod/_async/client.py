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
from ..errors import MorphodError, reading
from ..frames import frame
from ..objectives import Plan
from ..player import Player
from ..results import Controller
from ..scenes import MEDIA_TYPE, Environments, Scene
from ..scores import Entered, blocks
from ..weights import write_safetensors
from .._wire import WAIT_S, Request, given as _given, without_none
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

_DESIGNS_MAX = 10000
_LARGE_MAX = 1000000
_RANDOM_BODIES_MAX = 1000000
_LOOK_UP_S = 5.0
"""How long an interrupt looks for the job that continues."""


class AsyncClient:
    """A client of a morphod service.

    `server` is `http://host:port`, `https://…` or `unix:/path`; without it $MORPHOD_SERVER, then
    http://127.0.0.1:8765. `token` is needed where the service asks for one; without it
    $MORPHOD_TOKEN. While the service is away (a restart, an upgrade), busy or full, requests are
    repeated for `retry_s` seconds; submissions carry a key, so that none is accepted twice.

    Refused requests raise `morphod.ApiError`, which has the faults that the service named.
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
                       physics: Mapping[str, Any] | None = None,
                       precision: Literal["float32", "float64"] = "float32",
                       priority: Literal["interactive", "batch"] | None = None,
                       weight: float = 1.0, device: Literal["auto", "cpu", "cuda"] = "auto",
                       label: str | None = None, experiment: str | None = None,
                       verify: bool = False, best: int | None = None,
                       repair: Repair | None = None, on_fault: OnFault = "refuse",
                       wait: bool = True) -> AsyncEvaluation:
        """Scores up to 1,000,000 bodies (see `Body.of`; an array (n, 6, 6, 4) is fastest). With
        more than 10,000, no body is skipped or repaired, ids need an orientation, nothing is
        recorded, and `table()` reads the results in pages. To score random bodies without sending
        them, see `evaluate_random`.

        `wait=False` returns at once; the evaluation is durable then. `record` takes "com" and
        "masses", kept at every `record_stride` steps. `physics` overrides single numbers, such as
        `{"n_steps": 500}`. `repair="largest"` keeps the largest piece of bodies that are not in one
        piece. `on_fault="skip"` skips invalid bodies; their results have a `fault` and NaN.
        `best=10` computes the whole scores of the ten best only; the others are cut short, and have
        lower bounds. An id alone is scored in the orientation with the best stored score, or else
        in the canonical one; `Result.orientation` says which.
        """
        designs, lost, faults = requests_of(bodies, on_fault)
        if not 0 < len(designs) <= _LARGE_MAX:
            raise ValueError(f"an evaluation takes 1 to {_LARGE_MAX} bodies, not {len(designs)}")
        is_large = len(designs) > _DESIGNS_MAX
        if is_large:
            designs = packed(designs)
            warn_of_lost(lost)  # the results come in pages, which do not have it
        value: dict[str, Any] = {
            "designs": designs, "environments": environments, "controller": controller,
            "precision": precision, "weight": weight, "device": device, "verify": verify,
            "on_fault": on_fault,
            **_given(physics=physics, priority=priority, label=label, experiment=experiment,
                     repair=repair, best=best),
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
            if not is_large:
                evaluation._check(designs)
        return evaluation

    async def _interrupted(self, request: Request) -> KeyboardInterrupt:
        """The exception for an interrupted submission. The key finds the job, if there is one."""
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

    async def evaluate_random(self, count: int, seed: int = 1, *, first: int = 0,
                              environments: Environments = "paper-test",
                              controller: str = "default",
                              physics: Mapping[str, Any] | None = None,
                              precision: Literal["float32", "float64"] = "float32",
                              weight: float = 1.0, device: Literal["auto", "cpu", "cuda"] = "auto",
                              label: str | None = None, experiment: str | None = None,
                              best: int | None = None, wait: bool = True) -> AsyncEvaluation:
        """Scores the bodies of `random_bodies(count, seed, first=first)`, up to 1,000,000 of them
        in one evaluation, with one `best` over all: nothing is sent. The service draws and stores
        them first; until then it is queued.

        The results of more than 10,000 are read in pages, by `table()`; `table(whole=True)` reads
        only those that are not lower bounds.
        """
        value: dict[str, Any] = {
            "random": {"count": count, "seed": seed, "first": first},
            "environments": environments, "controller": controller, "precision": precision,
            "weight": weight, "device": device,
            **_given(physics=physics, label=label, experiment=experiment, best=best),
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
                       record_stride: int = 10, physics: Mapping[str, Any] | None = None,
                       precision: Literal["float32", "float64"] = "float32",
                       repair: Repair | None = None) -> Scene:
        """Computes up to 64 rollouts and their recordings without storing them, for viewers and
        editors. The losses are those of an evaluation, bit for bit."""
        request = Request.post("/v1/rollouts", without_none({
            "designs": designs_of(bodies), "environments": environments, "controller": controller,
            "record": list(record), "record_stride": record_stride, "precision": precision,
            "physics": physics, "repair": repair,
        }), accept=MEDIA_TYPE)
        return Scene((await self._connection.send(request)).content)

    async def show(self, bodies: Iterable[BodyLike] | NDArray[Any],
                   environments: Environments = "paper-test", *,
                   environment: int = 0, controller: str = "default",
                   physics: Mapping[str, Any] | None = None, repair: Repair | None = None,
                   title: str = "Robots of morphod") -> Player:
        """Robots that walk in one environment: a player for notebooks, which `save` writes as one
        HTML file."""
        if isinstance(environments, str):
            known = await self._connection.json(Request.get(f"/v1/environment-sets/{environments}"))
            world: Mapping[str, Any] = world_of(known, environment)
        elif -len(environments) <= environment < len(environments):
            world = environments[environment]
        else:
            raise MorphodError(f"there is no environment {environment}: {len(environments)} are "
                               "given, counted from 0")
        scene = await self.rollouts(bodies, [world], controller=controller,
                                    record_stride=4, physics=physics, repair=repair)
        return await player(self._connection, scene, title)

    async def random_bodies(self, count: int, seed: int | None = None, *,
                            first: int = 0) -> NDArray[np.bool_]:
        """Distinct random bodies (count, 6, 6, 4), as trainings draw them, none a rotation or
        reflection of another; nothing is stored. A seed (1 by default) has 1,000,000 bodies, always
        the same; these are `first`, `first + 1`, … of them. Two seeds have bodies in common: for
        more bodies, continue with `first`."""
        if count < 1 or first < 0 or first + count > _RANDOM_BODIES_MAX:
            raise ValueError(f"a seed has the bodies 0 to {_RANDOM_BODIES_MAX - 1}, not {first} to "
                             f"{first + count - 1}; count is at least 1")
        made: list[dict[str, Any]] = []
        for place in range(first, first + count, _DESIGNS_MAX):
            made += await self._make("random", {
                "first": place, "count": min(first + count - place, _DESIGNS_MAX), "seed": seed})
        return self._voxels(made)

    async def mutate(self, bodies: Iterable[BodyLike] | NDArray[Any], seed: int | None = None, *,
                     children: int = 1, rate: float | None = None) -> NDArray[np.bool_]:
        """Mutants as campaigns make them: `children` of each body, (bodies · children, 6, 6, 4), in
        the order of the bodies. Each differs from all bodies and all other mutants. `rate` is the
        probability that a voxel flips; without it 1/144. Without a `seed` it is 1."""
        return self._voxels(await self._make("mutate", {
            "designs": designs_of(bodies), "seed": seed, "children": children, "rate": rate}))

    async def cross(self, bodies: Iterable[BodyLike] | NDArray[Any],
                    others: Iterable[BodyLike] | NDArray[Any]) -> NDArray[np.bool_]:
        """The children (n, 6, 6, 4) of n bodies and n others: the voxels that exactly one parent
        has, the largest piece of them. The child of equal parents is empty."""
        first, second = designs_of(bodies), designs_of(others)
        if len(first) != len(second):
            raise ValueError(f"{len(first)} bodies cannot be crossed with {len(second)}")
        pairs = [[place, len(first) + place] for place in range(len(first))]
        return self._voxels(await self._make(
            "cross", {"designs": first + second, "pairs": pairs}))

    async def canonical(self, bodies: Iterable[BodyLike] | NDArray[Any]) -> list[str]:
        """The ids of bodies: their canonical forms, which rotations about z and reflections in x
        and y do not change. `Body.of` turns one into the body of the canonical orientation; to be
        scored, an id alone means the orientation with the best stored score."""
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
        """What an optimizer calls with its solutions; see `Objective`."""
        return AsyncObjective(self, measures, decode, maximize, worst, settings)

    async def designs(self, *, sort: Literal["id", "score"] = "score", limit: int = 100,
                      **filters: Any) -> pd.DataFrame:
        """A table of designs that were ever scored: by score the best first. `filters` are those of
        GET /v1/designs, such as `controller`."""
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

        `initial` are the bodies of the first population, or a campaign whose population it goes on
        from: designs that do not fit the workspace are left out, with a warning (`left_out`).
        `repair` and `on_fault` are those of `evaluate`. `settings` are those of the contract
        (docs/evolution.md), such as `population`, `generations`, `seed`, `selection`, `mutation`,
        `physics`.
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
                for member in members:  # a list does not have them; they are those of all
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
                    physics: Mapping[str, Any] | None = None, **settings: Any) -> AsyncStudy:
        """A study that your search drives: the one of this name that has not ended, or a new one.
        The service finds or makes it in one step, so that processes that open a name at once share
        one study.

        The name is the label of its campaign. `population` is the most designs that may live (512).
        `settings` are those of the contract (docs/studies.md), such as `selection`, `mutation`,
        `seed`. Raises `ConflictError`, which names each setting given here that differs from the
        study's.
        """
        value = {"mode": "study", "label": name, "if_exists": "return", **settings,
                 **_given(population=population, environments=environments, controller=controller,
                          physics=physics)}
        return AsyncStudy(self._connection, await self._connection.json(
            Request.submit("/v1/campaigns", value)))

    async def campaigns(self, *, label: str | None = None, experiment: str | None = None,
                        state: str | None = None, group: str | None = None,
                        archived: Literal["true", "all"] | None = None) -> AsyncCampaigns:
        """Campaigns with this label (`"gait*"`: that begins so), of this experiment, in this state,
        of this group; newest first."""
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
        """One tidy table of the generations of many campaigns: by label, by experiment, by group or
        by ids. With a `stride` only generations that are multiples of it."""
        if ids is not None:
            return await curves_of(self._connection, ids, stride)
        return await curves(self._connection, stride, **_given(label=label, experiment=experiment,
                                                               group=group))

    async def bundle(self, path: str | os.PathLike[str], *,
                     ids: Iterable[str | int] | None = None, label: str | None = None,
                     experiment: str | None = None, group: str | None = None,
                     recordings: bool = False) -> pathlib.Path:
        """Saves up to 100 campaigns that have ended as one file, a .tar.zst with all that belongs
        to them: by ids, by label, by experiment or by group. `recordings`: also what evaluations
        recorded of the designs of campaigns that do not learn."""
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
        """Checks every hash and line of a bundle, and stores nothing. A table of its campaigns:
        campaign (its id here, None where it is not), source_store, source_campaign, designs, …"""
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
        """Saves stored scores as one file, with what they depend on, for another service: all of
        them, or those of a controller, of a class, computed at a time or later."""
        if since is not None and since.tzinfo is None:
            raise ValueError("since needs a time zone")
        moment = since and since.astimezone(datetime.timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ")
        target = pathlib.Path(path)
        await self._connection.save(Request.get("/v1/scores", accept="application/zstd",
                                                controller=controller, since=moment,
                                                **_given(**{"class": fingerprint})), target)
        return target

    async def import_scores(self, path: str | os.PathLike[str]) -> Entered:
        """Imports the scores of a file, block by block. Scores that the service already has change
        nothing, so an interrupted import can be repeated. A damaged block is refused with
        `InvalidError`, and nothing of it is stored."""
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
                       name: str | None = None, label: str | None = None,
                       **settings: Any) -> AsyncTraining:
        """Starts the training of a controller on an endless stream of random bodies. `settings`
        are those of the contract (docs/learning.md), such as `steps`, `batch`, `seed`."""
        return await self._train("pretrain", settings, preset=preset, name=name, label=label)

    async def finetune(self, bodies: Iterable[BodyLike] | NDArray[Any] | None = None, *,
                       preset: Literal["workstation", "paper"] | None = None,
                       name: str | None = None, label: str | None = None,
                       **settings: Any) -> AsyncTraining:
        """Starts the training of a controller on bodies, or on a `population` of the service such
        as `{"campaign": "12"}`."""
        if bodies is not None:
            settings["designs"] = designs_of(bodies)
        return await self._train("finetune", settings, preset=preset, name=name, label=label)

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
        """A table of the controllers that have a name."""
        return frame([row async for row in self._connection.pages("/v1/controllers")])

    async def controller(self, name: str = "default") -> Controller:
        """A controller by its name, or by `sha256:` and its hash."""
        data = await self._connection.json(Request.get(f"/v1/controllers/{name}"))
        reply = await self._connection.send(
            Request.get(f"/v1/controllers/{name}/file", accept="application/octet-stream"))
        return Controller(data, reply.content)

    async def put_controller(self, name: str,
                             source: (str | os.PathLike[str] | bytes | Mapping[str, Any] |
                                      Controller),
                             metadata: Mapping[str, str] | None = None) -> Controller:
        """Stores a controller under a name: a safetensors file, its bytes, or its tensors by name,
        such as the `state_dict` of `Controller.torch()` (with `metadata`, which names the
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

    # ---- the service ----

    async def jobs(self, *, state: str | None = None, label: str | None = None,
                   experiment: str | None = None, kind: str | None = None,
                   archived: Literal["true", "all"] | None = None) -> pd.DataFrame:
        """A table of jobs, newest first."""
        return frame([row async for row in self._connection.pages(
            "/v1/jobs", state=state, label=label, experiment=experiment, kind=kind,
            archived=archived)])

    async def usage(self, by: Literal["label", "experiment", "submitted_by", "kind"] = "label"
                    ) -> pd.DataFrame:
        """A table of what jobs have used, deleted ones too: name, jobs, core_seconds,
        device_seconds; those that used most first."""
        reply = await self._connection.json(Request.get("/v1/usage", by=by, limit=1000))
        with reading():
            return frame(reply["items"])

    async def fleet(self) -> AsyncFleet:
        """The workers of other machines."""
        return await AsyncFleet(self._connection, {}).refresh()

    async def export(self, what: str, path: str | os.PathLike[str], *,
                     format: Literal["csv", "ndjson", "newick", "columns"] | None = None,
                     **params: Any) -> pathlib.Path:
        """Saves a list, a curve or a phylogeny in a file, as fast as the disk takes it:
        `export("campaigns/7/phylogeny", "born.csv")`, `export("jobs", "jobs.ndjson", label="B")`.

        `what` is a path of the contract behind /v1/, `params` its parameters. The suffix of the
        file gives the format: .csv, .ndjson or .jsonl, .nwk; `format` overrides it.
        """
        target = pathlib.Path(path)
        ends = {".csv": "csv", ".ndjson": "ndjson", ".jsonl": "ndjson", ".nwk": "newick"}
        form = format or ends.get(target.suffix)
        if form is None:
            raise ValueError(f"{target.name}: .csv, .ndjson, .jsonl or .nwk is expected, or format")
        request = Request.get(f"/v1/{what.removeprefix('/v1/').lstrip('/')}", accept="*/*",
                              format=form, **params)
        await self._connection.save(request, target)
        return target

    async def events(self, after: str | int | None = None, job: str | int | None = None
                     ) -> AsyncIterator[dict[str, Any]]:
        """Events of one job or of all as they happen, starting after the event `after`, or now. A
        restart of the service loses none. If events are no longer kept, one of the type "reset"
        takes their place."""
        if after is None:
            page = await self._connection.json(Request.get("/v1/events", format="json", limit=1))
            with reading():
                after = page["newest"]
        events = self._connection.events(str(after), None if job is None else str(job))
        async for event in events:
            yield event

    async def version(self) -> str:
        """The version of the service."""
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

    Called with many solutions it scores them in one evaluation and returns an array (n,); with one
    solution, a number. With `measures` it returns two arrays, the objective (n,) and the measures
    (n, measures), as pyribs takes them: `scheduler.tell(*objective(scheduler.ask()))`.

    A solution is a vector of 144 finite numbers or an array [x, y, z], a voxel where a value is
    above 0.5 whatever the shape, or another form that `Body.of` takes; `decode` turns others into
    one of these. The largest piece counts; a solution without a voxel, and one that diverges, gets
    the loss `worst`. Losses are to be minimized; `maximize=True`, the default with measures,
    returns them with the opposite sign.

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
