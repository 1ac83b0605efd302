#!/usr/bin/python3
"""Measures from outside how its own morphod behaves while the cores compute.

load: a batch of 10,000 designs in the paper's test set keeps the cores busy. How long does it take
until such a request is accepted, that is, durable, when idle and under load? What is the latency of
/healthz over 64 connections without pauses? How long does one interactive design take from the
request to its score?

shares: a batch evaluation of 10,000 designs, a training run and four zero-shot campaigns, with
different weights. Does each get its share of the cores, and do small evaluations keep their speed?
The rollouts of the training run are short: a block of gradients over 1000 steps takes seconds, so a
fair measurement would take many minutes."""
import argparse
import json
import pathlib
import re
import selectors
import socket
import statistics
import sys
import tempfile
import time
import urllib.parse

SOURCE = pathlib.Path(__file__).resolve().parents[1]
sys.path.insert(0, str(SOURCE / "experiments"))

from own_daemon import Daemon  # noqa: E402

N_DESIGNS, N_CONNECTIONS = 10000, 64
ASK = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n"
WEIGHTS = (1, 1, 2, 4)  # of the campaigns


def quantile(values, share):
    return sorted(values)[int((len(values) - 1) * share)]


def verdict(what, value, bound, unit="ms"):
    """Prints a measurement. Returns 1 if the bound is missed."""
    print(f"{what:<58} {value:10.1f} {unit:<3} bound {bound:6.0f}  "
          f"{'ok' if value <= bound else 'MISSED'}", flush=True)
    return value > bound


def timed(function, *arguments):
    """Returns the milliseconds of a call, and its result."""
    begun = time.monotonic()
    value = function(*arguments)
    return 1e3 * (time.monotonic() - begun), value


class Busy:
    """The daemon, and random bodies that it has not scored yet."""

    def __init__(self, daemon, seed):
        self.daemon, self.seed = daemon, seed

    def evaluation(self, n, wait="", **more):
        """Returns how long a request of n bodies takes, and the reply."""
        self.seed += 1
        drawn = self.daemon.call("/v1/bodies/random", {"count": n, "seed": self.seed})["items"]
        body = {"designs": [{"voxels": one["genotype"]} for one in drawn], **more}
        headers = {"Content-Type": "application/json"} | ({"Prefer": wait} if wait else {})
        took, reply = timed(self.daemon.fetch, "/v1/evaluations", json.dumps(body).encode(),
                            headers)
        return took, json.loads(reply)

    def batch(self, **more):
        return self.evaluation(N_DESIGNS, priority="batch", **more)

    def interactive(self, n, pause_s):
        """Returns how long one design takes, n times."""
        taken = []
        for _ in range(n):
            took, reply = self.evaluation(1, "wait=30")
            if "results" not in reply:
                sys.exit(f"an interactive design was not done: {reply}")
            taken.append(took)
            time.sleep(pause_s)
        return taken


def ask_health(address, duration_s):
    """64 connections that send the next request after each reply. Returns latencies in ms."""
    url, selector = urllib.parse.urlsplit(address), selectors.DefaultSelector()
    taken, begun = [], {}
    end = time.monotonic() + duration_s
    for _ in range(N_CONNECTIONS):
        one = socket.create_connection((url.hostname, url.port))
        selector.register(one, selectors.EVENT_READ)
        begun[one] = time.monotonic()
        one.send(ASK)
    while time.monotonic() < end:
        for key, _ in selector.select(1):
            reply, now = key.fileobj.recv(4096), time.monotonic()
            head, _, body = reply.partition(b"\r\n\r\n")
            length = re.search(rb"(?i)content-length: (\d+)", head)
            if not head.startswith(b"HTTP/1.1 200") or len(body) != int(length[1]):
                sys.exit(f"/healthz: {reply}")
            taken.append(1e3 * (now - begun[key.fileobj]))
            begun[key.fileobj] = time.monotonic()
            key.fileobj.send(ASK)
    for one in begun:
        one.close()
    return taken


