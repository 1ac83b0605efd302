"""Training runs: their settings, running to the end, curves, checkpoints, controllers, held-out
sets."""

import hashlib
import json
import struct

import pytest

from service import (BOOTSTRAP, CONTRACT, DESIGN, SHORT, await_end, awaited, check_rows, run, until)

BAR = {"cells": [[x, 2, 0] for x in range(4)]}
SMALL = {
    "steps": 6, "batch": 4, "physics": {"n_steps": 30},
    "validation": {"every_steps": 3, "designs": 3, "environments": 2},
    "checkpoint": {"every_steps": 2, "every_s": 0, "keep": 2}
}
TUNE = {"kind": "finetune", "designs": [DESIGN, BAR], **SMALL}
TRAIN = {"kind": "pretrain", **SMALL}
LONG = {
    "kind": "pretrain", "steps": 100000, "batch": 2, "physics": {"n_steps": 20},
    "validation": {"every_steps": 0}
}


def metadata(file):
    return json.loads(file[8:8 + struct.unpack("<Q", file[:8])[0]])["__metadata__"]


def train(service, value):
    return run(service, "trainings", value)


def test_population_that_has_not_succeeded(service):
    designs = [DESIGN] + [{"cells": [[x, 0, 0]]} for x in range(3)]
    job = service.post("/v1/evaluations", {"designs": designs, "physics": {"n_steps": 15000},
                                           "priority": "batch"})["id"]
    for verb in ("pause", "cancel"):
        service.act(job, verb)
        reply = service.request("POST", "/v1/trainings",
                                {"kind": "finetune", "population": {"evaluation": job}})
        assert reply.status == 409 and reply.pointers() == ["/population/evaluation"], reply.body


@pytest.fixture(scope="module")
def trained(service):
    """A small pretraining run that has ended."""
    return train(service, TRAIN | {"name": "small", "schedule": "paper-pretrain"})


def test_settings_are_reported_with_their_defaults(trained):
    settings = trained["settings"]
    assert settings | {
        "schedule": {"kind": "restarts", "peak": 0.001, "floor": 1e-05, "decay": 0.7,
                     "cycle_steps": 10, "cycle_growth": 2, "warmup_steps": 0},
        "adam": {"beta1": 0.9, "beta2": 0.999, "epsilon": 1e-08}, "adjoint_bound": 2,
        "adjoint_rule": "clip", "restart_weight": 3, "sensor": "inverse_sqrt", "seed": 1,
        "gradient_norm_limit": 1, "n_designs": None, "population": None
    } == settings
    assert settings["physics"] | {"n_steps": 30, "dt_s": 0.002, "integrator": "split",
                                  "control_period_s": 0.016} == settings["physics"]
    assert trained["name"] == "small" and trained["parent"] is None


def test_a_preset_and_what_is_named_over_it(service):
    request = TRAIN | {"preset": "phototaxis", "adam": {"beta2": 0.99}, "adjoint_bound": 4}
    CONTRACT.validate({"$ref": "#/components/schemas/TrainingRequest"}, request, "a preset")
    training = service.post("/v1/trainings", request)
    service.withdraw(training["id"])
    assert training["settings"] | {
        "steps": 6, "batch": 4, "adam": {"beta1": 0.8, "beta2": 0.99, "epsilon": 1e-08},
        "adjoint_bound": 4, "adjoint_rule": "restart", "restart_weight": 3, "seed": 1,
        "schedule": {"kind": "restarts", "peak": 0.002, "floor": 1e-05, "decay": 0.75,
                     "cycle_steps": 61, "cycle_growth": 22, "warmup_steps": 5}
    } == training["settings"]
    for request, detail in (
        ({"kind": "pretrain", "preset": "laptop"},
         'must be "workstation", "phototaxis", "paper" or "robust", got "laptop"'),
        (TUNE | {"preset": "phototaxis"}, "for finetuning")):
        reply = service.request("POST", "/v1/trainings", request)
        assert reply.status == 422 and detail in reply.json()["errors"][0]["detail"], reply.body


def holds(value, shown):
    """Returns whether an object has these members, recursively."""
    return (all(holds(value[key], member) for key, member in shown.items())
            if isinstance(shown, dict) else value == shown)


