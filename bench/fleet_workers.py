#!/usr/bin/python3
"""Measures the cost of the transport to workers. Its own morphod leaves an evaluation to one worker
with one thread, to three of them, and to one behind a delay of 150 ms. The bounds: three workers
compute at least 95 % of the rollouts per processor second of one, and the worker behind the delay
has work for at least 95 % of the time. Rollouts that three workers compute twice are counted and
shown: audits take one lease in ten of a new session. Other load on the machine changes the rates,
but barely affects the two ratios.

With --model: measures rollouts per second of one, two, four and more workers (--counts), as many as
leave the daemon a core, and compares them with the forecast of the model of a fleet (fleet_model.c)
for the cores of this machine. The model uses the rollouts per processor second of the same run. The
bound: they differ by at most 10 % on an idle machine."""
import argparse
import os
import pathlib
import subprocess
import sys
import tempfile
import time

TESTS = pathlib.Path(__file__).resolve().parents[1] / "tests"
sys.path[:0] = [str(TESTS / name) for name in ("fleet", "crash", "api")]

from daemon import BUILD, Daemon, bodies  # noqa: E402
from fleet import used  # noqa: E402
from machines import Worker, fleet_address  # noqa: E402
from network import Delay  # noqa: E402

N_ENVIRONMENTS = 10  # the default of the service
LEAST = 0.95
DIFFERENCE = 0.1


def runnable_s(worker):
    """Returns how long the computing thread had work: it ran, or waited for a processor."""
    tasks = pathlib.Path(f"/proc/{worker.process.pid}/task").iterdir()
    return max(sum(map(int, (task / "schedstat").read_text().split()[:2])) for task in tasks) / 1e9


def rates(n_workers, delay_s, designs):
    """Returns rollouts per processor second of the workers, new rollouts per second, the share
    computed twice, the share of the time in which the first worker had work, and the processors
    that they had."""
    with tempfile.TemporaryDirectory(prefix="morphod-bench-") as folder:
        settings = {"workers": 1, "compute": "fleet", "fleet_listen": "127.0.0.1:0"}
        workers = []
        try:
            with Daemon(folder, **settings) as daemon:
                address = fleet_address(daemon)
                if delay_s > 0:
                    delay = Delay(int(address.rpartition(":")[2]), delay_s, "127.0.0.1")
                    address = f"http://127.0.0.1:{delay.port}"
                workers = [Worker(folder, address, f"node-{i}") for i in range(n_workers)]
                daemon.until(lambda: daemon.json("/v1/fleet")["n_sessions"] == n_workers)
                before, had = sum(used(w.process.pid)[0] for w in workers), runnable_s(workers[0])
                begun = time.monotonic()
                job = daemon.submit({"designs": designs})
                daemon.succeed(job, timeout_s=600)
                elapsed = time.monotonic() - begun
                had_work = (runnable_s(workers[0]) - had) / elapsed
                processor_s = sum(used(w.process.pid)[0] for w in workers) - before
                twice = daemon.json("/v1/fleet")["rollouts_twice"]
        finally:
            for worker in workers:
                worker.close()
    n = len(designs) * N_ENVIRONMENTS
    return (n + twice) / processor_s, n / elapsed, twice / n, had_work, processor_s / elapsed


def modeled(n_workers, cores, rate, n_designs):
    """Returns rollouts per second according to the model."""
    n = n_designs * N_ENVIRONMENTS
    done = subprocess.run([BUILD / "bench" / "morpho-bench", "fleet-model", "forecast",
                           str(n_workers), str(cores), str(rate), str(n)], check=True,
                          capture_output=True, text=True).stdout
    return n / float(done)


def compare(n_designs, counts):
    """Prints measured rates next to those of the model, with this many designs per worker. Returns
    how many of them differ too much."""
    missed, cores = 0, os.cpu_count()
    for n_workers in counts:
        designs = bodies(1, n_designs * n_workers)
        of_core, rate, twice, _, had = rates(n_workers, 0, designs)
        on_paper = modeled(n_workers, cores, of_core, len(designs))
        differs = rate / on_paper - 1
        missed += abs(differs) > DIFFERENCE
        print(f"{n_workers} workers: {rate:.0f} rollouts/s, {100 * twice:.1f} % twice; "
              f"{of_core:.0f} per processor second, {had:.2f} processors; the model says "
              f"{on_paper:.0f} on {cores} cores: {100 * differs:+.1f} %", flush=True)
    return missed


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--designs", type=int, default=2000)
    parser.add_argument("--delay-s", type=float, default=0.15)
    parser.add_argument("--model", action="store_true", help="compare with the model's forecast")
    parser.add_argument("--counts", help="of workers, with --model: 1,2,4,…")
    asked = parser.parse_args()
    if asked.model:
        counts = asked.counts.split(",") if asked.counts else \
            [1 << i for i in range((os.cpu_count() - 1).bit_length())]
        return 1 if compare(asked.designs, [int(n) for n in counts]) else 0
    designs = bodies(1, asked.designs)
    one, alone, _, direct, _ = rates(1, 0, designs)
    three, together, twice, _, _ = rates(3, 0, designs)
    _, delayed, _, behind, _ = rates(1, asked.delay_s, designs)
    print(f"one worker: {one:.0f} rollouts per processor second, {alone:.0f}/s; three: "
          f"{three:.0f}, {together:.0f}/s, {100 * twice:.1f} % twice; behind "
          f"{1e3 * asked.delay_s:.0f} ms: {delayed:.0f}/s")
    missed = 0
    for what, value in (("three, of one's rollouts per processor second", three / one),
                        ("behind the delay, of one's time with work", behind / direct)):
        missed += value < LEAST
        print(f"{what:<48} {value:6.3f}  bound {LEAST}  {'ok' if value >= LEAST else 'MISSED'}",
              flush=True)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
