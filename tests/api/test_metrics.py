"""The gauges of running jobs in /metrics."""

import re

from service import SHORT, until

PLATES = [{"cells": [[x, y, 0] for x in range(width) for y in range(depth)]}
          for width in range(1, 7) for depth in range(1, 7)]
LABEL = 'two "words", a \\ and\na line \x07 è'
LONG = {
    "campaign": {"mode": "zero-shot", "population": 8, "generations": 100000,
                 "physics": {"n_steps": 100}, "exclude_pretraining": False, "label": LABEL},
    "training": {"kind": "finetune", "designs": PLATES[:2], "steps": 100000, "batch": 2,
                 "physics": SHORT, "validation": {"every_steps": 0}},
    "evaluation": {"designs": PLATES, "physics": {"n_steps": 20000}, "priority": "batch"},
}


def gauges(service):
    """The gauges of running jobs: {id: {name: value}}, and {id: (kind, label)}."""
    text = service.request("GET", "/metrics").body.decode()
    values, labels = {}, {}
    for name, id, kind, label, value in re.findall(
            r'^morphod_job_(\w+)\{id="(\d+)",kind="(\w+)",label="((?:[^"\\]|\\[\\n"])*)"\} (\S+)$',
            text, re.M):
        values.setdefault(id, {})[name] = float(value)
        labels[id] = kind, re.sub(r"\\(.)", lambda m: "\n" if m[1] == "n" else m[1], label)
    return values, labels


def test_running_jobs(start):
    service = start()
    ids = {kind: service.post(f"/v1/{kind}s", value)["id"] for kind, value in LONG.items()}
    whole = {"progress_ratio", "parts_done", "parts", "rollouts_per_second", "left_seconds"}

    def told():
        values, labels = gauges(service)
        done = [whole <= set(values.get(id, {})) for id in ids.values()]
        return all(done) and "best_score" in values[ids["campaign"]] and (values, labels)

    values, labels = until(told)
    assert labels == {id: (kind, LABEL if kind == "campaign" else "") for kind, id in ids.items()}
    for id, seen in values.items():
        assert ("best_score" in seen) == (id == ids["campaign"])
        assert 0 <= seen["parts_done"] < seen["parts"] and seen["left_seconds"] > 0
        share = seen["parts_done"] / seen["parts"]
        part = 1 / seen["parts"] if id == ids["campaign"] else 0
        assert share - 1e-9 <= seen["progress_ratio"] <= share + part + 1e-9
    campaign = service.get(f"/v1/campaigns/{ids['campaign']}")
    rows = service.pages(f"/v1/campaigns/{ids['campaign']}/generations")
    best = [row["score"]["quantiles"]["p0"] for row in rows]
    assert values[ids["campaign"]]["best_score"] in best
    assert values[ids["campaign"]]["parts"] == 100001
    assert values[ids["campaign"]]["parts_done"] <= campaign["progress"]["under_way"]
    training = service.get(f"/v1/trainings/{ids['training']}")["progress"]
    assert values[ids["training"]]["parts"] == 100000
    assert values[ids["training"]]["parts_done"] <= training["step"] + 1
    assert values[ids["evaluation"]]["parts"] == 10 * len(PLATES)
    for id in ids.values():
        assert service.act(id, "pause").status == 200
    until(lambda: gauges(service) == ({}, {}))


def test_only_so_many(start):
    """The heaviest, and the newest of those that weigh the same."""
    service = start("--max-campaigns=40")
    first = int(service.post("/v1/campaigns", LONG["campaign"] | {"replicates": 40})["id"])
    ids = [str(id) for id in range(first, first + 40)]
    until(lambda: len(service.pages("/v1/jobs?state=running")) == 40)
    until(lambda: set(gauges(service)[0]) == set(ids[8:]))
    service.post(f"/v1/jobs/{ids[0]}/weight", {"weight": 1.5})
    service.post(f"/v1/jobs/{ids[20]}/weight", {"weight": 0.5})
    assert set(gauges(service)[0]) == {ids[0], *ids[8:20], *ids[21:]}
