"""Tasks: in requests, by name and spelled out; values, hashes, storage and refusals."""

import math

import pytest

from service import DESIGN, run
from test_worlds import roll, scene

TALL = {"cells": [[x, y, z] for x in (2, 3) for y in (2, 3) for z in (0, 1)]}
SHORT = {"n_steps": 400, "control_period_s": 0.016}
PLACE = {"light_xy_m": [4.0, 2.5]}
AHEAD = {"kind": "ahead", "heading_rad": 0, "distance_m": 1.5}
SPELLED = {
    "photo": {"guide": {"kind": "fixed"}, "objective": "reach"},
    "photo-auc": {"guide": {"kind": "fixed"}, "objective": "approach"},
    "walk": {"guide": AHEAD, "objective": "travel"},
    "climb": {"guide": AHEAD, "objective": "climb"},
    "circle": {"guide": {"kind": "turning", "heading_rad": 0, "turn_rad_per_s": math.pi / 2,
                         "distance_m": 1.5}, "objective": "travel"},
    "path": {"guide": {"kind": "path", "distance_m": 1.5,
                       "points_m": [[3.5, 2.5], [3.5, 3.5], [2.5, 3.5]]}, "objective": "follow"},
    "shuttle": {"guide": {"kind": "path", "distance_m": 1.5,
                          "points_m": [[3.25, 2.5], [2.5, 2.5], [3.25, 2.5], [2.5, 2.5]]},
                "objective": "follow"},
    "pursue": {"guide": {"kind": "moving", "light_xy_m": [4, 2.5], "velocity_m_per_s": [0.3, 0]},
               "objective": "pursue"},
}
UNITS = {"photo": "", "photo-auc": "", "pursue": ""}


def environment(task):
    fixed = task in ("photo", "photo-auc") or (
        not isinstance(task, str) and task.get("guide", {"kind": "fixed"})["kind"] == "fixed")
    return {"task": task, **(PLACE if fixed else {})}


def evaluate(service, *environments, design=DESIGN, **more):
    reply = service.evaluate({"designs": [design], "environments": list(environments),
                              "physics": SHORT, **more})
    assert reply.json()["state"] == "succeeded", reply.json()
    return reply.json()


@pytest.mark.parametrize("name", SPELLED)
def test_named_tasks_are_the_same_as_spelled_out(service, name):
    """Both have one hash and one stored score, and the task is reported spelled out."""
    spelled = SPELLED[name]
    first = evaluate(service, environment(name))
    again = evaluate(service, environment(spelled))
    assert again["rollouts_cached"] == 1
    assert again["results"][0]["losses"] == first["results"][0]["losses"]
    worlds = [service.get(f"/v1/evaluations/{one['id']}/environments")["items"]
              for one in (first, again)]
    assert worlds[0] == worlds[1]
    (world, ) = worlds[0]
    assert world.get("task") == (None if name == "photo" else spelled)
    assert ("light_xy_m" in world) == name.startswith("photo")
    assert set(world["terrain_heights_m"]) == {0}
    assert service.get("/v1/environments/" + world["sha256"]) == world
    # What is reported can be sent back.
    world.pop("sha256")
    assert evaluate(service, world)["rollouts_cached"] == 1


def value_of(name, loss):
    if UNITS.get(name) == "":
        return 1 - loss
    return -(0.1 if name == "climb" else 1) * math.log(loss)


def test_losses_have_values_with_units(service):
    """Each environment of a list has the loss, value and unit of its own task; a mean of values
    is reported where all have one unit. Lists of plain tasks have numbers as before."""
    names = list(SPELLED)
    result, = evaluate(service, *map(environment, names))["results"]
    assert [entry["unit"] for entry in result["losses"]] == [UNITS.get(n, "m") for n in names]
    for name, entry in zip(names, result["losses"]):
        assert entry["value"] == pytest.approx(value_of(name, entry["loss"]), abs=1e-12)
    assert result["score"] == pytest.approx(
        sum(entry["loss"] for entry in result["losses"]) / len(names))
    assert "value" not in result and "unit" not in result
    result, = evaluate(service, *map(environment, ("walk", "climb", "path")))["results"]
    assert result["unit"] == "m"
    assert result["value"] == pytest.approx(
        sum(entry["value"] for entry in result["losses"]) / 3)
    result, = evaluate(service, environment("photo"), PLACE | {"terrain_sigma_m": 0, "seed": 1})[
        "results"]
    assert all(isinstance(loss, float) for loss in result["losses"])
    assert "value" not in result


