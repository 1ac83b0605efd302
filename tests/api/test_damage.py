"""Rows that cannot be read: the lists serve all others and name these, each says so itself, the log has the reason, and nothing stops."""

import contextlib
import json
import re
import shutil
import sqlite3
import subprocess
import time

import pytest
from service import DESIGN, SHORT
from test_morphoctl import MORPHOCTL

TRAINING = {"kind": "finetune", "steps": 1, "batch": 2, "designs": [DESIGN], "physics": {"n_steps": 8}, "validation": {"every_steps": 0}}
CAMPAIGN = {"mode": "zero-shot", "population": 4, "generations": 1, "physics": {"n_steps": 8}, "exclude_pretraining": False}
POSTS = (("/v1/evaluations", {"designs": [DESIGN], "physics": SHORT}), ("/v1/trainings", TRAINING), ("/v1/campaigns", CAMPAIGN))
EVALUATION, TRAINING_2, CAMPAIGN_3 = 1, 2, 3  # the first of each kind, all of which are damaged; 4, 5, 6 are not

# Table and column, the damage, the job, and the words.
ROWS = (
    ("jobs", "UPDATE jobs SET weight = 0 WHERE id = 1", EVALUATION, "jobs.weight is 0"),
    ("jobs", "UPDATE jobs SET priority = 7 WHERE id = 2", TRAINING_2, "jobs.priority is 7"),
    ("jobs", "UPDATE jobs SET state = 9 WHERE id = 3", CAMPAIGN_3, "jobs.state is 9"),
    ("evaluations", "UPDATE evaluations SET n_designs = 0 WHERE job = 1", EVALUATION, "evaluations.n_designs is 0"),
    ("evaluations", "UPDATE evaluations SET n_environments = 65 WHERE job = 1", EVALUATION, "evaluations.n_environments is 65"),
    ("evaluations", "DELETE FROM evaluations WHERE job = 1", EVALUATION, "evaluations.n_environments is 0"),
    ("physics", "INSERT INTO physics VALUES(99, zeroblob(32), x'0901'); UPDATE evaluations SET physics = 99 WHERE job = 1", EVALUATION,
     "physics.encoding cannot be decoded: version 9, length 2"),
    ("controllers", "INSERT INTO controllers SELECT 99, x'00', size, sensor, nx, ny, nz, n_parameters, metadata, stored_us FROM controllers LIMIT 1; "
     "UPDATE evaluations SET controller = 99 WHERE job = 1", EVALUATION, "controllers.sha256 of its controller is missing or is no hash"),
    ("trainings", "UPDATE trainings SET settings = version_3(settings) WHERE job = 2", TRAINING_2,
     "trainings.settings cannot be decoded: version 3, length {}"),
    ("trainings", "UPDATE trainings SET settings = x'' WHERE job = 2", TRAINING_2, "trainings.settings is missing or empty"),
    ("trainings", "INSERT INTO controllers SELECT 99, x'00', size, sensor, nx, ny, nz, n_parameters, metadata, stored_us FROM controllers LIMIT 1; "
     "UPDATE trainings SET result = 99 WHERE job = 2", TRAINING_2, "controllers.sha256 of its result is no hash"),
    ("campaigns", "UPDATE campaigns SET settings = substr(settings, 1, 100) WHERE job = 3", CAMPAIGN_3,
     "campaigns.settings cannot be decoded: version 2, length 100"),
    ("campaigns", "UPDATE campaigns SET n_environments = -1 WHERE job = 3", CAMPAIGN_3, "campaigns.n_environments is -1"),
    ("campaign_generations", "DELETE FROM campaign_generations WHERE job = 3 AND generation = 1", CAMPAIGN_3,
     "campaign_generations has no generation 1, its last"),
)
KINDS = {EVALUATION: "evaluation", TRAINING_2: "training", CAMPAIGN_3: "campaign"}


