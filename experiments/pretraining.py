"""Pretrains controllers through the daemon, at the paper's scale by default, and reports and draws
how they learn.

One call trains one recipe with some seeds, one training run after the other. The state folder is
kept: when called again, the program continues where it stopped, and yields the same numbers. A row
of the CSV file is a step or a validation; the file collects rows of many recipes. A training run is
not rerun, even without its state, if all its rows are in the CSV file and its controller is in the
folder."""
import bisect
import hashlib
import sys
from pathlib import Path

import own_daemon
from own_daemon import Daemon, Deadline
from charts import GRAY, PALETTE, Chart, Panel, Scale, bundle, decades
import records

TEXTS = ("recipe", "device", "machine", "row")
COLUMNS = TEXTS + ("seed", "step", "loss", "gradient_norm", "rate", "clipped_share",
                   "clipped_robots", "zeroed", "diverged", "skipped", "seconds", "standard_error")
PAPER_LOSS = 0.30
DT_MS = 4  # the usual step of physics
MARKS = (50, 150, 750, 1050)
SCHEDULES = {
    "one-cosine": {"kind": "cosine", "peak": 2e-3, "floor": 1e-5, "warmup_steps": 10},
    "paper-pretrain": {
        "kind": "restarts", "peak": 1e-3, "floor": 1e-5, "decay": 0.7, "cycle_steps": 10,
        "cycle_growth": 2, "warmup_steps": 0
    }, "constant": {"kind": "constant", "peak": 1e-3, "warmup_steps": 0}
}
SCHEDULES["restarts"] = SCHEDULES["paper-pretrain"]

# ---- recipes ----


def schedule_of(arguments):
    schedule = dict(SCHEDULES[arguments.schedule])
    given = {
        "peak": arguments.peak, "floor": arguments.floor, "warmup_steps": arguments.warmup,
        "decay": arguments.decay, "cycle_steps": arguments.cycle, "cycle_growth": arguments.growth
    }
    for name, value in given.items():
        if value is not None:
            if name not in schedule:
                sys.exit(f"{name} does not belong to the schedule {arguments.schedule}")
            schedule[name] = value
    return schedule


def physics_of(arguments):
    return {
        "n_steps": round(arguments.rollout_steps * DT_MS / arguments.dt_ms),
        "impact": arguments.impact, "integrator": arguments.integrator,
        "dt_s": arguments.dt_ms / 1000, "control_period_s": arguments.control_period_ms / 1000
    }


# With a preset, the settings of these options are the preset's.
OF_RECIPE = ("schedule", "peak", "floor", "decay", "warmup", "cycle", "growth", "bound", "rule",
             "restart_weight", "beta1", "beta2", "epsilon", "impact", "integrator", "dt_ms",
             "control_period_ms", "norm_limit", "sensor", "rollout_steps")


def request_of(arguments, seed):
    body = settings_of(arguments, seed)
    if arguments.vary:
        body["vary"] = dict(arguments.vary)
    if arguments.from_default:
        body["controller"] = "default"
        body.pop("sensor", None)  # the controller's
    body["name"] = f"pretraining-{hashlib.sha256(recipe_of(body).encode()).hexdigest()[:12]}-{seed}"
    return body


def settings_of(arguments, seed):
    if arguments.preset:
        usual = options().parse_args([])
        for name in OF_RECIPE:
            if getattr(arguments, name) != getattr(usual, name):
                sys.exit(f"--{name.replace('_', '-')} does not go with --preset, which has its own")
    body = {
        "kind": "pretrain", "seed": seed, "steps": arguments.steps, "batch": arguments.batch,
        "sensor": arguments.sensor, "schedule": schedule_of(arguments),
        "gradient_norm_limit": arguments.norm_limit,
        "adam": {"beta1": arguments.beta1, "beta2": arguments.beta2,
                 "epsilon": arguments.epsilon}, "adjoint_bound": arguments.bound,
        "adjoint_rule": arguments.rule, "restart_weight": arguments.restart_weight,
        "physics": physics_of(arguments), "device": arguments.device, "validation": {
                        "every_steps": arguments.validation_every,
                        "designs": arguments.validation_designs,
                        "environments": arguments.validation_environments
                    }, "checkpoint": {"keep": 1}
    }
    if arguments.preset:
        kept = ("kind", "seed", "steps", "batch", "device", "validation", "checkpoint")
        body = {"preset": arguments.preset, **{name: body[name] for name in kept}}
    return body


