"""kill -9 at random moments: nothing that was acknowledged is lost, nothing is there twice, every
bit is as without a crash."""
import pathlib
import random
import time

import requests
from daemon import bodies, check_database, stored_scores

PHYSICS = {"n_steps": 150}
N_BATCHES = 3
N_DESIGNS = 120
N_ENVIRONMENTS = 4
ROUND = N_BATCHES * N_DESIGNS * N_ENVIRONMENTS  # rollouts of the work that comes every few kills


def batches(seed):
    return [{
        "designs": bodies(seed * 10 + k, N_DESIGNS), "physics": PHYSICS, "label": f"batch {k}"
    } for k in range(N_BATCHES)]


def run_to_end(daemon, requests_and_keys):
    jobs = [daemon.submit(request, key=key) for request, key in requests_and_keys]
    return [daemon.finish(job) for job in jobs]


def await_work(daemon, least):
    """The running evaluations, when so many rollouts were computed in this life, or when nothing is
    left to compute."""
    until = time.monotonic() + 600
    while True:
        enough = daemon.counted("morphod_rollouts_total") >= least
        running, queued = (daemon.get(f"/v1/jobs?state={state}").json()["items"]
                           for state in ("running", "queued"))
        if enough or not running + queued:
            return running
        assert time.monotonic() < until, daemon.tail()


def test_kill_at_random_moments(daemon, soak, seed):
    print(f"seed {seed}")
    generator = random.Random(seed)
    n_kills = 200 if soak else 20
    quiet = daemon("undisturbed")
    with quiet:
        expected = run_to_end(quiet, [(request, None) for request in batches(seed)])
        assert all(e["state"] == "succeeded" for e in expected)
        assert quiet.stop()[0] == 0
    undisturbed = stored_scores(quiet.state)

    # Four lives compute about one round, so that kills hit every part of it: just submitted,
    # computing, the end.
    victim = daemon("victim")
    acknowledged = {}  # key: (request, job id)
    kills_while_busy = 0
    round_of = 0
    for kill in range(n_kills):
        victim.start()
        try:
            # Every few kills new work, with environments of its own so that nothing is in the store
            # yet.
            if kill % 4 == 0:
                round_of += 1
                for k, request in enumerate(batches(seed)):
                    light = [2.5 + 0.01 * round_of, 4.0]
                    own = {
                        **request, "environments": [{
                            "light_xy_m": light, "terrain_sigma_m": 0.05, "seed": n
                        } for n in range(N_ENVIRONMENTS)]
                    }
                    key = f"round {round_of} batch {k}"
                    reply = victim.post(own, key=key)
                    assert reply.status_code == 202, reply.text
                    acknowledged[key] = (own, reply.json()["id"])
            # A request whose reply may be cut off: acknowledged or not, repeating it with its key
            # must be safe.
            key = f"cut {kill}"
            own = {"designs": bodies(seed + kill, 3), "physics": PHYSICS}
            acknowledged.setdefault(key, (own, None))
            reply = victim.post(own, key=key, timeout_s=5)
            if reply.status_code in (200, 202):
                acknowledged[key] = (own, reply.json()["id"])
        except requests.ConnectionError:
            pass
        kills_while_busy += bool(await_work(victim, generator.uniform(0, ROUND / 2)))
        victim.kill()
        assert victim.process.returncode == -9
    print(f"{n_kills} kills, {kills_while_busy} of them while jobs were running")
    assert kills_while_busy > n_kills // 4

    victim.start()
    ids = set()
    for key, (request, job) in acknowledged.items():
        again = victim.submit(request, key=key)
        assert job is None or again == job, "an acknowledged evaluation has another id now"
        assert again not in ids, "two keys have one evaluation"
        ids.add(again)
        evaluation = victim.finish(again, timeout_s=1800)
        assert evaluation["state"] == "succeeded", evaluation
        assert evaluation["attempts"] == 0, "a kill counted as an attempt"
        assert evaluation["rollouts_done"] == evaluation["rollouts_total"]
        acknowledged[key] = (request, again)
    total = victim.get("/v1/jobs?limit=1000").json()
    assert {job["id"] for job in total["items"]} == ids, "there are jobs that nobody asked for"
    disturbed = run_to_end(victim, [(request, None) for request in batches(seed)])
    assert victim.stop()[0] == 0

    # The same work as in the undisturbed run, after all those kills: the replies and the stored
    # bits are the same.
    for a, b in zip(expected, disturbed):
        assert a["results"] == b["results"]
    check_database(victim.state)
    check_database(quiet.state)
    after = stored_scores(victim.state)
    for key, value in undisturbed.items():
        assert after.get(key) == value

    # And what was computed between kills has the bits of a run without any.
    replay = daemon("replay")
    with replay:
        for key, (request, job) in acknowledged.items():
            replay.submit(request, key=key)
        for job in [j["id"] for j in replay.get("/v1/jobs?limit=1000").json()["items"]]:
            assert replay.finish(job, timeout_s=1800)["state"] == "succeeded"
        run_to_end(replay, [(request, None) for request in batches(seed)])
        assert replay.stop()[0] == 0
    assert stored_scores(replay.state) == after


def calls(daemon):
    """Reads and writes of files since the process was made."""
    counts = dict(
        line.split(": ")
        for line in pathlib.Path(f"/proc/{daemon.process.pid}/io").read_text().splitlines())
    return int(counts["syscr"]) + int(counts["syscw"])


def test_kill_at_the_start(daemon, soak, seed):
    """Kills during the first moments: the schema, registration of the controller, recovery."""
    print(f"seed {seed}")
    generator = random.Random(seed)
    quiet = daemon("undisturbed")
    with quiet:
        needed = calls(quiet)
        assert quiet.stop()[0] == 0
    kills = kills_before_serving = 0
    for trial in range(20 if soak else 4):
        one = daemon(f"start {trial}")
        for _ in range(5):
            one.spawn()
            least = generator.uniform(0, needed)
            while calls(one) < least and not one.port_file.exists():
                pass
            kills_before_serving += not one.port_file.exists()
            one.kill()
            kills += 1
        with one:
            assert one.get("/readyz").status_code == 200
            names = [c["name"] for c in one.get("/v1/controllers").json()["items"]]
            assert names == ["bootstrap", "default"]
            one.score({"designs": bodies(seed, 2), "physics": PHYSICS})
            assert one.stop()[0] == 0
        check_database(one.state)
    print(
        f"{needed} calls to start; {kills} kills, {kills_before_serving} of them before it served")
    assert 2 * kills_before_serving >= kills


def test_one_state_folder_one_process(daemon):
    first = daemon("shared").start()
    second = daemon("shared")
    second.port_file = second.folder / "second"
    second.spawn()
    assert second.process.wait(20) == 75
    assert first.get("/readyz").status_code == 200
