"""Campaigns that other machines compute end with the same designs, scores, phylogeny, populations
and controller, bit for bit, while workers come and go, and with the same survivors as without
races."""
import pytest
from campaigns import MODES, RACE, check_same_lives, history, request, rollouts, undisturbed
from daemon import CONTROLLER, bodies
from machines import events, fleet_address, generation

NUMBERS = (1, 7, 2, 1)  # number of workers, one after the other


@pytest.mark.parametrize("mode", MODES)
def test_same_bits(daemon, worker, seed, mode):
    is_quick = mode == "zero-shot"  # it does not learn
    value = request(mode, seed, 12 if is_quick else 4)
    value |= {"population": 32 if is_quick else 24, "physics": {"n_steps": 80}}
    if is_quick:
        value |= {"physics": RACE["physics"], "environments": RACE["environments"]}
    expected, needed, _ = undisturbed(daemon, "alone", value)
    whole, unraced, _ = undisturbed(daemon, "whole", value | {"racing": "off"})
    last = value["generations"]
    with daemon("remote", workers=1, compute="fleet", fleet_listen="127.0.0.1:0") as one:
        workers, names = [], 0
        job = one.submit(value, "campaigns")
        for phase, n in enumerate(NUMBERS):
            for leaving in workers[n:]:
                assert leaving.stop() == 0
            workers = workers[:n]
            while len(workers) < n:
                names += 1
                workers.append(worker(fleet_address(one), f"node-{names}"))
            one.until(lambda n=n: one.json("/v1/fleet")["n_sessions"] == n)
            one.until(lambda least=last * phase // len(NUMBERS): generation(one, job) >= least)
        one.succeed(job, "campaigns")
        result = history(one, job)
        for part, what in expected.items():
            assert result[part] == what, f"{part} differ from those of one daemon"
        # With some seeds, no design can be cut.
        assert (check_same_lives(result, whole) > 0) == (needed < unraced)
        assert rollouts(one) == needed
        status = one.json("/v1/fleet")
        # Workers computed everything, and nothing was counted twice. Robots of gradients count as
        # well; the daemon computes what is due while there is no worker.
        steps = one.counted("morphod_campaign_learning_steps_total")
        assert needed <= status["rollouts_done"] <= needed + value["population"] * steps
        assert status["audits_failed"] == 0
        assert status["lost"] == 0, events(one, "fleet.lost")
        assert sum(session["rollouts_done"] > 0 for session in status["sessions"]) >= 2
        one.end()


def scored_elsewhere(daemon, worker, value):
    """Returns the results, which a worker computed with the same bits, and its rollouts."""
    with daemon("alone", workers=2) as one:
        expected = one.score(value)
        one.end()
    with daemon("remote", workers=1, compute="fleet", fleet_listen="127.0.0.1:0") as one:
        worker(fleet_address(one), "helper")
        one.until(lambda: one.json("/v1/fleet")["n_sessions"] == 1)
        result = one.score(value)
        assert result["results"] == expected["results"]
        rollouts = one.json("/v1/fleet")["rollouts_done"]
        assert rollouts >= result["rollouts_total"] - result["rollouts_cached"]
        one.end()
    return result["results"], rollouts


def test_errors_of_scores(daemon, worker, seed):
    """Other machines compute the additional rollouts that estimate errors, with the same bits."""
    _, rollouts = scored_elsewhere(daemon, worker, {
        "designs": bodies(seed, 10), "physics": "paper", "error": True, "priority": "batch"})
    assert rollouts > 10 * 10


def test_scores_to_a_tolerance(daemon, worker, seed):
    """Other machines compute the float32 rungs; steps and scores are those of one machine."""
    value = {"designs": bodies(seed, 6), "physics": {"n_steps": 200, "dt_s": 0.004},
             "tolerance": 0.002, "priority": "batch"}
    with daemon("alone", workers=2) as one:
        expected = one.score(value)
        one.end()
    rungs = [len(row["tolerance"]["rungs"]) for row in expected["results"]]
    with daemon("remote", workers=1, compute="fleet", fleet_listen="127.0.0.1:0") as one:
        worker(fleet_address(one), "helper")
        one.until(lambda: one.json("/v1/fleet")["n_sessions"] == 1)
        result = one.score(value)
        assert result["results"] == expected["results"]
        # Five rollouts in ten environments; the first of the second rung's are known.
        further = sum(n > 1 for n in rungs)
        assert further > 0, "a tolerance that the first rung reaches tests nothing"
        assert one.json("/v1/fleet")["rollouts_done"] >= 50 * len(rungs) + 30 * further
        one.end()


def test_tasks(daemon, worker, seed):
    """Other machines compute every task, with the same bits."""
    tasks = ["walk", "climb", "circle", "path", "shuttle", "pursue"]
    worlds = [{"task": task} for task in tasks] + [
        {"task": "photo-auc", "light_xy_m": [4, 3]},
        {"light_xy_m": [4, 3], "terrain_sigma_m": 0.05, "seed": 1}] + [
        {"task": {"guide": {"kind": "ahead"}, "objective": objective}} for objective in (
            "efficient", "jump", {"travel": 1, "peak_strain": -1})]
    results, rollouts = scored_elsewhere(daemon, worker, {
        "designs": bodies(seed, 30), "physics": {"n_steps": 500}, "priority": "batch",
        "environments": worlds})
    assert len({entry["loss"] for entry in results[0]["losses"]}) == len(worlds)
    assert rollouts > 20 * len(worlds)


def test_measures(daemon, worker, seed):
    """Losses that other machines computed get measures with the bits that one machine gives them;
    the losses stay."""
    value = {"designs": bodies(seed, 12), "priority": "batch"}
    with daemon("alone", workers=2) as one:
        expected = one.score(value | {"measures": True})
        one.end()
    with daemon("remote", workers=1, compute="fleet", fleet_listen="127.0.0.1:0") as one:
        worker(fleet_address(one), "helper")
        one.until(lambda: one.json("/v1/fleet")["n_sessions"] == 1)
        plain = one.score(value)
        begun = one.json("/v1/fleet")["rollouts_done"]
        assert begun > 0
        result = one.score(value | {"measures": True})
        assert result["results"] == expected["results"]
        computed = result["rollouts_total"] - result["rollouts_cached"]
        assert one.json("/v1/fleet")["rollouts_done"] >= begun + computed
        assert result["rollouts_cached"] == expected["rollouts_cached"]  # of equal bodies
        for row, known in zip(result["results"], plain["results"]):
            assert [entry["loss"] for entry in row["losses"]] == known["losses"]
        again = one.score(value | {"measures": ["work_j"], "label": "again"})
        assert again["rollouts_cached"] == again["rollouts_total"]
        one.end()


@pytest.mark.parametrize("mode", ["zero-shot", "few-shot"])
def test_measures_of_campaigns(daemon, worker, seed, mode):
    """Campaigns that select by a measure get the same bits from other machines, one of which is
    lost in the middle."""
    value = request(mode, seed, 5 if mode == "zero-shot" else 2) | {
        "population": 24, "physics": {"n_steps": 200}, "measures": True,
        "select_by": {"measure": "displacement_m", "direction": "max"}}
    expected, needed, _ = undisturbed(daemon, "alone", value)
    head = expected["phylogeny"][0]
    assert "measures.work_j" in head and len(set(head)) == len(head)
    with daemon("remote", workers=1, compute="fleet", fleet_listen="127.0.0.1:0") as one:
        lost, *_ = [worker(fleet_address(one), name) for name in ("lost", "left", "right")]
        one.until(lambda: one.json("/v1/fleet")["n_sessions"] == 3)
        job = one.submit(value, "campaigns")
        one.until(lambda: rollouts(one) > needed / 3)
        lost.kill()
        one.succeed(job, "campaigns")
        result = history(one, job)
        for part, what in expected.items():
            assert result[part] == what, f"{part} differ from those of one daemon"
        status = one.json("/v1/fleet")
        assert status["rollouts_done"] >= needed and status["audits_failed"] == 0
        assert rollouts(one) == needed
        one.end()


def test_the_best_of_many(daemon, worker, seed):
    """A race with rounds that other machines compute ends with the same result, although one of
    them is lost in the middle."""
    walker = CONTROLLER.with_name("phototaxis.safetensors")  # some bodies are far better
    value = {"designs": bodies(seed, 90), "physics": "paper", "best": 5}
    with daemon("alone", workers=2, default_controller=walker) as one:
        expected = one.score(value)
        one.end()
    needed = expected["rollouts_total"] - expected["rollouts_cut"]
    with daemon("remote", workers=1, compute="fleet", fleet_listen="127.0.0.1:0",
                default_controller=walker) as one:
        lost, *_ = [worker(fleet_address(one), name) for name in ("lost", "left", "right")]
        one.until(lambda: one.json("/v1/fleet")["n_sessions"] == 3)
        job = one.submit(value)
        one.until(lambda: one.json(f"/v1/jobs/{job}")["rollouts_done"] > needed / 3)
        lost.kill()
        result = one.succeed(job)
        assert result["results"] == expected["results"]
        assert result["rollouts_cut"] == expected["rollouts_cut"] > 0
        assert one.json("/v1/fleet")["rollouts_done"] >= needed - expected["rollouts_cached"]
        one.end()
