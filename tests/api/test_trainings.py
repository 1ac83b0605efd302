"""Trainings: what is refused and why, submission, running to the end, curves, checkpoints,
controllers, held-out sets."""

import csv
import hashlib
import io
import json
import struct
import time
import urllib.parse

import pytest
from service import BOOTSTRAP, CONTRACT, DESIGN, SHORT, await_end, tiny_controller

BAR = {"cells": [[x, 2, 0] for x in range(4)]}
SMALL = {
    "steps": 6, "batch": 4, "physics": {"n_steps": 30},
    "validation": {"every_steps": 3, "designs": 3,
                   "environments": 2}, "checkpoint": {"every_steps": 2, "every_s": 0, "keep": 2}
}
TUNE = {"kind": "finetune", "designs": [DESIGN, BAR], **SMALL}
TRAIN = {"kind": "pretrain", **SMALL}
LONG = {
    "kind": "pretrain", "steps": 100000, "batch": 2, "physics": {"n_steps": 20},
    "validation": {"every_steps": 0}
}


def metadata(file):
    return json.loads(file[8:8 + struct.unpack("<Q", file[:8])[0]])["__metadata__"]


def with_field(name, value, base=None):
    return {**(base or {"kind": "pretrain"}), name: value}


INVALID = {
    "not an object": ([], [""]),
    "a string": ("pretrain", [""]),
    "nothing": ({}, [""]),
    "kind unknown": ({"kind": "train"}, ["/kind"]),
    "kind a number": ({"kind": 1}, ["/kind"]),
    "finetune on nothing": ({"kind": "finetune"}, [""]),
    "finetune on both": ({**TUNE, "population": {"evaluation": "999999"}},
                         ["", "/population/evaluation"]),
    "pretrain on designs": (with_field("designs", [DESIGN]), ["/designs"]),
    "pretrain on a population": (with_field("population", {"evaluation": "999999"}),
                                 ["/population", "/population/evaluation"]),
    "preset unknown": (with_field("preset", "demo"), ["/preset"]),
    "preset a number": (with_field("preset", 2), ["/preset"]),
    "preset null": (with_field("preset", None), ["/preset"]),
    "finetune as a pretraining was": (with_field("preset", "phototaxis", TUNE), ["/preset"]),
    "preset with too many bodies": ({"kind": "pretrain", "preset": "paper",
                                     "steps": 32769}, ["/steps"]),
    "unknown field": (with_field("epochs", 3), ["/epochs"]),
    "unknown field with odd characters": (with_field("a/b~cé", 3), ["/a~1b~0cé"]),
    "name not a name": (with_field("name", "Walker"), ["/name"]),
    "name with a path": (with_field("name", "../walker"), ["/name"]),
    "unknown controller": (with_field("controller", "nobody"), ["/controller"]),
    "unknown controller of a finetuning": (with_field("controller", "nobody",
                                                      TUNE), ["/controller"]),
    "unknown controller by hash": (with_field("controller", "sha256:" + "0" * 64), ["/controller"]),
    "finetune from nothing": (with_field("controller", None, TUNE), ["/controller"]),
    "sensor with a controller": (with_field("sensor", "inverse_sqrt",
                                            {"kind": "pretrain", "controller": "default"}),
                                 ["/sensor"]),
    "sensor of a finetuning": (with_field("sensor", "inverse_sqrt", TUNE), ["/sensor"]),
    "sensor unknown": (with_field("sensor", "camera"), ["/sensor"]),
    "designs empty": ({"kind": "finetune", "designs": []}, ["/designs"]),
    "design out of bounds": ({"kind": "finetune",
                              "designs": [DESIGN, {"cells": [[0, 0,
                                                              4]]}]}, ["/designs/1/cells/0/2"]),
    "10001 designs": ({"kind": "finetune", "designs": [DESIGN] * 10001}, ["/designs"]),
    "population of no evaluation": ({"kind": "finetune", "population": {"evaluation": "999999"}},
                                    ["/population/evaluation"]),
    "population without evaluation": ({"kind": "finetune", "population": {}}, ["/population"]),
    "population of two jobs": ({
        "kind": "finetune", "population": {"evaluation": "999999", "campaign": "999999"}
    }, ["/population", "/population/campaign"]),
    "population of no campaign": ({"kind": "finetune",
                                   "population": {"campaign": "999999"}}, ["/population/campaign"]),
    "population a number": ({"kind": "finetune",
                             "population": {"evaluation": 7}}, ["/population/evaluation"]),
    "best of none": ({"kind": "finetune",
                      "population": {"evaluation": "999999",
                                     "best": 0}}, ["/population/best", "/population/evaluation"]),
    "steps zero": (with_field("steps", 0), ["/steps"]),
    "steps negative": (with_field("steps", -5), ["/steps"]),
    "10^9 steps": (with_field("steps", 10**9), ["/steps"]),
    "steps beyond integers": (with_field("steps", 10**30), ["/steps"]),
    "half a step": (with_field("steps", 0.5), ["/steps"]),
    "batch zero": (with_field("batch", 0), ["/batch"]),
    "batch too large": (with_field("batch", 65537), ["/batch"]),
    "more bodies than there are": ({"kind": "pretrain", "steps": 10**6,
                                    "batch": 65536}, ["/steps"]),
    "seed negative": (with_field("seed", -1), ["/seed"]),
    "seed beyond 2^53": (with_field("seed", 2**53), ["/seed"]),
    "schedule unknown": (with_field("schedule", "paper"), ["/schedule"]),
    "schedule a number": (with_field("schedule", 0.001), ["/schedule"]),
    "schedule without kind": (with_field("schedule", {"peak": 0.001}), ["/schedule"]),
    "schedule of unknown kind": (with_field("schedule", {"kind": "linear"}), ["/schedule/kind"]),
    "rate negative": (with_field("schedule",
                                 {"kind": "cosine", "peak": -0.001}), ["/schedule/peak"]),
    "rate zero": (with_field("schedule", {"kind": "constant", "peak": 0}), ["/schedule/peak"]),
    "rate above one": (with_field("schedule",
                                  {"kind": "constant", "peak": 1.5}), ["/schedule/peak"]),
    "floor above peak": (with_field("schedule", {"kind": "cosine", "peak": 0.001, "floor": 0.01}),
                         ["/schedule/floor"]),
    "floor negative": (with_field("schedule",
                                  {"kind": "cosine", "floor": -0.01}), ["/schedule/floor"]),
    "decay zero": (with_field("schedule", {"kind": "restarts", "decay": 0}), ["/schedule/decay"]),
    "cycle of nothing": (with_field("schedule", {"kind": "restarts", "cycle_steps": 0}),
                         ["/schedule/cycle_steps"]),
    "unknown field of a schedule": (with_field("schedule",
                                               {"kind": "restarts", "min": 0}), ["/schedule/min"]),
    "beta of one": (with_field("adam", {"beta1": 1}), ["/adam/beta1"]),
    "epsilon zero": (with_field("adam", {"epsilon": 0}), ["/adam/epsilon"]),
    "adam a number": (with_field("adam", 0.9), ["/adam"]),
    "norm limit negative": (with_field("gradient_norm_limit", -1), ["/gradient_norm_limit"]),
    "adjoint bound negative": (with_field("adjoint_bound", -2), ["/adjoint_bound"]),
    "adjoint bound a word": (with_field("adjoint_bound", "off"), ["/adjoint_bound"]),
    "adjoint rule unknown": (with_field("adjoint_rule", "scale"), ["/adjoint_rule"]),
    "adjoint rule a number": (with_field("adjoint_rule", 1), ["/adjoint_rule"]),
    "adjoint rule null": (with_field("adjoint_rule", None), ["/adjoint_rule"]),
    "restart weight negative": (with_field("restart_weight", -1), ["/restart_weight"]),
    "restart weight too large": (with_field("restart_weight", 1e7), ["/restart_weight"]),
    "restart weight a word": (with_field("restart_weight", "3"), ["/restart_weight"]),
    "time step zero": (with_field("physics", {"dt_s": 0}), ["/physics/dt_s"]),
    "unknown physics": (with_field("physics", {"wind": 0}), ["/physics/wind"]),
    "validation of no designs": (with_field("validation", {"designs": 0}), ["/validation/designs"]),
    "65 environments": (with_field("validation",
                                   {"environments": 65}), ["/validation/environments"]),
    "checkpoints kept: none": (with_field("checkpoint", {"keep": 0}), ["/checkpoint/keep"]),
    "checkpoint in the past": (with_field("checkpoint", {"every_s": -1}), ["/checkpoint/every_s"]),
    "priority unknown": (with_field("priority", "urgent"), ["/priority"]),
    "label too long": (with_field("label", "x" * 201), ["/label"]),
    "all of it": ({
        "kind": "finetune", "controller": "nobody", "population": {"evaluation": "999999"},
        "steps": 10**9, "batch": 0, "schedule": {"kind": "cosine", "peak": -1}, "epochs": 7
    }, ["/steps", "/batch", "/schedule/peak", "/epochs", "/controller", "/population/evaluation"]),
}


