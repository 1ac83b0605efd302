"""The suite morpho-12 as one evaluation: its table, its picture, and what happens to it."""

import json
import math
import re
import signal
import subprocess
import time
import urllib.request
import xml.etree.ElementTree

import pytest

from ctl import MORPHOCTL
from service import DESIGN, PATIENCE_S

TASKS = ("photo", "photo-auc", "walk", "rough", "up", "down", "hurdle", "gap", "circle", "shuttle",
         "path", "damage")
METERS = set(TASKS) - {"photo", "photo-auc", "damage"}
PHYSICS = {"n_steps": 100}
SHORT = {"random": {"seed": 7, "count": 3}, "environments": "morpho-12", "physics": PHYSICS}
UNSTABLE = {"dt_s": 0.02, "n_steps": 200, "control_period_s": 0.02, "integrator": "paper"}
SVG = "{http://www.w3.org/2000/svg}"


def done(service, id):
    deadline = time.monotonic() + PATIENCE_S
    while (job := service.get(f"/v1/evaluations/{id}"))["state"] not in ("succeeded", "failed"):
        assert time.monotonic() < deadline, job
        time.sleep(0.05)
    assert job["state"] == "succeeded", job
    return job


def run(service, request):
    return done(service, service.post("/v1/evaluations", request)["id"])


def suite(service, *arguments, **how):
    return subprocess.run([str(MORPHOCTL), "--server", f"http://{service.host}:{service.port}",
                           "suite", *map(str, arguments)], capture_output=True, text=True,
                          **{"check": True, **how})


def test_one_evaluation_scores_all_tasks(start):
    """It has the losses of twelve evaluations, grouped by task, with the means; it is one job, and
    each design is ranked in the sets of the tasks."""
    service = start()
    whole_rollouts = {**SHORT, "physics": {}}  # rankings have the default physics
    job = run(service, whole_rollouts)
    assert job["environments"] == "morpho-12" and job["rollouts_total"] == 3 * 120
    assert [task["task"] for task in job["suite"]["tasks"]] == list(TASKS)
    worlds = service.get(f"/v1/evaluations/{job['id']}/environments")["items"]
    for t, (name, summary) in enumerate(zip(TASKS, job["suite"]["tasks"])):
        set_name = f"morpho-12-{name}"
        assert summary["environments"] == set_name
        assert worlds[10 * t:10 * t + 10] == service.get(
            f"/v1/environment-sets/{set_name}")["items"]
        alone = run(service, {**whole_rollouts, "environments": set_name})
        assert alone["rollouts_cached"] == 30
        ranked = service.pages(f"/v1/designs?sort=score&environments={set_name}")
        for whole, one in zip(job["results"], alone["results"]):
            task = whole["tasks"][name]
            losses = whole["losses"][10 * t:10 * t + 10]
            assert [loss["loss"] for loss in losses] == [
                loss if isinstance(loss, float) else loss["loss"] for loss in one["losses"]]
            assert task["loss"] == pytest.approx(one["score"], rel=1e-12)
            assert task["value"] == pytest.approx(one.get("value", 1 - one["score"]), rel=1e-12)
            assert task["unit"] == ("m" if name in METERS else "") and task["diverged"] == 0
            assert one["robot"] in [row["robot"] for row in ranked]
        mean = sum(result["tasks"][name]["value"] for result in job["results"]) / 3
        assert summary["mean_value"] == pytest.approx(mean) and summary["left_out"] == 0
    for result in job["results"]:
        mean = sum(task["loss"] for task in result["tasks"].values()) / 12
        assert result["tasks_mean"] == {"loss": pytest.approx(mean), "left_out": []}
        assert result["score"] == pytest.approx(mean)
    listed = [one["id"] for one in service.get("/v1/jobs?limit=13")["items"]]
    assert listed.count(job["id"]) == 1
    rows = service.table(f"/v1/evaluations/{job['id']}/results?format=csv")
    assert [float(row["tasks_photo-auc_value"]) for row in rows] == [
        result["tasks"]["photo-auc"]["value"] for result in job["results"]]
    pages = service.get(f"/v1/evaluations/{job['id']}/results?limit=2")["items"]
    assert [row["tasks"] for row in pages] == [row["tasks"] for row in job["results"][:2]]


