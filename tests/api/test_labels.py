"""Labels, experiments, notes, the archive, deletion, the usage of jobs, retention rules."""

import os
import pathlib
import signal
import sqlite3
import time
import urllib.parse

import pytest
from service import DESIGN, SHORT, await_end, run, until

EVALUATION = {"designs": [DESIGN], "physics": SHORT}
SMALL = {"mode": "zero-shot", "preset": "demo", "population": 8, "generations": 2,
         "physics": SHORT}


def evaluate(service, **members):
    return run(service, "evaluations", EVALUATION | members)


def ids(service, query, path="/v1/jobs"):
    return [item["id"] for item in service.get(f"{path}?{query}")["items"]]


def edit(service, job, **members):
    reply = service.request("PATCH", f"/v1/jobs/{job}", members)
    assert reply.status == 200, reply.body
    return reply.json()


def delete(service, job):
    return service.request("DELETE", f"/v1/jobs/{job}")


def test_lists_by_label_and_experiment(service):
    one = evaluate(service, label="ünder test/1", experiment="lists")["id"]
    two = evaluate(service, label="ünder test/2")["id"]
    campaign = run(service, "campaigns", SMALL | {"label": "ünder", "experiment": "lists"})["id"]
    star = "%C3%BCnder"
    assert ids(service, f"label={star}*") == [campaign, two, one]
    assert ids(service, f"label={star}%20test/*&state=succeeded") == [two, one]
    assert ids(service, f"label={star}") == [campaign] and ids(service, "label=test*") == []
    assert ids(service, "experiment=lists") == [campaign, one]
    assert ids(service, "experiment=lists", "/v1/campaigns") == [campaign]
    assert ids(service, f"experiment=lists&label={star}%20*&kind=evaluation") == [one]
    assert edit(service, two, experiment="lists", label=None)["label"] is None
    assert ids(service, "experiment=lists&limit=2") == [campaign, two]
    assert ids(service, "search=NDER%20t") == [one]
    assert ids(service, "search=nder") == [campaign, one]
    assert ids(service, "search=r&kind=campaign&experiment=lists") == [campaign]
    assert ids(service, "search=test%2F1&state=succeeded", "/v1/evaluations") == [one]
    assert ids(service, "search=nder&limit=1") == [campaign]
    assert ids(service, f"search=nder&limit=1&cursor={campaign}") == [one]
    for sign in "%_":  # they are not wildcards
        found = service.get(f"/v1/jobs?limit=1000&search={urllib.parse.quote(sign)}")["items"]
        assert all(sign in job["label"] for job in found)
        assert not {one, campaign} & {job["id"] for job in found}
    brief = service.get("/v1/jobs?experiment=lists&kind=campaign")["items"][0]["campaign"]
    whole = service.get(f"/v1/campaigns/{campaign}")
    assert brief["best_score"] == whole["newest"]["score"]["quantiles"]["p0"] > 0
    assert (brief["seed"], brief["environments"]) == (1, "paper-test")
    rows = service.table("/v1/jobs?experiment=lists&format=csv")
    assert [row["experiment"] for row in rows] == ["lists"] * 3
    exported = service.get("/v1/campaigns/generations?experiment=lists")["items"]
    assert [row["campaign"] for row in exported] == [campaign] * 3
    service.refuses("/v1/jobs", "?experiment=", "?archived=1", "?label=" + "x" * 201,
                    "?search=")
    service.refuses("/v1/campaigns/generations", "?experiment=lists&label=x")


def test_notes_and_the_archive(service):
    job = evaluate(service, label="first")["id"]
    note = "It walks.\n<b>Not</b> HTML; \u202e neither."
    changed = edit(service, job, note=note, label="second", archived=True)
    assert (changed["note"], changed["label"]) == (note, "second") and changed["archived_at"]
    since = changed["archived_at"]
    assert edit(service, job, archived=True)["archived_at"] == since
    assert job not in ids(service, "limit=1000")
    assert job in ids(service, "archived=true") and job in ids(service, "archived=all&label=second")
    assert service.get(f"/v1/evaluations/{job}")["note"] == note  # nothing else changes
    etag = service.request("GET", f"/v1/jobs/{job}").headers["ETag"]
    assert edit(service, job, archived=False, note=None)["archived_at"] is None
    assert service.request("GET", f"/v1/jobs/{job}").headers["ETag"] != etag
    assert job in ids(service, "label=second")
    events = [one["type"] for one in service.get(f"/v1/events?format=json&job={job}")["items"]]
    assert events.count("job.changed") == 3
    for value, pointer in (({}, ""), ({"note": ""}, "/note"), ({"note": "x" * 1001}, "/note"),
                           ({"archived": 1}, "/archived"), ({"state": "queued"}, "/state"),
                           ({"experiment": "x" * 101}, "/experiment")):
        reply = service.request("PATCH", f"/v1/jobs/{job}", value)
        assert reply.status == 422 and reply.pointers() == [pointer], reply.body
    assert service.request("PATCH", "/v1/jobs/999999", {"archived": True}).status == 404


