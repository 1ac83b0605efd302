"""A worker that flips a bit in one of 1,000 rows is found; honest workers next to it are not
suspected. Wrong scores that it computed while it was alone are found as well."""
import contextlib
import os

from liar import Liar
from machines import events, fleet_address

# Short rollouts, so that a lease has many: thousands in each generation.
VALUE = {"mode": "zero-shot", "population": 1500, "generations": 10000, "physics": {"n_steps": 4},
         "exclude_pretraining": False}
LEASES = 500  # a liar must be found within this many of its leases
REFUSED = 76


def sessions_of(daemon, name):
    return [one for one in daemon.json("/v1/fleet")["sessions"] if one["name"] == name]


def session_of(daemon, name):
    (session, ) = sessions_of(daemon, name)
    return session


def test_a_liar_is_refused(daemon, worker, seed):
    with daemon("one", workers=1, compute="fleet", fleet_listen="127.0.0.1:0") as one:
        address = fleet_address(one)
        honest = [worker(address, name) for name in ("honest-1", "honest-2")]
        with contextlib.closing(Liar(address.partition("://")[2], seed)) as liar:
            odd = worker(liar.url, "liar")
            one.until(lambda: one.json("/v1/fleet")["n_sessions"] == 3)
            job = one.submit(VALUE | {"seed": seed}, "campaigns")
            status, log = odd.ended()
        assert status == REFUSED and liar.flipped > 0, log
        session = session_of(one, "liar")
        print(f"found after {session['leases_done']} leases, {liar.rows} rows, {liar.flipped} lies")
        assert session["state"] == "refused" and session["leases_done"] <= LEASES
        assert session["audits_failed"] > 0
        (event, ) = one.until(lambda: events(one, "fleet.refused"))
        assert event["data"]["name"] == "liar" and "where this machine computed" in session["why"]
        assert len(events(one, "fleet.differs")) >= 1
        # The others continue.
        before = one.json("/v1/fleet")["leases_done"]
        one.until(lambda: one.json("/v1/fleet")["leases_done"] > before + 20)
        for each in honest:
            session = session_of(one, each.name)
            assert session["state"] == "active" and session["audits_failed"] == 0
            assert session["audits"] > 0 and each.process.poll() is None
        # If it computes the same bits as the others, it may join again.
        again = worker(address, "liar")
        one.until(lambda: "active" in [s["state"] for s in sessions_of(one, "liar")])
        assert again.stop() == 0
        one.act(job, "cancel")


def verified(daemon, **request):
    """Returns the pages of POST /v1/fleet/verify as one list: the recomputed losses, and those that
    differ."""
    checked, different, page = 0, [], {}
    while page.get("next", "") is not None:
        page = daemon.post("/v1/fleet/verify", request | {"limit": 64})
        request["after"] = page["next"]
        checked += page["checked"]
        different += page["different"]
    return checked, different


def test_every_lie_is_named(daemon, worker, seed):
    origin = f"liar@{os.uname().nodename}"
    with daemon("one", workers=1, compute="fleet", fleet_listen="127.0.0.1:0") as one:
        address = fleet_address(one).partition("://")[2]
        with contextlib.closing(Liar(address, seed, share=0.01)) as liar:
            odd = worker(liar.url, "liar")
            job = one.submit(VALUE | {"population": 300, "generations": 4, "seed": seed},
                             "campaigns")
            one.succeed(job, "campaigns")
            assert odd.stop() == 0
        checked, different = verified(one, origin=origin)
        print(f"{liar.rows} rows, {liar.flipped} lies")
        assert checked == liar.rows and len(different) == liar.flipped > 0
        assert all(lie["stored"]["loss"] != lie["computed"]["loss"] for lie in different)
        assert verified(one, origin=origin, repair=True) == (checked, different)
        again, still = verified(one, origin=origin)
        assert still == [] and 0 < again < checked
        one.end()
