"""`"tolerance": 0.01`: time step and precision are chosen for each design, from rungs that are
stored like all scores."""

import csv
import json

import pytest

from ctl import ctl  # noqa: F401
from service import DESIGN, await_end, awaited, run

PLACES = [{"light_xy_m": [4.5, 2.5], "terrain_sigma_m": 0.05, "seed": seed} for seed in range(2)]
BODIES = [{"cells": [[x, y, 0] for x in range(width) for y in range(2)] + [[0, 0, z]
           for z in range(1, height)]} for width in (1, 2, 3) for height in (1, 2)]
PHYSICS = {"n_steps": 200, "dt_s": 0.004}  # 0.8 s: most rollouts have not bifurcated yet
REQUEST = {"designs": BODIES, "environments": PLACES, "physics": PHYSICS, "tolerance": 0.002}
LADDER = [(0.004, "float32"), (0.002, "float32"), (0.001, "float64"), (0.0005, "float64"),
          (0.00025, "float64")]
RUNS = 5  # of a rung


def plain(service, rung, **more):
    """The scores of the same designs with the settings of a rung, by an ordinary evaluation."""
    dt_s, precision = LADDER[rung]
    physics = {"dt_s": dt_s, "n_steps": round(0.8 / dt_s)}
    asked = {key: REQUEST[key] for key in ("designs", "environments")}
    return service.evaluate(asked | {"physics": physics, "precision": precision} | more).json()


@pytest.fixture(scope="module", name="climbed")
def climbed_designs(service):
    return service.evaluate(REQUEST).json()


def test_designs_reach_the_tolerance(climbed):
    assert climbed["state"] == "succeeded" and climbed["tolerance"] == 0.002
    assert climbed["physics"]["dt_s"] == 0.004 and climbed["precision"] == "float32"
    rungs = [len(row["tolerance"]["rungs"]) for row in climbed["results"]]
    assert max(rungs) > 1, "a tolerance that the first rung reaches tests nothing"
    assert climbed["rollouts_total"] == len(LADDER) * RUNS * 2 * len(BODIES)
    assert climbed["rollouts_done"] == climbed["rollouts_total"]
    assert climbed["rollouts_cut"] == climbed["rollouts_total"] - RUNS * 2 * sum(rungs)
    for row in climbed["results"]:
        seen = row["tolerance"]
        steps = [(rung["dt_s"], rung["precision"]) for rung in seen["rungs"]]
        assert steps == LADDER[:len(steps)] and seen["asked"] == 0.002
        errors = [rung["estimated_error"] for rung in seen["rungs"]]
        best = min(range(len(errors)), key=errors.__getitem__)
        assert seen["reached"] == (errors[best] <= 0.002)
        assert best == len(errors) - 1 or not seen["reached"]
        assert all(error > 0.002 for error in errors[:-1])
        assert len(errors) == len(LADDER) or seen["reached"]
        assert (seen["dt_s"], seen["precision"]) == LADDER[best]
        assert seen["estimated_error"] == errors[best]
        assert row["score"] == seen["rungs"][best]["score"]
        assert row["error"]["high"] - row["score"] == pytest.approx(errors[best])
        assert row["error"]["rounding"] == seen["rungs"][best]["rounding"]


def test_rungs_are_ordinary_scores(service, climbed):
    """Evaluations with the settings of a rung have the same losses and errors, and find the stored
    rollouts of the designs that have climbed there."""
    for rung in range(len(LADDER)):
        value = plain(service, rung, error=True)
        there = [place for place, row in enumerate(climbed["results"])
                 if len(row["tolerance"]["rungs"]) > rung]
        assert value["rollouts_cached"] >= RUNS * 2 * len(there)
        for place in there:
            row, known = value["results"][place], climbed["results"][place]
            seen = known["tolerance"]["rungs"][rung]
            assert row["score"] == seen["score"]
            assert row["error"]["high"] - row["score"] == pytest.approx(seen["estimated_error"])
            assert row["error"]["discretization"] == seen["discretization"]
            if LADDER[rung][0] == known["tolerance"]["dt_s"]:
                assert row["losses"] == known["losses"] and row["error"] == known["error"]


