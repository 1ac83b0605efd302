"""Training runs end with the same weights, bit for bit, regardless of kills, the number of workers,
and a full disk."""
import hashlib
import pathlib
import random
import time

import pytest
from daemon import BUILD, Daemon, bodies, open_database
from test_disk import fill

CHECKPOINT_BYTES = 12.4e6
# What computes: with devices, a training run writes while the next gradient is computed.
WHERE = {
    "cpu": {},
    "cuda": {"devices": "auto", "compute_module": BUILD / "tests" / "device" / "fake-device.so"}
}


def pretraining(seed, steps, **more):
    return {
        "kind": "pretrain", "name": "walker", "steps": steps, "batch": 16, "seed": seed,
        "physics": {"n_steps": 20},
        "validation": {"every_steps": 20, "designs": 4, "environments": 3},
        "checkpoint": {"every_steps": 4, "every_s": 0, "keep": 3}, **more
    }


def work(daemon):
    """Returns the number of blocks that this process has computed for gradients and for
    validations."""
    return daemon.counted("morphod_blocks_total")


def weights(daemon, job):
    return daemon.result(daemon.json(f"/v1/trainings/{job}")["controller"])


def curve(state, job):
    """Returns everything that a repeated run must not change: steps without their times, and
    validations."""
    database = open_database(state)
    steps = database.execute(
        "SELECT step, mean_loss, rate, gradient_norm, clipped_share, clipped_robots_share, "
        "diverged, zeroed, skipped, "
        "bounded FROM training_steps WHERE job = ? ORDER BY step", (job, )).fetchall()
    validations = database.execute("SELECT * FROM training_validations WHERE job = ? ORDER BY step",
                                   (job, )).fetchall()
    database.close()
    return steps, [row[1:] for row in validations]


def check_files(state):
    """Checks that the checkpoints on disk are those in the database, byte for byte."""
    database = open_database(state)
    rows = {(str(job), f"{step}.checkpoint"): (bytes(sha256), size)
            for job, step, sha256, size in database.execute(
                "SELECT job, step, sha256, size FROM checkpoints")}
    database.close()
    files = {(path.parent.name, path.name): path
             for path in (pathlib.Path(state) / "trainings").glob("*/*")}
    assert set(files) == set(rows)
    for name, path in files.items():
        content = path.read_bytes()
        assert (hashlib.sha256(content).digest(), len(content)) == rows[name]


def test_kill_at_random_moments(daemon, soak, seed):
    """Killed 20 times, with a different number of workers in each process, compared with
    undisturbed runs with 1, 2 and 7 workers."""
    print(f"seed {seed}")
    generator = random.Random(seed)
    n_kills, steps = (200, 1000) if soak else (20, 60)
    request = pretraining(seed, steps)
    expected = None
    all_work = 0
    for workers in (1, 2, 7):
        quiet = daemon(f"undisturbed {workers}", workers=workers)
        with quiet:
            job = quiet.submit(request, "trainings")
            quiet.succeed(job, "trainings", 600)
            all_work = work(quiet)
            result = weights(quiet, job)
            assert quiet.stop()[0] == 0
        learned = curve(quiet.state, job)
        assert len(learned[0]) == steps
        assert expected in (None, (result, learned)), f"{workers} workers produce another result"
        expected = result, learned

    # Each process does so much work that a training run ends after most of the kills, including the
    # work that each kill loses. Then the same training run follows again.
    victim = daemon("victim", workers=1)
    victim.start()
    kills = kills_while_running = 0
    done = []
    while True:
        job = victim.submit(request, "trainings", key=f"training {len(done)}")
        # A process that ends without a checkpoint counts as an attempt, which the next checkpoint
        # forgives. After three such processes a user resumes it.
        now = victim.json(f"/v1/trainings/{job}")
        if now["state"] == "failed":
            assert "killed" in now["error"]["detail"]
            victim.act(job, "resume")
        if kills == n_kills:
            break
        least = work(victim) + generator.uniform(0, 4 * all_work / n_kills)
        state = victim.awaited(
            f"/v1/trainings/{job}", lambda now: work(victim) >= least or now["state"] not in
            ("queued", "running"), timeout_s=600)["state"]
        if state == "succeeded":
            done.append(job)
            assert len(done) <= n_kills, "trainings end before they can be killed"
            continue
        kills_while_running += state == "running"
        victim.kill()
        kills += 1
        victim.settings["workers"] = generator.choice((1, 2, 7))
        victim.start()
    done.append(job)
    for job in done:
        victim.succeed(job, "trainings", 600)
        assert weights(victim, job) == expected[0], "not those of an undisturbed run"
    victim.end()
    print(f"{kills} kills of {len(done)} trainings, {kills_while_running} of them while one ran; "
          f"{all_work} blocks undisturbed")
    assert kills_while_running >= n_kills // 2
    for job in done:
        assert curve(victim.state, job) == expected[1]
    victim.start()  # removes what a crash left
    victim.end()
    check_files(victim.state)


