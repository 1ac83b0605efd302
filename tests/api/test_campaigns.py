"""Campaigns: what is refused and why, submission, running to each end, control, lists, curves,
replicates."""

import concurrent.futures
import csv
import io
import time
import urllib.parse

import pytest
from service import CONTRACT, DESIGN, await_end, awaited, tiny_controller

BAR = {"cells": [[x, 2, 0] for x in range(4)]}
HERE = [{"light_xy_m": [4.0, 2.5], "terrain_sigma_m": 0.05, "seed": 7}]
SMALL = {
    "mode": "zero-shot", "population": 8, "generations": 3, "environments": HERE,
    "physics": {"n_steps": 30}
}
LONG = {**SMALL, "population": 16, "generations": 100000, "physics": {"n_steps": 300}}
LEARNS = {
    **SMALL, "mode": "few-shot", "population": 4, "generations": 2,
    "learning": {"parent_steps": 1, "child_steps": 2, "batch": 4}
}


def but(base=None, **fields):
    return {**(base or {"mode": "zero-shot"}), **fields}


def learns(**fields):
    return {"mode": "few-shot", "learning": fields}


INVALID = {
    "not an object": ([], [""]),
    "a string": ("zero-shot", [""]),
    "nothing": ({}, [""]),
    "mode unknown": ({"mode": "one-shot"}, ["/mode"]),
    "mode a number": ({"mode": 0}, ["/mode"]),
    "preset unknown": (but(preset="laptop"), ["/preset"]),
    "unknown field": (but(epochs=3), ["/epochs"]),
    "unknown field with odd characters": (but(**{"a/b~cé": 3}), ["/a~1b~0cé"]),
    "population 0": (but(population=0), ["/population"]),
    "population 1": (but(population=1), ["/population"]),
    "population 10^8": (but(population=10**8), ["/population"]),
    "population as 1e8": (but(population=1e8), ["/population"]),
    "population negative": (but(population=-64), ["/population"]),
    "population in part": (but(population=63.5), ["/population"]),
    "population a word": (but(population="64"), ["/population"]),
    "population null": (but(population=None), ["/population"]),
    "population a list": (but(population=[64]), ["/population"]),
    "population beyond what learns": (but(mode="few-shot", population=10001,
                                          generations=1), ["/population"]),
    "generations negative": (but(generations=-1), ["/generations"]),
    "generations too many": (but(generations=100001), ["/generations"]),
    "half a generation": (but(generations=0.5), ["/generations"]),
    "designs too many": (but(population=65536, generations=100000), ["/generations"]),
    "seed negative": (but(seed=-1), ["/seed"]),
    "seed beyond 2^53": (but(seed=2**53), ["/seed"]),
    "seeds beyond 2^53": (but(seed=2**53 - 1, replicates=2), ["/seed"]),
    "replicates 0": (but(replicates=0), ["/replicates"]),
    "replicates 101": (but(replicates=101), ["/replicates"]),
    "zero-shot without a controller": (but(controller=None), ["/controller"]),
    "few-shot without a controller": (but(mode="few-shot", controller=None), ["/controller"]),
    "unknown controller": (but(controller="nobody"), ["/controller"]),
    "unknown controller by hash": (but(controller="sha256:" + "0" * 64), ["/controller"]),
    "unknown controller of a simultaneous campaign": (but(mode="simultaneous",
                                                          controller="nobody"), ["/controller"]),
    "not a controller's name": (but(controller="../default"), ["/controller"]),
    "no environments": (but(environments=[]), ["/environments"]),
    "unknown environments": (but(environments="paper"), ["/environments"]),
    "65 environments": (but(environments=HERE * 65), ["/environments"]),
    "environment without light": (but(environments=[{"terrain_sigma_m": 0.1, "seed": 1}]),
                                  ["/environments/0"]),
    "initial unknown": (but(initial="best"), ["/initial"]),
    "initial a number": (but(initial=12), ["/initial"]),
    "initial of nothing": (but(initial={}), ["/initial"]),
    "initial of both": (but(initial={"designs": [DESIGN], "campaign": "999999"}),
                        ["/initial", "/initial/campaign"]),
    "initial of no designs": (but(initial={"designs": []}), ["/initial/designs"]),
    "initial of no campaign": (but(initial={"campaign": "999999"}), ["/initial/campaign"]),
    "initial of a campaign's number": (but(initial={"campaign": 12}), ["/initial/campaign"]),
    "initial with an unknown field": (but(initial={"designs": [DESIGN], "evaluation": "1"}),
                                      ["/initial/evaluation"]),
    "design out of bounds": (but(initial={"designs": [DESIGN, {"cells": [[0, 0, 4]]}]}),
                             ["/initial/designs/1/cells/0/2"]),
    "design twice": (but(initial={"designs": [DESIGN, BAR, DESIGN]}), ["/initial/designs/2"]),
    "design and its image": (but(
        initial={"designs": [BAR, {"cells": [[3, y, 2]
                                             for y in range(4)]}]}), ["/initial/designs/1"]),
    "design thrice": (but(initial={"designs": [DESIGN, BAR, DESIGN, DESIGN]}),
                      ["/initial/designs/2", "/initial/designs/3"]),
    "design too large": (but(workspace=[3, 2, 4],
                             initial={"designs": [DESIGN, BAR]}), ["/initial/designs/1"]),
    "design across a narrow workspace": (but(workspace=[6, 1, 1],
                                             initial={
                                                 "designs": [{"cells": [[0, 0, 0], [0, 1, 0]]}]
                                             }), ["/initial/designs/0"]),
    "more designs than the population": (but(
        population=2, initial={"designs": [DESIGN, BAR, {"cells": [[0, 0,
                                                                    0]]}]}), ["/initial/designs"]),
    "workspace too large": (but(workspace=[6, 6, 5]), ["/workspace/2"]),
    "workspace of nothing": (but(workspace=[0, 6, 4]), ["/workspace/0"]),
    "workspace of two sides": (but(workspace=[6, 6]), ["/workspace"]),
    "workspace a word": (but(workspace="6x6x4"), ["/workspace"]),
    "mutation a number": (but(mutation=0.25), ["/mutation"]),
    "mutation of more than all": (but(mutation={"share": 1.01}), ["/mutation/share"]),
    "mutation rate 0": (but(mutation={"rate": 0}), ["/mutation/rate"]),
    "mutation rate above a half": (but(mutation={"rate": 0.6}), ["/mutation/rate"]),
    "mutation that shrinks": (but(mutation={"growth": 0.99}), ["/mutation/growth"]),
    "mutation with an unknown field": (but(mutation={"chance": 0.1}), ["/mutation/chance"]),
    "selection unknown": (but(selection="roulette"), ["/selection"]),
    "selection a number": (but(selection=4), ["/selection"]),
    "selection without kind": (but(selection={"size": 4}), ["/selection"]),
    "selection of unknown kind": (but(selection={"kind": "roulette"}), ["/selection/kind"]),
    "tournament of one": (but(selection={"kind": "tournament", "size": 1}), ["/selection/size"]),
    "novelty with a size": (but(selection={"kind": "novelty", "size": 4}), ["/selection/size"]),
    "truncation with everything": (but(
        selection={"kind": "truncation", "weight": 0, "layers": 2, "age_gap": 1}),
                                   ["/selection/weight", "/selection/layers",
                                    "/selection/age_gap"]),
    "novelty of weight 2": (but(selection={"kind": "novelty", "weight": 2}), ["/selection/weight"]),
    "one layer": (but(selection={"kind": "age-layered", "layers": 1}), ["/selection/layers"]),
    "learning in zero-shot": (but(learning={"parent_steps": 1}), ["/learning"]),
    "learning of no steps": (learns(parent_steps=0, child_steps=0), ["/learning"]),
    "learning of too many steps": (but(mode="simultaneous",
                                       generations=1000,
                                       learning={"parent_steps": 10000}), ["/learning"]),
    "steps negative": (learns(parent_steps=-1), ["/learning/parent_steps"]),
    "batch 0": (learns(batch=0), ["/learning/batch"]),
    "schedule unknown": (learns(schedule="paper"), ["/learning/schedule"]),
    "floor above peak": (learns(schedule={"kind": "cosine", "peak": 0.001, "floor": 0.01}),
                         ["/learning/schedule/floor"]),
    "beta of one": (learns(adam={"beta1": 1}), ["/learning/adam/beta1"]),
    "adjoint bound negative": (learns(adjoint_bound=-1), ["/learning/adjoint_bound"]),
    "adjoint rule unknown": (learns(adjoint_rule="scale"), ["/learning/adjoint_rule"]),
    "adjoint rule a number": (learns(adjoint_rule=1), ["/learning/adjoint_rule"]),
    "restart weight negative": (learns(restart_weight=-1), ["/learning/restart_weight"]),
    "restart weight too large": (learns(restart_weight=1e7), ["/learning/restart_weight"]),
    "restart weight a word": (learns(restart_weight="3"), ["/learning/restart_weight"]),
    "sensor of few-shot": (learns(sensor="inverse_sqrt"), ["/learning/sensor"]),
    "sensor with a controller": (but(mode="simultaneous",
                                     controller="default",
                                     learning={"sensor": "inverse_sqrt"}), ["/learning/sensor"]),
    "sensor unknown": (but(mode="simultaneous",
                           learning={"sensor": "camera"}), ["/learning/sensor"]),
    "checkpoints in the past": (learns(checkpoint_every_s=-1), ["/learning/checkpoint_every_s"]),
    "learning with an unknown field": (learns(steps=3), ["/learning/steps"]),
    "exclusion a number": (but(exclude_pretraining=1), ["/exclude_pretraining"]),
    "collapse above one": (but(collapse_share=1.5), ["/collapse_share"]),
    "time step zero": (but(physics={"dt_s": 0}), ["/physics/dt_s"]),
    "name in zero-shot": (but(name="walker"), ["/name"]),
    "name not a name": (but(mode="few-shot", name="Walker"), ["/name"]),
    "label too long": (but(label="x" * 201), ["/label"]),
    "priority unknown": (but(priority="urgent"), ["/priority"]),
    "weight 0": (but(weight=0), ["/weight"]),
    "weight 1001": (but(weight=1001), ["/weight"]),
    "all of it": ({
        "mode": "zero-shot", "population": 1, "generations": -1, "controller": "nobody",
        "initial": {"campaign": "999999"}, "replicates": 101, "workspace": [7, 6, 4],
        "mutation": {"share": -1}, "epochs": 7
    }, [
        "/population", "/generations", "/replicates", "/workspace/0", "/mutation/share", "/epochs",
        "/controller", "/initial/campaign"
    ]),
}