def test_stored_rungs_are_reused(service, climbed):
    again = service.evaluate(REQUEST | {"label": "again"}).json()
    assert again["results"] == climbed["results"]
    assert again["rollouts_cached"] + again["rollouts_cut"] == again["rollouts_total"]
    finer = service.evaluate(REQUEST | {"tolerance": 0.0005}).json()
    rungs = [len(row["tolerance"]["rungs"]) for row in climbed["results"]]
    assert finer["rollouts_cached"] >= RUNS * 2 * sum(rungs)
    for row, known in zip(finer["results"], climbed["results"]):
        n = len(known["tolerance"]["rungs"])
        assert row["tolerance"]["rungs"][:n] == known["tolerance"]["rungs"]
    assert service.get(f"/v1/evaluations/{climbed['id']}")["results"] == climbed["results"]


def test_errors_against_fine_steps(service, climbed):
    """The scores of the reached designs, compared with float64 and steps of 1/16 ms."""
    fine = service.evaluate({key: REQUEST[key] for key in ("designs", "environments")} | {
        "physics": {"dt_s": 0.0000625, "n_steps": 12800}, "precision": "float64"}).json()
    pairs = [(abs(row["score"] - best["score"]), row["tolerance"])
             for row, best in zip(climbed["results"], fine["results"])]
    reached = [off for off, seen in pairs if seen["reached"]]
    assert len(reached) >= len(BODIES) - 1
    assert sum(off <= 0.002 for off in reached) >= len(reached) - 1
    first = [abs(row["tolerance"]["rungs"][0]["score"] - best["score"])
             for row, best in zip(climbed["results"], fine["results"])]
    assert max(reached) < max(first)


def test_a_loose_tolerance_needs_one_rung(service):
    value = service.evaluate(REQUEST | {"tolerance": 1.0}).json()
    assert value["rollouts_cut"] == value["rollouts_total"] * 4 // 5
    for row in value["results"]:
        assert row["tolerance"]["reached"] and len(row["tolerance"]["rungs"]) == 1
        assert row["tolerance"]["dt_s"] == 0.004


def test_a_tolerance_below_rounding(service):
    """Displaced starts change every rung by more: the best rung is given, and marked."""
    value = service.evaluate(REQUEST | {"designs": BODIES[3:], "tolerance": 1e-5,
                                        "physics": {"n_steps": 2000, "dt_s": 0.004}}).json()
    seen = [row["tolerance"] for row in value["results"]]
    missed = [one for one in seen if not one["reached"]]
    assert missed and all(len(one["rungs"]) == len(LADDER) for one in missed)
    for one in missed:
        errors = [rung["estimated_error"] for rung in one["rungs"]]
        assert one["estimated_error"] == min(errors) > 1e-5
        rounding = all(rung["rounding"] > 1e-5 for rung in one["rungs"])
        assert one["bifurcates"] == (rounding or errors[4] > errors[2] / 2)
    assert any(one["bifurcates"] for one in missed)
    assert not any(one["bifurcates"] for one in seen if one["reached"])


def test_float64_from_the_start(service):
    value = service.evaluate(REQUEST | {"precision": "float64", "tolerance": 1e-5}).json()
    for row in value["results"]:
        assert {rung["precision"] for rung in row["tolerance"]["rungs"]} == {"float64"}


def test_diverging_rungs_are_passed(service):
    """A step that blows up is no estimate; a smaller one is. A skipped design has no rungs."""
    value = service.evaluate({
        "designs": [{"cells": [[9, 0, 0]]}, DESIGN], "environments": PLACES, "on_fault": "skip",
        "physics": {"integrator": "paper", "dt_s": 0.02, "n_steps": 50, "control_period_s": 0.02},
        "tolerance": 0.5}).json()
    skipped, other = (row["tolerance"] for row in value["results"])
    assert skipped == {"asked": 0.5, "reached": False, "estimated_error": None,
                       "bifurcates": False, "dt_s": None, "precision": None, "rungs": []}
    assert other["rungs"][0]["score"] is None and other["rungs"][0]["estimated_error"] is None
    assert other["reached"] and other["dt_s"] < 0.02
    assert value["results"][1]["score"] is not None and value["results"][1]["diverged"] == []
    assert [one["code"] for one in value["warnings"]].count("diverged") == 1
    assert any("a rung with a diverged rollout" in one["detail"] for one in value["warnings"])


