"""Trainings in environments of their own: drawn per robot, validated in them, with tasks."""

import json
import subprocess

import pytest

from ctl import MORPHOCTL
from service import CONTRACT, DESIGN, awaited, run
from test_trainings import BAR, LONG, SMALL, metadata

WORLDS = [{"task": "walk"}, {"task": "walk", "terrain": {"kind": "stairs-up"}},
          {"task": "path"}, {"task": "photo", "light_xy_m": [4, 2.5]},
          {"light_xy_m": [3, 3.5], "terrain_sigma_m": 0.05, "seed": 4}]
QUICK = SMALL | {"validation": {"every_steps": 3, "designs": 2}}
TUNE = {"kind": "finetune", "designs": [DESIGN, BAR], "environments": WORLDS, **QUICK}


def train(service, value):
    CONTRACT.validate({"$ref": "#/components/schemas/TrainingRequest"}, value, "a training")
    return run(service, "trainings", value)


def losses(service, training):
    return [row["mean_loss"] for row in service.pages(training["links"]["steps"])]


def file_of(service, training):
    return service.request("GET", training["links"]["controller"]).body


@pytest.fixture(scope="module")
def tuned(service):
    return train(service, TUNE)


def test_they_are_reported(service, tuned):
    assert tuned["settings"]["environments"] == {"count": 5}
    assert tuned["settings"]["validation"]["environments"] == 5
    shown = subprocess.run([MORPHOCTL, "-s", f"http://{service.host}:{service.port}", "train",
                            "show", tuned["id"]], check=True, capture_output=True, text=True)
    assert "5 of the request" in shown.stdout
    listed = service.get(tuned["links"]["held_out"])["environments"]
    worlds = service.evaluate({"designs": [DESIGN], "environments": WORLDS,
                               "physics": {"n_steps": 10}}).json()["id"]
    stored = service.get(f"/v1/evaluations/{worlds}/environments")["items"]
    assert listed == [{key: value for key, value in world.items() if key != "sha256"}
                      for world in stored]
    plain = train(service, {key: value for key, value in TUNE.items() if key != "environments"})
    assert plain["settings"]["environments"] is None
    assert losses(service, plain) != losses(service, tuned)
    assert "morphod.environments_crc64" not in metadata(file_of(service, plain))
    kept = metadata(file_of(service, tuned))
    assert len(kept["morphod.environments_crc64"]) == 16
    assert json.loads(kept["morphod.settings"])["environments"] == 5


def test_validation_scores_in_all_of_them(service, tuned):
    rows = service.pages(tuned["links"]["validations"])
    assert [row["rollouts"] for row in rows] == [10, 10, 10]
    value = service.evaluate(service.get(tuned["links"]["held_out"]) |
                             {"controller": tuned["name"]}).json()
    scores = [result["score"] for result in value["results"]]
    assert abs(sum(scores) / 2 - tuned["validation"]["mean_score"]) < 1e-12
    assert [one["unit"] for one in value["results"][0]["losses"]] == ["m", "m", "m", "", ""]


def test_a_named_set_is_its_list(service):
    value = TUNE | {"environments": "morpho-12-hurdle"}
    named = train(service, value)
    assert named["settings"]["environments"] == "morpho-12-hurdle"
    assert named["settings"]["validation"]["environments"] == 10
    worlds = service.get("/v1/environment-sets/morpho-12-hurdle")["items"]
    for world in worlds:
        del world["sha256"]
    listed = train(service, value | {"environments": worlds})
    assert listed["settings"]["environments"] == {"count": 10}
    assert losses(service, named) == losses(service, listed)
    assert named["controller"]["sha256"] == listed["controller"]["sha256"]


def test_a_loss_is_the_mean_over_robots_and_tasks(service):
    """With one design and one step, the loss follows from the losses in the environments: it is
    the mean of four of them."""
    one = train(service, TUNE | {"designs": [DESIGN], "steps": 1, "environments": WORLDS[:3],
                                 "physics": {"n_steps": 300}})
    value = service.evaluate({"designs": [DESIGN], "environments": WORLDS[:3],
                              "physics": {"n_steps": 300}}).json()
    a, b, c = (entry["loss"] for entry in value["results"][0]["losses"])
    means = [(i * a + j * b + (4 - i - j) * c) / 4 for i in range(5) for j in range(5 - i)]
    assert min(abs(mean - losses(service, one)[0]) for mean in means) < 1e-6


