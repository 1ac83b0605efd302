"""The daemon and its workers are upgraded while a campaign runs: which workers may join, which are
asked to leave, and the same bits."""
import contextlib
import re
import socket
import subprocess
import threading
import time

from campaigns import history, request, undisturbed
from daemon import MORPHOCTL, MORPHOD, OLDER
from machines import events, fleet_address, generation

UNWANTED = 69


def version_of(binary):
    result = subprocess.run([binary, "--version"], check=True, capture_output=True, text=True)
    return re.search(r"[0-9.]+", result.stdout)[0]


class Supervisor(threading.Thread):
    """Restarts a worker that ends because another version is required, as its systemd unit does."""

    def __init__(self, worker, address, name):
        super().__init__(daemon=True)
        self.start_worker = lambda: worker(address, name, binary=self.installed)
        self.installed, self.statuses, self.is_over = OLDER, [], False
        self.worker = self.start_worker()
        self.start()

    def run(self):
        while not self.is_over:
            self.statuses.append(self.worker.process.wait())
            if self.statuses[-1] != UNWANTED:
                return
            time.sleep(0.3)
            self.worker = self.start_worker()


def drain(daemon, *flags):
    return subprocess.run([MORPHOCTL, "--server", daemon.address, "fleet", "drain", *flags],
                          capture_output=True, text=True, timeout=300)


def test_a_campaign_outlives_upgrades(daemon, worker, seed):
    value = request("zero-shot", seed, 12) | {"population": 48, "physics": {"n_steps": 200}}
    expected, *_ = undisturbed(daemon, "alone", value)
    old, new = version_of(OLDER), version_of(MORPHOD)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    one = daemon("one", workers=1, compute="fleet", fleet_listen=f"127.0.0.1:{port}")
    one.binary = OLDER
    one.start()
    nodes = [Supervisor(worker, fleet_address(one), f"node-{i}") for i in range(2)]

    def sessions():
        shown = [s for s in one.json("/v1/fleet")["sessions"] if s["ended_at"] is None]
        return {s["name"]: (s["version"], s["older"]) for s in shown}

    def await_sessions(*wanted):
        one.until(lambda: sessions() == {n.name: w for n, w in zip(nodes, wanted)})

    for node in nodes:
        node.name = node.worker.name
    await_sessions((old, False), (old, False))
    job = one.submit(value, "campaigns")
    one.until(lambda: generation(one, job) >= 1)
    # The daemon is upgraded: its workers now have an older version, and continue.
    assert one.stop()[0] == 0
    one.binary = MORPHOD
    one.start()
    await_sessions((old, True), (old, True))
    (event, ) = events(one, "fleet.older")
    assert event["data"]["version"] == old and event["data"]["wanted"] == new
    begun = one.json("/v1/fleet")["leases_done"]
    one.until(lambda: one.json("/v1/fleet")["leases_done"] > begun + 3)
    # Without the new package, draining them is useless, as the first one shows.
    done = drain(one, "--older")
    assert done.returncode == 3
    assert f"is back with the old version {old}: install {new}" in done.stderr
    assert sorted(map(len, (node.statuses for node in nodes))) == [0, 1]
    for node in nodes:
        node.installed = MORPHOD
    done = drain(one, "--version", old)
    reported = f"has left and is back with version {new}\n"
    assert done.returncode == 0 and done.stdout.count(reported) == 2, done
    await_sessions((new, False), (new, False))
    print(f"upgraded in generation {generation(one, job)}")
    assert sorted(node.statuses for node in nodes) == [[UNWANTED], [UNWANTED, UNWANTED]]
    assert f"version {new}" in nodes[0].worker.log.read_text()
    assert drain(one, "--older").stdout == "no worker has an older version\n"
    one.succeed(job, "campaigns", timeout_s=600)
    result = history(one, job)
    for part, what in expected.items():
        assert result[part] == what, f"{part} differ from those of one daemon"
    for node in nodes:
        node.is_over = True
        with contextlib.suppress(ProcessLookupError):
            assert node.worker.stop() == 0
    one.end()


def test_the_other_way_round(daemon, worker):
    """Workers may be upgraded first. A worker with different bits is informed of the required
    version."""
    one = daemon("one", workers=1, fleet_listen="127.0.0.1:0")
    one.binary = OLDER
    with one:
        newer = worker(fleet_address(one), "newer")
        one.until(lambda: one.json("/v1/fleet")["n_sessions"] == 1)
        assert one.json("/v1/fleet")["n_older"] == 0 and newer.stop() == 0
        other = worker(fleet_address(one), "other", "--isa=x86-64")
        status, log = other.ended()
        assert status == UNWANTED and f"version {version_of(OLDER)} with class" in log