@pytest.mark.parametrize("more, words", [
    ({"tolerance": 0}, "1e-05"), ({"tolerance": -1}, "1e-05"), ({"tolerance": 1e-6}, "1e-05"),
    ({"tolerance": "fine"}, "number"), ({"verify": True}, "verify"),
    ({"record": ["com"]}, "record"), ({"best": 1}, "best"), ({"device": "cuda"}, 'request "cpu"'),
    ({"physics": {"n_steps": 40000}}, "fewer steps"),
    ({"physics": {"drop_height_m": 1.5}}, '"precision": "float64"'),
    ({"designs": BODIES * 1100, "environments": PLACES * 32}, "fewer designs")
])
def test_refusals(service, more, words):
    reply = service.request("POST", "/v1/evaluations", REQUEST | more)
    assert reply.status == 422 and reply.pointers() == ["/tolerance"], reply.json()
    assert words in reply.json()["errors"][0]["detail"]


def test_work_counts(start):
    """A request counts by the cost of all its rungs: 6 × 31 rollouts with the requested step."""
    limited = start("--max-open-rollouts=1000")
    held = limited.post("/v1/evaluations", {"designs": [DESIGN], "environments": PLACES[:1],
                                            "physics": {"n_steps": 1000000}})["id"]
    request = {"designs": BODIES, "environments": PLACES[:1], "physics": {"n_steps": 20000},
               "tolerance": 0.01}
    assert limited.request("POST", "/v1/evaluations", request).status == 503
    some = request | {"designs": BODIES[:5]}
    assert limited.request("POST", "/v1/evaluations", some).status == 202
    one = request | {"designs": BODIES[:1]}
    assert limited.request("POST", "/v1/evaluations", one).status == 503
    limited.act(held, "cancel")


def test_climbs_survive_a_restart(start, tmp_path):
    """Stored rungs are not recomputed, and the results are the same."""
    request = REQUEST | {"designs": BODIES[3:], "priority": "batch",
                         "physics": {"n_steps": 2500, "dt_s": 0.004}}
    first = start(state=tmp_path)
    id = first.post("/v1/evaluations", request)["id"]
    path = f"/v1/evaluations/{id}"
    awaited(first, path, lambda seen: seen["rollouts_done"] > RUNS * 2 * 3)
    assert first.stop() == 0, first.log_text()
    second = start(state=tmp_path)
    left = second.get(path)
    assert left["rollouts_done"] < left["rollouts_total"] and left["tolerance"] == 0.002
    value = await_end(second, path).json()
    assert value["state"] == "succeeded" and value["rollouts_done"] == value["rollouts_total"]
    other = run(start(), "evaluations", request)
    assert value["results"] == other["results"]
    assert value["rollouts_cut"] == other["rollouts_cut"]
    assert second.get(f"{path}/results?limit=4")["items"][2] == {"number": 2} | value["results"][2]


def test_columns(service, climbed):
    reply = service.request("GET", f"/v1/evaluations/{climbed['id']}/results?format=csv")
    head, first = reply.body.decode().splitlines()[:2]
    row, seen = dict(zip(head.split(","), next(csv.reader([first])))), climbed["results"][0]
    assert float(row["tolerance_estimated_error"]) == seen["tolerance"]["estimated_error"]
    assert float(row["tolerance_dt_s"]) == seen["tolerance"]["dt_s"]
    assert row["tolerance_precision"] == seen["tolerance"]["precision"]
    assert json.loads(row["tolerance_rungs"]) == seen["tolerance"]["rungs"]


def test_verify_takes_no_tolerance(ctl, climbed):  # noqa: F811
    """Its scores have other settings than the evaluation."""
    status, _, err = ctl(f"verify --evaluation {climbed['id']}")
    assert status != 0 and "has a tolerance" in err


def test_morphoctl(service, ctl, tmp_path):  # noqa: F811
    file = tmp_path / "designs.json"
    file.write_text(json.dumps(BODIES[:2]))
    status, out, err = ctl(f"eval {file} --tolerance 0.05 --physics n_steps=100")
    assert status == 0, err
    head, first, _ = out.splitlines()[:3]
    assert "tolerance" in head and "step" in head and "reached" in first and "float32" in first
    assert "not needed" in err
    assert ctl(f"eval {file} --tolerance 0")[0] != 0
    assert ctl(f"eval {file} --tolerance 0.05 --record com")[0] != 0
