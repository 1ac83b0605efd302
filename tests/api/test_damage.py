"""Rows that cannot be read: the lists serve all others and name these, each says so itself, the log has the reason, and nothing stops."""

import contextlib
import hashlib
import json
import re
import shutil
import sqlite3
import subprocess
import time

import pytest
from service import DESIGN, SHORT, await_end
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
    ("jobs", "UPDATE jobs SET state = 4294967296 WHERE id = 1", EVALUATION, "jobs.state is 4294967296"),
    ("jobs", "UPDATE jobs SET priority = -4294967296 WHERE id = 1", EVALUATION, "jobs.priority is -4294967296"),
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
    """Changes rows as no program of ours does; the next start is one after an unclean stop, which checks the database."""
    database = sqlite3.connect(state / "morphod.db")
    database.create_function("version_3", 1, lambda settings: b"\3" + settings[1:])
    database.execute("PRAGMA ignore_check_constraints = ON")
    for statement in sql.split("; "):
        assert database.execute(statement).rowcount > 0, statement
    database.execute("UPDATE meta SET value = 0 WHERE key = 'clean'")
    database.commit()
    database.close()


def finish(service, job):
    return await_end(service, f"/v1/jobs/{job}").json()


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
     "design", "designs.form of row {design} is no design"),
    (DESIGNS, "UPDATE designs SET form = zeroblob(length(form)) WHERE id = (SELECT design FROM genotypes WHERE id = (SELECT min(genotype) FROM set_scores))",
     "design", "designs.form of row {design} is no body"),
    (DESIGNS[1:], "UPDATE genotypes SET bits = x'01' WHERE id = (SELECT min(genotype) FROM set_scores)", "design", "genotypes.bits of row {genotype} is no design"),
    (DESIGNS[1:], "UPDATE set_scores SET bits = x'01' WHERE genotype = (SELECT min(genotype) FROM set_scores)", "design",
     "set_scores.bits of genotype {genotype}, controller 1, physics {physics} and set 1 is no score"),
    (("/v1/controllers",), "INSERT INTO controllers SELECT 99, x'00', size, sensor, nx, ny, nz, n_parameters, metadata, stored_us FROM controllers LIMIT 1; "
     "UPDATE controller_names SET controller = 99 WHERE name = 'training-2'",
     "controller", "controllers.sha256 of row 99 is no hash"),
)


def test_the_default_controller(whole, start, tmp_path):
    """Without it nothing starts; the words say which row."""
    damage(copied(whole, tmp_path), "INSERT INTO controllers SELECT 99, x'00', size, sensor, nx, ny, nz, n_parameters, metadata, stored_us FROM controllers LIMIT 1; "
                                    "UPDATE controller_names SET controller = 99 WHERE name = 'default'")
    with pytest.raises(RuntimeError, match="the controller default cannot be read: controllers.sha256 of row 99 is no hash"):
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
    keys = ("physics", "genotype", "design")
    with contextlib.closing(sqlite3.connect(state / "morphod.db")) as database:
        found = database.execute("SELECT physics, genotype, design FROM set_scores JOIN genotypes ON id = genotype"
                                 " ORDER BY physics DESC, genotype LIMIT 1").fetchone()
        words = words.format(**dict(zip(keys, found)))
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


