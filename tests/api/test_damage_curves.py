"""Damaged numbers in curves (steps, validations, generations, learning, replicates): pages name the row and go on behind it, a CSV goes without it."""

import contextlib
import sqlite3
import subprocess

import pytest
from service import DESIGN, Service
from test_damage import finish, unclean
from test_damage_values import VALUES
from test_morphoctl import MORPHOCTL

PHYSICS = {"n_steps": 8}
TRAINING = {"kind": "finetune", "steps": 4, "batch": 2, "designs": [DESIGN], "physics": PHYSICS,
            "validation": {"every_steps": 1, "designs": 2, "environments": 1}}
CAMPAIGN = {"mode": "few-shot", "population": 4, "generations": 3, "replicates": 2, "physics": PHYSICS, "exclude_pretraining": False,
            "learning": {"parent_steps": 2, "child_steps": 1, "batch": 2}}
# Path, the row that is damaged, its kind, id and place.
CURVES = {
    "training_steps": ("/v1/trainings/1/steps", "job = 1 AND step = 2", "step", "2", "job 1 and step 2"),
    "training_validations": ("/v1/trainings/1/validations", "job = 1 AND step = 2", "validation", "2", "job 1 and step 2"),
    "campaign_generations": ("/v1/campaigns/2/generations", "job = 2 AND generation = 1", "generation", "1", "job 2 and generation 1"),
    "campaign_steps": ("/v1/campaigns/2/learning", "job = 2 AND generation = 1 AND step = 2", "step", "1.2", "job 2 and step 2 of generation 1"),
}
FLAGS = {"skipped", "on_children", "exhausted", "collapse"}
BOUNDED = {"rate", "clipped_share", "clipped_robots_share", "seconds", "diversity", "turnover"}  # of the real numbers


@pytest.fixture(scope="module")
def served():
    service = Service("--log-format=logfmt")
    assert service.request("POST", "/v1/trainings", TRAINING).json()["id"] == "1"
    assert service.request("POST", "/v1/campaigns", CAMPAIGN).json()["id"] == "2"
    for job in (1, 2, 3):
        assert finish(service, job)["state"] == "succeeded"
    with contextlib.closing(sqlite3.connect(service.state / "morphod.db", isolation_level=None)) as database:
        yield service, database
    service.close()


@contextlib.contextmanager
def damaged(database, table, where, column, value):
    """One number of a row is another as long as this lasts."""
    before = database.execute(f"SELECT {column} FROM {table} WHERE {where}").fetchone()[0]
    assert database.execute(f"UPDATE {table} SET {column} = ? WHERE {where}", (value,)).rowcount == 1
    try:
        yield
    finally:
        database.execute(f"UPDATE {table} SET {column} = ? WHERE {where}", (before,))


def is_bounded(kind, column):
    return column in BOUNDED if kind == "REAL" else column not in FLAGS


def csv_of(service, path):
    reply = service.request("GET", path, headers={"Accept": "text/csv"})
    assert reply.status == 200 and reply.headers["Content-Type"].startswith("text/csv")
    return reply, reply.body.decode().splitlines()


@pytest.mark.parametrize("table", CURVES)
def test_damaged_numbers(served, table):
    service, database = served
    path, where, kind, id_, place = CURVES[table]
    whole, whole_csv = service.request("GET", path).json(), csv_of(service, path)[1]
    assert len(whole["items"]) > 3 and len(whole_csv) == len(whole["items"]) + 1
    n_named = 0
    for _, column, type_, not_null, _, key in database.execute(f"PRAGMA table_info({table})").fetchall():
        for value in (*VALUES[type_], *(() if not_null else (None,))):
            if key:
                continue
            with damaged(database, table, where, column, value):
                reply = service.request("GET", path)  # and holds it against the contract
                page, (csv_reply, lines) = reply.json(), csv_of(service, path)
            others = [item for item in page["items"] if item in whole["items"]]
            assert len(others) >= len(whole["items"]) - 1 and page["next_after"] == whole["next_after"]
            if "unreadable" not in page:
                assert len(lines) == len(whole_csv) and len(page["items"]) == len(whole["items"])
                assert value != -1 or not is_bounded(type_, column), column
                continue
            assert is_bounded(type_, column), column
            assert len(page["unreadable"]) == 1 and page["items"] == others and set(lines) < set(whole_csv) and len(lines) == len(whole_csv) - 1
            words = {key: text for key, text in page["unreadable"][0].items() if key != "detail"}
            assert words == {"kind": kind, "id": id_} and page["unreadable"][0]["detail"].startswith(f"{table}.{column} of {place} is ")
            if value == -1:
                n_named += 1
                assert page["unreadable"][0]["detail"].endswith(" is -1")
                for each in (reply, csv_reply):
                    line = next(line for line in unclean(service, [each]) if each.headers["X-Request-Id"] in line)
                    assert "level=warning" in line and f"{kind} {id_} cannot be read: {table}.{column} of {place} is -1" in line
    assert n_named >= 2 and service.request("GET", path).json() == whole


