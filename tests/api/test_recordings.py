"""Space for recordings: they are deleted on request, and new ones replace the oldest."""

import ast
import math
import struct

import pytest

from service import DESIGN, SHORT, until

VOXEL = {"cells": [[0, 0, 0]]}
RECORDED = {
    "designs": [VOXEL], "physics": {"n_steps": 100}, "record": ["masses"], "record_stride": 10
}
BYTES = 8 * 12 * 11 * 10  # 8 masses, 11 frames, 10 environments


def first(service, evaluation):
    return service.request("GET", f"/v1/evaluations/{evaluation['id']}/trajectories/0")


def test_recordings_are_deleted(service):
    evaluation = service.evaluate(RECORDED).json()
    path = f"/v1/evaluations/{evaluation['id']}"
    before = service.request("GET", path)
    assert before.json()["recorded_bytes"] == BYTES
    assert before.json()["recordings_removed_at"] is None
    track = first(service, evaluation).json()["masses_m"]
    reply = service.request("DELETE", path + "/trajectories")
    assert reply.status == 200
    assert reply.json() == {"evaluation": evaluation["id"], "bytes": BYTES}
    for below in ("", "/file", "?format=scene"):
        gone = service.request("GET", path + "/trajectories/0" + below)
        assert gone.status == 410 and "POST /v1/rollouts" in gone.json()["detail"]
    after = service.request("GET", path, headers={"If-None-Match": before.headers["ETag"]})
    assert after.status == 200
    assert after.json()["results"] == before.json()["results"], "scores stay"
    assert after.json()["recorded_bytes"] == 0 and after.json()["recordings_removed_at"]
    assert service.request("DELETE", path + "/trajectories").json()["bytes"] == 0
    event = service.get(f"/v1/events?format=json&job={evaluation['id']}")["items"][-1]
    assert event["type"] == "evaluation.recordings_removed"
    assert event["data"] == {"id": evaluation["id"], "bytes": BYTES, "reason": "request"}
    # The same motion can be recomputed, as the detail promises.
    again = service.request("POST", "/v1/rollouts",
                            RECORDED | {"designs": [{"voxels": evaluation["results"][0]["genotype"]}
                                                    ]},
                            headers={"Accept": "application/vnd.morphod.scene"})
    flat = [number for frame in track for point in frame for number in point]
    assert struct.pack(f"<{len(flat)}f", *flat) in again.body


def array_of(reply):
    """Returns shape, type and numbers of a .npy file."""
    assert reply.status == 200 and reply.body[:8] == b"\x93NUMPY\x01\x00"
    start = 10 + int.from_bytes(reply.body[8:10], "little")
    header = ast.literal_eval(reply.body[10:start].decode())
    assert start % 64 == 0 and header["fortran_order"] is False
    size, letter = {"<f8": (8, "d"), "<f4": (4, "f"), "|i1": (1, "b"), "|u1": (1, "B")}[
        header["descr"]]
    count = math.prod(header["shape"])
    assert len(reply.body) == start + size * count
    return header["shape"], struct.unpack_from(f"<{count}{letter}", reply.body, start)