def test_deletion(service):
    """Deleted jobs disappear at once. Jobs that others need stay, and so do designs, scores and
    controllers."""
    job = evaluate(service, record=["com"])["id"]
    reply = delete(service, job)
    assert reply.status == 200 and reply.json()["recorded_bytes"] > 0
    assert [one["what"] for one in reply.json()["stays"]] == ["designs", "scores"]
    for path in (f"/v1/jobs/{job}", f"/v1/evaluations/{job}",
                 f"/v1/evaluations/{job}/trajectories/0?environment=0",
                 f"/v1/evaluations/{job}/environments"):
        assert service.request("GET", path).status == 404, path
    assert delete(service, job).status == 404
    assert evaluate(service)["rollouts_cached"] > 0
    # A campaign whose population is the start of another.
    first = run(service, "campaigns", SMALL | {"replicates": 2})["id"]
    second = await_end(service, f"/v1/campaigns/{int(first) + 1}").json()["id"]
    bred = run(service, "campaigns", SMALL | {"initial": {"campaign": second}})["id"]
    for one, words in ((second, f"campaign {bred} was bred from its population"),
                       (first, f"campaign {second}, a replicate")):
        refused = delete(service, one)
        assert refused.status == 409 and words in refused.json()["detail"], refused.body
    for one in (bred, second, first):
        assert delete(service, one).status == 200
        for below in ("", "/population", "/phylogeny?format=csv", "/generations", "/champions"):
            assert service.request("GET", f"/v1/campaigns/{one}{below}").status == 404
    running = service.post("/v1/campaigns", SMALL | {"generations": 100000})["id"]
    refused = delete(service, running)
    assert refused.status == 409 and "it is " in refused.json()["detail"]
    service.act(running, "cancel")
    assert delete(service, running).status == 200
    learned = run(service, "campaigns", SMALL | {
        "mode": "simultaneous", "population": 2, "generations": 1, "name": "left",
        "learning": {"parent_steps": 1, "child_steps": 1, "batch": 2}})
    gone = delete(service, learned["id"]).json()
    assert gone["stays"][-1]["what"] == "controller left" and gone["checkpoints"] == 1
    assert service.request("GET", "/v1/controllers/left").status == 200


def test_usage(service):
    label = f"usage {time.time()}"
    jobs = [run(service, "campaigns", SMALL | {"label": label, "seed": 70 + i}) for i in range(2)]
    used = sum(job["core_seconds"] for job in jobs)
    assert used > 0 and all(job["device_seconds"] == 0 for job in jobs)
    rows = {row["name"]: row for row in service.get("/v1/usage?by=label")["items"]}
    assert rows[label]["jobs"] == 2 and rows[label]["core_seconds"] == pytest.approx(used, abs=2e-6)
    assert delete(service, jobs[0]["id"]).status == 200
    again = {row["name"]: row for row in service.get("/v1/usage")["items"]}
    assert again[label] == pytest.approx(rows[label])
    assert {row["name"] for row in service.get("/v1/usage?by=kind")["items"]} <= {
        "evaluation", "training", "campaign", "atlas", "certificate"}
    lines = service.table("/v1/usage?by=kind&format=csv")
    assert sum(int(line["jobs"]) for line in lines) >= 2
    service.refuses("/v1/usage", "?by=state", "?cursor=1")


