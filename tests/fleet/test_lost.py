"""How soon the leases of a lost worker go to another worker."""
import contextlib
import datetime
import http.client
import signal
import threading
import time
import types

import pytest
from machines import events, fleet_address
from workers import Workers

# Three bodies that take at least half a second each: two leases for the worker, one for the
# witness.
VALUE = {"mode": "zero-shot", "population": 3, "generations": 1, "physics": {"n_steps": 10000},
         "exclude_pretraining": False}
SILENCE_S = 6


class Witness(threading.Thread):
    """A session that waits for a lease and records when it arrives. It sends heartbeats."""

    def __init__(self, daemon):
        super().__init__(daemon=True)
        service = types.SimpleNamespace(addresses=[fleet_address(daemon)], get=daemon.json)
        self.fleet = Workers(service)
        self.session = self.fleet.join(name="witness")
        self.first = self.moment = None
        self.asked = 0  # number of requests for the next lease

    def take(self):
        """Returns its first lease; the thread waits for the next one."""
        self.first = self.fleet.take(self.session, wait=30)
        assert len(self.first) == 1
        self.start()

    def run(self):
        threading.Thread(target=self.live, daemon=True).start()
        while self.moment is None:
            self.asked += 1
            if self.fleet.take(self.session, wait=30):
                self.moment = time.monotonic()

    def live(self):
        with contextlib.suppress(OSError, http.client.HTTPException):  # the daemon ends
            while self.moment is None:
                self.fleet.orders(self.session, wait=1)


def lease_of(one, witness):
    """Waits until the witness has a lease of the victim; returns how the victim's session ended."""
    one.until(lambda: witness.moment is not None, every_s=0.001)
    assert witness.asked == 1  # the waiting request got it
    (session, ) = [s for s in one.json("/v1/fleet")["sessions"] if s["name"] == "victim"]
    assert session["state"] == "lost"
    return session


@pytest.fixture
def scene(daemon, worker):
    """A daemon, a worker that was stopped while it had two leases, and a session that waits for
    them."""
    one = daemon("one", workers=1, compute="fleet", fleet_listen="127.0.0.1:0").start()
    victim = worker(fleet_address(one), "victim")
    one.until(lambda: one.json("/v1/fleet")["n_sessions"] == 1)
    one.submit(VALUE, "campaigns")
    one.until(lambda: one.json("/v1/fleet")["leases"] == 2, every_s=0.002)
    victim.process.send_signal(signal.SIGSTOP)
    stopped = time.monotonic()
    witness = Witness(one)
    witness.take()
    time.sleep(0.1)  # a lease that is given out too early comes at once
    assert witness.moment is None
    return one, victim, witness, stopped


def test_of_a_dead_worker(scene):
    one, victim, witness, _ = scene
    killed = time.monotonic()
    victim.process.kill()
    assert lease_of(one, witness)["why"] == "its connection ended"  # not because of its silence
    print(f"leases of a dead worker: {1000 * (witness.moment - killed):.1f} ms")
    one.until(lambda: events(one, "fleet.lost"))


def test_of_a_silent_worker(scene):
    one, _, witness, stopped = scene
    one.until(lambda: one.json("/v1/fleet")["lost"] == 1)
    session = lease_of(one, witness)
    assert session["why"] == "it stopped responding"
    last, ended = (datetime.datetime.fromisoformat(session[name].replace("Z", "+00:00"))
                   for name in ("heard_at", "ended_at"))
    silent_s = (ended - last).total_seconds()
    print(f"silent for {silent_s:.2f} s, its lease after {witness.moment - stopped:.2f} s")
    assert silent_s >= SILENCE_S
