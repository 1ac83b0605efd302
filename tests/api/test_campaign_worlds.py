"""Campaigns that learn in their own environments, with tasks."""

import json
import signal
import subprocess

import pytest

from archives import unpack
from ctl import MORPHOCTL
from service import CONTRACT, DESIGN, await_end, awaited, run

BAR = {"cells": [[x, 2, 0] for x in range(4)]}
PLAIN = [{"light_xy_m": [4.0, 2.5], "terrain_sigma_m": 0.05, "seed": 7}]
WORLDS = [{"task": "walk"}, {"task": "walk", "terrain": {"kind": "stairs-up"}}, {"task": "path"},
          {"task": "photo", "light_xy_m": [4, 2.5]}]
LEARNING = {"parent_steps": 1, "child_steps": 2, "batch": 4}
CAMPAIGN = {"mode": "few-shot", "population": 4, "generations": 2, "environments": WORLDS,
            "physics": {"n_steps": 120}, "exclude_pretraining": False, "learning": LEARNING}
LISTS = ["generations", "population", "phylogeny?limit=1000", "learning"]
TILT = {"task": {"guide": {"kind": "ahead"}, "objective": {"travel": 1, "tilt_rad": -1}}}


def evolve(service, value):
    CONTRACT.validate({"$ref": "#/components/schemas/CampaignRequest"}, value, "a campaign")
    return run(service, "campaigns", value)


def learning_of(service, campaign):
    return [row["mean_loss"] for row in service.pages(f"/v1/campaigns/{campaign['id']}/learning")]


def history(service, id):
    """Returns what depends only on settings and seed."""
    rows = [service.get(f"/v1/campaigns/{id}/{name}")["items"] for name in LISTS]
    for generation in rows[0]:
        for key in ("seconds", "stored_at", "rollouts_cached", "rollouts"):
            generation.pop(key, None)
        generation["learning"].pop("seconds", None)
    for step in rows[3]:
        step.pop("seconds", None)
    done = service.get(f"/v1/campaigns/{id}")
    return rows, done["result"]["controller"]["sha256"]


def worlds(value, word):
    return value | {"learning": value["learning"] | {"worlds": word}}


def test_the_steps_are_those_of_a_training(service):
    """A simultaneous campaign without further generations is a finetuning run on its founders."""
    founders = [DESIGN, BAR, *({"voxels": one["genotype"]} for one in service.post(
        "/v1/bodies/random", {"count": 2, "seed": 3})["items"])]
    schedule = {"kind": "constant", "peak": 1e-4, "warmup_steps": 0}
    shared = {"environments": WORLDS, "physics": CAMPAIGN["physics"], "seed": 11}
    tuned = run(service, "trainings", shared | {
        "kind": "finetune", "designs": founders, "steps": 3, "batch": 4, "schedule": schedule,
        "validation": {"every_steps": 0}})
    campaign = evolve(service, shared | {
        "mode": "simultaneous", "controller": "default", "population": 4, "generations": 0,
        "initial": {"designs": founders}, "exclude_pretraining": False,
        "learning": {"parent_steps": 1, "child_steps": 3, "batch": 4, "schedule": schedule}})
    steps = [row["mean_loss"] for row in service.pages(tuned["links"]["steps"])]
    assert learning_of(service, campaign) == steps and len(steps) == 3
    # The weights are the same, too.
    scored = [service.evaluate({"designs": founders, "environments": WORLDS, "controller": name,
                                "physics": CAMPAIGN["physics"]}).json()["results"]
              for name in (tuned["name"], campaign["result"]["controller"]["name"])]
    assert [[one["score"] for one in results] for results in scored][0] == [
        one["score"] for one in scored[1]]