def test_held_out_worlds_and_orientations(service):
    """There are 64 held-out worlds of each task. An id without an orientation is the one with the
    best mean over the whole suite."""
    request = {**SHORT, "environments": "morpho-12-held-out", "physics": {"n_steps": 20}}
    job = run(service, request)
    assert job["rollouts_total"] == 3 * 768 and len(job["results"][0]["losses"]) == 768
    id, _ = job["results"][0]["robot"].split("@")
    del request["random"]
    turned = run(service, {**request, "designs": [{"id": f"{id}@{k}"} for k in range(8)]})
    best = min(turned["results"], key=lambda result: (result["score"], result["robot"]))
    again = run(service, {**request, "designs": [{"id": id}]})
    assert again["results"][0]["robot"] == best["robot"]
    assert again["results"][0]["orientation"] == "best" and again["rollouts_cached"] == 768


def test_what_a_mean_leaves_out(service):
    """A task in which a rollout diverged has no loss; a skipped design has none at all."""
    job = run(service, {"designs": [{"cells": [[0, 0, 0], [3, 3, 3]]}, DESIGN],
                        "environments": "morpho-12", "on_fault": "skip", "physics": UNSTABLE})
    skipped, diverged = job["results"]
    assert skipped["robot"] is None and skipped["tasks"]["walk"]["diverged"] == 0
    for result in (skipped, diverged):
        assert result["tasks_mean"] == {"loss": None, "left_out": list(TASKS)}
        assert result["tasks"]["walk"]["value"] is None
    assert diverged["tasks"]["walk"]["diverged"] == 10
    assert job["suite"]["tasks"][2]["left_out"] == 2
    picture = service.request("GET", f"/v1/evaluations/{job['id']}/picture.svg?designs=0,1")
    words = [text.text for text in
             xml.etree.ElementTree.fromstring(picture.body).iter(f"{SVG}text")]
    assert words.count("no score") == 2 and "0: skipped" in words
    job = run(service, {"designs": [{"cells": [[0, 0, 0], [3, 3, 3]]}, DESIGN],
                        "environments": "morpho-12", "on_fault": "skip", "physics": PHYSICS})
    walk = job["suite"]["tasks"][2]
    assert walk["left_out"] == 1
    assert walk["mean_value"] == job["results"][1]["tasks"]["walk"]["value"]


def test_measures_in_the_suite(service):
    """Measures are those of the evaluations in single sets."""
    request = {"designs": [DESIGN], "measures": ["displacement_m"], "physics": PHYSICS}
    whole = run(service, {**request, "environments": "morpho-12"})["results"][0]
    alone = run(service, {**request, "environments": "morpho-12-damage"})["results"][0]
    assert whole["losses"][-10:] == alone["losses"] and len(whole["losses"]) == 120
    mean = sum(loss["measures"]["displacement_m"] for loss in whole["losses"]) / 120
    assert whole["measures"]["displacement_m"] == pytest.approx(mean)


def test_refusals(service):
    """What works on one set, or computes elsewhere, refuses a suite and names a set."""
    for name, value in (("best", 1), ("record", ["com"]), ("verify", True), ("error", True),
                        ("tolerance", 0.01)):
        reply = service.request("POST", "/v1/evaluations", {
            "designs": [DESIGN], "environments": "morpho-12", name: value})
        error, = reply.json()["errors"]
        assert reply.status == 422 and error["pointer"] == f"/{name}"
        assert "morpho-12-walk" in error["detail"]
    tuned = {"kind": "finetune", "name": "f", "designs": [DESIGN]}
    for path, request in (("/v1/campaigns", {"mode": "zero-shot", "preset": "demo"}),
                          ("/v1/rollouts", {"designs": [DESIGN]}), ("/v1/trainings", tuned)):
        reply = service.request("POST", path, {**request, "environments": "morpho-12-held-out"},
                                headers={"Accept": "application/json"})
        error = reply.json()["errors"][0]
        assert reply.status == 422 and error["pointer"] == "/environments", reply.body
        assert "only evaluations" in error["detail"] and "held-out" in error["detail"]
    reply = service.request("POST", "/v1/evaluations", {
        "random": {"seed": 1, "count": 100000}, "environments": "morpho-12"})
    assert "12000000 rollouts" in reply.json()["errors"][0]["detail"]


def test_pages_with_measures_are_bounded(service):
    """A page has at most 2,000,000 numbers: 118 designs in 768 worlds with 20 measures."""
    job = run(service, {"random": {"seed": 5, "count": 120}, "environments": "morpho-12-held-out",
                        "physics": {"n_steps": 1}, "measures": True})
    assert "results" not in job
    pages, cursor = [], 0
    while cursor is not None:  # 47 MB take a minute to compare with the contract
        with urllib.request.urlopen(f"http://{service.host}:{service.port}/v1/evaluations/"
                                    f"{job['id']}/results?limit=1000&cursor={cursor}") as reply:
            page = json.load(reply)
        pages.append([row["number"] for row in page["items"]])
        cursor = page["next_cursor"]
    assert pages == [list(range(118)), [118, 119]]


