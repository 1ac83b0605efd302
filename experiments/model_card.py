"""Scores a controller through the daemon on bodies that no pretraining draws, and writes the
information that users need into its page.

Writes tables by size of the body (environments of the training run's distribution), by roughness of
the terrain and by distance of the light. Values beyond the training run's range are marked. A score
is the distance to the light at the end divided by that at the start: the mean over bodies of their
means over environments. Its 95 % confidence interval is a bootstrap over the bodies. Rollouts that
diverge are counted, but left out of the means. Text outside the markers is kept."""
import json
import math
import random
import re
import statistics
import sys
from pathlib import Path

import own_daemon
from own_daemon import Daemon, Deadline
import records

CENTER_M = 2.5
BINS = ((1, 4), (5, 9), (10, 19), (20, 29), (30, 44), (45, 144))
SIGMAS_M = (0.0, 0.02, 0.04, 0.06, 0.08, 0.10, 0.15, 0.20)
DISTANCES_M = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0)
TRAINED_SIGMA_M, TRAINED_DISTANCES_M = (0, 0.1), (0.4, 2.0)
RESAMPLES = 1000
PAGE = """# {name}.safetensors

What it is for, in one sentence.

<!-- model-card-file: begin -->
<!-- model-card-file: end -->

## Scores
<!-- model-card-scores: begin -->
<!-- model-card-scores: end -->

## Known limits
"""


def environment(distance_m, angle, sigma_m, seed):
    return {
        "light_xy_m": [
            CENTER_M + distance_m * math.cos(angle), CENTER_M + distance_m * math.sin(angle)
        ], "terrain_sigma_m": sigma_m, "seed": seed
    }


def sweeps(count):
    """Returns environments by roughness (lights uniform by area in the trained ring) and by
    distance of the light (roughness spread over the trained range): `count` for each value, with
    the same angles and places."""
    draw = random.Random(1)
    places = [(draw.random(), draw.random(), draw.random()) for _ in range(count)]
    near, far = TRAINED_DISTANCES_M

    def ring(share):
        return math.sqrt(near**2 + share * (far**2 - near**2))

    rough = {
        sigma: [
            environment(ring(r), 2 * math.pi * (i + a) / count, sigma, 1000 + i)
            for i, (r, a, _) in enumerate(places)
        ]
        for sigma in SIGMAS_M
    }
    light = {
        distance: [
            environment(distance, 2 * math.pi * (i + a) / count, s * TRAINED_SIGMA_M[1], 2000 + i)
            for i, (_, a, s) in enumerate(places)
        ]
        for distance in DISTANCES_M
    }
    return rough, light


def physics_of(daemon, arguments, controller):
    """Returns the default physics, or the paper's for a controller that acts in every step."""
    if daemon.call(f"/v1/controllers/{controller}")["control_period_s"]:
        return {"n_steps": 2 * arguments.rollout_steps}
    return {"integrator": "paper", "dt_s": 0.004, "n_steps": arguments.rollout_steps}


def evaluate(daemon, arguments, controller, designs, environments):
    """Returns losses: a list for each design, with None where it diverged. Stored losses are not
    recomputed."""
    body = {
        "designs": designs, "environments": environments, "controller": controller,
        "device": arguments.device, "priority": "batch",
        "physics": physics_of(daemon, arguments, controller)
    }
    job = daemon.follow(
        "evaluations", daemon.submit("evaluations", body), arguments.deadline,
        lambda job: f"{job['rollouts_done']} of {job['rollouts_total']} rollouts")
    if not own_daemon.ended_well("evaluation", job):
        sys.exit(own_daemon.cut_off())
    return [result["losses"] for result in job["results"]]


def interval(values):
    """Returns the mean and its 95 % confidence interval, by bootstrap."""
    draw, n = random.Random(1), len(values)
    if n < 2:
        return records.mean(values), None, None
    means = sorted(sum(draw.choices(values, k=n)) / n for _ in range(RESAMPLES))
    return sum(values) / n, means[round(0.025 * (RESAMPLES - 1))], means[round(0.975 *
                                                                               (RESAMPLES - 1))]


def line(name, bodies):
    """Returns a line of a table. bodies: the losses of each. Bodies are averaged first, so that the
    interval is over bodies."""
    means = [mean for losses in bodies if (mean := records.mean(losses)) is not None]
    rollouts = [loss for losses in bodies for loss in losses]
    if not means:
        return [name, str(len(bodies)), "–", "–", "–", "–"]
    mean, low, high = interval(means)
    around = "–" if low is None else f"{low:.4f} to {high:.4f}"
    return [
        name,
        str(len(bodies)), f"{mean:.4f}", around, f"{statistics.median(means):.4f}",
        f"{100 * sum(loss is None for loss in rollouts) / len(rollouts):.2f} %"
    ]


def by_size(designs, losses):
    for low, high in BINS:
        chosen = [
            body for design, body in zip(designs, losses)
            if low <= design["voxels"].count("1") <= high
        ]
        if chosen:
            yield line(f"{low} to {high} voxels", chosen)


def by_value(values, losses, count, unit, trained):
    for i, value in enumerate(values):
        beyond = "" if trained[0] <= value <= trained[1] else " (beyond the training)"
        yield line(f"{value:g} {unit}{beyond}",
                   [body[i * count:(i + 1) * count] for body in losses])


