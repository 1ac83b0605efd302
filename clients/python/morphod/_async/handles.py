"""Training runs and campaigns of the service, as objects."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import anyio

from ..errors import MorphodError, reading
from ..frames import frame, frame_of_columns, frame_of_designs, pandas
from ..phylogenies import Phylogeny
from ..player import Player
from ..progress import Bar, doing
from ..results import Controller
from ..scenes import MEDIA_TYPE, Scene
from .._wire import WAIT_S, Request, given
from .connection import AsyncConnection
from .evaluations import AsyncEvaluation
from .jobs import POLL_S, AsyncJob, interrupted
from .showing import player, world_of

if TYPE_CHECKING:
    import pandas as pd


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

    async def each(self) -> pd.DataFrame:
        """Returns a table of the bodies that a finetuning run with `each` trained individually:
        their scores before (`zero_shot`) and after (`finetuned`), and their controllers. Its
        `attrs` have the summary: Kendall's tau between the two scores and the mean gain, with
        intervals."""
        path = f"/v1/trainings/{self.id}/each"
        rows = [row async for row in self._connection.pages(path)]
        table = frame(rows)
        table.attrs |= (await self._connection.json(Request.get(path, limit=1)))["summary"]
        return table

    async def controller(self, step: int | None = None) -> Controller:
        """Returns the result or, while it learns, the controller of the newest checkpoint, or the
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
            raise MorphodError("campaigns from a list lack their founders: refresh() first")
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
        state, seed, own_score (its name, in a study that has one), aggregate (`cvar 0.9`; None: the
        mean), generation, and every statistic (`score_mean`, `score_quantiles_p0`, `diversity`, …).
        With a `stride` only generations that are multiples of it."""
        return await curves(self._connection, stride, campaigns=self.id)

    async def learning(self) -> pd.DataFrame:
        """Returns a table with a row per step of learning; empty in a zero-shot campaign."""
        path = f"/v1/campaigns/{self.id}/learning"
        rows = [row async for row in self._connection.pages(path)]
        return frame(rows, **self._constant())

    async def population(self, generation: int | None = None) -> pd.DataFrame:
        """Returns a table of the population after a generation (default: the newest), best first,
        with columns as in `champions`."""
        path = f"/v1/campaigns/{self.id}/population"
        # A cursor includes its generation.
        rows = [row async for row in self._connection.pages(path, generation=generation)]
        with reading():
            return frame_of_designs(rows)

    async def champions(self, count: int = 12) -> pd.DataFrame:
        """Returns a table of the best design and a sample of the others, most distinct first.

        Their `score` selected them, so it is lucky. With `re_evaluate`, `held_out_mean` is that of
        fresh worlds, with its 95 % interval `held_out_low` to `held_out_high`,
        `held_out_standard_error`, `held_out_worlds`, `held_out_generation` and `held_out_diverged`;
        NaN: it was in no re-evaluation, as may happen between two of them, or with another `count`,
        which selects other designs. `certificate` is the id of the newest certificate under a
        controller of the campaign, and `certificate_class` what it says."""
        found = await self._connection.json(
            Request.get(f"/v1/campaigns/{self.id}/champions", count=count))
        with reading():
            return frame_of_designs(found["items"])

    async def evaluate_champions(self, environments: str = "morpho-12", count: int = 12, *,
                                 controller: str | None = None, label: str | None = None,
                                 wait: bool = True) -> AsyncEvaluation:
        """Scores the champions in a named set of environments or a suite, with the physics of the
        campaign and, unless `controller` is given, the controller that scored them. With
        `wait=False` it returns as soon as the evaluation is durable."""
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

    async def ancestors(self, number: int) -> pd.DataFrame:
        """Returns a table of all ancestors of a design, the oldest first, and of the design itself
        at the end, each with its `number`, `robot`, `genotype`, parents and score."""
        path = f"/v1/campaigns/{self.id}/designs/{number}"
        own = await self._connection.json(Request.get(path))
        rows = [row async for row in self._connection.pages(f"{path}/ancestors")]
        return frame([*rows, {name: value for name, value in own.items()
                              if name not in ("campaign", "children")}])

    async def extend(self, generations: int) -> None:
        """Adds generations; a campaign that has succeeded continues."""
        request = Request.submit(f"/v1/campaigns/{self.id}/extend", {"generations": generations})
        self.data = await self._connection.json(request)

    async def show(self, count: int = 4, environment: int = 0) -> Player:
        """Shows the champions walking side by side: a player for notebooks."""
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
        """Waits until all have succeeded; see `Campaign.wait`."""
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        try:
            for member in self._members:
                await member.wait(
                    None if deadline is None else max(0.0, deadline - time.monotonic()))
        except KeyboardInterrupt:
            raise interrupted(*self._members) from None

    async def live(self) -> AsyncCampaigns:
        """Shows their progress until all have ended."""
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
                    await anyio.sleep(POLL_S)
                    for member in self._members:
                        if not member.ended:
                            await member.refresh()
        except KeyboardInterrupt:
            raise interrupted(*self._members) from None
        for member in self._members:
            member._conclude()
        return self

    async def curves(self, stride: int = 1) -> pd.DataFrame:
        """Returns one tidy table of all their generations; see `Campaign.curve`."""
        return await curves_of(self._connection, [member.id for member in self._members], stride)


async def curves(connection: AsyncConnection, stride: int = 1, **which: Any) -> pd.DataFrame:
    """Returns one tidy table of the generations of campaigns, with one request."""
    reply = await connection.send(Request.get(
        "/v1/campaigns/generations", accept=MEDIA_TYPE, stride=stride, **which))
    return frame_of_columns(reply.content)


async def curves_of(connection: AsyncConnection, ids: Iterable[str | int], stride: int = 1
                    ) -> pd.DataFrame:
    """Does the same by ids, with as many per request as fit in a URL."""
    ascending = sorted({int(id) for id in ids})
    tables = [await curves(connection, stride, campaigns=",".join(map(str, ascending[at:at + 40])))
              for at in range(0, len(ascending), 40)]
    joined: pd.DataFrame = pandas().concat(tables, ignore_index=True) if tables else frame([])
    return joined