def test_kills_change_nothing(start, tmp_path):
    """After kill -9 the evaluation continues under its id, keeps what it has saved, and has the
    same results as without a kill."""
    request = {**SHORT, "random": {"seed": 3, "count": 12}, "physics": {"n_steps": 500}}
    expected = run(start(), request)
    state = tmp_path / "state"
    first = start(state=state)
    id = first.post("/v1/evaluations", request)["id"]
    kills = 0
    deadline = time.monotonic() + PATIENCE_S
    while kills < 3:
        job = first.get(f"/v1/evaluations/{id}")
        assert time.monotonic() < deadline
        if job["state"] == "succeeded":
            break
        if job["rollouts_done"] <= 200 * kills:
            time.sleep(0.01)
            continue
        first.stop(signal.SIGKILL)
        kills += 1
        first = start(state=state)
    assert kills > 0
    job = done(first, id)
    assert job["results"] == expected["results"] and job["suite"] == expected["suite"]
    assert job["rollouts_done"] == 12 * 120 and job["rollouts_cached"] == 0
    assert [one["id"] for one in first.get("/v1/jobs")["items"]] == [id]


def test_pause_time_left_and_cancel(start):
    """Its progress is that of one job; it can be paused and cancelled, and then has no results."""
    service = start()
    id = service.post("/v1/evaluations", {**SHORT, "random": {"seed": 1, "count": 2000}})["id"]
    deadline = time.monotonic() + PATIENCE_S
    while not (job := service.get(f"/v1/evaluations/{id}"))["progress"]["seconds_left"]:
        assert time.monotonic() < deadline and job["state"] in ("queued", "running")
        time.sleep(0.05)
    assert 0 < job["rollouts_done"] < job["rollouts_total"] == 2000 * 120
    assert "results" not in job and "mean_loss" not in job["suite"]["tasks"][0]
    assert service.act(id, "pause").status == 200
    assert service.get(f"/v1/jobs/{id}")["state"] == "paused"
    picture = service.request("GET", f"/v1/evaluations/{id}/picture.svg")
    assert picture.status == 409 and "paused" in picture.json()["detail"]
    assert service.act(id, "cancel").status == 200
    assert service.get(f"/v1/evaluations/{id}")["state"] == "cancelled"
    assert service.request("GET", f"/v1/evaluations/{id}/results").status == 409
    assert len(service.get("/v1/jobs")["items"]) == 1


def test_the_picture(service):
    """An axis for each task with its unit, a polygon for each design, in two themes and layouts."""
    job = run(service, {**SHORT, "random": {"seed": 5, "count": 8}})
    path = f"/v1/evaluations/{job['id']}/picture.svg"
    reply = service.request("GET", path)
    assert reply.headers["Content-Type"].startswith("image/svg+xml")
    picture = xml.etree.ElementTree.fromstring(reply.body)
    words = [text.text for text in picture.iter(f"{SVG}text")]
    assert all(task in words for task in TASKS)
    assert words.count("0 to 3 m") == 8 and words.count("0 to 0.3 m") == 1
    assert words.count("0 to 1") == 3
    best = sorted(range(8), key=lambda d: job["results"][d]["tasks_mean"]["loss"])[:6]
    assert [int(word.split(":")[0]) for word in words if re.match(r"\d: ", word)] == best
    assert len(picture.findall(f"{SVG}path")) == 6
    # The dot of the first design on the axis of `photo` is above the center, by its value.
    dot = picture.find(f"{SVG}circle")
    lines = picture.findall(f"{SVG}line")
    center, end = float(lines[0].get("y1")), float(lines[0].get("y2"))
    value = job["results"][best[0]]["tasks"]["photo"]["value"]
    share = (center - float(dot.get("cy"))) / (center - end)
    assert share == pytest.approx(max(value, 0), abs=0.01)
    assert "#1b2027" not in reply.body.decode()
    chosen = service.request("GET", path + "?designs=7,1&theme=dark&width=360").body.decode()
    picture = xml.etree.ElementTree.fromstring(chosen)
    assert picture.get("width") == "360" and "#1b2027" in chosen
    assert len(picture.findall(f"{SVG}path")) == 2 and "7: " in chosen and "1: " in chosen
    service.refuses(path, "?designs=8", "?designs=1,2,3,4,5,6,7", "?designs=", "?designs=1,",
                    "?theme=blue", "?width=100")
    plain = run(service, {"designs": [DESIGN], "environments": "morpho-12-walk",
                          "physics": PHYSICS})
    refusal = service.request("GET", f"/v1/evaluations/{plain['id']}/picture.svg")
    assert refusal.status == 404 and "suite" in refusal.json()["detail"]