def damage(state, sql):
    database = sqlite3.connect(state / "morphod.db")
    database.create_function("version_3", 1, lambda settings: b"\3" + settings[1:])
    database.execute("PRAGMA ignore_check_constraints = ON")
    for statement in sql.split("; "):
        assert database.execute(statement).rowcount > 0, statement
    database.commit()
    database.close()


def finish(service, job):
    until = time.monotonic() + 60
    while service.request("GET", f"/v1/jobs/{job}").json()["state"] not in ("succeeded", "failed", "cancelled"):
        assert time.monotonic() < until
        time.sleep(0.02)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The database of two jobs of each kind, all done."""
    from service import Service
    running = Service()
    for _ in range(2):
        for path, value in POSTS:
            assert running.request("POST", path, value).status == 202
    for job in range(1, 7):
        finish(running, job)
    running.stop()
    database = sqlite3.connect(running.state / "morphod.db")
    copy = sqlite3.connect(tmp_path_factory.mktemp("whole") / "morphod.db")
    with copy:
        database.backup(copy)
    database.close()
    files = running.state / "controllers"
    yield copy, files
    copy.close()
    running.close()


def copied(whole, folder):
    """A state folder with the database of `whole`."""
    with sqlite3.connect(folder / "morphod.db") as copy:
        whole[0].backup(copy)
    copy.close()
    (folder / "controllers").symlink_to(whole[1])
    return folder


def unclean(service, replies):
    """The log's lines of requests that could not do all of their work. A line comes after its reply."""
    until = time.monotonic() + 30
    while not all(f"request={reply.headers['X-Request-Id']} " in service.log_text() for reply in replies):
        assert time.monotonic() < until
        time.sleep(0.01)
    return [line for line in service.log_text().splitlines() if " reason=" in line]


@pytest.mark.parametrize("table, sql, job, words", ROWS, ids=[f"{row[0]}-{i}" for i, row in enumerate(ROWS)])
def test_a_row(whole, start, tmp_path, table, sql, job, words):
    copied(whole, tmp_path)
    size = sqlite3.connect(tmp_path / "morphod.db").execute("SELECT length(settings) FROM trainings WHERE job = 2").fetchone()[0]
    words = words.format(size)
    damage(tmp_path, sql)
    service = start("--log-format=logfmt", state=tmp_path)
    kind, replies = KINDS[job], []

    def get(path):
        replies.append(service.request("GET", path))
        return replies[-1]

    entry = {"id": str(job), "kind": kind, "detail": words}
    lists = [("/v1/jobs", {1, 2, 3, 4, 5, 6} - {job}), (f"/v1/jobs?kind={kind}", {job + 3})]
    lists += [(f"/v1/{kind}s", {job + 3})] if kind != "evaluation" else []
    for path, others in lists:
        page = get(path)
        assert page.status == 200, page.body
        assert {int(item["id"]) for item in page.json()["items"]} == others and page.json()["unreadable"] == [entry], page.body
    # Page by page: it has its place like any other.
    seen, damaged, cursor = [], [], ""
    while cursor is not None:
        page = get(f"/v1/jobs?limit=1{cursor}").json()
        seen += [item["id"] for item in page["items"]]
        damaged += page.get("unreadable", [])
        cursor = None if page["next_cursor"] is None else f"&cursor={page['next_cursor']}"
    assert len(seen) == 5 and damaged == [entry]
    # The log has a line for each list, as a warning.
    lines = unclean(service, replies)
    assert len(lines) == len(lists) + 1 and all(f'reason="{kind} {job} cannot be read: {words}"' in line for line in lines)
    assert all("level=warning" in line and "status=200" in line for line in lines)
    # Itself, and not as another kind.
    for path in (f"/v1/jobs/{job}", f"/v1/{kind}s/{job}"):
        reply = get(path)
        assert reply.status == 500 and f"{kind.capitalize()} {job} cannot be read: {words}." in reply.json()["detail"], reply.body
        line = unclean(service, replies)[-1]
        assert f"request={reply.json()['request_id']} " in line and "level=warning" in line and words in line
    assert get(f"/v1/{'campaigns' if job != CAMPAIGN_3 else 'trainings'}/{job}").status == 404
    for path in (f"/v1/jobs/{job + 3}", "/metrics", "/readyz"):
        assert get(path).status == 200
    # The command line.
    command = [MORPHOCTL, {"evaluation": "job", "training": "train", "campaign": "campaign"}[kind], "list", "--server", service.addresses[0]]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert shown.stderr == f"morphoctl: {kind} {job} cannot be read by the server: {words}\n" and re.search(rf"^ *{job + 3} ", shown.stdout, re.M)
    page = json.loads(subprocess.run([*command, "--json"], capture_output=True, text=True, timeout=60, check=True).stdout)
    assert page["unreadable"] == [entry] and str(job + 3) in [item["id"] for item in page["items"]]
    shown = subprocess.run([MORPHOCTL, "job", "show", str(job), "--server", service.addresses[0]], capture_output=True, text=True, timeout=60, check=False)
    assert shown.returncode == 1 and words in shown.stderr
    # Work goes on.
    assert service.evaluate({"designs": [DESIGN], "physics": {"n_steps": 7}}).json()["state"] == "succeeded"


