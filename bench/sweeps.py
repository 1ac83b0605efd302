#!/usr/bin/python3
"""accuracy, stability: tables of morpho-bench, and their charts."""
import argparse
import contextlib
import math
import pathlib
import subprocess
import sys

SOURCE = pathlib.Path(__file__).resolve().parents[1]
sys.path.insert(0, str(SOURCE / "experiments"))

import records  # noqa: E402
from charts import Chart, Panel, Scale, decades  # noqa: E402

WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 860, 560, 80, 230, 50, 60
COLORS = ("#1b6ca8", "#c0392b", "#1e8449", "#b7950b", "#7d3c98",  # float32
          "#5dade2", "#ec7063", "#58d68d", "#f5b041", "#af7ac5")  # float64
ROBOTS = 32
TIME, ERROR = "time_ms_per_rollout", "path_error_m_1s_median"
SAME_DT = "same_dt_" + ERROR
CORE = "milliseconds per rollout of 4 s, one core"
FIRST_SECOND = "error of the center of mass in the first second, median, m"
HELD = "phototaxis-16ms"  # trained with outputs every 16 ms


def scale_of(values):
    """If there are many decades, only they have a mark."""
    low, high = decades(values)
    powers = [10.0**k for k in range(-12, 13) if low <= 10.0**k * 1.001 and 10.0**k <= high * 1.001]
    return Scale(low, high, log=True, ticks=powers if len(powers) > 3 else None)


def panel_of(chart, place, title, x_name, y_name, x_values, y_values):
    top = place * HEIGHT + TOP
    panel = Panel(chart, LEFT, top, WIDTH - RIGHT, top + HEIGHT - TOP - BOTTOM,
                  scale_of(x_values), scale_of(y_values))
    panel.title(title)
    panel.axes(x_name, x_grid=True)
    middle = top + (HEIGHT - TOP - BOTTOM) / 2
    chart.text(18, middle, y_name, text_anchor="middle", transform=f"rotate(-90 18 {middle})")
    return panel


def name(panel, place, text, color):
    panel.chart.legend(panel.right + 16, panel.top + 20 * place + 12, [(text, color, "")])


def front(points):
    """The points for which no other takes less time and has a smaller error."""
    best, least = [], math.inf
    for point in sorted(points):
        if point[1] < least:
            best.append(point)
            least = point[1]
    return best


def draw_front(chart, place, title, x_name, rows):
    """Draws error against time, a line for each controller, integrator and period."""
    panel = panel_of(chart, place, title, x_name, FIRST_SECOND,
                     [row[TIME] for row in rows], [row[ERROR] for row in rows])
    panel.line(front([(row[TIME], row[ERROR]) for row in rows]), "#c8c8c8", style="stroke-width:9")
    groups = records.group(rows, "controller", "integrator", "period_ms").items()
    for line, ((controller, integrator, period), group) in enumerate(groups):
        trained = controller == HELD
        color = "#000" if trained and integrator == "split" else "#888" if trained else COLORS[
            line % 3 if integrator == "paper" else 5 + line % 3]
        points = [(row[TIME], row[ERROR]) for row in group]
        panel.line(points, color)
        panel.dots(points, color, 4)
        name(panel, line, f"{integrator}, outputs every {period:g} ms" + (" *" if trained else ""),
             color)
    name(panel, len(groups), "front", "#c8c8c8")
    if any(row["controller"] == HELD for row in rows):
        name(panel, len(groups) + 1, f"* {HELD}", "")