def load(busy, quick):
    idle, _ = busy.batch()
    time.sleep(2)  # now every core computes
    duration_s = 3 if quick else 15
    health = ask_health(busy.daemon.address, duration_s)
    small = busy.interactive(20, 0)
    loaded, _ = busy.batch()
    running = busy.daemon.call("/v1/jobs?state=running")["items"]
    print(f"morphod under a batch of {N_DESIGNS} designs ("
          f"{sum(job['rollouts_done'] for job in running)} rollouts done when the last figure was "
          "taken)")
    missed = verdict("10,000 designs accepted, idle", idle, 1000)
    missed += verdict("10,000 designs accepted while the cores compute", loaded, 1000)
    missed += verdict("/healthz over 64 connections, 99th percentile", quantile(health, 0.99), 50)
    print(f"  (median {statistics.median(health):.2f} ms, longest {max(health):.1f} ms, "
          f"{len(health) / duration_s:.0f} requests per second)")
    missed += verdict("one interactive design × 10 environments, longest of 20", max(small), 1000)
    print(f"  (median {statistics.median(small):.1f} ms)")
    return missed


def busy_s(daemon, job):
    """Worker seconds so far. The evaluation is the only one of its kind that runs."""
    kind = job["kind_of"]
    if kind == "evaluations":
        found = re.search(r'morphod_job_worker_seconds_total\{kind="evaluation"\} (\S+)',
                          daemon.fetch("/metrics").decode())
        return float(found[1])
    return daemon.call(f"/v1/{kind}/{job['id']}")["progress"]["busy_s"] or 0


def shares(busy, quick):
    daemon = busy.daemon
    training = {"kind": "pretrain", "steps": 100000, "batch": 256, "seed": busy.seed, "weight": 2,
                "physics": {"n_steps": 100}, "validation": {"every_steps": 0}}
    campaign = {"mode": "zero-shot", "preset": "demo", "population": 64, "generations": 10000,
                "exclude_pretraining": False}
    jobs = [busy.batch(weight=2)[1] | {"kind_of": "evaluations"},
            daemon.call("/v1/trainings", training) | {"kind_of": "trainings"}]
    jobs += [daemon.call("/v1/campaigns", campaign | {"seed": i + 1, "weight": weight})
             | {"kind_of": "campaigns"} for i, weight in enumerate(WEIGHTS)]
    until = time.monotonic() + 120  # the cost of the first blocks is only estimated
    while min(busy_s(daemon, job) for job in jobs) <= 1:
        if time.monotonic() > until:
            sys.exit("not every job computes")
        time.sleep(0.1)
    time.sleep(10)
    seconds = 15 if quick else 60
    before = [busy_s(daemon, job) for job in jobs]
    time.sleep(seconds)
    got = [busy_s(daemon, job) - start for job, start in zip(jobs, before)]
    weights = [job["weight"] for job in jobs]
    print(f"worker seconds in {seconds} s\n"
          "job              weight  worker s    share  by weight  off by")
    most = 0
    for job, weight, worker_s in zip(jobs, weights, got):
        part, wanted = worker_s / sum(got), weight / sum(weights)
        off = part / wanted - 1
        print(f"{job['kind_of'][:-1] + ' ' + job['id']:<16} {weight:6g} {worker_s:9.2f} "
              f"{part:8.1%} {wanted:10.1%} {off:7.1%}")
        most = max(most, abs(off))
    missed = verdict("largest difference", 100 * most, 10, "%")
    taken = busy.interactive(60, 0.1)
    missed += verdict("one interactive design × 10 environments, 95th percentile",
                      quantile(taken, 0.95), 1500)
    print(f"  (60 times during that: median {statistics.median(taken):.0f} ms, longest "
          f"{max(taken):.0f} ms)")
    return missed


def main():
    parser = argparse.ArgumentParser(prog="tools/bench", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("load", "shares"))
    parser.add_argument("--quick", action="store_true", help="shorter measurements")
    parser.add_argument("--seed", type=int, default=1, help="of the bodies (default 1)")
    parser.add_argument("--morphod", type=pathlib.Path, help="the daemon (default: the build's)",
                        default=SOURCE / "build/src/daemon/morphod")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="morphod-bench-") as state:
        with Daemon(arguments.morphod, pathlib.Path(state), "--log-level=error",
                    "--max-campaigns=4") as daemon:
            measure = load if arguments.what == "load" else shares
            return 1 if measure(Busy(daemon, arguments.seed), arguments.quick) else 0


if __name__ == "__main__":
    sys.exit(main())