COSINE = {"kind": "cosine", "peak": 2e-3, "floor": 1e-5, "warmup_steps": 10}
RESTARTS = {"kind": "restarts", "peak": 1e-3, "floor": 1e-5, "decay": 0.7, "cycle_steps": 10,
            "cycle_growth": 2, "warmup_steps": 0}
TUNED = {"kind": "cosine", "peak": 3e-4, "floor": 1e-6, "warmup_steps": 0}


@pytest.mark.parametrize("request_, shown", [
    ({"kind": "pretrain"}, {
        "steps": 1400, "batch": 256, "schedule": COSINE,
        "validation": {"every_steps": 50, "designs": 64, "environments": 8},
        "checkpoint": {"every_steps": 0, "every_s": 60, "keep": 3}}),
    ({"designs": [DESIGN], "kind": "finetune", "seed": 7},
     {"steps": 60, "batch": 256, "seed": 7, "schedule": TUNED, "n_designs": 1}),
    ({"kind": "pretrain", "controller": None, "sensor": "inverse_square"},
     {"sensor": "inverse_square"}),
    ({"preset": "paper", "kind": "pretrain"},
     {"batch": 8192, "schedule": RESTARTS, "adjoint_bound": 0}),
    (TUNE | {"preset": "paper"}, {"schedule": RESTARTS | {"peak": 3.5e-4, "floor": 3.5e-5,
                                                         "decay": 1, "cycle_steps": 100,
                                                         "cycle_growth": 1}}),
    ({"kind": "pretrain", "preset": "phototaxis", "schedule": {"kind": "restarts", "peak": 0.003}},
     {"batch": 8192, "schedule": RESTARTS | {"peak": 0.003}}),
    ({"kind": "pretrain", "schedule": "paper-simultaneous"},
     {"schedule": RESTARTS | {"decay": 0.65}}),
    # A peak below the default floor lowers the floor.
    ({"kind": "pretrain", "schedule": {"kind": "cosine", "peak": 1e-6}},
     {"schedule": COSINE | {"peak": 1e-6, "floor": 1e-6}}),
    ({"kind": "pretrain", "schedule": {"kind": "constant", "peak": 0.5, "warmup_steps": 0}},
     {"schedule": {"kind": "constant", "peak": 0.5, "warmup_steps": 0}}),
    (TRAIN | {"seed": 2**53 - 1, "batch": 65536, "physics": {"n_steps": 200,
                                                             "impact": "bisection8"},
              "adam": {"beta1": 0, "beta2": 0.5, "epsilon": 1e-6}, "gradient_norm_limit": 0,
              "adjoint_bound": 8, "adjoint_rule": "restart", "restart_weight": 0},
     {"seed": 2**53 - 1, "batch": 65536, "gradient_norm_limit": 0, "adjoint_bound": 8,
      "adam": {"beta1": 0, "beta2": 0.5, "epsilon": 1e-6}, "adjoint_rule": "restart",
      "restart_weight": 0})])
def test_settings_of_requests(service, request_, shown):
    training = service.post("/v1/trainings", request_)
    service.withdraw(training["id"])
    assert holds(training["settings"], shown), training["settings"]
    assert (training["parent"] is None) == (request_["kind"] == "pretrain")


def test_words_with_escapes(service):
    body = b'{"kind":"pretrain","preset":"\\u0070aper","steps":2}'
    training = service.post("/v1/trainings", body=body)
    service.withdraw(training["id"])
    assert training["settings"]["batch"] == 8192 and training["settings"]["steps"] == 2


def test_the_end(service, trained):
    progress = trained["progress"]
    assert progress["step"] == progress["steps"] == 6 and progress["mean_loss"] > 0
    assert progress["seconds_left"] is None and trained["phase"] == "idle"
    assert trained["controller"]["name"] == "small"
    reply = service.tagged(trained["links"]["controller"])
    assert hashlib.sha256(reply.body).hexdigest() == trained["controller"]["sha256"]
    assert reply.headers["Morphod-Step"] == "6"
    assert service.request("GET", "/v1/controllers/small/file").body == reply.body
    described = service.get("/v1/controllers/small")["metadata"]
    assert described["morphod.kind"] == "pretrain" and described["morphod.step"] == "6"
    assert described["morphod.version"].startswith(service.get("/healthz")["version"] + " ")
    job = service.get(trained["links"]["job"])
    assert job["training"] == {"kind": "pretrain", "name": "small", "step": 6, "steps": 6,
                               "score": trained["validation"]["mean_score"], "environments": None}
    scores = service.evaluate({"designs": [DESIGN], "controller": "small", "physics": SHORT}).json()
    assert scores["controller"]["sha256"] == trained["controller"]["sha256"]