@pytest.mark.parametrize("name", INVALID)
def test_invalid(service, name):
    value, pointers = INVALID[name]
    reply = service.request("POST", "/v1/trainings", value)
    assert reply.status == 422, reply.body
    assert reply.pointers() == pointers, reply.body
    for fault in reply.json()["errors"]:
        assert len(fault["detail"]) > 15


# What no schema can tell: it depends on several fields, or on what the service has.
BEYOND_SCHEMA = {
    "finetune on nothing", "finetune on both", "pretrain on designs", "pretrain on a population",
    "unknown controller", "unknown controller of a finetuning", "unknown controller by hash",
    "finetune from nothing", "sensor with a controller", "sensor of a finetuning",
    "population of no evaluation", "population of no campaign", "more bodies than there are",
    "floor above peak", "finetune as a pretraining was", "preset with too many bodies"
}


def test_the_contract_refuses_the_same():
    """schema/openapi.yaml and the service agree on what a request is."""
    for name, (value, _) in INVALID.items():
        try:
            CONTRACT.validate({"$ref": "#/components/schemas/TrainingRequest"}, value, name)
            assert name in BEYOND_SCHEMA, name
        except AssertionError as error:
            assert name not in BEYOND_SCHEMA and name in str(error), (name, error)
    post = CONTRACT.document["paths"]["/v1/trainings"]["post"]["requestBody"]["content"][
        "application/json"]
    for value in [TUNE, TRAIN, LONG] + [example["value"] for example in post["examples"].values()]:
        CONTRACT.validate(post["schema"], value, "an example")


