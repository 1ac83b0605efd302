"""Workers of other machines."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ..frames import frame
from ..errors import reading
from .._wire import Request
from .connection import AsyncConnection

if TYPE_CHECKING:
    import pandas as pd


class AsyncFleet:
    """The workers of other machines that compute for the service, as of the last look.

    `data` is what the service reported, by the names of the contract: whether workers can join
    (`listening`), the classes, sums over all workers, and `sessions`.
    """

    def __init__(self, connection: AsyncConnection, data: dict[str, Any]) -> None:
        self._connection = connection
        self.data = data

    @reading()
    def __repr__(self) -> str:
        data = self.data
        return (f"<{data['n_sessions']} workers with {data['n_threads']} threads and "
                f"{data['n_devices']} GPUs, {data['rollouts_per_s']:,.0f} rollouts/s>")

    @property
    @reading()
    def sessions(self) -> pd.DataFrame:
        """A table of the workers: open sessions, then the newest that have ended."""
        return frame(self.data["sessions"])

    async def refresh(self) -> AsyncFleet:
        """Looks again."""
        self.data = await self._connection.json(Request.get("/v1/fleet"))
        return self

    async def drain(self, session: str, upgrade: bool = False) -> None:
        """Gives a worker, by its session's id, no more work: it finishes what it has and leaves.

        For an upgrade its process ends with status 69 and names the service's version, so that
        what supervises it starts what is installed by then.
        """
        query = "?upgrade=true" if upgrade else ""
        await self._connection.send(Request.post(f"/v1/fleet/sessions/{session}/drain{query}"))