def recipe_of(body):
    """Returns the recipe as one line without commas: always schedule, bound and size, and whatever
    differs from the default."""
    varied = [f"{name} {low:g}..{high:g}" for name, (low, high) in body.get("vary", {}).items()]
    if "controller" in body:
        varied.append("from default")
    if "preset" in body:
        return " ".join([body["preset"], *varied]) + f" / {body['batch']} x {body['steps']}"
    schedule = body["schedule"]
    kind, usual = next((name, s) for name, s in SCHEDULES.items() if s["kind"] == schedule["kind"])
    words = [{"one-cosine": "one cosine", "paper-pretrain": "restarts"}.get(kind, kind),
             f"{schedule['peak']:g}"]
    words[1] += f"..{schedule['floor']:g}" if "floor" in schedule else ""
    for name, word in (("decay", "decay"), ("cycle_steps", "cycle"), ("cycle_growth", "growth"),
                       ("warmup_steps", "warm-up")):
        if name in schedule and schedule[name] != usual.get(name):
            words.append(f"{word} {schedule[name]:g}")
    words.append(f"bound {body['adjoint_bound']:g}")
    if body["adjoint_rule"] != "clip":
        words.append(f"{body['adjoint_rule']} {body['restart_weight']:g}")
    adam = body["adam"]
    for value, usual_value, word in ((body["gradient_norm_limit"], 1, "norm"),
                                     (adam["beta1"], 0.9, "beta1"), (adam["beta2"], 0.999, "beta2"),
                                     (adam["epsilon"], 1e-8,
                                      "epsilon"), (usual_steps(body["physics"]), 1000, "lives of")):
        if value != usual_value:
            words.append(f"{word} {value:g}")
    for name, usual_value, word in (("dt_s", DT_MS / 1000, "dt"), ("control_period_s", 0,
                                                                   "period")):
        if body["physics"][name] != usual_value:
            words.append(f"{word} {1000 * body['physics'][name]:g} ms")
    words += [
        word for word, usual_word in ((body["physics"]["integrator"], "paper"),
                                      (body["physics"]["impact"], "exact"),
                                      (body.get("sensor", "inverse_sqrt"), "inverse_sqrt"))
        if word != usual_word
    ]
    return " ".join(words + varied) + f" / {body['batch']} x {body['steps']}"


def usual_steps(physics):
    """Returns how many steps of the usual length a rollout would have."""
    return physics["n_steps"] * physics["dt_s"] * 1000 / DT_MS


def file_of(folder, recipe, seed):
    slug = "".join(c if c.isalnum() or c in ".-" else "-"
                   for c in recipe.replace(" / ", "-").replace("..", "-to-"))
    return folder / f"{slug}-seed-{seed}.safetensors"


# ---- running ----


def rows_of(daemon, training, recipe):
    machine = daemon.machine()
    computed = " + ".join(f"{machine['gpus'].count(gpu)} {gpu}"
                          for gpu in sorted(set(machine["gpus"])))
    same = {
        "recipe": recipe, "device": training["device"],
        "machine": computed if training["device"] == "cuda" else f"{machine['workers']} threads",
        "seed": training["settings"]["seed"]
    }
    path = f"/v1/trainings/{training['id']}"
    for row in daemon.items(f"{path}/steps"):
        yield {
            **same, **row, "row": "step", "loss": row["mean_loss"],
            "clipped_robots": row["clipped_robots_share"], "skipped": int(row["skipped"])
        }
    for row in daemon.items(f"{path}/validations"):
        yield {
            **same, "row": "validation", "step": row["step"], "loss": row["mean_score"],
            "standard_error": row["standard_error"], "diverged": row["diverged"]
        }


