"""Evaluations: submission, waiting, results, idempotency, recordings, verification; jobs and
designs that come of them."""

import json
import math
import socket
import struct
import threading
import time

import pytest

from service import DESIGN, SHORT, await_end

BATCH = [{"cells": [[x, y, 0], [x, y, 1], [(x + 1) % 6, y, 0]]} for x in range(5) for y in range(6)]


def test_one_design(service):
    reply = service.evaluate({"designs": [DESIGN]})
    assert reply.status == 200 and reply.headers["Preference-Applied"] == "wait=30"
    value = reply.json()
    result = value["results"][0]
    assert value["state"] == "succeeded" and value["rollouts_total"] == 10 == value["rollouts_done"]
    assert len(result["losses"]) == 10 and result["diverged"] == []
    assert math.isclose(result["score"], sum(result["losses"]) / 10, rel_tol=1e-12)
    assert 0 < result["score"] < 1.5
    assert reply.headers["Location"] == f"/v1/evaluations/{value['id']}"
    assert service.request("GET", reply.headers["Location"]).json() == value


def test_accepted_then_polled(service):
    reply = service.request("POST", "/v1/evaluations",
                            {"designs": [DESIGN], "physics": {"n_steps": 37}, "label": "réglage"})
    assert reply.status == 202 and "results" not in reply.json()
    done = await_end(service, reply.headers["Location"])
    assert done.json()["label"] == "réglage" and len(done.json()["results"]) == 1
    again = service.request("GET",
                            reply.headers["Location"],
                            headers={"If-None-Match": done.headers["ETag"]})
    assert again.status == 304 and again.body == b""
    assert service.request("GET", reply.headers["Location"],
                           headers={"If-None-Match": '"other"'}).status == 200


def test_forms_of_a_design_agree(service):
    first = service.evaluate({"designs": [DESIGN], "physics": SHORT}).json()["results"][0]
    value = service.evaluate({
        "designs": [{"voxels": first["genotype"]},
                    {"cells": [[x + 1, y + 1, z] for x, y, z in DESIGN["cells"]]},
                    {"id": first["id"]}], "physics": SHORT
    }).json()
    assert value["results"][0] == first and value["results"][1] == first
    assert value["results"][2]["id"] == first["id"]
    assert value["rollouts_cached"] >= 10


def test_own_environments_order_and_float64(service):
    environments = [{"light_xy_m": [4.5, 2.5], "terrain_heights_m": [0.05] * 64}, {
        "light_xy_m": [2.5, 4.0], "terrain_sigma_m": 0.05, "seed": 3
    }, {"light_xy_m": [1, 1], "terrain_heights_m": [0.01 * (i % 8) for i in range(64)]}]
    request = {
        "designs": [DESIGN, BATCH[3]], "environments": environments, "physics": {"n_steps": 100},
        "precision": "float64"
    }
    forward = service.evaluate(request).json()
    assert forward["environments"] == {"count": 3} and forward["precision"] == "float64"
    backward = service.evaluate(
        dict(request, designs=request["designs"][::-1], environments=environments[::-1])).json()
    for a, b in zip(forward["results"], backward["results"][::-1]):
        assert a["id"] == b["id"] and a["losses"] == b["losses"][::-1]


def test_physics_are_echoed(service):
    physics = {
        "dt_s": 0.002, "n_steps": 30, "stiffness_n_per_m": 12000, "mass_kg": 1.5, "drag_per_s": 10,
        "gravity_m_per_s2": 9.81, "actuation": 0.1, "friction": 0.8, "friction_cap": 0.9,
        "drop_height_m": 0.01, "impact": "bisection8"
    }
    assert service.evaluate({"designs": [DESIGN], "physics": physics}).json()["physics"] == physics


def test_divergence_is_told(service):
    value = service.evaluate({"designs": [DESIGN], "physics": {"dt_s": 0.05,
                                                               "n_steps": 500}}).json()
    result = value["results"][0]
    assert value["state"] == "succeeded" and value["rollouts_diverged"] == 10
    assert result["score"] is None and result["losses"] == [None] * 10
    assert [fault["environment"] for fault in result["diverged"]] == list(range(10))


