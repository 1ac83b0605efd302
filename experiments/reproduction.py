"""The paper's three experiments through the daemon: zero-shot, few-shot and simultaneous evolution
of 8192 designs, three trials each.

Campaigns run one after the other, by mode and seed. The state folder is kept: when called again,
the program continues where it stopped. In the folder of results, generations.csv has a row per
generation, and campaigns.json the rest: settings, learning curves, the distributions of the first
and the last population, champions with their voxels. A campaign that is complete there, with the
same settings, is not rerun, even without its state. The figures and tables are made only from these
two files and the CSV file of `tools/bench pretraining`."""
import bisect
import hashlib
import json
import sys
from pathlib import Path

import own_daemon
from own_daemon import Daemon, Deadline, ended_well
from campaigns import MODES, progress_of, rows_of
import records
import reproduction_report

COLUMNS = ("mode", "seed", "generation", "mean", "best", "p5", "p25", "median", "p75", "p95",
           "p100", "diverged", "diversity", "species", "turnover", "mutants_born",
           "mutants_survived", "recombinants_born", "recombinants_survived", "fallbacks", "voxels",
           "footprint", "masses", "springs", "parents_mean", "children_mean", "children_cut",
           "steps", "first_loss", "last_loss", "rollouts", "cached", "seconds")
PAPER_SHOWS = {"zero-shot": 31,
               "few-shot": 6}  # the generations of the paper's figure of distinctive bodies
EDGES = {
    "score": [10**(-3 + i / 20) for i in range(81)], "footprint": [i - 0.5 for i in range(1, 38)],
    "masses": [5.0 * i for i in range(51)], "distinctiveness": [i / 100 for i in range(81)]
}


def histogram(values, edges):
    """Returns the shares of the values in the bins. Values outside count to the nearest bin."""
    counts = [0] * (len(edges) - 1)
    for value in values:
        counts[min(max(bisect.bisect_right(edges, value) - 1, 0), len(counts) - 1)] += 1
    return [round(count / len(values), 6) for count in counts] if values else counts


def distinctiveness(genotypes):
    """Returns the mean Hamming distance of each to all others, over the voxels, from the sums of
    the columns.
    """
    n, voxels = len(genotypes), len(genotypes[0])
    sums = [sum(column) for column in zip(*(map(int, genotype) for genotype in genotypes))]
    if n < 2:
        return [0.0] * n
    return [
        sum(n - c if digit == "1" else c for digit, c in zip(genotype, sums)) / ((n - 1) * voxels)
        for genotype in genotypes
    ]


def population(daemon, campaign, generation):
    """Returns the distributions of a population, to compare the first with the last."""
    designs = list(
        daemon.items(f"/v1/campaigns/{campaign['id']}/population?generation={generation}"))
    values = {
        "score": [d["score"] for d in designs if d["score"] is not None],
        "footprint": [d["footprint"] for d in designs], "masses": [d["masses"] for d in designs],
        "distinctiveness": distinctiveness([d["genotype"] for d in designs])
    }
    return {
        "generation": generation, "size": len(designs),
        "mean_distinctiveness": records.mean(values["distinctiveness"]),
        **{name: histogram(values[name], edges)
           for name, edges in EDGES.items()}
    }


def champions(daemon, campaign, generation, count):
    page = daemon.call(
        f"/v1/campaigns/{campaign['id']}/champions?generation={generation}&count={count}")
    keys = ("id", "genotype", "score", "distinctiveness", "voxels", "footprint", "masses",
            "springs", "born", "operator")
    return {
        "generation": generation, "designs": [{key: design[key]
                                               for key in keys} for design in page["items"]]
    }


