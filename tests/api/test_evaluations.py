"""Evaluations: results, waiting, recordings, verification, and the designs that they store."""

import math
import socket
import struct

import pytest

from service import DESIGN, SHORT, Service, await_end, awaited, run, until

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
        "dt_s": 0.002, "n_steps": 30, "control_period_s": 0.008, "stiffness_n_per_m": 12000,
        "mass_kg": 1.5, "drag_per_s": 10, "gravity_m_per_s2": 9.81, "actuation": 0.1,
        "friction": 0.8, "friction_cap": 0.9, "drop_height_m": 0.01, "impact": "bisection8",
        "integrator": "split"
    }
    assert service.evaluate({"designs": [DESIGN], "physics": physics}).json()["physics"] == physics


def test_integrators(service):
    """Each integrator has its own scores. The default is split."""
    def evaluate(**physics):
        request = {"designs": [DESIGN], "physics": {"n_steps": 57, **physics}}
        value = service.evaluate(request).json()
        assert value == service.get(f"/v1/evaluations/{value['id']}")
        rolled = service.post("/v1/rollouts", request)
        losses = value["results"][0]["losses"]
        assert [rollout["loss"] for rollout in rolled["rollouts"]] == losses
        assert rolled["physics"] == value["physics"]
        return value["physics"]["integrator"], losses, value["rollouts_cached"], value["results"][0]

    word, split, _, result = evaluate()
    assert word == "split" and evaluate(integrator="split")[:3] == ("split", split, 10)
    word, paper, cached, _ = evaluate(integrator="paper")
    assert word == "paper" and cached == 0
    assert all(a != b for a, b in zip(paper, split))
    assert evaluate(integrator="paper")[:3] == ("paper", paper, 10)

    known = service.get(f"/v1/designs/{result['id']}")
    scores = [score for orientation in known["orientations"] for score in orientation["scores"]]
    stored = [service.get(f"/v1/physics/{score['physics']}")["physics"] for score in scores]
    assert {one["integrator"] for one in stored if one["n_steps"] == 57} == {"paper", "split"}

    request = {"designs": [DESIGN], "physics": {"integrator": "split", "drag_per_s": 700}}
    refused = service.request("POST", "/v1/evaluations", request)
    assert refused.status == 422 and "drag_per_s times dt_s" in refused.json()["detail"]
    request = {"designs": [DESIGN], "physics": {"integrator": "euler"}}
    fault = service.request("POST", "/v1/evaluations", request).json()["errors"][0]
    assert fault["pointer"] == "/physics/integrator"
    assert fault["detail"] == 'must be "paper" or "split", got "euler"'


def test_divergence_is_reported(service):
    wild = {"integrator": "paper", "dt_s": 0.05, "n_steps": 500, "control_period_s": 0.05}
    value = service.evaluate({"designs": [DESIGN], "physics": wild}).json()
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
    """Equal environments are the same one, however their zeros are written."""
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
    job = service.post("/v1/evaluations", {"designs": BATCH, "physics": SHORT})
    assert job["priority"] == "batch" and job["n_designs"] == 30
    results = await_end(service, f"/v1/evaluations/{job['id']}").json()["results"]
    alone = service.evaluate({"designs": [BATCH[7]], "physics": SHORT, "priority": "batch"}).json()
    assert len(results) == 30 and results[7] == alone["results"][0]
    assert alone["priority"] == "batch"


@pytest.mark.parametrize("prefer", ["wait", "wait=-1", "wait=5.5", "wait=soon"])
def test_what_prefer_does_not_say_is_ignored(service, prefer):
    reply = service.request("POST", "/v1/evaluations", {"designs": [DESIGN]},
                            headers={"Prefer": prefer})
    assert reply.status == 202 and "Preference-Applied" not in reply.headers


def test_short_wait_gives_202(service):
    reply = service.evaluate({"designs": BATCH, "physics": {"n_steps": 1000000}}, wait=1)
    assert reply.status == 202 and reply.json()["state"] in ("queued", "running")
    assert service.act(reply.json()["id"], "cancel").status == 200


