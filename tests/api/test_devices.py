"""Devices, with a module that computes on the processor (tests/device/fake.c): what jobs accept and
show, and equal results with any number of devices and whatever happens to them."""

import json
import os
import pathlib
import platform
import random
import re
import signal
import subprocess
import time
import urllib.parse

import pytest

from fleet_daemon import Worker
from service import BINARY, SOURCE, Service, awaited, until
from workers import Workers

MODULE = pathlib.Path(BINARY).parents[2] / "tests" / "device" / "fake-device.so"
MORPHOCTL = pathlib.Path(
    os.environ.get("MORPHOCTL", SOURCE / "build" / "clients" / "morphoctl" / "morphoctl"))
FLAGS = (f"--compute-module={MODULE}", "--devices=auto")
SHORT = {"n_steps": 20}
CAMPAIGN = {"mode": "zero-shot", "population": 24, "generations": 4, "seed": 7, "physics": SHORT}
TRAINING = {
    "kind": "pretrain", "steps": 3, "batch": 40, "physics": {"n_steps": 4},
    "validation": {"every_steps": 3, "designs": 4, "environments": 2}
}


def grow(generator, size):
    cells = {(2, 2, 0)}
    while len(cells) < size:
        x, y, z = generator.choice(sorted(cells))
        dx, dy, dz = generator.choice(
            ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)))
        if 0 <= x + dx < 6 and 0 <= y + dy < 6 and 0 <= z + dz < 4:
            cells.add((x + dx, y + dy, z + dz))
    return {"cells": [list(cell) for cell in sorted(cells)]}


GENERATOR = random.Random(3)
DESIGNS = [grow(GENERATOR, 5 + i % 12) for i in range(100)]
LARGE = {"designs": DESIGNS, "physics": SHORT}


def fake(**what):
    return {f"MORPHO_FAKE_{name.upper()}": str(value) for name, value in what.items()}


def await_state(service, path, *states, seconds=300):
    return awaited(service, path, lambda seen: seen["state"] in states, seconds)


def run(service, kind, request):
    id = service.post(f"/v1/{kind}", request)["id"]
    return await_state(service, f"/v1/{kind}/{id}", "succeeded", "failed", "paused")


def refused(service, kind, request):
    reply = service.request("POST", f"/v1/{kind}", request)
    assert reply.status == 422 and reply.pointers() == ["/device"], reply.body
    return reply.body.decode()


def show(service):
    """Returns what morphoctl shows of the devices."""
    return subprocess.run([MORPHOCTL, "-s", f"http://{service.host}:{service.port}", "devices"],
                          capture_output=True, text=True, timeout=300, check=False)


def check_results(service, jobs, undisturbed):
    """Checks that the campaign and the training run end like undisturbed ones."""
    ended = [await_state(service, f"/v1/{kind}/{job}", "succeeded") for kind, job in jobs]
    assert all(job["error"] is None for job in ended)
    assert population(service, ended[0]) == undisturbed["population"]
    assert ended[1]["controller"]["sha256"] == undisturbed["controller"]


def population(service, campaign):
    items = service.get(f"/v1/campaigns/{campaign['id']}/population?limit=1000")["items"]
    return [(item["number"], item["genotype"], item["score"]) for item in items]


def devices(service):
    return service.get("/v1/devices")


def test_without_devices(service):
    assert devices(service) == {"items": [], "fingerprints": {"scores": None, "gradients": None}}
    for kind, request in (("evaluations", LARGE), ("trainings", TRAINING), ("campaigns", CAMPAIGN)):
        for device in ("cuda", "abacus"):
            refused(service, kind, {**request, "device": device})
    taken = service.post("/v1/evaluations", {**LARGE, "device": "auto"})
    assert taken["device"] == "cpu"
    assert service.act(taken["id"], "cancel").status == 200
    assert "morphod_device_load" not in service.request("GET", "/metrics").body.decode()


def test_ranks_a_class(start):
    """sort=score ranks one class: that of the service, or the requested one."""
    service = start(*FLAGS, environment=fake(devices=1))

    def ranked(query):
        page = service.request("GET", "/v1/designs?sort=score" + query)
        assert page.status == 200, page.body
        return len(page.json()["items"])

    processors = service.get("/v1/threads")["fingerprints"]["float32"]
    run(service, "evaluations", {"designs": DESIGNS[:3], "device": "cuda"})
    assert (ranked(""), ranked("&class=" + urllib.parse.quote(processors))) == (3, 0)
    run(service, "evaluations", {"designs": DESIGNS[:2], "device": "cpu"})
    assert (ranked(""), ranked("&class=" + urllib.parse.quote(processors))) == (3, 2)
    assert ranked("&class=nobody") == 0
    for wrong in ("", "x" * 64, "%01", "%C3%A4"):
        assert service.request("GET", "/v1/designs?sort=score&class=" + wrong).status == 400, wrong