def test_the_rule_of_the_adjoint(service):
    """The rule and its weight are reported, are part of the lineage, and affect learning: adjoints
    exceed such a low bound immediately."""
    files = []
    for rule, weight in (("clip", 3), ("restart", 3), ("restart", None), ("restart", 0.5)):
        chosen = {"adjoint_rule": rule} | ({"restart_weight": weight} if weight else {})
        done = train(service, TRAIN | {"adjoint_bound": 0.1} | chosen)
        assert done["progress"]["clipped_share"] > 0
        files.append(service.request("GET", done["links"]["controller"]).body)
        for settings in (done["settings"], json.loads(metadata(files[-1])["morphod.settings"])):
            assert settings["adjoint_rule"] == rule and settings["restart_weight"] == (weight or 3)
    assert files[1] == files[2] and len({file[-1000000:] for file in files}) == 3


def test_curve(service, trained):
    path = trained["links"]["steps"]
    rows = service.pages(path)
    assert [row["step"] for row in rows] == [1, 2, 3, 4, 5, 6] and rows[0]["rate"] == 0.001
    assert all(row["mean_loss"] > 0 and row["gradient_norm"] > 0 and row["seconds"] > 0 and
               not row["skipped"] for row in rows)
    check_rows(service, path, rows, ["step", "mean_loss", "gradient_norm"],
               lambda row: str(row["step"]))
    assert [row["step"] for row in service.get(path + "?stride=3")["items"]] == [3, 6]
    assert list(service.table(path + "?format=csv")[0]) == [
        "step", "mean_loss", "rate", "gradient_norm", "clipped_share", "clipped_robots_share",
        "diverged", "zeroed", "skipped", "bounded", "seconds"
    ]
    service.refuses(path, "?after=1", "?stride=0", "?step=1")


def test_validations(service, trained):
    """The last validation equals an evaluation of the held-out set with the result."""
    path = trained["links"]["validations"]
    rows = service.pages(path)
    assert [row["step"] for row in rows] == [0, 3, 6] and trained["validation"] == rows[-1]
    assert all(row["rollouts"] == 6 and row["mean_score"] > 0 for row in rows)
    check_rows(service, path, rows,
               ["step", "mean_score", "standard_error", "rollouts", "diverged"],
               lambda row: str(row["step"]))
    service.refuses(path, "?stride=2")
    held_out = service.get(trained["links"]["held_out"])
    assert len(held_out["designs"]) == 3 and len(held_out["environments"]) == 2
    value = service.evaluate(held_out | {"controller": "small"}).json()
    scores = [result["score"] for result in value["results"]]
    assert abs(sum(scores) / 3 - trained["validation"]["mean_score"]) < 1e-12
    events = service.get(
        f"/v1/events?format=json&job={trained['id']}&after=0&limit=1000")["items"]
    steps = {kind: [event["data"]["step"] for event in events if event["type"] == kind]
             for kind in ("training.validation", "training.checkpoint")}
    assert steps["training.validation"] == [0, 3, 6] and steps["training.checkpoint"][-1] == 6


def test_checkpoints(service, trained):
    items = service.get(trained["links"]["checkpoints"])["items"]
    assert [item["step"] for item in items] == [6, 4] and trained["checkpoint_step"] == 6
    assert all(item["size"] > 3 * 620912 * 4 for item in items)
    path = trained["links"]["controller"]
    middle = service.request("GET", path + "?step=4")
    assert middle.status == 200 and middle.headers["Morphod-Step"] == "4"
    result = service.get("/v1/controllers/small")["metadata"]
    put = service.upload("middle", middle.body).json()
    assert put["metadata"] == result | {"morphod.step": "4"}
    last = service.request("GET", path + "?step=6")
    assert hashlib.sha256(last.body).hexdigest() == trained["controller"]["sha256"]
    gone = service.request("GET", path + "?step=2")
    assert gone.status == 404 and "checkpoints" in gone.json()["detail"]
    service.refuses(path, "?step=0")
    assert service.request("GET", path, headers={"Accept": "text/csv"}).status == 406


