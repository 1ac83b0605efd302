"""Campaigns with races equal those without, bit for bit, except for children that were cut short,
even after kills, and for any number of workers. Power cuts: tests/unit/jobs/races.c; workers on
other machines: tests/fleet/test_same_bits.py."""
import random

import pytest
from campaigns import MODES, RACE, check_same_lives, history, work

SEEDS = (1, 2, 3)
N_LEARNING = 2  # the number of them of campaigns that learn, which take much longer


def values(mode, soak):
    """Small campaigns, with environments in which robots differ a lot after a few steps. With
    --soak, also the presets "demo" and "workstation", with shorter rollouts and fewer learning
    steps."""
    for seed in SEEDS if soak or mode == "zero-shot" else SEEDS[:N_LEARNING]:
        value = {"mode": mode, "seed": seed, "exclude_pretraining": False}
        few = {} if mode == "zero-shot" else {"controller": "default"}
        learning = {"parent_steps": 1, "child_steps": 1, "checkpoint_every_s": 1}
        # On every instruction set, children are cut short from about generation 7 on.
        longer = {"generations": 12} if mode != "simultaneous" else {}
        yield value | few | RACE | longer | ({"learning": learning | {"batch": 4}} if few else {})
        if soak:
            yield value | few | {"preset": "demo", "physics": "paper"}
            yield value | few | {"preset": "workstation", "generations": 10,
                                 "physics": RACE["physics"]} | (
                                     {"learning": learning} if few else {})


def start(one, requests):
    """Submits the requests, or finds their jobs again. Returns the jobs."""
    one.start()
    jobs = [one.submit(value, "campaigns", key=str(i)) for i, value in enumerate(requests)]
    for job in jobs:  # killed three times without a generation
        if one.json(f"/v1/campaigns/{job}")["state"] == "failed":
            one.act(job, "resume")
    return jobs


@pytest.mark.parametrize("mode", MODES)
def test_same_campaigns(daemon, soak, seed, mode):
    print(f"seed {seed}")
    generator = random.Random(f"{seed} {mode}")
    requests, n_kills, cut = list(values(mode, soak)), 40 if soak else 3, []
    quiet = daemon("whole", workers=0)
    jobs = start(quiet, [value | {"racing": "off"} for value in requests])
    for job in jobs:
        quiet.succeed(job, "campaigns", 7200)
    whole, all_work = [history(quiet, job) for job in jobs], work(quiet)
    quiet.end()
    victim = daemon("raced")
    for _ in range(n_kills):
        victim.settings["workers"] = generator.choice((1, 2, 7))
        jobs = start(victim, requests)
        least = generator.uniform(0, 1.5 * all_work / n_kills)
        victim.until(lambda least=least, jobs=jobs: work(victim) >= least or all(
            victim.json(f"/v1/campaigns/{job}")["state"] == "succeeded" for job in jobs),
                     7200, every_s=0.2 if soak else 0.01)
        victim.kill()
    victim.settings["workers"] = 2
    for job, expected in zip(start(victim, requests), whole):
        victim.succeed(job, "campaigns", 7200, attempts=2)
        cut.append(check_same_lives(history(victim, job), expected))
    victim.end()
    print(f"{mode}: {cut} children cut short")
    assert sum(cut) > 0 or mode != "zero-shot"  # learning depends on the processor
