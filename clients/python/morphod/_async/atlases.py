"""The part of the client for atlases that the service has, and for building them."""

from __future__ import annotations

import os
import pathlib
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ..atlas import Atlas
from ..atlas.reader import Where
from ..bodies import Body
from ..errors import counted, reading
from ..frames import frame
from ..scenes import Environments
from .._wire import Request, given as _given
from .connection import AsyncConnection
from .jobs import AsyncJob

if TYPE_CHECKING:
    import pandas as pd

_FILE = "application/octet-stream"


class AsyncStoredAtlas:
    """An atlas of the service (docs/atlas.md). `data` is the service's information about it, with
    the names of the contract. Bodies are given as positions, or as anything that `Body.of` accepts,
    and returned with the names of the contract.

    For many queries, `open` downloads the file, which answers them without the service, in
    microseconds.
    """

    def __init__(self, connection: AsyncConnection, data: dict[str, Any]) -> None:
        self._connection = connection
        self.data = data
        with reading():
            self._path = f"/v1/atlases/{data['name']}"

    @property
    @reading()
    def name(self) -> str:
        """Its name in the service."""
        return str(self.data["name"])

    @reading()
    def __repr__(self) -> str:
        return (f"<{type(self).__name__} {self.name}: "
                f"{counted(self.data['bodies'], 'body', 'bodies')} of at most "
                f"{counted(self.data['voxels_max'], 'voxel')}>")

    async def refresh(self) -> None:
        """Fetches `data` again."""
        self.data = await self._connection.json(Request.get(self._path))

    async def body(self, where: Where, steps: Iterable[str] | None = None,
                   changes: int | None = None) -> dict[str, Any]:
        """Returns a body with its losses, its rank among bodies of its size, and its best
        `changes`."""
        return await self._connection.json(Request.get(
            f"{self._path}/body", **_place(where), **_given(steps=_words(steps), changes=changes)))

    async def neighbors(self, where: Where, steps: Iterable[str] | None = None
                        ) -> list[dict[str, Any]]:
        """Lists the bodies one step away from a body, best first. `steps` are some of
        `add`, `remove` (both by default) and `move`."""
        return await self._items("neighbors", **_place(where), **_given(steps=_words(steps)))

    async def ascent(self, where: Where, steps: Iterable[str] | None = None
                     ) -> list[dict[str, Any]]:
        """Lists the bodies of the steepest ascent from a body, at most 1000."""
        return await self._items("ascent", **_place(where), **_given(steps=_words(steps)))

    async def best(self, limit: int = 10, voxels: int | None = None, *, measure: str | None = None,
                   order: Literal["descending", "ascending"] | None = None,
                   lo: float | None = None, hi: float | None = None,
                   score_lo: float | None = None, score_hi: float | None = None
                   ) -> list[dict[str, Any]]:
        """Lists the best bodies of a size, or of all; at most 1000. With `measure`, those with the
        highest values of a measure, or with the lowest ones in ascending `order`. Only bodies with
        lo ≤ score < hi or, with `measure`, with lo ≤ value < hi and score_lo ≤ score < score_hi."""
        return await self._items("best", limit=limit, **_given(
            voxels=voxels, measure=measure, order=order, lo=lo, hi=hi, score_lo=score_lo,
            score_hi=score_hi))

    async def similar(self, where: Where, limit: int = 10) -> list[dict[str, Any]]:
        """Lists the bodies within two steps of adding or removing a voxel, best first."""
        return await self._items("similar", limit=limit, **_place(where))

    async def optima(self, limit: int = 200) -> dict[str, Any]:
        """Returns the local optima with the largest basins, their number, and which basins touch.
        This takes seconds the first time."""
        return await self._connection.json(Request.get(f"{self._path}/optima", limit=limit))

    async def footprints(self) -> list[dict[str, Any]]:
        """Lists the best body of each footprint."""
        return await self._items("footprints")

    async def histogram(self, bins: int = 64, voxels: int | None = None, *,
                        lo: float | None = None, hi: float | None = None,
                        measure: str | None = None) -> dict[str, Any]:
        """Counts the bodies of each size by score, or by a measure."""
        return await self._connection.json(Request.get(
            f"{self._path}/histogram", bins=bins,
            **_given(voxels=voxels, lo=lo, hi=hi, measure=measure)))

    async def map(self, measure: str, bins: int = 64) -> dict[str, Any]:
        """Compares the scores with a measure: Kendall's τ, and a histogram of both."""
        return await self._connection.json(Request.get(
            f"{self._path}/map", measure=measure, bins=bins))

    async def compare(self, other: str | AsyncStoredAtlas, bins: int = 64) -> dict[str, Any]:
        """Compares the scores of two atlases: Kendall's τ, and a histogram of both scores."""
        name = other.name if isinstance(other, AsyncStoredAtlas) else other
        params: dict[str, Any] = {"with": name, "bins": bins}
        return await self._connection.json(Request.get(f"{self._path}/compare", **params))

    def sample(self, count: int, seed: int = 1) -> dict[str, Any]:
        """Names bodies from the whole ranking as the `population` of a finetuning run: one from
        each of `count` equally large parts, drawn with the seed."""
        return {"atlas": self.name, "count": count, "seed": seed}

    async def save(self, path: str | os.PathLike[str]) -> pathlib.Path:
        """Saves the file."""
        target = pathlib.Path(path)
        await self._connection.save(Request.get(f"{self._path}/file", accept=_FILE), target)
        return target

    async def open(self, path: str | os.PathLike[str]) -> Atlas:
        """Saves the file, checks all of it, and opens it."""
        return Atlas.open(await self.save(path), check=True)

    async def delete(self) -> None:
        """Deletes the atlas permanently."""
        await self._connection.send(Request("DELETE", self._path))

    async def _items(self, what: str, **params: Any) -> list[dict[str, Any]]:
        reply = await self._connection.json(Request.get(f"{self._path}/{what}", **params))
        with reading():
            items: list[dict[str, Any]] = list(reply["items"])
            return items