BITS = "UPDATE genotypes SET bits = x'01' WHERE id = (SELECT {})"
# The damage, what is asked, what it is called, and the words; {0} is what the statement behind them gives.
SINGLE = (
    (BITS.format("min(genotype) FROM evaluation_designs WHERE job = 1"), "/v1/evaluations/1", "Evaluation 1",
     "genotypes.bits of row {0} is no design", "SELECT genotype FROM evaluation_designs WHERE job = 1"),
    ("UPDATE designs SET form = x'00' WHERE id = (SELECT design FROM genotypes WHERE id = (SELECT genotype FROM evaluation_designs WHERE job = 1))",
     "/v1/evaluations/1", "Evaluation 1", "designs.form of row {0} is no design",
     "SELECT design FROM genotypes WHERE id = (SELECT genotype FROM evaluation_designs WHERE job = 1)"),
    ("UPDATE evaluation_designs SET genotype = 99 WHERE job = 1", "/v1/evaluations/1", "Evaluation 1",
     "evaluation_designs.genotype of job 1 is 99, which genotypes has not", None),
    ("DELETE FROM evaluation_designs WHERE job = 1", "/v1/evaluations/1", "Evaluation 1", "evaluation_designs of job 1 has 0 rows, not those from 0 to 0", None),
    ("DELETE FROM evaluation_environments WHERE job = 1 AND position = 5", "/v1/evaluations/1", "Evaluation 1",
     "evaluation_environments of job 1 has 9 rows, not those from 0 to 9", None),
    ("UPDATE scores SET loss = x'01' WHERE environment = 3", "/v1/evaluations/1", "Evaluation 1",
     "scores.loss of genotype {0}, controller 1, physics 1 and environment 3 is no number", "SELECT genotype FROM evaluation_designs WHERE job = 1"),
    ("UPDATE recomputed SET stored = x'01' WHERE environment = 2", "/v1/evaluations/7", "Evaluation 7",
     "recomputed.stored of job 7, position 0 and environment 2 is no number", None),
    ("UPDATE trajectories SET com = x'01'", "/v1/evaluations/7/trajectories/0", "Evaluation 7", "trajectories.com of row 1 has 1 bytes", None),
    ("UPDATE trajectories SET stride = 0", "/v1/evaluations/7/trajectories/0", "Evaluation 7", "trajectories.stride of row 1 is 0", None),
    (BITS.format("min(genotype) FROM training_designs WHERE job = 2"), "/v1/trainings/2/held-out", "Training 2",
     "genotypes.bits of row {0} is no design", "SELECT genotype FROM training_designs WHERE job = 2"),
    ("UPDATE training_checkpoints SET sha256 = x'01' WHERE job = 2", "/v1/trainings/2/checkpoints", "Training 2",
     "training_checkpoints.sha256 of job 2 and step 1 is no hash", None),
    ("UPDATE training_checkpoints SET sha256 = x'01' WHERE job = 2; UPDATE trainings SET result = NULL WHERE job = 2", "/v1/trainings/2/controller",
     "Training 2", "training_checkpoints.sha256 of job 2 and step 1 is no hash", None),
    ("UPDATE campaign_populations SET population = x'0102' WHERE job = 3 AND generation = 1", "/v1/campaigns/3/population", "Campaign 3",
     "campaign_populations.population of row {0} has 2 bytes", "SELECT id FROM campaign_populations WHERE job = 3 AND generation = 1"),
    ("UPDATE campaign_populations SET births = x'' WHERE job = 3 AND generation = 1", "/v1/campaigns/3/designs/0", "Campaign 3",
     "campaigns.n_designs of job 3 is {0}, campaign_populations.births has 4", "SELECT n_designs FROM campaigns WHERE job = 3"),
    ("DELETE FROM campaign_designs WHERE job = 3 AND number = 0", "/v1/campaigns/3/population?generation=0", "Campaign 3",
     "campaign_designs of job 3 has {0} rows, not those from 0 to {0}", "SELECT n_designs - 1 FROM campaigns WHERE job = 3"),
    ("UPDATE campaign_designs SET score = x'01' WHERE job = 3 AND number = 2", "/v1/campaigns/3/phylogeny", "Campaign 3",
     "campaign_designs.score of job 3 and number 2 is no number", None),
    (BITS.format("genotype FROM campaign_designs WHERE job = 3 AND number = 1"), "/v1/campaigns/3/designs/1", "Campaign 3",
     "genotypes.bits of row {0} is no design", "SELECT genotype FROM campaign_designs WHERE job = 3 AND number = 1"),
    ("INSERT INTO campaign_checkpoints VALUES(3, 1, 0, x'01', 7, 1700000000000000)", "/v1/campaigns/3/checkpoints", "Campaign 3",
     "campaign_checkpoints.sha256 of job 3, generation 1 and step 0 is no hash", None),
    ("UPDATE scores SET loss = x'01' WHERE environment = 4", DESIGN, "Design {1}",
     "scores.loss of genotype {0}, controller 1, physics 1 and environment 4 is no number", "SELECT genotype, design FROM evaluation_designs"
     " JOIN genotypes ON id = genotype WHERE job = 1"),
    (BITS.format("min(genotype) FROM evaluation_designs WHERE job = 1"), DESIGN, "Design {1}", "genotypes.bits of row {0} is no design",
     "SELECT genotype, design FROM evaluation_designs JOIN genotypes ON id = genotype WHERE job = 1"),
    ("UPDATE physics SET encoding = x'0901' WHERE id = 1", DESIGN, "Design {0}", "physics.encoding of row 1 cannot be decoded",
     "SELECT design FROM evaluation_designs JOIN genotypes ON id = genotype WHERE job = 1"),
    ("UPDATE environments SET sha256 = x'01' WHERE id = 1", DESIGN, "Design {0}", "environments.sha256 of row 1 is no hash",
     "SELECT design FROM evaluation_designs JOIN genotypes ON id = genotype WHERE job = 1"),
    ("UPDATE environment_set_members SET environment_set = 7 WHERE position = 4", DESIGN, "Design {0}",
     "environment_set_members.environment_set of position 4 is 7, which environment_sets has not",
     "SELECT design FROM evaluation_designs JOIN genotypes ON id = genotype WHERE job = 1"),
    (OTHERS[-1][1], "/v1/controllers/training-2", "Controller training-2", "controllers.sha256 of row 99 is no hash", None),
)