def test_work_that_cannot_be_read(start, tmp_path):
    """Jobs that are to run and cannot be read fail with the reason; others run; many of them have room in the log line."""
    first = start("--max-campaigns=1", "--max-trainings=1", state=tmp_path)
    for path, value in POSTS:
        value = {**value, "physics": {"n_steps": 9}}
        for _ in range(5):
            reply = first.request("POST", path, value)
            assert reply.status == 202
            assert first.request("POST", f"/v1/jobs/{reply.json()['id']}/pause").status in (200, 409)
    first.stop()
    damage(tmp_path, "UPDATE jobs SET state = 0, finished_us = 0; UPDATE trainings SET settings = x'77' WHERE job < 10; "
                     "UPDATE campaigns SET settings = x'78' WHERE job < 15; UPDATE evaluations SET n_designs = 0 WHERE job < 5")
    service = start("--log-format=logfmt", state=tmp_path)
    for job in (5, 10, 15):
        finish(service, job)
        assert service.request("GET", f"/v1/jobs/{job}").json()["state"] == "succeeded"
    until = time.monotonic() + 60
    while len(service.request("GET", "/v1/jobs?state=failed").json().get("unreadable", [])) < 12:
        assert time.monotonic() < until, service.log_text()
        time.sleep(0.1)
    reply = service.request("GET", "/v1/jobs?state=failed")
    page = reply.json()
    assert page["items"] == [] and [int(one["id"]) for one in page["unreadable"]] == [n for n in range(14, 0, -1) if n % 5 != 0]
    line = unclean(service, [reply])[-1]
    log = service.log_text()
    assert "campaign 14 cannot be read: campaigns.settings cannot be decoded: version 120, length 1; campaign 13" in line and re.search(r"; and \d+ more", line)
    for kind in ("training", "campaign"):
        assert re.search(rf"an attempt of a job failed.*the job cannot be read: {kind}s.settings cannot be decoded", log)
    assert service.request("POST", "/v1/jobs/6/resume").status == 500  # asked for, and what became of it cannot be shown
    for path in ("steps", "validations", "checkpoints", "controller"):
        reply = service.request("GET", f"/v1/trainings/6/{path}")
        assert reply.status == 500 and "trainings.settings" in reply.json()["detail"], reply.body
    for path in ("generations", "learning", "replicates", "population", "champions", "phylogeny", "checkpoints"):
        reply = service.request("GET", f"/v1/campaigns/11/{path}")
        assert reply.status == 500 and "campaigns.settings" in reply.json()["detail"], reply.body
    assert service.request("GET", "/v1/evaluations/1/trajectories/0").status == 500


