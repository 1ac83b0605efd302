"""A daemon and three workers, each on a separate machine, and the faults that can hit them: a
campaign ends with the history and the scores of an undisturbed one."""
import pathlib
import random
import shutil
import signal
import subprocess
import time

import pytest
from campaigns import history, request, rollouts, undisturbed
from daemon import ENDED, Daemon, stored_scores
from machines import Worker, events
from network import HUB, Network
from surroundings import fill

PORT = 8766
VALUE = request("zero-shot", 22, 7) | {"population": 40, "physics": {"n_steps": 100}}
FAULTS = 8  # the maximum of a round


@pytest.fixture
def network():
    network = Network()
    yield network
    network.close()


@pytest.fixture
def secured(folder):
    """Returns the settings of a daemon and the flags of its workers: beyond loopback everything is
    encrypted."""
    subprocess.run(["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt",
                    "ec_paramgen_curve:prime256v1", "-nodes", "-days", "1", "-subj", "/CN=hub",
                    "-out", "certificate", "-keyout", "key"], cwd=folder, check=True,
                   capture_output=True)
    pin = subprocess.run("openssl x509 -in certificate -pubkey -noout | openssl pkey -pubin "
                         "-outform der | openssl dgst -sha256 -binary | openssl base64", shell=True,
                         cwd=folder, check=True, capture_output=True, text=True).stdout.strip()
    tokens = pathlib.Path(folder) / "tokens"
    tokens.touch(0o600)
    tokens.write_text("node worker a-token-of-workers-and-no-more\n")
    settings = {"token_file": tokens, "fleet_certificate": f"{folder}/certificate",
                "fleet_key": f"{folder}/key", "fleet_listen": f"{HUB}:{PORT}", "compute": "fleet"}
    return settings, (f"--pin=sha256//{pin}", f"--token-file={tokens}")


class Round:
    """Each fault returns a function that ends it, or None if it has ended. There is at most one of
    each kind at a time."""

    def __init__(self, network, secured, disk, number, generator):
        self.network, self.disk, self.generator = network, disk, generator
        settings, self.flags = secured
        self.daemon = Daemon(disk / "d", disk.parent, workers=1, **settings)
        self.folder, self.number = disk.parent, number
        self.workers = [None] * 3
        self.lives, self.happened, self.ending = 1, [], {}

    def launch(self, i, port=PORT):
        if self.workers[i] is not None:
            self.workers[i].close()
        self.workers[i] = Worker(self.folder, f"https://{HUB}:{port}", f"node-{self.number}-{i}",
                                 *self.flags, before=self.network.inside(i))

    def start(self):
        self.daemon.start()
        for i in range(3):
            self.launch(i)
        self.submit()

    def submit(self):
        self.job = self.daemon.submit(VALUE, "campaigns", key="one campaign")

    def state(self):
        return self.daemon.json(f"/v1/campaigns/{self.job}")["state"]

    # ---- faults ----

    def kill(self, i):
        self.workers[i].kill()
        return lambda: self.launch(i)

    def stop(self, i):
        process = self.workers[i].process
        process.send_signal(signal.SIGSTOP)
        return lambda: process.send_signal(signal.SIGCONT)

    def cut(self, i):
        self.network.link(i, "down")
        return lambda: self.network.link(i, "up")

    def flap(self, i):
        for _ in range(self.generator.randint(2, 5)):
            for state in ("down", "up"):
                self.network.link(i, state)
                time.sleep(self.generator.uniform(0, 0.1))

    def slow(self, i):
        self.network.slow(i, True)
        return lambda: self.network.slow(i, False)

    def delay(self, i):
        self.launch(i, self.network.delayed(PORT, 0.15))

    def crash(self, _):
        if "fill" in self.ending:  # a start needs room
            return
        self.daemon.kill()
        self.lives += 1
        self.daemon.start()
        self.submit()
        if self.state() == "failed":  # three processes in a row were killed without a generation
            self.daemon.act(self.job, "resume")

    def fill(self, _):
        return fill(self.disk).unlink

    # ---- the round ----

    def disturb(self):
        """Causes faults at random moments, which overlap."""
        kinds = [self.kill, self.stop, self.cut, self.flap, self.slow, self.delay, self.crash,
                 self.fill]
        n = self.generator.randint(3, FAULTS)
        while len(self.happened) < n and self.state() not in ENDED:
            fault, i = self.generator.choice(kinds), self.generator.randrange(3)
            if fault.__name__ not in self.ending:
                self.happened.append(f"{fault.__name__} {i}")
                end = fault(i)
                if end is not None:
                    longest = 7.5 if self.generator.random() < 0.05 else 1.5
                    moment = time.monotonic() + self.generator.uniform(0.05, longest)
                    self.ending[fault.__name__] = moment, end
            self.end_faults(time.monotonic())
            time.sleep(self.generator.uniform(0, 0.3))
        while self.ending:
            self.end_faults(time.monotonic())
            time.sleep(0.01)

    def end_faults(self, now):
        for name, (moment, end) in list(self.ending.items()):
            if now >= moment:
                end()
                del self.ending[name]

    def check(self, expected, needed, scores):
        daemon = self.daemon
        daemon.succeed(self.job, "campaigns", attempts=2)
        result = history(daemon, self.job)
        for part, what in expected.items():
            assert result[part] == what, f"{part} differ from those of an undisturbed run"
        if self.lives == 1:  # nothing is stored twice, and nothing is lost
            assert rollouts(daemon) == needed
        assert events(daemon, "fleet.differs", "fleet.refused") == []
        for worker in self.workers:
            assert worker.process.poll() is None, worker.log.read_text()
            worker.close()
        daemon.end()
        assert stored_scores(daemon.state) == scores

    def close(self):
        for _, end in self.ending.values():
            end()
        for worker in self.workers:
            if worker is not None:
                worker.close()
        self.daemon.close()
        shutil.rmtree(self.disk / "d", ignore_errors=True)


def test_faults_at_random(daemon, network, secured, small_disk, seed, soak):
    expected, needed, _ = undisturbed(daemon, "undisturbed", VALUE)
    scores = stored_scores(daemon("undisturbed").state)
    for _ in range(3):
        network.add()
    n_faults = 0
    for number in range(200 if soak else 5):
        one = Round(network, secured, small_disk, number, random.Random(f"{seed} {number}"))
        begun = time.monotonic()
        try:
            one.start()
            one.disturb()
            one.check(expected, needed, scores)
        except BaseException:
            print(f"round {number} of seed {seed}: {one.happened}")
            raise
        finally:
            one.close()
        print(f"{number}: {time.monotonic() - begun:.1f} s {one.happened}")
        n_faults += len(one.happened)
    assert n_faults > 10
