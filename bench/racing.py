#!/usr/bin/python3
"""Measures what racing saves: the same zero-shot campaign without and with it, each in a state
folder of its own. Prints rollouts and seconds of both, whether their populations are the same, and
what could be saved: reckoned beforehand from the losses of the campaign without racing, for several
ways to cut the environments into waves, and for three orders of the environments. With --best, the
same for an evaluation of the best of random bodies."""
import argparse
import json
import math
import os
import pathlib
import sqlite3
import struct
import subprocess
import sys
import tempfile
import time
import urllib.request

import racing_best

SOURCE = pathlib.Path(__file__).resolve().parents[1]
WAVES = ((2, 8), (4, 6), (2, 3, 5), (2, 2, 2, 4), (1,) * 10)  # of ten environments


class Daemon:
    """A daemon with a state folder of its own, without designs that are excluded."""
    def __init__(self, options, folder):
        self.folder = pathlib.Path(folder)
        ports = self.folder / "addresses"
        self.process = subprocess.Popen(
            [options.build / "src/daemon/morphod", f"--state-dir={folder}/state",
             "--listen=127.0.0.1:0", f"--port-file={ports}", f"--workers={options.workers}",
             f"--devices={'auto' if options.device == 'gpu' else 'none'}", "--log-level=error",
             *options.option],
            env=os.environ | {"MORPHOD_DEFAULT_CONTROLLER": str(options.controller)},
            stdout=subprocess.DEVNULL)
        while not ports.exists():
            assert self.process.poll() is None, "the daemon did not start"
            time.sleep(0.05)
        self.url = ports.read_text(encoding="ascii").split()[0]

    def get(self, path, body=None):
        request = urllib.request.Request(self.url + path, body and json.dumps(body).encode(),
                                         {"Content-Type": "application/json"})
        with urllib.request.urlopen(request) as reply:
            return json.load(reply)

    def all_of(self, path):
        items, cursor = [], ""
        while cursor is not None:
            page = self.get(f"{path}&limit=1000" + (f"&cursor={cursor}" if cursor else ""))
            items += page["items"]
            cursor = page.get("next")
        return items

    def stop(self):
        self.process.terminate()
        self.process.wait()


def run(daemon, options, racing):
    """Runs the campaign to its end. Returns its generations, the seconds of cores and devices, and
    its last population. Prints what the device did: how long no call was in flight is the host's
    time between calls."""
    campaign = daemon.get("/v1/campaigns", {
        "mode": "zero-shot", "population": options.population, "generations": options.generations,
        "seed": options.seed, "exclude_pretraining": False, "racing": racing})["id"]
    while True:
        status = daemon.get(f"/v1/campaigns/{campaign}")
        if status["state"] not in ("queued", "running"):
            break
        time.sleep(0.2)
    assert status["state"] == "succeeded", status
    generations = daemon.all_of(f"/v1/campaigns/{campaign}/generations?format=json")
    for device in daemon.get("/v1/devices")["items"]:
        wall_s, n = sum(row["seconds"] for row in generations), len(generations)
        busy_s = device["busy_s"]
        print(f"{racing:9} {device['name']}: {device['calls'] / n:.1f} calls a generation,"
              f" {busy_s / n:.3f} s in calls, {(wall_s - busy_s) / n:.3f} s between them,"
              f" busy {busy_s / wall_s:.3f}")
    population = daemon.all_of(f"/v1/campaigns/{campaign}/population?format=json")
    return (generations, status["core_seconds"] + status["device_seconds"],
            [(row["number"], row["score"]) for row in population])


def read_losses(folder):
    """Reads born, died and losses of every design from the state folder."""
    connection = sqlite3.connect(f"file:{folder}/state/morphod.db?mode=ro", uri=True)
    rows = connection.execute(
        "SELECT d.born,d.died,s.losses,length(c.environments)/8 FROM campaign_designs d"
        " JOIN scores s ON s.genotype=d.genotype JOIN conditions c ON c.id=s.condition"
        " ORDER BY d.number").fetchall()
    connection.close()
    return [(born, math.inf if died is None else died, struct.unpack(f"<{n}d", losses[:8 * n]))
            for born, died, losses, n in rows]