@pytest.mark.parametrize("name", INVALID)
def test_invalid(service, name):
    value, pointers = INVALID[name]
    reply = service.request("POST", "/v1/campaigns", value)
    assert reply.status == 422, reply.body
    assert sorted(reply.pointers()) == sorted(pointers), reply.body
    for fault in reply.json()["errors"]:
        assert len(fault["detail"]) > 15


# What no schema can tell: it depends on several fields, or on what the service has.
BEYOND_SCHEMA = {
    "population beyond what learns", "designs too many", "seeds beyond 2^53",
    "zero-shot without a controller", "few-shot without a controller", "unknown controller",
    "unknown controller by hash", "unknown controller of a simultaneous campaign",
    "initial of no campaign", "design twice", "design and its image", "design thrice",
    "design too large", "design across a narrow workspace", "more designs than the population",
    "learning in zero-shot", "learning of no steps", "learning of too many steps",
    "floor above peak", "sensor of few-shot", "sensor with a controller", "name in zero-shot"
}


def test_the_contract_refuses_the_same():
    """schema/openapi.yaml and the service agree on what a request is."""
    for name, (value, _) in INVALID.items():
        try:
            CONTRACT.validate({"$ref": "#/components/schemas/CampaignRequest"}, value, name)
            assert name in BEYOND_SCHEMA, name
        except AssertionError as error:
            assert name not in BEYOND_SCHEMA and name in str(error), (name, error)
    post = CONTRACT.document["paths"]["/v1/campaigns"]["post"]["requestBody"]["content"][
        "application/json"]
    for value in [SMALL, LONG, LEARNS
                  ] + [example["value"] for example in post["examples"].values()]:
        CONTRACT.validate(post["schema"], value, "an example")


@pytest.mark.parametrize(
    "body, pointer", [('{"mode":"zero-shot","mutation":{"growth":1e400}}', "/mutation/growth"),
                      ('{"mode":"zero-shot","weight":-1e999}', "/weight"),
                      ('{"mode":"zero-shot","population":99999999999999999999}', "/population")])
