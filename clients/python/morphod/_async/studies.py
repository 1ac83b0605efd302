"""Studies: campaigns driven by a custom search, by ask and tell."""

from __future__ import annotations

import base64
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal

import anyio

from ..bodies import Body, BodyLike, OnFault, Repair, designs_of, warn_of_ids
from ..errors import MorphodError, reading
from ..objectives import Plan
from ..results import Asked, Batch, children_of
from .._wire import WAIT_S, Request, given, without_none
from .connection import AsyncConnection
from .handles import AsyncCampaign
from .jobs import AT_ONCE_S

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from typing_extensions import Self


class AsyncStudy(AsyncCampaign):
    """A campaign for which you make the children, batch by batch; otherwise it is like any
    campaign.

    The service commits a batch as a whole, with its scores and the state of your sampler, so either
    side may die at any moment. Leaving a `with` block finishes the study. If an exception
    leaves the block, the study stays open, and the same name finds it again.
    """

    def __init__(self, connection: AsyncConnection, data: dict[str, Any]) -> None:
        super().__init__(connection, data)
        with reading():
            self.next_batch = int(data["study"]["next_batch"])
        """The number of the next batch."""

    @property
    @reading()
    def own_score(self) -> dict[str, str] | None:
        """Name and unit of the scores that you send; None if the service computes them."""
        own: dict[str, str] | None = self.data["study"].get("own_score")
        return own

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, kind: type[BaseException] | None, error: BaseException | None,
                        trace: TracebackType | None) -> None:
        if error is None and not self.ended:
            await self.finish()

    async def ask(self, n: int, *, by: Literal["variation", "random"] = "variation",
                  parents: Iterable[int] | None = None) -> Asked:
        """Returns bodies that this study has never seen, made by the service: children of its
        population or of `parents`, with the mutation and crossover of its settings; random bodies
        while it is empty. Repeating the call gives the same bodies until the next batch."""
        value = {"n": n, "by": by, "parents": None if parents is None else list(parents)}
        return Asked(await self._connection.json(
            Request.post(f"{self._list}/{self.id}/ask", without_none(value))))

    async def tell(self, children: Iterable[BodyLike] | NDArray[Any] | Asked, *,
                   parents: Sequence[Sequence[int]] | None = None,
                   operator: str | Sequence[str] | None = None,
                   measures: Mapping[str, Iterable[float]] | None = None,
                   scores: Iterable[float] | None = None,
                   survivors: Iterable[int] | None = None, sampler_state: bytes | None = None,
                   on_fault: OnFault = "refuse", repair: Repair | None = None) -> Batch:
        """Sends the next batch, and returns its scores once they are committed.

        `children` are bodies, or the result of `ask`. `parents` are the numbers of each child's
        parents, up to two designs of earlier batches, and `operator` says how they were made, in
        your own words. `measures` has arrays by name, with NaN where there is no value. `scores`
        are required in a study with an `own_score`, which ranks by them: a finite number for each
        child, lower is better; NaN is for a child that is skipped. `survivors` are the numbers of
        the designs in the population that survive, along with all children; without them, the
        study's selection decides. `restore` returns `sampler_state`; save the sampler's current
        state, before it knows these scores. A skipped body (`on_fault="skip"`)
        has no number and the score NaN.
        """
        if isinstance(children, Asked):
            parents = children.parents if parents is None else parents
            operator = children.operators if operator is None else operator
            children = children.bodies
        value: dict[str, Any] = {
            "batch": self.next_batch, "on_fault": on_fault,
            "children": children_of(designs_of(children, on_fault), parents, operator, measures,
                                    scores),
            **given(repair=repair),
        }
        if survivors is not None:
            value["survivors"] = [int(number) for number in survivors]
        if sampler_state is not None:
            value["sampler_state"] = base64.b64encode(sampler_state).decode()
        # Sending the same batch again changes nothing, so it is safe to repeat.
        request = Request.post(f"{self._list}/{self.id}/tell", without_none(value)).waiting(WAIT_S)
        try:
            batch = await self._committed(await self._connection.json(request))
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                f"batch {self.next_batch} of study {self.id} continues if it has arrived: "
                "restore() or the same tell() returns its scores") from None
        self.next_batch = batch.number + 1
        with reading():
            warn_of_ids(batch.notes)
        return batch

    async def _committed(self, reply: dict[str, Any]) -> Batch:
        """Waits until a batch is committed."""
        while reply.get("state") != "committed":
            await self.refresh()
            if self.ended:
                self._require_success()
            asked = time.monotonic()
            reply = await self._connection.json(
                Request.get(f"{self._list}/{self.id}/batch", wait_s=WAIT_S))
            with reading():
                is_committed = reply["state"] == "committed"
            if not is_committed and self.ended:
                raise MorphodError(f"study {self.id} ended without its newest batch")
            if not is_committed and time.monotonic() - asked < AT_ONCE_S:
                await anyio.sleep(AT_ONCE_S)
        return Batch(reply)

    async def last(self) -> Batch | None:
        """Returns the newest batch, once it is committed; None if there was no batch yet."""
        await self.refresh()
        with reading():
            state = self.data["study"]
            if state["next_batch"] == 0 and not state["pending"]:
                return None
        batch = await self._committed(await self._connection.json(
            Request.get(f"{self._list}/{self.id}/batch", wait_s=WAIT_S)))
        self.next_batch = batch.number + 1
        return batch

    async def restore(self) -> tuple[bytes, Batch] | None:
        """Returns what a search needs to continue where it stopped: the sampler state that was sent
        with the newest batch, and that batch with its scores, which the sampler does not know yet.
        Returns None if there was no batch yet, so the search starts from the beginning."""
        batch = await self.last()
        if batch is None:
            return None
        with reading():
            is_saved = self.data["study"]["sampler"] is not None
        if not is_saved:
            raise MorphodError(f"batch {batch.number} of study {self.id} was sent without "
                               "sampler_state, so the sampler cannot be restored; last() returns "
                               "the batch")
        reply = await self._connection.send(Request.get(
            f"{self._list}/{self.id}/sampler", accept="application/octet-stream"))
        if reply.headers.get("Morphod-Batch") != str(batch.number):
            raise MorphodError(f"study {self.id} is also driven by another client")
        return reply.content, batch

    async def finish(self, survivors: Iterable[int] | None = None) -> None:
        """Ends the study. `survivors`: the designs of the population that survive."""
        if survivors is not None:
            await self.tell([], survivors=survivors)
        self.data = await self._connection.json(Request.post(f"{self._list}/{self.id}/finish"))

    def objective(self, measures: Sequence[Any] | None = None, *,
                  decode: Callable[[Any], BodyLike] | None = None,
                  maximize: bool | None = None, worst: float = 10.0,
                  operator: str = "sampler") -> AsyncStudyObjective:
        """Returns a function that an optimizer calls with its solutions, like `Client.objective`;
        each call is a batch of this study."""
        if self.own_score is not None:
            raise ValueError(f"study {self.id} ranks by its own score {self.own_score['name']!r}, "
                             "which objective() cannot compute; use tell(…, scores=…)")
        plan = Plan(measures, decode, worst, measures is not None if maximize is None else maximize)
        if plan.needs_path:
            raise ValueError("a study records no paths, so path_length_m cannot be a measure")
        return AsyncStudyObjective(self, plan, operator)