@pytest.mark.parametrize(
    "body, pointer",
    [('{"kind":"pretrain","schedule":{"kind":"cosine","peak":1e400}}', "/schedule/peak"),
     ('{"kind":"pretrain","adjoint_bound":1e999}', "/adjoint_bound"),
     ('{"kind":"pretrain","steps":99999999999999999999}', "/steps")])
def test_numbers_that_are_not_finite(service, body, pointer):
    reply = service.request("POST", "/v1/trainings", body=body)
    assert reply.status == 422 and reply.pointers() == [pointer], reply.body


@pytest.mark.parametrize("body", [
    b"", b"{", b'{"kind":"pretrain","kind":"pretrain"}', b'{"steps":NaN}', b'{"kind":"pretrain"}x',
    b"kind=pretrain", b'{"kind":"\xff"}', b"[" * 1000
])
def test_malformed(service, body):
    reply = service.request("POST", "/v1/trainings", body=body)
    assert reply.status == 400 and reply.json()["type"] == "/problems/malformed-json", reply.body


def test_media_types(service):
    for headers, status in (({"Content-Type": "text/plain"}, 415), ({"Accept": "text/html"}, 406)):
        assert service.request("POST", "/v1/trainings", body="{}", headers=headers).status == status
    for method in ("PUT", "DELETE"):
        assert service.request(method, "/v1/trainings").status == 405


def test_controller_of_another_workspace(service):
    tiny_controller(service)
    reply = service.request("POST", "/v1/trainings", {**TUNE, "controller": "tiny"})
    assert reply.status == 422 and reply.pointers() == [
        "/controller"
    ] and "1 × 1 × 1" in reply.json()["detail"], reply.body
    both = service.request("POST", "/v1/trainings", {**TUNE, "controller": "tiny", "batch": 0})
    assert both.status == 422 and both.pointers() == ["/batch", "/controller"], both.body


def test_population_that_has_not_succeeded(service):
    body = {
        "designs": [DESIGN] + [{"cells": [[x, 0, 0]]} for x in range(3)],
        "physics": {"n_steps": 15000}, "priority": "batch"
    }
    job = service.request("POST", "/v1/evaluations", body).json()["id"]
    service.request("POST", f"/v1/jobs/{job}/pause")
    reply = service.request("POST", "/v1/trainings",
                            {"kind": "finetune", "population": {"evaluation": job}})
    assert reply.status == 409 and reply.pointers() == ["/population/evaluation"], reply.body
    service.request("POST", f"/v1/jobs/{job}/cancel")
    assert service.request("POST", "/v1/trainings",
                           {"kind": "finetune", "population": {"evaluation": job}}).status == 409


def finished(service, training, seconds=60):
    return await_end(service, f"/v1/trainings/{training}", seconds)


@pytest.fixture(scope="module")
def trained(service):
    """A small pretraining that has ended."""
    reply = service.request(
        "POST", "/v1/trainings",
        {**TRAIN, "name": "small", "label": "première", "schedule": "paper-pretrain"})
    assert reply.status == 202, reply.body
    accepted = reply.json()
    assert reply.headers["Location"] == f"/v1/trainings/{accepted['id']}"
    assert accepted["state"] in ("queued", "running") and accepted["controller"] is None
    done = finished(service, accepted["id"]).json()
    assert done["state"] == "succeeded", done
    return done


def test_settings_are_told_with_their_defaults(trained):
    settings = trained["settings"]
    assert settings["schedule"] == {
        "kind": "restarts", "peak": 0.001, "floor": 1e-05, "decay": 0.7, "cycle_steps": 10,
        "cycle_growth": 2, "warmup_steps": 0
    }
    assert settings["adam"] == {"beta1": 0.9, "beta2": 0.999, "epsilon": 1e-08
                                } and settings["adjoint_bound"] == 2
    assert settings["adjoint_rule"] == "clip" and settings["restart_weight"] == 3
    assert settings["sensor"] == "inverse_sqrt" and settings["physics"][
        "n_steps"] == 30 and settings["physics"]["dt_s"] == 0.004
    assert settings["seed"] == 1
    assert settings["n_designs"] is None
    assert settings["population"] is None
    assert trained["name"] == "small" and trained["label"] == "première" and trained[
        "parent"] is None


