"""`"error": true`: the estimated errors of scores, from additional rollouts that are stored."""

import csv
import json
import math

import pytest

from ctl import ctl  # noqa: F401
from service import DESIGN, await_end, awaited, run

PLACES = [{"light_xy_m": [4.5, 2.5], "terrain_sigma_m": 0.05, "seed": seed} for seed in range(3)]
BODIES = [{"cells": [[x, y, 0], [x, y, 1], [x + 1, y, 0]]} for x in range(3) for y in range(2)]
PAPER = {"integrator": "paper", "dt_s": 0.004, "control_period_s": 0.004, "n_steps": 200}
REQUEST = {"designs": BODIES, "environments": PLACES, "physics": PAPER, "error": True}
RUNS = 5  # as requested, with half of the step, three displaced starts
MEMBERS = ("low", "high", "discretization", "rounding", "standard_error")


def mean_losses(service, **physics):
    """Scores under other settings, without errors."""
    asked = {key: REQUEST[key] for key in ("designs", "environments")}
    value = service.evaluate(asked | {"physics": PAPER | physics}).json()
    return [row["score"] for row in value["results"]]


@pytest.fixture(scope="module", name="estimated")
def estimated_scores(service):
    return service.evaluate(REQUEST).json()


def test_errors_are_those_of_the_rollouts(service, estimated):
    """The rollouts are ordinary ones: evaluations under their settings have the same losses, and
    find them in the store."""
    assert estimated["state"] == "succeeded" and estimated["displaced_starts"] == 3
    assert estimated["rollouts_total"] == RUNS * 3 * len(BODIES) == estimated["rollouts_done"]
    finer = mean_losses(service, dt_s=0.002, n_steps=400)
    displaced = [mean_losses(service, drop_height_m=1e-7 * place) for place in (1, 2, 3)]
    for place, row in enumerate(estimated["results"]):
        error = row["error"]
        assert error["discretization"] == pytest.approx(2 * abs(row["score"] - finer[place]))
        assert error["rounding"] == pytest.approx(
            max(abs(row["score"] - scores[place]) for scores in displaced))
        off = sum((loss - row["score"])**2 for loss in row["losses"])
        assert error["standard_error"] == pytest.approx(math.sqrt(off / 2 / 3))
        assert error["low"] <= row["score"] <= error["high"]
        assert all(0 <= place < 3 for place in error["bifurcates"])
    last = service.evaluate(REQUEST | {"label": "again"}).json()
    assert last["results"] == estimated["results"]
    assert last["rollouts_cached"] == last["rollouts_total"]


def test_scores_do_not_change(service, estimated):
    """Without `error` the losses are the same, and the reply has no errors."""
    plain = service.evaluate(REQUEST | {"error": False}).json()
    assert "displaced_starts" not in plain and plain["rollouts_total"] == 3 * len(BODIES)
    assert plain["rollouts_cached"] == plain["rollouts_total"]
    for row, known in zip(plain["results"], estimated["results"]):
        assert row == {key: value for key, value in known.items() if key != "error"}


def test_intervals_contain_scores_of_finer_steps(service, estimated):
    """The finer scores use an eighth of the step, in float64."""
    value = service.evaluate({key: REQUEST[key] for key in ("designs", "environments")} | {
        "physics": PAPER | {"n_steps": 1600, "dt_s": 0.0005},
        "precision": "float64"}).json()
    within = [row["error"]["low"] <= fine["score"] <= row["error"]["high"]
              for row, fine in zip(estimated["results"], value["results"])]
    assert sum(within) >= len(within) - 1


def test_split(service):
    """The factor depends on the integrator's order. The control period is kept."""
    physics = {"n_steps": 100, "dt_s": 0.004, "integrator": "split", "control_period_s": 0.008}
    request = {"designs": [DESIGN], "environments": PLACES[:1], "physics": physics}
    row = service.evaluate(request | {"error": True}).json()["results"][0]
    request["physics"] = physics | {"n_steps": 200, "dt_s": 0.002}
    finer = service.evaluate(request).json()["results"][0]
    assert row["error"]["discretization"] == pytest.approx(
        4 / 3 * abs(row["score"] - finer["score"]))
    assert row["error"]["standard_error"] is None


