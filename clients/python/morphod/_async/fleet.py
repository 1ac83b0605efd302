"""Workers on other machines."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ..frames import frame
from ..errors import counted, reading
from .._wire import Request
from .connection import AsyncConnection

if TYPE_CHECKING:
    import pandas as pd


class AsyncFleet:
    """The workers on other machines that compute for the service, as last reported.

    `data` is the service's report, with the names of the contract: whether workers can join
    (`listening`), the classes, sums over all workers, and `sessions`.
    """

    def __init__(self, connection: AsyncConnection, data: dict[str, Any]) -> None:
        self._connection = connection
        self.data = data

    @reading()
    def __repr__(self) -> str:
        data = self.data
        return (f"<{counted(data['n_sessions'], 'worker')} with "
                f"{counted(data['n_threads'], 'thread')} and {counted(data['n_devices'], 'GPU')}, "
                f"{data['rollouts_per_s']:,.0f} rollouts/s>")

    @property
    @reading()
    def sessions(self) -> pd.DataFrame:
        """Returns a table of the workers: open sessions, then the newest ended ones."""
        return frame(self.data["sessions"])

    async def refresh(self) -> AsyncFleet:
        """Looks again."""
        self.data = await self._connection.json(Request.get("/v1/fleet"))
        return self

    async def drain(self, session: str, upgrade: bool = False) -> None:
        """Stops giving work to a worker, given by its session's id: it finishes its leases and
        leaves.

        For an upgrade, its process exits with status 69 and reports the service's version, so that
        its supervisor can start the newly installed program.
        """
        query = "?upgrade=true" if upgrade else ""
        await self._connection.send(Request.post(f"/v1/fleet/sessions/{session}/drain{query}"))
