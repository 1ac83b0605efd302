#!/usr/bin/python3
"""Runs campaigns of all three modes through the daemon, and reports and draws how they evolve.

Zero-shot with three seeds, one few-shot and one simultaneous campaign of the same size. The state
folder is kept: when called again, the program continues where it stopped. The wall time of a
campaign is the sum of the seconds of its generations; the campaigns run one after the other."""
import argparse
import math
import re
import sys
from pathlib import Path

from own_daemon import Daemon, Deadline, add_options, cut_off, ended_well
from charts import COLORS, Chart, Panel, Scale
import records

MODES = ("zero-shot", "few-shot", "simultaneous")
COLUMNS = ("mode", "seed", "generation", "mean", "best", "median", "diversity", "turnover",
           "mutants_born", "mutants_survived", "recombinants_born", "recombinants_survived",
           "voxels", "footprint", "first_loss", "last_loss", "seconds")


def rows_of(daemon, campaign):
    """Yields a flat row per generation. Quantiles of the score are p0 (the best) to p100; sizes are
    means."""
    for row in daemon.items(f"/v1/campaigns/{campaign['id']}/generations"):
        operators, learning, score = row["operators"], row.get("learning") or {}, row["score"]
        yield {
            "mode": campaign["mode"], "seed": campaign["settings"]["seed"],
            "generation": row["generation"], "mean": score["mean"],
            "best": score["quantiles"]["p0"], "median": score["quantiles"]["p50"],
            **score["quantiles"], "diverged": score["diverged"], "diversity": row["diversity"],
            "species": row["species"], "turnover": row["turnover"],
            "mutants_born": operators["mutation"]["born"],
            "mutants_survived": operators["mutation"]["survived"],
            "recombinants_born": operators["crossover"]["born"],
            "recombinants_survived": operators["crossover"]["survived"],
            "fallbacks": operators["fallbacks"], **{
                name: row[name]["mean"]
                for name in ("voxels", "footprint", "masses", "springs")
            }, "parents_mean": row["parents_mean"], "children_mean": row["children_mean"],
            "children_cut": row["children_cut"],
            "steps": learning.get("steps"), "first_loss": learning.get("first_loss"),
            "last_loss": learning.get("last_loss"), "rollouts": row["rollouts"],
            "cached": row["cached"], "seconds": row["seconds"]
        }


def survival(row, operator):
    """Returns the share of the children of an operator, "mutants" or "recombinants", that
    survive."""
    born = row[f"{operator}_born"]
    return row[f"{operator}_survived"] / born if born else None


def progress_of(campaign):
    newest, progress = campaign["newest"], campaign["progress"]
    line = f"{campaign['mode']} seed {campaign['settings']['seed']}: "
    if newest:
        line += (f"generation {newest['generation']} of {progress['generations']}, mean "
                 f"{newest['score']['mean']}, ")
    line += f"{campaign['phase']} {progress['done']} of {progress['total']}"
    if progress["seconds_left"] is not None:
        line += f", {progress['seconds_left']:.0f} s left"
    return line


def run(arguments):
    deadline, rows = Deadline(), []
    with Daemon(arguments.build / "src/daemon/morphod", arguments.state,
                "--max-campaigns=1") as daemon:
        wanted = [("zero-shot", seed)
                  for seed in range(1, arguments.seeds + 1)] + [("few-shot", 1),
                                                                ("simultaneous", 1)]
        wanted = [(mode, seed) for mode, seed in wanted if mode in arguments.modes]
        for mode, seed in wanted:
            body = {
                "mode": mode, "preset": "demo", "population": arguments.population,
                "generations": arguments.generations, "seed": seed
            }
            key = re.sub(r"\W+", "-",
                         f"bench-{mode}-{arguments.population}-{arguments.generations}-{seed}")
            campaign = daemon.follow("campaigns", daemon.submit("campaigns", body, key), deadline,
                                     progress_of)
            if not ended_well("campaign", campaign):
                sys.exit(cut_off())
            rows += rows_of(daemon, campaign)
    records.write(arguments.csv, COLUMNS, rows)