def test_rollouts_and_tables_have_values(service):
    asked = {"designs": [DESIGN], "physics": SHORT,
             "environments": [environment("walk"), environment("photo")]}
    walked, plain = service.post("/v1/rollouts", asked)["rollouts"]
    assert walked["unit"] == "m"
    assert walked["value"] == pytest.approx(value_of("walk", walked["loss"]), abs=1e-12)
    assert "value" not in plain
    job = evaluate(service, environment("walk"))
    result, = job["results"]
    assert result["losses"][0]["loss"] == walked["loss"]
    row, = service.table(f"/v1/evaluations/{job['id']}/results?format=csv")
    assert float(row["value"]) == result["value"] and row["unit"] == "m"


def test_scenes_have_lights(service):
    """Rollouts and recordings have the light of each frame where a task moves it: 1.5 m ahead of
    the center of mass, or on its own."""
    asked = {"designs": [DESIGN], "physics": SHORT, "record": ["com", "masses"],
             "record_stride": 20, "environments": [
                 environment("walk"), environment("pursue"), environment("photo")]}
    header, array = scene(roll(service, asked))
    ahead, moving, fixed = header["rollouts"]
    n = 21
    com = array(ahead["com_m"])
    lights = array(ahead["lights_m"])
    assert ahead["lights_m"]["shape"] == [n, 3]
    for frame in range(n):
        assert lights[3 * frame:3 * frame + 3] == pytest.approx(
            [com[3 * frame] + 1.5, com[3 * frame + 1], 0], abs=1e-6)
    walked = lights
    lights = array(moving["lights_m"])
    for frame in range(n):
        assert lights[3 * frame:3 * frame + 2] == pytest.approx(
            [4 + 0.3 * 0.04 * frame, 2.5], abs=1e-6)
    assert "lights_m" not in fixed
    assert "light_xy_m" not in header["environments"][0]
    assert header["environments"][0]["task"] == SPELLED["walk"]
    job = evaluate(service, environment("walk"), record=["masses"], record_stride=20)
    header, array = scene(service.request(
        "GET", f"/v1/evaluations/{job['id']}/trajectories/0?environment=0&format=scene"))
    recorded = array(header["rollouts"][0]["lights_m"])
    assert recorded == pytest.approx(walked, abs=1e-5)


def test_a_task_changes_the_score(service):
    """Every task has a loss of its own; the heading matters, and where the light is."""
    losses = {}
    for name in SPELLED:
        entry, = evaluate(service, environment(name), design=TALL)["results"][0]["losses"]
        losses[name] = entry["loss"] if isinstance(entry, dict) else entry
    back = {"guide": AHEAD | {"heading_rad": math.pi}}
    losses["back"] = evaluate(service, environment(back), design=TALL)["results"][0]["losses"][0][
        "loss"]
    orbit = {"guide": {"kind": "moving", "light_xy_m": [4, 2.5], "turn_rad_per_s": 1}}
    losses["orbit"] = evaluate(service, environment(orbit), design=TALL)["results"][0]["losses"][
        0]["loss"]
    # In 0.8 s, the robot is on the first leg of both paths, which begin alike.
    assert len(set(losses.values())) >= len(losses) - 1, losses


REFUSED = [
    ({"task": "fly"}, "/task", 'must be an object or "photo"'),
    ({"task": 3}, "/task", "object"),
    ({"task": {"guide": {}}}, "/task/guide", "kind is missing"),
    ({"task": {"guide": {"kind": "ahead", "turn_rad_per_s": 1}}}, "/task/guide",
     'a guide of kind "ahead" has no turn_rad_per_s; remove it'),
    ({"task": {"guide": {"kind": "turning"}}}, "/task/guide", "turn_rad_per_s is missing"),
    ({"task": {"guide": {"kind": "path", "points_m": []}}}, "/task/guide/points_m",
     "must have 1 to 16 waypoints"),
    ({"task": {"guide": {"kind": "path", "points_m": [[1, 2]] * 17}}}, "/task/guide/points_m",
     "must have 1 to 16 waypoints"),
    ({"task": {"guide": {"kind": "path", "points_m": [[1, 2], [3]]}}},
     "/task/guide/points_m/1", "must be an array of 2 numbers"),
    ({"task": {"guide": {"kind": "path", "points_m": [[1, 2000]]}}},
     "/task/guide/points_m/0/1", "must be"),
    ({"task": {"guide": {"kind": "moving"}}}, "/task/guide", "light_xy_m is missing"),
    ({"task": {"guide": {"kind": "moving", "light_xy_m": [2.5, 2.55]}}}, "/task/guide/light_xy_m",
     "at least 0.1 m from"),
    ({"task": {"guide": {"kind": "moving", "light_xy_m": [4, 4], "center_m": [1, 1]}}},
     "/task/guide", "center_m needs a turn_rad_per_s other than 0; remove it"),
    ({"task": {"guide": {"kind": "moving", "light_xy_m": [4, 4], "center_m": [0, 0]}}},
     "/task/guide", "center_m needs a turn_rad_per_s other than 0; remove it"),
    ({"task": {"guide": AHEAD, "objective": "reach"}}, "/task",
     "objective reach needs a guide that is fixed or moving, got ahead"),
    ({"task": {"guide": AHEAD, "objective": "dance"}}, "/task/objective", "must be"),
    ({"task": {"guide": AHEAD | {"distance_m": 0.01}}}, "/task/guide/distance_m",
     "must be at least 0.1"),
    ({"task": {"guide": AHEAD, "speed": 1}}, "/task/speed", "unknown field"),
    ({"task": "photo", "light_xy_m": [2.5, 2.5]}, "/light_xy_m", "at least 0.1 m from"),
    ({"task": "walk", **PLACE}, "", "light_xy_m is only for a fixed light"),
    ({"task": "photo"}, "", "light_xy_m is missing"),
    ({"task": "walk", "terrain_sigma_m": 0.1}, "", "leave all of them out for flat ground"),
    ({"task": "walk", "seed": 1}, "", "leave all of them out for flat ground"),
    (PLACE, "", "give the terrain either"),
]