def test_evaluations(start):
    plain = start()
    expected = run(plain, "evaluations", LARGE)["results"]
    service = start(*FLAGS, environment=fake(devices=2))
    taken = run(service, "evaluations", LARGE)
    assert taken["device"] == "cuda" and taken["results"] == expected
    score = service.get(f"/v1/designs/{expected[0]['id']}")["orientations"][0]["scores"][0]
    assert score["fingerprint"] == "fake float32 score-1 sm90"
    # Another class is recomputed, except for the body that the devices left to the processors.
    for cached in (10, 1000):
        known = run(service, "evaluations", {**LARGE, "device": "cpu"})
        assert known["device"] == "cpu" and known["rollouts_cached"] == cached
        assert known["results"] == expected
    scores = service.get(f"/v1/designs/{expected[0]['id']}")["orientations"][0]["scores"]
    assert len({score["fingerprint"] for score in scores}) == len(scores) == 2
    assert {score["origin"] for score in scores} == {platform.node()}
    small = run(service, "evaluations", {"designs": DESIGNS[:3], "physics": {"n_steps": 21}})
    assert small["device"] == "cpu" and small["priority"] == "interactive"
    small = run(service, "evaluations",
                {"designs": DESIGNS[:3], "physics": {"n_steps": 22}, "device": "cuda"})
    assert small["device"] == "cuda" and small["priority"] == "batch"
    for world in ({"task": "walk", "terrain": {"kind": "slope"}},
                  {"task": "walk", "damage": {"octant": 0, "time_s": 1}},
                  {"task": {"objective": "jump"}, "light_xy_m": [4, 2.5]},
                  {"task": {"guide": {"kind": "ahead"}, "objective": {"travel": 1}}}):
        assert run(service, "evaluations",
                   {**LARGE, "device": "cuda", "environments": [world]})["device"] == "cuda"
    world = {"task": "walk", "terrain": {"kind": "grid", "spacing_m": 1,
                                         "heights_m": [[0, 0], [0, 0]]}}
    assert "terrains of kind" in refused(
        service, "evaluations", {**LARGE, "device": "cuda", "environments": [world]})
    for more in ({"record": ["com"]}, {"precision": "float64"}, {"priority": "interactive"}):
        refused(service, "evaluations", {**LARGE, "device": "cuda", **more})
        if more != {"priority": "interactive"}:
            assert run(service, "evaluations",
                       {"designs": DESIGNS[:9], **more, "physics": SHORT, "priority": "batch"
                        })["device"] == "cpu"
    shown = devices(service)
    assert shown["fingerprints"] == {
        "scores": "fake float32 score-1 sm90", "gradients": "fake float32 gradient-1 sm90"
    }
    assert [device["id"] for device in shown["items"]] == ["FAKE-0", "FAKE-1"]
    computed = 14 * len({result["genotype"] for result in expected}) + 30  # each body once
    assert sum(device["rollouts_done"] for device in shown["items"]) == computed
    assert all(
        device["state"] == "working" and device["error"] is None and device["capability"] == "9.0"
        for device in shown["items"])
    metrics = service.request("GET", "/metrics").body.decode()
    counts = re.findall(r'^morphod_device_rollouts_total\{device="(\d)"\} (\d+)$', metrics, re.M)
    assert [index for index, _ in counts] == ["0", "1"] and sum(int(n)
                                                                for _, n in counts) == computed
    assert float(
        re.search(r'^morphod_job_device_seconds_total\{kind="evaluation"\} (\S+)$', metrics,
                  re.M).group(1)) > 0


def test_suites(start):
    """Devices compute all tasks of a suite."""
    suite = {"designs": DESIGNS[:3], "environments": "morpho-12", "physics": {"n_steps": 100}}
    expected = run(start(), "evaluations", suite)["results"]
    ended = run(start(*FLAGS, environment=fake(devices=2)), "evaluations",
                {**suite, "device": "cuda"})
    assert ended["device"] == "cuda" and ended["results"] == expected
    assert len(expected[0]["tasks"]) == 12


