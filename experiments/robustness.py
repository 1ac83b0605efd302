#!/usr/bin/python3
"""Compares controllers on ground that differs from the usual: how well random bodies do, and the
best bodies of a campaign, when one constant of the world changes.

The first controller is the one that the others are compared with. Bodies that no pretraining draws
are scored in the ten worlds of the paper's test set, with each constant changed alone, and with all
of them changed at once. The difference to the first controller is paired by body; its 95 %
confidence interval is over bodies. With --campaigns, each controller also evolves bodies of its
own, and their ten best are scored in the same way. A rollout that diverges counts as 1, which is
standing still; their share is printed.

A row of the CSV file is a controller in one kind of world. The state folder is kept: when called
again, the program continues where it stopped."""
import math
import statistics
import sys
import textwrap
from pathlib import Path

import own_daemon
from own_daemon import Daemon, Deadline
from charts import PALETTE, Chart, Panel, Scale, decades
import records

TEXTS = ("who", "controller", "sha256", "axis")
COLUMNS = TEXTS + ("level", "n", "mean", "difference", "half_width", "diverged_share")
FRICTION = 0.9  # the usual one
FRICTIONS = (0.3, 0.5, 0.7, 0.9, 1.2)
FACTORS = ("stiffness", "mass", "drag", "gravity", "actuation")
BEST = 10
ALL = {"friction": [1 / 3, 4 / 3], "drop_m": [0, 0.2], "slope_degrees": [0, 10],
       **{name: [0.7, 1.3] for name in FACTORS}}
DIVERGED = 1.0


def axes():
    """Yields (axis, level, what varies in the worlds). Friction 0.9 is the usual world."""
    for level in FRICTIONS:
        share = level / FRICTION
        yield "friction", level, {} if level == FRICTION else {"friction": [share, share]}
    for name in FACTORS:
        for level in (0.7, 1.3):
            yield name, level, {name: [level, level]}
    yield "drop", 0.2, {"drop_m": [0.2, 0.2]}
    yield "slope", 10, {"slope_degrees": [10, 10]}
    yield "all", None, ALL


def worlds_of(axis, vary):
    if not vary:
        return "paper-test"
    worlds = {"of": "paper-test", "vary": vary}
    return worlds | {"count": 64, "seed": 99} if axis == "all" else worlds


def physics_of(arguments):
    return {"n_steps": 2 * arguments.rollout_steps}  # the usual step is 2 ms


def scores(daemon, arguments, sha256, which, axis, vary):
    """Returns the mean loss of each design, and the share of rollouts that diverged."""
    body = {
        **which, "controller": "sha256:" + sha256, "environments": worlds_of(axis, vary),
        "device": arguments.device, "priority": "batch", "physics": physics_of(arguments)
    }
    job = daemon.follow(
        "evaluations", daemon.submit("evaluations", body), arguments.deadline,
        lambda job: f"{axis}: {job['rollouts_done']} of {job['rollouts_total']} rollouts")
    if not own_daemon.ended_well("evaluation", job):
        sys.exit(own_daemon.cut_off())
    losses = [result["losses"] for result in daemon.items(f"/v1/evaluations/{job['id']}/results")]
    lost = sum(loss is None for row in losses for loss in row)
    means = [statistics.fmean(DIVERGED if loss is None else loss for loss in row)
             for row in losses]
    return means, lost / sum(map(len, losses))


def paired(values, others):
    """Returns the mean difference, and half of its 95 % confidence interval."""
    changes = [value - other for value, other in zip(values, others)]
    if len(changes) < 2:
        return statistics.fmean(changes), None
    return statistics.fmean(changes), 1.96 * statistics.stdev(changes) / math.sqrt(len(changes))


def best_of(daemon, arguments, sha256):
    """Evolves bodies with a controller, and returns the best."""
    body = {
        "mode": "zero-shot", "controller": "sha256:" + sha256, "device": arguments.device,
        "population": arguments.population, "generations": arguments.generations,
        "seed": arguments.campaign_seed, "exclude_pretraining": False,
        "physics": physics_of(arguments)
    }
    if arguments.vary:
        body["environments"] = {"of": "paper-test", "vary": dict(arguments.vary), "count": 20,
                                "seed": 7}
    if arguments.aggregate != "mean":
        body["aggregate"] = arguments.aggregate
    campaign = daemon.follow(
        "campaigns", daemon.submit("campaigns", body), arguments.deadline,
        lambda job: f"campaign {job['id']}: generation "
                    f"{job['newest']['generation'] if job['newest'] else 0} of "
                    f"{arguments.generations}")
    if not own_daemon.ended_well("campaign", campaign):
        sys.exit(own_daemon.cut_off())
    rows = daemon.call(f"/v1/campaigns/{campaign['id']}/population?limit={BEST}")["items"]
    return {"designs": [{"id": row["robot"]} for row in rows]}


def run(arguments):
    with Daemon.of(arguments) as daemon:
        print(f"on {daemon.machine()}", file=sys.stderr)
        controllers = [(file.stem, daemon.put_controller(f"c{i}", file)["sha256"])
                       for i, file in enumerate(arguments.controllers)]
        bodies = {"random": {"seed": arguments.seed, "count": arguments.bodies}}
        groups = [("bodies", [bodies] * len(controllers))]
        if arguments.campaigns:
            groups.append(("champions",
                           [best_of(daemon, arguments, sha256) for _, sha256 in controllers]))
        rows = []
        for who, designs in groups:
            for axis, level, vary in axes():
                first = None
                for (name, sha256), which in zip(controllers, designs):
                    means, diverged = scores(daemon, arguments, sha256, which, axis, vary)
                    first = first or means
                    # Champions are other bodies, so nothing pairs them.
                    change = paired(means, first) if who == "bodies" else (
                        statistics.fmean(means) - statistics.fmean(first), None)
                    rows.append(dict(zip(COLUMNS, (
                        who, name, sha256, axis, level, len(means), statistics.fmean(means),
                        *change, diverged))))
        records.write(arguments.csv, COLUMNS, rows)


