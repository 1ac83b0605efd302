"""Values that no writer of the store writes: lists keep to the contract, and name the row in `unreadable` where they cannot tell the value."""

import contextlib
import sqlite3

import pytest
from service import DESIGN, SHORT
from test_damage import POSTS, finish

JOBS, TRAININGS, CAMPAIGNS, DESIGNS = ("/v1/jobs", "/v1/jobs?kind=training"), ("/v1/jobs", "/v1/trainings"), ("/v1/jobs", "/v1/campaigns"), ("/v1/designs",)
LISTS = {
    "jobs": (*JOBS, "/v1/trainings", "/v1/campaigns"), "evaluations": JOBS, "trainings": TRAININGS, "campaigns": CAMPAIGNS, "physics": JOBS,
    "training_steps": TRAININGS, "training_validations": TRAININGS, "training_checkpoints": TRAININGS, "training_code": TRAININGS,
    "campaign_generations": CAMPAIGNS, "environment_sets": CAMPAIGNS, "controllers": ("/v1/controllers",), "controller_names": ("/v1/controllers",),
    "events": ("/v1/events?format=json&after=0&limit=1000",),
    "designs": (*DESIGNS, "/v1/designs?sort=score"), "genotypes": ("/v1/designs?sort=score",), "set_scores": ("/v1/designs?sort=score",),
}
ALONE = {"controllers": "/v1/controllers/default", "controller_names": "/v1/controllers/default", "trainings": "/v1/trainings/2", "campaigns": "/v1/campaigns/3"}
VALUES = {"INTEGER": (-1, 0, 1 << 33, 1 << 62, -(1 << 62)), "REAL": (-1.0, 0.0, 1e308, float("inf")), "TEXT": ("", "x\1y", "A b" * 100)}
# What must not pass: these show that the damage is seen.
NAMED = ("jobs.created_us", "jobs.started_us", "jobs.label", "evaluations.controller_name", "trainings.checkpoints_kept", "trainings.name",
         "campaigns.replicates", "campaigns.generations", "campaign_generations.diversity", "controllers.sensor", "controllers.nx",
         "controller_names.controller", "controller_names.stored_us", "designs.first_seen_us", "environment_sets.name",
         "events.time_us", "events.job", "events.type")


@pytest.fixture(scope="module")
def served():
    from service import Service
    service = Service()
    for path, value in POSTS:
        finish(service, service.request("POST", path, value).json()["id"])
    assert service.evaluate({"designs": [DESIGN, {"cells": [[0, 0, 0]]}], "physics": SHORT}).json()["state"] == "succeeded"
    with contextlib.closing(sqlite3.connect(service.state / "morphod.db", isolation_level=None)) as database:
        database.execute("PRAGMA ignore_check_constraints = ON")
        yield service, database
    service.close()


def count(page):
    return len(page["items"]) + len(page.get("unreadable", []))


@pytest.mark.parametrize("table", LISTS)
def test_lists_keep_to_the_contract(served, table):
    service, database = served
    whole = {path: service.request("GET", path).json() for path in LISTS[table]}
    rows = database.execute(f"SELECT * FROM {table}").fetchall()
    columns = database.execute(f"PRAGMA table_info({table})").fetchall()
    # Another row than before is another matter, but for a name that has none.
    elsewhere = {row[3] for row in database.execute(f"PRAGMA foreign_key_list({table})")} - ({"controller"} if table == "controller_names" else set())
    places = ",".join("?" * len(columns))
    named = set()
    for _, column, kind, not_null, _, key in columns:
        for value in (*VALUES.get(kind, ()), *(() if not_null else (None,))):
            if key or column in elsewhere:
                continue
            try:
                database.execute(f"UPDATE {table} SET {column} = ?", (value,))
            except sqlite3.IntegrityError:
                continue
            for path in LISTS[table]:
                reply = service.request("GET", path)  # and holds it against the contract
                assert reply.status == 200, reply.body
                if (table, column) != ("jobs", "kind"):  # of which some of these lists are
                    assert count(reply.json()) == count(whole[path]), (column, value)
                named.update(f"{table}.{column}" for one in reply.json().get("unreadable", []) if f"{table}.{column}" in one["detail"])
            if table in ALONE:
                reply = service.request("GET", ALONE[table], headers={"Accept": "application/json"})
                assert reply.status == 200 or "cannot be read: " in reply.json()["detail"], reply.body
            database.execute("BEGIN")
            database.execute(f"DELETE FROM {table}")
            database.executemany(f"INSERT INTO {table} VALUES({places})", rows)
            database.execute("COMMIT")
    assert {path: service.request("GET", path).json() for path in LISTS[table]} == whole
    assert {name for name in NAMED if name.split(".")[0] == table} <= named
