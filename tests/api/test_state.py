"""The state folder: what survives a restart, and what is refused."""

import contextlib
import hashlib
import os
import shutil
import sqlite3
import subprocess

import pytest
from service import BINARY, BOOTSTRAP, DESIGN, PATIENCE_S, SHORT, run, tiny_controller, until

ENVIRONMENT = {key: value for key, value in os.environ.items() if not key.startswith("MORPHOD")}
START = ("--listen=127.0.0.1:0", "--devices=none", f"--default-controller={BOOTSTRAP}")


def morphod(state, *arguments, user=None, text=""):
    """Runs the program, which must end, and returns the result."""
    command = [BINARY, *arguments, f"--state-dir={state}"]
    if user is not None:
        command = ["setpriv", f"--reuid={user}", f"--regid={user}", "--clear-groups", *command]
    return subprocess.run(command, input=text, capture_output=True, text=True, timeout=300,
                          env=ENVIRONMENT, check=False)


def test_tags_name_the_store(start, tmp_path):
    """Content that a client cached from one store is not mistaken for content of another store
    under the same numbers."""
    etags = []
    for name in ("one", "other"):
        running = start(state=tmp_path / name)
        evaluation = running.evaluate({"designs": [DESIGN], "physics": SHORT, "record": ["com"]})
        campaign = run(running, "campaigns", {
            "mode": "zero-shot", "population": 16, "generations": 1, "physics": SHORT,
            "exclude_pretraining": False
        })
        id, phylogeny = evaluation.json()["id"], campaign["links"]["phylogeny"]
        paths = [f"/v1/jobs/{id}", f"/v1/evaluations/{id}", f"/v1/evaluations/{id}/trajectories/0",
                 phylogeny + "?format=csv", phylogeny + "?format=newick"]
        etags.append({path: running.request("GET", path).headers["ETag"] for path in paths})
        for path in paths:
            for known in etags:
                reply = running.request("GET", path, headers={"If-None-Match": known[path]})
                assert reply.status == (304 if known is etags[-1] else 200), path
    assert etags[0].keys() == etags[1].keys()
    assert running.stop() == 0
    again = start(state=tmp_path / name)
    for path, etag in etags[-1].items():
        assert again.request("GET", path, headers={"If-None-Match": etag}).status == 304, path


def reset_of(service, last):
    """Returns whether the stream after an event begins with a reset."""
    raw, _ = service.raw(b"GET /v1/events HTTP/1.1\r\nHost: localhost\r\n"
                         b"Last-Event-ID: %s\r\n\r\n" % last.encode(), timeout=2)
    page = service.request("GET", f"/v1/events?format=json&after={last}").json()
    assert page["reset"] == (b"event: reset" in raw), (page, raw)
    return page["reset"]


@pytest.mark.parametrize("how", ["database", "folder"])
def test_tags_and_events_name_the_history(start, tmp_path, how):
    """Content newer than a backup is not mistaken for later content after the backup is restored. A
    restart changes nothing."""
    state, backup = tmp_path / "state", tmp_path / "backup"
    work = {"designs": [DESIGN], "physics": SHORT}

    def evaluate(service, steps):
        id = service.evaluate(work | {"physics": {"n_steps": steps}}).json()["id"]
        return f"/v1/jobs/{id}", service.request("GET", f"/v1/jobs/{id}").headers["ETag"]

    first = start(state=state)
    evaluate(first, 20)
    if how == "database":  # while it runs
        with contextlib.closing(sqlite3.connect(state / "morphod.db")) as database:
            database.execute("VACUUM INTO ?", (str(backup), ))
    assert first.stop() == 0
    if how == "folder":
        shutil.copytree(state, backup)
    lost = start(state=state)
    path, etag = evaluate(lost, 21)
    page = lost.request("GET", "/v1/events?format=json&after=0").json()
    events = [event["id"] for event in page["items"]]
    assert lost.stop() == 0
    again = start(state=state)  # a restart
    assert again.request("GET", path, headers={"If-None-Match": etag}).status == 304
    assert not any(reset_of(again, id) for id in (events[0], events[-1]))
    evaluate(again, 22)
    assert again.stop() == 0
    if how == "database":
        shutil.copy(backup, state / "morphod.db")
    else:
        shutil.rmtree(state)
        shutil.copytree(backup, state)
    restored = start(state=state)
    assert evaluate(restored, 23)[0] == path  # the number is reused
    assert restored.request("GET", path, headers={"If-None-Match": etag}).status == 200
    for steps in (24, 25, 26):  # more events than were lost
        evaluate(restored, steps)
    page = restored.request("GET", "/v1/events?format=json&after=0").json()
    assert int(page["newest"]) > int(events[-1]) + 2
    assert not reset_of(restored, events[0])  # an event that the backup has
    assert reset_of(restored, events[-1])