@pytest.fixture(scope="module")
def recorded(whole, tmp_path_factory):
    """The jobs of `whole`, and an evaluation that recorded and computed again, with what was computed."""
    from service import Service
    state = tmp_path_factory.mktemp("recorded")
    with sqlite3.connect(state / "morphod.db") as copy:
        whole[0].backup(copy)
    copy.close()
    shutil.copytree(whole[1], state / "controllers")
    running = Service(state=state)
    evaluation = running.evaluate({"designs": [DESIGN], "physics": SHORT, "verify": True, "record": ["com"]})
    assert evaluation.json()["id"] == "7" and evaluation.json()["state"] == "succeeded", evaluation.body
    form = evaluation.json()["results"][0]["id"]
    running.close()
    with contextlib.closing(sqlite3.connect(state / "morphod.db")) as database:
        copy = sqlite3.connect(state / "copy")
        database.backup(copy)
    yield (copy, whole[1]), form
    copy.close()


@pytest.mark.parametrize("sql, path, name, words, found", SINGLE, ids=[f"{i}-{row[3].split()[0]}" for i, row in enumerate(SINGLE)])
def test_what_belongs_to_one(recorded, start, tmp_path, sql, path, name, words, found):
    """A damaged row of what a job, a design or a controller consists of: the reply and the log say which it is."""
    state = copied(recorded[0], tmp_path)
    if path is DESIGN:
        path = f"/v1/designs/{recorded[1]}"
    with contextlib.closing(sqlite3.connect(state / "morphod.db")) as database:
        values = database.execute(found or "SELECT 0").fetchone()
    name, words = name.format(*values), words.format(*values)
    service = start("--log-format=logfmt", state=state)
    assert service.request("GET", path, headers={"Accept": "*/*"}).status == 200
    damage(state, sql)
    reply = service.request("GET", path, headers={"Accept": "*/*"})
    assert reply.status == 500 and reply.json()["detail"] == f"{name} cannot be read: {words}. The log of the service has the request's id.", reply.body
    line = unclean(service, [reply])[-1]
    assert "level=warning" in line and f"{name} cannot be read: {words}." in line
    assert service.evaluate({"designs": [{"cells": [[0, 0, 0]]}], "physics": {"n_steps": 3}, "environments": [
        {"light_xy_m": [4.5, 2.5], "terrain_sigma_m": 0.05, "seed": 7}]}).json()["state"] == "succeeded"


def test_work_with_a_damaged_row(whole, start, tmp_path):
    """Jobs whose designs cannot be read fail with the row, and the log has it."""
    state = copied(whole, tmp_path)
    damage(state, "UPDATE jobs SET state = 0, finished_us = 0 WHERE id < 4; UPDATE campaigns SET ended = 0, generations = 2 WHERE job = 3; "
                  "UPDATE genotypes SET bits = CAST(id AS BLOB)")
    service = start("--log-format=logfmt", state=state)
    for job, kind in KINDS.items():
        finish(service, job)
        error = service.request("GET", f"/v1/jobs/{job}").json()["error"]
        assert re.search(r": genotypes.bits of row \d+ is no design$", error["detail"]), error
        assert error["detail"] in service.log_text(), kind


@pytest.mark.parametrize("sql", ("UPDATE environment_sets SET id = 0", "UPDATE environment_sets SET n = 65", "UPDATE environment_sets SET n = 0"))
def test_a_named_set(whole, start, tmp_path, sql):
    """Damaged while the service runs: submissions that name it are refused, those with environments of their own are not, and the service stays."""
    service = start(state=copied(whole, tmp_path))
    damage(tmp_path, sql)
    for path, value in (("/v1/evaluations", {"designs": [DESIGN], "physics": {"n_steps": 7}}), ("/v1/campaigns", CAMPAIGN)):
        assert service.request("POST", path, value).status == 500
        reply = service.request("POST", path, {**value, "environments": [{"light_xy_m": [4.5, 2.5], "terrain_sigma_m": 0.05, "seed": 7}]})
        assert reply.status == 202, reply.body
        finish(service, int(reply.json()["id"]))
        assert service.request("GET", f"/v1/jobs/{reply.json()['id']}").json()["state"] == "succeeded"


