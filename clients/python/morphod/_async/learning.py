"""The part of the client for training runs and controllers."""

from __future__ import annotations

import os
import pathlib
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, Literal

from ..bodies import BodyLike, designs_of, voxels_of, warn_of_ids
from ..errors import reading
from ..frames import frame
from ..results import Controller
from ..scenes import Environments
from ..weights import write_safetensors
from .._wire import Request, given as _given
from .connection import AsyncConnection
from .handles import AsyncTraining

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd
    from numpy.typing import NDArray


class Learning:
    """Methods of the client."""

    _connection: AsyncConnection

    async def pretrain(self, *, preset: (Literal["workstation", "phototaxis", "paper", "robust"] |
                                         None) = None,
                       environments: Environments | None = None, name: str | None = None,
                       label: str | None = None, **settings: Any) -> AsyncTraining:
        """Starts training a controller on an endless stream of random bodies, in random
        worlds or in these `environments`; each robot of a step gets one. `settings` are
        those of the contract (docs/learning.md), such as `steps`, `batch`, `tasks=["walk"]`,
        `vary={"friction": [0.5, 1.2], "drop_m": [0, 0.2], "slope_degrees": [0, 10]}`."""
        return await self._train("pretrain", settings, preset=preset, environments=environments,
                                 name=name, label=label)

    async def finetune(self, bodies: Iterable[BodyLike] | NDArray[Any] | None = None, *,
                       preset: Literal["workstation", "paper"] | None = None,
                       environments: Environments | None = None, name: str | None = None,
                       label: str | None = None, each: bool = False,
                       keep: Literal["none", "all"] | None = None, best: int | None = None,
                       **settings: Any) -> AsyncTraining:
        """Starts finetuning a controller on bodies, or on a `population` of the service such as
        `{"campaign": "12"}`, or `StoredAtlas.sample(500)` for bodies from the whole ranking of an
        atlas; `environments` as in `pretrain`.

        With `each`, every body learns individually, starting from the same controller, and is
        scored before and after: see `Training.each()`. The service then stores none of the
        controllers, all of them (`keep="all"`), or only those of the `best` scores."""
        settings |= _given(keep=keep, best=best)
        if each:
            settings["each"] = True
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
        """Returns the training run with an id."""
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
        """Returns bodies (designs, 6, 6, 4) and environments that are never used for training;
        always the same for a seed."""
        found = await self._connection.json(Request.get(
            "/v1/held-out", seed=seed, designs=designs, environments=environments))
        with reading():
            return (voxels_of(design["voxels"] for design in found["designs"]),
                    list(found["environments"]))