def is_done(rows, recipe, seed, device, steps, file):
    """Returns whether an earlier call has completed the training."""
    known = {
        row["step"]
        for row in rows
        if (row["recipe"], row["seed"],
            row["row"]) == (recipe, seed, "step") and device in ("auto", row["device"])
    }
    return file.exists() and len(known) >= steps


def progress_of(training, recipe):
    progress = training["progress"]
    seed = training["settings"]["seed"]
    line = f"{recipe}, seed {seed}: step {progress['step']} of {progress['steps']}"
    if training["phase"] == "replaying":
        line += f", redrawing {progress['replayed']} of {progress['replay_total']} bodies"
    if progress["mean_loss"] is not None:
        line += f", loss {progress['mean_loss']:.4f}"
    if progress["bodies_per_s"]:
        line += f", {training['settings']['batch'] / progress['bodies_per_s']:.2f} s per step"
    if progress["seconds_left"] is not None:
        line += f", {progress['seconds_left']:.0f} s left"
    return line


def run(arguments):
    """Returns whether all training runs have ended. The rows of an unfinished training run are
    written as well."""
    deadline = Deadline(arguments.limit_s)
    known = records.read(arguments.csv, TEXTS)
    bodies = [request_of(arguments, seed) for seed in arguments.seeds]
    recipe = recipe_of(bodies[0])
    wanted = [
        body for body in bodies
        if not is_done(known, recipe, body["seed"], arguments.device, arguments.steps,
                       file_of(arguments.folder, recipe, body["seed"]))
    ]
    if not wanted:
        return True
    arguments.folder.mkdir(parents=True, exist_ok=True)
    with Daemon.of(arguments, "--max-trainings=1") as daemon:
        print(f"on {daemon.machine()}", file=sys.stderr)
        for body in wanted:
            training = daemon.follow("trainings", daemon.submit("trainings", body), deadline,
                                     lambda job: progress_of(job, recipe))
            new = list(rows_of(daemon, training, recipe))
            if new:
                key = (recipe, training["device"], training["settings"]["seed"])
                known = [
                    row for row in known if (row["recipe"], row["device"], row["seed"]) != key
                ] + new
                records.write(arguments.csv, COLUMNS, known)
            if not own_daemon.ended_well("training", training):
                return False
            print(
                f"{recipe}, seed {body['seed']}: {daemon.elapsed_s(training):.0f} s from start to "
                f"end, including validations and stops",
                file=sys.stderr)
            records.replace(file_of(arguments.folder, recipe, training["settings"]["seed"]),
                            daemon.fetch(f"/v1/trainings/{training['id']}/controller"))
            daemon.call(f"/v1/trainings/{training['id']}/checkpoints",
                        method="DELETE")  # 12 MB that are no longer needed
    return True


# ---- progress ----


def smooth(curve, half):
    """Returns the mean of (step, loss) over the steps within ±half(step) of each."""
    steps, sums = [step for step, _ in curve], [0.0]
    for _, loss in curve:
        sums.append(sums[-1] + loss)
    out = []
    for step, _ in curve:
        low, high = bisect.bisect_left(steps, step - half(step)), bisect.bisect_right(
            steps, step + half(step))
        out.append((step, (sums[high] - sums[low]) / (high - low)))
    return out


def losses(group):
    return [(row["step"], row["loss"]) for row in group
            if row["row"] == "step" and row["loss"] is not None]


def seconds_until(group, bound):
    """Returns the wall time until the mean loss of 20 consecutive steps is at most the bound."""
    last, seconds = [], 0.0
    for row in group:
        if row["row"] == "step":
            seconds += row["seconds"] or 0
            last = (last + ([row["loss"]] if row["loss"] is not None else []))[-20:]
            if len(last) == 20 and sum(last) / 20 <= bound:
                return seconds
    return None