def refused(path, *names, user=None):
    """Checks that both a start on this folder and its check exit with status 78 and mention these
    names."""
    for flags in (START, (*START, "--check-config")):
        ended = morphod(path, *flags, user=user)
        assert ended.returncode == 78, ended
        for name in names:
            assert str(name) in ended.stderr, ended.stderr


@pytest.mark.parametrize("mode", (0o770, 0o702, 0o1777))
def test_a_folder_that_others_may_write_to(tmp_path, mode):
    state = tmp_path / "state"
    state.mkdir()
    state.chmod(mode)
    refused(state, state, f"uid {os.geteuid()}", f"{mode:04o}", "chmod go-w")
    assert list(state.iterdir()) == []


def test_a_database_that_is_cut_short(start, tmp_path):
    """A file truncated by less than a page, which SQLite would fill up; and one without its schema
    number."""
    running = start(state=tmp_path / "state")
    running.evaluate({"designs": [DESIGN], "physics": SHORT})
    assert running.stop() == 0
    file = tmp_path / "state" / "morphod.db"
    whole = file.read_bytes()
    for n in (1, 4095):
        file.write_bytes(whole[:-n])
        ended = morphod(tmp_path / "state", *START)
        assert ended.returncode == 74 and "is truncated" in ended.stderr, ended
    file.write_bytes(whole)
    with contextlib.closing(sqlite3.connect(file)) as database:
        database.execute("PRAGMA user_version=0")
        database.commit()
    ended = morphod(tmp_path / "state", *START)
    assert ended.returncode == 78 and "no schema number" in ended.stderr, ended
    file.write_bytes(whole)
    assert start(state=tmp_path / "state").stop() == 0


@pytest.mark.parametrize("name",
                         ("lock", "reserve", "morphod.db", "morphod.db-wal", "morphod.db-shm",
                          "crash-marker", "controllers", "trainings", "campaigns"))
def test_entries_that_lead_elsewhere(start, tmp_path, name):
    elsewhere = tmp_path / "elsewhere"
    state = tmp_path / "state"
    running = start(state=state)
    assert running.stop() == 0
    entry = state / name
    if entry.exists():
        entry.rename(elsewhere)
    else:
        elsewhere.write_bytes(b"precious")
    before = elsewhere.read_bytes() if elsewhere.is_file() else sorted(elsewhere.iterdir())
    entry.symlink_to(elsewhere)
    refused(state, f"/{name} must be a", f"uid {os.geteuid()}")
    entry.unlink()
    os.mkfifo(entry)
    refused(state, f"/{name} must be a")
    assert (elsewhere.read_bytes()
            if elsewhere.is_file() else sorted(elsewhere.iterdir())) == before


@pytest.mark.skipif(os.geteuid() != 0 or shutil.which("setpriv") is None,
                    reason="only root may give files away")