def curves(rows):
    """Returns the rows of each campaign, in the order of the modes."""
    return dict(
        sorted(records.group(rows, "mode", "seed").items(),
               key=lambda item: (MODES.index(item[0][0]), item[0][1])))


def table(rows, population):
    """The table of docs/evolution.md."""
    lines = []
    for (mode, seed), group in curves(rows).items():
        first, last = group[0], group[-1]
        lines.append([
            f"{mode}, {int(seed)}", f"{first['mean']:.4f}", f"{last['mean']:.4f}",
            f"{100 * (1 - last['mean'] / first['mean']):.0f} %", f"{first['best']:.4f}",
            f"{last['best']:.4f}", f"{first['diversity']:.4f}",
            f"{max(r['diversity'] for r in group):.4f}", f"{last['diversity']:.4f}",
            f"{sum(r['seconds'] for r in group):.0f} s"
        ])
    heads = ("mode, seed", "mean at 0", "at the end", "better by", "best at 0", "at the end",
             "diversity at 0", "most", "at the end", "wall time")
    newest = int(max(row["generation"] for row in rows))
    return (records.table(heads, lines) +
            f"\n\nPopulation {population}, generations 0 to {newest}.")


def draw(rows, path):
    """Draws three panels against generations: mean and best score, diversity, share of children
    that survive."""
    panels = [("score: mean (line) and best (dashes)", [("mean", ""), ("best", "5 4")]),
              ("diversity", [("diversity", "")]),
              ("share of the children that survive: recombinants (line), mutants (dashes)",
               [("recombinants", ""), ("mutants", "5 4")])]
    width, height, left, right, top, bottom = 940, 300, 70, 170, 40, 40
    last = max(row["generation"] for row in rows) or 1
    chart = Chart(width, height * len(panels))

    def value(row, key):
        return survival(row, key) if key in ("recombinants", "mutants") else row[key]

    for p, (title, keys) in enumerate(panels):
        known = [v for row in rows for key, _ in keys if (v := value(row, key)) is not None]
        high = max(known) * 1.05 or 1
        scale = Scale(0, high, ticks=[high * i / 4 for i in range(5)])
        if p == 0 and min(known) > 0:  # scores fall by orders of magnitude
            scale = Scale(10**math.floor(math.log10(min(known))),
                          10**math.ceil(math.log10(max(known))),
                          log=True)
        generations = Scale(0, last, ticks=range(0, int(last) + 1, max(1, round(last / 6))))
        panel = Panel(chart, left, p * height + top, width - right, (p + 1) * height - bottom,
                      generations, scale)
        panel.title(title)
        panel.axes()
        for i, ((mode, seed), group) in enumerate(curves(rows).items()):
            for key, dash in keys:
                panel.line([(row["generation"], value(row, key)) for row in group], COLORS[mode],
                           dash)
            if p == 0:
                chart.text(width - right + 14,
                           top + 18 * i + 12,
                           f"{mode}, seed {int(seed)}",
                           fill=COLORS[mode])
    chart.text(left, height * len(panels) - 4, "generation")
    chart.save(path)


def main():
    parser = argparse.ArgumentParser(prog="tools/bench campaigns", description=__doc__)
    add_options(parser, ("--population", int, 64, None), ("--generations", int, 30, None),
                ("--seeds", int, 3, "zero-shot campaigns (default 3)"))
    parser.add_argument("--modes", nargs="+", choices=MODES, default=MODES)
    add_options(parser, ("--build", Path, Path("build"), None),
                ("--state", Path, Path(".morphod/bench-campaigns"), "kept between calls"),
                ("--csv", Path, Path("campaigns.csv"), None),
                ("--svg", Path, Path("campaigns.svg"), None),
                ("--report", bool, False,
                 "run nothing: only make the table and the drawing from the CSV file"))
    arguments = parser.parse_args()
    if not arguments.report:
        run(arguments)
    rows = records.read(arguments.csv, ("mode", ))
    draw(rows, arguments.svg)
    print(table(rows, arguments.population))
    zero = [group for (mode, _), group in curves(rows).items() if mode == "zero-shot"]
    return 0 if all(group[-1]["mean"] <= 0.75 * group[0]["mean"] for group in zero) else 1


if __name__ == "__main__":
    sys.exit(main())
