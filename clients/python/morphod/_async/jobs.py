"""What the service's jobs have in common, as objects."""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping
from typing import Any

import anyio

from ..errors import JobError, WaitError, printable, reading
from ..progress import Bar, doing
from .._wire import WAIT_S, Request
from .connection import AsyncConnection

_ENDED = ("succeeded", "failed", "cancelled")
_STATES = ("queued", "running", "paused", *_ENDED)
POLL_S = 1.0
AT_ONCE_S = 0.5
"""If a request that should have waited is answered early, it is not repeated immediately."""


def interrupted(*jobs: AsyncJob) -> KeyboardInterrupt:
    """Returns the exception for an interrupt, which lists the jobs that continue."""
    words = "; ".join(f"{job.noun} {job.id} continues: {job.finder}({job.id!r}).cancel(), or "
                      f"morphoctl job cancel {job.id}, ends it" for job in jobs if not job.ended)
    return KeyboardInterrupt(*([words] if words else []))


class AsyncJob:
    """What evaluations, campaigns and training runs have in common.

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
        `WaitError` after `timeout_s`; the job then continues. The service may restart
        in the meantime."""
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
                    await anyio.sleep(POLL_S)
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
        """Cancels it permanently. Results that a campaign or training run has committed are
        kept."""
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
