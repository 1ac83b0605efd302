"""Weights: what jobs accept, show, change and refuse, and the worker time in /metrics."""

import re

from service import awaited

DESIGNS = [{"cells": [[x, y, 0] for x in range(n) for y in range(6)]} for n in (2, 3, 4)]
LONG = {"designs": DESIGNS, "physics": {"n_steps": 1000000}, "priority": "batch"}
TRAINING = {
    "kind": "finetune", "designs": DESIGNS, "steps": 1000, "batch": 8, "physics": {"n_steps": 200},
    "validation": {"every_steps": 0}
}


def worker_seconds(service):
    text = service.request("GET", "/metrics").body.decode()
    return {
        kind: float(value)
        for kind, value in re.findall(r'^morphod_job_worker_seconds_total\{kind="(\w+)"\} (\S+)$',
                                      text, re.M)
    }


def test_taken_shown_and_changed(service):
    plain = service.post("/v1/evaluations", LONG)
    heavy = service.post("/v1/evaluations", {**LONG, "weight": 2.5})
    assert plain["weight"] == 1 and heavy["weight"] == 2.5
    path = f"/v1/jobs/{heavy['id']}"
    before = service.request("GET", path)
    changed = service.request("POST", path + "/weight", {"weight": 0.001})
    assert changed.status == 200 and changed.json()["weight"] == 0.001
    after = service.request("GET", path, headers={"If-None-Match": before.headers["ETag"]})
    assert after.status == 200 and after.json()["weight"] == 0.001
    assert service.post(path + "/weight", {"weight": 1000})["weight"] == 1000
    weights = {job["id"]: job["weight"] for job in service.get("/v1/jobs?limit=10")["items"]}
    assert weights[heavy["id"]] == 1000 and weights[plain["id"]] == 1
    events = service.get(f"/v1/events?format=json&job={heavy['id']}&after=0&limit=1000")["items"]
    assert [event["data"]["weight"] for event in events
            if event["type"] == "job.weight"] == [0.001, 1000]
    for job in (plain, heavy):
        assert service.act(job['id'], "cancel").status == 200
    assert service.request("POST", path + "/weight", {"weight": 2}).status == 409
    assert service.request("POST", "/v1/jobs/123456789/weight", {"weight": 2}).status == 404
    assert service.get(path)["weight"] == 1000


def test_pace_of_an_evaluation(service):
    idle = {"rollouts_per_s": None, "seconds_left": None, "busy_s": None}
    wide = LONG | {"physics": {"n_steps": 20000}, "verify": True}
    wide["environments"] = [{"light_xy_m": [4.5, 2.5], "terrain_sigma_m": 0.05, "seed": seed}
                            for seed in range(64)]
    path = f"/v1/evaluations/{service.post('/v1/evaluations', wide)['id']}"
    reply = []
    def shown(now):
        reply[:] = [now]
        return now["progress"]["rollouts_per_s"] is not None
    progress = awaited(service, path, shown)["progress"]
    job = reply[0]
    assert job["state"] == "running" and progress["busy_s"] > 0
    left = (job["rollouts_total"] - job["rollouts_done"]) / progress["rollouts_per_s"]
    assert 0 < progress["seconds_left"] < 2 * left + 1
    listed = {item["id"]: item for item in service.get("/v1/jobs?kind=evaluation")["items"]}
    assert listed[job["id"]]["progress"]["rollouts_per_s"] > 0
    known = service.request("GET", path)
    awaited(service, path, lambda now: now["progress"] != known.json()["progress"])
    tag = {"If-None-Match": known.headers["ETag"]}
    assert service.request("GET", path, headers=tag).status == 200
    service.act(job["id"], "cancel")
    assert service.get(path)["progress"] == idle
    service.tagged(path)


def test_of_a_training(service):
    training = service.post("/v1/trainings", {**TRAINING, "weight": 3})
    assert training["weight"] == 3
    path = f"/v1/jobs/{training['id']}"
    awaited(service, f"/v1/trainings/{training['id']}",
            lambda state: state["progress"]["step"] >= 2)
    running = service.get(f"/v1/trainings/{training['id']}")
    assert running["progress"]["busy_s"] > 0
    assert service.post(path + "/weight", {"weight": 0.5})["weight"] == 0.5
    assert service.get(f"/v1/trainings/{training['id']}")["weight"] == 0.5
    assert service.request("POST", path + "/cancel").status == 200
    awaited(service, f"/v1/trainings/{training['id']}", lambda state: state["phase"] == "idle")
    seconds = worker_seconds(service)
    assert set(seconds) == {"evaluation", "training", "campaign", "atlas",
                            "certificate"}
    assert seconds["training"] > 0


def test_wrong_weights(service):
    job = service.post("/v1/evaluations", LONG)["id"]
    for weight in (0, -1, 0.0009, 1000.1, 1e300, "2", None):
        reply = service.request("POST", f"/v1/jobs/{job}/weight", {"weight": weight})
        assert reply.status == 422 and reply.pointers() == ["/weight"], reply.body
    assert service.act(job, "cancel").json()["weight"] == 1


def test_wrong_bodies(service):
    path = "/v1/jobs/1/weight"
    form = {"headers": {"Content-Type": "application/x-www-form-urlencoded"}}
    for body, status, how in (("{", 400, {}), ("", 400, {}), ("2", 422, {}), ("{}", 422, {}),
                              ("weight=2", 415, form)):
        assert service.request("POST", path, body=body, **how).status == status, body
    assert service.request("POST", path, {}).pointers() == [""]
    assert service.request("POST", path, {"weight": 1, "factor": 2}).pointers() == ["/factor"]
    assert service.request("PUT", path, {"weight": 1}).status == 405
