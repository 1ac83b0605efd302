"""Campaigns whose controller says what it was pretrained on: how the bodies of it that are left out
are told of."""

import json
import struct
import time

from service import BOOTSTRAP, awaited, run

HERE = [{"light_xy_m": [4.0, 2.5], "terrain_sigma_m": 0.05, "seed": 7}]
SMALL = {
    "mode": "zero-shot", "population": 8, "generations": 1, "environments": HERE,
    "physics": {"n_steps": 30}
}


def put(service, name, **said):
    """Stores the bootstrap controller with further metadata; returns its SHA-256."""
    file = BOOTSTRAP.read_bytes()
    size = struct.unpack("<Q", file[:8])[0]
    header = json.loads(file[8:8 + size])
    header["__metadata__"].update({f"morphod.{key}": value for key, value in said.items()})
    text = json.dumps(header).encode()
    reply = service.upload(name, struct.pack("<Q", len(text)) + text + file[8 + size:])
    assert reply.status == 201, reply.body
    return reply.json()["sha256"]


def pretrained(steps, seed="31"):
    return {
        "kind": "pretrain", "parent": "random", "seed": seed, "step": str(steps),
        "settings": json.dumps({"batch": 1024}, separators=(",", ":"))
    }


def submit(service, **fields):
    return service.post("/v1/campaigns", {**SMALL, **fields})["id"]


def test_a_lineage_that_cannot_be_read(start):
    service = start()
    digits = put(service, "odd", **pretrained("many", seed="none"))
    done = run(service, "campaigns", SMALL | {"controller": "odd"})
    assert done["progress"]["generation"] == 1
    id = done["id"]
    events = service.get(f"/v1/events?format=json&job={id}&after=0&limit=100")["items"]
    told = [event["data"] for event in events if event["type"] == "campaign.lineage_unreadable"]
    assert [(data["id"], data["controller"], data["field"])
            for data in told] == [(id, digits, "morphod.seed"), (id, digits, "morphod.step")]
    lines = [line for line in service.log_text().splitlines()
             if "campaign.lineage_unreadable" in line]
    assert len(lines) == 2 and "morphod.seed" in lines[0]
    assert all("warning" in line.lower() and digits in line for line in lines)


def test_a_drawing_is_told_and_handed_over(start):
    service = start()
    total = 1024 * 200000
    put(service, "long", **pretrained(200000))
    first = submit(service, controller="long", workspace=[3, 3, 2])
    drawn = awaited(service, f"/v1/campaigns/{first}",
                    lambda seen: seen["progress"]["seconds_left"] is not None)
    second = submit(service, controller="long", workspace=[3, 3, 2])  # not before: either may begin
    waits = awaited(service, f"/v1/campaigns/{second}",
                    lambda seen: seen["progress"]["seconds_left"] is not None)
    for seen in (drawn, waits):
        assert seen["state"] == "running" and seen["phase"] == "preparing", seen
        assert 0 < seen["progress"]["done"] < seen["progress"]["total"] == total
        assert seen["newest"] is None and seen["progress"]["seconds_left"] > 1
    assert drawn["reason"] is None and f"campaign {first} draws" in waits["reason"]
    job = service.get(f"/v1/jobs/{second}")
    assert job["state"] == "running" and job["reason"] == waits["reason"]
    waits = service.get(f"/v1/campaigns/{second}")
    assert service.act(first, "pause").status == 200
    draws = awaited(service, f"/v1/campaigns/{second}", lambda seen: seen["reason"] is None)
    assert draws["phase"] == "preparing" and draws["progress"]["done"] >= waits["progress"]["done"]
    assert service.act(first, "resume").status == 200
    waits = awaited(service, f"/v1/campaigns/{first}", lambda seen: seen["reason"] is not None)
    assert f"campaign {second} draws" in waits["reason"]
    assert waits["progress"]["done"] >= draws["progress"]["done"]
    begun = time.monotonic()
    for id in (second, first):
        assert service.act(id, "cancel").status == 200
        awaited(service, f"/v1/campaigns/{id}", lambda seen: seen["phase"] == "idle")
    assert time.monotonic() - begun < 10
