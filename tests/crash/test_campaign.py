"""Campaigns end with the same designs, scores, phylogeny, populations and controller, bit for bit,
whatever kills them and however many workers compute; a kill costs a block of work."""
import hashlib
import random
import re
import time

import pytest
from daemon import check_database

MODES = ("zero-shot", "few-shot", "simultaneous")


def request(mode, seed, generations):
    learning = {} if mode == "zero-shot" else {
        "name": "walker",
        "learning": {"parent_steps": 2, "child_steps": 2, "checkpoint_every_s": 1}
    }
    return {
        "mode": mode, "population": 12, "generations": generations, "seed": seed,
        "physics": {"n_steps": 30}, **learning
    }


def post(daemon, path, value=None, key=None, expected=(200, 202)):
    headers = {} if key is None else {"Idempotency-Key": key}
    reply = daemon.session.post(daemon.address + path, json=value, headers=headers, timeout=60)
    assert reply.status_code in expected, f"{path}: {reply.text}\n{daemon.tail()}"
    return reply.json()


def campaign(daemon, job):
    reply = daemon.get(f"/v1/campaigns/{job}")
    assert reply.status_code == 200, reply.text
    return reply.json()


def await_campaign(daemon, job, condition, timeout_s=60):
    until = time.monotonic() + timeout_s
    while True:
        now = campaign(daemon, job)
        if condition(now):
            return now
        assert time.monotonic() < until, f"{now}\n{daemon.tail()}"
        time.sleep(0.005)


def finish(daemon, job, timeout_s=120, attempts=0):
    end = await_campaign(daemon, job, lambda now: now["state"] in
                         ("succeeded", "failed", "cancelled"), timeout_s)
    assert end["state"] == "succeeded" and end["attempts"] <= attempts, end
    return end


def without(text, *columns):
    """A CSV without these columns."""
    rows = [line.split(",") for line in text.splitlines()]
    keep = [i for i, name in enumerate(rows[0]) if name not in columns]
    return [[row[i] for i in keep] for row in rows]


def history(daemon, job):
    """Everything that a repeat must not change."""
    def text(path):
        reply = daemon.get(f"/v1/campaigns/{job}/{path}")
        assert reply.status_code == 200, reply.text
        return reply.text

    populations = []
    for generation in range(campaign(daemon, job)["settings"]["generations"] + 1):
        reply = daemon.get(f"/v1/campaigns/{job}/population?generation={generation}&limit=1000")
        assert reply.status_code == 200, reply.text
        populations.append([(item["number"], item["genotype"], item["score"])
                            for item in reply.json()["items"]])
    result = campaign(daemon, job)["result"]
    weights = None
    if result is not None:
        reply = daemon.get(f"/v1/controllers/{result['controller']['name']}/file")
        assert reply.status_code == 200 and hashlib.sha256(
            reply.content).hexdigest() == result["controller"]["sha256"]
        weights = result["controller"]["sha256"]
    return {
        "generations": without(text("generations?format=csv"), "seconds", "stored"),
        "learning": without(text("learning?format=csv"), "seconds"),
        "phylogeny": text("phylogeny?format=csv"), "populations": populations, "weights": weights
    }


def counted(daemon):
    """What was computed for campaigns in this life: rollouts, steps of learning."""
    text = daemon.get("/metrics").text
    return [
        int(re.search(rf"^morphod_campaign_{what}_total (\d+)", text, re.M)[1])
        for what in ("rollouts", "learning_steps")
    ]


def rollouts(daemon):
    return counted(daemon)[0]


def work(daemon):
    """The same as one number: a step counts as a block of ten rollouts, so that kills find both."""
    n, steps = counted(daemon)
    return n + 10 * steps


def await_work(daemon, job, least):
    """The campaign, when so much was computed in this life, or when it has ended."""
    until = time.monotonic() + 600
    while work(daemon) < least and campaign(daemon, job)["state"] in ("queued", "running"):
        assert time.monotonic() < until, daemon.tail()
    return campaign(daemon, job)