def test_measures(start):
    """Devices measure: evaluations, and campaigns that select by a measure."""
    measured = {**LARGE, "measures": True}
    selecting = {**CAMPAIGN, "measures": ["work_j"],
                 "select_by": {"measure": "displacement_m", "direction": "max"}}
    plain, service = start(), start(*FLAGS, environment=fake(devices=2))
    taken = run(service, "evaluations", measured)
    assert taken["device"] == "cuda"
    assert taken["results"] == run(plain, "evaluations", measured)["results"]
    assert taken["results"][0]["measures"]["work_j"] > 0
    again = run(service, "evaluations", {**measured, "label": "again"})
    assert again["rollouts_cached"] == again["rollouts_total"] > 0
    assert again["results"] == taken["results"]
    ended = [run(on, "campaigns", selecting) for on in (plain, service)]
    assert [campaign["device"] for campaign in ended] == ["cpu", "cuda"]
    assert population(plain, ended[0]) == population(service, ended[1])


@pytest.mark.parametrize("integrator", ["paper", "split"])
def test_devices_compute_both_integrators(start, integrator):
    service = start(*FLAGS, environment=fake(devices=1))
    for kind, request in (("evaluations", LARGE), ("campaigns", CAMPAIGN), ("trainings", TRAINING)):
        asked = {**request, "physics": {**request["physics"], "integrator": integrator}}
        ended = run(service, kind, asked)
        assert (ended["state"], ended["device"]) == ("succeeded", "cuda"), kind
        assert f'"integrator": "{integrator}"' in json.dumps(ended), kind
    assert devices(service)["items"][0]["rollouts_done"] > 0


def test_devices_learn_every_objective(start):
    """Custom grids are all that devices refuse."""
    service = start(*FLAGS, environment=fake(devices=1))
    worlds = [{"task": {"guide": {"kind": "turning", "turn_rad_per_s": 1}, "objective": objective}}
              for objective in ("efficient", "jump", {"travel": 1, "work_j": -1e-5})]
    grid = {"terrain": {"kind": "grid", "spacing_m": 1, "heights_m": [[0, 0], [0, 0]]}}
    few_shot = {**CAMPAIGN, "mode": "few-shot", "generations": 1, "population": 8}
    training = {**TRAINING, "validation": {"every_steps": 3, "designs": 4}}
    for kind, request in (("trainings", training), ("campaigns", few_shot)):
        ended = run(service, kind, {**request, "environments": worlds, "device": "cuda"})
        assert (ended["state"], ended["device"]) == ("succeeded", "cuda"), ended
        asked = {**request, "environments": [*worlds, {**worlds[1], **grid}], "device": "cuda"}
        assert "terrains of kind" in refused(service, kind, asked)


@pytest.fixture(scope="module")
def undisturbed():
    """The results of the jobs on one device."""
    service = Service(*FLAGS, environment=fake())
    campaign = run(service, "campaigns", CAMPAIGN)
    training = run(service, "trainings", TRAINING)
    result = {
        "population": population(service, campaign), "controller": training["controller"]["sha256"]
    }
    assert campaign["device"] == "cuda" and training["device"] == "cuda" and len(
        result["population"]) == 24
    assert service.close() == 0
    return result


@pytest.mark.parametrize(
    "more",
    [{"devices": 2}, {"devices": 4}, {"devices": 2, "rows": 17}, {"devices": 2, "lose": "1:3"}])
def test_same_results(start, undisturbed, more):
    service = start(*FLAGS, environment=fake(**more))
    assert population(service, run(service, "campaigns", CAMPAIGN)) == undisturbed["population"]
    assert run(service, "trainings", TRAINING)["controller"]["sha256"] == undisturbed["controller"]
    states = [device["state"] for device in devices(service)["items"]]
    assert states == (["working", "lost"] if "lose" in more else ["working"] * more["devices"])
    assert ("a device was lost" in service.log_text()) == ("lose" in more)