def request_of(arguments, mode, seed, controller):
    body = {
        "mode": mode, "preset": "paper", "population": arguments.population,
        "generations": arguments.generations[mode], "seed": seed, "device": arguments.device,
        "physics": {"n_steps": arguments.rollout_steps}
    }
    if controller:
        body["controller"] = "sha256:" + controller
    if mode != "zero-shot":
        body["name"] = f"reproduction-{mode}-{seed}"
        learning = {
            "adjoint_bound": arguments.bound, "adjoint_rule": arguments.rule,
            "restart_weight": arguments.restart_weight
        }
        if mode == "few-shot" and arguments.few_shot_steps:
            learning.update(parent_steps=arguments.few_shot_steps // 2,
                            child_steps=arguments.few_shot_steps - arguments.few_shot_steps // 2)
        body["learning"] = learning
    return body


def result_of(daemon, campaign, request, count):
    """Returns the entry of a campaign in campaigns.json."""
    last = campaign["newest"]["generation"]
    learning = {}
    if campaign["mode"] != "zero-shot":
        for row in daemon.items(f"/v1/campaigns/{campaign['id']}/learning"):
            learning.setdefault(
                row["generation"],
                []).append(None if row["mean_loss"] is None else float(f"{row['mean_loss']:.6g}"))
    shown = sorted({0, min(PAPER_SHOWS.get(campaign["mode"], last), last), last})
    return {
        "mode": campaign["mode"], "seed": campaign["settings"]["seed"], "request": request,
        "device": campaign["device"], "machine": daemon.machine(),
        "elapsed_s": daemon.elapsed_s(campaign), "end": campaign["end"], "settings": {
            key: campaign["settings"][key]
            for key in ("population", "generations", "learning")
        }, "controller": (campaign["controller"] or {}).get("sha256"),
        "learning": list(learning.values()), "populations": [
            population(daemon, campaign, generation) for generation in sorted({0, last})
        ], "champions": [champions(daemon, campaign, generation, count) for generation in shown]
    }


def keep(arguments, done, rows, campaign, new_rows, result):
    """Replaces the rows and the result of this campaign in the files."""
    key = (campaign["mode"], campaign["settings"]["seed"])
    rows[:] = [row for row in rows if (row["mode"], row["seed"]) != key] + new_rows
    done[:] = [entry for entry in done if (entry["mode"], entry["seed"]) != key
               ] + ([result] if result else [])
    records.write(arguments.folder / "generations.csv", COLUMNS, rows)
    lines = ",\n".join(json.dumps(entry, separators=(",", ":"))
                       for entry in done)  # a line per campaign
    records.replace(arguments.folder / "campaigns.json",
                    f'{{"edges":{json.dumps(EDGES)},"campaigns":[\n{lines}\n]}}\n')


def run(arguments):
    """Returns whether all campaigns have ended."""
    deadline = Deadline(arguments.limit_s)
    done, rows = reproduction_report.read(arguments.folder)
    controllers = [hashlib.sha256(file.read_bytes()).hexdigest() for file in arguments.controller]
    wanted = []
    for mode in arguments.modes:
        for i, seed in enumerate(arguments.seeds):
            controller = None if mode == "simultaneous" else controllers[i % len(controllers)]
            request = request_of(arguments, mode, seed, controller)
            if not any(entry["request"] == request for entry in done):
                wanted.append(request)
    if not wanted:
        return True
    with Daemon.of(arguments, "--max-campaigns=1") as daemon:
        print(f"on {daemon.machine()}", file=sys.stderr)
        for sha256, file in zip(controllers, arguments.controller):
            daemon.put_controller(f"reproduction-{sha256[:12]}", file)
        for request in wanted:
            campaign = daemon.follow("campaigns", daemon.submit("campaigns", request), deadline,
                                     progress_of)
            whole = ended_well("campaign", campaign)
            if campaign["newest"] is not None:
                keep(arguments, done, rows, campaign, list(rows_of(daemon, campaign)),
                     result_of(daemon, campaign, request, arguments.champions) if whole else None)
            if not whole:
                return False
    return True


def options():
    parser = own_daemon.parser_of("reproduction", __doc__)
    parser.add_argument("--modes", nargs="+", choices=MODES, default=MODES)
    own_daemon.add_options(
        parser, own_daemon.SEEDS, ("--population", int, 8192, None),
        *((f"--generations-{mode}", int, usual, f"default {usual}, as in the paper")
          for mode, usual in (("zero-shot", 100), ("few-shot", 7), ("simultaneous", 180))))
    parser.add_argument("--controller", type=Path, nargs="+", default=[own_daemon.OF_PAPER],
                        help="safetensors, pretrained: one for all trials, or one for each seed "
                        "(default: the project's)")
    own_daemon.add_options(
        parser,
        ("--bound", float, 2.0, "bound of each robot's adjoint where the controller learns; 0: not "
         "clipped, as in the paper (default 2)"), *own_daemon.ABOVE_BOUND,
        ("--few-shot-steps", int, 60, "learning steps in each generation (default 60)"),
        ("--champions", int, 20, "champions to draw of each population (default 20)"),
        own_daemon.ROLLOUT_STEPS, own_daemon.LIMIT,
        ("--folder", Path, Path("reproduction"),
         "folder of CSV, JSON and figures (default reproduction)"),
        ("--pretraining", Path, None,
         "CSV file of `tools/bench pretraining`, for the first figure and the table"),
        ("--markdown", Path, None,
         "page that gets the tables, between the markers reproduction: begin and end"),
        ("--report", bool, False,
         "run nothing: only make the figures and tables from the folder"))
    return parser


def main():
    arguments = options().parse_args()
    arguments.generations = {
        mode: getattr(arguments, "generations_" + mode.replace("-", "_"))
        for mode in MODES
    }
    if len(arguments.controller) not in (1, len(arguments.seeds)):
        sys.exit("--controller must be one file, or one for each seed")
    if not arguments.report and not run(arguments):
        return own_daemon.cut_off()
    text = reproduction_report.report(arguments.folder, arguments.pretraining)
    print(text)
    if arguments.markdown:
        records.put_between(arguments.markdown, "reproduction", text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