@pytest.mark.parametrize("case", range(len(REFUSED)))
def test_invalid_tasks_are_refused(service, case):
    given, below, words = REFUSED[case]
    reply = service.request("POST", "/v1/evaluations",
                            {"designs": [DESIGN], "environments": [given]})
    assert reply.status == 422, reply.json()
    faults = {fault["pointer"]: fault["detail"] for fault in reply.json()["errors"]}
    assert words in faults["/environments/0" + below], faults


def test_members_may_come_in_any_order(service):
    """The same task with its members in another order, and the light after the task."""
    backward = {"task": dict(reversed([
        ("objective", "travel"), ("guide", dict(reversed(AHEAD.items())))]))}
    first = evaluate(service, environment("walk"))
    again = evaluate(service, backward)
    assert again["rollouts_cached"] == 1 and first["results"][0]["losses"] == again["results"][0][
        "losses"]
    late = {"task": {"objective": "approach"}, **PLACE}
    early = {**PLACE, "task": {"objective": "approach"}}
    assert evaluate(service, late)["results"][0]["losses"] == evaluate(service, early)["results"][
        0]["losses"]


def test_studies_and_campaigns_keep_tasks(service):
    """A study reports values; a differing task is named; a campaign selects by the task."""
    study = {"mode": "study", "population": 16, "environments": [environment("walk")],
             "physics": SHORT, "label": "a study that walks"}
    made = service.post("/v1/campaigns", study)
    told = service.post(f"/v1/campaigns/{made['id']}/tell",
                        {"batch": 0, "children": [{"body": DESIGN}, {"body": TALL}]},
                        headers={"Prefer": "wait=60"})
    for child in told["children"]:
        entry, = child["losses"]
        assert entry["unit"] == "m" and child["value"] == entry["value"]
    other = study | {"environments": [environment("climb")], "if_exists": "return"}
    reply = service.request("POST", "/v1/campaigns", other)
    assert "/environments/0/task" in reply.pointers()
    assert '"objective":"climb"' in reply.json()["errors"][0]["detail"]
    campaign = run(service, "campaigns", {
        "mode": "zero-shot", "population": 8, "generations": 2, "seed": 5, "physics": SHORT,
        "environments": [environment("walk")]})
    items = service.get(f"/v1/campaigns/{campaign['id']}/environments")["items"]
    assert items[0]["task"] == SPELLED["walk"]
    scores = [row["score"]["best"] if "best" in row["score"] else row["score"]["quantiles"]["p0"]
              for row in service.get(f"/v1/campaigns/{campaign['id']}/generations")["items"]]
    assert scores[-1] <= scores[0]