def test_the_last_device_is_lost(start, undisturbed, tmp_path):
    state, trigger = tmp_path / "state", tmp_path / "lose"
    service = start(*FLAGS, state=state, environment=fake(delay_ms=20, lose_if=trigger))
    jobs = [("campaigns", service.post("/v1/campaigns", {**CAMPAIGN, "generations": 4})["id"]),
            ("trainings", service.post("/v1/trainings", TRAINING)["id"]),
            ("evaluations", service.post("/v1/evaluations",
                                         {**LARGE, "physics": {"n_steps": 100}})["id"])]
    until(lambda: any(device["calls"] > 1 for device in devices(service)["items"]))
    trigger.touch()
    for kind, job in jobs:
        paused = await_state(service, f"/v1/{kind}/{job}", "paused", "succeeded")
        if paused["state"] == "paused":
            assert paused["error"]["code"] == "device" and "fallen off its bus" in paused["error"][
                "detail"]
            assert kind == "evaluations" or "fallen off its bus" in paused["reason"]
            assert paused["attempts"] == 0
    assert await_state(service, f"/v1/campaigns/{jobs[0][1]}", "paused")["device"] == "cuda"
    assert devices(service)["items"][0]["state"] == "lost"
    assert run(service, "evaluations",
               {"designs": DESIGNS[:2], "physics": SHORT})["state"] == "succeeded"
    assert run(service, "evaluations", {**LARGE, "physics": {"n_steps": 3}})["device"] == "cpu"
    refused(service, "campaigns", {**CAMPAIGN, "device": "cuda"})
    shown = show(service)
    assert shown.returncode == 3 and "lost" in shown.stdout and "fallen off its bus" in shown.stderr
    assert service.act(jobs[0][1], "resume").status == 200  # too early
    await_state(service, f"/v1/campaigns/{jobs[0][1]}", "paused")
    assert service.stop() == 0
    without = start(state=state)  # the jobs wait for devices
    assert without.act(jobs[0][1], "resume").status == 200
    paused = await_state(without, f"/v1/campaigns/{jobs[0][1]}", "paused")
    assert "the service has none" in paused["reason"]
    assert without.stop() == 0
    trigger.unlink()
    service = start(*FLAGS, state=state, environment=fake(devices=2))
    for kind, job in jobs:
        if service.get(f"/v1/{kind}/{job}")["state"] == "paused":
            assert service.act(job, "resume").status == 200
    check_results(service, jobs, undisturbed)


def test_want_of_memory(start, undisturbed, tmp_path):
    """Not enough memory for the smallest part: jobs wait, paused, and continue when there is
    more."""
    state = tmp_path / "state"
    service = start(*FLAGS, state=state, environment=fake(rows=9, shards=0))
    jobs = []
    for kind, request in (("campaigns", CAMPAIGN), ("trainings", TRAINING),
                          ("evaluations", {**LARGE, "physics": {"n_steps": 9}})):
        job = run(service, kind, {**request, "device": "cuda"})
        assert job["state"] == "paused" and job["attempts"] == 0
        assert job["error"]["code"] == "device" and "enough memory" in job["error"]["detail"]
        assert "resume" in job["error"]["detail"]
        jobs.append((kind, job["id"]))
    assert service.stop() == 0
    service = start(*FLAGS, state=state, environment=fake(devices=2))
    assert all(service.act(job, "resume").status == 200 for _, job in jobs)
    check_results(service, jobs, undisturbed)


def test_kill(start, undisturbed, tmp_path):
    """The service is killed repeatedly, with a different number of devices each time."""
    state, jobs = tmp_path / "state", []
    for attempt in range(5):
        service = start(*FLAGS, state=state, environment=fake(devices=1 + attempt % 3, delay_ms=15))
        if not jobs:
            jobs = [(kind, service.post(f"/v1/{kind}", request)["id"])
                    for kind, request in (("campaigns", CAMPAIGN), ("trainings", TRAINING))]
        time.sleep(0.1 + 0.07 * attempt)
        service.stop(signal.SIGKILL)
    service = start(*FLAGS, state=state, environment=fake(devices=2))
    for _, job in jobs:  # three processes that saved nothing stop the job: a user resumes it
        if service.get(f"/v1/jobs/{job}")["state"] == "failed":
            assert service.act(job, "resume").status in (200, 202)
    check_results(service, jobs, undisturbed)


def test_cancel(start):
    service = start(*FLAGS, environment=fake())
    job = service.post("/v1/campaigns", {**CAMPAIGN, "physics": {"n_steps": 1000000}})["id"]
    until(lambda: devices(service)["items"][0]["busy"])
    assert service.act(job, "cancel").status == 200
    until(lambda: not devices(service)["items"][0]["busy"])