def summary(group):
    """Returns the numbers of one training run for the tables."""
    curve = losses(group)
    steps = [row for row in group if row["row"] == "step"]
    validations = [row for row in group if row["row"] == "validation" and row["loss"] is not None]
    around = {
        mark: records.mean([loss for step, loss in curve if mark - 10 < step <= mark + 10])
        for mark in MARKS if curve and curve[-1][0] >= mark
    }
    seconds = sum(row["seconds"] or 0 for row in steps)
    return {
        "steps": len(steps), "around": around,
        "end": records.mean([loss for _, loss in curve[-20:]
                             ]), "until": seconds_until(group, PAPER_LOSS), "seconds": seconds,
        "per_step": seconds / len(steps) if steps else None,
        "held_out": (validations[-1]["loss"],
                     validations[-1]["standard_error"]) if validations else None,
        "zeroed": sum(row["zeroed"] or 0 for row in steps), "skipped": sum(row["skipped"] or 0
                                                                           for row in steps)
    }


def table(rows):
    def text(value, form):
        return "–" if value is None else format(value, form)

    lines = []
    for (recipe, device, seed), group in records.group(rows, "recipe", "device", "seed").items():
        s = summary(group)
        held_out = f"{s['held_out'][0]:.4f} ± {1.96 * (s['held_out'][1] or 0):.4f}" if s[
            "held_out"] else "–"
        lines.append([f"{recipe} ({device})", f"{int(seed)}", f"{s['steps']}"] +
                     [text(s["around"].get(mark), ".3f") for mark in MARKS] + [
                         text(s["end"], ".4f"),
                         text(s["until"], ".0f"), f"{s['seconds']:.0f}",
                         text(s["per_step"], ".3f"), held_out
                     ])
    heads = ["recipe", "seed", "steps"] + [f"loss at {mark}" for mark in MARKS] + [
        "end", f"s to {PAPER_LOSS:.2f}", "s", "s per step", "held out"
    ]
    return records.table(heads, lines)


