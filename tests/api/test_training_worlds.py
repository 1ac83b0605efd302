"""Training runs in environments of their own: drawn per robot, validated in them, with tasks."""

import json
import subprocess

import pytest

from ctl import MORPHOCTL
from service import CONTRACT, DESIGN, awaited, run
from test_trainings import BAR, LONG, SMALL, metadata

WORLDS = [{"task": "walk"}, {"task": "walk", "terrain": {"kind": "stairs-up"}},
          {"task": "path", "terrain": {"kind": "grid", "spacing_m": 0.3, "heights_m": [
              [0.01 * (i * j % 5) for i in range(30)] for j in range(20)]}},
          {"task": "photo", "light_xy_m": [4, 2.5]},
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
    assert "5 from the request" in shown.stdout
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


TASKS = ["walk", "photo", {"guide": {"kind": "moving", "light_xy_m": [4, 2.5]}}]


def test_tasks_in_random_terrains(service):
    value = {"kind": "pretrain", "tasks": TASKS, **SMALL, "name": "tasks"}
    done = train(service, value | {"validation": {"every_steps": 3, "designs": 2,
                                                  "environments": 4}})
    settings = done["settings"]
    assert settings["environments"] is None and settings["validation"]["environments"] == 4
    assert [task["objective"] for task in settings["tasks"]] == ["travel", "reach", "pursue"]
    assert service.get("/v1/trainings?limit=1")["items"][0]["settings"] == settings
    set_ = service.get(done["links"]["held_out"])
    tasks = [world.get("task", {"objective": "reach"}) for world in set_["environments"]]
    assert [task["objective"] for task in tasks] == ["travel", "reach", "pursue", "travel"]
    plain = service.get("/v1/held-out?seed=1&designs=2&environments=4")["environments"]
    assert [world["terrain_heights_m"] for world in plain] == [
        world["terrain_heights_m"] for world in set_["environments"]]
    assert plain[1] == set_["environments"][1]  # its light stands still
    value_ = service.evaluate(set_ | {"controller": "tasks"}).json()
    scores = [result["score"] for result in value_["results"]]
    assert abs(sum(scores) / 2 - done["validation"]["mean_score"]) < 1e-12
    described = metadata(file_of(service, done))
    assert json.loads(described["morphod.settings"])["tasks"] == 3
    # Only reaching lights is what a training run does without tasks.
    bare = {"kind": "pretrain", **SMALL}
    assert losses(service, train(service, bare | {"tasks": ["photo"]})) == losses(
        service, train(service, bare)) != losses(service, done)
    again = train(service, {"kind": "pretrain", **SMALL, "tasks": settings["tasks"]})
    assert losses(service, again) == losses(service, done)
    shown = subprocess.run([MORPHOCTL, "-s", f"http://{service.host}:{service.port}", "train",
                            "show", done["id"]], check=True, capture_output=True, text=True)
    assert "3 tasks in random terrains" in shown.stdout


@pytest.mark.parametrize("own", [{"environments": WORLDS}, {"tasks": TASKS}])
def test_a_restart_changes_nothing(start, tmp_path, own):
    """Stopped and started several times, a training run ends with the same file as without."""
    value = {"kind": "pretrain", **own, "steps": 40, "batch": 3, "seed": 9,
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
    refuse(TUNE | {"tasks": ["walk"]}, "/tasks", "cannot be combined with environments")
    bare = {"kind": "pretrain", **SMALL}
    refuse(bare | {"tasks": []}, "/tasks", "1 to 64 tasks")
    refuse(bare | {"tasks": "walk"}, "/tasks", "must be an array")
    refuse(bare | {"tasks": ["photo", "fly"]}, "/tasks/1", "walk")
    refuse(bare | {"tasks": [{"guide": {"kind": "moving", "light_xy_m": [2.5, 2.5]}}]},
           "/tasks/0/guide/light_xy_m", "from (2.5, 2.5)")
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
    made = subprocess.run(
        [MORPHOCTL, *server, "train", "start", "pretrain", "--tasks", "walk,photo", "--steps", "1",
         "--batch", "2", "--validate-every", "0", "-p", "n_steps=20", "--json"],
        check=True, capture_output=True, text=True)
    tasks = service.get(f"/v1/trainings/{json.loads(made.stdout.splitlines()[-1])['id']}"
                        )["settings"]["tasks"]
    assert [task["objective"] for task in tasks] == ["travel", "reach"]
    holey = subprocess.run([MORPHOCTL, *server, "train", "start", "pretrain", "--tasks",
                            "walk,,circle"], capture_output=True, text=True, check=False)
    assert holey.returncode != 0 and "/tasks/1" in holey.stderr
    for given, shown in (("morpho-12-walk", "morpho-12-walk"),
                         (tmp_path / "worlds.json", {"count": 5})):
        made = subprocess.run(
            [MORPHOCTL, *server, "train", "start", "pretrain", "--environments", str(given),
             "--steps", "1", "--batch", "2", "--validate-every", "0", "-p", "n_steps=20", "--json"],
            check=True, capture_output=True, text=True)
        job = json.loads(made.stdout.splitlines()[-1])
        assert service.get(f"/v1/trainings/{job['id']}")["settings"]["environments"] == shown