def axis_text(row):
    unit = {"drop": " m", "slope": "°"}.get(row["axis"], "")
    if row["axis"] == "all":
        return "all at once, 64 worlds"
    factor = "× " if row["axis"] in FACTORS else ""
    return f"{row['axis']} {factor}{row['level']:g}{unit}"


def tables(rows):
    """A table each for bodies and champions: a line per world, a column per controller."""
    out = []
    for (who, ), group in records.group(rows, "who").items():
        lines = []
        for same in records.group(group, "axis", "level").values():
            cells = [axis_text(same[0]), f"{same[0]['mean']:.4f}"]
            for row in same[1:]:
                half = f" ± {row['half_width']:.4f}" if row["half_width"] is not None else ""
                share = 100 * row["difference"] / same[0]["mean"]
                cells.append(f"{row['mean']:.4f} ({row['difference']:+.4f}{half}, {share:+.0f} %)")
            worst = max(row["diverged_share"] for row in same)
            cells.append(f"{100 * worst:.2f} %")
            lines.append(cells)
        names = [row["controller"] for row in group if row["axis"] == group[0]["axis"]
                 and row["level"] == group[0]["level"]]
        n = int(group[0]["n"])
        title = (f"**{n} random bodies**: mean score, and in parentheses the difference from "
                 f"{names[0]} with its 95 % interval, paired by body."
                 if who == "bodies" else
                 f"**The {n} best bodies of a campaign with each controller**: mean score, and in "
                 f"parentheses the difference from {names[0]}.")
        title = textwrap.fill(f"{title} A rollout that diverges counts as 1.", 100,
                              break_on_hyphens=False)
        out.append(title + "\n\n" + records.table(["", *names, "most diverged"], lines))
    return "\n\n".join(out)


def draw(rows, path):
    """Draws the mean score against friction: a line per controller, the first one thick."""
    groups = records.group([row for row in rows if row["axis"] == "friction"], "who")
    width, high, left, top, gap = 940, 340, 70, 46, 80
    names = list(records.group(rows, "controller"))
    chart = Chart(width, top + len(groups) * (high + gap) + 20 * len(names))
    for p, ((who, ), group) in enumerate(groups.items()):
        at = top + p * (high + gap)
        panel = Panel(chart, left, at, width - 20, at + high,
                      Scale(min(FRICTIONS), max(FRICTIONS), ticks=FRICTIONS),
                      Scale(*decades([row["mean"] for row in group]), log=True))
        panel.title("mean score of random bodies" if who == "bodies" else
                    f"mean score of the {BEST} best bodies of a campaign")
        panel.axes("coefficient of friction", "distance to the light, end / start", x_grid=True)
        for i, line in enumerate(records.group(group, "controller").values()):
            points = [(row["level"], row["mean"]) for row in line]
            panel.line(points, PALETTE[i % len(PALETTE)],
                       style="stroke-width:2.6" if i == 0 else "")
            panel.dots(points, PALETTE[i % len(PALETTE)])
    for i, (name, ) in enumerate(names):
        chart.legend(left, top + len(groups) * (high + gap) + 20 * i,
                     [(name, PALETTE[i % len(PALETTE)], "")])
    chart.save(path)


def main():
    parser = own_daemon.parser_of("robustness", __doc__)
    parser.add_argument("controllers", nargs="*", type=Path, metavar="FILE",
                        help="safetensors files, the first the one to compare with (default: the "
                        "default controller alone)")
    own_daemon.add_options(
        parser, ("--bodies", int, 512, "random bodies (default 512)"),
        ("--seed", int, 424242, "seed of their stream (default 424242)"),
        ("--campaigns", bool, False, "also evolve bodies with each controller"),
        ("--population", int, 512, "of the campaigns (default 512)"),
        ("--generations", int, 60, "of the campaigns (default 60)"),
        ("--campaign-seed", int, 1, "of the campaigns (default 1)"),
        ("--aggregate", ("mean", "quantile", "cvar", "mean-sd"), "mean",
         "how a campaign's losses become scores (default mean)"), own_daemon.ROLLOUT_STEPS,
        own_daemon.LIMIT,
        ("--csv", Path, Path("robustness.csv"), None),
        ("--svg", Path, Path("robustness.svg"), None),
        ("--markdown", Path, None,
         "page that gets the tables, between the markers robustness: begin and end"),
        ("--report", bool, False,
         "run nothing: only make the tables and the drawing from the CSV file"))
    own_daemon.add_vary(parser, "range of what varies in the worlds of the campaigns, 20 worlds; "
                        "can be repeated (default: the paper's test set)")
    arguments = parser.parse_args()
    arguments.controllers = arguments.controllers or [own_daemon.SHIPPED]
    arguments.deadline = Deadline(arguments.limit_s)
    if len({file.stem for file in arguments.controllers}) < len(arguments.controllers):
        parser.error("two controllers have the same name")
    if not arguments.campaigns and (arguments.vary or arguments.aggregate != "mean"):
        parser.error("--vary and --aggregate are for campaigns; add --campaigns")
    if not arguments.report:
        run(arguments)
    own_daemon.report(arguments, "robustness", TEXTS, draw, tables)
    return 0


if __name__ == "__main__":
    sys.exit(main())