def await_idle(service, path):
    return awaited(service, path, lambda seen: seen["phase"] == "idle")


def test_checkpoints_are_deleted(service):
    """The checkpoint from which a training run continues stays until it has ended; after that, none
    is needed."""
    def delete(path):
        return service.request("DELETE", path).json()

    running = service.post("/v1/trainings", LONG | {
        "checkpoint": {"every_steps": 1, "every_s": 0, "keep": 4}})
    path, itself = running["links"]["checkpoints"], f"/v1/trainings/{running['id']}"
    awaited(service, path, lambda seen: len(seen["items"]) == 4)
    assert service.act(running["id"], "pause").status == 200
    await_idle(service, itself)
    steps = [item["step"] for item in service.get(path)["items"]]
    reply = service.request("DELETE", f"{path}/{steps[0]}")
    assert reply.status == 409 and f"step {steps[0]}" in reply.json()["detail"], reply.body
    assert delete(f"{path}/{steps[1]}")["items"] == [{"step": steps[1]}]
    for bad in (steps[1], 999999, 0, "x", "1000001"):
        assert service.request("DELETE", f"{path}/{bad}").status == 404, bad
    reply = delete(path)
    assert reply["items"] == [{"step": step} for step in steps[2:]]
    assert reply["bytes"] > 12e6 * len(steps[2:])
    assert delete(path) == {"items": [], "bytes": 0}
    folder = service.state / "trainings" / running["id"]
    assert [file.name for file in folder.iterdir()] == [f"{steps[0]}.checkpoint"]
    controller = service.request("GET", running["links"]["controller"])
    assert controller.headers["Morphod-Step"] == str(steps[0])
    assert service.act(running["id"], "resume").status in (200, 202)
    awaited(service, itself, lambda seen: seen["progress"]["step"] > steps[0])
    assert service.act(running["id"], "cancel").status in (200, 202)
    assert await_idle(service, itself)["state"] == "cancelled"
    assert delete(path)["items"]
    until(lambda: not folder.exists())  # its thread may write one more file, but its row is refused
    assert service.get(itself)["checkpoint_step"] is None
    gone = service.request("GET", running["links"]["controller"])
    assert gone.status == 404 and "ended" in gone.json()["detail"]
    # A training run that has succeeded has a resulting controller.
    links = train(service, TUNE | {"name": "pruned"})["links"]
    assert delete(links["checkpoints"])["items"] == [{"step": 6}, {"step": 4}]
    service.refuses(links["controller"], "?step=6", status=200)
    service.refuses(links["controller"], "?step=4", status=404)
    assert service.request("DELETE", links["checkpoints"] + "?all=1").status == 400


def test_the_same_again(service, trained):
    """The same request yields the same file, under another name."""
    request = TRAIN | {"schedule": "paper-pretrain"}
    again = train(service, request | {"name": "again"})["controller"]["sha256"]
    other = train(service, request | {"name": "other", "seed": 2})["controller"]["sha256"]
    assert again == trained["controller"]["sha256"] != other


def test_finetune(service):
    done = train(service, TUNE)
    assert done["name"] == f"training-{done['id']}" == done["controller"]["name"]
    assert done["parent"] == {
        "name": "default", "sha256": hashlib.sha256(BOOTSTRAP.read_bytes()).hexdigest()
    }
    assert done["settings"]["n_designs"] == 2 and done["settings"]["sensor"] is None
    described = service.get(f"/v1/controllers/{done['name']}")
    assert described["metadata"]["morphod.parent"].endswith(done["parent"]["sha256"])
    held_out = service.get(done["links"]["held_out"])["designs"]
    placed = service.evaluate({"designs": [DESIGN, BAR], "physics": SHORT}).json()["results"]
    assert [one["voxels"] for one in held_out] == [result["genotype"] for result in placed]


def test_finetune_a_population(service):
    designs = [DESIGN, BAR, {"cells": [[0, 0, 0], [0, 0, 1]]}]
    evaluation = service.evaluate({"designs": designs, "physics": {"n_steps": 60}}).json()
    best = sorted(evaluation["results"], key=lambda result: result["score"])[:2]
    population = {"evaluation": evaluation["id"], "best": 2}
    training = train(service, {"kind": "finetune", "population": population, **SMALL})
    assert training["settings"]["population"] == {"evaluation": evaluation["id"]}
    assert training["settings"]["n_designs"] == 2
    held_out = service.get(training["links"]["held_out"])["designs"]
    assert [one["voxels"] for one in held_out] == [result["genotype"] for result in best]