def test_numbers_that_are_not_finite(service, body, pointer):
    reply = service.request("POST", "/v1/campaigns", body=body)
    assert reply.status == 422 and reply.pointers() == [pointer], reply.body


@pytest.mark.parametrize("body", [
    b"", b"{", b'{"mode":"zero-shot","mode":"zero-shot"}', b'{"population":NaN}',
    b'{"weight":Infinity}', b'{"mode":"zero-shot"}x', b'{"mode":"\xff"}',
    b'{"mode":"zero-shot\\u0000"}', b"[" * 1000
])
def test_malformed(service, body):
    reply = service.request("POST", "/v1/campaigns", body=body)
    assert reply.status == 400 and reply.json()["type"] == "/problems/malformed-json", reply.body


def test_media_types_and_methods(service):
    for headers, status in (({"Content-Type": "text/plain"}, 415), ({"Accept": "text/html"}, 406),
                            ({"Idempotency-Key": ""}, 400)):
        assert service.request("POST", "/v1/campaigns", body="{}", headers=headers).status == status
    assert service.request("POST", "/v1/campaigns?x=1", SMALL).status == 400
    for method in ("PUT", "DELETE"):
        assert service.request(method, "/v1/campaigns").status == 405
    assert service.request("OPTIONS",
                           "/v1/campaigns").headers["Allow"] == "GET, HEAD, POST, OPTIONS"
    assert service.request("GET", "/v1/jobs/1/pause").status == 405


def test_controller_of_another_workspace(service):
    tiny_controller(service)
    for mode in ("zero-shot", "few-shot", "simultaneous"):
        reply = service.request("POST", "/v1/campaigns", but(SMALL, mode=mode, controller="tiny"))
        assert reply.status == 422 and reply.pointers() == [
            "/controller"
        ] and "1 × 1 × 1" in reply.json()["detail"], reply.body
    both = service.request("POST", "/v1/campaigns", but(controller="tiny", population=0))
    assert both.status == 422 and both.pointers() == ["/population", "/controller"], both.body


def finished(service, id, seconds=60):
    return await_end(service, f"/v1/campaigns/{id}", seconds)


def run(service, value):
    reply = service.request("POST", "/v1/campaigns", value)
    assert reply.status == 202, reply.body
    done = finished(service, reply.json()["id"]).json()
    assert done["state"] == "succeeded", done
    return done


def ended(service, ids):
    for id in ids:
        service.request("POST", f"/v1/jobs/{id}/cancel")


@pytest.fixture(scope="module")
def evolved(service):
    """A small zero-shot campaign that has succeeded."""
    reply = service.request(
        "POST", "/v1/campaigns",
        but(SMALL, label="première", initial={"designs": [DESIGN, BAR]}, weight=2))
    assert reply.status == 202, reply.body
    accepted = reply.json()
    assert reply.headers["Location"] == f"/v1/campaigns/{accepted['id']}" and reply.headers[
        "Retry-After"]
    assert accepted["state"] in (
        "queued", "running") and accepted["result"] is None and accepted["end"] is None
    done = finished(service, accepted["id"]).json()
    assert done["state"] == "succeeded", done
    return done


@pytest.fixture(scope="module")
def learned(service):
    """A few-shot campaign that has succeeded."""
    return run(service, but(LEARNS, name="tuned-by-evolution"))


def test_settings_are_told_with_their_defaults(service, evolved, learned):
    settings = evolved["settings"]
    assert evolved["mode"] == "zero-shot" and evolved["preset"] == "workstation" and evolved[
        "label"] == "première"
    assert evolved["weight"] == 2 and evolved["priority"] == "batch" and evolved["name"] is None
    assert settings["population"] == 8 and settings["generations"] == 3 and settings[
        "seed"] == 1 and settings["workspace"] == [6, 6, 4]
    assert settings["mutation"] == {"share": 0.25, "rate": 1 / 144, "growth": 1.025
                                    } and settings["selection"] == {"kind": "truncation"}
    assert settings["environments"] == {"count": 1} and settings["initial"] == {
        "n_designs": 2
    } and settings["learning"] is None
    assert settings["exclude_pretraining"] is True and settings[
        "collapse_share"] == 0.5 and settings["physics"]["n_steps"] == 30
    assert evolved["controller"]["name"] == "default" and evolved["group"] == {
        "id": evolved["id"], "replicate": 0, "replicates": 1
    }
    learning = learned["settings"]["learning"]
    assert learning["batch"] == 4 and learning["schedule"]["peak"] == 3.5e-4 and learning["adam"][
        "beta1"] == 0.9 and learning["sensor"] is None
    assert learning["checkpoint_every_s"] == 60 and learning["adjoint_bound"] == 2 and learning[
        "adjoint_rule"] == "clip"
    assert learning["restart_weight"] == 3
    rule = {"adjoint_rule": "restart", "restart_weight": 0.5}
    queued = service.request("POST", "/v1/campaigns",
                             {"mode": "simultaneous", "preset": "demo", "learning": rule}).json()
    assert queued["controller"] is None and queued["settings"]["learning"][
        "batch"] == 64 and queued["settings"]["generations"] == 30
    assert queued["settings"]["learning"]["sensor"] == "inverse_sqrt" and queued["settings"][
        "environments"] == "paper-test"
    assert queued["settings"]["learning"]["adjoint_rule"] == "restart" and queued["settings"][
        "learning"]["restart_weight"] == 0.5
    assert queued["name"] == f"campaign-{queued['id']}"
    assert queued["settings"]["initial"] == "random"
    ended(service, [queued["id"]])


@pytest.mark.parametrize(
    "given, told",
    [("tournament", {"kind": "tournament", "size": 4}),
     ({"kind": "tournament", "size": 8}, {"kind": "tournament", "size": 8}),
     ("novelty", {"kind": "novelty", "weight": 0.5}), ("truncation", {"kind": "truncation"}),
     ({"kind": "age-layered", "layers": 3}, {"kind": "age-layered", "layers": 3, "age_gap": 5})])
def test_selections(service, given, told):
    done = run(service, but(SMALL, selection=given, generations=2))
    assert done["settings"]["selection"] == told and done["progress"]["generation"] == 2


