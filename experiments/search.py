"""Search methods on an atlas, whose optimum is known: exact regret against the number of
evaluations. docs/search.md says what is compared."""
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # several runs at a time; and sums in one order
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import importlib.metadata
import importlib.util
import math
import multiprocessing
import sys
import time
import warnings
from pathlib import Path

import client_code

if __name__ == "__main__":
    client_code.prepare()
else:  # a process of the pool
    sys.path.insert(0, str(client_code.CLIENT))

import charts
import records
import numpy as np

from search_evolution import paper_ga

CHECKPOINTS = [n * 10**k for k in range(7) for n in (1, 2, 5)]
SHOWN = (100, 300, 1000, 3000, 10000, 30000, 100000)


def hill_climbing(*steps):
    """Looks at the neighbors of a body in random order and goes to the first better one; starts
    again from a random body if all are worse."""
    def search(problem, seed, budget):
        rng = np.random.default_rng(seed)
        atlas = problem.atlas
        while problem.evaluations < budget:
            here = atlas.find(problem.random(rng))
            loss = problem.evaluate(atlas.genotype(here))
            while here is not None:
                neighbors = [neighbor.position for neighbor in atlas.neighbors(here, steps)]
                here = None
                for place in rng.permutation(len(neighbors)):
                    if problem.evaluations >= budget:
                        return
                    found = problem.evaluate(atlas.genotype(neighbors[place]))
                    if found < loss:
                        here, loss = neighbors[place], found
                        break
    return search


def random_search(problem, seed, budget):
    rng = np.random.default_rng(seed)
    while problem.evaluations < budget:
        problem.evaluate(problem.random(rng))


# ---- by the packages: vectors of numbers, from which problem.decode grows bodies ----


def finite_loss(problem, body):
    """Evaluates a body. The packages refuse the infinite loss of one that diverged: they get the
    worst finite loss of the atlas instead."""
    loss = problem.evaluate(body)
    if math.isfinite(loss):
        return loss
    scores = problem.atlas.scores()
    return float(scores[np.isfinite(scores)].max())


def with_ribs(problem, seed, budget, emitters_of):
    from ribs.archives import GridArchive
    from ribs.schedulers import Scheduler
    most = problem.atlas.voxels_max
    archive = GridArchive(solution_dim=problem.dimensions, dims=[most, most],
                          ranges=[(0.5, most + 0.5)] * 2, seed=seed)
    scheduler = Scheduler(archive, emitters_of(archive))
    while problem.evaluations < budget:
        bodies = [problem.decode(values) for values in scheduler.ask()]
        bodies_left = bodies[:budget - problem.evaluations]
        losses = [finite_loss(problem, body) for body in bodies_left]
        if len(losses) < len(bodies):
            return
        measures = [problem.measures(body)[:2] for body in bodies]
        scheduler.tell(-np.array(losses), np.array(measures, dtype=float))


def map_elites(problem, seed, budget):
    from ribs.emitters import GaussianEmitter
    initial = np.random.default_rng(seed).normal(size=(32, problem.dimensions))
    with_ribs(problem, seed, budget, lambda archive: [
        GaussianEmitter(archive, sigma=0.5, initial_solutions=initial, batch_size=32, seed=seed)])


def cma_me(problem, seed, budget):
    from ribs.emitters import EvolutionStrategyEmitter
    with_ribs(problem, seed, budget, lambda archive: [
        EvolutionStrategyEmitter(archive, x0=np.zeros(problem.dimensions), sigma0=1.0,
                                 ranker="2imp", batch_size=16, seed=2 * seed + k)
        for k in range(2)])


def by_nevergrad(problem, seed, budget):
    import nevergrad
    parameters = nevergrad.p.Array(shape=(problem.dimensions, ))
    parameters.random_state.seed(seed)
    np.random.seed(seed)  # what some of its optimizers draw from
    optimizer = nevergrad.optimizers.NGOpt(parametrization=parameters, budget=budget)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for _ in range(budget):
            candidate = optimizer.ask()
            optimizer.tell(candidate, finite_loss(problem, problem.decode(candidate.value)))


def by_optuna(problem, seed, budget):
    import optuna
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=seed))
    names = [f"v{voxel}" for voxel in range(problem.dimensions)]
    study.optimize(lambda trial: finite_loss(problem, problem.decode(
        [trial.suggest_float(name, -2, 2) for name in names])), n_trials=budget)


