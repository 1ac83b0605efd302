"""A separate morphod: started on a free port in its own folder, used over HTTP, stopped or
killed."""
import hashlib
import os
import pathlib
import random
import re
import signal
import sqlite3
import subprocess
import time

import requests

REPOSITORY = pathlib.Path(__file__).resolve().parents[2]
BUILD = pathlib.Path(os.environ.get("MORPHOD_BUILD", REPOSITORY / "build"))
MORPHOD = BUILD / "src" / "daemon" / "morphod"
OLDER = BUILD / "tests" / "morphod-older"
MORPHOCTL = BUILD / "clients" / "morphoctl" / "morphoctl"
ACCEPTED = (200, 202)
ENDED = ("succeeded", "failed", "cancelled")
# Time limit of a wait for something that must happen. It is far above the usual time, because the
# machine may be slow and busy.
PATIENCE_S = 300
# The service stops within 9 s of the signal. The rest is for such a machine.
STOP_S = 40


def rest(begun, least_s):
    """Sleeps between two looks at something that has been awaited since `begun`: longer after a
    long wait, so that looking takes little processor time, and is late by a fiftieth at most."""
    time.sleep(max(least_s, min((time.monotonic() - begun) / 50, 0.1)))


CONTROLLER = REPOSITORY / "data" / "controllers" / "bootstrap.safetensors"


def grow(generator):
    """Returns a random contiguous body as 144 digits."""
    cells = {(generator.randrange(6), generator.randrange(6), generator.randrange(4))}
    size = generator.randint(1, 40)
    while len(cells) < size:
        x, y, z = generator.choice(sorted(cells))
        dx, dy, dz = generator.choice(
            ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)))
        cell = (x + dx, y + dy, z + dz)
        if 0 <= cell[0] < 6 and 0 <= cell[1] < 6 and 0 <= cell[2] < 4:
            cells.add(cell)
    return "".join("1" if (x, y, z) in cells else "0" for x in range(6) for y in range(6)
                   for z in range(4))


def bodies(seed, n):
    generator = random.Random(seed)
    return [{"voxels": grow(generator)} for _ in range(n)]


class Daemon:
    binary = MORPHOD

    def __init__(self, folder, beside=None, **settings):
        """Its log and address are also in the folder, or in the folder `beside`."""
        self.folder = pathlib.Path(folder)
        self.state = self.folder / "state"
        self.log = (beside or self.folder) / "log"
        self.port_file = (beside or self.folder) / "address"
        self.settings = {"worker_nice": 0, "log_level": "info", "devices": "none", **settings}
        self.process = None
        self.address = None
        self.session = requests.Session()

    def command(self, *more):
        flags = [f"--{k.replace('_', '-')}={v}" for k, v in self.settings.items()]
        return [
            str(self.binary), f"--state-dir={self.state}", "--listen=127.0.0.1:0",
            f"--port-file={self.port_file}", f"--default-controller={CONTROLLER}", *flags, *more
        ]

    def spawn(self, command=None, pass_fds=(), **environment):
        """Starts the process without waiting for it."""
        self.folder.mkdir(parents=True, exist_ok=True)
        self.port_file.unlink(missing_ok=True)
        inherited = {k: v for k, v in os.environ.items() if not k.startswith("MORPHOD_")}
        with open(self.log, "ab") as log:
            self.process = subprocess.Popen(command or self.command(), stdout=log, stderr=log,
                                            env=inherited | environment, pass_fds=pass_fds)
        return self

    def start(self, timeout_s=600):
        self.spawn()
        self.await_address(timeout_s)
        self.session.close()
        self.session = requests.Session()
        return self

    def await_address(self, timeout_s=600):
        self.until(lambda: self.port_file.exists() or self.process.poll() is not None, timeout_s)
        if not self.port_file.exists():
            raise RuntimeError(f"morphod ended with {self.process.returncode}:\n{self.tail()}")
        self.address = self.port_file.read_text().split()[0]

    def tail(self, n=30):
        return "\n".join(self.log.read_text(
            errors="replace").splitlines()[-n:]) if self.log.exists() else ""

    def kill(self):
        """kill -9: like a power cut for the process, but without losing the disk's cache.
        """
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()

    def stop(self):
        """Sends SIGTERM, and returns (exit status, seconds)."""
        begin = time.monotonic()
        self.process.send_signal(signal.SIGTERM)
        try:
            status = self.process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            self.kill()
            raise RuntimeError(f"morphod did not stop within {STOP_S} s:\n{self.tail()}") from None
        return status, time.monotonic() - begin

    def end(self):
        """Stops in order, and checks that the database is intact."""
        assert self.stop()[0] == 0, self.tail()
        check_database(self.state)

    def close(self):
        self.session.close()
        if self.process is not None and self.process.poll() is None:
            self.kill()

    def __enter__(self):
        return self.start()

    def __exit__(self, *_):
        self.close()

    # ---- requests ----

    def get(self, path, **options):
        return self.session.get(self.address + path, timeout=300, **options)

    def json(self, path):
        reply = self.get(path)
        assert reply.status_code == 200, reply.text
        return reply.json()

    def counted(self, name):
        """Returns a counter of this process, without labels."""
        return int(re.search(rf"^{name} (\d+)$", self.get("/metrics").text, re.M)[1])

    def send(self, path, value=None, key=None, wait_s=0, timeout_s=90):
        """Sends a POST, and returns the reply."""
        headers = {} if key is None else {"Idempotency-Key": key}
        if wait_s:
            headers["Prefer"] = f"wait={wait_s}"
        return self.session.post(self.address + path, json=value, headers=headers,
                                 timeout=timeout_s)

    def post(self, path, value=None, **options):
        """Sends a POST that must be accepted, and returns its JSON."""
        reply = self.send(path, value, **options)
        assert reply.status_code in ACCEPTED, f"{path}: {reply.text}\n{self.tail()}"
        return reply.json()

    def put(self, name, content):
        """Stores a controller."""
        reply = self.session.put(f"{self.address}/v1/controllers/{name}/file", data=content,
                                 headers={"Content-Type": "application/octet-stream"})
        assert reply.status_code in (200, 201), reply.text

    def act(self, job, verb):
        return self.post(f"/v1/jobs/{job}/{verb}")

    def evaluate(self, request, **options):
        """Sends an evaluation, and returns the reply."""
        return self.send("/v1/evaluations", request, **options)

    def submit(self, request, kind="evaluations", **options):
        return self.post(f"/v1/{kind}", request, **options)["id"]

    def awaited(self, path, condition, timeout_s=300, every_s=0.005):
        """Returns the JSON of GET PATH as soon as it satisfies the condition."""
        return self.until(lambda: self.json(path), timeout_s, condition, every_s)

    def until(self, look, timeout_s=900, holds=bool, every_s=0.005):
        """Calls look() until holds(its result) is true, and returns that result."""
        begun = time.monotonic()
        while not holds(seen := look()):
            assert time.monotonic() < begun + timeout_s, f"{seen}\n{self.tail()}"
            rest(begun, every_s)
        return seen

    def failed_writes(self):
        """Returns the number of writes that failed, such as those on a full disk."""
        text = self.get("/metrics").text
        return int(re.search(r"^morphod_store_operations_failed_total (\d+)", text, re.M)[1])

    def finish(self, job, kind="evaluations", timeout_s=900):
        """Waits for the end of a job and returns it."""
        return self.awaited(f"/v1/{kind}/{job}", lambda now: now["state"] in ENDED, timeout_s, 0.05)

    def succeed(self, job, kind="evaluations", timeout_s=900, attempts=0):
        done = self.finish(job, kind, timeout_s)
        assert done["state"] == "succeeded" and done["attempts"] <= attempts, done
        return done

    def score(self, request, timeout_s=900):
        return self.succeed(self.submit(request), timeout_s=timeout_s)

    def result(self, controller):
        """Returns the file of a job's result. Fails if it does not match its hash."""
        reply = self.get(f"/v1/controllers/{controller['name']}/file")
        assert reply.status_code == 200, reply.text
        assert hashlib.sha256(reply.content).hexdigest() == controller["sha256"]
        return reply.content


