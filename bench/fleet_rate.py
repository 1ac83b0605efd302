#!/usr/bin/python3
"""Measures how many rollouts per second a daemon can take from its workers: a morphod of its own
computes nothing (compute=fleet), and a worker here answers every lease at once with the same row.
All of the daemon's work is real: queues, leases, the messages with their digests, and the store.
The time ends when the last evaluation has succeeded, that is, when its last score is committed."""
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


def answers(leases):
    """A message of canned results."""
    parts = [HEADER.pack(b"MOFLEETR", 1, len(leases), HEADER.size + sum(
        RESULT.size + 12 * rows for _, rows in leases))]
    for (epoch, number), rows in leases:
        parts += [RESULT.pack(epoch, number, 0, rows, 0.001, 0.001),
                  memoryview(LOSSES)[:8 * rows], memoryview(STEPS)[:4 * rows]]
    return b"".join(parts)


class Canned(threading.Thread):
    """A worker that computes nothing; `connection` lasts for all of its requests."""
    def __init__(self, workers, n_threads):
        super().__init__(daemon=True)
        self.workers, self.over, self.rows, self.leases = workers, False, 0, 0
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
            body = answers(leases)
            self.rows += sum(rows for _, rows in leases)
            self.leases += len(leases)
            self.workers.send(connection, "POST", self.path + "/exchange", body, Prefer="wait=2",
                              Content_Type="application/octet-stream", Content_Digest=digest(body))
            reply = connection.getresponse()
            down = reply.read()
            if reply.status != 200:
                sys.exit(f"the exchange was refused: {down.decode()}")
            leases = read_leases(down)


def submit(service, n, seed):
    """Evaluations of new designs in the paper's test set, which wait: nobody computes yet."""
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
    parser.add_argument("--bound", type=float, default=300000, help="rollouts per second")
    asked = parser.parse_args()
    service = Service("--fleet-listen=127.0.0.1:0", "--compute=fleet")
    try:
        jobs = submit(service, asked.evaluations, 1)
        workers = Workers(service)
        canned = [Canned(workers, 1000 + i) for i in range(asked.sessions)]
        begun, used = time.monotonic(), used_s(service.process.pid)
        for one in canned:
            one.start()
        for job in jobs:
            while service.get(f"/v1/jobs/{job}")["state"] not in ("succeeded", "failed"):
                time.sleep(0.05)
        took, used = time.monotonic() - begun, used_s(service.process.pid) - used
        states = [service.get(f"/v1/jobs/{job}")["state"] for job in jobs]
        for one in canned:
            one.over = True
    finally:
        service.close()
    rows, leases = sum(one.rows for one in canned), sum(one.leases for one in canned)
    rate = rows / took
    print(f"{rows} rollouts in {leases} leases, {took:.2f} s; the daemon used {used:.2f} s of "
          f"processors, {1e6 * used / rows:.2f} µs per rollout")
    good = states == ["succeeded"] * len(jobs) and rate >= asked.bound
    print(f"{'rollouts per second, to the committed row':<44} {rate:10.0f}     bound "
          f"{asked.bound:7.0f}  {'ok' if good else 'MISSED'}")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