FLIP = "UPDATE environments SET data = CAST(substr(data, 1, 99) || x'42' || substr(data, 101) AS BLOB) WHERE id = 3"
PAPER_TEST = (
    ("UPDATE environment_sets SET id = 0", "environment_sets.id of row 1"),
    ("UPDATE environment_sets SET n = 65", "environment_sets.n of row 1"),
    ("UPDATE environment_sets SET name = 'pap' || x'ff'", "environment_sets.name of row 1"),
    ("UPDATE environments SET data = x'00' WHERE id = 3", "environments.data of row 3"),
    (FLIP, "environments.data of row 3"),
    ("UPDATE environments SET sha256 = zeroblob(32) WHERE id = 3", "environments.sha256 of row 3"),
    (FLIP + "; UPDATE environments SET sha256 = x'01' WHERE id = 3", "environments.sha256 of row 3, environments.data of row 3"),
    ("UPDATE environment_set_members SET environment = 1 WHERE position = 4", "environment_set_members.environment of set 1 and position 4"),
    ("UPDATE environment_set_members SET environment = 99 WHERE position = 4", "environment_set_members.environment of set 1 and position 4"),
    ("DELETE FROM environment_set_members WHERE position = 4", "environment_set_members.environment of set 1 and position 4"),
    ("UPDATE environment_set_members SET position = 64 WHERE position = 4",
     "environment_set_members.position of set 1, environment_set_members.environment of set 1 and position 4"),
    ("DELETE FROM environment_set_members", "environment_set_members.environment of set 1 and position 0, "),
    ("UPDATE environment_set_members SET environment_set = 7 WHERE position = 4",
     "environment_set_members.environment_set of 1 rows, environment_set_members.environment of set 1 and position 4"),
    ("DELETE FROM environment_sets", "environment_sets.name of row 1"),
)


@pytest.mark.parametrize("sql, rows", PAPER_TEST, ids=[str(i) for i in range(len(PAPER_TEST))])
def test_the_papers_test_set(whole, start, tmp_path, sql, rows):
    """A constant of the code: each start writes again what is damaged, in the same rows, so that stored scores stay its scores."""
    damage(copied(whole, tmp_path), sql)
    service = start("--log-format=logfmt", state=tmp_path)
    lines = [line for line in service.log_text().splitlines() if "paper-test were written again" in line]
    assert len(lines) == 1 and "level=warning" in lines[0] and f'rows="{rows}' in lines[0]
    again = service.evaluate({"designs": [DESIGN], "physics": SHORT}).json()
    assert again["state"] == "succeeded" and again["rollouts_cached"] == 10, again
    assert again["results"] == service.request("GET", "/v1/evaluations/1").json()["results"]
    checked = service.evaluate({"designs": [DESIGN], "physics": SHORT, "verify": True}).json()
    assert checked["state"] == "succeeded" and checked["results"][0]["agrees"] is True, checked
    service.stop()
    damage_free = start("--log-format=logfmt", state=tmp_path)
    assert "paper-test were written again" not in damage_free.log_text()
    design = damage_free.request("GET", f"/v1/designs/{again['results'][0]['id']}").json()
    assert {score["environments"] for orientation in design["orientations"] for score in orientation["scores"]} == {"paper-test"}


def test_a_test_set_of_another_version(whole, start, tmp_path):
    """What a folder calls paper-test keeps that meaning."""
    copied(whole, tmp_path)
    with contextlib.closing(sqlite3.connect(tmp_path / "morphod.db")) as database:
        rows = database.execute("SELECT id, data FROM environments").fetchall()
        for row, data in rows:
            data = data[8:16] + data[:8] + data[16:]
            database.execute("UPDATE environments SET data = ?, sha256 = ? WHERE id = ?", (data, hashlib.sha256(data).digest(), row))
        database.commit()
        rows = database.execute("SELECT * FROM environments").fetchall()
        service = start(state=tmp_path)
        assert service.evaluate({"designs": [DESIGN], "physics": {"n_steps": 6}}).json()["state"] == "succeeded"
        assert "were written again" not in service.log_text() and database.execute("SELECT * FROM environments").fetchall() == rows


def test_an_environment_with_another_hash(whole, start, tmp_path):
    """Nothing is computed in an environment that is not what its scores are filed under."""
    service = start(state=copied(whole, tmp_path))
    damage(tmp_path, FLIP)
    for path, value in POSTS[::2]:
        job = service.request("POST", path, {**value, "physics": {"n_steps": 7}}).json()["id"]
        finish(service, job)
        error = service.request("GET", f"/v1/jobs/{job}").json()["error"]
        assert error["detail"].endswith(": environments.data of row 3 has not the hash environments.sha256"), error


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