RESTARTS = {"kind": "restarts", "floor": 1e-05}
PHOTOTAXIS = {
    "steps": 1400, "batch": 8192, "adam": {"beta1": 0.8, "beta2": 0.999, "epsilon": 1e-08},
    "adjoint_bound": 8, "adjoint_rule": "restart", "restart_weight": 3, "schedule": {
        **RESTARTS, "peak": 0.002, "decay": 0.75, "cycle_steps": 61, "cycle_growth": 22,
        "warmup_steps": 5
    }
}
PAPER = {
    "steps": 1400, "batch": 8192, "adam": {"beta1": 0.9, "beta2": 0.999, "epsilon": 1e-08},
    "adjoint_bound": 0, "adjoint_rule": "clip", "restart_weight": 3, "schedule": {
        **RESTARTS, "peak": 0.001, "decay": 0.7, "cycle_steps": 10, "cycle_growth": 2,
        "warmup_steps": 0
    }
}
SCHEDULE = {
    **RESTARTS, "peak": 0.004, "decay": 0.7, "cycle_steps": 10, "cycle_growth": 2, "warmup_steps": 0
}
PRESETS = {
    "phototaxis": ({"preset": "phototaxis"}, PHOTOTAXIS),
    "paper": ({"preset": "paper"}, PAPER),
    "paper of a finetuning": ({**TUNE, "preset": "paper"}, {
        **PAPER, "steps": 6, "batch": 4, "schedule": {
            "kind": "restarts", "peak": 3.5e-4, "floor": 3.5e-5, "decay": 1, "cycle_steps": 100,
            "cycle_growth": 1, "warmup_steps": 0
        }
    }),
    "the default": ({**SMALL, "preset": "workstation"}, {
        "steps": 6, "batch": 4, "adam": PAPER["adam"], "adjoint_bound": 2, "adjoint_rule": "clip",
        "restart_weight": 3
    }),
    "overridden": ({**SMALL, "preset": "phototaxis", "adam": {"beta2": 0.99}, "adjoint_bound": 4}, {
        **PHOTOTAXIS, "steps": 6, "batch": 4, "adam": {**PHOTOTAXIS["adam"], "beta2": 0.99},
        "adjoint_bound": 4
    }),
    "another schedule": (
        {**SMALL, "preset": "phototaxis",
         "schedule": {"kind": "restarts",
                      "peak": 0.004}}, {**PHOTOTAXIS, "steps": 6, "batch": 4,
                                        "schedule": SCHEDULE}),
}


@pytest.mark.parametrize("name", PRESETS)
def test_presets(service, name):
    """A request that names one has its settings, but for those that it names itself."""
    request, settings = PRESETS[name]
    request = {"kind": "pretrain", **request}
    CONTRACT.validate({"$ref": "#/components/schemas/TrainingRequest"}, request, name)
    reply = service.request("POST", "/v1/trainings", request)
    assert reply.status == 202, reply.body
    assert service.request("POST", f"/v1/jobs/{reply.json()['id']}/cancel").status == 200
    told = reply.json()["settings"]
    assert {key: told[key] for key in settings} == settings
    assert told["seed"] == 1 and told["gradient_norm_limit"] == 1 and told["physics"][
        "dt_s"] == 0.004


def test_presets_are_named_where_one_is_unknown(service):
    reply = service.request("POST", "/v1/trainings", {"kind": "pretrain", "preset": "laptop"})
    assert reply.status == 422 and [fault["detail"] for fault in reply.json()["errors"]] == [
        'must be "workstation", "phototaxis" or "paper", got "laptop"'
    ], reply.body
    reply = service.request("POST", "/v1/trainings", {**TUNE, "preset": "phototaxis"})
    assert "of a finetuning" in reply.json()["errors"][0]["detail"], reply.body


def test_the_end(service, trained):
    progress = trained["progress"]
    assert progress["step"] == progress["steps"] == 6 and progress["mean_loss"] > 0 and progress[
        "seconds_left"] is None
    assert trained["controller"]["name"] == "small" and trained["phase"] == "idle" and trained[
        "error"] is None
    reply = service.request("GET", trained["links"]["controller"])
    assert hashlib.sha256(reply.body).hexdigest(
    ) == trained["controller"]["sha256"] and reply.headers["Morphod-Step"] == "6"
    assert service.request("GET",
                           "/v1/controllers/small/file").body == reply.body
    described = service.request("GET", "/v1/controllers/small").json()
    assert described["metadata"]["morphod.kind"] == "pretrain" and described["metadata"][
        "morphod.step"] == "6"
    again = service.request("GET",
                            trained["links"]["controller"],
                            headers={"If-None-Match": reply.headers["ETag"]})
    assert again.status == 304
    whole = service.request("GET", f"/v1/trainings/{trained['id']}")
    assert service.request("GET",
                           f"/v1/trainings/{trained['id']}",
                           headers={"If-None-Match": whole.headers["ETag"]}).status == 304
    scores = service.evaluate({"designs": [DESIGN], "controller": "small", "physics": SHORT}).json()
    assert scores["state"] == "succeeded" and scores["controller"]["sha256"] == trained[
        "controller"]["sha256"]


def test_the_rule_of_the_adjoint(service):
    """It and its weight are told, stand in the lineage, and decide what is learned: a bound this
    low is passed at once."""
    files = []
    for rule, weight in (("clip", 3), ("restart", 3), ("restart", None), ("restart", 0.5)):
        chosen = {"adjoint_rule": rule} | ({"restart_weight": weight} if weight else {})
        reply = service.request("POST", "/v1/trainings", {**TRAIN, "adjoint_bound": 0.1, **chosen})
        assert reply.status == 202, reply.body
        done = finished(service, reply.json()["id"]).json()
        assert done["state"] == "succeeded" and done["settings"]["adjoint_rule"] == rule and done[
            "progress"]["clipped_share"] > 0
        files.append(service.request("GET", done["links"]["controller"]).body)
        settings = json.loads(metadata(files[-1])["morphod.settings"])
        assert settings["adjoint_rule"] == rule and settings["restart_weight"] == done["settings"][
            "restart_weight"] == (weight or 3)
    assert files[1] == files[2] and len({file[-1000000:] for file in files}) == 3


