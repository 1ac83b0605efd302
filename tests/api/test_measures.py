"""`"measures"`: numbers that describe the rollouts of an evaluation besides their losses."""

import csv
import json
import math
import signal

import numpy as np
import pytest

from ctl import ctl  # noqa: F401
from service import DESIGN, await_end, awaited, run

NAMES = [
    "displacement_m", "path_length_m", "mean_speed_m_per_s", "straightness", "heading_error_rad",
    "sideways_m", "peak_height_m", "mean_height_m", "tilt_rad", "yaw_rate_rad_per_s", "air_share",
    "contact_front_share", "contact_back_share", "contact_left_share", "contact_right_share",
    "hops_per_s", "work_j", "cost_of_transport", "peak_strain", "inverted_voxels",
]
PLACES = [{"light_xy_m": [4.5, 2.5], "terrain_heights_m": [[0] * 8] * 8},
          {"light_xy_m": [1, 3], "terrain_sigma_m": 0.05, "seed": 1},
          {"light_xy_m": [2.5, 4], "terrain_sigma_m": 0.05, "seed": 2}]
BODIES = [{"cells": [[x, 0, 0] for x in range(long)] + [[0, y, 0] for y in range(1, wide)] +
           [[0, 0, 1]]} for long in (1, 2, 3) for wide in (2, 4)]
REQUEST = {"designs": BODIES, "environments": PLACES, "physics": {"n_steps": 400}}
PERIOD = 8  # steps: the outputs of the default controller are held so long
T_S = 400 * 0.002


@pytest.fixture(scope="module", name="plain")
def plain_scores(service):
    """The same scores without measures, which are stored first."""
    return run(service, "evaluations", REQUEST)


@pytest.fixture(scope="module", name="measured")
def measured_scores(service, plain):
    assert plain["state"] == "succeeded"
    return run(service, "evaluations", REQUEST | {"measures": True})


def losses(row):
    return [entry["loss"] for entry in row["losses"]]


def test_without_then_with(service, plain, measured):
    """Losses that are stored without measures are computed again, with the same bits, and are
    stored once; then everything is found."""
    total = len(BODIES) * len(PLACES)
    assert measured["measures"] == NAMES and measured["rollouts_total"] == total
    assert measured["rollouts_cached"] == 0 and measured["rollouts_done"] == total
    for row, known in zip(measured["results"], plain["results"]):
        assert losses(row) == known["losses"] and row["score"] == known["score"]
        for entry in row["losses"]:
            assert list(entry["measures"]) == NAMES and entry["unit"] == ""
            assert entry["value"] == pytest.approx(1 - entry["loss"])
        for name, mean in row["measures"].items():
            values = [entry["measures"][name] for entry in row["losses"]]
            assert mean == (None if None in values else pytest.approx(sum(values) / len(values)))
    again = run(service, "evaluations", REQUEST | {"measures": True, "label": "again"})
    assert again["rollouts_cached"] == total and again["results"] == measured["results"]
    # Any others are found, too: all measures are stored, whichever were requested.
    some = run(service, "evaluations", REQUEST | {"measures": ["work_j", "air_share"]})
    assert some["rollouts_cached"] == total and some["measures"] == ["air_share", "work_j"]
    for row, known in zip(some["results"], measured["results"]):
        assert row["flags"] == known["flags"]
        for entry, whole in zip(row["losses"], known["losses"]):
            assert entry["measures"] == {name: whole["measures"][name]
                                         for name in ("air_share", "work_j")}
    # Requests without measures are answered as before.
    for more in ({}, {"measures": False}):
        after = service.evaluate(REQUEST | {"label": "after"} | more).json()
        assert after["results"] == plain["results"] and "measures" not in after
        assert after["rollouts_cached"] == total


