"""A finetuning run of each design ends with the same scores and controllers, whatever killed its
process, and however many threads it had."""
import random

import pytest
from daemon import bodies, open_database
from test_training import WHERE

N, STEPS = 8, 12
REQUEST = {
    "kind": "finetune", "designs": bodies(7, N), "each": True, "best": 2, "name": "own",
    "steps": STEPS, "batch": 8, "seed": 4, "physics": {"n_steps": 20},
    "validation": {"environments": 3}, "checkpoint": {"every_steps": 3, "every_s": 0, "keep": 2}
}


def progress(one, job):
    return one.json(f"/v1/trainings/{job}")["progress"]


def result(one, job):
    page = one.json(f"/v1/trainings/{job}/each")
    steps = one.json(f"/v1/trainings/{job}/steps")["items"]
    for step in steps:
        del step["seconds"]
    return page, steps


def resumed(one, job):
    """The job's state, after it is resumed if it failed."""
    now = one.json(f"/v1/trainings/{job}")
    if now["state"] == "failed":
        assert "killed" in now["error"]["detail"]
        one.act(job, "resume")
    return now


@pytest.mark.parametrize("device", WHERE)
def test_kill_at_random_moments(daemon, soak, seed, device):
    """Killed repeatedly, with a different number of workers in each process, which lives until it
    has learned a few more steps, so that most kills are within a design. Resumed when it failed, as
    it does after three kills without a checkpoint."""
    print(f"seed {seed}")
    generator = random.Random(seed)
    n_kills = 60 if soak else 10
    request = REQUEST | {"device": device}
    with daemon("undisturbed", workers=2, **WHERE[device]) as quiet:
        job = quiet.submit(request, "trainings")
        quiet.succeed(job, "trainings", 600)
        expected = result(quiet, job)
        assert len(expected[0]["items"]) == N and len(expected[1]) == N * STEPS
        quiet.end()

    victim = daemon("victim", workers=1, **WHERE[device]).start()
    assert victim.submit(request, "trainings") == job
    path = f"/v1/trainings/{job}"
    kills = within = 0
    while kills < n_kills:
        now = resumed(victim, job)
        least = now["progress"]["step"] + generator.randrange(2 * N * STEPS // n_kills)
        now = victim.awaited(path, lambda now: now["state"] not in ("queued", "running") or
                             now["progress"]["step"] >= least and now["state"] == "running",
                             timeout_s=600)
        if now["state"] == "succeeded":
            break
        within += now["progress"]["step"] % STEPS != 0
        done = now["progress"]["bodies_done"]
        victim.kill()
        kills += 1
        victim.settings["workers"] = generator.choice((1, 2, 7))
        victim.start()
        assert progress(victim, job)["bodies_done"] >= done
    resumed(victim, job)
    victim.succeed(job, "trainings", 600)
    print(f"{kills} kills, {within} of them within a design")
    assert within > 0
    assert result(victim, job) == expected
    kept = [row["controller"] for row in expected[0]["items"] if row["controller"]["name"]]
    assert len(kept) == 2
    for controller in kept:
        assert victim.json(f"/v1/controllers/{controller['name']}")["sha256"] == (
            controller["sha256"])
    victim.end()
    database = open_database(victim.state)
    rows = database.execute("SELECT count(*) FROM training_bodies WHERE job = ?", (job, ))
    assert rows.fetchone()[0] == N
    assert database.execute("SELECT count(*) FROM checkpoints").fetchone()[0] == 0
    database.close()