def test_where_they_learn_by_default(service):
    """In the campaign's environments if one of them has a task, a profile or damage; in others,
    which earlier versions accepted, in random ones."""
    value = CAMPAIGN | {"generations": 0}
    for environments, word in ((WORLDS, "environments"), (PLAIN, "random"), (None, "random"),
                               ("morpho-12-walk", "environments"), ("morpho-12-photo", "random"),
                               ("morpho-12-damage", "environments")):
        asked = value | {"environments": environments}
        if environments is None:
            del asked["environments"]
        done = evolve(service, asked)
        assert done["settings"]["learning"]["worlds"] == word
        same, other = (evolve(service, worlds(asked, one)) for one in (
            word, "random" if word == "environments" else "environments"))
        assert learning_of(service, same) == learning_of(service, done)
        assert learning_of(service, other) != learning_of(service, done)
    frozen = run(service, "campaigns", {
        key: item for key, item in value.items() if key != "learning"} | {"mode": "zero-shot"})
    assert frozen["settings"]["learning"] is None


def test_tasks_on_random_terrains(service):
    """Robots have the tasks of the campaign's environments, and terrains of their own: a
    simultaneous campaign without further generations is a finetuning run that learns these
    tasks."""
    founders = [DESIGN, BAR]
    tasks = ["walk", "path", "shuttle"]
    schedule = {"kind": "constant", "peak": 1e-4, "warmup_steps": 0}
    shared = {"physics": CAMPAIGN["physics"], "seed": 11}
    tuned = run(service, "trainings", shared | {
        "kind": "finetune", "designs": founders, "tasks": tasks, "steps": 3, "batch": 4,
        "schedule": schedule, "validation": {"every_steps": 0}})

    def learn(word, **terrain):
        return evolve(service, shared | {
            "mode": "simultaneous", "controller": "default", "population": 2, "generations": 0,
            "initial": {"designs": founders}, "exclude_pretraining": False,
            "environments": [{"task": task, **terrain} for task in tasks],
            "learning": {"parent_steps": 1, "child_steps": 3, "batch": 4, "schedule": schedule,
                         "worlds": word}})

    campaign = learn("tasks")
    assert campaign["settings"]["learning"]["worlds"] == "tasks"
    steps = [row["mean_loss"] for row in service.pages(tuned["links"]["steps"])]
    assert learning_of(service, campaign) == steps and len(steps) == 3
    # The terrains of the environments count for the scores alone.
    stairs = {"terrain": {"kind": "stairs-up"}}
    assert learning_of(service, learn("tasks", **stairs)) == steps
    assert learning_of(service, learn("environments", **stairs)) != steps
    assert learning_of(service, learn("random", **stairs)) != steps


def test_a_named_set_is_its_list(service):
    listed = service.get("/v1/environment-sets/morpho-12-hurdle")["items"]
    for world in listed:
        del world["sha256"]
    one, two = (evolve(service, CAMPAIGN | {"environments": environments})
                for environments in ("morpho-12-hurdle", listed))
    assert one["settings"]["environments"] == "morpho-12-hurdle"
    assert learning_of(service, one) == learning_of(service, two)
    assert history(service, one["id"])[1] == history(service, two["id"])[1]


def test_refusals(service):
    def refuse(value, pointer, words):
        reply = service.request("POST", "/v1/campaigns", value)
        assert reply.status == 422 and reply.pointers() == [pointer], reply.body
        assert words in reply.json()["errors"][0]["detail"]

    tilted = CAMPAIGN | {"environments": [*WORLDS, TILT]}
    refuse(tilted, "/environments/4/task/objective", "tilt_rad has no derivative")
    refuse(tilted, "/environments/4/task/objective", '{"worlds": "random"}')
    refuse(worlds(CAMPAIGN, "paper"), "/learning/worlds", '"random", "environments" or "tasks"')
    refuse(CAMPAIGN | {"mode": "zero-shot"}, "/learning", "does not learn")
    done = evolve(service, worlds(tilted, "random") | {"generations": 0})
    assert done["state"] == "succeeded"


