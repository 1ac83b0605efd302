"""Makes figures and tables of `tools/bench reproduction` from only its files.

In every figure, columns and colors stand for modes. A line is the mean over the trials, a band
their range."""
import json
import math
import textwrap
from pathlib import Path

import voxels
from campaigns import MODES, survival, table
from charts import COLORS, GRAY, Chart, Panel, Scale, bundle, decades
import pretraining
import records

PRETRAINING = "#8e44ad"
LEFT, RIGHT, TOP, BOTTOM, WIDE, HIGH = 64, 14, 64, 44, 270, 210  # of a panel, with margins
# The paper's numbers: loss, length, minutes on eight H100 GPUs. None: not given.
PAPER = {
    "pretraining": ("0.30", "1400 steps", 56), "zero-shot": ("near optimal", "100 generations", 17),
    "few-shot": ("as good or better", "6 generations shown", None),
    "simultaneous": ("about 0.30 (training)", "180 generations, 360 steps", 109)
}
PAPER_GPUS, PAPER_SIZE = 8, 8192  # robots of a batch, designs of a population
FEW_STEPS = 4  # learning steps in a generation
PAPER_RECIPE = "restarts 0.001..1e-05 bound 0 /"  # its schedule, nothing clipped
PAPER_LENGTH = {"pretraining": 1400, "zero-shot": 100, "simultaneous": 180}


def read(folder):
    """Returns (entries of campaigns.json, rows of generations.csv)."""
    path = Path(folder) / "campaigns.json"
    kept = json.loads(path.read_text(encoding="utf-8"))["campaigns"] if path.exists() else []
    rows = records.read(Path(folder) / "generations.csv", ("mode", ))
    for row in rows:
        row["seed"], row["generation"] = int(row["seed"]), int(row["generation"])
    return kept, rows


def trials(rows, mode):
    return [
        sorted(group, key=lambda row: row["generation"])
        for (of, _), group in records.group(rows, "mode", "seed").items() if of == mode
    ]


def grid(columns, n_rows, title, legend):
    """Returns the page of a figure with panels, and a function that makes the panel in a row and
    column."""
    width, height = max(columns * (LEFT + WIDE + RIGHT), 680), TOP + n_rows * (HIGH + BOTTOM) + 12
    chart = Chart(width, height)
    chart.text(LEFT, 22, title, font_size=15)
    chart.legend(LEFT, 42, legend, column=200)

    def panel(row, column, x, y):
        left, top = column * (LEFT + WIDE + RIGHT) + LEFT, TOP + row * (HIGH + BOTTOM) + 8
        return Panel(chart, left, top, left + WIDE, top + HIGH - 16, x, y)

    return chart, panel


def generations(rows, mode):
    return Scale(0, max([row["generation"] for row in rows if row["mode"] == mode] + [1]))


def part_of(losses, child_steps, of_parents):
    """Returns the losses of a generation on its parents, or those on its children, which come last.
    """
    first = max(len(losses) - child_steps, 0)
    return losses[:first] if of_parents else losses[first:]


def learning_curves(kept, mode):
    """Returns mean losses while learning: (curves, one for each trial; dash). Step s of n in
    generation g is at g - 1 + s/n. If a generation has few steps on its parents and on its
    children, so that the curve would be a comb, there is one of each at g."""
    entries = [entry for entry in kept if entry["mode"] == mode and entry["learning"]]
    if not entries:
        return []
    parents, children = (entries[0]["settings"]["learning"][key]
                         for key in ("parent_steps", "child_steps"))
    if not 0 < parents <= FEW_STEPS or not 0 < children <= FEW_STEPS:
        return [([{
            g - 1 + (s + 1) / len(losses): loss
            for g, losses in enumerate(entry["learning"]) if g > 0 for s, loss in enumerate(losses)
        } for entry in entries], "")]
    return [([{
        g: records.mean(part)
        for g, losses in enumerate(entry["learning"])
        if (part := part_of(losses, children, of_parents))
    } for entry in entries], dash) for of_parents, dash in ((True, ""), (False, "2 3"))]


