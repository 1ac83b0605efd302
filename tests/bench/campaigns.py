#!/usr/bin/python3
"""Runs campaigns of all three modes through the daemon, and tells and draws how they evolve.

Zero-shot with three seeds, one few-shot and one simultaneous campaign of the same size. The state folder is kept: called again, it goes
on where it was. Wall time per campaign is the sum of its generations' seconds; the campaigns run one after the other."""
import argparse
import csv
import json
import math
import re
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

MODES = ("zero-shot", "few-shot", "simultaneous")
COLUMNS = ("mode", "seed", "generation", "mean", "best", "median", "diversity", "turnover", "mutants_born", "mutants_survived",
           "recombinants_born", "recombinants_survived", "voxels", "footprint", "first_loss", "last_loss", "seconds")
COLOURS = {"zero-shot": "#1b6ca8", "few-shot": "#c0392b", "simultaneous": "#1e8449"}


def number(value):
    return "" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)


class Service:
    """A daemon of our own, whose state lasts from one call to the next."""

    def __init__(self, build, state):
        state.mkdir(parents=True, exist_ok=True)
        (state / "address").unlink(missing_ok=True)
        source = Path(__file__).resolve().parents[2]
        self.log = open(state / "log", "a", encoding="utf-8")
        self.process = subprocess.Popen(
            [build / "src/daemon/morphod", f"--state-dir={state / 'state'}", "--listen=127.0.0.1:0", f"--port-file={state / 'address'}",
             f"--default-controller={source / 'data/controllers/bootstrap.safetensors'}", "--max-campaigns=1"],
            stdout=subprocess.DEVNULL, stderr=self.log)
        for _ in range(600):
            if (state / "address").exists() and (state / "address").read_text().strip():
                break
            if self.process.poll() is not None:
                sys.exit(f"morphod did not start: see {state / 'log'}")
            time.sleep(0.1)
        self.address = (state / "address").read_text().split()[0]

    def call(self, path, body=None, headers=None):
        request = urllib.request.Request(self.address + path, None if body is None else json.dumps(body).encode(),
                                         {"Content-Type": "application/json", **(headers or {})})
        with urllib.request.urlopen(request, timeout=120) as reply:
            return json.load(reply)

    def stop(self):
        self.process.terminate()
        self.process.wait(60)


def rows_of(service, campaign, seed):
    after = -1
    while True:
        page = service.call(f"/v1/campaigns/{campaign['id']}/generations?limit=1000" + (f"&after={after}" if after >= 0 else ""))
        for row in page["items"]:
            operators, learning = row["operators"], row.get("learning") or {}
            yield {"mode": campaign["mode"], "seed": seed, "generation": row["generation"], "mean": row["score"]["mean"],
                   "best": row["score"]["quantiles"]["p0"], "median": row["score"]["quantiles"]["p50"], "diversity": row["diversity"],
                   "turnover": row["turnover"], "mutants_born": operators["mutation"]["born"],
                   "mutants_survived": operators["mutation"]["survived"], "recombinants_born": operators["crossover"]["born"],
                   "recombinants_survived": operators["crossover"]["survived"], "voxels": row["voxels"]["mean"],
                   "footprint": row["footprint"]["mean"], "first_loss": learning.get("first_loss"),
                   "last_loss": learning.get("last_loss"), "seconds": row["seconds"]}
            after = row["generation"]
        if not page["more"]:
            return