def metadata(controller):
    """Returns the table of the file and its lineage."""
    given = dict(controller["metadata"])
    lines = [["SHA-256", f"`{controller['sha256']}`"],
             [
                 "size",
                 f"{controller['bytes']} bytes, {controller['parameters']} parameters, float32"
             ], ["workspace", " × ".join(map(str, controller["workspace"])) + " voxels"],
             ["sensor", f"`{controller['sensor']}`"]]
    for key in sorted(given):
        if key in ("morphod.settings", "morphod.code", "sensor", "workspace"):
            continue
        lines.append([f"`{key}`", f"`{given[key]}`" if key.startswith("morphod.") else given[key]])
    for key in ("morphod.settings", "morphod.code"):
        if key in given:
            try:
                value = json.loads(given[key])
            except ValueError:
                value = given[key]
            parts = value.items() if isinstance(
                value, dict) else enumerate(value) if isinstance(value, list) else [("", value)]
            lines += [[f"`{key}` {name}".rstrip(), f"`{json.dumps(part)}`"] for name, part in parts]
    return records.table(("", ""),
                         [[cell.replace("|", "\\|") for cell in entry] for entry in lines])


def card(arguments):
    """Returns (table of the file, tables of the scores)."""
    rough, light = sweeps(arguments.environments)
    head = ("bodies", "mean score", "95 % confidence", "median", "diverged")
    with Daemon.of(arguments) as daemon:
        controller = daemon.put_controller(arguments.name, arguments.controller)
        designs, seeds, left = [], [], arguments.bodies
        while left > 0:  # a set has at most 1000 designs
            seeds.append(arguments.seed + len(seeds))
            held_out = daemon.call(
                f"/v1/held-out?seed={seeds[-1]}&designs={min(left, 1000)}"
                f"&environments={2 * arguments.environments}"
            )
            environments = held_out["environments"] if len(seeds) == 1 else environments
            designs += [design for design in held_out["designs"]
                        if design not in designs]  # small bodies may be in several sets
            left -= 1000
        name = "sha256:" + controller["sha256"]
        usual = evaluate(daemon, arguments, name, designs, environments)
        paper = evaluate(daemon, arguments, name, designs, "paper-test")
        by_rough = evaluate(daemon, arguments, name, designs,
                            [environment for group in rough.values() for environment in group])
        by_light = evaluate(daemon, arguments, name, designs,
                            [environment for group in light.values() for environment in group])
        physics = physics_of(daemon, arguments, name)
        machine = daemon.machine()
        description = json.loads(
            daemon.fetch(f"/v1/controllers/{arguments.name}"))
    computed = ", ".join(sorted(set(
        machine["gpus"]))) if machine["gpus"] and arguments.device != "cpu" else "processors"
    count = arguments.environments
    parts = [
        f"Made by `tools/bench model-card` ({computed}): {len(designs)} bodies that no pretraining "
        f"draws (`/v1/held-out`, "
        f"seed{'s' if len(seeds) > 1 else ''} {', '.join(map(str, seeds))}), rollouts of "
        f"{physics['n_steps']} steps with the "
        f"{'physics of the paper' if 'integrator' in physics else 'default physics'}. "
        "A score is the distance to the light at the end "
        "divided by that at the start: 1 is standing still, 0 is reaching it. The mean is over "
        "bodies; its confidence interval comes from resampling the bodies.",
        f"**By size of the body**, {len(environments)} environments of the training's "
        f"distribution:",
        records.table(("size", ) + head, [line("all", usual), *by_size(designs, usual)]),
        "**The paper's test set**, ten environments:",
        records.table(("", ) + head, [line("all", paper)]),
        f"**By roughness of the terrain** (σ of its heights), {count} lights 0.4 to 2 m away each:",
        records.table(("σ", ) + head, by_value(SIGMAS_M, by_rough, count, "m", TRAINED_SIGMA_M)),
        f"**By distance of the light**, {count} environments with σ up to 0.1 m each; the map ends "
        f"2.5 m from the start, and its border's heights continue:",
        records.table(("distance", ) + head,
                      by_value(DISTANCES_M, by_light, count, "m", TRAINED_DISTANCES_M))
    ]
    return metadata(description), "\n\n".join(parts)


def main():
    parser = own_daemon.parser_of("model-card", __doc__)
    parser.add_argument("--controller", type=Path, required=True, help="safetensors file")
    own_daemon.add_options(
        parser, ("--name", str, None, "name of the controller (default: that of the file)"),
        ("--bodies", int, 1000, "held-out bodies (default 1000)"),
        ("--seed", int, 1,
         "seed of the held-out set; each further thousand bodies use the next one (default 1)"),
        ("--environments", int, 8, "number for each roughness and distance, 1 to 8; twice as many "
         "for the sizes (default 8)"), own_daemon.ROLLOUT_STEPS, own_daemon.LIMIT,
        ("--markdown", Path, None, "page (default data/controllers/NAME.md)"))
    arguments = parser.parse_args()
    if not 1 <= arguments.environments <= 8 or not 1 <= arguments.bodies <= 10000:
        sys.exit("--environments must be 1 to 8, --bodies 1 to 10000")
    arguments.name = arguments.name or re.sub(r"[^a-z0-9._-]+", "-",
                                              arguments.controller.stem.lower())[:64].strip("-._")
    arguments.deadline = Deadline(arguments.limit_s)
    page = arguments.markdown or own_daemon.SOURCE / "data" / "controllers" / f"{arguments.name}.md"
    file, scores = card(arguments)
    records.put_between(page, "model-card-file", file, PAGE.format(name=arguments.name))
    records.put_between(page, "model-card-scores", scores)
    print(scores)
    return 0


if __name__ == "__main__":
    sys.exit(main())
