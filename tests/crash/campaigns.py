"""Small campaigns, and what must be the same however often they run."""

MODES = ("zero-shot", "few-shot", "simultaneous")


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
    """A CSV without these columns."""
    rows = [line.split(",") for line in text.splitlines()]
    keep = [i for i, name in enumerate(rows[0]) if name not in columns]
    return [[row[i] for i in keep] for row in rows]


def history(daemon, job):
    """Everything that a repeat must not change."""
    path = f"/v1/campaigns/{job}"

    def table(what):
        return without(daemon.get(f"{path}/{what}?format=csv").text, "seconds", "stored")

    now = daemon.json(path)
    populations = [
        [(item["number"], item["genotype"], item["score"]) for item in
         daemon.json(f"{path}/population?generation={generation}&limit=1000")["items"]]
        for generation in range(now["settings"]["generations"] + 1)
    ]
    return {
        **{what: table(what) for what in ("generations", "learning", "phylogeny")},
        "populations": populations,
        "weights": now["result"] and daemon.result(now["result"]["controller"])
    }


def undisturbed(daemon, name, value):
    """What becomes of a campaign that nothing disturbs: its history, rollouts, and work."""
    quiet = daemon(name, workers=2)
    with quiet:
        job = quiet.submit(value, "campaigns")
        quiet.succeed(job, "campaigns", timeout_s=600)
        result = history(quiet, job), rollouts(quiet), work(quiet)
        assert quiet.stop()[0] == 0
    return result


def rollouts(daemon):
    """What was computed for campaigns in this life."""
    return daemon.counted("morphod_campaign_rollouts_total")


def work(daemon):
    """The same with learning: a step counts as a block of ten rollouts, so that kills find both."""
    return rollouts(daemon) + 10 * daemon.counted("morphod_campaign_learning_steps_total")
