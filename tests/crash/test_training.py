"""Trainings end with the same weights, bit for bit, whatever kills them, however many workers
compute, and when the disk fills up."""
import hashlib
import pathlib
import random
import time

import pytest
from daemon import BUILD, Daemon, bodies, check_database, open_database
from test_disk import fill

CHECKPOINT_BYTES = 12.4e6
# Who computes: with devices a training writes while the next gradient is computed.
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


def train(daemon, request, key=None):
    headers = {} if key is None else {"Idempotency-Key": key}
    reply = daemon.session.post(daemon.address + "/v1/trainings",
                                json=request,
                                headers=headers,
                                timeout=30)
    assert reply.status_code == 202, reply.text
    return reply.json()["id"]


def training(daemon, job):
    reply = daemon.get(f"/v1/trainings/{job}")
    assert reply.status_code == 200, reply.text
    return reply.json()


def await_training(daemon, job, condition, timeout_s=30):
    until = time.monotonic() + timeout_s
    while True:
        now = training(daemon, job)
        if condition(now):
            return now
        assert time.monotonic() < until, f"{now}\n{daemon.tail()}"
        time.sleep(0.01)


def work(daemon):
    """Blocks computed in this life: of gradients and of validations."""
    return daemon.counted("morphod_blocks_total")


def await_work(daemon, job, least):
    """The training, when so much was computed in this life, or when it has ended."""
    until = time.monotonic() + 600
    while work(daemon) < least and training(daemon, job)["state"] in ("queued", "running"):
        assert time.monotonic() < until, daemon.tail()
    return training(daemon, job)


def finish(daemon, job, timeout_s=60):
    end = await_training(daemon, job, lambda now: now["state"] in
                         ("succeeded", "failed", "cancelled"), timeout_s)
    assert end["state"] == "succeeded", end
    return end


def weights(daemon, job):
    """The file of a training's result; fails when it is not what its name says."""
    result = training(daemon, job)["controller"]
    reply = daemon.get(f"/v1/controllers/{result['name']}/file")
    assert reply.status_code == 200, reply.text
    assert hashlib.sha256(reply.content).hexdigest() == result["sha256"]
    return reply.content


def curve(state, job):
    """Everything that a repeat must not change: steps without their times, and validations."""
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
    """Checkpoints on the disk are those that the database speaks of, byte for byte."""
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
    """Killed 20 times, with another number of workers in every life, against undisturbed runs with
    1, 2 and 7 workers."""
    print(f"seed {seed}")
    generator = random.Random(seed)
    n_kills, steps = (200, 1000) if soak else (20, 60)
    request = pretraining(seed, steps)
    expected = None
    all_work = 0
    for workers in (1, 2, 7):
        quiet = daemon(f"undisturbed {workers}", workers=workers)
        with quiet:
            job = train(quiet, request)
            finish(quiet, job, timeout_s=600)
            all_work = work(quiet)
            result = weights(quiet, job)
            assert quiet.stop()[0] == 0
        learned = curve(quiet.state, job)
        assert len(learned[0]) == steps
        assert expected is None or (result,
                                    learned) == expected, f"{workers} workers give another result"
        expected = result, learned

    # Lives of so much work that a training ends after most of them, with what each kill takes back.
    # Another follows, the same.
    victim = daemon("victim", workers=1)
    victim.start()
    kills = kills_while_running = 0
    done = []
    while True:
        job = train(victim, request, key=f"training {len(done)}")
        # A life without a checkpoint counts as an attempt, which the next one forgives. After three
        # such lives a person resumes it.
        if training(victim, job)["state"] == "failed":
            assert "killed" in training(victim, job)["error"]["detail"]
            assert victim.session.post(f"{victim.address}/v1/jobs/{job}/resume").status_code in (
                200, 202)
        if kills == n_kills:
            break
        state = await_work(victim, job,
                           work(victim) + generator.uniform(0, 4 * all_work / n_kills))["state"]
        if state == "succeeded":
            done.append(job)
            assert len(done) <= n_kills, "trainings end before anything kills them"
            continue
        kills_while_running += state == "running"
        victim.kill()
        kills += 1
        victim.settings["workers"] = generator.choice((1, 2, 7))
        victim.start()
    done.append(job)
    for job in done:
        assert finish(victim, job, timeout_s=600)["attempts"] == 0
        assert weights(victim,
                       job) == expected[0], "the weights are not those of an undisturbed run"
    assert victim.stop()[0] == 0
    print(
        f"{kills} kills of {len(done)} trainings, {kills_while_running} of them while one ran; "
        f"{all_work} blocks undisturbed"
    )
    assert kills_while_running >= n_kills // 2
    for job in done:
        assert curve(victim.state, job) == expected[1]
    check_database(victim.state)
    victim.start()  # what a crash left is gone
    assert victim.stop()[0] == 0
    check_files(victim.state)