# ---- the database, read while no process uses it ----

SCORES = """
SELECT g.bits, c.sha256, p.sha256, f.text, e.sha256, s.losses, length(k.environments) / 8,
       v.position
FROM scores s JOIN conditions k ON k.id = s.condition JOIN genotypes g ON g.id = s.genotype
JOIN controllers c ON c.id = k.controller JOIN physics p ON p.id = k.physics
JOIN fingerprints f ON f.id = k.fingerprint JOIN condition_environments v ON v.condition = k.id
JOIN environments e ON e.id = v.environment
"""


def open_database(state):
    return sqlite3.connect(f"file:{pathlib.Path(state) / 'morphod.db'}?mode=rw", uri=True)


def stored_scores(state):
    """Returns {key: (loss bytes, diverged step)}. Fails on a duplicate key."""
    database = open_database(state)
    scores = {}
    for *key, losses, n, place in database.execute(SCORES):
        assert tuple(key) not in scores, "a score is stored twice"
        steps = losses[8 * n:-8] or bytes(4 * n)  # the last eight bytes are the checksum
        scores[tuple(key)] = (losses[8 * place:8 * place + 8],
                              int.from_bytes(steps[4 * place:4 * place + 4], "little"))
    database.close()
    return scores


def check_database(state):
    """Checks requirements of every database that no process uses."""
    database = open_database(state)
    assert database.execute("PRAGMA integrity_check").fetchall() == [("ok", )]
    assert database.execute("PRAGMA foreign_key_check").fetchall() == []
    for table, key in (("designs", "form"), ("genotypes", "bits"), ("environments", "sha256"),
                       ("controllers", "sha256")):
        total, distinct = database.execute(
            f"SELECT count(*), count(DISTINCT {key}) FROM {table}").fetchone()
        assert total == distinct, f"{table}: {total - distinct} rows are duplicates"
    stored_scores(state)
    for (row, ) in database.execute(
            "SELECT j.id FROM jobs j JOIN evaluations e ON e.job = j.id WHERE j.state = 3 AND "
            "e.done <> e.n_designs * e.n_environments * "
            "iif(e.n_displaced > 0, 2 + e.n_displaced, 1) * iif(e.tolerance > 0, 5, 1)"):
        raise AssertionError(f"job {row} has succeeded without all its rollouts")
    database.close()