def test_a_folder_of_somebody_else(start, tmp_path):
    """Root may not use it either. A link is followed if root has made it, as systemd does for a
    dynamic user."""
    for folder in (tmp_path, *tmp_path.parents[:3]):  # xdist has one more folder
        folder.chmod(0o755)
    private, link = tmp_path / "private", tmp_path / "morphod"
    private.mkdir(mode=0o700)
    os.chown(private, 65534, 65534)
    refused(private, private, "uid 65534", "0700", "chown")
    link.symlink_to(private)
    refused(f"{link}/", "uid 65534")
    for owner in (0, 65534, 1):
        os.chown(link, owner, 0, follow_symlinks=False)
        if owner == 1:
            refused(link, link, "symbolic link", "uid 1", user=65534)
            refused(f"{link}/", "symbolic link", user=65534)
        else:
            running = start(state=link, user=65534)
            assert running.evaluate({"designs": [DESIGN], "physics": SHORT}).status == 200
            assert running.stop() == 0
    assert (private / "morphod.db").stat().st_uid == 65534
    os.chown(private / "morphod.db", 1, 1)
    refused(private, "morphod.db", "uid 1", user=65534)


def test_one_folder_has_one_process(start, tmp_path):
    """Also if the lock file is deleted."""
    first = start(state=tmp_path / "state")
    for is_there in (True, False):
        if not is_there:
            (tmp_path / "state" / "lock").unlink()
        ended = morphod(tmp_path / "state", *START)
        assert ended.returncode == 75 and "another process" in ended.stderr, ended
    assert first.request("GET", "/readyz").status == 200


FILES = {
    "controllers/" + 64 * "a" + ".safetensors": 10, "controllers/notes.txt": 20,
    "trainings/7/5.checkpoint": 30, "campaigns/x/y/z": 40, "trainings/1/.tmp-x": 50
}


def put_files(state, names=FILES):
    for name, size in names.items():
        path = state / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(size * b"x")


def tree(state):
    return {
        str(path.relative_to(state)): path.read_bytes()
        for path in state.rglob("*") if path.is_file()
    }


@pytest.mark.parametrize("content", (None, b"", b"x"))
@pytest.mark.parametrize("name", FILES)
def test_files_without_a_database(tmp_path, name, content):
    """Something is not mounted: nothing is created or deleted, and the error says what to do.
    """
    state = tmp_path / "state"
    put_files(state, {name: 30, "controllers/.tmp-4": 5})
    state.chmod(0o700)
    if content is not None:
        (state / "morphod.db").write_bytes(content)
    before = tree(state)
    for _ in range(2):
        ended = morphod(state, *START)
        assert ended.returncode == 78, ended
        for words in (str(state), "lost its database", "morphod.db is missing or empty", "restore",
                      name[:16]):
            assert words in ended.stderr, ended.stderr
        assert {**tree(state), "lock": b""} == {**before, "lock": b""}


@pytest.mark.parametrize("lost", ("all of it", "its end", "what the log held"))
def test_a_database_that_was_lost(start, tmp_path, lost):
    state = tmp_path / "state"
    running = start(state=state)
    running.stop(9 if lost != "its end" else 15)
    database = state / "morphod.db"
    if lost == "all of it":  # the log still exists: SQLite would delete it
        shutil.rmtree(state / "controllers")
        database.unlink()
    elif lost == "its end":
        os.truncate(database, 0)
    else:
        (state / "morphod.db-wal").unlink()
    before = tree(state)
    refused_start = start(state=state, wait=False)
    assert refused_start.process.wait(PATIENCE_S) == 78
    assert "lost its database" in refused_start.log_text()
    after = tree(state)
    for part in ("morphod.db-shm", "lock"):
        before.pop(part, None), after.pop(part, None)
    assert after == before


@pytest.mark.parametrize("version, words", [(8, ("was written by morphod 0.1", "empty folder")),
                                            (13, ("unreleased program", "empty folder")),
                                            (9999, ("newer", ))])