def draw(rows, path):
    """Draws the loss of the batch against the logarithm of the step, which shows the beginning, and
    the score of the held-out bodies against the step."""
    groups = records.group(rows, "recipe", "device")
    last = max(row["step"] for row in rows)
    width, left, right, top, high, gap = 940, 70, 20, 46, 380, 70
    chart = Chart(width, top + 2 * (high + gap) + 20 * len(groups) + 10)
    known = [row["loss"] for row in rows if row["loss"]]
    last = max(last, 2)
    scales = Scale(1, last, log=True), Scale(0, last)
    scale = Scale(*decades(known + [PAPER_LOSS]), log=True)
    panels = []
    for p, title in enumerate(("mean loss of the batch, smoothed: each seed (thin), mean (thick)",
                               "score of held-out bodies: mean over seeds and range")):
        panel = Panel(chart, left, top + p * (high + gap), width - right,
                      top + p * (high + gap) + high, scales[p], scale)
        panel.title(title)
        panel.axes("step of learning", "distance to the light, end / start", x_grid=True)
        panel.line([(scales[p].low, PAPER_LOSS), (last, PAPER_LOSS)], GRAY, "2 3")
        chart.text(*((left + 6, f"{panel.at_y(PAPER_LOSS) - 5:.1f}") if p == 0 else
                     (width - right - 130, f"{panel.at_y(PAPER_LOSS) + 14:.1f}")),
                   f"the paper's end, {PAPER_LOSS}",
                   fill=GRAY)
        panels.append(panel)
    for i, ((recipe, device), group) in enumerate(groups.items()):
        color = PALETTE[i % len(PALETTE)]
        smoothed = []
        for trial in records.group(group, "seed").values():
            curve = smooth(losses(trial), lambda step: min(10, step // 10))
            kept = [
                point for j, point in enumerate(curve)
                if j == len(curve) - 1 or j < 20 or point[0] % max(1, int(point[0] / 60)) == 0
            ]
            panels[0].line(kept, color, style="stroke-width:.8;stroke-opacity:.5")
            smoothed.append(dict(kept))
        common = sorted(set.intersection(*map(set, smoothed)))
        panels[0].line([(step, sum(curve[step] for curve in smoothed) / len(smoothed))
                        for step in common],
                       color,
                       style="stroke-width:2.4")
        validations = [{row["step"]: row["loss"]
                        for row in trial if row["row"] == "validation"}
                       for trial in records.group(group, "seed").values()]
        bundle(panels[1], validations, color, dots=True)
        y = top + 2 * (high + gap) + 20 * i
        chart.legend(
            left, y,
            [(f"{recipe} ({device}), {len(smoothed)} seed{'s' if len(smoothed) > 1 else ''}",
              color, "")])
    chart.save(path)


def options():
    parser = own_daemon.parser_of("pretraining", __doc__)
    own = "(default: the schedule's)"
    own_daemon.add_options(
        parser, own_daemon.SEEDS, ("--steps", int, 1400, None), ("--batch", int, 8192, None),
        ("--schedule", SCHEDULES, "one-cosine", "restarts: the same as paper-pretrain"),
        ("--peak", float, None, f"largest rate {own}"),
        ("--floor", float, None, f"smallest rate {own}"),
        ("--decay", float, None, f"factor of the peak from one restart to the next {own}"),
        ("--warmup", int, None, f"steps of warm-up {own}"),
        ("--cycle", int, None, f"steps to the first restart {own}"),
        ("--growth", int, None, f"growth of the cycles {own}"),
        ("--bound", float, 2.0,
         "bound of each robot's adjoint; 0: not clipped, as in the paper (default 2)"),
        *own_daemon.ABOVE_BOUND, ("--beta1", float, 0.9, "beta1 of Adam (default 0.9)"),
        ("--beta2", float, 0.999, "beta2 of Adam (default 0.999)"),
        ("--epsilon", float, 1e-8, "epsilon of Adam (default 1e-8)"),
        ("--impact", str, "exact",
         "time of impact: exact, or bisection8 as in the paper (default exact)"),
        ("--integrator", ("paper", "split"), "paper", None),
        ("--dt-ms", float, DT_MS,
         f"time step, ms; rollouts last as long as with {DT_MS} ms (default {DT_MS})"),
        ("--control-period-ms", float, 0,
         "how often the controller computes its outputs; 0: at every step (default 0)"),
        ("--norm-limit", float, 1.0, "largest norm of the gradient of a batch; 0: off (default 1)"),
        ("--sensor", ("inverse_sqrt", "inverse_square"), "inverse_sqrt", None),
        ("--validation-every", int, 50, "steps between validations (default 50; 0: never)"),
        ("--validation-designs", int, 256, "held-out bodies (default 256)"),
        ("--validation-environments", int, 8, "held-out environments of each (default 8)"),
        ("--preset", ("workstation", "phototaxis", "paper", "robust"), None,
         "all settings but steps and batch; only --vary and --from-default go with it"),
        ("--from-default", bool, False, "start with the default controller's weights"),
        own_daemon.ROLLOUT_STEPS, own_daemon.LIMIT,
        ("--csv", Path, Path("pretraining.csv"), "read at the start, rewritten with new rows"),
        ("--svg", Path, Path("pretraining.svg"), None),
        ("--folder", Path, Path("controllers"), "for the final controllers (default controllers)"),
        ("--markdown", Path, None,
         "page that gets the table, between the markers pretraining: begin and end"),
        ("--report", bool, False,
         "run nothing: only make the table and the drawing from the CSV file"))
    own_daemon.add_vary(parser, "range of what varies in the worlds; can be repeated")
    return parser


def main():
    arguments = options().parse_args()
    if not arguments.report and not run(arguments):
        return own_daemon.cut_off()
    own_daemon.report(arguments, "pretraining", TEXTS, draw, table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
