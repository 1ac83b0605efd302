"""Evaluations of random bodies, which are given by a seed instead of a list."""

import csv
import io

import pytest

from service import awaited, run

WORLD = {"environments": [{"light_xy_m": [2.6 + 0.4 * k, 2.5], "terrain_sigma_m": 0.02, "seed": k}
                          for k in range(2)],
         "physics": {"n_steps": 10}}


def drawn(service, **request):
    return service.post("/v1/bodies/random", request)["items"]


def pages(service, id, query=""):
    return service.pages(f"/v1/evaluations/{id}/results{query}")


def test_same_as_listed(service):
    """The same designs, scores and order as those of a list."""
    bodies = drawn(service, count=150, seed=31, first=40)
    listed = run(service, "evaluations",
                 WORLD | {"designs": [{"voxels": body["genotype"]} for body in bodies]})
    random = run(service, "evaluations",
                 WORLD | {"random": {"count": 150, "seed": 31, "first": 40}})
    assert random["results"] == listed["results"] and random["rollouts_cached"] == 300
    assert random["random"] == {"seed": 31, "first": 40, "drawn": 150}
    assert listed["random"] is None and random["n_designs"] == 150
    for id in (random["id"], listed["id"]):
        items = pages(service, id)
        assert [item.pop("number") for item in items] == list(range(150))
        assert items == listed["results"]
    small = service.get(f"/v1/evaluations/{listed['id']}/results?limit=60&cursor=70")
    assert [item["number"] for item in small["items"]] == list(range(70, 130))
    assert small["next_cursor"] == "130"
    for behind in (150, 2**32, 2**32 + 70):
        path = f"/v1/evaluations/{listed['id']}/results?cursor={behind}"
        assert service.get(path) == {"items": [], "next_cursor": None}


def test_more_than_a_list(service):
    """`best` for more designs than a request can list; results come in pages."""
    n = 10_400
    job = run(service, "evaluations", WORLD | {"random": {"count": n, "seed": 32}, "best": 7})
    assert job["state"] == "succeeded" and job["n_designs"] == n and "results" not in job
    assert job["rollouts_total"] == 2 * n == job["rollouts_done"]
    whole = pages(service, job["id"], "?whole=true")
    assert 7 <= len(whole) <= n and not any(item["lower_bound"] for item in whole)
    scores = sorted(item["score"] for item in whole)
    everything = run(service, "evaluations", WORLD | {"random": {"count": n, "seed": 32}})
    items = pages(service, everything["id"])
    assert [item["number"] for item in items] == list(range(n))
    assert sorted(item["score"] for item in items)[:7] == scores[:7]
    assert len({item["id"] for item in items}) == n
    body = service.request(
        "GET", f"/v1/evaluations/{everything['id']}/results?format=csv").body.decode()
    rows = list(csv.DictReader(io.StringIO(body)))
    assert len(rows) == n and float(rows[17]["score"]) == items[17]["score"]


def test_whole_scores_only(service):
    """Only exact scores, not lower bounds, with the numbers of their designs."""
    far = [{"light_xy_m": [4.5 - 0.4 * k, 1.5], "terrain_sigma_m": 0.03, "seed": k}
           for k in range(8)]
    physics = {"integrator": "paper", "dt_s": 0.004, "n_steps": 800}
    job = run(service, "evaluations", {"environments": far, "physics": physics,
                                       "random": {"count": 60, "seed": 5}, "best": 3})
    assert job["rollouts_cut"] > 0
    listed = [row | {"number": number} for number, row in enumerate(job["results"])]
    assert pages(service, job["id"]) == listed
    whole = pages(service, job["id"], "?whole=true")
    assert whole == [row for row in listed if not row["lower_bound"]] and 3 <= len(whole) < 60
    page = service.get(f"/v1/evaluations/{job['id']}/results?whole=true&limit=2")
    assert page["items"] == whole[:2] and int(page["next_cursor"]) == whole[1]["number"] + 1


def test_restart_while_they_are_drawn(start, tmp_path):
    """After a pause, and after a stop of the service during a draw: stored designs stay, and the
    others are the same as without an interruption."""
    n = 30_000
    request = WORLD | {"random": {"count": n, "seed": 33}}
    request["environments"] = request["environments"][:1]
    service = start(state=tmp_path / "state")
    job = service.post("/v1/evaluations", request)
    path = f"/v1/evaluations/{job['id']}"
    awaited(service, path, lambda seen: seen["random"]["drawn"] > 2000)
    paused = service.act(job["id"], "pause")
    assert paused.status == 200
    before = service.get(path)["random"]["drawn"]
    assert 2000 < before
    service.stop()
    service = start(state=tmp_path / "state")
    assert service.get(path)["state"] == "paused" and service.get(path)["random"]["drawn"] == before
    assert service.act(job["id"], "resume").status == 200
    awaited(service, path, lambda seen: seen["random"]["drawn"] > before)
    assert service.get(path)["state"] == "queued" and service.stop() == 0
    service = start(state=tmp_path / "state")
    done = awaited(service, path, lambda seen: seen["state"] in ("succeeded", "failed"))
    assert done["state"] == "succeeded" and done["random"]["drawn"] == n
    place = n - 500
    items = service.get(f"{path}/results?limit=500&cursor={place}")["items"]
    bodies = drawn(service, count=500, seed=33, first=place)
    assert [item["genotype"] for item in items] == [body["genotype"] for body in bodies]


@pytest.mark.parametrize("random, more, pointer", [
    ({}, {}, "/random"),
    ({"count": 0}, {}, "/random/count"),
    ({"count": 1_000_001}, {}, "/random/count"),
    ({"count": 2, "first": 999_999}, {}, "/random/first"),
    ({"count": 2, "seed": -1}, {}, "/random/seed"),
    ({"count": 2, "distinct": True}, {}, "/random/distinct"),
    ({"count": 1_000_000}, {"environments": WORLD["environments"][:1] * 11}, "/random/count"),
    ({"count": 2}, {"designs": [{"voxels": "1" + "0" * 143}]}, "/random"),
    ({"count": 2}, {"record": ["com"]}, "/random"),
    ({"count": 2}, {"verify": True}, "/random"),
    ({"count": 2}, {"best": 3}, "/best"),
])
def test_what_is_refused(service, random, more, pointer):
    reply = service.request("POST", "/v1/evaluations", WORLD | {"random": random} | more)
    assert reply.status == 422 and reply.pointers() == [pointer], reply.body


def test_results_of_what_has_none(service):
    job = service.post("/v1/evaluations", WORLD | {"random": {"count": 200_000, "seed": 34}})
    path = f"/v1/evaluations/{job['id']}"
    assert service.request("GET", path + "/results").status == 409
    assert service.act(job["id"], "cancel").status == 200
    service.refuses("/v1/evaluations/999999/results", "", status=404)
    service.refuses(path + "/results", "?whole=maybe", "?cursor=x", "?limit=0")
