"""Campaigns end with the same designs, scores, phylogeny, populations and controller, bit for bit,
regardless of kills and of the number of workers. A kill costs a block of work."""
import random

import pytest
from campaigns import MODES, history, request, rollouts, undisturbed, work
from daemon import open_database


def kill_one_campaign(daemon, generator, value, round_name, n_kills):
    """Runs a campaign undisturbed, and again with up to n_kills kills. Returns (kills, kills while
    it ran).
    """
    expected, needed, all_work = undisturbed(daemon, f"undisturbed-{round_name}", value)
    assert len(expected["populations"]) == value["generations"] + 1

    victim = daemon(f"victim-{round_name}")
    kills = kills_while_running = computed = 0
    while True:
        victim.settings["workers"] = generator.choice((1, 2, 7))
        victim.start()
        job = victim.submit(value, "campaigns", key="one campaign")
        path = f"/v1/campaigns/{job}"
        # A process that ends without a generation counts as an attempt, which the next generation
        # forgives. After three such processes a user resumes it.
        now = victim.json(path)
        if now["state"] == "failed":
            assert "killed" in now["error"]["detail"]
            victim.act(job, "resume")
        if kills == n_kills:
            break
        least = generator.uniform(0, all_work / 5)
        state = victim.awaited(path, lambda now: work(victim) >= least or now["state"] not in
                               ("queued", "running"), timeout_s=600)["state"]
        if state == "succeeded":
            break
        kills_while_running += state == "running"
        computed += rollouts(victim)
        victim.kill()
        kills += 1
    victim.succeed(job, "campaigns", 600, attempts=2)  # killed after its last generation
    computed += rollouts(victim)
    result = history(victim, job)
    for part, what in expected.items():
        assert result[part] == what, f"{part} differ from those of an undisturbed run"
    # Work that was counted before a kill but not committed: about a block per worker, of 10
    # rollouts. A slow disk can delay the commit of a generation, and the scores of the next one
    # wait for that. Work between the count and the kill is not counted: the unit test of kills
    # counts exactly.
    assert computed - needed <= (kills * 7 + 2 * value["population"]) * 10
    victim.end()
    return kills, kills_while_running


@pytest.mark.parametrize("mode", MODES)
def test_kill_at_random_moments(daemon, soak, seed, mode):
    print(f"seed {seed}")
    generator = random.Random(f"{seed} {mode}")
    n_kills, generations = (100, 60) if soak else (10, 6)
    kills = kills_while_running = rounds = 0
    while kills < n_kills:  # a campaign may end before all its kills
        value = request(mode, seed % 100000 + rounds, generations)
        done = kill_one_campaign(daemon, generator, value, f"{mode}-{rounds}", n_kills - kills)
        kills, kills_while_running = kills + done[0], kills_while_running + done[1]
        rounds += 1
        assert rounds <= n_kills, "campaigns end before they can be killed"
    print(f"{mode}: {kills} kills of {rounds} campaigns, {kills_while_running} while they ran")
    assert 2 * kills_while_running >= kills


def held_out(daemon, job):
    """Returns the bits of all results in fresh worlds."""
    database = open_database(daemon.state)
    rows = database.execute("SELECT generation,number,worlds,diverged,mean,standard_error FROM"
                            " campaign_held_out WHERE job=? ORDER BY 1,2", (job, )).fetchall()
    database.close()
    return rows


@pytest.mark.parametrize("mode", MODES)
def test_kills_during_re_evaluations(daemon, seed, mode):
    """Most of the work is in fresh worlds, so kills come between the scores of a generation and
    its commit: the history and the results have the same bits."""
    print(f"seed {seed}")
    generator = random.Random(f"{seed} {mode}")
    value = request(mode, seed % 100000, 4) | {
        "re_evaluate": {"every": 1, "environments": 100}, "environments": "paper-test"}
    quiet = daemon("undisturbed", workers=2)
    with quiet:
        job = quiet.submit(value, "campaigns")
        quiet.succeed(job, "campaigns", timeout_s=600)
        expected, all_rollouts = history(quiet, job), rollouts(quiet)
        quiet.end()
    results = held_out(quiet, job)
    assert len(results) == 5 * 12 and all_rollouts >= 5 * 12 * 100
    victim, kills = daemon("victim", workers=1).start(), 0
    job = victim.submit(value, "campaigns")
    path = f"/v1/campaigns/{job}"
    while kills < 6:
        now = victim.json(path)
        if now["state"] == "failed":
            assert "killed" in now["error"]["detail"]
            victim.act(job, "resume")
        # Beyond the scores of a generation of 12 parents and 12 children.
        least = generator.uniform(240, 240 + 1200)
        state = victim.awaited(path, lambda now: rollouts(victim) >= least or now["state"] not in
                               ("queued", "running"), timeout_s=600)["state"]
        if state == "succeeded":
            break
        victim.kill()
        kills += 1
        victim.settings["workers"] = generator.choice((1, 2, 7))
        victim.start()
    if victim.json(path)["state"] == "failed":
        victim.act(job, "resume")
    victim.succeed(job, "campaigns", 600, attempts=3)
    found = history(victim, job)
    for part, what in expected.items():
        assert found[part] == what, f"{part} differ from those of an undisturbed run"
    victim.end()
    assert held_out(victim, job) == results
    assert kills >= 2


@pytest.mark.parametrize("mode", MODES)
def test_pauses_stops_and_extensions(daemon, seed, mode):
    """Paused, stopped, killed while paused, and extended: the result is as if all generations had
    been requested at once."""
    print(f"seed {seed}")
    expected = undisturbed(daemon, "at-once", request(mode, seed % 100000, 4))[0]
    one = daemon("extended", workers=2).start()
    job = one.submit(request(mode, seed % 100000, 2), "campaigns")
    path = f"/v1/campaigns/{job}"
    one.awaited(path, lambda now: now["phase"] in ("learning", "scoring"))
    one.act(job, "pause")
    one.awaited(path, lambda now: now["state"] == "paused" and now["phase"] == "idle")
    one.kill()
    one.start()
    assert one.json(path)["state"] == "paused"
    one.post(path + "/extend", {"generations": 1})
    one.act(job, "resume")
    one.awaited(path, lambda now: now["progress"]["generation"] is not None)
    assert one.stop()[0] == 0, one.tail()
    one.start()
    one.succeed(job, "campaigns")
    one.post(path + "/extend", {"generations": 1})
    one.succeed(job, "campaigns")
    assert history(one, job) == expected
    one.end()