def draw_accuracy(rows, path, gpu):
    """gpu: rows of times on a GPU, or none."""
    chart = Chart(WIDTH, (3 if gpu else 2) * HEIGHT)
    shown = [row for row in rows if row["impact"] == "exact" and row["precision"] == "float32"]
    steps = "(4, 2, 1, 0.5 ms from left to right; float32, exact impacts)"
    draw_front(chart, 0, f"Against the limit of small steps {steps}", CORE, shown)
    if gpu:
        times = {(row["integrator"], row["period_ms"], row["dt_ms"]): 1e3 * row[TIME]
                 for row in gpu}
        draw_front(chart, 1, "The same errors against time on one H200 (8192 bodies in ten "
                   "environments)", "microseconds per rollout of 4 s, one H200",
                   [{**row, TIME: times[row["integrator"], row["period_ms"], row["dt_ms"]]}
                    for row in shown])
    # Not float64 exact itself.
    first = [row for row in rows if row["integrator"] == "paper" and row["period_ms"] == 4
             and 0 < row[SAME_DT] < math.inf]
    panel = panel_of(chart, 2 if gpu else 1, "Against float64 exact at the same time step: only "
                     "precision and impact mode (paper, 4 ms)", CORE, FIRST_SECOND,
                     [row[TIME] for row in first], [row[SAME_DT] for row in first])
    for place, (words, group) in enumerate(records.group(first, "precision", "impact").items()):
        points = [(row[TIME], row[SAME_DT]) for row in group]
        panel.line(points, COLORS[place])
        panel.dots(points, COLORS[place], 3)
        name(panel, place, " ".join(words), COLORS[place])
    chart.save(path)


def draw_stability(rows, path):
    """Draws what happened to the robots at each step and stiffness, and the linear bound."""
    rows = [row for row in rows if row["row"].endswith("N/m")]
    maps = records.group(rows, "integrator", "period").items()
    chart = Chart(WIDTH, len(maps) * HEIGHT)
    for place, ((integrator, period), group) in enumerate(maps):
        panel = panel_of(chart, place, f"{integrator}, outputs every {period}", "time step, ms",
                         "stiffness, N/m", (0.1, 10), (1e3, 1e7))
        for i, (words, color, shown) in enumerate((
            ("all robots stay intact", "#58b368", lambda row: row["stays"] == ROBOTS),
            ("some blow up for a moment", "#f7dc6f",
             lambda row: row["stays"] < ROBOTS and row["diverged"] == 0),
            ("some diverge", "#f0a30a", lambda row: 0 < row["diverged"] < ROBOTS),
            ("all diverge", "#d6604d", lambda row: row["diverged"] == ROBOTS))):
            squares = "".join(
                f"M{panel.at_x(row['dt_ms']) - 8:.0f} "
                f"{panel.at_y(row['stiffness_n_per_m']) - 8:.0f}h16v16h-16z"
                for row in group if shown(row))
            chart.out.append(f'<path fill="{color}" d="{squares}"/>')
            name(panel, i, words, color)
        panel.dots([(4 if integrator == "paper" else 2, 15000)], "#1b6ca8", 5)
        name(panel, 4, "the paper's settings" if integrator == "paper" else "the default",
             "#1b6ca8")
        bound = {row["stiffness_n_per_m"]: row["linear_bound_ms"] for row in group}
        panel.line([(dt, most) for most, dt in sorted(bound.items()) if 0.1 <= dt <= 10], "#111")
        name(panel, 5, "linear bound", "#111")
    chart.save(path)


def main():
    parser = argparse.ArgumentParser(prog="tools/bench", description=__doc__,
                                     epilog="Other options go to morpho-bench.")
    parser.add_argument("what", choices=("accuracy", "stability"))
    parser.add_argument("--csv", help="the table (default: standard output)")
    parser.add_argument("--svg", help="the chart of the table, with --csv")
    parser.add_argument("--gpu", help="times of `cuda-bench MODULE accuracy`, for the chart")
    parser.add_argument("--report", action="store_true", help="measure nothing: draw the table")
    arguments, others = parser.parse_known_args()
    if not arguments.report:
        command = [SOURCE / "build/bench/morpho-bench", arguments.what, *others]
        with open(arguments.csv, "w") if arguments.csv else contextlib.nullcontext() as table:
            status = subprocess.run(command, stdout=table, check=False).returncode
        if status != 0:
            sys.exit(status)
    if arguments.csv and arguments.svg:
        words = ("controller", "integrator", "precision", "impact", "period", "row")
        rows = records.read(arguments.csv, words)
        if arguments.what == "accuracy":
            gpu = records.read(arguments.gpu, words) if arguments.gpu else []
            draw_accuracy(rows, arguments.svg, gpu)
        else:
            draw_stability(rows, arguments.svg)


if __name__ == "__main__":
    main()
