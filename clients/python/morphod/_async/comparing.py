"""Fetches the data for comparisons."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ..comparisons import (CONFIDENCE, CampaignComparison, ControllerComparison, crossed,
                           differences_of, recipe_of, require_comparable, require_two_controllers,
                           training_differences, welch)
from ..errors import MorphodError, reading
from .._wire import Request
from .connection import AsyncConnection
from .handles import AsyncCampaign, AsyncCampaigns, AsyncTraining

if TYPE_CHECKING:
    from .client import AsyncClient


def sides_of(campaigns: Sequence[str | int | AsyncCampaign | AsyncCampaigns]) -> list[str]:
    """Returns one campaign id for each side. Each group in an `AsyncCampaigns` is a side."""
    ids: list[str] = []
    for one in campaigns:
        if isinstance(one, AsyncCampaigns):
            with reading():
                ids += dict.fromkeys(str(member.data["group"]["id"]) for member in one)
        else:
            ids.append(one.id if isinstance(one, AsyncCampaign) else str(one))
    if len(ids) < 2:
        raise MorphodError(f"a comparison needs at least two campaigns, got {len(ids)}; a campaign "
                           "and its replicates count as one")
    for id in ids:
        if ids.count(id) > 1:
            raise MorphodError(f"campaign {id} is given twice: there is nothing to compare")
    return ids


async def compare_campaigns(connection: AsyncConnection, ids: Sequence[str]
                            ) -> CampaignComparison:
    """Compares campaigns with the first one."""
    with reading():
        campaigns = [await connection.json(Request.get(f"/v1/campaigns/{id}")) for id in ids]
        conditions = [await _conditions(connection, one) for one in campaigns]
        groups = [one["group"]["id"] for one in campaigns]
        sides, members = [], []
        for place, campaign in enumerate(campaigns):
            alone = groups.count(groups[place]) > 1
            counted, early = await _members(connection, campaign, alone)
            differences = differences_of(conditions[0], conditions[place])
            require_comparable(ids[0], ids[place], differences)
            sides.append({"campaign": campaign["id"], "label": campaign["label"],
                          "replicates": [one["id"] for one in counted], "left_out": early,
                          "differences": differences})
            members.append(counted)
        generation = min(_newest(one) for side in members for one in side)
        scores = [[await _best(connection, one["id"], generation) for one in side]
                  for side in members]
    for place, side in enumerate(sides):
        side["best"] = sum(scores[place]) / len(scores[place])
        if place > 0:
            side.update(welch(scores[0], scores[place]))
    return CampaignComparison({"generation": generation, "confidence": CONFIDENCE,
                               "sides": sides})


async def _conditions(connection: AsyncConnection, campaign: dict[str, Any]) -> dict[str, Any]:
    """Returns what scores depend on, except the seed."""
    worlds = await connection.json(Request.get(f"/v1/campaigns/{campaign['id']}/environments"))
    settings = {name: value for name, value in campaign["settings"].items() if name != "seed"}
    settings["environments"] = [world["sha256"] for world in worlds["items"]]
    return {"mode": campaign["mode"], "settings": settings,
            "controller": (campaign["controller"] or {}).get("sha256"),
            "device": campaign["device"],
            "own_score": campaign.get("own_score")}


async def _members(connection: AsyncConnection, campaign: dict[str, Any], alone: bool
                   ) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Returns the replicates that count, and those that ended early.
    If all ended early, all count."""
    if alone:
        return [campaign], []
    group = [one async for one in
             connection.pages("/v1/campaigns", group=campaign["group"]["id"], archived="all")]
    counted = [one for one in group if one["state"] not in ("cancelled", "failed")]
    early = [{"id": one["id"], "state": one["state"]} for one in group if one not in counted]
    return (counted, early) if counted else (group, [])


def _newest(campaign: dict[str, Any]) -> int:
    if campaign["newest"] is None:
        raise MorphodError(f"campaign {campaign['id']} has no complete generation yet")
    return int(campaign["newest"]["generation"])


async def _best(connection: AsyncConnection, id: str, generation: int) -> float:
    page = await connection.json(Request.get(
        f"/v1/campaigns/{id}/generations", limit=1,
        cursor=generation - 1 if generation > 0 else None))
    best = page["items"][0]["score"]["quantiles"]["p0"]
    return math.nan if best is None else float(best)


# ---- controllers ----


async def compare_controllers(client: AsyncClient, a: str | AsyncTraining, b: str | AsyncTraining,
                              held_out: tuple[int, int, int], settings: dict[str, Any]
                              ) -> ControllerComparison:
    """Compares two controllers. held_out: seed, numbers of designs and environments."""
    seed, designs, environments = held_out
    sources = [await _controller_of(client, one) for one in (a, b)]
    controllers = [about for _, _, about in sources]
    with reading():
        require_two_controllers(sources[0][1], sources[1][1], controllers)
        recipes = [recipe_of(about) for about in controllers]
        differences = training_differences(controllers, recipes)
    bodies, worlds = await client.held_out(seed, designs=designs, environments=environments)
    scored = [await client.evaluate(bodies, worlds, controller=controller, **settings)
              for controller, _, _ in sources]
    found = crossed(scored[0].losses, scored[1].losses)
    sides = {}
    for side, (_, name, _), recipe, evaluation in zip("ab", sources, recipes, scored):
        with reading():
            sides[side] = {
                "controller": name, "sha256": evaluation.data["controller"]["sha256"],
                "evaluation": evaluation.id, "mean_score": found.pop(f"mean_{side}"),
                "designs_diverged": sum(math.isnan(row.score) for row in evaluation),
                "rollouts_diverged": sum(len(row.data["diverged"]) for row in evaluation),
                "training_known": recipe is not None}
    return ControllerComparison({
        **sides, "differences": differences, "confidence": CONFIDENCE, **found,
        "held_out": {"seed": seed, "designs": designs, "environments": environments}})


async def _controller_of(client: AsyncClient, source: str | AsyncTraining
                         ) -> tuple[str, str, dict[str, Any]]:
    """Returns a reference to a controller that exists, its name, and the service's reply about it.
    """
    if isinstance(source, AsyncTraining):
        await source.refresh()
        with reading():
            result = source.data["controller"]
            if result is None:
                raise MorphodError(f"training {source.id} has no controller yet: wait() for its "
                                   "end")
            source, name = f"sha256:{result['sha256']}", str(result["name"])
    else:
        name = source
    return source, name, await client.request("GET", f"/v1/controllers/{source}")
