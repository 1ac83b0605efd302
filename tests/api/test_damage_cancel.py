"""Jobs that cannot be read, and how people get rid of them: they can be cancelled, and their checkpoints deleted."""

import contextlib
import re
import sqlite3
import subprocess
import time

import pytest
from test_damage import CAMPAIGN, CAMPAIGN_3, KINDS, ROWS, TRAINING_2, copied, damage, unclean, whole  # noqa: F401
from test_morphoctl import MORPHOCTL

PAUSE = "UPDATE jobs SET state = 2, finished_us = 0 WHERE id < 4"
# What of a job's own row cannot be read; that of its state must come behind the pause.
CASES = [(sql, job, words) for _, sql, job, words in ROWS] + [
    ("UPDATE jobs SET kind = 9 WHERE id = 2", TRAINING_2, "jobs.kind is 9"),
    ("UPDATE jobs SET state = -1 WHERE id = 1", 1, "jobs.state is -1"),
    ("UPDATE jobs SET state = 9, kind = 9 WHERE id = 2", TRAINING_2, "jobs.kind is 9"),
]


def value(state, sql):
    with contextlib.closing(sqlite3.connect(state / "morphod.db")) as database:
        return database.execute(sql).fetchone()[0]


def metric(service, name):
    return int(re.search(rf"^{name} (\d+)", service.request("GET", "/metrics").body.decode(), re.M)[1])


@pytest.mark.parametrize("sql, job, words", CASES, ids=[f"{i}-{row[2].split()[0]}" for i, row in enumerate(CASES)])
def test_a_paused_job(whole, start, tmp_path, sql, job, words):  # noqa: F811
    copied(whole, tmp_path)
    words = words.format(value(tmp_path, "SELECT length(settings) FROM trainings WHERE job = 2"))
    damage(tmp_path, PAUSE + "; " + sql)
    service = start("--log-format=logfmt", state=tmp_path)
    # Nothing else can be done with it, and the words say why. (Where the damage is not of the job as such, that is done and cannot be shown.)
    for verb in ("pause", "resume"):
        if "campaign_generations" not in words and "of its result" not in words:
            reply = service.request("POST", f"/v1/jobs/{job}/{verb}")
            assert reply.status == 500 and words in reply.json()["detail"], reply.body
    before = value(tmp_path, "SELECT max(sequence) FROM events")
    reply = service.request("DELETE", f"/v1/jobs/{job}")
    is_readable = service.request("GET", f"/v1/jobs/{job}").status == 200
    assert is_readable == (sql.startswith("UPDATE jobs SET state") and "kind" not in sql)
    assert reply.status == (200 if is_readable else 204), reply.body
    if is_readable:
        assert reply.json()["state"] == "cancelled"
    else:
        assert f"{words}" in unclean(service, [reply])[-1]
    assert value(tmp_path, f"SELECT state FROM jobs WHERE id = {job}") == 5
    events = service.request("GET", f"/v1/events?format=json&after={before}").json()["items"]
    assert [event["type"] for event in events] == ["job.finished"] and events[0]["job"] == str(job)
    assert events[0]["data"] == {"id": str(job), "state": "cancelled", **({} if "kind" in sql else {"kind": KINDS[job]})}
    again = service.request("DELETE", f"/v1/jobs/{job}")
    if "kind" not in sql:
        assert again.status == 409 and "it is cancelled" in again.json()["detail"], again.body
    # It is no more work that is open, and the others are as they were.
    assert metric(service, "morphod_rollouts_open") == (0 if job == 1 else 10)
    for other in {1, 2, 3} - {job}:
        assert service.request("DELETE", f"/v1/jobs/{other}").json()["state"] == "cancelled"
    assert metric(service, "morphod_rollouts_open") == 0


@pytest.mark.parametrize("sql, words", (("UPDATE campaigns SET settings = x'78' WHERE job = 3", "campaigns.settings cannot be decoded: version 120, length 1"),
                                        ("DELETE FROM campaign_generations WHERE job = 3 AND generation = 1", "campaign_generations has no generation 1, its last")))