def draw_performance(kept, rows, pretrained, path):
    """Draws the paper's figure "Performance and diversity"."""
    modes = [
        mode for mode in ("simultaneous", "zero-shot", "few-shot")
        if any(row["mode"] == mode for row in rows)
    ]
    first = 1 if pretrained else 0
    everything = [row[key] for row in rows for key in ("mean", "best")
                  ] + [loss for entry in kept for losses in entry["learning"] for loss in losses]
    score = Scale(*decades(everything + [row["loss"] for row in pretrained]), log=True)
    legend = [("test score, mean", "#000", ""), ("test score, best", "#000", "5 4"),
              ("loss while learning", GRAY, ""), ("the same, only on children", GRAY, "2 3")]
    chart, panel = grid(first + len(modes), 2,
                        "Performance and diversity: mean over the trials and their range", legend)
    if pretrained:
        at = panel(0, 0, Scale(0, max(row["step"] for row in pretrained)), score)
        at.title("pretraining", 6, 13)
        at.axes("step of learning", "distance to the light, end / start")
        by_seed = records.group(pretrained, "seed").values()
        smoothed = [
            pretraining.smooth(pretraining.losses(group), lambda step: min(10, step // 10))
            for group in by_seed
        ]
        bundle(at, [{step: loss
                     for step, loss in curve if step < 50 or step % 5 == 0}
                    for curve in smoothed], GRAY)
        bundle(at, [{row["step"]: row["loss"]
                     for row in group if row["row"] == "validation"} for group in by_seed],
               PRETRAINING,
               dots=True)
        chart.text(at.left,
                   at.bottom + 60,
                   "line with dots: score of held-out bodies",
                   fill=PRETRAINING)
        for i, line in enumerate(textwrap.wrap(pretrained[0]["recipe"], 44)):
            chart.text(at.left, at.bottom + 78 + 14 * i, line, fill="#444", font_size=10)
    high = max([row["diversity"] for row in rows]) * 1.1 or 1
    for column, mode in enumerate(modes, first):
        at = panel(0, column, generations(rows, mode), score)
        at.title(mode, 6, 13)
        at.axes("", "" if column else "distance to the light, end / start")
        for curves, dash in learning_curves(kept, mode):
            bundle(at, curves, GRAY, dash)
        for key, dash in (("mean", ""), ("best", "5 4")):
            bundle(at, [{row["generation"]: row[key]
                         for row in group} for group in trials(rows, mode)], COLORS[mode], dash)
        at = panel(1, column, generations(rows, mode), Scale(0, high))
        at.axes("generation", "" if column > first else "diversity (Hamming / 144)")
        bundle(at, [{row["generation"]: row["diversity"]
                     for row in group} for group in trials(rows, mode)], COLORS[mode])
    chart.save(path)


def draw_over_generations(rows, path, title, legend, quantities):
    """Draws a row of panels for each quantity. quantities: (name of the axis, [(row → value,
    dash)])."""
    modes = [mode for mode in MODES if any(row["mode"] == mode for row in rows)]
    chart, panel = grid(len(modes), len(quantities), title, legend)
    for r, (name, values) in enumerate(quantities):
        known = [v for row in rows for value, _ in values if (v := value(row)) is not None]
        for column, mode in enumerate(modes):
            at = panel(r, column, generations(rows, mode),
                       Scale(0,
                             max(known, default=1) * 1.05 or 1))
            if r == 0:
                at.title(mode, 6, 13)
            at.axes("generation" if r == len(quantities) - 1 else "", "" if column else name)
            for value, dash in values:
                bundle(at, [{row["generation"]: value(row)
                             for row in group}
                            for group in trials(rows, mode)], COLORS[mode], dash)
    chart.save(path)


def draw_populations(kept, edges, path):
    """Draws the paper's figure "Evolved populations": distributions in the first population (gray)
    and in the last (colored)."""
    modes = [mode for mode in MODES if any(entry["mode"] == mode for entry in kept)]
    quantities = [("score", "score (end / start)"),
                  ("footprint", "footprint (columns of voxels, 0.01 m² each)"),
                  ("masses", "body mass (kg, 1 kg per mass)"),
                  ("distinctiveness", "mean Hamming distance to others / 144")]
    chart, panel = grid(
        len(quantities), len(modes),
        "Populations: the first (gray) and the last (colored); shares, mean over the trials", [])
    for column, (name, title) in enumerate(quantities):
        bins = edges[name]
        used = [
            i for i in range(len(bins) - 1) if any(population[name][i] for entry in kept
                                                   for population in entry["populations"])
        ] or [0]
        low, high = used[0], used[-1] + 1
        for r, mode in enumerate(modes):
            entries = [entry for entry in kept if entry["mode"] == mode]
            shares = [[
                records.mean([entry["populations"][which][name][i] for entry in entries])
                for i in range(low, high)
            ] for which in (0, -1)]
            at = panel(r, column, Scale(bins[low], bins[high], log=name == "score"),
                       Scale(0,
                             max(max(shares[0]), max(shares[1])) * 1.05))
            at.axes(title if r == len(modes) - 1 else "",
                    f"{mode}: share of the designs" if column == 0 else "")
            for share, color in zip(shares, (GRAY, COLORS[mode])):
                at.histogram(bins[low:high + 1], share, color)
    chart.save(path)


def blocks(kept):
    """Yields the blocks of the figure of champions: the first population of the first trial, then
    those of each mode."""
    first = {mode: next((entry for entry in kept if entry["mode"] == mode), None) for mode in MODES}
    shown = next((entry for entry in first.values() if entry), None)
    if shown:
        yield "the initial population", GRAY, shown["champions"][0]
    for mode in ("simultaneous", "zero-shot", "few-shot"):
        for champions in (first[mode]["champions"][1:] if first[mode] else []):
            yield f"{mode}, generation {champions['generation']}", COLORS[mode], champions


def draw_champions(kept, path):
    """Draws the paper's figure "Morphological distinctiveness": designs at even steps over the
    ranking, most distinct first, scores below."""
    per_row, unit = 10, 8
    wide, high = 12 * voxels.COS * unit + 10, 10 * unit + 22
    shown = list(blocks(kept))
    rows_of = [math.ceil(len(champions["designs"]) / per_row) for _, _, champions in shown]
    chart = Chart(round(20 + per_row * wide), round(20 + sum(34 + n * high for n in rows_of)))
    y = 20.0
    for (title, color, champions), n in zip(shown, rows_of):
        chart.text(10,
                   f"{y + 14:.1f}",
                   title +
                   ": at even steps over the ranking, most distinct first; below each its score",
                   font_size=13)
        for i, design in enumerate(champions["designs"]):
            left, top = 10 + i % per_row * wide, y + 26 + i // per_row * high
            chart.out += voxels.draw(design["genotype"], left, top, unit,
                                     color if color != GRAY else "#999999")
            text = "diverged" if design["score"] is None else f"{design['score']:.3f}"
            chart.text(f"{left + 6 * voxels.COS * unit:.1f}",
                       f"{top + 10 * unit + 14:.1f}",
                       text,
                       text_anchor="middle")
        y += 34 + n * high
    chart.save(path)


# ---- tables ----


def spread(values, form):
    """Formats the mean and, for several values, least to most."""
    values = [value for value in values if value is not None]
    if not values:
        return "–"
    middle, least, most = (format(value, form)
                           for value in (sum(values) / len(values), min(values), max(values)))
    return middle if least == most else f"{middle} ({least} to {most})"


def paper_line(name):
    loss, length, minutes = PAPER[name]
    return [
        name, "paper", loss, length, f"{minutes} min" if minutes else "not given",
        f"{PAPER_GPUS} H100", f"{PAPER_GPUS * minutes}" if minutes else "–", ""
    ]


def own_line(name, experiment, loss, length, size, minutes, gpus):
    """Returns a line of the table. length: (number, unit); minutes: of each trial. The saving in
    GPU time is shown only if length and size equal the paper's."""
    names = ", ".join(f"{gpus.count(gpu)} {gpu}" for gpu in sorted(set(gpus))) or "none"
    spent = [m * len(gpus) for m in minutes]
    is_equal = gpus and spent and length[0] == PAPER_LENGTH.get(experiment) and size == PAPER_SIZE
    less = ""
    if is_equal and records.mean(spent):
        less = f"{PAPER_GPUS * PAPER[experiment][2] / records.mean(spent):.0f} times less"
    return [
        "", name, loss, f"{length[0]} {length[1]}",
        spread(minutes, ".1f") + " min", names,
        spread(spent, ".1f") if gpus else "–", less
    ]


def comparison(kept, rows, pretrained, best):
    """Returns the table that compares with the paper. pretrained: all training runs; the table has
    only the best recipe and the paper's, and another table of the page has all."""
    lines = [paper_line("pretraining")] if pretrained else []
    for (recipe, device), group in records.group(pretrained, "recipe", "device").items():
        if recipe != best[0]["recipe"] and not recipe.startswith(PAPER_RECIPE):
            continue
        each = [pretraining.summary(trial) for trial in records.group(group, "seed").values()]
        loss = "training " + spread([s["end"] for s in each], ".3f")
        loss += "; held out " + spread([s["held_out"][0] for s in each if s["held_out"]], ".3f")
        gpus = [
            part.split(" ", 1)[1] for part in group[-1]["machine"].split(" + ") if part
            for _ in range(int(part.split()[0]))
        ] if device == "cuda" else []
        batch = int(recipe.rsplit("/", 1)[1].split("x")[0])
        lines.append(
            own_line(f"morphod, {recipe}", "pretraining", loss,
                     (min(s["steps"] for s in each), "steps"), batch,
                     [s["seconds"] / 60 for s in each], gpus))
        until = [s["until"] / 60 for s in each if s["until"] is not None]
        if until:
            lines.append([
                "", f"the same, to {pretraining.PAPER_LOSS:.2f}", f"{pretraining.PAPER_LOSS:.2f}",
                "",
                spread(until, ".2f") + " min", "", "", ""
            ])
    for mode in MODES:
        entries = [entry for entry in kept if entry["mode"] == mode]
        of = {
            entry["seed"]: [
                row for row in rows if (row["mode"], row["seed"]) == (mode, entry["seed"])
            ]
            for entry in entries
        }
        if not entries:
            continue
        loss = "test " + spread([group[-1]["mean"] for group in of.values()], ".4f")
        learnt = entries[0]["settings"]["learning"] if any(entry["learning"]
                                                           for entry in entries) else {}
        for name, of_parents in (("parents", True), ("children", False)):
            parts = [
                part_of(entry["learning"][-1], learnt["child_steps"], of_parents)
                for entry in entries if entry["learning"]
            ]
            last = [losses[-1] for losses in parts if losses]
            loss += f"; training on {name} " + spread(last, ".3f") if last else ""
        length = (max(group[-1]["generation"] for group in of.values()), "generations")
        gpus = entries[0]["machine"]["gpus"] if entries[0]["device"] == "cuda" else []
        minutes = [entry["elapsed_s"] / 60 for entry in entries]
        lines += [
            paper_line(mode),
            own_line("morphod", mode, loss, length, entries[0]["settings"]["population"], minutes,
                     gpus)
        ]
    return records.table(
        ("experiment", "", "loss or score", "length", "wall time", "GPUs", "GPU minutes", ""),
        lines)


def report(folder, pretraining_csv=None):
    """Draws every figure into the folder. Returns the tables as Markdown."""
    folder = Path(folder)
    kept, rows = read(folder)
    pretrained = records.read(pretraining_csv, pretraining.TEXTS) if pretraining_csv else []
    if not rows:
        raise SystemExit(f"{folder / 'generations.csv'} has no rows")
    best = min(records.group(pretrained, "recipe", "device").values(),
               default=[],
               key=lambda group: records.mean([
                   loss for trial in records.group(group, "seed").values()
                   for _, loss in pretraining.losses(trial)[-20:]
               ]) or math.inf)
    draw_performance(kept, rows, best, folder / "performance.svg")
    operators = [("crossover", "#000", ""), ("mutation", "#000", "5 4")]
    draw_over_generations(
        rows, folder / "operators.svg",
        "Success of crossover and mutation: mean over the trials and their range", operators,
        [("share of the children that survive", [(lambda row: survival(row, "recombinants"), ""),
                                                 (lambda row: survival(row, "mutants"), "5 4")])])
    draw_over_generations(rows, folder / "bodies.svg",
                          "Bodies: mean of the population, mean over the trials and their range",
                          [], [("footprint (0.01 m² each)", [(lambda row: row["footprint"], "")]),
                               ("body mass (kg)", [(lambda row: row["masses"], "")]),
                               ("springs", [(lambda row: row["springs"], "")])])
    if kept:
        edges = json.loads((folder / "campaigns.json").read_text(encoding="utf-8"))["edges"]
        draw_populations(kept, edges, folder / "populations.svg")
        draw_champions(kept, folder / "champions.svg")
    sizes = {entry["settings"]["population"] for entry in kept}
    text = comparison(kept, rows, pretrained, best) if kept else ""
    return f"{text}\n\n{table(rows, ' and '.join(str(size) for size in sorted(sizes)) or '?')}"
