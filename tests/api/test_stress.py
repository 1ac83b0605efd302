"""Settings far outside the range of the physics: non-finite numbers never appear in a reply, the
database or a controller; divergence is reported."""

import json
import math
import sqlite3
import struct

import pytest
from service import BOOTSTRAP, DESIGN

BLOCK = {"voxels": "1" * 144}
DESIGNS = [DESIGN, BLOCK, {"cells": [[x, 2, 0] for x in range(6)]}]
WORLDS = [
    {"light_xy_m": [2.6, 2.5], "terrain_sigma_m": 0.05, "seed": 1},  # inside the block
    {"light_xy_m": [4.0, 2.5], "terrain_sigma_m": 1.0, "seed": 2},
    {"light_xy_m": [1.0, 1.5], "terrain_sigma_m": 0.05, "seed": 3}
]
PAPER = {"integrator": "paper", "dt_s": 0.004}
LONG_STEP = {"dt_s": 0.005, "control_period_s": 0.005}
EVERYTHING = {"stiffness_n_per_m": 60000, "drop_height_m": 10, **LONG_STEP}
PHYSICS = {
    "as it is": {}, "stiffness x4": PAPER | {"stiffness_n_per_m": 60000},
    "dt 5 ms": PAPER | LONG_STEP, "drop from 10 m": PAPER | {"drop_height_m": 10},
    "everything": PAPER | EVERYTHING, "everything, split": EVERYTHING
}
STEPS, BATCH = 2, 6


def parts(file):
    """Returns the header and the numbers of a safetensors file."""
    start = 8 + struct.unpack("<Q", file[:8])[0]
    return file[:start], struct.unpack(f"<{(len(file) - start) // 4}f", file[start:])


def all_finite(numbers):
    return all(map(math.isfinite, numbers))


def plain_json(text):
    """Refuses NaN and Infinity, which Python would accept but JSON does not have."""
    return json.loads(text, parse_constant=lambda word: pytest.fail(f"{word} in {text!r}"))


def learn(service, controller, physics):
    """Runs a short finetuning run, and returns the rows of its curve."""
    request = {
        "kind": "finetune", "controller": controller, "designs": DESIGNS, "steps": STEPS,
        "batch": BATCH, "physics": physics, "schedule": {"kind": "constant", "peak": 0.01},
        "validation": {"every_steps": 1, "environments": 2},
        "checkpoint": {"every_steps": 1, "every_s": 0, "keep": 2}
    }
    training = service.post("/v1/trainings", request)
    while training["state"] not in ("succeeded", "failed"):
        training = plain_json(
            service.request("GET", f"/v1/trainings/{training['id']}",
                            headers={"Prefer": "wait=10"}).body)
    if training["state"] == "succeeded":
        result = service.request("GET", training["links"]["controller"]).body
        assert all_finite(parts(result)[1])
        # A checkpoint with a non-finite moment would not be read.
        assert all_finite(
            parts(service.request("GET",
                                  training["links"]["controller"] + f"?step={STEPS - 1}").body)[1])
    rows = plain_json(service.request("GET", training["links"]["steps"]).body)["items"]
    assert [row["step"] for row in rows] == list(range(1, STEPS + 1))
    for row in rows:
        assert (row["mean_loss"] is None) == (row["diverged"] == BATCH), row
        assert row["skipped"] or row["diverged"] + row["zeroed"] < BATCH, row
    # Nothing was learned unless a step changed a weight.
    assert (training["state"] == "failed") == all(row["skipped"] for row in rows), training
    for row in plain_json(service.request("GET", training["links"]["validations"]).body)["items"]:
        assert row["diverged"] > 0 if row["mean_score"] is None else row["diverged"] < row[
            "rollouts"], row
    return rows


def score(service, controller, physics):
    """Returns the numbers of rollouts that diverged and that did not."""
    evaluation = plain_json(
        service.evaluate({
            "designs": DESIGNS, "environments": WORLDS, "controller": controller, "physics": physics
        }).body)
    assert evaluation["state"] == "succeeded", evaluation
    diverged = 0
    for result in evaluation["results"]:
        shown = {item["environment"]: item["step"] for item in result["diverged"]}
        assert all(1 <= step <= physics["n_steps"] for step in shown.values()), result
        assert (result["score"] is None) == (result["diverged"] != []), result
        assert result["score"] is None or math.isfinite(result["score"]), result
        assert [loss is None
                for loss in result["losses"]] == [k in shown for k in range(len(WORLDS))], result
        diverged += len(result["diverged"])
    return diverged, len(DESIGNS) * len(WORLDS) - diverged


def check_stored(path):
    """Checks every number of the database, after the daemon has ended."""
    database = sqlite3.connect(f"file:{path}?mode=ro", uri=True)
    checked = 0
    for (table, ) in database.execute(
            "SELECT name FROM sqlite_schema WHERE type = 'table' AND name NOT LIKE 'sqlite%'"
    ).fetchall():
        for _, column, kind, *_ in database.execute(f"PRAGMA table_info({table})").fetchall():
            if kind == "REAL":
                values = [
                    value for (value, ) in database.execute(
                        f"SELECT {column} FROM {table} WHERE {column} IS NOT NULL")
                ]
                assert all_finite(values), (table, column)
                checked += len(values)
    for losses, n in database.execute(
            "SELECT losses, length(environments) / 8 FROM scores"
            " JOIN conditions ON id = condition"):
        steps = struct.unpack(f"<{n}I", losses[8 * n:-8] or bytes(4 * n))
        for value, step in zip(struct.unpack(f"<{n}d", losses[:8 * n]), steps):
            assert value == math.inf if step > 0 else math.isfinite(value), (value, step)
            checked += 1
    for (data, ) in database.execute("SELECT data FROM events"):
        plain_json(data)
    database.close()
    return checked


def test_nothing_but_numbers(start, tmp_path):
    service = start(state=tmp_path)
    header, weights = parts(BOOTSTRAP.read_bytes())
    loud = struct.pack(f"<{len(weights)}f", *(100 * weight for weight in weights))
    assert service.upload("loud", header + loud).status == 201
    shown = {}
    for controller in ("default", "loud"):
        for name, changes in PHYSICS.items():
            physics = {"n_steps": 100, **changes}
            rows = learn(service, controller, physics)
            shown[controller, name] = (*score(service, controller, physics),
                                      sum(row["diverged"] for row in rows))
    print(shown)
    assert service.stop() == 0
    # There are cases on both sides of the border: divergence is reported, and the rest has its
    # scores.
    assert shown["default", "as it is"] == (0, 9, 0)
    assert shown["default", "stiffness x4"][0] > 0 and shown["default", "stiffness x4"][2] > 0
    assert check_stored(tmp_path / "morphod.db") > 10 * (len(DESIGNS) * len(WORLDS) + STEPS)