def test_finetuning_survives(daemon, seed):
    """Pauses, orderly stops and kills of a finetuning run on a population."""
    print(f"seed {seed}")
    results = []
    for disturbed in (False, True):
        one = daemon(f"finetune {disturbed}").start()
        population = one.score({"designs": bodies(seed, 12), "physics": {"n_steps": 50}})["id"]
        job = one.submit({
            "kind": "finetune", "population": {"evaluation": population, "best": 8}, "steps": 40,
            "batch": 16, "seed": seed, "physics": {"n_steps": 20},
            "validation": {"every_steps": 0}, "name": "tuned", "adjoint_bound": 0.1,
            "adjoint_rule": "restart", "restart_weight": 2.5
        }, "trainings")
        path = f"/v1/trainings/{job}"
        if disturbed:
            one.awaited(path, lambda now: now["progress"]["step"] >= 5)
            one.act(job, "pause")
            paused = one.awaited(path, lambda now: now["state"] == "paused" and
                                 now["checkpoint_step"] is not None)["checkpoint_step"]
            assert paused >= 5
            one.kill()
            one.start()
            assert one.json(path)["state"] == "paused"
            one.act(job, "resume")
            one.awaited(path, lambda now: now["progress"]["step"] >= paused + 3)
            assert one.stop()[0] == 0
            assert "work=parked" in one.tail(), one.tail()
            one.start()
            assert one.json(path)["checkpoint_step"] > paused
        one.succeed(job, "trainings")
        results.append(weights(one, job))
        one.end()
    assert results[0] == results[1]


def fill_but(disk, room):
    """Fills a disk except for this much room, and returns the file that does so."""
    filler = fill(disk)
    with open(filler, "r+b") as file:
        file.truncate(filler.stat().st_size - room)
    return filler


ROWS = 4_000_000  # room for rows, but not for a checkpoint
FULL_DISK = {"every_steps": 10, "every_s": 0, "keep": 1}


@pytest.mark.parametrize("device", WHERE)
def test_full_disk_at_a_checkpoint(training_disk, daemon, seed, device):
    """There is no room for a checkpoint: the training run waits, reports this, can be cancelled,
    and continues automatically with the same result."""
    request = pretraining(seed, 30, checkpoint=FULL_DISK, device=device)
    quiet = daemon("roomy", **WHERE[device])
    with quiet:
        job = quiet.submit(request, "trainings")
        quiet.succeed(job, "trainings")
        expected = weights(quiet, job)
        assert quiet.stop()[0] == 0
    with Daemon(training_disk / "d", training_disk.parent, **WHERE[device]) as one:
        filler = fill_but(training_disk, ROWS)
        assert filler.stat().st_size + ROWS > CHECKPOINT_BYTES
        first = one.submit(request, "trainings")
        waiting = one.awaited(f"/v1/trainings/{first}", lambda now: now["state"] == "paused")
        assert "no space" in waiting["reason"] and "will continue" in waiting["reason"], waiting
        assert waiting["progress"]["step"] == 10
        for path in ("/v1/jobs", "/v1/trainings"):  # it can be recognized by its state
            found = {
                state: [item["id"] for item in one.json(f"{path}?state={state}")["items"]]
                for state in ("running", "paused")
            }
            assert found == {"running": [], "paused": [first]}, found
        second = one.submit(request, "trainings")
        one.act(first, "cancel")
        one.awaited(f"/v1/trainings/{first}", lambda now: now["state"] == "cancelled")
        one.awaited(f"/v1/trainings/{second}", lambda now: now["state"] == "paused")
        # Not a byte is left: the service runs, and a cancellation is still possible.
        third = one.submit(request | {"name": "third"}, "trainings")
        before = filler.stat().st_size
        assert fill(training_disk).stat().st_size > before
        time.sleep(1.5)  # it cannot even start; jobs that wait for room try again every second
        assert one.process.poll() is None, one.tail()
        assert one.get("/healthz").status_code == 200
        one.act(third, "cancel")
        filler.unlink()
        one.succeed(second, "trainings")
        assert weights(one, second) == expected
        one.end()
        check_files(one.state)


@pytest.mark.parametrize("device", WHERE)
def test_stop_on_a_full_disk(training_disk, seed, device):
    """A stop does not wait for room. The next start continues from the last checkpoint."""
    with Daemon(training_disk / "d", training_disk.parent, **WHERE[device]) as one:
        filler = fill_but(training_disk, ROWS)
        job = one.submit(pretraining(seed, 20, checkpoint=FULL_DISK, device=device), "trainings")
        one.awaited(f"/v1/trainings/{job}", lambda now: now["state"] == "paused")
        assert one.stop()[0] == 0
        assert "stopped work=" in one.tail(), one.tail()  # it was not stopped at its deadline
        filler.unlink()
        one.start()
        one.succeed(job, "trainings")
        one.end()
        check_files(one.state)
