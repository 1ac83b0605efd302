"""Warnings about successful jobs with questionable results: starts on steep ground, lights at the
start, time steps that are too large, robots that diverged, morphospaces without new bodies."""

import math
import struct

import pytest
from ctl import CELLS, ctl  # noqa: F401
from service import DESIGN, SHORT, SOURCE, await_end, run

# An L: one foot, and an arm above the ground.
HOOK = {"cells": [[0, 2, 0]] + [[x, 2, 1] for x in range(6)]}
BAR = {"cells": [[x, 2, 0] for x in range(4)]}
STIFF = {"n_steps": 20, "stiffness_n_per_m": 1e6}
HERE = [{"light_xy_m": [4.0, 2.5], "terrain_sigma_m": 0.05, "seed": 7}]
CAMPAIGN = {"mode": "zero-shot", "population": 6, "generations": 1, "environments": HERE,
            "seed": 3, "exclude_pretraining": False, "physics": SHORT}
LEARNING = {"parent_steps": 1, "child_steps": 2, "batch": 4}
TUNE = {"kind": "finetune", "designs": [DESIGN, BAR], "steps": 6, "batch": 4, "physics": STIFF,
        "validation": {"every_steps": 0}}


def flat(*lights):
    return [{"light_xy_m": list(light), "terrain_sigma_m": 0, "seed": 1} for light in lights]


def codes(job):
    return [warning["code"] for warning in job["warnings"]]


def warnings_of_events(service, job):
    """Returns the warnings in the events of a job, in order: the state at that time, and the
    code."""
    events = service.get(f"/v1/events?format=json&job={job['id']}")["items"]
    return [(event["data"]["state"], event["data"]["code"]) for event in events
            if event["type"] == "job.warning"]


def listed(service, job):
    jobs = service.get("/v1/jobs?limit=5")["items"]
    return next(item for item in jobs if item["id"] == job["id"])


# ---- starts ----


@pytest.mark.parametrize("slope", [0.4, 0.56, 1.0])
def test_a_body_with_an_overhang_gains_no_energy(service, slope):
    heights = [round(slope * 5 / 7 * x, 12) for _ in range(8) for x in range(8)]
    world = {"light_xy_m": [4.5, 2.5], "terrain_heights_m": heights}
    done = service.evaluate({
        "designs": [HOOK], "physics": {"actuation": 0, "n_steps": 250}, "record": ["com"],
        "record_stride": 1, "environments": [world]
    }).json()
    file = service.request("GET", f"/v1/evaluations/{done['id']}/trajectories?array=com").body
    frames = [z for _, _, z in struct.iter_unpack("<3d", file[-251 * 24:])]
    assert len(frames) == 251 and max(frames) <= frames[0] + 1e-6, max(frames) - frames[0]


# ---- lights ----

NEAR = [[2.5, 2.5], [2.45, 2.45], [2.5, 2.599], [2.401, 2.5]]


@pytest.mark.parametrize("light", NEAR)
def test_a_light_at_the_start_is_refused(service, light):
    worlds = flat([4.0, 2.5], light)
    for path, request in (("evaluations", {"designs": [DESIGN], "physics": SHORT}),
                          ("campaigns", CAMPAIGN),
                          ("campaigns", {"mode": "study", "population": 3}),
                          ("rollouts", {"designs": [DESIGN], "physics": SHORT})):
        reply = service.request("POST", f"/v1/{path}", request | {"environments": worlds})
        assert reply.status == 422, (path, reply.body)
        assert reply.pointers() == ["/environments/1/light_xy_m"], reply.body
        assert "0.1 m" in reply.json()["errors"][0]["detail"]


def test_a_light_near_the_start_is_flagged(service):
    done = service.evaluate({"designs": [DESIGN], "physics": SHORT,
                             "environments": flat([4.0, 2.5], [2.5, 2.61])}).json()
    assert codes(done) == codes(listed(service, done)) == ["light_near_start"], done
    assert "environment 1 is 0.11 m" in done["warnings"][0]["detail"]
    assert warnings_of_events(service, done) == [("queued", "light_near_start")]
    campaign = run(service, "campaigns", CAMPAIGN | {"environments": flat([2.5, 2.7])})
    assert codes(campaign) == ["light_near_start"]
    assert warnings_of_events(service, campaign) == [("queued", "light_near_start")]


def test_no_warning_without_a_reason(service):
    done = service.evaluate({"designs": [DESIGN], "physics": SHORT,
                             "environments": flat([2.5, 2.81])}).json()
    assert done["warnings"] == [] == warnings_of_events(service, done)
    assert service.evaluate({"designs": [DESIGN], "physics": SHORT}).json()["warnings"] == []