def test_core_seconds_are_processor_time(start):
    """Four workers share one core: waiting for it does not count."""
    service = start("--workers=4")
    core = min(os.sched_getaffinity(0))
    for thread in os.listdir(f"/proc/{service.process.pid}/task"):
        os.sched_setaffinity(int(thread), {core})

    def used():
        fields = pathlib.Path(f"/proc/{service.process.pid}/stat").read_text().rsplit(")", 1)[1]
        return sum(map(int, fields.split()[11:13])) / os.sysconf("SC_CLK_TCK")

    before = used()
    done = run(service, "evaluations", {"physics": {"n_steps": 10000}, "designs": [
        {"cells": [[x, y, 0] for x in range(n) for y in range(3)]} for n in range(1, 7)]})
    assert 0.3 < done["core_seconds"] <= 1.1 * (used() - before) + 0.05, done["core_seconds"]


def test_usage_survives_a_kill(start, tmp_path):
    first = start(state=tmp_path)
    job = first.post("/v1/campaigns", SMALL | {"generations": 100000})["id"]
    until(lambda: (first.get(f"/v1/campaigns/{job}")["progress"]["generation"] or 0) > 3)
    first.act(job, "pause")
    before = first.get(f"/v1/jobs/{job}")["core_seconds"]
    first.stop(signal.SIGKILL)
    again = start(state=tmp_path)
    kept = again.get(f"/v1/jobs/{job}")["core_seconds"]
    assert 0 < kept <= before + 1
    again.act(job, "resume")
    until(lambda: again.get(f"/v1/jobs/{job}")["core_seconds"] > kept)
    again.act(job, "cancel")


def test_retention(start, tmp_path):
    """Evaluations are deleted by age; those with a note or in the archive stay."""
    first = start(state=tmp_path)
    jobs = [evaluate(first, record=["com"])["id"] for _ in range(4)]
    edit(first, jobs[0], note="for the paper")
    edit(first, jobs[1], archived=True)
    first.stop()
    with sqlite3.connect(tmp_path / "morphod.db") as db:
        db.execute("UPDATE jobs SET finished_us=finished_us-86400000000 WHERE id<?", [jobs[3]])
    db.close()
    again = start("--keep-evaluations=12h", state=tmp_path)
    until(lambda: ids(again, "archived=all") == [jobs[3], jobs[1], jobs[0]])
    shown = [one for one in again.get("/v1/events?format=json")["items"]
            if one["type"] == "job.deleted"]
    assert [(one["job"], one["data"]["reason"]) for one in shown] == [(jobs[2], "age")]
    again.stop()
    third = start("--keep-recordings=12h", state=tmp_path)
    edit(third, jobs[1], archived=False)
    third.stop()
    last = start("--keep-recordings=12h", state=tmp_path)
    until(lambda: last.get(f"/v1/jobs/{jobs[1]}")["recorded_bytes"] == 0)
    assert all(last.get(f"/v1/jobs/{job}")["recorded_bytes"] for job in (jobs[0], jobs[3]))


def test_retention_of_runs(start, tmp_path):
    """Training runs and campaigns are deleted by age, each kind by its own rule. What another job
    needs stays, and so does a controller."""
    first = start(state=tmp_path)
    taught = run(first, "trainings", {
        "kind": "pretrain", "name": "stays", "steps": 1, "batch": 1, "physics": {"n_steps": 5},
        "validation": {"designs": 1, "environments": 1}})["id"]
    parent = run(first, "campaigns", SMALL)["id"]
    bred = run(first, "campaigns", SMALL | {"initial": {"campaign": parent}})["id"]
    alone = run(first, "campaigns", SMALL | {"seed": 2})["id"]
    first.stop()
    with sqlite3.connect(tmp_path / "morphod.db") as db:
        db.execute("UPDATE jobs SET finished_us=finished_us-86400000000 WHERE id<>?", [bred])
    db.close()
    again = start("--keep-campaigns=12h", state=tmp_path)
    until(lambda: ids(again, "archived=all") == [bred, parent, taught])
    again.stop()
    assert list((tmp_path / "trainings" / taught).iterdir())
    last = start("--keep-trainings=12h", state=tmp_path)
    until(lambda: ids(last, "archived=all") == [bred, parent])
    until(lambda: not (tmp_path / "trainings" / taught).exists())
    assert last.request("GET", "/v1/controllers/stays/file").status == 200
    assert {one["job"] for one in last.get("/v1/events?format=json")["items"]
            if one["type"] == "job.deleted"} == {alone, taught}