def test_the_end(service, evolved):
    progress = evolved["progress"]
    assert progress["generation"] == progress["generations"] == 3 and progress[
        "designs"] == 32 and progress["under_way"] is None
    assert evolved["end"] == "completed" and evolved["phase"] == "idle" and evolved[
        "error"] is None and evolved["reason"] is None
    assert evolved["newest"]["generation"] == 3 and evolved["result"] is None and evolved[
        "finished_at"] >= evolved["started_at"]
    for path in evolved["links"].values():
        if "/events" not in path:
            assert service.request("GET", path, headers={
                "Accept": "application/json, text/event-stream"
            }).status == 200
    path = f"/v1/campaigns/{evolved['id']}"
    whole = service.request("GET", path)
    assert service.request("GET", path,
                           headers={"If-None-Match": whole.headers["ETag"]}).status == 304
    assert service.request("HEAD", path).headers["ETag"] == whole.headers["ETag"]


def test_learning_gives_a_controller(service, learned):
    assert learned["result"]["controller"]["name"] == "tuned-by-evolution" == learned["name"]
    described = service.request("GET", "/v1/controllers/tuned-by-evolution").json()
    assert described["sha256"] == learned["result"]["controller"]["sha256"] != learned[
        "controller"]["sha256"]
    path = learned["links"]["learning"]
    page = service.request("GET", path).json()
    places = [(row["generation"], row["step"]) for row in page["items"]]
    assert places == sorted(places) and len(places) >= 6 and page[
        "next_cursor"] is None
    assert {row["on"] for row in page["items"]} == {"parents", "children"}
    assert all(row["mean_loss"] > 0 and row["gradient_norm"] > 0 for row in page["items"])
    first = service.request("GET", path + "?limit=2").json()
    assert first["next_cursor"] == "{}.{}".format(
        *places[1]) and first["items"] == page["items"][:2]
    assert service.request(
        "GET", f"{path}?cursor={first['next_cursor']}").json()["items"] == page["items"][2:]
    table = service.request("GET", path, headers={"Accept": "text/csv"})
    lines = list(csv.DictReader(io.StringIO(table.body.decode())))
    assert [(int(line["generation"]), int(line["step"]), line["on"])
            for line in lines] == [(r["generation"], r["step"], r["on"]) for r in page["items"]]
    assert [float(line["mean_loss"])
            for line in lines] == [row["mean_loss"] for row in page["items"]]
    assert service.request("GET", path + "?format=csv&limit=1").body.count(b"\n") == 2
    for bad in ("?cursor=1", "?cursor=-1.0", "?cursor=1.x", "?cursor=1.2.3", "?limit=0",
                "?format=xml",
                "?step=1"):
        assert service.request("GET", path + bad).status == 400, bad
    reply = service.request("GET", path)
    assert service.request("GET", path,
                           headers={"If-None-Match": reply.headers["ETag"]}).status == 304


def test_generations(service, evolved):
    path = evolved["links"]["generations"]
    page = service.request("GET", path).json()
    rows = page["items"]
    assert [row["generation"] for row in rows] == [
        0, 1, 2, 3
    ] and page["next_cursor"] is None and rows[-1] == evolved["newest"]
    assert [row["first_number"]
            for row in rows] == [0, 8, 16, 24] and all(row["born"] == row["population"] == 8
                                                       for row in rows)
    for row in rows:
        quantiles = list(row["score"]["quantiles"].values())
        assert quantiles == sorted(
            quantiles) and quantiles[0] <= row["score"]["mean"] <= quantiles[-1]
        assert 0 < row["diversity"] < 1 and row["species"] == 8 and row["seconds"] > 0
        assert row["voxels"]["least"] <= row["voxels"]["mean"] <= row["voxels"]["most"] <= 144
    for row in rows[1:]:
        mutation, crossover = row["operators"]["mutation"], row["operators"]["crossover"]
        assert mutation["born"] + crossover["born"] == 8 and mutation["born"] >= 2 and mutation[
            "attempts"] >= 2
        assert mutation["survived"] + crossover["survived"] == row["turnover"] * 8
    assert [row["score"]["quantiles"]["p0"] for row in rows] == sorted(
        (row["score"]["quantiles"]["p0"] for row in rows), reverse=True)
    first = service.request("GET", path + "?limit=2").json()
    assert first["next_cursor"] == "1" and first["items"] == rows[:2]
    assert service.request("GET", path + "?cursor=1").json()["items"] == rows[2:]
    assert service.request("GET", path +
                           "?cursor=3").json() == {"items": [], "next_cursor": None}
    for table in (service.request("GET", path, headers={"Accept": "text/csv"}),
                  service.request("GET", path + "?format=csv")):
        assert table.headers["Content-Type"].startswith("text/csv") and table.headers["ETag"]
        lines = list(csv.DictReader(io.StringIO(table.body.decode())))
        assert [float(line["mean"]) for line in lines] == [row["score"]["mean"] for row in rows]
        assert [float(line["p95"])
                for line in lines] == [row["score"]["quantiles"]["p95"] for row in rows]
        assert [float(line["springs_mean"])
                for line in lines] == [row["springs"]["mean"] for row in rows]
        assert [int(line["mutation_attempts"])
                for line in lines] == [row["operators"]["mutation"]["attempts"] for row in rows]
        assert [int(line["rollouts"])
                for line in lines] == [row["rollouts"]
                                       for row in rows] and lines[0]["parents_mean"] == ""
        assert [float(line["seconds"]) for line in lines] == [row["seconds"] for row in rows]
    etag = service.request("GET", path + "?format=csv").headers["ETag"]
    assert service.request("GET", path + "?format=csv",
                           headers={"If-None-Match": etag}).status == 304
    for bad in ("?cursor=-1", "?cursor=x", "?cursor=1.1", "?limit=0", "?limit=1001",
                "?format=newick", "?stride=2"):
        assert service.request("GET", path + bad).status == 400, bad
    assert service.request("GET", path, headers={"Accept": "image/png"}).status == 406
    assert service.request("GET", evolved["links"]["learning"]).json() == {
        "items": [], "next_cursor": None
    }


def test_the_same_again(service, evolved):
    """Another campaign of the same settings has the same history, but for the seconds."""
    again = run(service, but(SMALL, initial={"designs": [DESIGN, BAR]}))
    for what in ("generations", "phylogeny"):
        pages = [
            service.request("GET", one["links"][what] + "?limit=1000").json()["items"]
            for one in (evolved, again)
        ]
        for rows in pages:
            for row in rows:
                for key in ("seconds", "rollouts", "cached"):
                    row.pop(key, None)
        assert pages[0] == pages[1], what
    other = run(service, but(SMALL, initial={"designs": [DESIGN, BAR]}, seed=2))
    assert other["newest"]["score"] != evolved["newest"]["score"]