# The name, the packages that are needed, the method.
METHODS = {
    "random": ("random search", (), random_search),
    "ga": ("the paper's GA", (), paper_ga),
    "climbing": ("hill climbing with restarts: add, remove", (), hill_climbing("add", "remove")),
    "climbing-moves": ("hill climbing with restarts: add, remove, move", (),
                       hill_climbing("add", "remove", "move")),
    "map-elites": ("MAP-Elites", ("ribs", ), map_elites),
    "cma-me": ("CMA-ME", ("ribs", ), cma_me),
    "nevergrad": ("NGOpt", ("nevergrad", ), by_nevergrad),
    "tpe": ("TPE", ("optuna", ), by_optuna),
}


def missing(method):
    return [name for name in METHODS[method][1] if importlib.util.find_spec(name) is None]


def title(method):
    name, packages, _ = METHODS[method]
    versions = [f"{package} {importlib.metadata.version(package)}" for package in packages
                if not missing(method)]
    return name + (f" ({', '.join(versions)})" if versions else "")


def run(task):
    """Returns the method, the seed, the regrets after 1, 2, … evaluations where it improves, and
    the number of different bodies."""
    from morphod.atlas import Atlas, Problem
    path, method, seed, budget = task
    problem = Problem(Atlas.open(path), budget=budget)
    began = time.monotonic()
    METHODS[method][2](problem, seed, budget)
    return {"method": method, "seed": seed, "budget": budget, "evaluations": problem.evaluations,
            "distinct": problem.distinct, "seconds": time.monotonic() - began,
            "improvements": [(n, loss - problem.optimum_loss) for n, loss in problem.improvements]}


def limits_of(text):
    """Reads METHOD=N,…"""
    return {method: int(n) for method, n in (part.split("=") for part in text.split(","))}


def regret_at(row, evaluations):
    """Returns the regret after so many evaluations; infinite before the first. A run that was
    limited has none after its end."""
    if evaluations > row["budget"]:
        return float("nan")
    return min((regret for n, regret in row["improvements"] if n <= evaluations),
               default=float("inf"))


def quartiles(values):
    return [float(value) for value in np.quantile(values, (0.25, 0.5, 0.75))]


def table(rows, methods, budget, seeds):
    """Returns lines of Markdown: the median regret with quartiles, and the seeds that found the
    optimum."""
    shown = [n for n in SHOWN if n < budget] + [budget]
    lines = ["| method | " + " | ".join(f"after {n:,}" for n in shown) +
             f" | optimum found, of {seeds} | distinct bodies |",
             "| --- |" + " --- |" * (len(shown) + 2)]
    for method in methods:
        if missing(method):
            lines.append(f"| {title(method)} | " + " | ".join(
                ["not run: no package " + ", ".join(missing(method))] + [""] * (len(shown) + 1)) +
                " |")
            continue
        own = [row for row in rows if row["method"] == method]
        cells = []
        for n in shown:
            low, middle, high = quartiles([regret_at(row, n) for row in own])
            cells.append("–" if math.isnan(middle) else f"{middle:.4f} ({low:.4f} … {high:.4f})")
        found = sum(regret_at(row, row["budget"]) == 0 for row in own)
        distinct = round(float(np.median([row["distinct"] for row in own])))
        lines.append(f"| {title(method)} | " + " | ".join(cells) + f" | {found} | {distinct} |")
    return lines


def figure(path, rows, methods, budget, caption):
    """Draws the mean regret over the seeds against the evaluations."""
    ran = [method for method in methods if not missing(method)]
    at = sorted({n for n in CHECKPOINTS if 10 <= n <= budget} | {row["budget"] for row in rows} |
                {round(10 * 1.15**k) for k in range(100) if 10 * 1.15**k < budget})
    curves = {method: [(n, float(np.mean([regret_at(row, n) for row in rows
                                          if row["method"] == method]))) for n in at]
              for method in ran}
    drawn = [regret for curve in curves.values() for _, regret in curve if regret > 0]
    chart = charts.Chart(920, 470)
    panel = charts.Panel(chart, 70, 60, 560, 400, charts.Scale(10, budget, log=True),
                         charts.Scale(*charts.decades(drawn), log=True))
    panel.title(caption)
    panel.axes("evaluations", "mean regret (loss above the optimum)")
    for i, method in enumerate(ran):
        color = charts.PALETTE[i]
        panel.line([(n, regret) for n, regret in curves[method] if regret > 0], color)
        chart.legend(585, 80 + 24 * i, [(METHODS[method][0], color, "")])
    chart.save(path)


