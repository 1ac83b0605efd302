"""The client, the entry point of the package."""

from __future__ import annotations

import datetime
import os
import pathlib
import warnings
from collections.abc import AsyncIterator, Callable, Iterable, Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal

from ..bodies import BodyLike, OnFault, Repair, designs_of, voxels_of, warn_of_ids
from ..comparisons import CampaignComparison, ControllerComparison
from ..errors import MorphodError, counted, reading
from ..frames import frame
from ..objectives import Plan
from ..scenes import Environments
from ..scores import Entered, blocks
from .._wire import Request, given as _given, without_none
from . import comparing
from .atlases import Atlases
from .certificates import Certifying
from .connection import AsyncConnection
from .fleet import AsyncFleet
from .handles import AsyncCampaign, AsyncCampaigns, AsyncTraining, curves, curves_of
from .learning import Learning
from .scoring import DESIGNS_MAX, Physics, Scoring
from .studies import AsyncStudy

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd
    from numpy.typing import NDArray
    from typing_extensions import Self

_RANDOM_BODIES_MAX = 1000000


class AsyncClient(Scoring, Learning, Atlases, Certifying):
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

    # ---- bodies and designs ----

    async def random_bodies(self, count: int, seed: int | None = None, *,
                            first: int = 0) -> NDArray[np.bool_]:
        """Returns distinct random bodies (count, 6, 6, 4), drawn as in training, none a rotation or
        reflection of another; nothing is stored. A seed (1 by default) has 1,000,000 bodies,
        always the same; this returns numbers `first`, `first + 1`, … Different seeds share
        bodies, so to get more, increase `first`."""
        if count < 1 or first < 0 or first + count > _RANDOM_BODIES_MAX:
            raise ValueError(f"a seed has bodies 0 to {_RANDOM_BODIES_MAX - 1}, got {first} to "
                             f"{first + count - 1}; count must be at least 1")
        made: list[dict[str, Any]] = []
        for place in range(first, first + count, DESIGNS_MAX):
            made += await self._make("random", {
                "first": place, "count": min(first + count - place, DESIGNS_MAX), "seed": seed})
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
                raise TypeError("a body in the list is not an object")
            return items

    def objective(self, measures: Sequence[Any] | None = None, *,
                  decode: Callable[[Any], BodyLike] | None = None,
                  maximize: bool | None = None, worst: float = 10.0,
                  **settings: Any) -> AsyncObjective:
        """Returns a function that an optimizer calls with its solutions; see `Objective`."""
        return AsyncObjective(self, measures, decode, maximize, worst, settings)

    async def designs(self, *, sort: Literal["id", "score"] = "score", limit: int = 100,
                      **filters: Any) -> pd.DataFrame:
        """Returns a table of all designs ever scored; sorted by score, the best come first.
        `filters` are those of GET /v1/designs, such as `controller`, `environments`, and
        `physics="paper"` for scores under the paper's physics."""
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
        "displacement_m", "direction": "max"}`, the campaign selects by one. With `aggregate`, such
        as `{"kind": "cvar", "level": 0.9}`, the score of a design is not the mean of its losses
        over the environments, but here the mean of the worst tenth. With `re_evaluate`, such as
        `{"every": 10, "environments": 64}`, the best designs are also scored in fresh worlds that
        are not used for selection: `champions()` has these scores without luck.
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
            left_out = counted(len(members[0].left_out), "design")
            warnings.warn(f"campaign {initial.id} has {left_out} outside the workspace, left out "
                          "here: random bodies replace them", stacklevel=2)
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
        generation that all have reached. A campaign stands for its replicates; their spread
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

    async def compare_controllers(self, a: str | AsyncTraining, b: str | AsyncTraining, *,
                                  seed: int = 1, designs: int = 64, environments: int = 16,
                                  **settings: Any) -> ControllerComparison:
        """Compares two controllers, or the results of two training runs, on the same held-out
        bodies and environments. `settings` are passed to `evaluate` for both controllers, for
        example `physics`."""
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