def reckon(designs, waves, order_of):
    """Returns the share of the children's rollouts that a race would compute."""
    n = len(designs[0][2])
    computed = whole = 0
    for generation in range(1, max(design[0] for design in designs) + 1):
        parents = [d[2] for d in designs if d[0] < generation <= d[1]]
        bound = max(sum(losses) / n for losses in parents)
        order = order_of(parents)
        for _, _, losses in (d for d in designs if d[0] == generation):
            end, known = 0, [0.0] * n
            for size in waves:
                for k in order[end:end + size]:
                    known[k] = losses[k]
                end += size
                if sum(known) / n > bound:
                    break
            computed += min(end, n)
            whole += n
    return computed / whole


def spread(parents):
    def variance(k):
        finite = [losses[k] for losses in parents if math.isfinite(losses[k])]
        mean = sum(finite) / len(finite)
        return sum((loss - mean) ** 2 for loss in finite) / len(finite)
    return sorted(range(len(parents[0])), key=lambda k: -variance(k))


def hardest(parents):
    def mean(k):
        finite = [losses[k] for losses in parents if math.isfinite(losses[k])]
        return sum(finite) / len(finite)
    return sorted(range(len(parents[0])), key=lambda k: -mean(k))


def main():
    parser = argparse.ArgumentParser(prog="tools/bench racing", description=__doc__)
    parser.add_argument("--population", type=int, default=512)
    parser.add_argument("--generations", type=int, default=100)
    parser.add_argument("--best", type=int, help="an evaluation that asks for so many")
    parser.add_argument("--designs", type=int, default=10000, help="of so many random bodies")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--device", choices=("cpu", "gpu"), default="cpu")
    parser.add_argument("--workers", type=int, default=0, help="0: one per processor")
    parser.add_argument("--option", action="append", default=[], help="further option of morphod")
    parser.add_argument("--build", type=pathlib.Path, default=SOURCE / "build")
    parser.add_argument("--controller", type=pathlib.Path,
                        default=SOURCE / "data/controllers/phototaxis.safetensors")
    options = parser.parse_args()
    if options.best is not None:
        return racing_best.measure(options, Daemon)
    found = {}
    for racing in ("off", "lossless"):
        with tempfile.TemporaryDirectory(prefix="morphod-racing-") as folder:
            daemon = Daemon(options, folder)
            try:
                generations, cores_s, population = run(daemon, options, racing)
            finally:
                daemon.stop()
            found[racing] = (sum(row["rollouts"] for row in generations[1:]),
                             sum(row["seconds"] for row in generations[1:]), cores_s, population)
            print(f"{racing:9} {found[racing][0]:9} rollouts of children, {found[racing][1]:8.2f} s"
                  f" in {len(generations) - 1} generations, {cores_s:8.2f} s of cores and devices",
                  flush=True)
            if racing == "off":
                designs = read_losses(folder)
    same = found["off"][3] == found["lossless"][3]
    print(f"share     {found['lossless'][0] / found['off'][0]:9.3f} of the rollouts,"
          f" {found['lossless'][1] / found['off'][1]:.3f} of the time,"
          f" {found['lossless'][2] / found['off'][2]:.3f} of that of cores and devices;"
          f" {'the same population' if same else 'ANOTHER POPULATION'}")
    print("reckoned beforehand, rollouts of children by order of the environments:")
    print("waves       largest spread first   hardest first   as in the set")
    for waves in WAVES:
        if sum(waves) == len(designs[0][2]):
            print(f"{'+'.join(map(str, waves)) if len(set(waves)) > 1 else 'single':12}"
                  f"{reckon(designs, waves, spread):20.3f}{reckon(designs, waves, hardest):16.3f}"
                  f"{reckon(designs, waves, lambda parents: range(len(parents[0]))):16.3f}")
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main())