def test_interactive_evaluations_do_not_wait_for_devices(start):
    """A cancelled job does not wait even for a rollout that is already on a device."""
    service = start(*FLAGS, environment=fake(delay_ms=60000))
    large = service.post("/v1/evaluations", {**LARGE, "device": "cuda"})["id"]
    until(lambda: devices(service)["items"][0]["busy"])
    small = service.evaluate({"designs": DESIGNS[:3], "physics": SHORT}).json()
    assert small["state"] == "succeeded" and small["device"] == "cpu" and small[
        "rollouts_cached"] == 0
    assert service.get(f"/v1/jobs/{large}")["rollouts_done"] == 0
    assert service.act(large, "cancel").status == 200


class Cluster:
    """A service without devices, and workers that have some."""

    def __init__(self, start, state):
        self.service = start("--devices=none", "--fleet-listen=127.0.0.1:0", state=state)
        self.fleet, self.workers = Workers(self.service), []

    def launch(self, **more):
        self.workers.append(Worker(f"http://{self.fleet.host}:{self.fleet.port}", *FLAGS,
                                   f"--name=gpu-{len(self.workers)}", environment=fake(**more)))
        return self.workers[-1]

    def until_there(self, n):
        until(lambda: (self.fleet.status()["classes"]["device"] or {}).get("sessions") == n)

    def waiting(self, kind, job):
        """Returns the reason of a job that waits for workers with devices."""
        def waits(shown):
            return shown["state"] == "running" and (shown["reason"] or "").startswith(
                'waiting for a worker of class "fake float32 score-1 sm90"')
        awaited(self.service, f"/v1/{kind}/{job}", waits)

    def close(self):
        for worker in self.workers:
            worker.close()


@pytest.fixture
def cluster(start, tmp_path):
    cluster = Cluster(start, tmp_path / "state")
    yield cluster
    cluster.close()


def test_only_workers_have_devices(cluster, start, undisturbed, tmp_path):
    """Their class is known once the first one joins. Jobs of this class wait for them, even after a
    restart, and end with the same bits as a service with a device."""
    service = cluster.service
    for kind, request in (("evaluations", LARGE), ("campaigns", CAMPAIGN)):
        reply = service.request("POST", f"/v1/{kind}", {**request, "device": "cuda"})
        assert reply.status == 422 and "no worker with devices has joined" in reply.body.decode()
    assert cluster.fleet.status()["classes"]["device"] is None
    worker = cluster.launch()
    cluster.until_there(1)
    assert devices(service) == {"items": [], "fingerprints": {
        "scores": "fake float32 score-1 sm90", "gradients": "fake float32 gradient-1 sm90"}}
    # Large work stays on the processors unless devices are requested.
    assert run(service, "evaluations", {**LARGE, "physics": {"n_steps": 3}})["device"] == "cpu"
    done = run(service, "evaluations", {**LARGE, "device": "cuda"})
    assert done["state"] == "succeeded" and done["device"] == "cuda"
    measured = run(service, "evaluations", {**LARGE, "device": "cuda", "measures": ["work_j"]})
    assert measured["state"] == "succeeded" and measured["device"] == "cuda"
    assert all(result["measures"]["work_j"] > 0 for result in measured["results"])
    design = service.get(f"/v1/designs/{done['results'][0]['id']}")
    by_device, = [score for score in design["orientations"][0]["scores"]
                  if score["fingerprint"] == "fake float32 score-1 sm90"]
    assert by_device["origin"].startswith("gpu-0@")
    # Devices in another class are not served, nor is a wrong canary.
    cluster.launch(code="other-2")
    until(lambda: cluster.fleet.status()["n_sessions"] == 2)
    cluster.until_there(1)
    offer = cluster.fleet.offer()
    offer["classes"] = {"device": devices(service)["fingerprints"] | {"canary": "0" * 64}}
    cluster.fleet.refuses(409, "the canary of class", "POST", "/v1/fleet/sessions",
                          json.dumps(offer), Content_Type="application/json")
    assert worker.stop() == 0
    cluster.until_there(0)
    jobs = [(kind, service.post(f"/v1/{kind}", {**request, "device": "cuda"})["id"])
            for kind, request in (("campaigns", CAMPAIGN), ("evaluations", {
                **LARGE, "physics": {"n_steps": 21}}))]
    for kind, job in jobs:
        cluster.waiting(kind, job)
    assert service.stop() == 0
    cluster = Cluster(start, tmp_path / "state")
    try:
        service = cluster.service
        for kind, job in jobs:
            cluster.waiting(kind, job)
        dropped = service.post("/v1/evaluations", {**LARGE, "physics": {"n_steps": 22},
                                                   "device": "cuda"})["id"]
        cluster.waiting("evaluations", dropped)
        assert service.act(dropped, "cancel").status == 200
        assert await_state(service, f"/v1/evaluations/{dropped}", "cancelled")
        cluster.launch(springs=300)  # the service computes larger bodies on its processors
        ended = [await_state(service, f"/v1/{kind}/{job}", "succeeded") for kind, job in jobs]
        assert population(service, ended[0]) == undisturbed["population"]
    finally:
        cluster.close()


