"""kill -9 at random moments: no acknowledged work is lost, nothing is duplicated, and every bit is
the same as without a crash."""
import pathlib
import random

import requests
from daemon import CONTROLLER, bodies, stored_scores

PHYSICS = {"n_steps": 60}
N_BATCHES = 3
N_DESIGNS = 80
N_ENVIRONMENTS = 4
ROUND = N_BATCHES * N_DESIGNS * N_ENVIRONMENTS  # rollouts of the work that is added every few kills


def batches(seed):
    return [{
        "designs": bodies(seed * 10 + k, N_DESIGNS), "physics": PHYSICS, "label": f"batch {k}"
    } for k in range(N_BATCHES)]


def run_to_end(daemon, requests):
    return [daemon.succeed(job) for job in [daemon.submit(request) for request in requests]]


def await_work(daemon, least):
    """Returns the running evaluations once this process has computed this many rollouts, or once
    nothing is left to compute."""
    def look():
        running, queued = (daemon.json(f"/v1/jobs?state={state}")["items"]
                           for state in ("running", "queued"))
        enough = daemon.counted("morphod_rollouts_total") >= least
        return enough or not running + queued, running

    return daemon.until(look, 600, lambda seen: seen[0])[1]


def test_kill_at_random_moments(daemon, soak, seed):
    print(f"seed {seed}")
    generator = random.Random(seed)
    n_kills = 200 if soak else 20
    quiet = daemon("undisturbed")
    with quiet:
        expected = run_to_end(quiet, batches(seed))
        quiet.end()
    undisturbed = stored_scores(quiet.state)

    # Four processes compute about one round, so that kills hit every part of it: just submitted,
    # computing, the end.
    victim = daemon("victim")
    acknowledged = {}  # key: (request, job id)
    kills_while_busy = 0
    round_of = 0
    for kill in range(n_kills):
        victim.start()
        try:
            # New work every few kills, with new environments, so that the store has none of its
            # scores.
            if kill % 4 == 0:
                round_of += 1
                for k, request in enumerate(batches(seed)):
                    light = [2.5 + 0.01 * round_of, 4.0]
                    ahead = {"guide": {"kind": "ahead", "heading_rad": 0.01 * round_of}}
                    path = {"guide": {"kind": "path", "points_m": [light]}}
                    own = {
                        **request, "environments": [
                            {"light_xy_m": light, "terrain_sigma_m": 0.05, "seed": 1},
                            {"light_xy_m": light, "terrain_sigma_m": 0.05, "seed": 2},
                            {"task": ahead, "terrain_sigma_m": 0.05, "seed": 3}, {"task": path}]
                    }
                    key = f"round {round_of} batch {k}"
                    reply = victim.evaluate(own, key=key)
                    assert reply.status_code == 202, reply.text
                    acknowledged[key] = (own, reply.json()["id"])
            # A request with a reply that may be lost: whether it was acknowledged or not, repeating
            # it with its key must be safe.
            key = f"cut {kill}"
            own = {"designs": bodies(seed + kill, 3), "physics": PHYSICS}
            acknowledged.setdefault(key, (own, None))
            reply = victim.evaluate(own, key=key)
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
        evaluation = victim.succeed(again, timeout_s=1800)  # a kill is not an attempt
        assert evaluation["rollouts_done"] == evaluation["rollouts_total"]
        acknowledged[key] = (request, again)
    total = victim.json("/v1/jobs?limit=1000")
    assert {job["id"] for job in total["items"]} == ids, "there are jobs that were not submitted"
    disturbed = run_to_end(victim, batches(seed))
    victim.end()

    # The same work as in the undisturbed run, after all these kills: the replies and the stored
    # bits are the same.
    for a, b in zip(expected, disturbed):
        assert a["results"] == b["results"]
    after = stored_scores(victim.state)
    for key, value in undisturbed.items():
        assert after.get(key) == value

    # Work that was computed between kills has the same bits as in a run without kills.
    replay = daemon("replay")
    with replay:
        for job in [replay.submit(request) for request, _ in acknowledged.values()]:
            replay.succeed(job, timeout_s=1800)
        run_to_end(replay, batches(seed))
        assert replay.stop()[0] == 0
    assert stored_scores(replay.state) == after


def test_kill_in_a_race(daemon, soak, seed):
    """An evaluation of the best designs ends with the same result after kills in every round of its
    race, and does not recompute saved work."""
    print(f"seed {seed}")
    generator = random.Random(seed)
    n_kills = 100 if soak else 8
    distinct = [body for body in bodies(seed, 150) if body["voxels"].count("1") > 12]
    request = {"designs": distinct, "physics": "paper", "best": 4}
    walker = CONTROLLER.with_name("phototaxis.safetensors")  # some bodies are far better
    quiet = daemon("undisturbed", workers=1, default_controller=walker)
    with quiet:
        expected = quiet.score(request)
        quiet.end()
    needed = expected["rollouts_total"] - expected["rollouts_cut"]
    assert len(stored_scores(quiet.state)) == needed < 0.8 * expected["rollouts_total"]

    victim = daemon("victim", workers=2, default_controller=walker)
    for kill in range(n_kills):
        victim.start()
        job = victim.submit(request, key="race")
        least = generator.uniform(0, 2 * needed / n_kills)
        victim.until(lambda least=least: victim.counted("morphod_rollouts_total") >= least or
                     victim.json(f"/v1/jobs/{job}")["state"] == "succeeded")
        victim.kill()
    saved = len(stored_scores(victim.state))
    print(f"{saved} of {needed} rollouts were saved before the last start")
    with victim:
        result = victim.succeed(victim.submit(request, key="race"))
        assert victim.counted("morphod_rollouts_total") == needed - saved
        victim.end()
    assert result["results"] == expected["results"]
    assert (result["rollouts_cached"], result["rollouts_cut"]) == (0, expected["rollouts_cut"])
    assert stored_scores(victim.state) == stored_scores(quiet.state)


def calls(daemon):
    """Returns reads and writes of files since the process started."""
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
            names = [c["name"] for c in one.json("/v1/controllers")["items"]]
            assert names == ["bootstrap", "default"]
            one.score({"designs": bodies(seed, 2), "physics": PHYSICS})
            one.end()
    print(f"{needed} calls to start; {kills} kills, {kills_before_serving} before it served")
    assert 2 * kills_before_serving >= kills