class AsyncStudyObjective:
    """An objective whose calls are the batches of a study; see `Objective`.

    `objective(solutions, sampler_state=…)` sends them and returns what the optimizer needs.
    `objective.last` is the batch of the last call.
    """

    def __init__(self, study: AsyncStudy, plan: Plan, operator: str) -> None:
        self.study = study
        self.last: Batch | None = None
        self._plan = plan
        self._operator = operator

    async def __call__(self, solutions: Any, *, sampler_state: bytes | None = None,
                       survivors: Iterable[int] | None = None) -> Any:
        """Scores the solutions, and returns what the optimizer needs."""
        bodies, single = self._plan.read(solutions)
        values = self._plan.values(bodies)
        self.last = await self.study.tell(
            [body if body is not None else [] for body in bodies], operator=self._operator,
            measures={name: values[:, column] for column, name in enumerate(self._plan.names)},
            sampler_state=sampler_state, survivors=survivors, on_fault="skip")
        return self._plan.write(bodies, self._there(bodies), None, single)

    def again(self, batch: Batch) -> Any:
        """Returns what the call that sent a batch, found by `AsyncStudy.restore`, would have
        returned."""
        self.last = batch
        bodies: list[Body | None] = list(batch.bodies)
        return self._plan.write(bodies, self._there(bodies), None, False)

    def _there(self, bodies: Sequence[Body | None]) -> NDArray[Any]:
        """Returns the scores of the bodies that were not skipped."""
        assert self.last is not None
        scores: NDArray[Any] = self.last.scores
        return scores[[body is not None for body in bodies]]