def test_scores_are_not_computed_twice(service):
    request = {"designs": [BATCH[0]], "physics": {"n_steps": 55}}
    first = service.evaluate(request).json()
    second = service.evaluate(request).json()
    assert first["rollouts_cached"] == 0 and second["rollouts_cached"] == 10 and second[
        "id"] != first["id"]
    assert second["results"] == first["results"]


def test_minus_zero_is_zero(service):
    """Environments that are equal are one, however their zeros are written."""
    place = {"designs": [DESIGN], "physics": {"n_steps": 21}}
    first = service.evaluate(
        {**place, "environments": [{"light_xy_m": [0, 1], "terrain_heights_m": [0] * 64}]}).json()
    again = service.evaluate(
        {**place, "environments": [{"light_xy_m": [-0.0, 1],
                                    "terrain_heights_m": [-0.0] * 64}]}).json()
    assert again["rollouts_cached"] == 1
    assert again["results"] == first["results"]


def test_verify(service):
    request = {"designs": [BATCH[1]], "physics": {"n_steps": 56}}
    fresh = service.evaluate(dict(request, verify=True)).json()["results"][0]
    assert fresh["stored_losses"] == [None] * 10 and fresh["agrees"] is None
    stored = service.evaluate(request).json()["results"][0]
    value = service.evaluate(dict(request, verify=True)).json()
    result = value["results"][0]
    assert value["rollouts_cached"] == 0
    assert result[
        "agrees"] is True and result["losses"] == stored["losses"] == result["stored_losses"]


def test_batch(service):
    reply = service.request("POST", "/v1/evaluations", {"designs": BATCH, "physics": SHORT})
    assert reply.json()["priority"] == "batch" and reply.json()["n_designs"] == 30
    results = await_end(service, reply.headers["Location"]).json()["results"]
    alone = service.evaluate({"designs": [BATCH[7]], "physics": SHORT}).json()["results"][0]
    assert len(results) == 30 and results[7] == alone
    assert service.evaluate({"designs": [BATCH[7]], "physics": SHORT,
                             "priority": "batch"}).json()["priority"] == "batch"


def test_idempotency(service):
    request = {"designs": [DESIGN], "physics": {"n_steps": 23}}
    key = {"Idempotency-Key": '"key-one"'}
    first = service.request("POST", "/v1/evaluations", request, headers=key)
    second = service.request("POST",
                             "/v1/evaluations",
                             request,
                             headers={"Idempotency-Key": "key-one"})
    assert first.status == second.status == 202 and first.json()["id"] == second.json()["id"]
    other = service.request("POST", "/v1/evaluations", dict(request, label="other"), headers=key)
    assert other.status == 422 and other.json()["errors"][0]["header"] == "Idempotency-Key"
    for bad in ("", '""', "k" * 256, '"a', "a\tb"):
        assert service.request("POST", "/v1/evaluations", request,
                               headers={"Idempotency-Key": bad
                                        }).status in ((202, ) if bad == '"a' else (400, )), bad


