"""An atlas that workers on other machines compute has the same bytes, while workers come and go."""
import pytest

from machines import fleet_address

REQUEST = {
    "voxels": 5, "name": "all", "physics": {"n_steps": 300},
    "environments": [{"task": "walk"}, {"light_xy_m": [4, 2.5], "terrain_sigma_m": 0.05, "seed": 3}]
}
NUMBERS = (2, 1, 2)  # number of workers, one after the other
BODIES = 124


def file_of(one):
    return (one.state / "atlases" / "all.atlas").read_bytes()


def bodies(one, job):
    return one.json(f"/v1/jobs/{job}")["atlas"]["bodies_done"]


@pytest.mark.parametrize("more", ({}, {"measures": True}), ids=("plain", "measured"))
def test_same_bytes(daemon, worker, more):
    with daemon("alone", workers=2) as alone:
        alone.succeed(alone.submit(REQUEST | more, "atlases"), "jobs")
        needed = alone.counted("morphod_atlas_rollouts_total")
        expected = file_of(alone)
        alone.end()
    with daemon("remote", workers=1, compute="fleet", fleet_listen="127.0.0.1:0") as one:
        workers, names = [], 0
        job = one.submit(REQUEST | more, "atlases")
        for phase, n in enumerate(NUMBERS):
            for leaving in workers[n:]:
                assert leaving.stop() == 0
            workers = workers[:n]
            while len(workers) < n:
                names += 1
                workers.append(worker(fleet_address(one), f"node-{names}"))
            one.until(lambda n=n: one.json("/v1/fleet")["n_sessions"] == n)
            one.until(lambda least=BODIES * phase // len(NUMBERS): bodies(one, job) >= least)
        one.succeed(job, "jobs")
        assert file_of(one) == expected
        status = one.json("/v1/fleet")
        assert status["rollouts_done"] >= needed == one.counted("morphod_atlas_rollouts_total")
        assert status["audits_failed"] == 0
        one.end()