def test_another_duration_is_flagged(service):
    """With a smaller time step alone, rollouts are shorter."""
    request = {"designs": [DESIGN], "physics": {"dt_s": 0.001}}
    done = service.evaluate(request).json()
    assert codes(done) == codes(listed(service, done)) == ["other_duration"]
    assert done["warnings"][0]["detail"].endswith("set n_steps to 4000")
    assert codes(service.post("/v1/rollouts", request)) == ["other_duration"]
    request["physics"]["n_steps"] = 4000
    assert codes(service.evaluate(request).json()) == []


# ---- controllers that act in every step ----


def test_a_controller_without_a_period_is_flagged(service):
    """With short steps, and not with the paper's physics or a period of the request."""
    plain = SOURCE / "data" / "controllers" / "bootstrap.safetensors"
    assert service.upload("acts-always", plain.read_bytes()).status == 201
    request = {"designs": [DESIGN], "physics": {"n_steps": 4}, "controller": "acts-always"}
    done = service.evaluate(request).json()
    assert codes(done) == codes(listed(service, done)) == ["every_step"]
    assert '"physics": "paper"' in done["warnings"][0]["detail"]
    assert warnings_of_events(service, done) == [("queued", "every_step")]
    assert codes(service.post("/v1/rollouts", request)) == ["every_step"]
    for physics in ("paper", {"n_steps": 8, "control_period_s": 0.008}):
        assert codes(service.evaluate(request | {"physics": physics}).json()) == []


# ---- time steps beyond the linear stability bound ----


def bound_s(eigenvalue, stiffness, mass, drag, integrator):
    """Returns the largest stable step of docs/numerics.md, by bisection."""
    low, high = 0.0, 1.0
    for _ in range(60):
        dt = (low + high) / 2
        e = math.exp(-drag * dt)
        push = (1 - e) / (drag * dt) if integrator == "split" else 1
        stable = push * eigenvalue * stiffness / mass * dt * dt < 2 * (1 + e)
        low, high = (dt, high) if stable else (low, dt)
    return low


@pytest.mark.parametrize("integrator", ["paper", "split"])
def test_a_step_beyond_the_bound_is_flagged(service, integrator):
    """Every request with physics is warned at once; a step just below the bound gets no warning."""
    bound = bound_s(12, 50000, 2, 20, integrator)
    given = {"n_steps": 4, "stiffness_n_per_m": 50000, "mass_kg": 2, "drag_per_s": 20,
             "integrator": integrator}
    near, beyond = (given | dict.fromkeys(("dt_s", "control_period_s"), round(share * bound, 7))
                    for share in (0.999, 1.001))
    evaluation = {"designs": [DESIGN]}
    training = {"kind": "pretrain", "steps": 1, "batch": 2, "validation": {"every_steps": 0}}
    requests = [("evaluations", evaluation), ("evaluations", evaluation | {"environments": HERE}),
                ("trainings", training), ("campaigns", CAMPAIGN),
                ("campaigns", CAMPAIGN | {"environments": "paper-test"}),
                ("campaigns", {"mode": "study", "population": 3, "environments": HERE})]
    for path, request in requests:
        job = service.post(f"/v1/{path}", request | {"physics": beyond})
        assert codes(job)[-1] == "unstable_step", (path, job)
        detail = job["warnings"][-1]["detail"]
        assert f"dt_s {beyond['dt_s']:.6g} exceeds" in detail and integrator in detail, detail
        assert f" bound of {bound:.3g} for stiffness_n_per_m 50000, mass_kg 2" in detail, detail
        usable = float(detail.rsplit(" ", 1)[1])
        assert 0.7 * bound < usable <= 0.8 * bound, detail
        assert "unstable_step" in codes(listed(service, job))
        assert warnings_of_events(service, job)[0] == ("queued", "unstable_step")
        assert codes(service.post(f"/v1/{path}", request | {"physics": near})) == [], path
    rolled = service.post("/v1/rollouts", evaluation | {"physics": beyond})
    assert codes(rolled) == ["unstable_step"] and rolled["warnings"][0]["detail"] == detail
    assert codes(service.post("/v1/rollouts", evaluation | {"physics": near})) == []


# ---- robots that diverged ----


def test_an_evaluation_in_which_all_diverge(service):
    done = service.evaluate({"designs": [DESIGN, BAR], "environments": HERE,
                             "physics": STIFF}).json()
    assert done["state"] == "succeeded" and done["rollouts_diverged"] == 2
    assert codes(done) == codes(listed(service, done)) == ["all_diverged", "unstable_step"]
    assert "stiffness_n_per_m" in done["warnings"][0]["detail"]
    assert warnings_of_events(service, done) == [("queued", "unstable_step"),
                                                 ("succeeded", "all_diverged")]
    again = service.evaluate({"designs": [DESIGN, BAR], "environments": HERE,
                              "physics": STIFF}).json()
    assert again["rollouts_cached"] == 2 and codes(again)[0] == "all_diverged"