def test_values_are_those_of_the_motion(service, measured):
    """The recorded centers of mass and contacts have the same motion."""
    recorded = run(service, "evaluations", REQUEST | {
        "record": ["com", "contacts"], "record_stride": PERIOD, "measures": NAMES})
    assert [row["losses"] for row in recorded["results"]] == [
        row["losses"] for row in measured["results"]]
    for design in range(len(BODIES)):
        for k, place in enumerate(PLACES):
            got = recorded["results"][design]["losses"][k]["measures"]
            path = f"/v1/evaluations/{recorded['id']}/trajectories/{design}"
            com = np.array(service.get(f"{path}?environment={k}")["com_m"])
            way = com[-1, :2] - com[0, :2]
            ahead = np.array(place["light_xy_m"]) - com[0, :2]
            length = np.hypot(*np.diff(com[:, :2], axis=0).T).sum()
            assert got["displacement_m"] == pytest.approx(np.hypot(*way), abs=2e-6)
            assert got["path_length_m"] == pytest.approx(length, abs=2e-6)
            assert got["mean_speed_m_per_s"] == pytest.approx(length / T_S, abs=3e-6)
            assert got["straightness"] == pytest.approx(np.hypot(*way) / length, abs=1e-4)
            across = ahead[0] * way[1] - ahead[1] * way[0]
            assert got["sideways_m"] == pytest.approx(across / np.hypot(*ahead), abs=2e-6)
            if np.hypot(*way) > 0.011:
                assert got["heading_error_rad"] == pytest.approx(
                    math.atan2(abs(across), ahead @ way), abs=1e-3)
            if k == 0:  # flat ground
                assert got["mean_height_m"] == pytest.approx(com[1:, 2].mean(), abs=2e-6)
                assert got["peak_height_m"] == pytest.approx(com[:, 2].max(), abs=2e-6)
            sides = [got[f"contact_{side}_share"] for side in ("front", "back", "left", "right")]
            assert sides[0] + sides[1] == pytest.approx(sides[2] + sides[3], abs=5e-6)
            assert 0 <= got["air_share"] <= 1 and got["work_j"] > 0 and got["peak_strain"] > 0


def test_float64_and_paper(service, measured):
    """float64 has measures of its own, close to those of float32; so has every other physics."""
    fine = run(service, "evaluations", REQUEST | {"precision": "float64", "measures": True})
    close = [abs(one["measures"]["displacement_m"] - other["measures"]["displacement_m"]) < 1e-3
             for row, known in zip(fine["results"], measured["results"])
             for one, other in zip(row["losses"], known["losses"])]
    assert fine["rollouts_cached"] == 0 and np.mean(close) > 0.7
    paper = run(service, "evaluations", REQUEST | {
        "physics": "paper", "designs": [DESIGN], "measures": ["work_j"]})
    assert paper["results"][0]["measures"]["work_j"] > 0


def test_tasks_have_measures(service):
    request = REQUEST | {"environments": [{"task": "walk"}], "measures": ["displacement_m"]}
    row = service.evaluate(request).json()["results"][0]
    assert row["unit"] == "m" and row["losses"][0]["unit"] == "m"
    assert row["losses"][0]["value"] <= row["measures"]["displacement_m"] + 1e-6


def test_errors_and_races(service, measured):
    """The additional rollouts of `error` have no measures; a race measures what it computes."""
    estimated = run(service, "evaluations", REQUEST | {"measures": True, "error": True})
    assert estimated["rollouts_cached"] == len(BODIES) * len(PLACES)
    assert [row["measures"] for row in estimated["results"]] == [
        row["measures"] for row in measured["results"]]
    assert all("error" in row for row in estimated["results"])
    places = [PLACES[1] | {"seed": seed} for seed in range(20, 40)]
    raced = run(service, "evaluations", {
        "random": {"count": 40, "seed": 4}, "environments": places, "best": 1,
        "physics": {"n_steps": 1000}, "measures": ["work_j"]})
    assert raced["rollouts_cut"] > 0
    for row in raced["results"]:
        assert (row["measures"]["work_j"] is None) == row["lower_bound"]
        for entry in row["losses"]:
            assert (entry["loss"] is None) == (entry["measures"]["work_j"] is None)


def test_without_a_value(service):
    """Skipped designs and diverged rollouts have no measures, and no flags."""
    value = service.evaluate({
        "designs": [{"cells": [[9, 0, 0]]}, DESIGN], "environments": PLACES[:2], "measures": True,
        "on_fault": "skip", "physics": {
            "integrator": "paper", "dt_s": 0.1, "control_period_s": 0.1, "n_steps": 200}
    }).json()
    for row in value["results"]:
        assert row["measures"] == dict.fromkeys(NAMES) and row["flags"] == []
        assert all(entry["measures"] == dict.fromkeys(NAMES) and entry["flags"] == []
                   for entry in row["losses"])


def test_flags(service):
    """Springs far softer than usual stretch to more than three times their length: the score
    stands, and is marked."""
    value = run(service, "evaluations", {
        "random": {"count": 40, "seed": 2}, "environments": PLACES,
        "physics": {"n_steps": 400, "stiffness_n_per_m": 100.0}, "measures": ["peak_strain"]})
    marked = 0
    for row in value["results"]:
        for entry in row["losses"]:
            strain = entry["measures"]["peak_strain"]
            assert ("overstrained" in entry["flags"]) == (strain is not None and strain > 2)
            marked += len(entry["flags"]) > 0 and entry["loss"] is not None
        assert set(row["flags"]) == {flag for entry in row["losses"] for flag in entry["flags"]}
    assert marked > 0


