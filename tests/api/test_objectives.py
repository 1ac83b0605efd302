"""Objectives `efficient` and `jump`, and weighted sums: in requests, results, storage, refusals."""

import json
import subprocess

import pytest

from ctl import MORPHOCTL
from service import DESIGN, run

TALL = {"cells": [[x, y, z] for x in (2, 3) for y in (2, 3) for z in (0, 1)]}
SHORT = {"n_steps": 400}
AHEAD = {"kind": "ahead"}
# The two examples of docs/tasks.md.
STAIRS = {"task": {"guide": AHEAD, "objective": {"travel": 1, "work_j": -2e-5}},
          "terrain": {"kind": "stairs-up"}}
JUMP = {"task": {"guide": {"kind": "moving", "light_xy_m": [4, 2.5], "turn_rad_per_s": 6.28},
                 "objective": "jump"}}
STRAIN = {"task": {"guide": AHEAD, "objective": {"peak_strain": -2, "travel": 1}},
          "terrain": {"kind": "stairs-up"}}
EFFICIENT = {"task": {"guide": AHEAD, "objective": "efficient"}}


def evaluate(service, *environments, design=DESIGN, **more):
    job = service.evaluate({"designs": [design], "environments": list(environments),
                            "physics": SHORT, **more}).json()
    assert job["state"] == "succeeded", job
    return job


def losses_of(service, *environments, **more):
    return evaluate(service, *environments, **more)["results"][0]["losses"]


def test_values_are_those_of_the_definitions(service):
    """Values follow from the measures of the same rollouts, and losses from the values."""
    walk = {"task": "walk", "terrain": {"kind": "stairs-up"}}
    rows = losses_of(service, STAIRS, JUMP, STRAIN, EFFICIENT, walk, measures=True)
    measures = [row["measures"] for row in rows]
    assert [row["unit"] for row in rows] == ["", "m", "", "m/kJ", "m"]
    assert rows[0]["value"] == pytest.approx(rows[4]["value"] - 2e-5 * measures[0]["work_j"],
                                             abs=1e-5)
    assert rows[2]["value"] == pytest.approx(rows[4]["value"] - 2 * measures[2]["peak_strain"],
                                             abs=1e-5)
    way = max(measures[3]["displacement_m"] - 0.2, 0)
    assert rows[3]["value"] == pytest.approx(1000 * way / measures[3]["work_j"], abs=1e-5)
    for row, scale in zip(rows, (1, 0.1, 1, 0.1, 1)):
        assert row["loss"] == pytest.approx(pow(2.718281828459045, -row["value"] / scale))
    bare = losses_of(service, STAIRS, JUMP, STRAIN, EFFICIENT, walk)  # stored, without measures
    assert [row["value"] for row in bare] == [row["value"] for row in rows]


def test_a_task_is_echoed_stored_and_its_order_does_not_count(service):
    """Terms have one order, so equal sums have one hash and one stored score."""
    first = evaluate(service, STRAIN)
    turned = {**STRAIN, "task": {"guide": AHEAD, "objective": {"travel": 1, "peak_strain": -2}}}
    again = evaluate(service, turned)
    assert again["rollouts_cached"] == 1
    (world, ) = service.get(f"/v1/evaluations/{again['id']}/environments")["items"]
    assert world["task"]["objective"] == {"travel": 1, "peak_strain": -2}
    assert list(world["task"]["objective"]) == ["travel", "peak_strain"]
    other = evaluate(service, {**STRAIN, "task": {
        "guide": AHEAD, "objective": {"travel": 1, "peak_strain": -2.5}}})
    assert other["rollouts_cached"] == 0
    assert other["results"][0]["losses"] != first["results"][0]["losses"]
    for one in (EFFICIENT, JUMP):
        job = evaluate(service, one)
        (world, ) = service.get(f"/v1/evaluations/{job['id']}/environments")["items"]
        assert world["task"]["objective"] == one["task"]["objective"]
        assert evaluate(service, {"task": world["task"]})["rollouts_cached"] == 1


