"""A body that kills every worker is identified; its job fails with the body's name, and no other
job does."""
from liar import Victim
from machines import fleet_address

N = 120


def test_a_body_that_ends_workers(daemon, worker, seed):
    with daemon("one", workers=1, compute="fleet", fleet_listen="127.0.0.1:0") as one:
        bodies = one.post("/v1/bodies/random", {"count": N, "seed": seed % 1000})["items"]
        poison, others = bodies[N // 2], bodies[:N // 2] + bodies[N // 2 + 1:]
        victims = [Victim(fleet_address(one).partition("://")[2], poison["genotype"],
                          lambda url, name=name: worker(url, name)) for name in ("a", "b", "c")]
        one.until(lambda: one.json("/v1/fleet")["n_sessions"] == 3)

        def submit(chosen):  # short rollouts, so that leases have many bodies
            return one.submit({"designs": [{"voxels": body["genotype"]} for body in chosen],
                               "physics": {"n_steps": 60}, "priority": "batch"})

        failed = one.finish(submit(bodies), "evaluations", 240)
        deaths = sum(victim.deaths for victim in victims)
        print(f"found after {deaths} deaths")
        assert failed["state"] == "failed" and poison["id"] in failed["error"]["detail"], failed
        # Three losses may be chance. Then leases are halved, and then three workers have only this
        # body. Two more attempts of the job follow, with leases that are small by then.
        assert all(victim.deaths > 0 for victim in victims) and deaths <= 3 + 7 + 3 + 2 * 8
        one.succeed(submit(others), timeout_s=240)
        for victim in victims:
            victim.close()