@pytest.mark.parametrize("workspace, designs", [([1, 1, 1], 1), ([2, 1, 1], 2)])
def test_a_morphospace_that_is_exhausted(service, workspace, designs):
    done = run(service, but(SMALL, workspace=workspace, generations=50))
    assert done["end"] == "exhausted" and done["progress"]["designs"] == designs and done["newest"][
        "population"] <= designs
    reply = service.request("POST", f"/v1/campaigns/{done['id']}/extend", {"generations": 1})
    assert reply.status == 409 and "exhausted" in reply.json()["detail"], reply.body
    assert len(service.request("GET", done["links"]["phylogeny"]).json()["items"]) == designs


def test_no_generations_at_all(service):
    done = run(service, but(SMALL, generations=0))
    assert done["end"] == "completed" and done["progress"] | {"generation": 0, "designs": 8
                                                              } == done["progress"]


def test_from_another_campaign(service, evolved):
    done = run(service, but(SMALL,
                            initial={"campaign": evolved["id"]},
                            population=10,
                            generations=1))
    first = service.request("GET", done["links"]["population"] + "?generation=0").json()["items"]
    last = service.request("GET", evolved["links"]["population"]).json()["items"]
    inherited = {row["genotype"] for row in first if row["operator"] == "inherited"}
    assert inherited == {row["genotype"]
                         for row in last} and {row["operator"]
                                               for row in first} == {"inherited", "random"}
    assert done["settings"]["initial"] == {"campaign": evolved["id"]}
    evaluation = service.evaluate({"designs": [DESIGN], "physics": {"n_steps": 5}}).json()["id"]
    reply = service.request("POST", "/v1/campaigns", but(SMALL, initial={"campaign": evaluation}))
    assert reply.status == 422 and reply.pointers() == ["/initial/campaign"], reply.body


def test_replicates(service):
    first = service.request("POST", "/v1/campaigns", but(SMALL, replicates=3, seed=5)).json()
    ids = [str(int(first["id"]) + i) for i in range(3)]
    all_done = [finished(service, id).json() for id in ids]
    assert [one["settings"]["seed"] for one in all_done] == [5, 6, 7]
    assert [one["group"] for one in all_done] == [{"id": ids[0], "replicate": i, "replicates": 3}
                                                  for i in range(3)]
    listed = service.request("GET", f"/v1/campaigns?group={ids[0]}").json()["items"]
    assert [one["id"] for one in listed] == ids[::-1]
    curves = [
        service.request("GET", one["links"]["generations"]).json()["items"] for one in all_done
    ]
    for id in ids:
        page = service.request("GET", f"/v1/campaigns/{id}/replicates").json()
        assert page["next_cursor"] is None and [
            row["generation"] for row in page["items"]
        ] == [0, 1, 2, 3]
    for row in page["items"]:
        of_all = [curve[row["generation"]] for curve in curves]
        for name, values in (("mean_score", [one["score"]["mean"] for one in of_all]),
                             ("best_score", [one["score"]["quantiles"]["p0"] for one in of_all]),
                             ("diversity", [one["diversity"] for one in of_all])):
            assert row[name]["least"] == min(values) and row[name]["most"] == max(values) and abs(
                row[name]["mean"] - sum(values) / 3) < 1e-12
        assert row["campaigns"] == 3
    path = f"/v1/campaigns/{ids[0]}/replicates"
    assert service.request("GET", path + "?limit=1&cursor=1").json() == {
        "items": [page["items"][2]], "next_cursor": "2"
    }
    table = service.request("GET", path, headers={"Accept": "text/csv"}).body.decode()
    lines = list(csv.DictReader(io.StringIO(table)))
    assert [float(line["diversity_most"])
            for line in lines] == [row["diversity"]["most"] for row in page["items"]]
    assert service.request("GET", path + "?generation=1").status == 400


def test_replicates_wait_for_the_slowest(service):
    """Generations that not all have are left out; those that are cancelled do not count."""
    first = service.request("POST", "/v1/campaigns", but(LONG, replicates=3)).json()
    ids = [str(int(first["id"]) + i) for i in range(3)]
    path = f"/v1/campaigns/{ids[0]}/replicates"
    assert service.request("POST", f"/v1/jobs/{ids[1]}/cancel").json()["state"] == "cancelled"
    service.request("POST", f"/v1/jobs/{ids[2]}/pause")
    rows = service.request("GET", path).json()["items"]
    assert all(row["campaigns"] == 2 for row in rows)
    ended(service, ids)
    assert service.request("GET", path).json() == {"items": [], "next_cursor": None}


def test_pause_resume_extend_cancel(service):
    id = service.request("POST", "/v1/campaigns", LONG).json()["id"]
    path, job_path = f"/v1/campaigns/{id}", f"/v1/jobs/{id}"
    running = awaited(
        service, path,
        lambda value: value["progress"]["generation"] is not None and value["phase"] != "idle")
    assert running["state"] == "running" and running["progress"]["under_way"] >= 1 and running[
        "reason"] is None
    assert service.request("GET", path).headers["Retry-After"]
    reply = service.request("POST", path + "/extend", {"generations": 1})
    assert reply.status == 422 and reply.pointers() == [
        "/generations"
    ], reply.body  # it has as many as there may be
    assert service.request("POST", job_path + "/pause").json()["state"] == "paused"
    assert service.request("POST", job_path + "/pause").status == 200
    paused = awaited(service, path, lambda value: value["phase"] == "idle")
    job = service.request("GET", f"/v1/jobs/{id}").json()
    assert job["state"] == "paused" and job["campaign"]["generation"] == paused["progress"][
        "generation"] and job["campaign"]["mode"] == "zero-shot"
    assert paused["id"] in [
        one["id"] for one in service.request("GET", "/v1/campaigns?state=paused").json()["items"]
    ]
    assert service.request("POST", job_path + "/resume").json()["state"] in ("queued", "running")
    awaited(service, path, lambda value:
            (value["progress"]["generation"] or 0) > paused["progress"]["generation"])
    assert service.request("POST", f"/v1/jobs/{id}/pause").json()["state"] == "paused"
    assert service.request("POST", f"/v1/jobs/{id}/resume").status == 200
    assert service.request("POST", job_path + "/cancel").json()["state"] == "cancelled"
    for verb in ("pause", "resume", "cancel"):
        reply = service.request("POST", f"{job_path}/{verb}")
        assert reply.status == 409 and "cancelled" in reply.json()["detail"], reply.body
    reply = service.request("POST", path + "/extend", {"generations": 5})
    assert reply.status == 409 and "cancelled" in reply.json()["detail"], reply.body
    assert service.request("POST", f"/v1/jobs/{id}/cancel").status == 409