def test_a_folder_of_another_version(start, tmp_path, version, words):
    state = tmp_path / "state"
    assert start(state=state).stop() == 0
    with contextlib.closing(sqlite3.connect(state / "morphod.db")) as database:
        database.execute(f"PRAGMA user_version={version}")
    before = tree(state)
    other = start(state=state, wait=False)
    assert other.process.wait(PATIENCE_S) == 78
    assert all(word in other.log_text() for word in words)
    assert tree(state) == before


def test_a_new_folder_starts(start, tmp_path):
    """Also a folder in which a first start was killed before the database had its first page."""
    state = tmp_path / "state"
    for name in ("controllers", "trainings/3", "campaigns"):
        (state / name).mkdir(parents=True)
    state.chmod(0o700)
    (state / "morphod.db").write_bytes(b"")
    (state / "controllers/.tmp-0").write_bytes(b"half")
    assert start(state=state).request("GET", "/readyz").status == 200


def test_orphans_stay_until_they_are_cleaned(start, tmp_path):
    state = tmp_path / "state"
    running = start(state=state)
    body = tiny_controller(running)
    assert running.request("DELETE", "/v1/controllers/tiny").status == 204
    unused = f"controllers/{hashlib.sha256(body).hexdigest()}.safetensors"
    assert morphod(state, "store", "clean", "--yes").returncode == 75
    assert running.stop() == 0
    before = tree(state)
    put_files(state, {**FILES, "controllers/.tmp-12": 5, "trainings/9/.tmp-3": 5})
    for _ in range(2):
        running = start(state=state)
        assert running.stop() == 0
        after = tree(state)
        assert {name: len(after[name]) for name in FILES} == FILES
        assert "controllers/.tmp-12" not in after and "trainings/9/.tmp-3" not in after
        line = next(line for line in running.log_text().splitlines() if "unused files" in line)
        assert "files=5" in line and "bytes=150" in line and any(name in line for name in FILES)
    for answer in ("n\n", ""):
        asked = morphod(state, "store", "clean", text=answer)
        assert asked.returncode == 0 and "Nothing was removed" in asked.stdout, asked
        listed = dict(
            reversed(line.split()) for line in asked.stdout.splitlines() if line.startswith(" "))
        assert {name: int(size) for name, size in listed.items()} == {**FILES, unused: len(body)}
        assert set(tree(state)) == set(after)
    done = morphod(state, "store", "clean", text="y\n")
    assert done.returncode == 0 and "Removed" in done.stdout, done
    kept = {name for name in before if "/" in name} - {unused}
    assert {name for name in tree(state) if "/" in name} == kept
    assert not (state / "campaigns/x").exists()
    again = morphod(state, "store", "clean", "--yes")
    assert again.returncode == 0 and again.stdout.startswith("0 unused files")
    running = start(state=state)
    assert "nothing refers to" not in running.log_text()
    assert running.evaluate({"designs": [DESIGN], "physics": SHORT}).status == 200


def test_clean_makes_no_store(tmp_path):
    missing = tmp_path / "missing"
    assert morphod(missing, "store", "clean", "--yes").returncode == 74 and not missing.exists()
    tmp_path.chmod(0o700)
    ended = morphod(tmp_path, "store", "clean", "--yes")
    assert ended.returncode == 74 and "no database" in ended.stderr
    assert not (tmp_path / "morphod.db").exists()
    assert morphod(tmp_path, "store", "clean", "--nothing").returncode == 64