def test_the_champions_of_a_campaign(service, tmp_path):
    """They are scored with the physics and controller of the campaign, or another controller."""
    campaign = service.post("/v1/campaigns", {
        "mode": "zero-shot", "preset": "demo", "population": 8, "generations": 1,
        "physics": PHYSICS, "exclude_pretraining": False})["id"]
    deadline = time.monotonic() + PATIENCE_S
    while service.get(f"/v1/campaigns/{campaign}")["state"] != "succeeded":
        assert time.monotonic() < deadline
        time.sleep(0.05)
    champions = [row["robot"] for row in service.get(
        f"/v1/campaigns/{campaign}/champions?count=3")["items"]]
    path = f"/v1/campaigns/{campaign}/champions"
    job = done(service, service.post(path, {"count": 3, "environments": "morpho-12",
                                            "label": "champions"})["id"])
    assert [result["robot"] for result in job["results"]] == champions
    assert job["label"] == "champions" and job["physics"]["n_steps"] == 100
    assert job["suite"]["name"] == "morpho-12" and job["record"] == []
    shown = suite(service, "run", "--campaign", campaign, "-n", 3, "--json")
    assert json.loads(shown.stdout)["results"] == job["results"]
    reply = service.request("POST", path, {"environments": "morpho-12", "controller": "nobody"})
    assert reply.status == 422 and reply.json()["errors"][0]["pointer"] == "/controller"
    reply = service.request("POST", path, {"environments": "morpho-12", "record": ["com"]})
    assert reply.status == 422 and reply.json()["errors"][0]["pointer"] == "/record"
    for wrong in ([{"task": "walk"}], 5, {}):  # with one sentence
        reply = service.request("POST", path, {"environments": wrong})
        assert reply.status == 422 and reply.json()["errors"][0]["pointer"] == "/environments"
        assert reply.json()["errors"][0]["detail"].startswith("must be the name of a set or suite")
    assert suite(service, "run", "--campaign", campaign, "--random", 3, check=False).returncode == 2


def test_morphoctl(service, tmp_path):
    """`suite run` submits one evaluation and prints its table; `show` prints it again; `picture`
    saves the picture."""
    arguments = ["run", "--random", 2, "--seed", 7, "-p", "n_steps=100"]
    before = len(service.pages("/v1/evaluations"))
    job = json.loads(suite(service, *arguments, "--json").stdout)
    assert len(service.pages("/v1/evaluations")) == before + 1
    assert job["suite"]["name"] == "morpho-12" and len(job["results"]) == 2
    table = [line.split() for line in suite(service, *arguments).stdout.splitlines()]
    assert table[0] == ["design", *TASKS, "mean", "loss"]
    for row, result in zip(table[1:], job["results"]):
        assert row[0] == result["robot"]
        assert [float(cell) for cell in row[1:]] == [pytest.approx(value, abs=6e-4) for value in (
            *(result["tasks"][task]["value"] for task in TASKS), result["tasks_mean"]["loss"])]
    assert table[3][0] == "mean"
    assert float(table[3][3]) == pytest.approx(job["suite"]["tasks"][2]["mean_value"], abs=6e-4)
    robots = [result["robot"] for result in job["results"]]
    skipped = suite(service, "run", *robots, "-", "--on-fault", "skip", "-p", "n_steps=100",
                    input='{"cells": [[0, 0, 0], [3, 3, 3]]}')
    assert "leave out up to 1 of 3 designs" in skipped.stderr and "skipped" in skipped.stdout
    id = suite(service, "run", *robots, "-p", "n_steps=100", "--held-out", "--no-wait").stdout
    job = done(service, id.strip())
    assert job["environments"] == "morpho-12-held-out"
    shown = suite(service, "show", job["id"]).stdout.splitlines()
    assert len(shown) == 4 and shown[1].split()[0] == robots[0]
    plain = run(service, {"designs": [DESIGN], "physics": PHYSICS})
    refused = suite(service, "show", plain["id"], check=False)
    assert refused.returncode == 2 and "not in a suite" in refused.stderr
    file = tmp_path / "radar.svg"
    suite(service, "picture", job["id"], "-o", file, "--theme", "dark", "--designs", "1")
    assert file.read_text().startswith("<svg") and "#1b2027" in file.read_text()
    assert math.isclose(float(shown[1].split()[1]),
                        job["results"][0]["tasks"]["photo"]["value"], abs_tol=6e-4)