def test_extend(service):
    """A campaign that is extended, after its end, in the queue, or set aside, is the one that was
    longer from the beginning."""
    whole = run(service, but(SMALL, generations=5))
    hold = service.request("POST", "/v1/campaigns", LONG).json()["id"]
    short = service.request("POST", "/v1/campaigns", but(SMALL, generations=2)).json()["id"]
    extended = service.request("POST", f"/v1/campaigns/{short}/extend", {"generations": 1})
    assert extended.status == 200 and extended.json()["progress"]["generations"] == 3
    ended(service, [hold])
    finished(service, short)
    again = service.request("POST", f"/v1/campaigns/{short}/extend", {"generations": 2}).json()
    assert again["settings"]["generations"] == 5
    assert again["state"] == "succeeded" or (again["state"] in ("queued", "running") and
                                             again["end"] is None)
    done = finished(service, short).json()
    assert done["state"] == "succeeded" and done["progress"]["generation"] == 5
    assert done["newest"]["score"] == whole["newest"]["score"] and done["newest"][
        "diversity"] == whole["newest"]["diversity"]
    events = service.request(
        "GET", f"/v1/events?format=json&job={short}&after=0&limit=1000").json()["items"]
    assert [
        event["data"]["generations"] for event in events if event["type"] == "campaign.extended"
    ] == [3, 5]


@pytest.mark.parametrize("body, status, pointer", [({}, 422, ""),
                                                   ({"generations": 0}, 422, "/generations"),
                                                   ({"generations": -3}, 422, "/generations"),
                                                   ({"generations": 1.5}, 422, "/generations"),
                                                   ({"generations": "9"}, 422, "/generations"),
                                                   ([], 422, ""),
                                                   ({"generations": 1, "seed": 2}, 422, "/seed"),
                                                   ({"generations": 100001}, 422, "/generations"),
                                                   ({"generations": 99999}, 422, "/generations")])
def test_bad_extensions(service, evolved, body, status, pointer):
    reply = service.request("POST", f"/v1/campaigns/{evolved['id']}/extend", body)
    assert reply.status == status and reply.pointers() == [pointer], reply.body
    assert service.request("GET",
                           f"/v1/campaigns/{evolved['id']}").json()["settings"]["generations"] == 3


def test_an_extension_that_would_change_the_past(service):
    """One cosine over all generations has another rate in every step when there are more."""
    value = but(
        LEARNS,
        mode="simultaneous",
        generations=1,
        learning={"parent_steps": 1, "child_steps": 1, "batch": 2, "schedule": "one-cosine"})
    id = run(service, value)["id"]
    reply = service.request("POST", f"/v1/campaigns/{id}/extend", {"generations": 1})
    assert reply.status == 409 and len(reply.json()["detail"]) > 40, reply.body


def test_checkpoints_are_deleted(service):
    """A campaign that has ended needs none; one that has not keeps what it goes on from."""
    simultaneous = but(LEARNS,
                       mode="simultaneous",
                       learning={"parent_steps": 1, "child_steps": 1, "batch": 2})
    done = run(service, but(simultaneous, generations=1))
    path = done["links"]["checkpoints"]
    kept = service.request("GET", path)
    assert kept.headers["ETag"] and [(item["generation"], item["step"])
                                     for item in kept.json()["items"]] == [(1, 2)]
    folder = service.state / "campaigns" / done["id"]
    assert [file.name for file in folder.iterdir()] == ["1-2.checkpoint"]
    reply = service.request("DELETE", path).json()
    assert reply == {
        "items": [{"generation": 1, "step": 2}], "bytes": kept.json()["items"][0]["size"]
    } and reply["bytes"] > 12e6
    assert not folder.exists() and service.request("GET", path).json() == {"items": []}
    assert service.request("DELETE", path).json() == {"items": [], "bytes": 0}
    assert service.request(
        "GET",
        f"/v1/controllers/{done['result']['controller']['name']}").status == 200, "the result stays"
    reply = service.request("POST", f"/v1/campaigns/{done['id']}/extend", {"generations": 1})
    assert reply.status == 409 and "was deleted" in reply.json()["detail"], reply.body
    assert service.request("GET", f"/v1/campaigns/{done['id']}").json()["state"] == "succeeded"
    # One that is paused goes on from its own, whether it is asked for or not.
    id = service.request("POST", "/v1/campaigns", but(simultaneous,
                                                      generations=100000)).json()["id"]
    path, deadline = f"/v1/campaigns/{id}/checkpoints", time.monotonic() + 60
    while not service.request("GET", path).json()["items"]:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    assert service.request("DELETE", path).json()["items"] == [] and service.request(
        "GET", path).json()["items"]
    assert service.request("POST", f"/v1/jobs/{id}/cancel").status == 200
    finished(service, id)
    assert service.request("DELETE", path).json()["items"]
    while (service.state / "campaigns" /
           id).exists():  # its thread may write one more, whose row is refused
        assert time.monotonic() < deadline
        time.sleep(0.02)
    assert service.request("GET", path).json()["items"] == []
    frozen = run(service, SMALL)["links"]["checkpoints"]
    assert service.request("GET", frozen).json() == {"items": []} and service.request(
        "DELETE", frozen).json() == {"items": [], "bytes": 0}
    assert service.request("DELETE", frozen + "?all=1").status == 400


def test_idempotency(service):
    key = {"Idempotency-Key": "campaign-one"}
    first = service.request("POST", "/v1/campaigns", but(SMALL, replicates=2), headers=key)
    second = service.request("POST", "/v1/campaigns", but(SMALL, replicates=2), headers=key)
    assert first.status == second.status == 202 and first.json()["id"] == second.json()["id"]
    other = service.request("POST", "/v1/campaigns", SMALL, headers=key)
    assert other.status == 422 and other.json()["errors"][0]["header"] == "Idempotency-Key"
    other = service.request("POST",
                            "/v1/campaigns",
                            but(SMALL, initial={"campaign": first.json()["id"]}),
                            headers=key)
    assert other.status == 422 and other.json(
    )["errors"][0]["header"] == "Idempotency-Key", other.body
    for i in range(2):
        finished(service, str(int(first.json()["id"]) + i))