def test_an_evaluation_in_which_some_diverge(service):
    """The block of 144 voxels is less stable than one voxel."""
    done = service.evaluate({
        "designs": [{"voxels": "1" * 144}, {"cells": [[0, 0, 0]]}], "environments": HERE,
        "physics": {"integrator": "paper", "dt_s": 0.004, "n_steps": 300,
                    "stiffness_n_per_m": 30000}
    }).json()
    assert done["rollouts_diverged"] == 1, done
    assert codes(done) == ["diverged", "unstable_step"], done
    assert "1 of 2 rollouts" in done["warnings"][0]["detail"]


@pytest.mark.parametrize("steps, least", [(1, 1), (6, 6), (300, 10)])
def test_a_training_in_which_all_diverge_fails(service, steps, least):
    """The warning comes early; the training run keeps its curve, and a controller that has learned
    nothing is not stored."""
    job = service.post("/v1/trainings", TUNE | {"steps": steps, "name": f"stiff-{steps}"})
    failed = await_end(service, f"/v1/trainings/{job['id']}").json()
    assert failed["state"] == "failed" and failed["attempts"] == 1, failed
    first = "first step," if least == 1 else f"first {least} steps,"
    assert f"in the {first} every robot diverged" in failed["error"]["detail"]
    assert "stiffness_n_per_m" in failed["error"]["detail"]
    assert codes(failed) == codes(listed(service, failed)) == ["all_diverged", "unstable_step"]
    rows = service.pages(failed["links"]["steps"])
    assert [row["diverged"] for row in rows] == [4] * least
    assert service.request("GET", f"/v1/controllers/stiff-{steps}").status == 404


def test_a_campaign_in_which_all_diverge(service):
    done = run(service, "campaigns", CAMPAIGN | {"physics": STIFF})
    assert done["state"] == "succeeded" and done["newest"]["score"]["diverged"] == 6
    assert codes(done) == codes(listed(service, done)) == ["all_diverged", "unstable_step"]
    assert "generation 1" in done["warnings"][0]["detail"]
    shown = warnings_of_events(service, done)
    assert [code for _, code in shown] == ["unstable_step"] + ["all_diverged"] * 2, shown
    assert shown[-1][0] == "succeeded"


def test_a_campaign_that_cannot_learn_fails(service):
    job = service.post("/v1/campaigns", CAMPAIGN | {"mode": "few-shot", "physics": STIFF,
                                                    "learning": LEARNING})
    failed = await_end(service, f"/v1/campaigns/{job['id']}").json()
    assert failed["state"] == "failed" and failed["attempts"] == 1, failed
    assert "generation 0" in failed["error"]["detail"]
    assert "stiffness_n_per_m" in failed["error"]["detail"]


# ---- nothing new ----


def test_a_campaign_without_new_bodies(service):
    done = run(service, "campaigns", CAMPAIGN | {"workspace": [2, 1, 1], "generations": 5})
    assert done["end"] == "exhausted" and codes(done) == ["exhausted"]
    number = done["progress"]["generation"]
    assert done["warnings"][0]["detail"] == (
        f"it ended at generation {number} of 5 because no unseen bodies are left")
    assert warnings_of_events(service, done) == [("succeeded", "exhausted")]


# ---- morphoctl ----


def test_morphoctl_prints_warnings(ctl, service):
    stiff = "--physics n_steps=20 --physics stiffness_n_per_m=1e6"
    status, _, errors = ctl(f"eval {stiff}", CELLS)
    assert status == 0 and "warning: job" in errors and "every rollout diverged" in errors, errors
    done = service.get("/v1/evaluations?limit=1")["items"][0]
    assert codes(done) == ["all_diverged", "unstable_step"]
    for command, words in (("job show", "warning        every rollout diverged"),
                           ("watch", "job.warning"), ("wait", f"job {done['id']} has succeeded")):
        status, output, errors = ctl(f"{command} {done['id']}")
        assert status == 0 and words in output, (command, output, errors)
    assert "warning: job" in errors and "every rollout diverged" in errors, errors
    status, output, _ = ctl("job list --limit 1")
    assert "succeeded (all_diverged)" in output, output


def test_morphoctl_prints_warnings_about_a_request(ctl):
    physics = "--physics n_steps=4 --physics dt_s=0.006 --physics control_period_s=0.006"
    for command, given in ((f"eval --no-wait {physics}", CELLS),
                           (f"campaign start zero-shot --population 4 --generations 0 {physics}",
                            None)):
        status, output, errors = ctl(command, given) if given else ctl(command)
        assert status == 0 and output.strip().isdigit(), (output, errors)
        assert f" {output.strip()}: dt_s 0.006 exceeds the linear stability" in errors, errors


def test_morphoctl_watches_a_campaign_without_new_bodies(ctl):
    status, output, errors = ctl(
        "campaign start zero-shot --population 6 --generations 5 --workspace 2,1,1 "
        "--physics n_steps=20 --no-exclusions --watch")
    assert status == 0, errors
    assert "warning: campaign" in errors and "no unseen bodies are left" in errors, (output, errors)