def test_all_recordings_as_one_array(service):
    """The array has each rollout, padded for the smaller design with values that no recording
    contains."""
    channels = {"com": None, "masses": 60, "actuation": 78, "contacts": 20}
    evaluation = service.evaluate({"designs": [DESIGN, VOXEL], "physics": SHORT,
                                   "record": list(channels), "record_stride": 5}).json()
    path = f"/v1/evaluations/{evaluation['id']}/trajectories"
    for channel, side in channels.items():
        shape, numbers = array_of(service.tagged(f"{path}?array={channel}"))
        side = side or 3
        assert shape[:3] == (2, 10, 5) and math.prod(shape[3:]) == side
        for n, k in ((0, 0), (0, 7), (1, 0), (1, 9)):
            shown = service.get(f"{path}/{n}?environment={k}")
            frames = shown[{"com": "com_m", "masses": "masses_m"}.get(channel, channel)]
            for f, frame in enumerate(frames):
                own = [x for point in frame for x in point] if channel == "masses" else frame
                row = numbers[((n * 10 + k) * 5 + f) * side:][:side]
                assert list(row[:len(own)]) == pytest.approx(own, rel=1e-7 * (channel == "masses"))
                rest = {"masses": "nan", "actuation": "-128", "contacts": "255"}.get(channel)
                assert {str(x) for x in row[len(own):]} == ({rest} if n and rest else set())
    assert array_of(service.request("GET", path))[0] == (2, 10, 5, 20, 3)
    service.refuses(path, "?array=none", "?environment=1")
    assert service.request("DELETE", path).status == 200
    assert service.request("GET", path).status == 410
    plain = service.evaluate({"designs": [DESIGN], "physics": SHORT}).json()["id"]
    for unknown in (plain, "999999"):
        assert service.request("GET", f"/v1/evaluations/{unknown}/trajectories").status == 404


def test_what_cannot_be_deleted(service):
    """Recordings from which an evaluation will continue stay."""
    running = service.post("/v1/evaluations", RECORDED | {
        "priority": "batch", "precision": "float64", "physics": {"n_steps": 200000},
        "record_stride": 200000})
    path = f"/v1/evaluations/{running['id']}/trajectories"
    reply = service.request("DELETE", path)
    assert reply.status == 409 and "has not ended" in reply.json()["detail"]
    assert service.request("GET", path).status == 409
    assert service.act(running["id"], "cancel").status in (200, 202)
    assert service.request("DELETE", path).status == 200
    plain = service.evaluate({"designs": [DESIGN], "physics": SHORT}).json()["id"]
    none = service.request("DELETE", f"/v1/evaluations/{plain}/trajectories")
    assert none.status == 200 and none.json()["bytes"] == 0
    for unknown in ("999999", "x"):
        assert service.request("DELETE", f"/v1/evaluations/{unknown}/trajectories").status == 404


def test_the_oldest_give_way(start, tmp_path):
    """Three recordings fit into the budget, and two after a restart with a smaller one."""
    budget = ("--max-recorded=16K", "--max-recordings=32K")
    running = start(*budget, state=tmp_path)
    evaluations = [running.evaluate(RECORDED | {"label": str(n)}).json() for n in range(5)]
    until(lambda: running.metric("morphod_recordings_removed_total") == 2)
    assert running.metric("morphod_recordings_removed_bytes_total") == 2 * BYTES
    until(lambda: running.metric("morphod_recordings_bytes") == 3 * BYTES)
    assert [first(running, one).status for one in evaluations] == [410, 410, 200, 200, 200]
    events = [event for event in running.get("/v1/events?format=json")["items"]
              if event["type"] == "evaluation.recordings_removed"]
    assert [event["job"] for event in events] == [one["id"] for one in evaluations[:2]]
    assert {event["data"]["reason"] for event in events} == {"budget"}
    assert running.stop() == 0
    log = running.log_text()
    assert log.count("evaluation.recordings_removed") == 2 and f"bytes={BYTES}" in log
    smaller = start("--max-recorded=16K", "--max-recordings=24K", state=tmp_path)
    until(lambda: smaller.metric("morphod_recordings_bytes") == 2 * BYTES)
    assert [first(smaller, one).status for one in evaluations] == [410, 410, 410, 200, 200]


def test_no_budget(start):
    """With a budget of 0 nothing is removed. A budget smaller than the recordings of one evaluation
    is raised."""
    for budget in ("0", "1K"):
        running = start("--max-recorded=32K", f"--max-recordings={budget}")
        evaluations = [running.evaluate(RECORDED).json() for _ in range(3)]
        until(lambda: running.metric("morphod_recordings_bytes") == 3 * BYTES)
        assert [first(running, one).status for one in evaluations] == [200] * 3
        assert running.stop() == 0