def test_clients_that_left_do_not_wait(start):
    """Requests stop waiting when their client hangs up."""
    running = start()
    paused = running.post("/v1/evaluations",
                          {"designs": [DESIGN], "physics": {"n_steps": 1000000}})["id"]
    assert running.act(paused, "pause").json()["state"] == "paused"
    request = (f"GET /v1/jobs/{paused} HTTP/1.1\r\nHost: localhost\r\n"
               "Prefer: wait=60\r\n\r\n").encode()
    waiting = [socket.create_connection((running.host, running.port)) for _ in range(4)]
    for sock in waiting:
        sock.sendall(request)
    in_flight = "morphod_http_requests_in_flight"
    until(lambda: running.metric(in_flight) == 5)  # including this request
    for sock in waiting:
        sock.close()
    until(lambda: running.metric(in_flight) == 1)
    assert running.act(paused, "cancel").status == 200


def test_recording(service):
    value = service.evaluate({
        "designs": [DESIGN], "physics": {"n_steps": 100}, "record": ["com", "masses"],
        "record_stride": 25
    }).json()
    path = f"/v1/evaluations/{value['id']}/trajectories/0"
    whole = service.get(path + "?environment=3")
    masses = whole["masses_m"]
    assert whole["frames"] == 5 == len(whole["com_m"]) == len(masses) and whole["stride"] == 25
    assert whole["environment"] == 3 and len({len(frame) for frame in masses}) == 1
    center = [sum(axis) / len(axis) for axis in zip(*masses[2])]
    assert all(math.isclose(a, b, abs_tol=1e-4) for a, b in zip(center, whole["com_m"][2]))
    binary = service.tagged(path + "/file?environment=3")
    shape = [int(size) for size in binary.headers["Morphod-Shape"].split(",")]
    assert binary.headers["Morphod-Array"] == "masses" and shape == [5, len(masses[0]), 3]
    flat = [number for frame in masses for point in frame for number in point]
    assert struct.pack(f"<{math.prod(shape)}f", *flat) == binary.body
    com = service.request("GET", path + "/file?environment=3&array=com")
    assert com.headers["Morphod-Shape"] == "5,3"
    service.refuses(path, "?environment=64", "?environment=x", "/file?array=pose", "?array=com")
    service.refuses(path, "?environment=10", "/file?environment=10", status=404)
    service.refuses(path[:-1], "1", "x", status=404)
    for below, media in (("", "text/csv"), ("/file", "application/json")):
        assert service.request("GET", path + below, headers={"Accept": media}).status == 406


def test_recorded_channels(service):
    value = service.evaluate({
        "designs": [DESIGN], "physics": {"n_steps": 60}, "record": ["contacts", "actuation"],
        "record_stride": 20
    }).json()
    assert value["record"] == ["actuation", "contacts"]
    path = f"/v1/evaluations/{value['id']}/trajectories/0"
    whole = service.get(path)
    assert "com_m" not in whole and "masses_m" not in whole
    body = service.get(f"/v1/designs/{value['results'][0]['genotype']}/body")
    for name, parts, low, form in (("actuation", "springs", -127, "b"),
                                   ("contacts", "masses", 0, "B")):
        rows = whole[name]
        assert len(rows) == 4 and {len(row) for row in rows} == {len(body[parts])}
        assert not any(rows[0]) and any(rows[-1])
        assert all(low <= number <= (-low or 1) for row in rows for number in row)
        file = service.request("GET", f"{path}/file?array={name}")
        assert file.body == struct.pack(f"{sum(map(len, rows))}{form}", *sum(rows, []))
    assert service.request("GET", path + "/file").headers["Morphod-Array"] == "actuation"
    service.refuses(path, "/file?array=masses", status=404)


def test_not_recorded(service):
    request = {"designs": [DESIGN], "physics": SHORT}
    for more, below in (({}, ""), ({"record": ["com"], "record_stride": 5}, "/file?array=masses")):
        id = service.evaluate(request | more).json()["id"]
        service.refuses(f"/v1/evaluations/{id}/trajectories/0", below, status=404)


@pytest.fixture(scope="module")
def few():
    """A daemon with few designs, for tests that read the whole list design by design."""
    running = Service()
    bars = [{"cells": [[2, y, 0] for y in range(n)]} for n in range(1, 7)]
    run(running, "evaluations", {"designs": bars})
    yield running
    assert running.close() == 0, running.log_text()


