"""Finetuning runs of bodies that are drawn from the whole ranking of an atlas."""

import hashlib
import json
import select

import pytest

from atlases import INFINITY, Plain, file_of
from ctl import ctl  # noqa: F401
from service import await_end, run, until

FROZEN = [4, 17, 48, 55, 68, 87, 111]  # places of the seed 1
FILE = {"Content-Type": "application/octet-stream"}
SHORT = {"kind": "finetune", "steps": 1, "batch": 2, "physics": {"n_steps": 20},
         "validation": {"environments": 1}}


def sampled(count, seed=1, name="sampled", **more):
    return SHORT | {"population": {"atlas": name, "count": count, "seed": seed}} | more


def put(service, name, data):
    reply = service.request("PUT", f"/v1/atlases/{name}/file", body=data, headers=FILE)
    assert reply.status in (200, 201), reply.body


@pytest.fixture(scope="module")
def plain(service):
    """An atlas with bodies of equal scores, and some that diverged."""
    data = file_of(levels=20)
    put(service, "sampled", data)
    plain = Plain(data)
    plain.ranked = [i for i in plain.order if plain.scores[i] < INFINITY]
    assert 0 < len(plain.ranked) < len(plain.order)
    return plain


def submitted(service, value):
    """Returns a training run after its submission, and withdraws it."""
    reply = service.request("POST", "/v1/trainings", value)
    assert reply.status == 202, reply.body
    job = reply.json()
    service.withdraw(job["id"])
    return job


def bodies_of(service, job):
    held_out = service.get(f"/v1/trainings/{job['id']}/held-out")
    return [service.post("/v1/bodies/canonical", {"designs": [design]})["items"][0]["id"]
            for design in held_out["designs"]]


def test_one_body_of_each_part(service, plain):
    n = len(plain.ranked)
    for count in (1, 7, n):
        for seed in (1, 2):
            job = submitted(service, sampled(count, seed, each=True))
            places = job["sample"]["places"]
            assert len(places) == count == job["settings"]["n_designs"]
            for i, place in enumerate(places):
                assert i * n // count <= place < (i + 1) * n // count
            expected = [plain.body(plain.ranked[place])["id"] for place in places]
            assert bodies_of(service, job) == expected
    assert places == list(range(n))


def test_the_draw(service, plain):
    """The same request gives the same bodies, in every version; another seed gives others."""
    draw = {seed: submitted(service, sampled(7, seed))["sample"]["places"] for seed in range(20)}
    assert draw[1] == submitted(service, sampled(7, 1))["sample"]["places"] == FROZEN
    assert len({tuple(places) for places in draw.values()}) > 15
    firsts = {places[0] for places in draw.values()}
    assert len(firsts) > 8 and max(firsts) > len(plain.ranked) / 7 / 2
    default = sampled(7)
    del default["population"]["seed"]
    assert submitted(service, default)["sample"]["places"] == FROZEN


def test_what_the_reply_says(service, plain):
    digest = hashlib.sha256(file_of(levels=20)).hexdigest()
    job = submitted(service, sampled(5, 3))
    population = {"atlas": "sampled", "count": 5, "seed": 3, "sha256": digest}
    assert job["settings"]["population"] == population
    places = job["sample"].pop("places")
    assert job["sample"] == {"bodies": len(plain.ranked),
                             "diverged": len(plain.order) - len(plain.ranked),
                             "orientations": "canonical", "environments": "paper-test",
                             "controller": plain.controller}
    again = submitted(service, SHORT | {"population": population})
    assert again["sample"]["places"] == places
    listed = service.get("/v1/trainings?limit=1")["items"][0]
    assert listed["settings"]["population"] == population and "sample" not in listed


def test_scores_are_those_of_the_atlas(service):
    """With its controller, environments and physics."""
    world = {"environments": "paper-test", "physics": {"n_steps": 30}}
    built = service.post("/v1/atlases", world | {"name": "own", "voxels": 4,
                                                 "orientations": "canonical"})
    assert await_end(service, f"/v1/jobs/{built['id']}").json()["state"] == "succeeded"
    request = SHORT | world | {"population": {"atlas": "own", "count": 6}, "each": True}
    del request["validation"]
    job = run(service, "trainings", request)
    rows = service.get(f"/v1/trainings/{job['id']}/each")["items"]
    assert [row["place"] for row in rows] == job["sample"]["places"]
    best = service.get("/v1/atlases/own/best")["items"]
    for row in rows:
        assert row["id"] == best[row["place"]]["id"]
        assert row["zero_shot"] == pytest.approx(best[row["place"]]["score"], rel=1e-6)
    lines = service.table(f"/v1/trainings/{job['id']}/each?format=csv")
    assert [int(line["place"]) for line in lines] == job["sample"]["places"]


def test_nothing_depends_on_the_atlas_later(service):
    put(service, "gone", file_of(levels=20))
    request = sampled(4, name="gone", each=True)
    headers = {"Idempotency-Key": "drawn from an atlas that is gone"}
    job = service.post("/v1/trainings", request, headers=headers)
    assert service.request("DELETE", "/v1/atlases/gone").status == 204
    assert await_end(service, f"/v1/trainings/{job['id']}").json()["state"] == "succeeded"
    done = service.get(f"/v1/trainings/{job['id']}")
    assert done["sample"] == job["sample"] and done["settings"] == job["settings"]
    rows = service.get(f"/v1/trainings/{job['id']}/each")["items"]
    assert [row["place"] for row in rows] == job["sample"]["places"]
    replayed = service.request("POST", "/v1/trainings", request, headers=headers)
    assert replayed.status == 202 and replayed.json()["id"] == job["id"]
    reply = service.request("POST", "/v1/trainings", request)
    assert reply.status == 422 and reply.pointers() == ["/population/atlas"]
    assert "does not exist" in reply.json()["detail"]