def test_curve(service, trained):
    path = trained["links"]["steps"]
    page = service.request("GET", path).json()
    assert [row["step"] for row in page["items"]
            ] == [1, 2, 3, 4, 5, 6] and page["next_cursor"] is None
    rows = page["items"]
    assert all(row["mean_loss"] > 0 and row["gradient_norm"] > 0 and row["seconds"] > 0 and
               not row["skipped"] for row in rows)
    assert rows[0]["rate"] == 0.001
    first = service.request("GET", path + "?limit=4").json()
    assert first["next_cursor"] == "4" and first["items"] == rows[:4]
    assert service.request("GET", path + "?cursor=4").json()["items"] == rows[4:]
    end = service.request("GET", path + "?cursor=6").json()
    assert end == {"items": [], "next_cursor": None}
    assert [row["step"]
            for row in service.request("GET", path + "?stride=3").json()["items"]] == [3, 6]
    table = service.request("GET", path, headers={"Accept": "text/csv"})
    assert table.headers["Content-Type"].startswith("text/csv")
    lines = list(csv.DictReader(io.StringIO(table.body.decode())))
    assert [float(line["mean_loss"]) for line in lines] == [row["mean_loss"] for row in rows]
    assert list(lines[0]) == [
        "step", "mean_loss", "rate", "gradient_norm", "clipped_share", "clipped_robots_share",
        "diverged", "zeroed", "skipped", "bounded", "seconds"
    ]
    assert service.request("GET", path + "?format=csv").body == table.body
    assert service.request("GET", path + "?format=json",
                           headers={"Accept": "text/csv"}).json() == page
    part = service.request("GET", path + "?limit=2&cursor=1", headers={"Accept": "text/csv"})
    assert part.body.count(b"\n") == 3
    for bad in ("?cursor=-1", "?cursor=x", "?after=1", "?stride=0", "?limit=0", "?limit=1001",
                "?step=1",
                "?format=newick"):
        assert service.request("GET", path + bad).status == 400, bad
    assert service.request("GET", path, headers={"Accept": "image/png"}).status == 406
    reply = service.request("GET", path)
    assert service.request("GET", path,
                           headers={"If-None-Match": reply.headers["ETag"]}).status == 304


def test_validations(service, trained):
    path = trained["links"]["validations"]
    rows = service.request("GET", path).json()["items"]
    assert [row["step"] for row in rows] == [0, 3, 6] and trained["validation"] == rows[-1]
    assert all(row["rollouts"] == 6 and row["mean_score"] > 0 for row in rows)
    assert [row["step"]
            for row in service.request("GET", path + "?cursor=0").json()["items"]] == [3, 6]
    table = service.request("GET", path, headers={"Accept": "text/csv"}).body.decode()
    assert table.splitlines()[0] == "step,mean_score,standard_error,rollouts,diverged" and len(
        table.splitlines()) == 4
    assert service.request("GET", path + "?format=csv").body.decode() == table
    assert service.request("GET", path + "?format=json",
                           headers={"Accept": "text/csv"}).json()["items"] == rows
    assert service.request("GET", path + "?stride=2").status == 400


def test_validation_is_an_evaluation_of_the_held_out_set(service, trained):
    """What is told of the last step is what the same designs score with the result."""
    held_out = service.request("GET", trained["links"]["held_out"]).json()
    assert len(held_out["designs"]) == 3 and len(held_out["environments"]) == 2
    value = service.evaluate({**held_out, "controller": "small"}).json()
    scores = [result["score"] for result in value["results"]]
    assert abs(sum(scores) / 3 - trained["validation"]["mean_score"]) < 1e-12


def test_checkpoints(service, trained):
    items = service.request("GET", trained["links"]["checkpoints"]).json()["items"]
    assert [item["step"] for item in items] == [6, 4] and trained["checkpoint_step"] == 6
    assert all(item["size"] > 3 * 620912 * 4 for item in items)
    path = trained["links"]["controller"]
    middle = service.request("GET", path + "?step=4")
    assert middle.status == 200 and middle.headers["Morphod-Step"] == "4"
    put = service.request("PUT",
                          "/v1/controllers/middle/file",
                          body=middle.body,
                          headers={"Content-Type": "application/octet-stream"})
    assert put.json()["metadata"]["morphod.step"] == "4"
    result = service.request("GET", "/v1/controllers/small").json()["metadata"]
    assert put.json()["metadata"] == {**result, "morphod.step": "4"}
    last = service.request("GET", path + "?step=6")
    assert hashlib.sha256(last.body).hexdigest() == trained["controller"]["sha256"]
    gone = service.request("GET", path + "?step=2")
    assert gone.status == 404 and "checkpoints" in gone.json()["detail"]
    assert service.request("GET", path + "?step=0").status == 400
    assert service.request("GET", path, headers={"Accept": "text/csv"}).status == 406