def test_designs(few):
    service = few
    result = service.evaluate({"designs": [BATCH[9]]}).json()["results"][0]
    path = "/v1/designs/" + result["id"]
    design = service.tagged(path).json()
    assert design["voxels"] == 3 and design["masses"] == 16
    assert service.get("/v1/designs/" + result["id"].upper()) == design
    form = next(one for one in design["orientations"] if one["genotype"] == result["genotype"])
    stored, = (score for score in form["scores"]
               if score["environments"] == "paper-test" and score["score"] == result["score"])
    assert stored["losses"] == result["losses"] and "float32" in stored["fingerprint"]
    by_id, by_score = (service.pages(f"/v1/designs?sort={sort}", 1) for sort in ("id", "score"))
    assert len({row["id"] for row in by_id}) == len(by_id)
    assert result["id"] in {row["id"] for row in by_id} & {row["id"] for row in by_score}
    numbers = [row["score"] for row in by_score if row["score"] is not None]
    assert numbers == sorted(numbers) and result["score"] in numbers
    service.refuses("/v1/designs", "?sort=score&controller=nobody", status=404)


def test_the_first_thousand_rollouts(start):
    """Designs beyond them do not show a partial score, because it would look like a lower bound."""
    service = start()
    design = {"cells": [[1, 1, 0]]}
    lights = [{"light_xy_m": [3 + 0.001 * k, 3], "terrain_sigma_m": 0, "seed": k}
              for k in range(1000)]
    for n, shown in ((995, 995), (1000, 1000)):
        for first in range(0 if n == 995 else 995, n, 60):
            run(service, "evaluations", {"designs": [design], "physics": {"n_steps": 1},
                                         "environments": lights[first:min(first + 60, n)]})
        if n == 995:
            id = run(service, "evaluations", {"designs": [design], "physics": {"n_steps": 2}})[
                "results"][0]["id"]
        value = service.get(f"/v1/designs/{id}")
        scores = [score for one in value["orientations"] for score in one["scores"]]
        assert value["truncated"] and len(scores) == shown
        assert not any(score["lower_bound"] for score in scores)


@pytest.mark.parametrize("sort", ("id", "score"))
def test_designs_from_the_other_end(few, sort):
    """The pages equal the whole list: newest first, or worst first."""
    service = few
    path = f"/v1/designs?sort={sort}&order="
    ascending = service.pages(path + "ascending")
    assert len(ascending) > 3 and ascending == service.pages(f"/v1/designs?sort={sort}")
    for limit in (1, 2, 1000):
        assert service.pages(path + "descending", limit) == ascending[::-1]


def test_everything_survives_a_restart(start, tmp_path):
    first = start(state=tmp_path)
    reply = first.evaluate({"designs": BATCH[:5], "physics": SHORT})
    request = {"designs": BATCH, "physics": {"n_steps": 1500}}
    key = {"Idempotency-Key": "again"}
    id = first.post("/v1/evaluations", request, headers=key)["id"]
    assert first.stop() == 0, first.log_text()
    second = start(state=tmp_path)
    assert second.get(reply.headers["Location"]) == reply.json()
    assert second.post("/v1/evaluations", request, headers=key)["id"] == id
    assert await_end(second, f"/v1/evaluations/{id}").json()["state"] == "succeeded"
    again = second.evaluate({"designs": BATCH[:5], "physics": SHORT}).json()
    assert again["results"] == reply.json()["results"]
    types = [event["type"] for event in second.get(f"/v1/events?format=json&job={id}")["items"]]
    assert types[0] == "job.created" and types[-1] == "job.finished"


FULL = {"voxels": "1" * 144}
PLACES = [{"light_xy_m": [4.5, 2.5], "terrain_sigma_m": 0.01, "seed": k} for k in range(16)]


@pytest.mark.parametrize("request_, priority", [
    ({"designs": [FULL], "physics": {"n_steps": 1001}}, "interactive"),
    ({"designs": [FULL], "physics": {"n_steps": 1001}, "priority": "batch"}, "batch"),
    ({"designs": [DESIGN], "physics": {"n_steps": 100000}, "priority": "interactive"},
     "interactive"),
    ({"designs": [FULL], "physics": {"n_steps": 100000}, "priority": "interactive"}, "batch"),
    ({"designs": [FULL], "physics": {"n_steps": 100000}}, "batch"),
    ({"designs": BATCH, "physics": {"n_steps": 1000000}, "priority": "interactive"}, "batch"),
    *(({"designs": [FULL], "physics": physics, "precision": precision}, priority)
      for physics in ({"n_steps": 50000}, {"n_steps": 15000, "control_period_s": 0.002})
      for precision, priority in (("float32", "interactive"), ("float64", "batch")))])
def test_interactive_is_short(service, request_, priority):
    """Interactive work overtakes everything else, so long work is never interactive, whatever was
    requested."""
    job = service.post("/v1/evaluations", {"environments": PLACES[:1], **request_})
    service.withdraw(job["id"])
    assert job["priority"] == priority