def speed(path, rounds=5, n=5000):
    """Yields lines: the times of one-time computations, and the shortest time in several rounds for
    each call of a problem. These are CPU times, because the machine may be busy."""
    from morphod.atlas import Atlas, Problem
    began = time.process_time()
    atlas = Atlas.open(path)
    once = []
    for name, call in (("opening", lambda: atlas), ("ranks", atlas.order),
                       ("basins", atlas.basins)):
        call()
        once.append(f"{name} {time.process_time() - began:.2f} s")
        began = time.process_time()
    yield f"{len(atlas):,} bodies, computed once: " + ", ".join(once)
    problem = Problem(atlas)
    rng = np.random.default_rng(1)
    texts = [problem.random(rng) for _ in range(n)]
    bodies = np.array([[digit == "1" for digit in text] for text in texts])
    bodies = bodies.reshape(n, *atlas.workspace)
    vectors = [rng.normal(size=problem.dimensions) for _ in range(n)]
    calls = {"a genotype": lambda: [problem.evaluate(text) for text in texts],
             "a body of an array of 5000": lambda: problem.evaluate_all(bodies),
             "growing a body from a vector": lambda: [problem.decode(values) for values in vectors]}
    times = []
    for name, call in calls.items():
        least = math.inf
        for _ in range(rounds):
            began = time.process_time()
            call()
            least = min(least, time.process_time() - began)
        times.append(f"{name} {1e6 * least / n:.1f} µs")
    yield "loss of " + ", ".join(times)


def parser_of():
    parser = argparse.ArgumentParser(
        prog="tools/bench search", description="Search methods on an atlas: exact regret against "
        "the number of evaluations. The table goes to standard output. Methods whose package is "
        "not installed are named as not run: pip install './clients/python[search]'.")
    parser.add_argument("atlas", help="an atlas file")
    parser.add_argument("--evaluations", type=int, default=1000, help="of each run (default 1000)")
    parser.add_argument("--seeds", type=int, default=30, help="runs of each method (default 30)")
    parser.add_argument("--methods", type=lambda text: text.split(","), default=list(METHODS),
                        help=f"default {','.join(METHODS)}")
    parser.add_argument("--limits", type=limits_of, default={},
                        help="fewer evaluations of slow methods, as tpe=300,nevergrad=500")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(),
                        help="runs at a time (default: one per processor)")
    parser.add_argument("--speed", action="store_true",
                        help="only measure how long a problem takes to answer")
    parser.add_argument("--csv", type=Path, 
                        help="regrets of all runs at 1, 2, 5, 10, … evaluations")
    parser.add_argument("--svg", type=Path, help="a chart of the mean regrets")
    return parser


def main():
    parser = parser_of()
    arguments = parser.parse_args()
    unknown = (set(arguments.methods) | set(arguments.limits)) - set(METHODS)
    if unknown or arguments.evaluations < 10 or arguments.seeds < 1:
        parser.error(f"no method {', '.join(sorted(unknown))}" if unknown else
                     "at least 10 evaluations and one seed")
    from morphod.atlas import Atlas
    atlas = Atlas.open(arguments.atlas, check=True)
    if arguments.speed:
        print("\n".join(speed(arguments.atlas)))
        return 0
    tasks = [(arguments.atlas, method, seed,
              min(arguments.evaluations, arguments.limits.get(method, arguments.evaluations)))
             for method in arguments.methods if not missing(method)
             for seed in range(1, arguments.seeds + 1)]
    rows = []
    with multiprocessing.get_context("spawn").Pool(arguments.jobs) as pool:
        for row in pool.imap(run, tasks):
            rows.append(row)
            print(f"{row['method']} seed {row['seed']}: regret "
                  f"{regret_at(row, row['budget']):.4f}, {row['seconds']:.1f} s",
                  file=sys.stderr)
    scope = (f"{len(atlas):,} bodies of at most {atlas.voxels_max} voxels, {atlas.orientations}, "
             f"{atlas.n_environments} environments")
    print(f"{scope}; optimum {atlas.score(int(atlas.best(1)[0])):.4f}\n")
    print("\n".join(table(rows, arguments.methods, arguments.evaluations, arguments.seeds)))
    if arguments.csv:
        at = [n for n in CHECKPOINTS if n < arguments.evaluations] + [arguments.evaluations]
        records.replace(arguments.csv, "method,seed,evaluations,regret\n" + "".join(
            f"{row['method']},{row['seed']},{n},{regret_at(row, n):.9g}\n"
            for row in rows for n in at if n <= row["budget"]))
    if arguments.svg:
        figure(arguments.svg, rows, arguments.methods, arguments.evaluations, scope)
    return 0


if __name__ == "__main__":
    sys.exit(main())