def test_checkpoints_are_deleted(service):
    """What a training goes on from stays until it has ended; then nothing of it is needed."""
    running = service.request(
        "POST", "/v1/trainings",
        {**LONG, "checkpoint": {"every_steps": 1, "every_s": 0, "keep": 4}}).json()
    path = running["links"]["checkpoints"]
    deadline = time.monotonic() + 60
    while len(service.request("GET", path).json()["items"]) < 4:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    assert service.request("POST", f"/v1/jobs/{running['id']}/pause").status == 200
    while service.request("GET", f"/v1/trainings/{running['id']}").json()["phase"] != "idle":
        assert time.monotonic() < deadline
        time.sleep(0.02)
    steps = [item["step"] for item in service.request("GET", path).json()["items"]]
    reply = service.request("DELETE", f"{path}/{steps[0]}")
    assert reply.status == 409 and f"step {steps[0]}" in reply.json()["detail"], reply.body
    assert service.request("DELETE", f"{path}/{steps[1]}").json()["items"] == [{"step": steps[1]}]
    for bad in (steps[1], 999999, 0, "x", "1000001"):
        assert service.request("DELETE", f"{path}/{bad}").status == 404, bad
    reply = service.request("DELETE", path).json()
    assert reply["items"] == [{"step": step} for step in steps[2:]]
    assert reply["bytes"] > 12e6 * len(steps[2:])
    assert service.request("DELETE", path).json() == {"items": [], "bytes": 0}
    folder = service.state / "trainings" / running["id"]
    assert [file.name for file in folder.iterdir()] == [f"{steps[0]}.checkpoint"]
    assert service.request("GET",
                           running["links"]["controller"]).headers["Morphod-Step"] == str(steps[0])
    assert service.request("POST", f"/v1/jobs/{running['id']}/resume").status in (200, 202)
    while service.request("GET",
                          f"/v1/trainings/{running['id']}").json()["progress"]["step"] <= steps[0]:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    assert service.request("POST", f"/v1/jobs/{running['id']}/cancel").status in (200, 202)
    assert finished(service, running["id"]).json()["state"] == "cancelled"
    while service.request("GET", f"/v1/trainings/{running['id']}").json()["phase"] != "idle":
        assert time.monotonic() < deadline
    assert service.request("DELETE", path).json()["items"]
    while folder.exists():  # its thread may write one more, whose row is refused
        assert time.monotonic() < deadline
        time.sleep(0.02)
    assert service.request("GET",
                           f"/v1/trainings/{running['id']}").json()["checkpoint_step"] is None
    gone = service.request("GET", running["links"]["controller"])
    assert gone.status == 404 and "ended" in gone.json()["detail"]
    # One that has succeeded has a controller of its own.
    done = finished(
        service,
        service.request("POST", "/v1/trainings", {**TUNE, "name": "pruned"}).json()["id"]).json()
    assert service.request("DELETE", done["links"]["checkpoints"]).json()["items"] == [{"step": 6},
                                                                                       {"step": 4}]
    assert service.request("GET", done["links"]["controller"] + "?step=6").status == 200
    assert service.request("GET", done["links"]["controller"] + "?step=4").status == 404
    assert service.request("DELETE", "/v1/trainings/999999/checkpoints").status == 404
    assert service.request("DELETE", done["links"]["checkpoints"] + "?all=1").status == 400


def test_the_same_again(service, trained):
    """The same request gives the same file, under another name."""
    reply = service.request("POST", "/v1/trainings",
                            {**TRAIN, "name": "again", "schedule": "paper-pretrain"})
    done = finished(service, reply.json()["id"]).json()
    assert done["controller"]["sha256"] == trained["controller"]["sha256"]
    other = service.request("POST", "/v1/trainings",
                            {**TRAIN, "name": "other", "schedule": "paper-pretrain", "seed": 2})
    assert finished(
        service,
        other.json()["id"]).json()["controller"]["sha256"] != trained["controller"]["sha256"]


def test_finetune(service):
    reply = service.request("POST", "/v1/trainings", TUNE)
    assert reply.status == 202, reply.body
    done = finished(service, reply.json()["id"]).json()
    assert done["state"] == "succeeded" and done["name"] == f"training-{done['id']}" == done[
        "controller"]["name"]
    assert done["parent"]["name"] == "default" and done["parent"]["sha256"] == hashlib.sha256(
        BOOTSTRAP.read_bytes()).hexdigest()
    assert done["settings"]["n_designs"] == 2 and done["settings"]["sensor"] is None
    described = service.request("GET", f"/v1/controllers/{done['name']}").json()
    assert described["metadata"]["morphod.parent"].endswith(done["parent"]["sha256"])
    held_out = service.request("GET", done["links"]["held_out"]).json()
    placed = service.evaluate({"designs": [DESIGN, BAR], "physics": SHORT}).json()["results"]
    assert [design["voxels"]
            for design in held_out["designs"]] == [result["genotype"] for result in placed]


def test_finetune_a_population(service):
    designs = [DESIGN, BAR, {"cells": [[0, 0, 0], [0, 0, 1]]}]
    evaluation = service.evaluate({"designs": designs, "physics": {"n_steps": 60}}).json()
    best = sorted(evaluation["results"], key=lambda result: result["score"])[:2]
    body = {
        "kind": "finetune", "population": {"evaluation": evaluation["id"], "best": 2},
        **SMALL, "label": None
    }
    del body["label"]
    reply = service.request("POST", "/v1/trainings", body)
    assert reply.status == 202, reply.body
    training = reply.json()
    assert training["settings"]["population"] == {"evaluation": evaluation["id"]
                                                  } and training["settings"]["n_designs"] == 2
    held_out = service.request("GET", training["links"]["held_out"]).json()
    assert [design["voxels"]
            for design in held_out["designs"]] == [result["genotype"] for result in best]
    assert finished(service, training["id"]).json()["state"] == "succeeded"