def test_idempotency_under_a_race(service):
    request = {"designs": [DESIGN], "physics": {"n_steps": 24}}
    ids = []
    threads = [
        threading.Thread(target=lambda: ids.append(
            service.request("POST", "/v1/evaluations", request, headers={"Idempotency-Key": "race"})
            .json()["id"])) for _ in range(16)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(ids) == 16 and len(set(ids)) == 1


@pytest.mark.parametrize("prefer", ["wait", "wait=-1", "wait=1.5", "wait=soon"])
def test_bad_prefer(service, prefer):
    reply = service.request("POST",
                            "/v1/evaluations", {"designs": [DESIGN]},
                            headers={"Prefer": prefer})
    assert reply.status == 400 and reply.json()["errors"][0]["header"] == "Prefer"


def test_short_wait_gives_202(service):
    many = [{
        "cells": [[x, y, z] for x in range(6) for y in range(5 + d % 2) for z in range(1 + d % 3)]
    } for d in range(60)]
    reply = service.evaluate({"designs": many, "physics": {"n_steps": 200000}}, wait=1)
    assert reply.status == 202 and reply.json()["state"] in ("queued", "running")
    begun = time.monotonic()
    got = service.request("GET", reply.headers["Location"], headers={"Prefer": "wait=1"})
    assert got.status == 200 and 0.8 < time.monotonic() - begun < 3 and got.headers["Retry-After"]
    cancelled = service.request("POST", "/v1/jobs/" + reply.json()["id"] + "/cancel")
    assert cancelled.status == 200
    assert await_end(service, reply.headers["Location"]).json()["state"] == "cancelled"


def test_clients_that_left_do_not_wait(start):
    """Those who hang up while they wait do not go on waiting."""
    running = start()
    paused = running.request("POST", "/v1/evaluations",
                             {"designs": [DESIGN], "physics": {"n_steps": 1000000}}).json()["id"]
    assert running.request("POST", f"/v1/jobs/{paused}/pause").json()["state"] == "paused"
    request = (f"GET /v1/jobs/{paused} HTTP/1.1\r\nHost: localhost\r\n"
               "Prefer: wait=60\r\n\r\n").encode()
    waiting = [socket.create_connection((running.host, running.port)) for _ in range(4)]
    for sock in waiting:
        sock.sendall(request)
    deadline = time.monotonic() + 10
    while b"morphod_http_requests_in_flight 5\n" not in running.request(
            "GET", "/metrics").body:  # with this one
        assert time.monotonic() < deadline
        time.sleep(0.1)
    for sock in waiting:
        sock.close()
    while b"morphod_http_requests_in_flight 1\n" not in running.request("GET", "/metrics").body:
        assert time.monotonic() < deadline
        time.sleep(0.1)
    assert running.request("POST", f"/v1/jobs/{paused}/cancel").status == 200


def test_recording(service):
    value = service.evaluate({
        "designs": [DESIGN], "physics": {"n_steps": 100}, "record": ["com", "masses"],
        "record_stride": 25
    }).json()
    path = f"/v1/evaluations/{value['id']}/trajectories/0"
    whole = service.request("GET", path + "?environment=3").json()
    assert whole["frames"] == 5 == len(whole["com_m"]) == len(
        whole["masses_m"]) and whole["stride"] == 25
    assert whole["environment"] == 3 and len({len(frame) for frame in whole["masses_m"]}) == 1
    center = [
        sum(point[axis] for point in whole["masses_m"][2]) / len(whole["masses_m"][2])
        for axis in range(3)
    ]
    assert all(math.isclose(a, b, abs_tol=1e-4) for a, b in zip(center, whole["com_m"][2]))
    binary = service.request("GET", path + "/file?environment=3")
    shape = [int(size) for size in binary.headers["Morphod-Shape"].split(",")]
    numbers = struct.unpack(f"<{math.prod(shape)}f", binary.body)
    assert binary.headers["Morphod-Array"] == "masses" and shape == [
        5, len(whole["masses_m"][0]), 3
    ]
    flat = [number for frame in whole["masses_m"] for point in frame for number in point]
    assert all(struct.pack("<f", a) == struct.pack("<f", b) for a, b in zip(flat, numbers))
    com = service.request("GET", path + "/file?environment=3&array=com")
    assert com.headers["Morphod-Shape"] == "5,3"
    again = service.request(
        "GET",
        path + "/file?environment=3",
        headers={"If-None-Match": binary.headers["ETag"]})
    assert again.status == 304
    for bad, status in (("?environment=10", 404), ("?environment=64", 400), ("?environment=x", 400),
                        ("/file?array=pose", 400), ("?array=com", 400), ("/file?environment=10",
                                                                         404)):
        assert service.request("GET", path + bad).status == status, bad
    assert service.request("GET", path[:-1] + "1").status == 404
    assert service.request("GET", path[:-1] + "x").status == 404
    assert service.request("GET", path, headers={"Accept": "text/csv"}).status == 406
    assert service.request("GET", path + "/file",
                           headers={"Accept": "application/json"}).status == 406


def test_not_recorded(service):
    value = service.evaluate({"designs": [DESIGN], "physics": SHORT}).json()
    assert service.request("GET", f"/v1/evaluations/{value['id']}/trajectories/0").status == 404
    value = service.evaluate(
        {"designs": [DESIGN], "physics": SHORT, "record": ["com"], "record_stride": 5}).json()
    assert service.request(
        "GET", f"/v1/evaluations/{value['id']}/trajectories/0/file?array=masses").status == 404


def test_jobs_list_and_pages(service):
    ids = [service.evaluate({"designs": [DESIGN], "physics": SHORT}).json()["id"] for _ in range(5)]
    seen, cursor = [], ""
    while cursor is not None:
        page = service.request("GET",
                               "/v1/jobs?limit=2" + (f"&cursor={cursor}" if cursor else "")).json()
        assert len(page["items"]) <= 2
        seen += [job["id"] for job in page["items"]]
        cursor = page["next_cursor"]
    assert seen == sorted(seen, key=int,
                          reverse=True) and set(ids) <= set(seen) and len(seen) == len(set(seen))
    states = service.request("GET",
                             "/v1/jobs?state=succeeded&kind=evaluation&limit=1000").json()["items"]
    assert {job["state"] for job in states} == {"succeeded"}
    page = service.request("GET", "/v1/jobs?limit=3")
    assert service.request("GET",
                           "/v1/jobs?limit=3",
                           headers={"If-None-Match": page.headers["ETag"]}).status == 304
    assert service.request("GET", f"/v1/jobs/{ids[0]}").json()["id"] == ids[0]
    assert service.request("GET", f"/v1/jobs/{ids[0]}?x=1").status == 400


def test_list(service):
    """Evaluations have a list as the other kinds of jobs have: without results."""
    ids = [
        service.evaluate({"designs": [DESIGN], "physics": SHORT, "label": "of a list"}).json()["id"]
        for _ in range(3)
    ]
    page = service.request("GET", "/v1/evaluations?label=of%20a%20list&limit=2").json()
    assert [one["id"] for one in page["items"]] == ids[:0:-1] and "results" not in page["items"][0]
    rest = service.request(
        "GET", f"/v1/evaluations?label=of%20a%20list&limit=2&cursor={page['next_cursor']}").json()
    assert [one["id"] for one in rest["items"]] == ids[:1] and rest["next_cursor"] is None
    assert page["items"][0] == service.request("GET", f"/v1/jobs/{ids[2]}").json()
    assert service.request("GET", "/v1/evaluations?state=failed").json()["items"] == []
    for bad in ("?state=lost", "?kind=training", "?limit=0", "?cursor=x"):
        assert service.request("GET", "/v1/evaluations" + bad).status == 400, bad


def test_pause_resume_cancel(service):
    body = {
        "designs": [{"cells": [[x, 0, 0] for x in range(6)]}] + BATCH,
        "physics": {"n_steps": 200000}, "priority": "batch"
    }
    job = service.request("POST", "/v1/evaluations", body).json()
    path = f"/v1/jobs/{job['id']}"
    assert service.request("POST", path + "/pause").json()["state"] == "paused"
    assert service.request("POST", path + "/pause").status == 200
    assert service.request("GET", "/v1/jobs?state=paused").json()["items"][0]["id"] == job["id"]
    assert service.request("POST", path + "/resume").json()["state"] in ("queued", "running")
    assert service.request("POST", path + "/cancel").status == 200
    assert service.request("GET", path).json()["state"] == "cancelled"
    assert service.request("DELETE", path).status == 405
    for change in ("/cancel", "/pause", "/resume"):
        assert service.request("POST", path + change).status == 409
        assert service.request("POST", "/v1/jobs/123456789" + change).status == 404


def test_designs(service):
    result = service.evaluate({"designs": [BATCH[9]]}).json()["results"][0]
    reply = service.request("GET", "/v1/designs/" + result["id"])
    design = reply.json()
    assert design["voxels"] == 3 and design["masses"] == 16
    scores = {
        orientation["genotype"]: orientation["scores"]
        for orientation in design["orientations"]
    }
    stored = [
        score for score in scores[result["genotype"]]
        if score["environments"] == "paper-test" and score["score"] == result["score"]
    ]
    assert stored and stored[0]["losses"] == result["losses"] and "float32" in stored[0][
        "fingerprint"]
    assert service.request("GET",
                           "/v1/designs/" + result["id"],
                           headers={"If-None-Match": reply.headers["ETag"]}).status == 304
    assert service.request("GET",
                           "/v1/designs/" + result["id"].upper()).json()["id"] == result["id"]
    for sort in ("id", "score"):
        seen, cursor = [], ""
        while cursor is not None:
            page = service.request(
                "GET", f"/v1/designs?sort={sort}&limit=4" +
                (f"&cursor={cursor}" if cursor else "")).json()
            seen += page["items"]
            cursor = page["next_cursor"]
        assert result["id"] in {row["id"] for row in seen}
        if sort == "score":
            numbers = [row["score"] for row in seen if row["score"] is not None]
            assert numbers == sorted(numbers) and result["score"] in numbers
        else:
            assert len({row["id"] for row in seen}) == len(seen)
    assert service.request("GET", "/v1/designs?sort=score&controller=nobody").status == 404


def test_everything_survives_a_restart(start, tmp_path):
    first = start(state=tmp_path)
    reply = first.evaluate({"designs": BATCH[:5], "physics": SHORT})
    open_job = first.request("POST",
                             "/v1/evaluations", {"designs": BATCH, "physics": {"n_steps": 1500}},
                             headers={"Idempotency-Key": "again"}).json()
    assert first.stop() == 0, first.log_text()
    second = start(state=tmp_path)
    assert second.request("GET", reply.headers["Location"]).json() == reply.json()
    same = second.request("POST",
                          "/v1/evaluations", {"designs": BATCH, "physics": {"n_steps": 1500}},
                          headers={"Idempotency-Key": "again"})
    assert same.json()["id"] == open_job["id"]
    assert await_end(second, same.headers["Location"]).json()["state"] == "succeeded"
    assert second.evaluate({"designs": BATCH[:5],
                            "physics": SHORT}).json()["results"] == reply.json()["results"]
    events = second.request("GET", f"/v1/events?format=json&job={open_job['id']}").json()["items"]
    assert [event["type"]
            for event in events][0] == "job.created" and events[-1]["type"] == "job.finished"
    json.dumps(events)


FULL = {"voxels": "1" * 144}


def test_interactive_is_short(service):
    """Interactive work overtakes all else, so what takes long is not, whatever was asked for."""
    def priority(**more):
        reply = service.request("POST", "/v1/evaluations", {
            "environments": [{"light_xy_m": [4.5, 2.5], "terrain_sigma_m": 0.01, "seed": 1}], **more
        })
        assert reply.status in (200, 202), reply.body
        job = reply.headers["Location"].replace("evaluations", "jobs")
        assert service.request("POST", job + "/cancel").status in (200, 202, 409)
        return reply.json()["priority"]

    assert priority(designs=[FULL], physics={"n_steps": 1001}) == "interactive"
    assert priority(designs=[FULL], physics={"n_steps": 1001}, priority="batch") == "batch"
    assert priority(designs=[DESIGN], physics={"n_steps": 100000},
                    priority="interactive") == "interactive"
    assert priority(designs=[FULL], physics={"n_steps": 100000}, priority="interactive") == "batch"
    assert priority(designs=[FULL], physics={"n_steps": 100000}) == "batch"
    assert priority(designs=BATCH, physics={"n_steps": 1000000}, priority="interactive") == "batch"
    assert priority(designs=[FULL], physics={"n_steps": 15000},
                    precision="float32") == "interactive"
    assert priority(designs=[FULL], physics={"n_steps": 15000}, precision="float64") == "batch"


def test_pausing_frees_the_workers(start):
    """A block of 16 environments and a million steps takes minutes: a pause breaks it off, as a
    cancellation does."""
    running = start("--workers=1")
    environments = [{"light_xy_m": [4.5, 2.5], "terrain_sigma_m": 0.01, "seed": k}
                    for k in range(16)]
    reply = running.request(
        "POST", "/v1/evaluations",
        {"designs": [FULL], "environments": environments, "physics": {"n_steps": 1000000}})
    assert reply.status == 202
    job = reply.headers["Location"].replace("evaluations", "jobs")
    await_state = time.monotonic() + 30
    while running.request("GET", "/v1/threads").json()["n_busy"] == 0 or running.request(
            "GET", job).json()["state"] != "running":
        assert time.monotonic() < await_state
        time.sleep(0.05)
    assert running.request("POST", job + "/pause").status in (200, 202)
    other = running.request("POST", "/v1/evaluations",
                            {"designs": [DESIGN], "physics": SHORT, "priority": "batch"})
    until = time.monotonic() + 60
    while running.request("GET", other.headers["Location"]).json()["state"] != "succeeded":
        assert time.monotonic() < until, "the paused evaluation holds the worker"
        time.sleep(0.1)
    assert running.request("GET", job).json()["state"] == "paused"
    assert running.request("POST", job + "/cancel").status in (200, 202)