class AsyncAtlasBuild(AsyncJob):
    """An atlas that the service builds."""

    noun = "atlas"

    @reading()
    def _steps(self) -> tuple[int, int]:
        build = self.data["atlas"]
        return int(build["bodies_done"]), int(build["bodies_total"] or 0)

    async def live(self) -> AsyncAtlasBuild:
        """Shows its progress until it has ended."""
        await self._watch(f"atlas {self.id}", " bodies")
        return self

    async def atlas(self) -> AsyncStoredAtlas:
        """Returns the atlas, once the job has succeeded."""
        with reading():
            name = self.data["atlas"]["name"]
        return AsyncStoredAtlas(self._connection, await self._connection.json(
            Request.get(f"/v1/atlases/{name}")))


class Atlases:
    """Methods of the client."""

    _connection: AsyncConnection

    async def build_atlas(self, voxels: int, *, task: str | None = None,
                          environments: Environments | None = None,
                          orientations: Literal["images", "canonical"] | None = None,
                          measures: Literal[True] | Sequence[str] | None = None,
                          name: str | None = None, label: str | None = None,
                          **settings: Any) -> AsyncAtlasBuild:
        """Scores all bodies of at most `voxels` voxels, and keeps the scores in an atlas: a
        durable job. `measures` are names, such as `["mean_speed_m_per_s"]`, or True for all: the
        atlas then has their means. `settings` are those of the contract, such as `controller` and
        `physics`."""
        value = {"voxels": voxels, **_given(
            task=task, environments=environments, orientations=orientations, measures=measures,
            name=name, label=label), **settings}
        return AsyncAtlasBuild(self._connection, await self._connection.json(
            Request.submit("/v1/atlases", value)))

    async def atlases(self) -> pd.DataFrame:
        """Returns a table of the atlases of the service."""
        reply = await self._connection.json(Request.get("/v1/atlases"))
        with reading():
            return frame(reply["items"])

    async def atlas(self, name: str) -> AsyncStoredAtlas:
        """Returns an atlas of the service."""
        return AsyncStoredAtlas(self._connection, await self._connection.json(
            Request.get(f"/v1/atlases/{name}")))

    async def put_atlas(self, name: str, path: str | os.PathLike[str]) -> AsyncStoredAtlas:
        """Uploads an atlas file, which the service checks. An atlas with this name is replaced."""
        return AsyncStoredAtlas(self._connection, await self._connection.json(Request(
            "PUT", f"/v1/atlases/{name}/file", content=pathlib.Path(path).read_bytes(),
            headers={"Content-Type": _FILE}, timeout_s=600.0)))


def _place(where: Where) -> dict[str, Any]:
    if isinstance(where, (int, np.integer)):
        return {"position": int(where)}
    return {"design": where if isinstance(where, str) else Body.of(where).genotype}


def _words(steps: Iterable[str] | None) -> str | None:
    return steps if steps is None or isinstance(steps, str) else ",".join(steps)