def test_files_of_unused_controllers(start, tmp_path):
    """A file is deleted when nothing refers to it, and restored by another upload."""
    running = start(state=tmp_path / "state")

    def delete(controller, status):
        reply = running.request("DELETE", f"/v1/controllers/{controller}")
        assert reply.status == status, reply.body
        return reply.json()["detail"] if status == 409 else None

    body = tiny_controller(running)
    digest = hashlib.sha256(body).hexdigest()
    file = tmp_path / "state" / "controllers" / f"{digest}.safetensors"
    assert "the name tiny refers to it" in delete(f"sha256:{digest}", 409) and file.exists()
    delete("tiny", 204)
    delete(f"sha256:{digest}", 204)
    assert not file.exists()
    running.refuses(f"/v1/controllers/sha256:{digest}", "", status=404)
    delete(f"sha256:{digest}", 404)
    assert tiny_controller(running) == body and file.read_bytes() == body
    again = running.request("GET", f"/v1/controllers/sha256:{digest}/file")
    assert again.body == body
    default = running.get("/v1/controllers/default")["sha256"]
    evaluation = running.evaluate({"designs": [DESIGN], "physics": SHORT}).json()["id"]
    for content in (BOOTSTRAP.read_bytes(), body):
        assert running.upload("default", content).status == 200
    delete("bootstrap", 204)
    assert f"evaluation {evaluation} refers to it" in delete(f"sha256:{default}", 409)
    for text in ("sha256:", "sha256:" + 63 * "0", "sha256:" + 64 * "g", "sha256:" + 64 * "0"):
        delete(text, 404)


def test_store_check(start, tmp_path):
    """An intact store, a damaged one, and one with a different loss and a correct checksum."""
    state = tmp_path / "state"

    def check(*flags):
        ended = morphod(state, "store", "check", *flags)
        return ended.returncode, ended.stdout

    running = start(state=state)
    assert running.evaluate({"designs": [DESIGN], "physics": SHORT}).status == 200
    assert check()[0] == 75
    assert running.stop() == 0
    for flags, again in ((), 'losses of class "cpu'), (("--sample=0", ), ""):
        status, printed = check(*flags)
        assert status == 0 and " 0 findings." in printed and again in printed, printed
        assert "1 differ" not in printed
    for wrong in ("--sample=", "--sample=x", "--sample=-1", "--yes"):
        assert check(wrong)[0] == 64, wrong
    with contextlib.closing(sqlite3.connect(state / "morphod.db")) as database:
        database.execute("UPDATE scores SET losses=CAST(x'00'||substr(losses,2) AS BLOB)")
        database.commit()
    status, printed = check()
    assert status == 74 and "losses are damaged: scores, genotype 1" in printed, printed


def test_a_clock_that_is_not_credible(start, tmp_path):
    """The stored times are moved back by 400 days, as if the clock were wrong: nothing is deleted
    by age, and the service reports this until a user confirms the clock."""
    state = tmp_path / "state"
    flags = ["--keep-evaluations=90d"]
    service = start(*flags, state=state)
    id = service.evaluate({"designs": [DESIGN], "physics": {"n_steps": 2}}).json()["id"]
    assert service.request("GET", "/healthz").json()["notice"] is None
    service.stop()
    with contextlib.closing(sqlite3.connect(state / "morphod.db")) as database, database:
        past = 400 * 86400 * 10**6
        database.execute("UPDATE jobs SET finished_us=finished_us-?", (past, ))
        moved = database.execute("UPDATE meta SET value=value-? WHERE key='credible time'",
                                 (past, ))
        assert moved.rowcount == 1
    for _ in range(2):
        service = start(*flags, state=state)
        until(lambda: service.request("GET", "/healthz").json()["notice"])
        assert "accept-clock" in service.request("GET", "/readyz").json()["notice"]
        assert 399 < service.metric("morphod_clock_ahead_seconds") / 86400 < 401
        assert service.request("GET", f"/v1/jobs/{id}").status == 200
        until(lambda: "the clock is not credible" in service.log_text())
        service.evaluate({"designs": [DESIGN], "physics": {"n_steps": 3}})
        service.stop()
    done = morphod(state, "store", "accept-clock")
    assert done.returncode == 0 and "UTC was accepted" in done.stdout, done
    service = start(*flags, state=state)
    until(lambda: service.request("GET", f"/v1/jobs/{id}").status == 404)
    until(lambda: "old jobs were deleted jobs=1" in service.log_text())
    assert service.request("GET", "/healthz").json()["notice"] is None
