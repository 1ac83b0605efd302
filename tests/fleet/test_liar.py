"""A worker that flips a bit in one of 1,000 rows is found; the honest ones beside it are not
suspected."""
import contextlib

from liar import Liar
from machines import events, fleet_address

# Short rollouts, so that a lease has many: thousands in each generation.
VALUE = {"mode": "zero-shot", "population": 1500, "generations": 10000, "physics": {"n_steps": 20},
         "exclude_pretraining": False}
LEASES = 500  # within so many of its own a liar must be found
QUARANTINED = 76


def session_of(daemon, name):
    (session, ) = [one for one in daemon.json("/v1/fleet")["sessions"] if one["name"] == name]
    return session


def test_a_liar_is_quarantined(daemon, worker, seed):
    with daemon("one", workers=1, compute="fleet", fleet_listen="127.0.0.1:0") as one:
        address = fleet_address(one)
        honest = [worker(address, name) for name in ("honest-1", "honest-2")]
        with contextlib.closing(Liar(address.partition("://")[2], seed)) as liar:
            odd = worker(liar.url, "liar")
            one.until(lambda: one.json("/v1/fleet")["n_sessions"] == 3)
            job = one.submit(VALUE | {"seed": seed}, "campaigns")
            status, log = odd.ended(120)
        assert status == QUARANTINED and liar.flipped > 0, log
        session = session_of(one, "liar")
        print(f"found after {session['leases_done']} leases, {liar.rows} rows, {liar.flipped} lies")
        assert session["state"] == "quarantined" and session["leases_done"] <= LEASES
        assert session["audits_failed"] > 0
        (event, ) = one.until(lambda: events(one, "fleet.quarantined"))
        assert event["data"]["name"] == "liar" and "where two others gave" in session["why"]
        assert len(events(one, "fleet.differs")) >= 1
        # It does not come back, and the others go on.
        status, log = worker(address, "liar").ended()
        assert status == QUARANTINED and "quarantine" in log
        before = one.json("/v1/fleet")["leases_done"]
        one.until(lambda: one.json("/v1/fleet")["leases_done"] > before + 20)
        for each in honest:
            session = session_of(one, each.name)
            assert session["state"] == "active" and session["audits_failed"] == 0
            assert session["audits"] > 0 and each.process.poll() is None
        one.act(job, "cancel")
