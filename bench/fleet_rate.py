#!/usr/bin/python3
"""Measures how many rollouts per second a daemon can accept from its workers. Its own morphod
computes nothing (compute=fleet), and a worker here answers every lease immediately with the same
row. All of the daemon's work is real: queues, leases, the messages with their digests, and the
store. The measurement ends when the last evaluation has succeeded, that is, when its last score is
committed. With --gradients, it measures a training run; each shard gets a canned sum of 5 MB."""
import argparse
import json
import pathlib
import struct
import sys
import threading
import time

SOURCE = pathlib.Path(__file__).resolve().parents[1]
sys.path.insert(0, str(SOURCE / "tests" / "api"))

from service import Service  # noqa: E402
from workers import HEADER, RESULT, Workers, digest, read_leases  # noqa: E402

N_DESIGNS, N_ENVIRONMENTS, ROWS_MAX = 10000, 10, 131072
LOSSES, STEPS = struct.pack("<d", 0.5) * ROWS_MAX, bytes(4 * ROWS_MAX)
SHARD, BATCH = 1024, 65536
DONE_WITH_GRADIENT = 3
COUNTS = struct.Struct("<Q6Qd")


def answers(leases):
    """Returns a message of canned results."""
    parts = [HEADER.pack(b"MOFLEETR", 1, len(leases), HEADER.size + sum(
        RESULT.size + 12 * rows for _, rows in leases))]
    for (epoch, number), rows in leases:
        parts += [RESULT.pack(epoch, number, 0, rows, 0.001, 0.001),
                  memoryview(LOSSES)[:8 * rows], memoryview(STEPS)[:4 * rows]]
    return b"".join(parts)


def shards(n_parameters):
    """Returns a function that answers leases of gradients."""
    total = struct.pack("<d", 1e-6) * n_parameters

    def answer(leases):
        size = HEADER.size + sum(RESULT.size + 12 * rows + COUNTS.size + len(total)
                                 for _, rows in leases)
        parts = [HEADER.pack(b"MOFLEETR", 1, len(leases), size)]
        for (epoch, number), rows in leases:
            parts += [RESULT.pack(epoch, number, DONE_WITH_GRADIENT, rows, 0.001, 0.001),
                      memoryview(LOSSES)[:8 * rows], memoryview(STEPS)[:4 * rows],
                      COUNTS.pack(n_parameters, rows, rows, 0, 0, 0, 0, 0.0), total]
        return b"".join(parts)

    return answer


class Canned(threading.Thread):
    """A worker that computes nothing. All of its requests use `connection`. most: results per
    message."""
    def __init__(self, workers, n_threads, answer=answers, most=8):
        super().__init__(daemon=True)
        self.workers, self.over, self.rows, self.leases = workers, False, 0, 0
        self.answer, self.most = answer, most
        self.path = workers.join(name=f"canned {n_threads}", n_threads=n_threads)

    def watch(self):
        connection = self.workers.connection()
        while not self.over:
            self.workers.send(connection, "GET", self.path + "/orders", Prefer="wait=2")
            if connection.getresponse().read() == b"":
                return

    def run(self):
        threading.Thread(target=self.watch, daemon=True).start()
        connection, leases = self.workers.connection(), []
        while not self.over:
            now, leases = leases[:self.most], leases[self.most:]
            body = self.answer(now)
            self.rows += sum(rows for _, rows in now)
            self.leases += len(now)
            self.workers.send(connection, "POST", self.path + "/exchange", body,
                              Prefer="wait=2" if not leases else None,
                              Content_Type="application/octet-stream", Content_Digest=digest(body))
            reply = connection.getresponse()
            down = reply.read()
            if reply.status != 200 and self.over:
                return
            if reply.status != 200:
                raise RuntimeError(f"the exchange was refused: {down.decode()}")
            leases += read_leases(down)


def train(service, steps):
    """Submits a training run with many shards per step, on bodies that need not be drawn."""
    drawn = service.post("/v1/bodies/random", {"count": SHARD, "seed": 1})["items"]
    return [service.post("/v1/trainings", {
        "kind": "finetune", "name": "canned", "steps": steps, "batch": BATCH,
        "designs": [{"voxels": one["genotype"]} for one in drawn],
        "validation": {"every_steps": 0}})["id"]]


def submit(service, n, seed):
    """Submits evaluations of new designs in the paper's test set. They wait, because nothing
    computes yet."""
    jobs = []
    for i in range(n):
        drawn = service.post("/v1/bodies/random", {"count": N_DESIGNS, "seed": seed + i})["items"]
        jobs.append(service.post("/v1/evaluations", {
            "designs": [{"voxels": one["genotype"]} for one in drawn], "priority": "batch"})["id"])
    return jobs


def used_s(pid):
    fields = pathlib.Path(f"/proc/{pid}/stat").read_text().rsplit(") ", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / 100


def main():
    parser = argparse.ArgumentParser(prog="tools/bench fleet-rate", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--evaluations", type=int, default=30,
                        help=f"of {N_DESIGNS} designs each (default 30)")
    parser.add_argument("--sessions", type=int, default=1)
    parser.add_argument("--gradients", type=int, default=0, metavar="STEPS",
                        help=f"steps of a training run with {BATCH // SHARD} shards each")
    parser.add_argument("--bound", type=float,
                        help="per second: rollouts (300000), or shards (80)")
    asked = parser.parse_args()
    bound = asked.bound or (80 if asked.gradients else 300000)
    service = Service("--fleet-listen=127.0.0.1:0", "--compute=fleet")
    try:
        how = {}
        if asked.gradients:
            how["answer"] = shards(service.get("/v1/controllers/default")["parameters"])
            how["most"] = 1  # an exchange has room for one sum
        workers = Workers(service)
        jobs = train(service, asked.gradients) if asked.gradients else \
            submit(service, asked.evaluations, 1)
        # They join last: a session that sends nothing for six seconds is lost.
        canned = [Canned(workers, 1000 + i, **how) for i in range(asked.sessions)]
        begun, used = time.monotonic(), used_s(service.process.pid)
        for one in canned:
            one.start()
        for job in jobs:
            while service.get(f"/v1/jobs/{job}")["state"] not in ("succeeded", "failed"):
                if not all(one.is_alive() for one in canned):
                    return 1  # the thread has printed the reason
                time.sleep(0.05)
        took, used = time.monotonic() - begun, used_s(service.process.pid) - used
        states = [service.get(f"/v1/jobs/{job}")["state"] for job in jobs]
        for one in canned:
            one.over = True
    finally:
        service.close()
    rows, leases = sum(one.rows for one in canned), sum(one.leases for one in canned)
    what, n = ("shards", leases) if asked.gradients else ("rollouts", rows)
    rate = n / took
    print(f"{rows} rollouts in {leases} leases, {took:.2f} s; the daemon used {used:.2f} s of "
          f"processors, {1e6 * used / rows:.2f} µs per rollout")
    good = states == ["succeeded"] * len(jobs) and rate >= bound
    print(f"{what + ' per second, to the committed row':<44} {rate:10.0f}     bound "
          f"{bound:7.0f}  {'ok' if good else 'MISSED'}")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