@pytest.mark.parametrize("population, pointers, said", [
    ({"atlas": "sampled"}, ["/population"], "count is missing"),
    ({"atlas": "sampled", "count": 0}, ["/population/count"], ""),
    ({"atlas": "sampled", "count": 10001}, ["/population/count"], ""),
    ({"atlas": "sampled", "count": 125}, ["/population/count"], "number of bodies"),
    ({"atlas": "sampled", "count": 2, "seed": -1}, ["/population/seed"], ""),
    ({"atlas": "sampled", "count": 2, "best": 1}, ["/population/best"], "cannot be combined"),
    ({"atlas": "sampled", "count": 2, "sha256": "A" * 64}, ["/population/sha256"], "lower case"),
    ({"atlas": "sampled", "count": 2, "evaluation": "1"},
     ["/population", "/population/evaluation"], "exactly one"),
    ({"atlas": "", "count": 2}, ["/population/atlas"], ""),
    ({"atlas": "../sampled", "count": 2}, ["/population/atlas"], "does not exist"),
    ({"atlas": "missing", "count": 2}, ["/population/atlas"], "does not exist"),
    ({"atlas": "sampled", "count": 2, "bodies": 3}, None, ""),
    ({"evaluation": "1", "count": 2}, ["/population", "/population/evaluation"],
     "only for an atlas"),
])
def test_refusals(service, plain, population, pointers, said):
    reply = service.request("POST", "/v1/trainings", SHORT | {"population": population})
    assert reply.status in (400, 422), reply.body
    if pointers is not None:
        assert reply.pointers() == pointers, reply.body
    assert said in reply.body.decode()


def test_refusals_of_other_kinds(service, plain):
    reply = service.request("POST", "/v1/trainings", sampled(3, controller="nobody"))
    assert reply.status == 422 and reply.pointers() == ["/controller"]
    reply = service.request("POST", "/v1/trainings", sampled(3, designs=[{"cells": [[0, 0, 0]]}]))
    assert reply.status == 422 and "both designs and population" in reply.body.decode()
    reply = service.request("POST", "/v1/certificates", {
        "population": {"atlas": "sampled", "count": 3}})
    assert reply.status == 422, reply.body


def test_an_atlas_that_is_being_built(service):
    job = service.post("/v1/atlases", {"name": "unfinished", "voxels": 9})["id"]
    reply = service.request("POST", "/v1/trainings", sampled(3, name="unfinished"))
    assert reply.status == 409 and reply.pointers() == ["/population/atlas"]
    assert f"job {job} builds it" in reply.json()["detail"]
    service.withdraw(job)


def test_another_file(service, plain):
    put(service, "replaced", file_of(levels=20))
    job = submitted(service, sampled(3, name="replaced"))
    put(service, "replaced", file_of(levels=20, seed=2))
    reply = service.request("POST", "/v1/trainings",
                            SHORT | {"population": job["settings"]["population"]})
    assert reply.status == 409 and reply.pointers() == ["/population/atlas"]
    assert "another file" in reply.json()["detail"]


def test_a_damaged_file(start):
    service = start()
    data = bytearray(file_of(levels=20))
    data[-20] ^= 1
    (service.state / "atlases" / "damaged.atlas").write_bytes(data)
    reply = service.request("POST", "/v1/trainings", sampled(3, name="damaged"))
    assert reply.status == 409 and "cannot be used" in reply.json()["detail"]


def test_morphoctl(service, plain, ctl):  # noqa: F811
    short = "--steps 1 --batch 2 -p n_steps=20 --validation-environments 1"
    start = f"train start finetune {short}"
    code, out, said = ctl(f"{start} --atlas sampled --count 4 --atlas-seed 3 --each")
    assert code == 0, said
    id = service.get("/v1/trainings?limit=1")["items"][0]["id"]
    await_end(service, f"/v1/trainings/{id}")
    shown = ctl(f"train show {id}")[1]
    assert "atlas sampled, seed 3" in shown and f"{len(plain.ranked)} bodies ranked" in shown
    assert f"{len(plain.order) - len(plain.ranked)} without a score left out" in shown
    table = ctl(f"train each {id}")[1]
    assert "place" in table
    for wrong in ("--atlas sampled", "--count 3", "--atlas sampled --count 3 --population 1",
                  "--atlas sampled --count 3 --random 2"):
        assert ctl(f"{start} {wrong}")[0] == 2
    assert ctl("train start pretrain --atlas sampled --count 3")[0] == 2
    code, _, said = ctl(f"{start} --atlas sampled --count 200")
    assert code != 0 and "number of bodies" in said


def test_draws_delay_no_other_request(start):
    """A draw reads and ranks all bodies, so it has the threads of lists, not those of the rest."""
    service = start()
    put(service, "large", file_of(voxels=9))
    job = service.post("/v1/trainings", sampled(2, name="large"))["id"]
    # They are refused, but only after the draw.
    refused = json.dumps(sampled(2, name="large", steps=1_000_000, each=True)).encode()
    drawing = [service.connection() for _ in range(32)]
    for connection in drawing:
        connection.connect()
    for connection in drawing:
        connection.request("POST", "/v1/trainings", refused, {"Content-Type": "application/json"})
    until(lambda: service.metric("morphod_http_requests_queued") >= 16)
    service.get(f"/v1/jobs/{job}")
    done = select.select([connection.sock for connection in drawing], [], [], 0)[0]
    assert len(done) < 26  # it did not wait for those that were queued
    for connection in drawing:
        reply = connection.getresponse()
        assert reply.status == 422 and b"steps in total" in reply.read()
        connection.close()