def test_the_suite_is_in_every_service(service):
    """The sets of morpho-12 are listed, and requests accept their names; designs are ranked by
    them. An unknown name is refused."""
    sets = {one["name"]: one["environments"]
            for one in service.get("/v1/environment-sets")["items"]}
    assert sets.pop("paper-test") == 10 and len(sets) == 24
    suites = service.get("/v1/environment-sets")["suites"]
    assert [(one["name"], one["environments"]) for one in suites] == [
        ("morpho-12", 120), ("morpho-12-held-out", 768)]
    for suite, end in zip(suites, ("", "-held-out")):
        assert [one["environments"] for one in suite["tasks"]] == [
            f"morpho-12-{one['task']}{end}" for one in suite["tasks"]]
        assert suite["environments"] == sum(sets[one["environments"]] for one in suite["tasks"])
    assert {one["environments"] for suite in suites for one in suite["tasks"]} == set(sets)
    reply = service.request("GET", "/v1/environment-sets/morpho-12")
    assert reply.status == 404 and "such as morpho-12-walk" in reply.json()["detail"]
    for name, n in sets.items():
        assert n == (64 if name.endswith("-held-out") else 10)
    for name in ("walk", "up", "gap"):
        worlds = service.get(f"/v1/environment-sets/morpho-12-{name}")["items"]
        assert len(worlds) == 10
        objectives = {world["task"]["objective"] for world in worlds}
        assert objectives == {"climb" if name == "up" else "travel"}
    job = service.evaluate({"designs": [DESIGN, TALL], "environments": "morpho-12-walk"}).json()
    assert job["environments"] == "morpho-12-walk" and job["state"] == "succeeded"
    for result in job["results"]:
        assert len(result["losses"]) == 10 and result["unit"] == "m"
    ranked = service.get("/v1/designs?sort=score&environments=morpho-12-walk")["items"]
    assert [row["score"] for row in ranked[:2]] == sorted(
        result["score"] for result in job["results"])
    reply = service.request("POST", "/v1/evaluations",
                            {"designs": [DESIGN], "environments": "morpho-12-fly"})
    assert reply.status == 422 and "/v1/environment-sets" in reply.json()["errors"][0]["detail"]


def test_the_worlds_of_a_set_are_counted_and_measured(service):
    """Limits hold for the worlds of a named set as for a list."""
    refusal = service.request("POST", "/v1/evaluations",
                              {"random": {"seed": 1, "count": 200000},
                               "environments": "morpho-12-walk-held-out"}).json()
    assert refusal["errors"][0]["pointer"] == "/random/count"
    assert "12800000 rollouts" in refusal["errors"][0]["detail"]
    worlds = service.get("/v1/environment-sets/morpho-12-up")["items"]
    assert max(max(world["terrain"]["heights_m"]) for world in worlds) > 1
    reply = service.request("POST", "/v1/evaluations",
                            {"designs": [DESIGN], "environments": "morpho-12-up", "error": True})
    assert reply.status == 422 and "float64" in reply.json()["errors"][0]["detail"]


def test_springs_break(service):
    """Damage is told back, changes the score of a rollout that lasts long enough, and belongs to
    the identity of an environment; what makes no sense is refused."""
    world = {"light_xy_m": [4, 3], "terrain_sigma_m": 0.05, "seed": 1}
    worlds = [world, world | {"damage": {"octant": 0, "time_s": 0.1}},
              world | {"damage": {"octant": 0, "time_s": 10}},
              {"task": "walk", "damage": {"octant": 7, "time_s": 0}}, {"task": "walk"}]
    job = service.evaluate({"designs": [TALL], "environments": worlds,
                            "physics": {"n_steps": 500}}).json()
    losses = [entry["loss"] for entry in job["results"][0]["losses"]]
    assert losses[0] == losses[2] != losses[1] and losses[3] != losses[4]
    shown = service.request("POST", "/v1/rollouts", {
        "designs": [TALL], "environments": worlds[1:2], "physics": {"n_steps": 500}},
        headers={"Accept": "application/json"}).json()
    assert shown["environments"][0]["damage"] == {"octant": 0, "time_s": 0.1}
    assert shown["rollouts"][0]["loss"] == losses[1]
    damaged = service.get("/v1/environment-sets/morpho-12-damage")["items"]
    assert [one["damage"] for one in damaged] == [
        {"octant": i % 8, "time_s": 2} for i in range(10)]
    campaign = service.request("POST", "/v1/campaigns", {
        "mode": "study", "label": "broken", "environments": worlds[1:2]}).json()
    reply = service.request("POST", "/v1/campaigns", {
        "mode": "study", "label": "broken", "if_exists": "return", "environments": worlds[2:3]})
    assert reply.status == 409 and "/environments/0/damage" in reply.body.decode(), reply.body
    service.act(campaign["id"], "cancel")
    for damage, place, words in [
            ({"octant": 8, "time_s": 1}, "/octant", "7"), ({"octant": 1}, "", "time_s is missing"),
            ({"time_s": 1}, "", "octant is missing"), ({"octant": 1, "time_s": -1}, "/time_s", "0"),
            ({"octant": 1, "time_s": 1, "share": 1}, "/share", "octant, time_s"),
            ([1], "", "object")]:
        reply = service.request("POST", "/v1/evaluations", {
            "designs": [TALL], "environments": [world | {"damage": damage}]})
        error = reply.json()["errors"][0]
        assert error["pointer"] == f"/environments/0/damage{place}", error
        assert words in error["detail"], error
