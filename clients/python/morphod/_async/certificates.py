"""The part of the client for certificates: how much scores depend on the simulation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

from ..bodies import BodyLike, OnFault, Repair, designs_of, warn_of_ids
from ..certificates import CertificateReport
from ..errors import reading
from ..frames import frame
from ..scenes import Environments
from .._wire import Request, given as _given
from .connection import AsyncConnection
from .jobs import AsyncJob

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray


class AsyncCertificate(AsyncJob):
    """How much the scores of designs depend on time steps, worlds and constants: a job with a
    report."""

    _list = "/v1/certificates"
    noun = "certificate"
    finder = "client.certificate"

    @reading()
    def _steps(self) -> tuple[int, int]:
        progress = self.data["certificate"]
        return int(progress["rollouts_done"]), int(progress["rollouts"])

    async def live(self) -> AsyncCertificate:
        """Shows its progress until it has ended."""
        await self._watch(f"certificate {self.id}", " rollouts")
        return self

    async def report(self) -> CertificateReport:
        """Returns the report; while the job runs, it covers the completed levels. Raises
        `ConflictError` if there are none."""
        return CertificateReport(await self._connection.json(
            Request.get(f"{self._list}/{self.id}/report")))

    async def csv(self) -> str:
        """Returns the report as CSV, with a row for each design and level."""
        reply = await self._connection.send(
            Request.get(f"{self._list}/{self.id}/report.csv", accept="text/csv"))
        with reading():
            return reply.content.decode()


class Certifying:
    """Methods of the client."""

    _connection: AsyncConnection

    async def certify(self, designs: Iterable[BodyLike] | NDArray[Any] | None = None, *,
                      campaign: str | int | AsyncJob | None = None,
                      evaluation: str | int | AsyncJob | None = None, best: int | None = None,
                      environments: Environments | None = None, controller: str | None = None,
                      physics: Mapping[str, Any] | Literal["paper"] | None = None,
                      axes: Sequence[str] | None = None, seed: int | None = None,
                      levels: Sequence[float] | None = None,
                      ranges: Mapping[str, Sequence[float]] | None = None,
                      repair: Repair | None = None, on_fault: OnFault = "refuse",
                      label: str | None = None, experiment: str | None = None,
                      **settings: Any) -> AsyncCertificate:
        """Starts a certificate of up to 256 bodies (see `Body.of`), or of the `best` designs (20 by
        default) of a campaign or an evaluation, given by its id or as an object, which also
        provides the environments, the physics and the controller that are not given.

        `axes` are some of `precision`, `step`, `held_out`, `chance`, `stiffness`, `mass`, `drag`,
        `gravity`, `actuation`, `friction`, `drop` and `worlds` (all by default); `levels` are the
        factors of each constant, and `ranges` those of the axis `worlds`, such as
        `{"friction": (0.5, 1.5)}`. `settings` are the other settings of the contract, such as
        `held_out`, `worlds`, `chance`, `top`, `weight` and `device` (docs/trust.md)."""
        value = _given(
            environments=environments, controller=controller, physics=physics, seed=seed,
            axes=axes if axes is None or isinstance(axes, str) else list(axes),
            levels=None if levels is None else list(levels),
            ranges=None if ranges is None else {name: list(of) for name, of in ranges.items()},
            label=label, experiment=experiment)
        population = _given(campaign=_id(campaign), evaluation=_id(evaluation))
        if len(population) + (designs is not None) != 1:
            raise ValueError("certify needs one of designs, campaign and evaluation, got "
                             f"{len(population) + (designs is not None)}")
        if designs is not None:
            if best is not None:
                raise ValueError("best needs a campaign or an evaluation")
            value.update(designs=designs_of(designs, on_fault), on_fault=on_fault,
                         **_given(repair=repair))
        else:
            value["population"] = population | _given(best=best)
        data = await self._connection.json(
            Request.submit("/v1/certificates", {**value, **settings}))
        with reading():
            warn_of_ids(data.get("notes") or ())
        return AsyncCertificate(self._connection, data)

    async def certificate(self, id: str | int) -> AsyncCertificate:
        """Returns the certificate with an id."""
        return AsyncCertificate(self._connection, await self._connection.json(
            Request.get(f"/v1/certificates/{id}")))

    async def certificates(self, *, state: str | None = None, label: str | None = None,
                           experiment: str | None = None,
                           archived: Literal["true", "all"] | None = None) -> pd.DataFrame:
        """Returns a table of certificates, newest first."""
        return frame([row async for row in self._connection.pages(
            "/v1/certificates", state=state, label=label, experiment=experiment,
            archived=archived)])


def _id(job: str | int | AsyncJob | None) -> str | None:
    return None if job is None else job.id if isinstance(job, AsyncJob) else str(job)
