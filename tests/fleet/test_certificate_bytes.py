"""A certificate that workers on other machines compute has the same report, while workers come and
go, with the measures of the base."""
from daemon import bodies
from machines import fleet_address

REQUEST = {
    "designs": bodies(5, 12), "axes": ["step", "chance", "friction"], "chance": 8, "seed": 3,
    "levels": [0.8, 1.25], "physics": {"n_steps": 300}
}
NUMBERS = (2, 1, 2)  # number of workers, one after the other


def report(one, job):
    reply = one.get(f"/v1/certificates/{job}/report")
    assert reply.status_code == 200, reply.text
    return reply.content


def test_same_report(daemon, worker):
    with daemon("alone", workers=2) as alone:
        first = alone.submit(REQUEST, "certificates")
        needed = alone.succeed(first, "certificates")["certificate"]["rollouts"]
        expected = report(alone, first)
        alone.end()
    with daemon("remote", workers=1, compute="fleet", fleet_listen="127.0.0.1:0") as one:
        workers, names = [], 0
        job = one.submit(REQUEST, "certificates")
        assert job == first, "the report has the id"
        for phase, n in enumerate(NUMBERS):
            for leaving in workers[n:]:
                assert leaving.stop() == 0
            workers = workers[:n]
            while len(workers) < n:
                names += 1
                workers.append(worker(fleet_address(one), f"node-{names}"))
            one.until(lambda n=n: one.json("/v1/fleet")["n_sessions"] == n)
            least = needed * phase // len(NUMBERS)
            one.awaited(f"/v1/certificates/{job}",
                        lambda now, least=least: now["certificate"]["rollouts_done"] >= least)
        one.succeed(job, "certificates")
        assert report(one, job) == expected
        status = one.json("/v1/fleet")
        in_float64 = 12 * 2 * 10  # rollouts of the steps, which stay at the daemon
        assert status["rollouts_done"] >= needed - in_float64 and status["audits_failed"] == 0
        one.end()