def test_pausing_frees_the_workers(start):
    """A block of 16 environments and a million steps takes minutes: a pause stops it, as a
    cancellation does."""
    running = start("--workers=1")
    job = running.post("/v1/evaluations", {"designs": [FULL], "environments": PLACES,
                                           "physics": {"n_steps": 1000000}})["id"]
    awaited(running, f"/v1/jobs/{job}", lambda seen: seen["state"] == "running")
    awaited(running, "/v1/threads", lambda seen: seen["n_busy"])
    assert running.act(job, "pause").status in (200, 202)
    run(running, "evaluations", {"designs": [DESIGN], "physics": SHORT, "priority": "batch"})
    assert running.get(f"/v1/jobs/{job}")["state"] == "paused"
    assert running.act(job, "cancel").status in (200, 202)


# ---- designs that are not bodies ----

APART = [[0, 0, 0], [1, 0, 0], [3, 3, 0]]
MIXED = [
    {"cells": [[9, 0, 0]]}, DESIGN, {"voxels": "1"}, {"cells": APART}, {"cells": []},
    {"cells": [["x"] * 40], "unknown": [0] * 40}, DESIGN, "no object"
]


def test_faulty_designs_are_skipped(service):
    """Results are at the positions of the request, also in a job that verifies or records."""
    request = {"physics": SHORT, "on_fault": "skip", "repair": "largest", "designs": MIXED}
    plain = service.evaluate({"physics": SHORT, "designs": [DESIGN, {"cells": APART[:2]}]}).json()
    for more in ({}, {"verify": True}, {"record": ["com"]}):
        value = service.evaluate(dict(request, **more)).json()
        rows = value["results"]
        assert value["n_designs"] == len(MIXED) == len(rows) and value["n_skipped"] == 5
        assert value["rollouts_total"] == value["rollouts_done"] == 30
        assert [row["score"] for row in rows if row["fault"] is None] == [
            plain["results"][place]["score"] for place in (0, 1, 0)
        ]
        assert [row["fault"] and row["fault"]["pointer"] for row in rows] == [
            "/designs/0/cells/0/0", None, "/designs/2/voxels", None, "/designs/4/cells",
            "/designs/5/cells/0/0", None, "/designs/7"
        ]
        assert rows[3]["repaired"] == 1 and rows[3]["voxels"] == 2 and rows[3]["masses"] == 12
        assert rows[1]["footprint"] == 3 and rows[1]["springs"] > 24 and rows[1]["repaired"] == 0
        assert rows[0]["id"] is rows[0]["voxels"] is rows[0]["score"] is None
        assert rows[0]["losses"] == [None] * 10
    recorded = f"/v1/evaluations/{value['id']}/trajectories"
    assert service.request("GET", f"{recorded}/6?environment=9").json()["design"] == 6
    assert service.request("GET", f"{recorded}/3?format=scene").status == 200
    assert service.request("GET", f"{recorded}/0").status == 404
    assert service.request("GET", f"/v1/jobs/{value['id']}").json()["n_skipped"] == 5


def test_all_designs_are_skipped(service):
    value = service.evaluate({"on_fault": "skip", "designs": [MIXED[0]] * 3}).json()
    assert value["state"] == "succeeded" and value["rollouts_total"] == 0
    assert [row["fault"]["pointer"] for row in value["results"]] == [
        f"/designs/{place}/cells/0/0" for place in range(3)
    ]


def test_skipping_skips_no_other_fault(service):
    """The rules count even if they follow the designs. Faults elsewhere are refused."""
    refused = service.request("POST", "/v1/evaluations",
                              {"designs": MIXED, "on_fault": "leave"})
    assert refused.status == 422 and "/on_fault" in refused.pointers()
    assert "/designs/0/cells/0/0" in refused.pointers()
    refused = service.request("POST", "/v1/evaluations",
                              {"designs": MIXED, "physics": {"dt_s": 9}, "on_fault": "skip"})
    assert refused.pointers() == ["/physics/dt_s"]
    malformed = b'{"on_fault": "skip", "designs": [{"cells": [[0, 0, 0], [1,'
    assert service.request("POST", "/v1/evaluations", body=malformed).status == 400
    rolled = service.post("/v1/rollouts", {"designs": [{"cells": APART}], "physics": SHORT,
                                           "repair": "largest"})
    assert rolled["designs"][0]["repaired"] == 1