def test_campaigns_and_studies(service):
    """A campaign selects by a weighted sum, also with a measure that has no derivative; a study
    with another objective is another study."""
    small = {"mode": "zero-shot", "preset": "demo", "seed": 1, "environments": [STRAIN, JUMP],
             "population": 8, "generations": 2, "physics": {"n_steps": 100}}
    job = run(service, "campaigns", small)
    assert job["state"] == "succeeded"
    worlds = service.get(f"/v1/campaigns/{job['id']}/environments")["items"]
    assert worlds[0]["task"]["objective"] == {"travel": 1, "peak_strain": -2}
    study = {"mode": "study", "label": "sums"}
    made = service.request("POST", "/v1/campaigns", {**study, "environments": [STAIRS]}).json()
    reply = service.request("POST", "/v1/campaigns", {
        **study, "if_exists": "return", "environments": [STRAIN]})
    assert reply.status == 409 and "/environments/0/task" in reply.body.decode()
    service.act(made["id"], "cancel")


def test_trainings_learn_sums(service):
    """Training runs take objectives with a gradient, and refuse others by name."""
    tune = {"kind": "finetune", "designs": [TALL], "steps": 1, "batch": 2,
            "physics": {"n_steps": 40}, "validation": {"every_steps": 1}}
    job = run(service, "trainings", {**tune, "name": "sums",
                                     "environments": [STAIRS, EFFICIENT, JUMP]})
    assert job["state"] == "succeeded"
    for settings, pointer in (
            ({"environments": [STAIRS, STRAIN]}, "/environments/1/task/objective"),
            ({"kind": "pretrain", "tasks": ["walk", STRAIN["task"]], "designs": None},
             "/tasks/1/objective")):
        value = {k: v for k, v in {**tune, **settings}.items() if v is not None}
        error = service.request("POST", "/v1/trainings", value).json()["errors"][0]
        assert error["pointer"] == pointer, error
        assert error["detail"].startswith("peak_strain has no derivative"), error
        assert "travel" in error["detail"] and "work_j" in error["detail"]


@pytest.mark.parametrize("objective, place, words", [
    ("sum", "", '"jump", got "sum"'),
    ({}, "", "1 to 8 weights, got 0"),
    ({"fly": 1}, "/fly", "neither an objective nor a measure; the terms are reach, approach"),
    ({"sum": 1}, "/sum", "neither an objective nor a measure"),
    ({"sideways_m": 1}, "/sideways_m", "cannot be weighted"),
    ({"cost_of_transport": -1}, "/cost_of_transport", "cannot be weighted"),
    ({"travel": 0}, "/travel", "must not be 0"),
    ({"travel": 1e7}, "/travel", "from -1e+06 to 1e+06"),
    ({"travel": "1"}, "/travel", "number"),
    ({"travel": 1, "follow": 1}, "", "follow needs a guide that is path"),
    ({"travel": 1, "climb": 1, "jump": 1, "work_j": 1, "tilt_rad": 1, "air_share": 1,
      "peak_strain": 1, "hops_per_s": 1, "straightness": 1}, "", "1 to 8 weights, got 9"),
    (1, "", "object"),
])
def test_what_makes_no_sense_is_refused(service, objective, place, words):
    """Each refusal names the place and says what to do."""
    reply = service.request("POST", "/v1/evaluations", {
        "designs": [DESIGN], "environments": [{"task": {"guide": AHEAD, "objective": objective}}]})
    assert reply.status == 422, reply.body
    error = reply.json()["errors"][0]
    below = "" if "needs a guide" in words else "/objective"
    assert error["pointer"] == f"/environments/0/task{below}{place}", error
    assert words in error["detail"], error


def test_a_term_is_given_once(service):
    """A name that is repeated is refused, not added up."""
    text = json.dumps({"designs": [DESIGN], "environments": [
        {"task": {"guide": AHEAD, "objective": {"travel": 1, "climb": 2}}}]})
    reply = service.request("POST", "/v1/evaluations", body=text.replace("climb", "travel"))
    assert reply.status in (400, 422), reply.body


def test_morphoctl_prints_values(service, tmp_path):
    """morphoctl eval shows the value with its unit."""
    worlds = tmp_path / "worlds.json"
    worlds.write_text(json.dumps([EFFICIENT]))
    shown = subprocess.run(
        [MORPHOCTL, "--server", f"http://{service.host}:{service.port}", "eval", "--random", "2",
         "--seed", "7", "--environments", str(worlds), "-p", "n_steps=200"], check=True,
        capture_output=True, text=True).stdout
    assert "m/kJ" in shown
