"""Campaigns whose controller records its pretraining: how they report the bodies that they
exclude."""

import json
import re
import signal
import subprocess
import time

from ctl import MORPHOCTL
from service import BOOTSTRAP, await_end, awaited, run, soon, until, with_metadata

HERE = [{"light_xy_m": [4.0, 2.5], "terrain_sigma_m": 0.05, "seed": 7}]
SMALL = {
    "mode": "zero-shot", "population": 8, "generations": 1, "environments": HERE,
    "physics": {"n_steps": 30}
}


def put(service, name, **said):
    """Stores the bootstrap controller with further metadata; returns its SHA-256."""
    more = {f"morphod.{key}": value for key, value in said.items()}
    reply = service.upload(name, with_metadata(BOOTSTRAP.read_bytes(), **more))
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
    shown = [event["data"] for event in events if event["type"] == "campaign.lineage_unreadable"]
    assert [(data["id"], data["controller"], data["field"])
            for data in shown] == [(id, digits, "morphod.seed"), (id, digits, "morphod.step")]
    lines = [line for line in service.log_text().splitlines()
             if "campaign.lineage_unreadable" in line]
    assert len(lines) == 2 and "morphod.seed" in lines[0]
    assert all("warning" in line.lower() and digits in line for line in lines)


def test_a_drawing_is_reported_and_handed_over(start):
    service = start()
    total = 1024 * 200000
    put(service, "long", **pretrained(200000))
    first = submit(service, controller="long", workspace=[3, 3, 2])
    drawn = awaited(service, f"/v1/campaigns/{first}",
                    lambda seen: seen["progress"]["seconds_left"] is not None)
    second = submit(service, controller="long", workspace=[3, 3, 2])  # now either may begin
    waits = awaited(service, f"/v1/campaigns/{second}",
                    lambda seen: seen["progress"]["seconds_left"] is not None)
    for seen in (drawn, waits):
        assert seen["state"] == "running" and seen["phase"] == "preparing", seen
        assert 0 < seen["progress"]["done"] < seen["progress"]["total"] == total
        assert seen["newest"] is None and seen["progress"]["seconds_left"] > 1
    assert drawn["reason"] is None
    assert f"waiting for campaign {first}, which is redrawing" in waits["reason"]
    job = service.get(f"/v1/jobs/{second}")
    assert job["state"] == "running" and job["reason"] == waits["reason"]
    waits = service.get(f"/v1/campaigns/{second}")
    assert service.act(first, "pause").status == 200
    draws = awaited(service, f"/v1/campaigns/{second}", lambda seen: seen["reason"] is None)
    assert draws["phase"] == "preparing" and draws["progress"]["done"] >= waits["progress"]["done"]
    assert service.act(first, "resume").status == 200
    waits = awaited(service, f"/v1/campaigns/{first}", lambda seen: seen["reason"] is not None)
    assert f"waiting for campaign {second}, which is redrawing" in waits["reason"]
    assert waits["progress"]["done"] >= draws["progress"]["done"]
    with soon():
        for id in (second, first):
            assert service.act(id, "cancel").status == 200
            awaited(service, f"/v1/campaigns/{id}", lambda seen: seen["phase"] == "idle")


def pieces(events, kind):
    return [event["data"] for event in events if event["type"] == kind]


def test_the_first_campaign_shows_how_far_it_is(start):
    """In events, once per second, and in morphoctl without a terminal."""
    service = start()
    put(service, "long", **pretrained(200000))
    id = submit(service, controller="long", workspace=[3, 3, 2])

    def reported():
        items = service.get(f"/v1/events?format=json&job={id}&after=0&limit=100")["items"]
        return pieces(items, "campaign.progress")

    until(lambda: len(reported()) >= 2)
    for data in reported():
        assert data["phase"] == "preparing" and data["generation"] == 0
        assert data["total"] == 1024 * 200000
    assert 0 < reported()[0]["done"] < reported()[1]["done"]
    watched = subprocess.Popen([MORPHOCTL, "campaign", "watch", id], stdout=subprocess.PIPE,
                               text=True, env={"MORPHOD_SERVER": service.addresses[0]})
    try:
        for line in watched.stdout:
            if "preparing" in line:
                break
    finally:
        watched.kill()
        watched.communicate()
    assert re.search(r"preparing [\d,]+ of 204,800,000 pretraining bodies  \S.* until they "
                     r"are drawn", line), line
    assert service.act(id, "cancel").status == 200


def test_the_bodies_are_drawn_once(start, tmp_path):
    """The second campaign finds them in the state folder, and has the same bits as the first one,
    which was killed while it was writing the file."""
    state = tmp_path / "state"
    service = start(state=str(state))
    put(service, "once", **pretrained(300))
    id = submit(service, controller="once", seed=5)
    for _ in range(2):
        until(lambda: any((state / "excluded").glob("*")), every=0.0002)
        service.stop(signal.SIGKILL)
        service = start(state=str(state))
        assert not list((state / "excluded").glob(".tmp*"))
    first = await_end(service, f"/v1/campaigns/{id}", 300).json()
    assert first["state"] == "succeeded", first
    made, = (state / "excluded").glob("*.forms")
    inode = made.stat().st_ino
    assert made.stat().st_size < 300 * 1024 * 22
    begun = time.monotonic()
    again = run(service, "campaigns", SMALL | {"controller": "once", "seed": 5})
    print(f"{time.monotonic() - begun:.2f} s")
    assert made.stat().st_ino == inode
    one, other = (service.get(f"/v1/campaigns/{number}/phylogeny?limit=100")
                  for number in (id, again["id"]))
    assert len(one["items"]) == 16 and one["items"] == other["items"]
