"""What evaluations, training runs, campaigns and certificates have in common as jobs: lists,
labels, keys, waiting, control, events, metrics, and unknown ids."""

import concurrent.futures
import time
import urllib.parse

import pytest

from service import DESIGN, SHORT, SOON_S, await_end, awaited

BAR = {"cells": [[x, 2, 0] for x in range(4)]}
CAMPAIGN = {
    "mode": "zero-shot", "population": 4, "generations": 2, "physics": SHORT,
    "exclude_pretraining": False
}
TRAINING = {
    "kind": "finetune", "designs": [DESIGN, BAR], "steps": 3, "batch": 2, "physics": SHORT,
    "validation": {"every_steps": 0}
}
JOBS = {
    "evaluations": {"designs": [DESIGN], "physics": SHORT},
    "trainings": TRAINING,
    "campaigns": CAMPAIGN,
    "certificates": {"designs": [DESIGN, BAR], "axes": ["friction"], "physics": SHORT},
}
PLATES = [{"cells": [[x, y, 0] for x in range(width) for y in range(depth)]}
          for width in range(1, 7) for depth in range(1, 7)]
LONG = {
    "evaluations": {"designs": PLATES, "physics": {"n_steps": 20000}, "priority": "batch"},
    "trainings": TRAINING | {"steps": 100000},
    "campaigns": CAMPAIGN | {"population": 16, "generations": 100000, "physics": {"n_steps": 300}},
    "certificates": {"designs": PLATES, "axes": ["chance"], "physics": {"n_steps": 20000}},
}
BELOW = {
    "evaluations": ["", "/trajectories/0", "/trajectories/0/file"],
    "trainings": ["", "/steps", "/validations", "/checkpoints", "/controller", "/held-out"],
    "campaigns": ["", "/generations", "/learning", "/replicates", "/population", "/designs/0",
                  "/designs/0/ancestors", "/designs/0/descendants", "/phylogeny", "/checkpoints",
                  "/phylogeny?format=csv", "/phylogeny?format=newick", "/champions"],
    "certificates": ["", "/report", "/report.csv"],
}
COUNTED = {  # at least this much after one job
    "evaluations": {"morphod_rollouts_total": 10},
    "trainings": {"morphod_training_steps_total": 3, "morphod_training_checkpoints_total": 1,
                  "morphod_training_robots_total": 6, "morphod_training_step_seconds_total": 1e-9,
                  "morphod_trainings_running": 0, "morphod_training_robots_zeroed_total": 0},
    "campaigns": {"morphod_campaign_generations_total": 3, "morphod_campaign_designs_total": 12,
                  "morphod_campaign_rollouts_total": 12, "morphod_campaigns_running": 0,
                  "morphod_campaign_learning_steps_total": 0,
                  "morphod_campaign_rollouts_cached_total": 0},
    "certificates": {"morphod_certificate_rollouts_total": 100,
                     "morphod_certificates_running": 0},
}
each_kind = pytest.mark.parametrize("kind", JOBS)


@pytest.fixture(scope="module")
def ended(service):
    """A job of each kind that has succeeded."""
    done = {}
    for kind, value in JOBS.items():
        reply = service.request("POST", f"/v1/{kind}", value | {"label": "première", "weight": 2})
        accepted = reply.json()
        assert reply.status == 202 and reply.headers["Retry-After"], reply.body
        assert reply.headers["Location"] == f"/v1/{kind}/{accepted['id']}"
        # It has succeeded if everything was known, which depends on the tests before.
        assert accepted["state"] in ("queued", "running", "succeeded")
        assert "results" not in accepted
        done[kind] = await_end(service, reply.headers["Location"]).json()
    return done


@each_kind
def test_the_end(service, ended, kind):
    done, path = ended[kind], f"/v1/{kind}/{ended[kind]['id']}"
    assert done["state"] == "succeeded" and done["error"] is None and done["attempts"] == 0
    assert done["label"] == "première" and done["weight"] == 2
    assert service.post(f"/v1/{kind}", JOBS[kind])["label"] is None
    assert done["finished_at"] >= done["started_at"] >= done["created_at"]
    assert service.tagged(path).json() == done
    assert service.request("GET", path, headers={"If-None-Match": '"other"'}).status == 200
    job = service.get(f"/v1/jobs/{done['id']}")
    assert job["kind"] == kind[:-1] and job["state"] == "succeeded"
    for link in done.get("links", {}).values():
        if "/events" not in link:
            service.refuses(link, "", status=200)