def test_unknown_errors(service):
    """A design without a body has no error, nor has one with a diverged rollout."""
    value = service.evaluate({
        "designs": [{"cells": [[9, 0, 0]]}, DESIGN], "environments": PLACES[:2], "error": True,
        "on_fault": "skip", "physics": PAPER | {"dt_s": 0.1, "control_period_s": 0.1}
    }).json()
    assert value["rollouts_total"] == RUNS * 2
    for row in value["results"]:
        assert row["error"] == dict.fromkeys(MEMBERS) | {"bifurcates": []}


@pytest.mark.parametrize("more, words", [
    ({"verify": True}, "verify"), ({"record": ["com"]}, "record"), ({"best": 1}, "best"),
    ({"device": "cuda"}, "is supported only on CPUs"),
    ({"physics": {"n_steps": 600000}}, "n_steps must be"),
    ({"physics": {"drop_height_m": 1.5}}, '"precision": "float64"'), ({"error": 1}, "true or false")
])
def test_refusals(service, more, words):
    reply = service.request("POST", "/v1/evaluations", REQUEST | more)
    assert reply.status == 422 and reply.pointers() == ["/error"], reply.json()
    assert words in reply.json()["errors"][0]["detail"]


def test_high_worlds_need_float64(service):
    """Float32 cannot displace a start by 1e-7 m there."""
    high = [{"light_xy_m": [4.5, 2.5], "terrain_heights_m": [5] * 64}]
    request = {"designs": [DESIGN], "environments": high, "physics": {"n_steps": 50},
               "error": True}
    reply = service.request("POST", "/v1/evaluations", request)
    assert reply.status == 422 and reply.pointers() == ["/error"], reply.json()
    assert "float64" in reply.json()["errors"][0]["detail"]
    row = service.evaluate(request | {"precision": "float64"}).json()["results"][0]
    assert row["error"]["rounding"] > 0


def test_columns(service, estimated):
    """A table of results has the errors, too."""
    reply = service.request("GET", f"/v1/evaluations/{estimated['id']}/results?format=csv")
    head, first = reply.body.decode().splitlines()[:2]
    row = dict(zip(head.split(","), next(csv.reader([first]))))
    assert float(row["error_low"]) == pytest.approx(estimated["results"][0]["error"]["low"])
    assert float(row["error_high"]) == pytest.approx(estimated["results"][0]["error"]["high"])


def test_work_counts(start):
    """A request counts by its cost: each rollout as six rollouts with the requested step."""
    limited = start("--max-open-rollouts=1000")
    places = [PLACES[0] | {"seed": seed} for seed in range(30)]
    held = limited.post("/v1/evaluations", {"designs": [DESIGN], "environments": places[:1],
                                            "physics": {"n_steps": 1000000}})["id"]
    request = {"designs": BODIES, "environments": places, "physics": {"n_steps": 20000}}
    assert limited.request("POST", "/v1/evaluations", request | {"error": True}).status == 503
    assert limited.request("POST", "/v1/evaluations", request).status == 202
    some = request | {"designs": BODIES[:4], "error": True}
    assert limited.request("POST", "/v1/evaluations", some).status == 202
    assert limited.request("POST", "/v1/evaluations", some).status == 503
    limited.act(held, "cancel")


def test_errors_survive_a_restart(start, tmp_path):
    """Stored rollouts are not recomputed, and the estimates have the same bits."""
    request = REQUEST | {"physics": {"n_steps": 4000}, "priority": "batch"}
    first = start(state=tmp_path)
    id = first.post("/v1/evaluations", request)["id"]
    path = f"/v1/evaluations/{id}"
    awaited(first, path, lambda seen: seen["rollouts_done"] > 0)
    assert first.stop() == 0, first.log_text()
    second = start(state=tmp_path)
    value = await_end(second, path).json()
    assert value["state"] == "succeeded" and value["rollouts_done"] == value["rollouts_total"]
    other = run(start(), "evaluations", request)
    assert value["results"] == other["results"]
    assert second.get(f"{path}/results?limit=4")["items"][3] == {"number": 3} | value["results"][3]


def test_morphoctl(service, ctl, tmp_path):  # noqa: F811
    file = tmp_path / "designs.json"
    file.write_text(json.dumps(BODIES[:2]))
    status, out, err = ctl(f"eval {file} --error --physics n_steps=100")
    assert status == 0, err
    head, first, _ = out.splitlines()[:3]
    assert "limit" in head and "bifurcates" in head and " to " in first and " of 10" in first
    assert ctl(f"eval {file} --error --record com")[0] != 0
    assert "limit" not in ctl(f"eval {file} --physics n_steps=100")[1]