@pytest.mark.parametrize("kind", ["trainings", "campaigns"])
def test_only_workers_learn(cluster, start, kind):
    """Shards of gradients go to the devices of workers, and one worker is killed. The sums have the
    same bits as those of a service with a device."""
    requests = {"trainings": {**TRAINING, "batch": 1100, "validation": {"every_steps": 0}},
                "campaigns": {**CAMPAIGN, "mode": "few-shot", "name": "learned", "learning": {
                    "parent_steps": 1, "child_steps": 1, "batch": 1100}, "generations": 1}}
    request = {**requests[kind], "device": "cuda", "physics": {"n_steps": 4}}
    alone = run(start(*FLAGS, environment=fake()), kind, request)
    workers = [cluster.launch(delay_ms=delay_ms) for delay_ms in (0, 3000)]
    cluster.until_there(2)
    # Workers accept no urgent work, so these jobs run like any others there.
    job = cluster.service.post(f"/v1/{kind}", {**request, "priority": "interactive"})["id"]
    until(lambda: any(one["leases"] for one in cluster.fleet.status()["sessions"]
                      if one["name"] == "gpu-1"))
    workers[1].process.kill()
    ended = await_state(cluster.service, f"/v1/{kind}/{job}", "succeeded")
    if kind == "trainings":
        assert ended["controller"] == alone["controller"] and ended["code"] == alone["code"]
        assert workers[0].stop() == 0
        job = cluster.service.post("/v1/trainings", {**request, "name": "second"})["id"]
        cluster.waiting("trainings", job)
        assert cluster.service.act(job, "cancel").status == 200
        await_state(cluster.service, f"/v1/trainings/{job}", "cancelled")
    else:
        assert ended["result"]["controller"]["sha256"] == alone["result"]["controller"]["sha256"]


def test_a_gradient_that_devices_of_workers_do_not_support(cluster, start):
    """The processors of the service compute all of it."""
    request = {**TRAINING, "validation": {"every_steps": 0}}
    alone = run(start(), "trainings", request)
    cluster.launch(springs=30)
    cluster.until_there(1)
    ended = run(cluster.service, "trainings", {**request, "device": "cuda"})
    assert ended["device"] == "cuda" and ended["code"] == alone["code"]


def test_known_keys_are_answered_without_devices(start, tmp_path):
    state = tmp_path / "state"
    requests = [(kind, {**request, "device": "cuda"}, {"Idempotency-Key": kind})
                for kind, request in (("evaluations", LARGE), ("trainings", TRAINING), ("campaigns",
                                                                                        CAMPAIGN))]
    service = start(*FLAGS, state=state, environment=fake())
    ids = [
        service.post(f"/v1/{kind}", request, headers=key)["id"] for kind, request, key in requests
    ]
    assert service.stop() == 0
    service = start(state=state)
    for known, (kind, request, key) in zip(ids, requests):
        again = service.request("POST", f"/v1/{kind}", request, headers=key)
        assert again.status == 202 and again.json()["id"] == known, again.body
        refused = service.request("POST", f"/v1/{kind}", request)
        assert refused.status == 422
        assert "the service has no devices; request" in refused.body.decode()


def test_another_code_is_reported(start, tmp_path):
    """A training run that continues under another version of the module reports it."""
    state = tmp_path / "state"
    service = start(*FLAGS, state=state, environment=fake(delay_ms=300))
    job = service.post("/v1/trainings", {**TRAINING, "checkpoint": {"every_steps": 1}})["id"]
    until(lambda: service.get(f"/v1/trainings/{job}")["progress"]["step"] >= 1)
    assert service.stop() == 0
    service = start(*FLAGS, state=state, environment=fake(code="version-2"))
    ended = await_state(service, f"/v1/trainings/{job}", "succeeded")
    assert [code["fingerprint"] for code in ended["code"]
            ] == ["fake float32 gradient-1 sm90", "fake float32 version-2 sm90"]