@each_kind
def test_lists(service, ended, kind):
    done = ended[kind]
    seen = [item["id"] for item in service.pages(f"/v1/{kind}", 3)]
    assert seen == sorted(set(seen), key=int, reverse=True) and done["id"] in seen
    listed = service.pages(f"/v1/{kind}?state=succeeded")
    is_brief = kind in ("evaluations", "certificates")
    shown = service.get(f"/v1/jobs/{done['id']}") if is_brief else done
    for long in ("founders", "notes"):  # lists omit members that can be as long as a population
        shown.pop(long, None)
    assert shown in listed and "results" not in shown
    service.tagged(f"/v1/{kind}?state=succeeded")
    jobs = service.pages(f"/v1/jobs?kind={kind[:-1]}")
    assert {job["kind"] for job in jobs} == {kind[:-1]} and [job["id"] for job in jobs] == seen
    every = service.pages("/v1/jobs", 5)
    assert [job["id"] for job in every if job["kind"] == kind[:-1]] == seen
    assert {job["state"] for job in service.pages("/v1/jobs?state=succeeded")} == {"succeeded"}
    service.refuses(f"/v1/{kind}", "?state=done", "?cursor=x", "?cursor=01", "?limit=0", "?label=",
                    "?label=" + "x" * 201, "?kind=training", "?group=x", "?group=0", "?group=01",
                    "?mode=zero-shot")
    service.refuses(f"/v1/jobs/{done['id']}", "?x=1")
    assert service.request("POST", f"/v1/{kind}?x=1", JOBS[kind]).status == 400


def test_what_has_a_label_is_found(service):
    label = "für Ä & %  " + "😀" * 189  # of the largest length
    first = service.post("/v1/campaigns", CAMPAIGN | {"label": label, "replicates": 2})["id"]
    campaigns = [str(int(first) + 1), first]
    for id in campaigns:
        await_end(service, f"/v1/campaigns/{id}")
    evaluation = service.evaluate(JOBS["evaluations"] | {"label": label}).json()["id"]
    quoted = f"?label={urllib.parse.quote(label)}"
    for path, ids in (("jobs" + quoted, [evaluation, *campaigns]),
                      (f"jobs{quoted}&kind=campaign&state=succeeded", campaigns),
                      (f"jobs{quoted}&state=paused", []), (f"jobs{quoted}&kind=training", []),
                      ("campaigns" + quoted, campaigns),
                      (f"campaigns{quoted}&group={first}", campaigns),
                      (f"campaigns{quoted}&group={evaluation}", []), ("trainings" + quoted, []),
                      ("evaluations" + quoted, [evaluation]),
                      (f"evaluations{quoted}&state=failed", []),
                      ("jobs?label=nothing%20has%20this", [])):
        assert [item["id"] for item in service.pages("/v1/" + path)] == ids, path
    assert [item["id"] for item in service.pages("/v1/campaigns" + quoted, 1)] == campaigns


@each_kind
def test_idempotency(service, ended, kind):
    """The same key returns the same job, quoted or not, and also in a race, but not with another
    body."""
    def submit(key):
        return service.request("POST", f"/v1/{kind}", JOBS[kind], headers={"Idempotency-Key": key})

    replies = [submit(f'"{kind}-one"'), submit(f"{kind}-one")]
    with concurrent.futures.ThreadPoolExecutor(16) as pool:
        race = list(pool.map(submit, [f"{kind}-race"] * 16))
    for same in (replies, race):
        assert {reply.status for reply in same} == {202}
        assert len({reply.json()["id"] for reply in same}) == 1
    id = replies[0].json()["id"]
    others = [JOBS[kind] | {"weight": 3}]
    if kind == "trainings":
        population = {"evaluation": ended["evaluations"]["id"]}
        others.append({"kind": "finetune", "population": population})
    if kind == "campaigns":
        others.append(CAMPAIGN | {"initial": {"campaign": id}})
    for other in others:
        reply = service.request("POST", f"/v1/{kind}", other,
                                headers={"Idempotency-Key": f"{kind}-one"})
        assert reply.status == 422, reply.body
        assert reply.json()["errors"][0]["header"] == "Idempotency-Key"
    await_end(service, f"/v1/{kind}/{id}")


