#!/usr/bin/python3
"""Measures the cost of idle workers. Its own morphod holds sessions that wait for work, each with a
request for orders and one for leases. During that time, how long does /healthz take, how much of a
core does the daemon use, and does the number of its descriptors stay constant?"""
import argparse
import asyncio
import json
import os
import pathlib
import subprocess
import sys
import time

SOURCE = pathlib.Path(__file__).resolve().parents[1]
sys.path.insert(0, str(SOURCE / "tests" / "api"))

from service import Service  # noqa: E402
from workers import Workers, digest, results  # noqa: E402

TICK_S = 1 / os.sysconf("SC_CLK_TCK")
PAUSE_S = 0.005  # between two probes
# Runs in its own process, so that the work of the sessions here does not delay it.
PROBE = """
import http.client, sys, time
host, port, seconds, pause = sys.argv[1], *map(float, sys.argv[2:])
connection = http.client.HTTPConnection(host, int(port), timeout=30)
end = time.monotonic() + seconds
while time.monotonic() < end:
    begun = time.monotonic()
    connection.request("GET", "/healthz")
    assert connection.getresponse().read()
    print(time.monotonic() - begun)
    time.sleep(pause)
"""


class Connection:
    """One connection of a worker, for one request after the other."""
    def __init__(self, workers):
        self.workers, self.reader, self.writer = workers, None, None

    async def request(self, method, path, body=b"", **headers):
        if self.writer is None:
            self.reader, self.writer = await asyncio.open_connection(
                self.workers.host, self.workers.port, ssl=self.workers.context)
        lines = [f"{method} {path} HTTP/1.1", "Host: localhost", f"Content-Length: {len(body)}"]
        lines += [f"{name.replace('_', '-')}: {value}" for name, value in headers.items()]
        self.writer.write("\r\n".join(lines).encode() + b"\r\n\r\n" + body)
        head = (await self.reader.readuntil(b"\r\n\r\n")).decode().lower()
        reply = await self.reader.readexactly(int(head.split("content-length: ")[1].split()[0]))
        return int(head.split(" ")[1]), reply


async def session(workers, offer, number, ready):
    """Joins, and waits for orders and leases until it is cancelled."""
    orders, leases = Connection(workers), Connection(workers)
    offer = json.dumps(offer | {"name": f"idle {number}"}).encode()
    status, reply = await orders.request("POST", "/v1/fleet/sessions", offer,
                                         Content_Type="application/json")
    assert status == 201, reply
    path = "/v1/fleet/sessions/" + json.loads(reply)["session"]
    nothing = results()

    async def ask(connection, *request, **headers):
        while True:
            status, reply = await connection.request(*request, **headers)
            assert status == 200, reply

    ready.release()
    await asyncio.gather(
        ask(orders, "GET", path + "/orders", Prefer="wait=2"),
        ask(leases, "POST", path + "/exchange", nothing, Prefer="wait=30",
            Content_Type="application/octet-stream", Content_Digest=digest(nothing)))


def used(pid):
    """Returns processor seconds and descriptors of a process."""
    fields = pathlib.Path(f"/proc/{pid}/stat").read_text().rsplit(") ", 1)[1].split()
    return TICK_S * (int(fields[11]) + int(fields[12])), len(os.listdir(f"/proc/{pid}/fd"))


async def measure(workers, n, seconds):
    """Returns the 99th percentile of /healthz in seconds, the share of a core, and the growth in
    descriptors, while n sessions are idle."""
    service, ready = workers.service, asyncio.Semaphore(0)
    pid, offer = service.process.pid, workers.offer()
    tasks = [asyncio.create_task(session(workers, offer, i, ready)) for i in range(n)]
    for _ in range(n):
        await asyncio.wait_for(ready.acquire(), 60)
    await asyncio.sleep(min(3, seconds))  # by now each has renewed its request for orders
    before, begun = used(pid), time.monotonic()
    probe = await asyncio.create_subprocess_exec(
        sys.executable, "-c", PROBE, service.host, str(service.port), str(seconds), str(PAUSE_S),
        stdout=subprocess.PIPE)
    shown, _ = await probe.communicate()
    after, elapsed = used(pid), time.monotonic() - begun
    assert probe.returncode == 0 and workers.status()["n_sessions"] == n
    failed = [task.exception() for task in tasks if task.done()]
    assert not failed, failed[0]
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    times = sorted(map(float, shown.split()))
    return (times[int(0.99 * (len(times) - 1))], (after[0] - before[0]) / elapsed,
            after[1] - before[1])


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sessions", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=30, help="3600 for an hour")
    asked = parser.parse_args()
    service = Service("--fleet-listen=127.0.0.1:0")
    try:
        p99_s, share, grown = asyncio.run(measure(Workers(service), asked.sessions, asked.seconds))
    finally:
        service.close()
    missed = 0
    for what, value, bound, unit in (("/healthz, 99th percentile", 1e3 * p99_s, 50, "ms"),
                                     ("of a core", 100 * share, 10, "%"),
                                     ("more descriptors than at the start", grown, 8, "")):
        missed += value > bound
        print(f"{what:<40} {value:10.1f} {unit:<3} bound {bound:6.0f}  "
              f"{'ok' if value <= bound else 'MISSED'}", flush=True)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