def test_idempotency(service):
    key = {"Idempotency-Key": "training-one"}
    first = service.request("POST", "/v1/trainings", TUNE, headers=key)
    second = service.request("POST", "/v1/trainings", TUNE, headers=key)
    assert first.status == second.status == 202 and first.json()["id"] == second.json()["id"]
    other = service.request("POST", "/v1/trainings", {**TUNE, "batch": 5}, headers=key)
    assert other.status == 422 and other.json()["errors"][0]["header"] == "Idempotency-Key"
    population = {"kind": "finetune", "population": {"evaluation": first.json()["id"]}}
    other = service.request("POST", "/v1/trainings", population, headers=key)
    assert other.status == 422, other.body
    assert service.request("POST", "/v1/trainings", TUNE,
                           headers={"Idempotency-Key": ""}).status == 400


def test_lists(service, trained):
    seen, cursor = [], ""
    while cursor is not None:
        page = service.request("GET", "/v1/trainings?limit=2" +
                               (f"&cursor={cursor}" if cursor else "")).json()
        seen += [item["id"] for item in page["items"]]
        cursor = page["next_cursor"]
    assert seen == sorted(seen, key=int, reverse=True) and trained["id"] in seen and len(
        set(seen)) == len(seen)
    ended = service.request("GET", "/v1/trainings?state=succeeded&limit=1000").json()["items"]
    assert trained in ended
    page = service.request("GET", "/v1/trainings?state=succeeded")
    assert service.request("GET",
                           "/v1/trainings?state=succeeded",
                           headers={"If-None-Match": page.headers["ETag"]}).status == 304
    jobs = service.request("GET", "/v1/jobs?kind=training&limit=1000").json()["items"]
    assert {job["kind"] for job in jobs} == {"training"} and seen == [job["id"] for job in jobs]
    job = service.request("GET", trained["links"]["job"]).json()
    assert job["training"] == {"kind": "pretrain", "name": "small", "step": 6, "steps": 6
                               } and job["state"] == "succeeded"
    assert "training" not in {
        job["kind"]
        for job in service.request("GET", "/v1/jobs?kind=evaluation").json()["items"]
    }
    label = urllib.parse.quote(trained["label"])
    assert trained in service.request(
        "GET", f"/v1/trainings?label={label}&state=succeeded").json()["items"]
    assert service.request("GET", f"/v1/trainings?label={label}&state=failed").json()["items"] == []
    for bad in ("?state=done", "?cursor=x", "?limit=0", "?kind=pretrain"):
        assert service.request("GET", "/v1/trainings" + bad).status == 400, bad


def test_nothing_there(service, trained):
    evaluation = service.evaluate({"designs": [DESIGN], "physics": SHORT}).json()["id"]
    for id in ("999999", "0", "x", evaluation):
        for below in ("", "/steps", "/validations", "/checkpoints", "/controller", "/held-out"):
            assert service.request("GET", f"/v1/trainings/{id}{below}").status == 404, id + below
    assert service.request("GET", f"/v1/evaluations/{trained['id']}").status == 404
    assert service.request("GET", f"/v1/trainings/{trained['id']}/nothing").status == 404


def test_events(service, trained):
    events = service.request(
        "GET", f"/v1/events?format=json&job={trained['id']}&after=0&limit=1000").json()["items"]
    types = [event["type"] for event in events]
    assert types[0] == "job.created" and "job.started" in types and types[-1] == "job.finished"
    progress = [event["data"] for event in events if event["type"] == "training.progress"]
    assert progress and set(progress[-1]) >= {
        "id", "step", "steps", "mean_loss", "gradient_norm", "rate", "clipped_share",
        "bodies_per_s", "seconds_left"
    }
    assert progress[-1]["id"] == trained["id"] and progress[-1]["steps"] == 6
    assert [event["data"]["step"] for event in events
            if event["type"] == "training.validation"] == [0, 3, 6]
    assert [event["data"]["step"] for event in events
            if event["type"] == "training.checkpoint"][-1] == 6


def test_pause_resume_cancel(service):
    training = service.request("POST", "/v1/trainings", LONG).json()["id"]
    path = f"/v1/jobs/{training}"
    deadline = time.monotonic() + 30
    while service.request("GET", f"/v1/trainings/{training}").json()["progress"]["step"] == 0:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    running = service.request("GET", f"/v1/trainings/{training}").json()
    assert running["state"] == "running" and running["phase"] in (
        "learning", "saving") and running["reason"] is None
    assert service.request("POST", path + "/pause").json()["state"] == "paused"
    while service.request("GET", f"/v1/trainings/{training}").json()["phase"] != "idle":
        assert time.monotonic() < deadline
        time.sleep(0.05)
    paused = service.request("GET", f"/v1/trainings/{training}").json()
    assert paused[
        "state"] == "paused" and paused["checkpoint_step"] == paused["progress"]["step"] > 0
    early = service.request("GET", f"/v1/trainings/{training}/controller")
    assert early.status == 200 and early.headers["Morphod-Step"] == str(paused["checkpoint_step"])
    assert service.request("POST", path + "/resume").json()["state"] in ("queued", "running")
    while service.request(
            "GET",
            f"/v1/trainings/{training}").json()["progress"]["step"] <= paused["progress"]["step"]:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert service.request("POST", path + "/cancel").status == 200
    done = finished(service, training).json()
    assert done["state"] == "cancelled" and done["controller"] is None
    assert service.request("POST", path + "/cancel").status == 409