@each_kind
def test_nothing_there(service, ended, kind):
    other = next(job["id"] for name, job in ended.items() if name != kind)
    absent = ("999999", "0", "x", "-1", "1" * 30)
    for id in (*absent, other):
        service.refuses(f"/v1/{kind}/{id}", *BELOW[kind], status=404)
        if kind != "evaluations":
            assert service.request("DELETE", f"/v1/{kind}/{id}/checkpoints").status == 404
        if kind == "campaigns":
            for verb, body in (("extend", {"generations": 1}), ("champions", {})):
                path = f"/v1/campaigns/{id}/{verb}"
                assert service.request("POST", path, body).status == 404
    for id in absent:
        assert service.request("DELETE", f"/v1/jobs/{id}").status == 404
        assert service.request("PATCH", f"/v1/jobs/{id}", {"note": "!"}).status == 404
        assert {service.act(id, verb).status for verb in ("pause", "resume", "cancel")} == {404}
    service.refuses(f"/v1/{kind}/{ended[kind]['id']}", "/nothing", status=404)
    for method in ("PUT", "DELETE"):
        assert service.request(method, f"/v1/{kind}").status == 405
    assert service.request("PUT", f"/v1/jobs/{other}").status == 405
    service.refuses("/v1/jobs/1", "/pause", status=405)


@each_kind
def test_events(service, ended, kind):
    events = service.get(
        f"/v1/events?format=json&job={ended[kind]['id']}&after=0&limit=1000")["items"]
    types = [event["type"] for event in events]
    assert types[0] == "job.created" and types[1] == "job.started" and types[-1] == "job.finished"
    reported = [event["data"] for event in events if event["type"] == "training.progress"]
    if kind == "trainings":
        assert set(reported[-1]) >= {"id", "step", "steps", "mean_loss", "gradient_norm", "rate",
                                 "clipped_share", "bodies_per_s", "seconds_left"}
        assert reported[-1]["id"] == ended[kind]["id"] and reported[-1]["steps"] == 3


@each_kind
def test_metrics(service, ended, kind):
    assert ended[kind]
    for name, least in COUNTED[kind].items():
        assert service.metric(name) >= least, name


@each_kind
def test_wait(service, kind):
    id = service.post(f"/v1/{kind}", LONG[kind])["id"]
    begun = time.monotonic()
    reply = service.request("GET", f"/v1/{kind}/{id}", headers={"Prefer": "wait=1"})
    assert reply.status == 200 and 0.8 < time.monotonic() - begun < SOON_S
    assert reply.json()["state"] in ("queued", "running")
    assert reply.headers["Preference-Applied"] == "wait=1" and reply.headers["Retry-After"]
    assert service.act(id, "cancel").status == 200
    assert await_end(service, f"/v1/{kind}/{id}").json()["state"] == "cancelled"
    for ignored in ("wait", "wait=-1", "wait=5.5", "wait=soon"):
        reply = service.request("GET", f"/v1/{kind}/{id}", headers={"Prefer": ignored})
        assert reply.status == 200 and "Preference-Applied" not in reply.headers, ignored


def position(job):
    """Returns the progress of a job."""
    of_kind = job.get(job["kind"], {})
    rollouts = of_kind.get("rollouts_done", job.get("rollouts_done"))
    return of_kind.get("step", of_kind.get("generation", rollouts))


def phase(job):
    return job["phase"] if "phase" in job else job[job["kind"]]["phase"]


@each_kind
def test_pause_resume_cancel(service, kind):
    job = service.post(f"/v1/{kind}", LONG[kind])
    path = f"/v1/jobs/{job['id']}"

    def goes_on(before):
        awaited(service, path, lambda job: (position(job) or 0) > before)

    goes_on(0)
    running = service.get(f"/v1/{kind}/{job['id']}")
    assert running["state"] == "running" and running.get("reason") is None
    for _ in range(2):
        assert service.act(job["id"], "pause").json()["state"] == "paused"
    if kind != "evaluations":
        assert phase(running) != "idle"
        awaited(service, f"/v1/{kind}/{job['id']}", lambda value: phase(value) == "idle")
    paused = service.get(path)
    assert paused["state"] == "paused"
    for items in ("/v1/jobs", f"/v1/{kind}"):
        assert job["id"] in [one["id"] for one in service.pages(items + "?state=paused")]
    assert service.act(job["id"], "resume").json()["state"] in ("queued", "running")
    goes_on(position(paused))
    assert service.act(job["id"], "pause").json()["state"] == "paused"
    assert service.act(job["id"], "resume").status == 200
    assert service.act(job["id"], "cancel").json()["state"] == "cancelled"
    for verb in ("pause", "resume", "cancel"):
        reply = service.act(job["id"], verb)
        assert reply.status == 409 and "cancelled" in reply.json()["detail"], reply.body
    assert await_end(service, f"/v1/{kind}/{job['id']}").json()["state"] == "cancelled"