def run(arguments):
    service = Service(arguments.build, arguments.state)
    rows = []
    try:
        wanted = [("zero-shot", seed) for seed in range(1, arguments.seeds + 1)] + [("few-shot", 1), ("simultaneous", 1)]
        wanted = [(mode, seed) for mode, seed in wanted if mode in arguments.modes]
        campaigns = []
        for mode, seed in wanted:
            body = {"mode": mode, "preset": "demo", "population": arguments.population, "generations": arguments.generations, "seed": seed}
            key = re.sub(r"\W+", "-", f"bench-{mode}-{arguments.population}-{arguments.generations}-{seed}")
            campaigns.append((service.call("/v1/campaigns", body, {"Idempotency-Key": key}), seed))
        for campaign, seed in campaigns:
            while True:
                campaign = service.call(f"/v1/campaigns/{campaign['id']}", headers={"Prefer": "wait=20"})
                if campaign["state"] in ("succeeded", "failed", "cancelled"):
                    break
                newest = campaign["newest"]
                if newest is not None:
                    print(f"{campaign['mode']} seed {seed}: generation {newest['generation']} of {arguments.generations}, "
                          f"mean {newest['score']['mean']:.4f}", file=sys.stderr, flush=True)
            if campaign["state"] != "succeeded":
                sys.exit(f"campaign {campaign['id']} {campaign['state']}: {campaign['error']}")
            rows += rows_of(service, campaign, seed)
    finally:
        service.stop()
    with open(arguments.csv, "w", encoding="utf-8", newline="") as out:
        writer = csv.DictWriter(out, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows({key: number(value) for key, value in row.items()} for row in rows)


def read(path):
    with open(path, encoding="utf-8", newline="") as file:
        return [{key: value if key == "mode" else None if value == "" else float(value) for key, value in row.items()}
                for row in csv.DictReader(file)]


def curves(rows):
    groups = {}
    for row in rows:
        groups.setdefault((row["mode"], int(row["seed"])), []).append(row)
    return groups


def table(rows, population):
    """The table of docs/evolution.md."""
    lines = [f"| mode, seed | mean at 0 | at the end | better by | best at 0 | at the end | diversity at 0 | most | at the end | wall time |",
             "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |"]
    for (mode, seed), group in sorted(curves(rows).items(), key=lambda item: (MODES.index(item[0][0]), item[0][1])):
        first, last = group[0], group[-1]
        lines.append(f"| {mode}, {seed} | {first['mean']:.4f} | {last['mean']:.4f} | {100 * (1 - last['mean'] / first['mean']):.0f} % | "
                     f"{first['best']:.4f} | {last['best']:.4f} | {first['diversity']:.4f} | {max(r['diversity'] for r in group):.4f} | "
                     f"{last['diversity']:.4f} | {sum(r['seconds'] for r in group):.0f} s |")
    lines.append(f"\nPopulation {population}, generations 0 to {int(max(row['generation'] for row in rows))}.")
    return "\n".join(lines)


def draw(rows, path):
    """Three panels against generations: mean and best score, diversity, share of children that survive."""
    panels = [("score: mean (line) and best (dashes)", [("mean", ""), ("best", "5 4")]), ("diversity", [("diversity", "")]),
              ("share of the children that live on: recombinants (line), mutants (dashes)", [("recombinants", ""), ("mutants", "5 4")])]
    width, height, left, right, top, bottom = 940, 300, 70, 170, 40, 40
    last = max(row["generation"] for row in rows) or 1
    out = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height * len(panels)}" font-family="sans-serif" font-size="12">',
           "<style>.grid{stroke:#ddd}polyline{fill:none;stroke-width:1.6}</style>", '<rect width="100%" height="100%" fill="#fff"/>']

    def value(row, key):
        if key in ("recombinants", "mutants"):
            return row[f"{key}_survived"] / row[f"{key}_born"] if row[f"{key}_born"] else None
        return row[key]

    for p, (title, keys) in enumerate(panels):
        known = [v for row in rows for key, _ in keys if (v := value(row, key)) is not None]
        high, low = max(known) * 1.05 or 1, None
        base = p * height
        if p == 0 and min(known) > 0:  # scores fall by orders of magnitude
            high, low = 10 ** math.ceil(math.log10(max(known))), 10 ** math.floor(math.log10(min(known)))

        def x(generation):
            return left + generation / last * (width - left - right)

        def y(v):
            share = v / high if low is None else math.log(v / low) / math.log(high / low)
            return base + height - bottom - share * (height - top - bottom)

        out.append(f'<text x="{left}" y="{base + 24}" font-size="15">{title}</text>')
        steps = [high * i / 4 for i in range(5)]
        if low is not None:
            steps = [d * 10 ** k for k in range(round(math.log10(low)), round(math.log10(high)) + 1) for d in (1, 2, 5) if d * 10 ** k <= high]
        for v in steps:
            out.append(f'<line class="grid" x1="{left}" y1="{y(v):.1f}" x2="{width - right}" y2="{y(v):.1f}"/>'
                       f'<text x="{left - 8}" y="{y(v) + 4:.1f}" text-anchor="end">{v:.3g}</text>')
        every = max(1, round(last / 6))
        for g in range(0, int(last) + 1, every):
            out.append(f'<text x="{x(g):.1f}" y="{base + height - bottom + 18}" text-anchor="middle">{g}</text>')
        for i, ((mode, seed), group) in enumerate(sorted(curves(rows).items(), key=lambda item: (MODES.index(item[0][0]), item[0][1]))):
            for key, dash in keys:
                points = " ".join(f"{x(row['generation']):.1f},{y(v):.1f}" for row in group if (v := value(row, key)) is not None)
                out.append(f'<polyline stroke="{COLOURS[mode]}" stroke-dasharray="{dash}" points="{points}"/>')
            if p == 0:
                out.append(f'<text x="{width - right + 14}" y="{base + top + 18 * i + 12}" fill="{COLOURS[mode]}">{mode}, seed {seed}</text>')
    out.append(f'<text x="{left}" y="{height * len(panels) - 4}">generation</text></svg>')
    Path(path).write_text("\n".join(out) + "\n", encoding="utf-8")


def main():
    parser = argparse.ArgumentParser(prog="tools/bench campaigns", description=__doc__)
    parser.add_argument("--population", type=int, default=64)
    parser.add_argument("--generations", type=int, default=30)
    parser.add_argument("--seeds", type=int, default=3, help="zero-shot campaigns (default 3)")
    parser.add_argument("--modes", nargs="+", choices=MODES, default=MODES)
    parser.add_argument("--build", type=Path, default=Path("build"))
    parser.add_argument("--state", type=Path, default=Path(".morphod/bench-campaigns"), help="kept between calls")
    parser.add_argument("--csv", type=Path, default=Path("campaigns.csv"))
    parser.add_argument("--svg", type=Path, default=Path("campaigns.svg"))
    parser.add_argument("--report", action="store_true", help="run nothing: only the table and the drawing of what the CSV file holds")
    arguments = parser.parse_args()
    if not arguments.report:
        run(arguments)
    rows = read(arguments.csv)
    draw(rows, arguments.svg)
    print(table(rows, arguments.population))
    zero = [group for (mode, _), group in curves(rows).items() if mode == "zero-shot"]
    return 0 if all(group[-1]["mean"] <= 0.75 * group[0]["mean"] for group in zero) else 1


if __name__ == "__main__":
    sys.exit(main())