def test_a_job_of_another_kind(whole, start, tmp_path):
    """A training that its job calls an evaluation is in no list of trainings; all others are."""
    damage(copied(whole, tmp_path), "UPDATE jobs SET kind = 0 WHERE id IN (2, 3)")
    service = start(state=tmp_path)
    for kind, damaged in (("training", TRAINING_2), ("campaign", CAMPAIGN_3)):
        for query in ("", "?state=succeeded"):
            page = service.request("GET", f"/v1/{kind}s{query}")
            assert page.status == 200 and [int(item["id"]) for item in page.json()["items"]] == [damaged + 3], page.body
    page = service.request("GET", "/v1/jobs").json()
    assert len(page["items"]) == 4 and {int(one["id"]) for one in page["unreadable"]} == {TRAINING_2, CAMPAIGN_3}


DESIGNS = "/v1/designs", "/v1/designs?sort=score"
OTHERS = (
    (DESIGNS, "UPDATE designs SET form = x'00' WHERE id = (SELECT design FROM genotypes WHERE id = (SELECT min(genotype) FROM set_scores))",
     "design", "designs.form is no design"),
    (DESIGNS, "UPDATE designs SET form = zeroblob(length(form)) WHERE id = (SELECT design FROM genotypes WHERE id = (SELECT min(genotype) FROM set_scores))",
     "design", "designs.form is no body"),
    (DESIGNS[1:], "UPDATE genotypes SET bits = x'01' WHERE id = (SELECT min(genotype) FROM set_scores)", "design", "genotypes.bits is no design"),
    (DESIGNS[1:], "UPDATE set_scores SET bits = x'01' WHERE genotype = (SELECT min(genotype) FROM set_scores)", "design", "set_scores.bits is no score"),
    (("/v1/controllers",), "INSERT INTO controllers SELECT 99, x'00', size, sensor, nx, ny, nz, n_parameters, metadata, stored_us FROM controllers LIMIT 1; "
     "UPDATE controller_names SET controller = 99 WHERE name = 'training-2'",
     "controller", "controllers.sha256 is no hash"),
)


def test_the_default_controller(whole, start, tmp_path):
    """Without it nothing starts; the words say which row."""
    damage(copied(whole, tmp_path), "INSERT INTO controllers SELECT 99, x'00', size, sensor, nx, ny, nz, n_parameters, metadata, stored_us FROM controllers LIMIT 1; "
                                    "UPDATE controller_names SET controller = 99 WHERE name = 'default'")
    with pytest.raises(RuntimeError, match="the controller default cannot be read: controllers.sha256 is no hash"):
        start(state=tmp_path)


@pytest.mark.parametrize("paths, sql, kind, words", OTHERS, ids=[str(i) for i in range(len(OTHERS))])
def test_a_design_or_controller(whole, start, tmp_path, paths, sql, kind, words):
    """Lists serve all others and name it, whole and page by page; work goes on."""
    state = copied(whole, tmp_path)
    if kind == "design":  # with the default physics, by which designs are sorted
        (state / "controllers").unlink()
        shutil.copytree(whole[1], state / "controllers")
        first = start(state=state)
        for cells in ([[0, 0, 0]], [[0, 0, 0], [1, 0, 0]], [[0, 0, 0], [0, 0, 1]]):
            assert first.evaluate({"designs": [{"cells": cells}]}).json()["state"] == "succeeded"
        first.stop()
        sql = sql.replace("FROM set_scores)", "FROM set_scores WHERE physics = (SELECT max(physics) FROM set_scores))")
    service = start(state=state)
    before = {path: service.request("GET", path).json()["items"] for path in paths}
    service.stop()
    damage(state, sql)
    service = start("--log-format=logfmt", state=state)
    for path in paths:
        reply = service.request("GET", path)
        page = reply.json()
        assert reply.status == 200 and len(before[path]) > 2 and len(page["items"]) == len(before[path]) - 1, reply.body
        assert all(item in before[path] for item in page["items"])
        entry = {"id": page["unreadable"][0]["id"], "kind": kind, "detail": words}
        assert page["unreadable"] == [entry] and (kind == "design" or entry["id"] == "training-2")
        assert f'reason="{kind} {entry["id"]} cannot be read: {words}"' in unclean(service, [reply])[-1]
        seen, damaged, cursor = [], [], ""
        while cursor is not None:
            one = service.request("GET", f"{path}{'&' if '?' in path else '?'}limit=1{cursor}").json()
            seen += one["items"]
            damaged += one.get("unreadable", [])
            cursor = None if one["next_cursor"] is None else f"&cursor={one['next_cursor']}"
        assert seen == page["items"] and damaged == [entry]
    command = [MORPHOCTL, kind, "list", *(["--sort", "score"] if "score" in paths[-1] else []), "--server", service.addresses[0]]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert f"{kind} {entry['id']} cannot be read by the server: {words}" in shown.stderr
    assert service.evaluate({"designs": [DESIGN], "physics": {"n_steps": 6}}).json()["state"] == "succeeded"