def test_pretraining_with_other_seeds(service):
    value = {"kind": "pretrain", "environments": WORLDS, **QUICK}
    first, second, other = (train(service, value | {"seed": seed}) for seed in (5, 5, 6))
    assert losses(service, first) == losses(service, second) != losses(service, other)
    assert first["controller"]["sha256"] == second["controller"]["sha256"]
    weights = train(service, {"kind": "pretrain", "environments": WORLDS[:1] * 2, **QUICK})
    single = train(service, {"kind": "pretrain", "environments": WORLDS[:1], **QUICK})
    assert losses(service, weights) == losses(service, single)  # one world, listed twice


def test_a_restart_changes_nothing(start, tmp_path):
    """Stopped and started several times, a training ends with the same file as without."""
    value = {"kind": "pretrain", "environments": WORLDS, "steps": 40, "batch": 3, "seed": 9,
             "name": "own", "physics": {"n_steps": 300},
             "validation": {"every_steps": 20, "designs": 1},
             "checkpoint": {"every_steps": 7, "every_s": 0, "keep": 2}}
    quiet = start("--workers=1", state=tmp_path / "quiet")
    expected = file_of(quiet, train(quiet, value))
    state = tmp_path / "disturbed"
    one = start("--workers=2", state=state)
    path = f"/v1/trainings/{one.post('/v1/trainings', value)['id']}"
    stops = []
    for least in (3, 15, 25):
        awaited(one, path, lambda seen: seen["progress"]["step"] >= least)
        assert one.stop() == 0
        one = start("--workers=2", state=state)
        stops.append(one.get(path)["checkpoint_step"])
    done = awaited(one, path, lambda seen: seen["state"] == "succeeded")
    assert file_of(one, done) == expected and 0 < stops[0] < stops[-1] < 40, stops


def test_refusals(service):
    def refuse(value, pointer, detail):
        reply = service.request("POST", "/v1/trainings", value)
        assert reply.status == 422, reply.body
        (error, ) = reply.json()["errors"]
        assert error["pointer"] == pointer and detail in error["detail"], error

    refuse(TUNE | {"validation": {"environments": 5}}, "/validation/environments",
           "validated in all of them")
    refuse(TUNE | {"environments": []}, "/environments", "1 to 64")
    refuse(TUNE | {"environments": WORLDS[:1] * 65}, "/environments", "1 to 64")
    refuse(TUNE | {"environments": [{"task": "fly"}]}, "/environments/0/task", "walk")
    refuse(TUNE | {"environments": "morpho-12-fly"}, "/environments", "GET /v1/environment-sets")
    refuse(TUNE | {"environments": [{"light_xy_m": [2.5, 2.5], "task": "photo"}]},
           "/environments/0/light_xy_m", "from (2.5, 2.5)")


def test_a_light_near_the_start_is_warned_of(service):
    training = service.post("/v1/trainings", LONG | {"validation": {"every_steps": 0}} | {
        "environments": [{"light_xy_m": [2.7, 2.5], "task": "photo"}]})
    assert "light_near_start" in [warning["code"] for warning in training["warnings"]]
    assert service.act(training["id"], "cancel").status == 200


def test_morphoctl_starts_one(service, tmp_path):
    server = ["-s", f"http://{service.host}:{service.port}"]
    (tmp_path / "worlds.json").write_text(json.dumps(WORLDS), encoding="utf-8")
    for given, shown in (("morpho-12-walk", "morpho-12-walk"),
                         (tmp_path / "worlds.json", {"count": 5})):
        made = subprocess.run(
            [MORPHOCTL, *server, "train", "start", "pretrain", "--environments", str(given),
             "--steps", "1", "--batch", "2", "--validate-every", "0", "-p", "n_steps=20", "--json"],
            check=True, capture_output=True, text=True)
        job = json.loads(made.stdout.splitlines()[-1])
        assert service.get(f"/v1/trainings/{job['id']}")["settings"]["environments"] == shown
