"""Walking robots: the environments and the player with which job objects show them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..errors import MorphodError, reading
from ..player import Player, player_of
from ..scenes import Scene
from .._wire import Request
from .connection import AsyncConnection


@reading()
def world_of(worlds: Mapping[str, Any], environment: int) -> dict[str, Any]:
    """One of the environments that the service lists."""
    items = worlds["items"]
    if not -len(items) <= environment < len(items):
        raise MorphodError(f"there is no environment {environment}: there are {len(items)}, "
                           "counted from 0")
    return {name: value for name, value in items[environment].items() if name != "sha256"}


async def player(connection: AsyncConnection, scene: Scene, title: str) -> Player:
    """Returns a player for a scene, made from the modules of the service's own dashboard."""
    index = await connection.send(Request.get("/", accept="text/html"))
    with reading():
        making = player_of(index.content.decode(), scene, title)
        step = next(making)
    while isinstance(step, str):
        content = (await connection.send(Request.get(step, "*/*"))).content
        with reading():
            step = making.send(content.decode())
    return step