def test_a_gradient_that_devices_do_not_support(start):
    """The processors compute all of it, and the training run reports it."""
    plain = start()
    expected = run(plain, "trainings", {**TRAINING, "validation": {"every_steps": 0}})
    service = start(*FLAGS, environment=fake(springs=30))
    training = run(service, "trainings",
                   {**TRAINING, "validation": {"every_steps": 0}, "name": "other"})
    assert training["device"] == "cuda" and training["code"] == expected["code"]
    assert training["code"][0]["fingerprint"].startswith("cpu ")
    steps = [
        service.get(f"/v1/trainings/{job['id']}/steps")["items"]
        for service, job in ((plain, expected), (service, training))
    ]
    assert [step["mean_loss"] for step in steps[0]] == [step["mean_loss"] for step in steps[1]]


def test_devices_learn_tasks(start):
    """A training run with tasks, profiles or damage runs on devices."""
    service = start(*FLAGS, environment=fake())
    light = {"light_xy_m": [4, 2.5], "terrain_sigma_m": 0.05, "seed": 1}
    quiet = {**TRAINING, "validation": {"every_steps": 0}}
    for worlds in ({"environments": [light, {"task": "walk"}]},
                   {"environments": "morpho-12-up"},
                   {"environments": [{**light, "damage": {"octant": 3, "time_s": 0.01}}]},
                   {"environments": [light] * 3}, {"tasks": ["photo", "climb"]}):
        for device in ("cuda", "auto"):
            done = run(service, "trainings", quiet | worlds | {"device": device})
            assert done["state"] == "succeeded" and done["device"] == "cuda"


def test_stored_scores_say_who_computed_them(start):
    """This includes bodies of a campaign that its devices do not support."""
    service = start(*FLAGS, environment=fake(springs=300))
    campaign = run(service, "campaigns", {**CAMPAIGN, "generations": 2})
    assert campaign["device"] == "cuda" and campaign["state"] == "succeeded"
    sizes = set()
    for item in service.get(f"/v1/campaigns/{campaign['id']}/population?limit=1000")["items"]:
        shown = service.get(f"/v1/designs/{item['id']}")
        body = next(body for body in shown["orientations"] if body["genotype"] == item["genotype"])
        is_large = item["springs"] > 300
        assert body["scores"][0]["fingerprint"].startswith("cpu " if is_large else "fake ")
        sizes.add(is_large)
    assert sizes == {False, True}


@pytest.mark.parametrize(
    "flags, environment, words",
    [(FLAGS, {"abi": 99}, "a different version of this program"),
     ((f"--compute-module={MODULE}", "--devices=0,3"), {"devices": 2}, "device 3 does not exist"),
     ((f"--compute-module={MODULE}", "--devices=1"), {"devices": 2, "shut": 1
                                                      }, "device 1 cannot be used"),
     ((f"--compute-module={MODULE}", "--devices=0,1"), {"devices": 2, "older": 1},
      "device 1 cannot be used: its compute capability is 8.0"),
     (("--compute-module=/no/such/module.so", "--devices=auto"), {}, "/no/such/module.so"),
     (("--devices=many", ), {}, "must be auto, none, or a device number")])
def test_refused_at_the_start(flags, environment, words):
    with pytest.raises(RuntimeError) as failure:
        Service(*flags, environment=fake(**environment))
    assert words in str(failure.value)


def test_without_what_auto_looks_for(start):
    service = start(f"--compute-module={MODULE}", "--devices=auto", environment=fake(devices=0))
    assert service.log_text().count("no devices found; using the CPU") == 1
    assert devices(service)["items"] == []
    service = start(*FLAGS, environment=fake(devices=2, full=0))  # others use all of its memory
    assert [device["index"] for device in devices(service)["items"]
            ] == [1] and "a device was lost" in service.log_text()
    service = start(f"--compute-module={MODULE}", "--devices=1", environment=fake(devices=2))
    assert [device["index"] for device in devices(service)["items"]] == [1]
    shown = show(service)
    assert shown.returncode == 0 and "Fake device" in shown.stdout and "FAKE-1" in shown.stdout
