"""The physics of requests: the defaults, and "paper" instead of an object."""

import pytest
from service import BOOTSTRAP, CONTRACT, DESIGN, run

BAR = {"cells": [[x, 2, 0] for x in range(4)]}
WORLD = {"light_xy_m": [4.5, 2.5], "terrain_sigma_m": 0.05, "seed": 7}
PAPER = {"dt_s": 0.004, "n_steps": 1000, "integrator": "paper"}
DEFAULT = {"dt_s": 0.002, "n_steps": 2000, "integrator": "split"}
LEARNS = {"mode": "simultaneous", "population": 2, "generations": 0}
JOBS = [("campaigns", LEARNS), ("campaigns", LEARNS | {"mode": "zero-shot"}),
        ("campaigns", {"mode": "study", "population": 2}),
        ("trainings", {"kind": "pretrain", "steps": 1}),
        ("trainings", {"kind": "finetune", "steps": 1, "designs": [DESIGN]})]
SCORED = {"designs": [DESIGN], "environments": [WORLD]}


def settings_of(service, path, request):
    """Returns the physics of a job that is cancelled at once."""
    job = service.post(f"/v1/{path}", request)
    service.withdraw(job["id"])
    return job["settings"]["physics"]


def starts_untrained(request):
    return "simultaneous" in request.values() or "pretrain" in request.values()


def test_defaults(service):
    default = DEFAULT | {"control_period_s": 0.016}
    physics = service.post("/v1/evaluations", SCORED)["physics"]
    assert physics | default == physics
    assert service.post("/v1/rollouts", SCORED)["physics"] == physics
    for path, request in JOBS:
        assert settings_of(service, path, request) == physics, request
        one = settings_of(service, path, request | {"physics": {"n_steps": 7}})
        assert one == physics | {"n_steps": 7}, request


def test_presets(service):
    """Settings in a request replace those of a preset, one by one, wherever they stand."""
    for path, request in JOBS:
        if request.get("mode") == "study":
            continue
        expected = PAPER | {"control_period_s": 0 if starts_untrained(request) else 0.016}
        physics = settings_of(service, path, request | {"preset": "paper"})
        assert physics | expected == physics, request
        one = settings_of(service, path, {"physics": {"n_steps": 7}, "preset": "paper", **request})
        assert one == physics | {"n_steps": 7}, request
    physics = settings_of(service, "trainings",
                          {"kind": "pretrain", "steps": 1, "preset": "phototaxis"})
    assert physics | {"dt_s": 0.002, "n_steps": 2000, "integrator": "split",
                      "control_period_s": 0.016} == physics


def test_paper_is_all_of_its_settings(service):
    """One word and the settings that it stands for are the same physics, with the same scores."""
    CONTRACT.validate({"$ref": "#/components/schemas/EvaluationRequest"},
                      SCORED | {"physics": "paper"}, "the word")
    word = service.post("/v1/rollouts", SCORED | {"physics": "paper"})
    spelled = service.post("/v1/rollouts", SCORED | {"physics": PAPER})
    assert word["physics_sha256"] == spelled["physics_sha256"]
    assert word["rollouts"] == spelled["rollouts"]
    physics = word["physics"]
    assert physics | PAPER | {"control_period_s": 0.016} == physics == spelled["physics"]

    first, second = (run(service, "evaluations", SCORED | {"physics": given, "label": str(given)})
                     for given in ("paper", PAPER))
    assert first["results"] == second["results"] and second["rollouts_cached"] == 1
    assert first["physics"] == second["physics"] == physics
    assert first["results"][0]["losses"] == [word["rollouts"][0]["loss"]]
    stored = service.get("/v1/designs/" + first["results"][0]["id"])["orientations"]
    assert word["physics_sha256"] in [score["physics"] for one in stored for score in one["scores"]]
    assert service.get("/v1/physics/" + word["physics_sha256"])["physics"] == physics

    for path, request in JOBS:
        whole = PAPER | ({"control_period_s": 0} if starts_untrained(request) else {})
        given = settings_of(service, path, request | {"physics": "paper"})
        assert given == settings_of(service, path, request | {"physics": whole}), request
        assert given == physics | whole, request


@pytest.mark.parametrize("text", ["", "Paper", "paper ", "default", "split", "x" * 100])
def test_other_words_are_refused(service, text):
    for path, request in (("evaluations", SCORED), ("rollouts", SCORED), *JOBS):
        reply = service.request("POST", f"/v1/{path}", request | {"physics": text})
        assert reply.status == 422 and reply.pointers() == ["/physics"], (path, reply.body)
        assert reply.json()["errors"][0]["detail"] == (
            f'must be an object or "paper", got "{text[:64]}"')


@pytest.mark.parametrize("other", [None, True, 1, ["paper"], {"paper": True}])
def test_what_is_neither_is_refused(service, other):
    for path, request in (("evaluations", SCORED), *JOBS):
        reply = service.request("POST", f"/v1/{path}", request | {"physics": other})
        assert reply.status == 422, (path, reply.body)
        assert reply.pointers() == ["/physics/paper" if isinstance(other, dict) else "/physics"]


def test_designs_are_ranked_under_one_physics(service):
    file = bytearray(BOOTSTRAP.read_bytes())
    file[-1] ^= 2  # a controller without other scores
    assert service.upload("ranked", bytes(file)).status == 201
    asked = {"controller": "ranked"}
    default = run(service, "evaluations", asked | {"designs": [DESIGN]})["results"]
    paper = run(service, "evaluations", asked | {"designs": [BAR], "physics": "paper"})["results"]
    run(service, "evaluations", asked | {"designs": [DESIGN, BAR], "physics": {"n_steps": 5}})

    def ranked(query):
        items = service.get("/v1/designs?sort=score&controller=ranked" + query)["items"]
        return [(item["id"], item["score"]) for item in items]

    best = [[(row["id"], row["score"]) for row in rows] for rows in (default, paper)]
    assert ranked("") == ranked("&physics=default") == best[0]
    assert ranked("&physics=paper") == best[1] != best[0]
    service.refuses("/v1/designs", "?sort=score&physics=split", "?sort=score&physics=",
                    "?physics=paper", "?sort=id&physics=default")