@pytest.mark.parametrize("mode", ["few-shot", "simultaneous"])
def test_kills_change_nothing(start, tmp_path, mode):
    """A campaign that is killed in every phase ends as one that is not, with any number of
    threads."""
    value = CAMPAIGN | {"mode": mode, "generations": 3, "physics": {"n_steps": 800},
                        "learning": LEARNING | {"checkpoint_every_s": 1}}
    if mode == "few-shot":
        value = worlds(value, "tasks")
    whole = start("--workers=2")
    expected = history(whole, run(whole, "campaigns", value)["id"])
    id, seen, kills = None, (0, ""), 0
    while True:
        one = start(f"--workers={1 + kills % 2}", state=tmp_path)
        id = id or one.post("/v1/campaigns", value)["id"]
        path = f"/v1/campaigns/{id}"
        now = awaited(one, path, lambda now, least=seen: now["state"] == "succeeded" or (
            now["phase"] in ("learning", "scoring") and 1 <= now["progress"]["done"] and
            (now["progress"]["under_way"], now["phase"]) > least))
        if now["state"] == "succeeded":
            break
        seen = (now["progress"]["under_way"], now["phase"])
        assert one.stop(signal.SIGKILL) == -9, one.log_text()
        kills += 1
    assert kills >= 3
    assert history(one, id) == expected


def test_in_a_bundle(service, start):
    """Another service has the same settings and history. Campaigns that learn in random
    environments keep the form that bundles always had."""
    ids = [evolve(service, value)["id"] for value in (
        CAMPAIGN, worlds(CAMPAIGN, "random") | {"measures": ["work_j"]},
        CAMPAIGN | {"measures": ["work_j"]}, worlds(CAMPAIGN, "tasks"))]
    bundle = service.request("GET", f"/v1/bundles?campaigns={','.join(ids)}").body
    heads = [json.loads(content) for name, content in unpack(bundle)
             if name.endswith("campaign.json")]
    assert [head["settings"].get("learning_worlds") for head in heads] == [
        "environments", None, "environments", "tasks"]
    other = start()
    entered = other.request("POST", "/v1/bundles?mode=enter", body=bundle,
                            headers={"Content-Type": "application/zstd"}).json()
    for id, item in zip(ids, entered["items"], strict=True):
        there = other.get(f"/v1/campaigns/{item['campaign']}")
        assert there["settings"] == service.get(f"/v1/campaigns/{id}")["settings"]
    again = other.request("GET", "/v1/bundles?campaigns=" + ",".join(
        item["campaign"] for item in entered["items"])).body
    assert [json.loads(content)["settings"] for name, content in unpack(again)
            if name.endswith("campaign.json")] == [head["settings"] for head in heads]


def test_more_generations(service):
    """A campaign that was extended is one that was longer from the start."""
    value = CAMPAIGN | {"mode": "simultaneous"}
    short = evolve(service, value | {"generations": 1})
    service.post(f"/v1/campaigns/{short['id']}/extend", {"generations": 1})
    await_end(service, f"/v1/campaigns/{short['id']}")
    whole = evolve(service, value)
    assert learning_of(service, short) == learning_of(service, whole)


def test_morphoctl(service, tmp_path):
    def ctl(*words):
        return subprocess.run([MORPHOCTL, "-s", f"http://{service.host}:{service.port}",
                               "campaign", *words], check=True, capture_output=True,
                              text=True).stdout

    path = tmp_path / "worlds.json"
    path.write_text(json.dumps(WORLDS))
    how = ["--environments", str(path), "--population", "4", "--generations", "0", "--child-steps",
           "1", "-p", "n_steps=20", "--no-exclusions", "--json"]
    learns = json.loads(ctl("start", "few-shot", *how))
    assert learns["settings"]["learning"]["worlds"] == "environments"
    assert "in the campaign's environments" in ctl("show", learns["id"])
    random = json.loads(ctl("start", "few-shot", *how, "--worlds", "random"))
    assert random["settings"]["learning"]["worlds"] == "random"
    assert "in the campaign's environments" not in ctl("show", random["id"])
    tasks = json.loads(ctl("start", "few-shot", *how, "--worlds", "tasks"))
    assert "with the tasks of its environments" in ctl("show", tasks["id"])