def test_finetuning_survives(daemon, seed):
    """Pauses, orderly stops and kills of a finetuning on a population."""
    print(f"seed {seed}")
    designs = bodies(seed, 12)
    results = []
    for disturbed in (False, True):
        one = daemon(f"finetune {disturbed}")
        one.start()
        population = one.score({"designs": designs, "physics": {"n_steps": 50}})["id"]
        job = train(
            one, {
                "kind": "finetune", "population": {"evaluation": population, "best": 8
                                                   }, "steps": 40, "batch": 16, "seed": seed,
                "physics": {"n_steps": 20}, "validation": {"every_steps": 0}, "name": "tuned",
                "adjoint_bound": 0.1, "adjoint_rule": "restart", "restart_weight": 2.5
            })
        if disturbed:
            await_training(one, job, lambda now: now["progress"]["step"] >= 5)
            assert one.session.post(f"{one.address}/v1/jobs/{job}/pause").status_code in (200, 202)
            paused = await_training(
                one, job,
                lambda now: now["state"] == "paused" and now["checkpoint_step"] is not None)
            assert paused["checkpoint_step"] >= 5
            one.kill()
            one.start()
            assert training(one, job)["state"] == "paused"
            assert one.session.post(f"{one.address}/v1/jobs/{job}/resume").status_code in (200, 202)
            await_training(one, job,
                           lambda now: now["progress"]["step"] >= paused["checkpoint_step"] + 3)
            status, seconds = one.stop()
            assert status == 0 and seconds < 10, (status, seconds)
            assert "work=parked" in one.tail(), one.tail()
            one.start()
            assert training(one, job)["checkpoint_step"] > paused["checkpoint_step"]
        finish(one, job)
        results.append(weights(one, job))
        assert one.stop()[0] == 0
        check_database(one.state)
    assert results[0] == results[1]


@pytest.mark.parametrize("device", WHERE)
def test_full_disk_at_a_checkpoint(training_disk, daemon, seed, device):
    """No room for a checkpoint: it waits, says so, can be cancelled, and goes on by itself with the
    same result."""
    request = pretraining(seed,
                          30,
                          checkpoint={"every_steps": 10, "every_s": 0, "keep": 1},
                          device=device)
    quiet = daemon("roomy", **WHERE[device])
    with quiet:
        job = train(quiet, request)
        finish(quiet, job)
        expected = weights(quiet, job)
        assert quiet.stop()[0] == 0
    one = Daemon(training_disk + "/d", **WHERE[device])
    one.log = pathlib.Path(training_disk).parent / "log"
    one.port_file = pathlib.Path(training_disk).parent / "address"
    try:
        one.start()
        filler = fill(training_disk)
        filler_room = filler.stat().st_size
        assert filler_room > CHECKPOINT_BYTES
        # Room for rows, none for a checkpoint.
        with open(filler, "r+b") as file:
            file.truncate(max(0, filler_room - 4_000_000))
        first = train(one, request)
        waiting = await_training(one, first, lambda now: now["state"] == "paused")
        assert "no space" in waiting["reason"] and "by itself" in waiting["reason"], waiting
        assert waiting["progress"]["step"] == 10
        listed = [item for item in one.get("/v1/jobs").json()["items"] if item["id"] == first]
        assert listed[0]["state"] == "paused", listed
        for path in ("/v1/jobs", "/v1/trainings"):  # it is found by the state that it shows
            found = {
                state: [item["id"] for item in one.get(f"{path}?state={state}").json()["items"]]
                for state in ("running", "paused")
            }
            assert found == {"running": [], "paused": [first]}, found
        second = train(one, request)
        assert one.session.post(f"{one.address}/v1/jobs/{first}/cancel").status_code in (200, 202)
        await_training(one, first, lambda now: now["state"] == "cancelled")
        await_training(one, second, lambda now: now["state"] == "paused")
        # Not a byte is left: the service lives, and a cancellation is still possible.
        third = train(one, {**request, "name": "third"})
        refill = fill_again(filler)
        time.sleep(1.5)
        assert one.process.poll() is None, one.tail()
        assert one.get("/healthz").status_code == 200
        reply = one.session.post(f"{one.address}/v1/jobs/{third}/cancel")
        assert reply.status_code in (200, 202), reply.text
        assert refill > 0
        filler.unlink()
        finish(one, second)
        assert weights(one, second) == expected
        assert one.stop()[0] == 0
        check_database(one.state)
        check_files(one.state)
    finally:
        one.close()


def fill_again(filler):
    """Appends to the filler until nothing fits any more; returns the bytes that went in."""
    before = filler.stat().st_size
    with open(filler, "ab", buffering=0) as file:
        for size in (65536, 512):
            try:
                while True:
                    file.write(b"\0" * size)
            except OSError:
                pass
    return filler.stat().st_size - before


@pytest.mark.parametrize("device", WHERE)
def test_stop_on_a_full_disk(training_disk, seed, device):
    """A stop does not wait for room; the next start goes on from the last checkpoint."""
    one = Daemon(training_disk + "/d", **WHERE[device])
    one.log = pathlib.Path(training_disk).parent / "log"
    one.port_file = pathlib.Path(training_disk).parent / "address"
    try:
        one.start()
        filler = fill(training_disk)
        with open(filler, "r+b") as file:
            file.truncate(filler.stat().st_size - 4_000_000)
        job = train(
            one,
            pretraining(seed,
                        20,
                        checkpoint={"every_steps": 10, "every_s": 0, "keep": 1},
                        device=device))
        await_training(one, job, lambda now: now["state"] == "paused")
        status, seconds = one.stop()
        assert status == 0 and seconds < 10, (status, seconds, one.tail())
        filler.unlink()
        one.start()
        finish(one, job)
        assert one.stop()[0] == 0
        check_database(one.state)
        check_files(one.state)
    finally:
        one.close()