def test_idempotency_of_what_is_done_with_a_campaign(service):
    """An extension that is sent twice adds once, and champions are recorded once, even when they
    have others behind them by then."""
    id = run(service, SMALL)["id"]
    path, key = f"/v1/campaigns/{id}", {"Idempotency-Key": "more-of-it"}
    generations = SMALL["generations"] + 2
    for _ in range(3):
        reply = service.request("POST", path + "/extend", {"generations": 2}, headers=key)
        assert reply.status == 200 and reply.json(
        )["settings"]["generations"] == generations, reply.body
    assert finished(service, id).json()["progress"]["generation"] == generations
    assert service.request("POST", path + "/extend", {"generations": 2},
                           headers=key).json()["state"] == "succeeded"
    other = run(service, but(SMALL, seed=77))["id"]
    for about, body in ((path + "/extend", {"generations": 1}),
                        (f"/v1/campaigns/{other}/extend", {"generations": 2}), (path + "/champions",
                                                                                {})):
        reply = service.request("POST", about, body, headers=key)
        assert reply.status == 422 and reply.json()["errors"][0]["header"] == "Idempotency-Key", (
            about, reply.body)
    key = {"Idempotency-Key": "record-it"}
    first = service.request("POST", path + "/champions", {"count": 2}, headers=key)
    assert first.status == 202, first.body
    assert service.request("POST",
                           path + "/extend", {"generations": 1},
                           headers={"Idempotency-Key": "and-more"}).status == 200
    finished(service, id)
    again = service.request("POST", path + "/champions", {"count": 2}, headers=key)
    assert again.status == 202 and again.json()["id"] == first.json(
    )["id"] and again.headers["Location"] == first.headers["Location"]
    assert service.request("POST", path + "/champions", {"count": 3}, headers=key).status == 422
    assert service.request("POST",
                           path + "/champions", {"count": 2},
                           headers={"Idempotency-Key": "record-it-again"
                                    }).json()["id"] != first.json()["id"]


def test_lists(service, evolved, learned):
    seen, cursor = [], ""
    while cursor is not None:
        page = service.request("GET", "/v1/campaigns?limit=3" +
                               (f"&cursor={cursor}" if cursor else "")).json()
        seen += [item["id"] for item in page["items"]]
        cursor = page["next_cursor"]
    assert seen == sorted(seen, key=int, reverse=True) and {evolved["id"],
                                                            learned["id"]} <= set(seen) and len(
                                                                set(seen)) == len(seen)
    page = service.request("GET", "/v1/campaigns?state=succeeded&limit=1000")
    assert evolved in page.json()["items"]
    assert service.request("GET",
                           "/v1/campaigns?state=succeeded&limit=1000",
                           headers={"If-None-Match": page.headers["ETag"]}).status == 304
    jobs = service.request("GET", "/v1/jobs?kind=campaign&limit=1000").json()["items"]
    assert {job["kind"]
            for job in jobs} == {"campaign"} and {job["id"]
                                                  for job in jobs} >= set(seen)
    assert "campaign" not in {
        job["kind"]
        for job in service.request("GET", "/v1/jobs?kind=training&limit=1000").json()["items"]
    }
    job = service.request("GET", evolved["links"]["job"]).json()
    assert job["campaign"] == {
        "mode": "zero-shot", "population": 8, "generation": 3, "generations": 3
    } and job["state"] == "succeeded"
    for bad in ("?state=done", "?cursor=x", "?limit=0", "?group=x", "?group=0", "?mode=zero-shot",
                "?label=", "?group=01", "?cursor=01", "?label=" + "x" * 201):
        assert service.request("GET", "/v1/campaigns" + bad).status == 400, bad


def test_what_has_a_label_is_found(service):
    label = "für Ä & %  " + "😀" * 180
    first = service.request("POST", "/v1/campaigns", but(SMALL, label=label, replicates=2,
                                                         seed=77)).json()["id"]
    finished(service, first)
    finished(service, str(int(first) + 1))
    evaluation = service.evaluate({"designs": [DESIGN], "physics": {"n_steps": 5},
                                   "label": label}).json()["id"]
    quoted = urllib.parse.quote(label)

    def found(path):
        return [item["id"] for item in service.request("GET", path).json()["items"]]

    campaigns = [str(int(first) + 1), first]
    assert found(f"/v1/jobs?label={quoted}") == [evaluation, *campaigns]
    assert found(f"/v1/jobs?label={quoted}&kind=campaign&state=succeeded") == campaigns
    assert found(f"/v1/jobs?label={quoted}&state=paused") == found(
        f"/v1/jobs?label={quoted}&kind=training") == []
    assert found(f"/v1/campaigns?label={quoted}") == found(
        f"/v1/campaigns?label={quoted}&group={first}") == campaigns
    assert found(f"/v1/campaigns?label={quoted}&group={evaluation}") == found(
        f"/v1/trainings?label={quoted}") == []
    page = service.request("GET", f"/v1/campaigns?label={quoted}&limit=1").json()
    assert found(f"/v1/campaigns?label={quoted}&limit=1&cursor={page['next_cursor']}") == [first]
    assert found("/v1/jobs?label=nothing%20has%20this") == []


def test_nothing_there(service, evolved):
    evaluation = service.evaluate({"designs": [DESIGN], "physics": {"n_steps": 5}}).json()["id"]
    for id in ("999999", "0", "x", "-1", "1" * 30, evaluation):
        for below in ("", "/generations", "/learning", "/replicates", "/population", "/designs/0",
                      "/designs/0/ancestors", "/designs/0/descendants", "/phylogeny",
                      "/phylogeny?format=csv", "/phylogeny?format=newick", "/champions"):
            assert service.request("GET", f"/v1/campaigns/{id}{below}").status == 404, id + below
        if id != evaluation:
            for verb in ("pause", "resume", "cancel"):
                assert service.request("POST", f"/v1/jobs/{id}/{verb}").status == 404
        assert service.request("POST", f"/v1/campaigns/{id}/extend",
                               {"generations": 1}).status == 404
        assert service.request("GET", f"/v1/campaigns/{id}/checkpoints").status == service.request(
            "DELETE", f"/v1/campaigns/{id}/checkpoints").status == 404
        assert service.request("POST", f"/v1/campaigns/{id}/champions", {}).status == 404
    assert service.request("GET", f"/v1/evaluations/{evolved['id']}").status == 404
    assert service.request("GET", f"/v1/trainings/{evolved['id']}").status == 404
    assert service.request("GET", f"/v1/campaigns/{evolved['id']}/nothing").status == 404