def test_a_paused_campaign(whole, start, tmp_path, sql, words):  # noqa: F811
    """By its own path; then its checkpoints."""
    damage(copied(whole, tmp_path), PAUSE + "; INSERT INTO campaign_checkpoints VALUES(3, 1, 0, zeroblob(32), 7, 1700000000000000); " + sql)
    service = start("--log-format=logfmt", state=tmp_path)
    assert service.request("POST", "/v1/trainings/3/cancel").status == 404
    assert service.request("POST", "/v1/campaigns/2/cancel").status == 404
    reply = service.request("POST", "/v1/campaigns/3/cancel")
    assert reply.status == 204 and words in unclean(service, [reply])[-1]
    reply = service.request("POST", "/v1/campaigns/3/cancel")
    assert reply.status == 409 and "it is cancelled" in reply.json()["detail"], reply.body
    reply = service.request("DELETE", "/v1/campaigns/3/checkpoints")
    assert reply.status == 200 and reply.json() == {"removed": [{"generation": 1, "step": 0}], "bytes": 7}, reply.body


def test_the_checkpoints_of_a_training(whole, start, tmp_path):  # noqa: F811
    damage(copied(whole, tmp_path), PAUSE + "; UPDATE trainings SET settings = x'77' WHERE job = 2")
    service = start(state=tmp_path)
    shown = subprocess.run([MORPHOCTL, "job", "cancel", "2", "1", "--server", service.addresses[0]], capture_output=True, text=True, timeout=60, check=True)
    assert shown.stdout == "job 1 is cancelled\n", shown
    assert shown.stderr == "job 2 is cancelled; the server cannot read it: morphoctl job show 2 says why\n", shown
    reply = service.request("DELETE", "/v1/trainings/2/checkpoints")
    assert reply.status == 200 and len(reply.json()["removed"]) == 1, reply.body
    assert value(tmp_path, "SELECT count(*) FROM training_checkpoints WHERE job = 2") == 0


@pytest.mark.parametrize("sql", ("state = 9", "kind = 9", "weight = 0"))
def test_a_running_campaign(start, tmp_path, sql):
    """Its row is damaged while it runs: it ends all the same."""
    service = start(state=tmp_path)
    job = service.request("POST", "/v1/campaigns", {**CAMPAIGN, "generations": 100000}).json()["id"]
    until = time.monotonic() + 30
    while metric(service, "morphod_campaigns_running") != 1 or value(tmp_path, f"SELECT generation FROM campaigns WHERE job = {job}") < 1:
        assert time.monotonic() < until
        time.sleep(0.02)
    damage(tmp_path, f"UPDATE jobs SET {sql} WHERE id = {job}")
    assert service.request("DELETE", f"/v1/jobs/{job}").status == (200 if sql == "state = 9" else 204)
    while metric(service, "morphod_campaigns_running") != 0:
        assert time.monotonic() < until
        time.sleep(0.02)
    assert value(tmp_path, f"SELECT state FROM jobs WHERE id = {job}") == 5


LARGEST = (1 << 63) - 1


@pytest.mark.parametrize("column, number", (("version", LARGEST), ("version", -LARGEST), ("attempts", LARGEST), ("attempts", -LARGEST)))
def test_a_number_that_is_counted_on(whole, start, tmp_path, column, number):  # noqa: F811
    """One more does not fit: a job that is to run runs or fails all the same, and a paused one can be cancelled."""
    damage(copied(whole, tmp_path), f"UPDATE jobs SET {column} = {number}; UPDATE jobs SET state = 2, finished_us = 0 WHERE id < 4; "
                                    "UPDATE jobs SET state = 0, finished_us = 0 WHERE id > 3")
    service = start(state=tmp_path)
    for job in (1, 2, 3):
        reply = service.request("DELETE", f"/v1/jobs/{job}")
        assert reply.status == (200 if column == "version" else 204), reply.body
        assert value(tmp_path, f"SELECT state FROM jobs WHERE id = {job}") == 5
    until = time.monotonic() + 30
    while value(tmp_path, "SELECT count(*) FROM jobs WHERE state < 3") != 0:
        assert time.monotonic() < until, service.log_text()
        time.sleep(0.05)
    ended = value(tmp_path, "SELECT group_concat(state) FROM jobs WHERE id > 3")
    assert ended == ("4,4,4" if (column, number) == ("attempts", LARGEST) else "3,3,3"), service.log_text()
    for job in (4, 5, 6):
        assert service.request("GET", f"/v1/jobs/{job}").status == 200
