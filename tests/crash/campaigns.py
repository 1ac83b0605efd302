"""Small campaigns, and what must be the same in every run."""
import csv

MODES = ("zero-shot", "few-shot", "simultaneous")


# For campaigns in which children are cut short: lights near the start, where each step has a large
# effect.
RACE = {
    "population": 10, "generations": 6,
    "physics": {"integrator": "paper", "dt_s": 0.004, "n_steps": 300},
    "environments": [{"light_xy_m": [2.5 + x, 2.5 + y],
                      "terrain_heights_m": [0.02 * ((7 * k + 3 * i) % 5) for k in range(64)]}
                     for i, (x, y) in enumerate(((.11, 0), (0, .11), (.3, .1), (-.3, -.1)))]
}


def request(mode, seed, generations):
    learning = {} if mode == "zero-shot" else {
        "name": "walker",
        "learning": {"parent_steps": 2, "child_steps": 2, "checkpoint_every_s": 1}
    }
    return {
        "mode": mode, "population": 12, "generations": generations, "seed": seed,
        "physics": {"n_steps": 30}, **learning
    }


def without(text, *columns):
    """Returns a CSV without these columns."""
    rows = list(csv.reader(text.splitlines()))
    keep = [i for i, name in enumerate(rows[0]) if name not in columns]
    return [[row[i] for i in keep] for row in rows]


def history(daemon, job):
    """Returns everything that a repeated run must not change."""
    path = f"/v1/campaigns/{job}"

    def table(what):
        return without(daemon.get(f"{path}/{what}?format=csv").text, "seconds", "stored")

    def population(generation):
        items, cursor = [], ""
        while cursor is not None:
            page = daemon.json(f"{path}/population?generation={generation}&limit=1000{cursor}")
            items += [(item["number"], item["genotype"], item["score"]) for item in page["items"]]
            cursor = page["next_cursor"] and f"&cursor={page['next_cursor']}"
        return items

    now = daemon.json(path)
    populations = [population(i) for i in range(now["settings"]["generations"] + 1)]
    return {
        **{what: table(what) for what in ("generations", "learning", "phylogeny")},
        "populations": populations,
        "weights": now["result"] and daemon.result(now["result"]["controller"])
    }


def check_same_lives(raced, whole):
    """Checks two histories, with and without races: they are the same except for children that were
    cut short. Returns the number of these."""
    shown = {"generations": ("children_cut", "children_mean", "rollouts", "cached",
                            "rollouts_diverged"), "phylogeny": ("score", "lower_bound")}
    for table, columns in shown.items():
        head = raced[table][0]
        for one, other in zip(raced[table], whole[table], strict=True):
            assert [x for name, x in zip(head, one) if name not in columns] == [
                x for name, x in zip(head, other) if name not in columns]
    for part in ("learning", "populations", "weights"):
        assert raced[part] == whole[part], f"{part} differ from those without races"
    lives = [[dict(zip(history["phylogeny"][0], row)) for row in history["phylogeny"][1:]]
             for history in (raced, whole)]
    for one, other in zip(*lives):
        assert other["lower_bound"] == "0"
        if one["lower_bound"] == "1":
            assert one["origin_time"] == one["destruction_time"]
            assert float(one["score"]) <= float(other["score"] or "inf")  # diverged
        else:
            assert one["score"] == other["score"]
    return sum(one["lower_bound"] == "1" for one in lives[0])


def undisturbed(daemon, name, value):
    """Runs a campaign without disturbance. Returns its history, rollouts, and work."""
    quiet = daemon(name, workers=2)
    with quiet:
        job = quiet.submit(value, "campaigns")
        quiet.succeed(job, "campaigns", timeout_s=600)
        result = history(quiet, job), rollouts(quiet), work(quiet)
        assert quiet.stop()[0] == 0
    return result


def rollouts(daemon):
    """Returns the rollouts that this process has computed for campaigns."""
    return daemon.counted("morphod_campaign_rollouts_total")


def work(daemon):
    """The same including learning: a step counts as a block of ten rollouts, so that kills hit
    both."""
    return rollouts(daemon) + 10 * daemon.counted("morphod_campaign_learning_steps_total")