@pytest.mark.parametrize("sql", ("UPDATE environment_sets SET id = 0", "UPDATE environment_sets SET n = 65", "UPDATE environment_sets SET n = 0"))
def test_a_named_set(whole, start, tmp_path, sql):
    """Submissions that name it are refused, those with environments of their own are not, and the service stays."""
    damage(copied(whole, tmp_path), sql)
    service = start(state=tmp_path)
    for path, value in (("/v1/evaluations", {"designs": [DESIGN], "physics": {"n_steps": 7}}), ("/v1/campaigns", CAMPAIGN)):
        assert service.request("POST", path, value).status == 500
        reply = service.request("POST", path, {**value, "environments": [{"light_xy_m": [4.5, 2.5], "terrain_sigma_m": 0.05, "seed": 7}]})
        assert reply.status == 202, reply.body
        finish(service, int(reply.json()["id"]))
        assert service.request("GET", f"/v1/jobs/{reply.json()['id']}").json()["state"] == "succeeded"


def test_json_that_is_none(start, tmp_path):
    """Texts that go into replies as they are stored: replies stay JSON, and say what was not."""
    first = start(state=tmp_path)
    for n_steps in (8, 9):
        assert first.evaluate({"designs": [DESIGN], "physics": {"n_steps": n_steps}}).status == 200
    first.stop()
    damage(tmp_path, "UPDATE events SET data = '{\"id\":' WHERE sequence % 2 = 1; UPDATE events SET data = '7' WHERE sequence = 2; "
                     "UPDATE events SET data = '{\"a\":\"x' || CAST(x'ff' AS TEXT) || '\"}' WHERE sequence = 4; "
                     "UPDATE events SET data = json_object('a', printf('%.*c', 504, 'x')) WHERE sequence = 6; UPDATE controllers SET metadata = '}'")
    service = start(state=tmp_path)
    events = service.request("GET", "/v1/events?format=json&after=0").json()["items"]
    assert len(events) > 5 and events[0]["data"] == {"unreadable": "events.data is not JSON"}
    assert events[1]["data"] == {"unreadable": "events.data is no object"}
    assert events[3]["data"] == {"a": "x\ufffd"} and events[5]["data"] == {"unreadable": "events.data is too long"}
    with contextlib.closing(service.connection()) as connection:
        connection.request("GET", "/v1/events?after=0", headers={"Accept": "text/event-stream"})
        lines = (line.decode() for line in connection.getresponse())
        data = json.loads(next(line for line in lines if line.startswith("data: "))[len("data: "):])
    assert data["data"] == events[0]["data"]
    for path in ("/v1/controllers", "/v1/controllers/default"):
        reply = service.request("GET", path, headers={"Accept": "application/json"}).json()
        for one in reply.get("items", [reply]):
            assert one["metadata"] == {"unreadable": "controllers.metadata is not JSON"}
    assert service.evaluate({"designs": [DESIGN], "physics": SHORT}).json()["state"] == "succeeded"
