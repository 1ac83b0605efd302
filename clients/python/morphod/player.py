"""The stage of the dashboard as one HTML file that needs no service and no network."""

from __future__ import annotations

import base64
import html
import json
import os
import pathlib
import re
from collections.abc import Generator
from typing import Any

import numpy as np

from .errors import MorphodError
from .scenes import Rollout, Scene

# Blue, orange, green, pink, gray, yellow: color-blind people can distinguish them.
_COLORS = ("#5aa9e6", "#f3a536", "#3fae8c", "#d77fb4", "#a9b4c0", "#e2d04b")


class Player:
    """Walking robots. It shows itself in a notebook; `save` writes it as one HTML file."""

    def __init__(self, page: str) -> None:
        self.html = page

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the HTML file. Its name ends in .html or .htm, or has no suffix."""
        suffix = pathlib.Path(path).suffix
        if suffix.lower() not in ("", ".html", ".htm"):
            raise ValueError(f"{path}: a player is an HTML file; name it .html (morphoctl film and "
                             "picture make films and pictures)")
        with open(path, "w", encoding="utf-8") as file:
            file.write(self.html)

    def _repr_html_(self) -> str:
        return (f'<iframe srcdoc="{html.escape(self.html)}" sandbox="allow-scripts"'
                ' style="width:100%;height:480px;border:0"></iframe>')


def player_of(index: str, scene: Scene, title: str) -> Generator[str | Player, str, None]:
    """Makes a player. Yields the path of each dashboard file that it needs, expects the file's text
    in return, and finally yields the player. `index` is the text of the dashboard's page."""
    found = re.search(r"assets/[0-9a-f]{16}", index)
    if found is None:
        raise MorphodError("there are no players without the dashboard, and the service runs with "
                           "the setting dashboard = off")
    assets = f"/{found[0]}"
    page = yield f"{assets}/export/page.js"
    names = re.findall(r"'([^']+)'", _part(page, r"const MODULES = \[(.*?)\];"))
    modules = []
    for name in names:
        source = yield f"{assets}/{name}"
        modules.append(_inline(source))
    script = "\n".join(modules)
    script += _part(page, r"const SCRIPT = `(.*?)`;\n")
    text = html.escape(title)
    yield Player(
        '<!doctype html><html lang="en"><meta charset="utf-8">'
        f'<meta name="viewport" content="width=device-width"><title>{text}</title>'
        f'<style>{_part(page, "const STYLE = `(.*?)`;")}</style>'
        f'<canvas tabindex="0" aria-label="{text}"></canvas>'
        '<footer><button id="play"></button>'
        '<input id="time" type="range" min="0" step="any" aria-label="Time">'
        '<button id="side">Side by side</button><button id="springs">Springs</button>'
        '<span id="names"></span></footer>'
        f'<script type="module">const DATA={_safe(json.dumps(_data(scene)))};\n'
        f'{_safe(script)}</script></html>')


def _part(source: str, pattern: str) -> str:
    found = re.search(pattern, source, re.DOTALL)
    if found is None:
        raise MorphodError("this service's dashboard has a different version than this package: "
                           "install the package version of the service")
    return found[1]


def _inline(source: str) -> str:
    """Returns a module's source as part of one script, which already has its imports."""
    source = re.sub(r"^import [^;]*;$", "", source, flags=re.MULTILINE)
    return re.sub(r"^export (?=(const|function|class|async))", "", source, flags=re.MULTILINE)


def _safe(text: str) -> str:
    """Text inside a script element must not end it."""
    return text.replace("</", "<\\/").replace("<!--", "<\\!--")


def _result(rollout: Rollout) -> str:
    if rollout.unit and rollout.value is not None:
        return f"{rollout.value:.2f} {rollout.unit}"
    return "diverged" if rollout.loss is None else f"{rollout.loss:.4f}"


def _first_light(scene: Scene, environment: int) -> list[float]:
    """Where the guide of a task places the light at the start."""
    for rollout in scene:
        if rollout.environment == environment and "lights_m" in rollout.more:
            first: list[float] = rollout.more["lights_m"][0, :2].tolist()
            return first
    return [2.5, 4.5]


def _terrain(world: dict[str, Any]) -> dict[str, Any]:
    if "terrain" in world:
        heights = np.asarray(world["terrain"]["heights_m"])
        columns = {"columns": heights.shape[1]} if heights.ndim == 2 else {}
        return {"heights": heights.ravel().tolist(), "spacing": world["terrain"]["spacing_m"],
                **columns}
    return {"heights": np.ravel(world["terrain_heights_m"]).tolist()}


def _data(scene: Scene) -> dict[str, Any]:
    worlds = [{"light": list(world.get("light_xy_m", _first_light(scene, place))),
               "points": world.get("task", {}).get("guide", {}).get("points_m"),
               "task": world.get("task"),
               **_terrain(world)}
              for place, world in enumerate(scene.environments)]
    robots = []
    for place, rollout in enumerate(scene):
        if rollout.masses_m is None:
            raise MorphodError('a player needs recorded masses: record=["masses"]')
        robots.append({
            "genotype": scene.designs[rollout.design]["genotype"],
            "label": f"design {rollout.design}",
            "result": _result(rollout),
            "frames": len(rollout.masses_m),
            "frameS": scene.frame_s,
            "lights": (None if "lights_m" not in rollout.more
                       else np.ravel(rollout.more["lights_m"]).tolist()),
            "color": _COLORS[place % len(_COLORS)],
            "world": rollout.environment,
            "track": base64.b64encode(np.ascontiguousarray(rollout.masses_m).tobytes()).decode(),
        })
    return {"worlds": worlds, "robots": robots}