def test_events(service, evolved):
    events = service.request(
        "GET", f"/v1/events?format=json&job={evolved['id']}&after=0&limit=1000").json()["items"]
    types = [event["type"] for event in events]
    assert types[0] == "job.created" and "job.started" in types and types[-1] == "job.finished"
    told = [event["data"] for event in events if event["type"] == "campaign.generation"]
    assert [data["generation"] for data in told] == [0, 1, 2, 3]
    rows = service.request("GET", evolved["links"]["generations"]).json()["items"]
    for data, row in zip(told, rows):
        assert set(data) >= {
            "id", "generation", "generations", "mean", "best", "diversity", "turnover",
            "seconds_left"
        }
        assert data["id"] == evolved["id"] and data["generations"] == 3 and abs(
            data["best"] - row["score"]["quantiles"]["p0"]) < 1e-6
        assert abs(data["mean"] - row["score"]["mean"]) < 1e-6 and abs(data["diversity"] -
                                                                       row["diversity"]) < 1e-6


def test_wait(service):
    id = service.request("POST", "/v1/campaigns", LONG).json()["id"]
    begun = time.monotonic()
    reply = service.request("GET", f"/v1/campaigns/{id}", headers={"Prefer": "wait=1"})
    assert reply.status == 200 and 0.8 < time.monotonic() - begun < 5 and reply.headers[
        "Preference-Applied"] == "wait=1"
    ended(service, [id])
    assert service.request("GET", f"/v1/campaigns/{id}", headers={"Prefer": "wait"}).status == 400


def test_a_training_on_a_population(service, evolved):
    value = {
        "kind": "finetune", "population": {"campaign": evolved["id"], "best": 3}, "steps": 1,
        "batch": 2, "physics": {"n_steps": 20}, "validation": {"every_steps": 0, "designs": 3}
    }
    reply = service.request("POST", "/v1/trainings", value)
    assert reply.status == 202, reply.body
    training = reply.json()
    assert training["settings"]["population"] == {"campaign": evolved["id"]
                                                  } and training["settings"]["n_designs"] == 3
    best = service.request("GET", evolved["links"]["population"] + "?limit=3").json()["items"]
    held_out = service.request("GET", training["links"]["held_out"]).json()
    assert [design["voxels"] for design in held_out["designs"]] == [row["genotype"] for row in best]
    assert training in service.request(
        "GET", "/v1/trainings").json()["items"] or training["state"] != "succeeded"
    for population, pointers in (({"evaluation": evolved["id"]}, ["/population/evaluation"]), ({
            "campaign": "999999"
    }, ["/population/campaign"]), ({"campaign": training["id"]}, ["/population/campaign"]),
                                 ({"campaign": 7}, ["/population/campaign"]),
                                 ({"campaign": evolved["id"], "evaluation": "999999"},
                                  ["/population",
                                   "/population/evaluation"]), ({"best": 3}, ["/population"])):
        reply = service.request("POST", "/v1/trainings", {**value, "population": population})
        assert reply.status == 422 and sorted(reply.pointers()) == pointers, reply.body


def test_campaigns_without_a_population(service):
    """Two that wait behind others: they have nothing yet, which is said."""
    holds = [service.request("POST", "/v1/campaigns", but(LONG, replicates=20)).json()["id"]]
    waits = service.request("POST", "/v1/campaigns", LONG).json()
    assert waits["state"] == "queued" and waits["progress"]["generation"] is None and waits[
        "newest"] is None
    path = f"/v1/campaigns/{waits['id']}"
    for below in ("/population", "/population?generation=0", "/champions",
                  "/champions?generation=0", "/designs/0"):
        reply = service.request("GET", path + below)
        assert reply.status == 404 and len(reply.json()["detail"]) > 30, reply.body
    assert service.request(
        "GET", path + "/generations").json() == {"items": [], "next_cursor": None}
    assert service.request("GET", path + "/phylogeny").json() == {"items": [], "next_cursor": None}
    assert service.request("GET", path + "/phylogeny?format=csv").body.count(b"\n") == 1
    assert service.request("GET", path + "/phylogeny?format=newick").body == b""
    reply = service.request("POST", path + "/champions", {})
    assert reply.status == 409 and len(reply.json()["detail"]) > 30, reply.body
    reply = service.request("POST", "/v1/campaigns", but(SMALL, initial={"campaign": waits["id"]}))
    assert reply.status == 409 and reply.pointers() == ["/initial/campaign"], reply.body
    reply = service.request("POST", "/v1/trainings",
                            {"kind": "finetune", "population": {"campaign": waits["id"]}})
    assert reply.status == 409 and reply.pointers() == ["/population/campaign"], reply.body
    ended(service, [str(int(holds[0]) + i) for i in range(20)] + [waits["id"]])


def test_clients_at_once(service):
    """Several clients submit, read, change and cancel side by side; every reply is whole and as the
    contract says."""
    def work(number):
        id = service.request("POST",
                             "/v1/campaigns",
                             but(SMALL, seed=100 + number),
                             headers={"Idempotency-Key": f"at-once-{number}"}).json()["id"]
        for below in ("", "/generations", "/population", "/phylogeny?format=csv", "/replicates",
                      "/phylogeny?format=newick"):
            assert service.request("GET", f"/v1/campaigns/{id}{below}").status in (200, 404)
        if number % 3 == 0:
            assert service.request("POST", f"/v1/jobs/{id}/cancel").status in (200, 409)
        return finished(service, id).json()

    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        done = list(pool.map(work, range(12)))
    assert len({one["id"] for one in done}) == 12
    assert all(one["state"] in (("succeeded", "cancelled") if i % 3 == 0 else ("succeeded", ))
               for i, one in enumerate(done))


def test_metrics(service, evolved, learned):
    assert evolved["state"] == learned["state"] == "succeeded"
    text = service.request("GET", "/metrics").body.decode()
    values = dict(line.rsplit(" ", 1) for line in text.splitlines() if not line.startswith("#"))
    assert float(values["morphod_campaign_generations_total"]) >= 7 and float(
        values["morphod_campaign_designs_total"]) >= 32
    assert float(values["morphod_campaign_rollouts_total"]) >= 32 and float(
        values["morphod_campaign_learning_steps_total"]) >= 6
    assert "morphod_campaigns_running" in values
    assert "morphod_campaign_rollouts_cached_total" in values