def test_a_pause_writes_a_checkpoint(service):
    training = service.post("/v1/trainings", LONG)["id"]
    path = f"/v1/trainings/{training}"
    running = awaited(service, path, lambda seen: seen["progress"]["step"] > 0)
    assert running["phase"] in ("learning", "saving")
    assert service.act(training, "pause").status == 200
    paused = await_idle(service, path)
    assert paused["checkpoint_step"] == paused["progress"]["step"] > 0
    early = service.request("GET", path + "/controller")
    assert early.status == 200 and early.headers["Morphod-Step"] == str(paused["checkpoint_step"])
    assert service.act(training, "cancel").status == 200
    assert await_end(service, path).json()["controller"] is None


def test_lineage_of_the_code(start, tmp_path):
    """A training run continues under another instruction set, and reports this everywhere."""
    first = start("--isa=x86-64", state=tmp_path)
    training = first.post("/v1/trainings", LONG | {"name": "mixed"})
    assert training["code"] == []
    path = f"/v1/trainings/{training['id']}"
    awaited(first, path, lambda seen: seen["progress"]["step"] >= 3)
    assert first.stop() == 0
    second = start("--isa=avx2", state=tmp_path)
    code = awaited(second, path, lambda seen: len(seen["code"]) == 2)["code"]
    assert code[0]["from_step"] == 0 < code[1]["from_step"]
    assert "x86-64" in code[0]["fingerprint"] and "avx2" in code[1]["fingerprint"]
    assert second.get("/v1/trainings?limit=1")["items"][0]["code"] == code
    changes = [event["data"] for event in second.get("/v1/events?format=json")["items"]
               if event["type"] == "training.code_changed"]
    at = code[1]["from_step"]
    assert changes == [{"id": training["id"], "from_step": at, "before": code[0]["fingerprint"],
                        "fingerprint": code[1]["fingerprint"]}]
    assert "training.code_changed" in second.log_text()
    exported = second.request("GET", f"{path}/controller?step={at}")
    assert exported.status == 200  # before the change
    assert json.loads(metadata(exported.body)["morphod.code"]) == code[:1]
    awaited(second, path, lambda seen: seen["progress"]["step"] > at)
    assert second.act(training["id"], "pause").status == 200
    await_idle(second, path)
    exported = second.request("GET", f"{path}/controller")
    assert int(exported.headers["Morphod-Step"]) > at
    assert json.loads(metadata(exported.body)["morphod.code"]) == code


def test_no_controller_yet(service):
    hold = service.post("/v1/trainings", LONG)["id"]
    waits = service.post("/v1/trainings", TUNE)["id"]
    path = f"/v1/trainings/{waits}"
    reply = service.request("GET", path + "/controller")
    assert reply.status == 404 and "yet" in reply.json()["detail"], reply.body
    nothing = {"items": [], "next_cursor": None}
    assert service.get(path + "/steps") == service.get(path + "/validations") == nothing
    assert service.get(path + "/checkpoints") == {"items": []}
    for id in (hold, waits):
        service.act(id, "cancel")


def test_held_out_sets(service):
    value = service.tagged("/v1/held-out?seed=3&designs=5&environments=2").json()
    assert len(value["designs"]) == 5 and len(value["environments"]) == 2
    more = service.get("/v1/held-out?seed=3&designs=6&environments=3")
    assert more["designs"][:5] == value["designs"]
    assert more["environments"][:2] == value["environments"]
    assert service.get("/v1/held-out?seed=4&designs=5&environments=2") != value
    usual = service.get("/v1/held-out")
    assert len(usual["designs"]) == 64 and len(usual["environments"]) == 8
    results = service.evaluate(value | {"physics": SHORT}).json()["results"]
    assert [one["genotype"] for one in results] == [one["voxels"] for one in value["designs"]]
    service.refuses("/v1/held-out", "?seed=-1", "?seed=9007199254740992", "?designs=0", "?kind=x",
                    "?designs=1001", "?environments=65", "?environments=0")