@pytest.mark.parametrize("more, pointer, words", [
    ({"measures": ["speed"]}, "/measures/0", "\"displacement_m\", \"path_length_m\""),
    ({"measures": ["speed"]}, "/measures/0", "\"peak_strain\" or \"inverted_voxels\""),
    ({"measures": ["work_j", "work_j"]}, "/measures/1", "duplicate"),
    ({"measures": []}, "/measures", "at least one"),
    ({"measures": "all"}, "/measures", "must be true, for all measures, or an array of names"),
    ({"measures": None}, "/measures", "must be true"),
    ({"measures": True, "verify": True}, "/measures", "cannot be combined with verify")])
def test_refusals(service, more, pointer, words):
    reply = service.request("POST", "/v1/evaluations", REQUEST | more)
    assert reply.status == 422 and reply.pointers() == [pointer], reply.json()
    assert words in reply.json()["errors"][0]["detail"]


def test_only_evaluations_have_measures(service):
    reply = service.request("POST", "/v1/rollouts", REQUEST | {"measures": True})
    assert reply.status == 422 and "/measures" in reply.pointers()


def test_long_results_come_in_pages(service):
    """More than 2,000,000 measured numbers are not in one reply."""
    places = [PLACES[1] | {"seed": seed} for seed in range(64)]
    value = service.post("/v1/evaluations", {
        "random": {"count": 1600, "seed": 1}, "environments": places, "measures": True,
        "physics": {"n_steps": 8}})
    value = await_end(service, f"/v1/evaluations/{value['id']}").json()
    assert value["state"] == "succeeded" and "results" not in value
    page = service.get(f"/v1/evaluations/{value['id']}/results?limit=3&whole=true")
    assert [row["number"] for row in page["items"]] == [0, 1, 2]
    assert list(page["items"][2]["losses"][63]["measures"]) == NAMES


@pytest.mark.parametrize("number, status", [(signal.SIGTERM, 0), (signal.SIGKILL, -9)])
def test_measures_survive_a_restart(start, tmp_path, number, status):
    """Stored rollouts are not computed again; the results have the same bits with any number of
    threads."""
    request = REQUEST | {"physics": {"n_steps": 20000}, "priority": "batch", "measures": True}
    first = start("--workers=1", state=tmp_path)
    path = f"/v1/evaluations/{first.post('/v1/evaluations', request)['id']}"
    awaited(first, path, lambda seen: seen["rollouts_done"] > 0)
    assert first.stop(number) == status, first.log_text()
    second = start(state=tmp_path)
    value = await_end(second, path).json()
    assert value["state"] == "succeeded" and value["rollouts_done"] == value["rollouts_total"]
    other = run(start("--workers=3"), "evaluations", request)
    assert value["results"] == other["results"]
    page = second.get(f"{path}/results?limit=4")["items"]
    assert page[3] == {"number": 3} | value["results"][3]


def test_morphoctl(service, ctl, tmp_path):  # noqa: F811
    file, table = tmp_path / "designs.json", tmp_path / "results.csv"
    file.write_text(json.dumps(BODIES[:2]))
    status, out, err = ctl(f"eval {file} --measures work_j,air_share --physics n_steps=100")
    assert status == 0, err
    head = out.splitlines()[0]
    assert "air_share" in head and "work_j" in head and "flags" in head
    newest = service.get("/v1/evaluations?limit=1")["items"][0]
    assert newest["measures"] == ["air_share", "work_j"]
    status, out, err = ctl(f"job show {newest['id']}")
    assert status == 0 and "air_share, work_j" in out, err
    status, out, err = ctl(f"export evaluations/{newest['id']}/results -o {table}")
    assert status == 0, err
    rows = list(csv.DictReader(table.open(encoding="utf-8")))
    shown = service.get(f"/v1/evaluations/{newest['id']}")["results"]
    assert [float(row["measures_work_j"]) for row in rows] == [
        row["measures"]["work_j"] for row in shown]
    status, out, _ = ctl(f"eval {file} --measures all --physics n_steps=100")
    assert status == 0 and "cost_of_transport" in out
    status, _, err = ctl(f"eval {file} --measures speed")
    assert status != 0 and "inverted_voxels" in err
    assert "work_j" not in ctl(f"eval {file} --physics n_steps=100")[1]