def test_lineage_of_the_code(start, tmp_path):
    """A training that goes on under another instruction set goes on, and says so wherever it is
    asked."""
    first = start("--isa=x86-64", state=tmp_path)
    training = first.request("POST", "/v1/trainings", {**LONG, "name": "mixed"}).json()
    assert training["code"] == []
    path = f"/v1/trainings/{training['id']}"
    deadline = time.monotonic() + 60
    while first.request("GET", path).json()["progress"]["step"] < 3:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    assert first.stop() == 0
    second = start("--isa=avx2", state=tmp_path)
    while len(second.request("GET", path).json()["code"]) < 2:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    code = second.request("GET", path).json()["code"]
    assert [entry["from_step"] for entry in code][0] == 0 < code[1]["from_step"]
    assert ["x86-64" in code[0]["fingerprint"], "avx2" in code[1]["fingerprint"]] == [True, True]
    assert second.request("GET", "/v1/trainings?limit=1").json()["items"][0]["code"] == code
    changes = [
        event for event in second.request("GET", "/v1/events?format=json").json()["items"]
        if event["type"] == "training.code_changed"
    ]
    assert [event["data"] for event in changes] == [{
        "id": training["id"], "from_step": code[1]["from_step"], "before": code[0]["fingerprint"],
        "fingerprint": code[1]["fingerprint"]
    }]
    assert "training.code_changed" in second.log_text()
    at = code[1]["from_step"]
    exported = second.request("GET", f"{path}/controller?step={at}")
    assert exported.status == 200 and json.loads(metadata(
        exported.body)["morphod.code"]) == code[:1]  # before the change
    while second.request("GET", path).json()["progress"]["step"] <= at:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    assert second.request("POST", f"/v1/jobs/{training['id']}/pause").status == 200
    while second.request("GET", path).json()["phase"] != "idle":
        assert time.monotonic() < deadline
        time.sleep(0.02)
    exported = second.request("GET", f"{path}/controller")
    assert int(exported.headers["Morphod-Step"]) > at and json.loads(
        metadata(exported.body)["morphod.code"]) == code


def test_wait(service):
    training = service.request("POST", "/v1/trainings", LONG).json()["id"]
    begun = time.monotonic()
    reply = service.request("GET", f"/v1/trainings/{training}", headers={"Prefer": "wait=1"})
    assert reply.status == 200 and 0.8 < time.monotonic() - begun < 5 and reply.headers[
        "Preference-Applied"] == "wait=1"
    assert reply.headers["Retry-After"]
    service.request("POST", f"/v1/jobs/{training}/cancel")
    assert service.request("GET", f"/v1/trainings/{training}",
                           headers={"Prefer": "wait"}).status == 400


def test_no_controller_yet(service):
    hold = service.request("POST", "/v1/trainings", LONG).json()["id"]
    waits = service.request("POST", "/v1/trainings", TUNE).json()["id"]
    reply = service.request("GET", f"/v1/trainings/{waits}/controller")
    assert reply.status == 404 and "yet" in reply.json()["detail"], reply.body
    assert service.request("GET", f"/v1/trainings/{waits}/steps").json() == {
        "items": [], "next_cursor": None
    }
    assert service.request("GET", f"/v1/trainings/{waits}/validations").json() == {
        "items": [], "next_cursor": None
    }
    assert service.request("GET", f"/v1/trainings/{waits}/checkpoints").json() == {"items": []}
    for id in (hold, waits):
        service.request("POST", f"/v1/jobs/{id}/cancel")


def test_held_out_sets(service):
    reply = service.request("GET", "/v1/held-out?seed=3&designs=5&environments=2")
    value = reply.json()
    assert len(value["designs"]) == 5 and len(value["environments"]) == 2
    more = service.request("GET", "/v1/held-out?seed=3&designs=6&environments=3").json()
    assert more["designs"][:5] == value["designs"] and more["environments"][:2] == value[
        "environments"]
    assert service.request("GET", "/v1/held-out?seed=4&designs=5&environments=2").json() != value
    assert service.request("GET",
                           "/v1/held-out?seed=3&designs=5&environments=2",
                           headers={"If-None-Match": reply.headers["ETag"]}).status == 304
    usual = service.request("GET", "/v1/held-out").json()
    assert len(usual["designs"]) == 64 and len(usual["environments"]) == 8
    evaluated = service.evaluate({**value, "physics": SHORT}).json()
    assert evaluated["state"] == "succeeded" and [
        result["genotype"] for result in evaluated["results"]
    ] == [d["voxels"] for d in value["designs"]]
    for bad in ("?seed=-1", "?seed=9007199254740992", "?designs=0", "?designs=1001",
                "?environments=65", "?environments=0", "?kind=x"):
        assert service.request("GET", "/v1/held-out" + bad).status == 400, bad


def test_metrics(service, trained):
    assert trained["state"] == "succeeded"
    text = service.request("GET", "/metrics").body.decode()
    values = dict(line.rsplit(" ", 1) for line in text.splitlines() if not line.startswith("#"))
    assert float(values["morphod_training_steps_total"]) >= 6 and float(
        values["morphod_training_checkpoints_total"]) >= 3
    assert float(values["morphod_training_robots_total"]) >= 24 and float(
        values["morphod_training_step_seconds_total"]) > 0
    assert "morphod_trainings_running" in values
    assert "morphod_training_robots_zeroed_total" in values