@pytest.mark.parametrize("table", CURVES)
def test_pages_go_on_behind_damage(served, table):
    service, database = served
    path, where, _, id_, _ = CURVES[table]
    whole = service.request("GET", path).json()["items"]
    seen, after = [], ""
    with damaged(database, table, where, "rollouts" if table == "training_validations" else "seconds", -1):
        for _ in whole:
            page = service.request("GET", f"{path}?limit=1{after}").json()
            assert len(page["items"]) + len(page.get("unreadable", [])) == 1
            seen += page["items"] + [one["id"] for one in page.get("unreadable", [])]
            after = f"&after={page['next_after']}"
        assert service.request("GET", f"{path}?limit=1{after}").json()["items"] == []
    assert [a == b or b == id_ for a, b in zip(whole, seen)] == [True] * len(whole) and seen.count(id_) == 1


def test_replicates_without_a_generation(served):
    """What one campaign's generation cannot say is left out; if no other has it, the generation is."""
    service, database = served
    path = "/v1/campaigns/2/replicates"
    whole, whole_csv = service.request("GET", path).json(), csv_of(service, path)[1]
    assert [row["campaigns"] for row in whole["items"]] == [2] * 4
    with damaged(database, "campaign_generations", "job = 3 AND generation = 1", "diversity", 7.0):
        page, lines = service.request("GET", path).json(), csv_of(service, path)[1]
        one = {"id": "1", "kind": "generation", "detail": "campaign_generations.diversity of job 3 and generation 1 is 7"}
        assert page["unreadable"] == [one] and page["next_after"] == whole["next_after"]
        assert [row["campaigns"] for row in page["items"]] == [2, 1, 2, 2] and len(lines) == len(whole_csv)
        assert page["items"][1]["diversity"]["most"] <= 1
        with damaged(database, "campaign_generations", "job = 2 AND generation = 1", "species", -1):
            page, lines = service.request("GET", path).json(), csv_of(service, path)[1]
            assert len(page["unreadable"]) == 2 and [row["generation"] for row in page["items"]] == [0, 2, 3]
            assert lines == whole_csv[:2] + whole_csv[3:]
    assert service.request("GET", path).json() == whole


def test_a_training_whose_newest_rows_are_damaged(served):
    """It is read: of its newest step and validation nothing is known."""
    service, database = served
    whole = service.request("GET", "/v1/trainings/1").json()
    assert whole["progress"]["mean_loss"] is not None and whole["validation"]["step"] == 4
    with damaged(database, "training_steps", "step = 4", "diverged", (1 << 33) + 5), damaged(database, "training_validations", "step = 4", "diverged", -1):
        now = service.request("GET", "/v1/trainings/1").json()
        assert now["validation"] is None and now["progress"]["mean_loss"] is None and now["progress"]["diverged"] == 0
    assert service.request("GET", "/v1/trainings/1").json() == whole


def test_morphoctl_goes_on_behind_a_damaged_page(served):
    """A whole page of rows that cannot be read does not end a curve."""
    service, database = served
    database.execute("BEGIN")
    before = database.execute("SELECT * FROM training_steps").fetchall()
    validations = database.execute("SELECT * FROM training_validations").fetchall()
    columns = ",".join(row[1] for row in database.execute("PRAGMA table_info(training_steps)").fetchall() if row[1] not in ("job", "step"))
    database.execute("DELETE FROM training_validations")
    database.execute(f"WITH RECURSIVE n(i) AS (SELECT 5 UNION ALL SELECT i + 1 FROM n WHERE i < 1100) INSERT INTO training_steps(job, step, {columns}) "
                     f"SELECT job, i, {columns} FROM training_steps, n WHERE step = 1")
    database.execute("UPDATE training_steps SET rate = -1 WHERE step <= 1050")
    database.execute("COMMIT")
    address = f"http://{service.host}:{service.port}"
    shown = subprocess.run([MORPHOCTL, "--server", address, "train", "show", "1"], capture_output=True, text=True, timeout=30, check=True).stdout
    database.execute("BEGIN")
    for table, rows in (("training_steps", before), ("training_validations", validations)):
        database.execute(f"DELETE FROM {table}")
        database.executemany(f"INSERT INTO {table} VALUES({','.join('?' * len(rows[0]))})", rows)
    database.execute("COMMIT")
    assert "1100" in shown, shown