def kill_one_campaign(daemon, generator, value, round_name, n_kills):
    """Runs a campaign undisturbed, and again with up to n_kills kills. (kills, kills while it ran)
    """
    quiet = daemon(f"undisturbed-{round_name}", workers=2)
    with quiet:
        job = post(quiet, "/v1/campaigns", value)["id"]
        finish(quiet, job, timeout_s=600)
        expected = history(quiet, job)
        needed, all_work = rollouts(quiet), work(quiet)
        assert quiet.stop()[0] == 0
    assert len(expected["populations"]) == value["generations"] + 1

    victim = daemon(f"victim-{round_name}")
    kills = kills_while_running = computed = 0
    while True:
        victim.settings["workers"] = generator.choice((1, 2, 7))
        victim.start()
        now = post(victim, "/v1/campaigns", value, key="one campaign")
        job = now["id"]
        # A life without a generation counts as an attempt, which the next one forgives. After three
        # such lives a person resumes it.
        if campaign(victim, job)["state"] == "failed":
            assert "killed" in campaign(victim, job)["error"]["detail"]
            post(victim, f"/v1/jobs/{job}/resume")
        if kills == n_kills:
            break
        state = await_work(victim, job, generator.uniform(0, all_work / 5))["state"]
        if state == "succeeded":
            break
        kills_while_running += state == "running"
        computed += rollouts(victim)
        victim.kill()
        kills += 1
    finish(victim, job, timeout_s=600, attempts=2)  # killed after its last generation
    computed += rollouts(victim)
    result = history(victim, job)
    assert victim.stop()[0] == 0
    for part, what in expected.items():
        assert result[part] == what, f"{part} differ from those of an undisturbed run"
    # What was counted before a kill and had no commit yet: about a block per worker, of 10
    # rollouts.
    # A slow disk can hold back the commit of a generation, and the scores of the next wait for
    # that.
    # What came between the count and the kill is not counted: the unit test of kills counts
    # exactly.
    assert computed - needed <= (kills * 7 + 2 * value["population"]) * 10
    check_database(victim.state)
    return kills, kills_while_running


@pytest.mark.parametrize("mode", MODES)
def test_kill_at_random_moments(daemon, soak, seed, mode):
    print(f"seed {seed}")
    generator = random.Random(f"{seed} {mode}")
    n_kills, generations = (100, 60) if soak else (10, 6)
    kills = kills_while_running = rounds = 0
    while kills < n_kills:  # a campaign may be done before its kills are
        value = request(mode, seed % 100000 + rounds, generations)
        done = kill_one_campaign(daemon, generator, value, f"{mode}-{rounds}", n_kills - kills)
        kills, kills_while_running = kills + done[0], kills_while_running + done[1]
        rounds += 1
        assert rounds <= n_kills, "campaigns end before anything kills them"
    print(f"{mode}: {kills} kills of {rounds} campaigns, {kills_while_running} while they ran")
    assert 2 * kills_while_running >= kills


@pytest.mark.parametrize("mode", MODES)
def test_pauses_stops_and_extensions(daemon, seed, mode):
    """Paused, stopped, killed while paused, and extended: as if all its generations had been asked
    for at once."""
    print(f"seed {seed}")
    quiet = daemon("at-once", workers=2)
    with quiet:
        job = post(quiet, "/v1/campaigns", request(mode, seed % 100000, 4))["id"]
        finish(quiet, job)
        expected = history(quiet, job)
        assert quiet.stop()[0] == 0
    one = daemon("extended", workers=2)
    one.start()
    job = post(one, "/v1/campaigns", request(mode, seed % 100000, 2))["id"]
    await_campaign(one, job, lambda now: now["phase"] in ("learning", "scoring"))
    post(one, f"/v1/jobs/{job}/pause")
    await_campaign(one, job, lambda now: now["state"] == "paused" and now["phase"] == "idle")
    one.kill()
    one.start()
    assert campaign(one, job)["state"] == "paused"
    post(one, f"/v1/campaigns/{job}/extend", {"generations": 1})
    post(one, f"/v1/jobs/{job}/resume")
    await_campaign(one, job, lambda now: now["progress"]["generation"] is not None)
    status, seconds = one.stop()
    assert status == 0 and seconds < 10, (status, seconds)
    one.start()
    finish(one, job)
    assert len(campaign(one, job)["newest"]) > 0
    post(one, f"/v1/campaigns/{job}/extend", {"generations": 1})
    finish(one, job)
    assert history(one, job) == expected
    assert one.stop()[0] == 0
    check_database(one.state)
