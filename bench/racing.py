#!/usr/bin/python3
"""Measures the savings of racing: the same campaign without and with it, each in its own state
folder. Prints rollouts and seconds of both, and whether their histories are the same: births,
deaths, populations, statistics, learned weights. For a zero-shot campaign, also prints an estimate
of the savings from the losses of the campaign without racing, for several ways to split the
environments into waves, and for three orders of the environments. With --best, does the same for an
evaluation of the best of random bodies."""
import argparse
import csv
import math
import pathlib
import sqlite3
import struct
import sys
import tempfile

import racing_best

SOURCE = pathlib.Path(__file__).resolve().parents[1]
sys.path.insert(0, str(SOURCE / "tests" / "crash"))

from campaigns import MODES, check_same_lives, history  # noqa: E402
from daemon import Daemon  # noqa: E402

WAVES = ((2, 8), (4, 6), (2, 3, 5), (2, 2, 2, 4), (1,) * 10)  # of ten environments


def start(options, folder):
    """Starts a daemon with its own state folder."""
    daemon = Daemon(folder, workers=options.workers, log_level="error",
                    devices="auto" if options.device == "gpu" else "none",
                    default_controller=options.controller)
    daemon.binary = options.build / "src" / "daemon" / "morphod"
    return daemon


def run(daemon, options, racing):
    """Runs the campaign to its end. Returns rollouts and seconds of its generations except the
    first, the seconds of cores and devices, and its history. Prints the activity of the device: the
    time without a call in flight is the host's time between calls."""
    value = {"mode": options.mode, "seed": options.seed, "exclude_pretraining": False,
             "racing": racing}
    if options.mode != "zero-shot":
        value["controller"] = "default"
    for name in ("preset", "population", "generations"):
        if getattr(options, name) is not None:
            value[name] = getattr(options, name)
    status = daemon.succeed(daemon.submit(value, "campaigns"), "campaigns", 7 * 86400)
    path = f"/v1/campaigns/{status['id']}"
    rows = [{name: float(row[name] or 0) for name in ("rollouts", "seconds")} for row in
            csv.DictReader(daemon.get(f"{path}/generations?format=csv").text.splitlines())]
    for device in daemon.json("/v1/devices")["items"]:
        wall_s, n = sum(row["seconds"] for row in rows), len(rows)
        busy_s = device["busy_s"]
        print(f"{racing:9} {device['name']}: {device['calls'] / n:.1f} calls per generation,"
              f" {busy_s / n:.3f} s in calls, {(wall_s - busy_s) / n:.3f} s between them,"
              f" busy {busy_s / wall_s:.3f}")
    rollouts, seconds = (sum(row[name] for row in rows[1:]) for name in ("rollouts", "seconds"))
    cores_s = status["core_seconds"] + status["device_seconds"]
    print(f"{racing:9} {rollouts:9.0f} rollouts, {seconds:8.2f} s in {len(rows) - 1} generations,"
          f" {cores_s:8.2f} s of cores and devices", flush=True)
    return rollouts, seconds, cores_s, history(daemon, status["id"])


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


def estimate(designs, waves, order_of):
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


def print_estimates(designs):
    print("estimated rollouts of children, by order of the environments:")
    print("waves       largest spread first   hardest first   as in the set")
    for waves in WAVES:
        if sum(waves) == len(designs[0][2]):
            print(f"{'+'.join(map(str, waves)) if len(set(waves)) > 1 else 'single':12}"
                  f"{estimate(designs, waves, spread):20.3f}"
                  f"{estimate(designs, waves, hardest):16.3f}"
                  f"{estimate(designs, waves, lambda parents: range(len(parents[0]))):16.3f}")


def main():
    parser = argparse.ArgumentParser(prog="tools/bench racing", description=__doc__)
    parser.add_argument("--mode", choices=MODES, default="zero-shot")
    parser.add_argument("--preset", help="its population and generations")
    parser.add_argument("--population", type=int, help="default: the preset's, or 512")
    parser.add_argument("--generations", type=int, help="default: the preset's, or 100")
    parser.add_argument("--best", type=int, help="an evaluation of this many best designs")
    parser.add_argument("--designs", type=int, default=10000, help="random bodies of it")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--device", choices=("cpu", "gpu"), default="cpu")
    parser.add_argument("--workers", type=int, default=0, help="0: one per processor")
    parser.add_argument("--build", type=pathlib.Path, default=SOURCE / "build")
    parser.add_argument("--controller", type=pathlib.Path,
                        default=SOURCE / "data/controllers/phototaxis-16ms.safetensors")
    options = parser.parse_args()
    if options.best is not None:
        return racing_best.measure(options, start)
    if options.preset is None:
        options.population = options.population or 512
        options.generations = options.generations or 100
    found = {}
    for racing in ("off", "lossless"):
        with tempfile.TemporaryDirectory(prefix="morphod-racing-") as folder:
            with start(options, folder) as daemon:
                found[racing] = run(daemon, options, racing)
                daemon.stop()
            if racing == "off" and options.mode == "zero-shot":
                designs = read_losses(folder)
    whole, raced = found["off"], found["lossless"]
    cut = check_same_lives(raced[3], whole[3])
    print(f"share     {raced[0] / whole[0]:9.3f} of the rollouts, {raced[1] / whole[1]:.3f} of the"
          f" time, {raced[2] / whole[2]:.3f} of that of cores and devices; {cut} children cut"
          " short; the same histories")
    if options.mode == "zero-shot":
        print_estimates(designs)
    return 0


if __name__ == "__main__":
    sys.exit(main())
