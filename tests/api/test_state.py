"""The state folder: what of it outlives a start, and what is refused."""

import contextlib
import hashlib
import os
import shutil
import sqlite3
import subprocess

import pytest
from service import BINARY, BOOTSTRAP, DESIGN, SHORT, await_end, tiny_controller

ENVIRONMENT = {key: value for key, value in os.environ.items() if not key.startswith("MORPHOD")}


def test_tags_name_the_store(start, tmp_path):
    """What a client keeps of one store is not taken for what another one has under the same
    numbers."""
    etags = []
    for name in ("one", "other"):
        running = start(state=tmp_path / name)
        evaluation = running.evaluate({"designs": [DESIGN], "physics": SHORT,
                                       "record": ["com"]}).json()
        campaign = running.post(
            "/v1/campaigns", {
                "mode": "zero-shot", "population": 16, "generations": 1, "physics": SHORT,
                "exclude_pretraining": False
            })
        await_end(running, f"/v1/campaigns/{campaign['id']}")
        paths = [
            f"/v1/jobs/{evaluation['id']}", f"/v1/evaluations/{evaluation['id']}",
            f"/v1/evaluations/{evaluation['id']}/trajectories/0",
            f"/v1/campaigns/{campaign['id']}/phylogeny?format=csv",
            f"/v1/campaigns/{campaign['id']}/phylogeny?format=newick"
        ]
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


def refused(path, *names, user=None):
    """What a start on this folder says, which is refused with status 78."""
    command = [
        BINARY, f"--state-dir={path}", "--listen=127.0.0.1:0", "--devices=none",
        f"--default-controller={BOOTSTRAP}"
    ]
    if user is not None:
        command = ["setpriv", f"--reuid={user}", f"--regid={user}", "--clear-groups", *command]
    ended = subprocess.run(command,
                           capture_output=True,
                           text=True,
                           timeout=30,
                           env=ENVIRONMENT,
                           check=False)
    assert ended.returncode == 78, ended
    check = subprocess.run([*command, "--check-config"],
                           capture_output=True,
                           text=True,
                           timeout=30,
                           env=ENVIRONMENT,
                           check=False)
    assert check.returncode == 78, check
    for text in (ended.stderr, check.stderr):
        for name in names:
            assert str(name) in text, text


@pytest.mark.parametrize("mode", (0o770, 0o702, 0o1777))
def test_a_folder_that_others_may_write_to(tmp_path, mode):
    state = tmp_path / "state"
    state.mkdir()
    state.chmod(mode)
    refused(state, state, f"uid {os.geteuid()}", f"{mode:04o}", "chmod go-w")
    assert list(state.iterdir()) == []


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
    """Root may not use it either; and a link is followed if root has made it, as systemd does for a
    dynamic user."""
    for folder in (tmp_path, *tmp_path.parents[:3]):  # xdist has a folder more
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


def test_the_lock_outlives_its_file(start, tmp_path):
    first = start(state=tmp_path / "state")
    (tmp_path / "state" / "lock").unlink()
    ended = subprocess.run(
        [BINARY, f"--state-dir={tmp_path / 'state'}", "--listen=127.0.0.1:0", "--devices=none"],
        capture_output=True,
        text=True,
        timeout=30,
        env=ENVIRONMENT,
        check=False)
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
    """Something is not mounted: nothing is made, nothing is deleted, and the start says what to do.
    """
    state = tmp_path / "state"
    put_files(state, {name: 30, "controllers/.tmp-4": 5})
    state.chmod(0o700)
    if content is not None:
        (state / "morphod.db").write_bytes(content)
    before = tree(state)
    for _ in range(2):
        ended = subprocess.run([
            BINARY, f"--state-dir={state}", "--listen=127.0.0.1:0", "--devices=none",
            f"--default-controller={BOOTSTRAP}"
        ],
                               capture_output=True,
                               text=True,
                               timeout=30,
                               env=ENVIRONMENT,
                               check=False)
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
    if lost == "all of it":  # the log is there still: SQLite would delete it
        shutil.rmtree(state / "controllers")
        database.unlink()
    elif lost == "its end":
        os.truncate(database, 0)
    else:
        (state / "morphod.db-wal").unlink()
    before = tree(state)
    refused_start = start(state=state, wait=False)
    assert refused_start.process.wait(30) == 78 and "lost its database" in refused_start.log_text()
    after = tree(state)
    for part in ("morphod.db-shm", "lock"):
        before.pop(part, None), after.pop(part, None)
    assert after == before


def test_a_folder_of_version_0_1(start, tmp_path):
    state = tmp_path / "state"
    assert start(state=state).stop() == 0
    with contextlib.closing(sqlite3.connect(state / "morphod.db")) as database:
        database.execute("PRAGMA user_version=8")
    before = tree(state)
    old = start(state=state, wait=False)
    assert old.process.wait(30) == 78
    assert "was written by morphod 0.1" in old.log_text() and "empty folder" in old.log_text()
    assert tree(state) == before


def test_a_new_folder_starts(start, tmp_path):
    """Also one in which a first start was killed before the database had its first page."""
    state = tmp_path / "state"
    for name in ("controllers", "trainings/3", "campaigns"):
        (state / name).mkdir(parents=True)
    state.chmod(0o700)
    (state / "morphod.db").write_bytes(b"")
    (state / "controllers/.tmp-0").write_bytes(b"half")
    assert start(state=state).request("GET", "/readyz").status == 200


def clean(state, *flags, text=""):
    return subprocess.run([BINARY, "store", "clean", f"--state-dir={state}", *flags],
                          input=text,
                          capture_output=True,
                          text=True,
                          timeout=60,
                          env=ENVIRONMENT,
                          check=False)


def test_orphans_stay_until_they_are_cleaned(start, tmp_path):
    state = tmp_path / "state"
    running = start(state=state)
    body = tiny_controller(running)
    assert running.request("DELETE", "/v1/controllers/tiny").status == 204
    unused = f"controllers/{hashlib.sha256(body).hexdigest()}.safetensors"
    assert clean(state, "--yes").returncode == 75
    assert running.stop() == 0
    before = tree(state)
    put_files(state, {**FILES, "controllers/.tmp-12": 5, "trainings/9/.tmp-3": 5})
    for _ in range(2):
        running = start(state=state)
        assert running.stop() == 0
        after = tree(state)
        assert {name: len(after[name]) for name in FILES} == FILES
        assert "controllers/.tmp-12" not in after and "trainings/9/.tmp-3" not in after
        line = next(line for line in running.log_text().splitlines() if "nothing refers to" in line)
        assert "files=5" in line and "bytes=150" in line and any(name in line for name in FILES)
    for answer in ("n\n", ""):
        asked = clean(state, text=answer)
        assert asked.returncode == 0 and "Nothing was removed" in asked.stdout, asked
        listed = dict(
            reversed(line.split()) for line in asked.stdout.splitlines() if line.startswith(" "))
        assert {name: int(size) for name, size in listed.items()} == {**FILES, unused: len(body)}
        assert set(tree(state)) == set(after)
    done = clean(state, text="y\n")
    assert done.returncode == 0 and "Removed" in done.stdout, done
    assert {name
            for name in tree(state)
            if "/" in name} == {name
                                for name in before if "/" in name} - {unused}
    assert not (state / "campaigns/x").exists()
    again = clean(state, "--yes")
    assert again.returncode == 0 and again.stdout.startswith("0 files")
    running = start(state=state)
    assert "nothing refers to" not in running.log_text()
    assert running.evaluate({"designs": [DESIGN], "physics": SHORT}).status == 200


def test_clean_makes_no_store(tmp_path):
    assert clean(tmp_path / "missing",
                 "--yes").returncode == 74 and not (tmp_path / "missing").exists()
    tmp_path.chmod(0o700)
    ended = clean(tmp_path, "--yes")
    assert ended.returncode == 74 and "no database" in ended.stderr and not (tmp_path /
                                                                             "morphod.db").exists()
    assert clean(tmp_path, "--nothing").returncode == 64


def test_files_of_unused_controllers(start, tmp_path):
    """A file goes when nothing refers to it, and comes back by another upload."""
    running = start(state=tmp_path / "state")
    body = tiny_controller(running)
    digest = hashlib.sha256(body).hexdigest()
    path = f"/v1/controllers/sha256:{digest}"
    file = tmp_path / "state" / "controllers" / f"{digest}.safetensors"
    used = running.request("DELETE", path)
    assert used.status == 409 and "the name tiny refers to it" in used.json(
    )["detail"] and file.exists()
    assert running.request("DELETE", "/v1/controllers/tiny").status == 204
    assert running.request("DELETE", path).status == 204 and not file.exists()
    for method in ("GET", "DELETE"):
        assert running.request(method, path).status == 404
    assert tiny_controller(running) == body and file.read_bytes() == body
    assert running.request("GET", path + "/file").body == body
    default = running.get("/v1/controllers/default")["sha256"]
    evaluation = running.evaluate({"designs": [DESIGN], "physics": SHORT}).json()["id"]
    assert running.request("PUT",
                           "/v1/controllers/default/file",
                           body=BOOTSTRAP.read_bytes(),
                           headers={"Content-Type": "application/octet-stream"}).status == 200
    assert running.request("PUT",
                           "/v1/controllers/default/file",
                           body=body,
                           headers={"Content-Type": "application/octet-stream"}).status == 200
    assert running.request("DELETE", "/v1/controllers/bootstrap").status == 204
    used = running.request("DELETE", f"/v1/controllers/sha256:{default}")
    assert used.status == 409 and f"evaluation {evaluation} refers to it" in used.json()["detail"]
    for text in ("sha256:", "sha256:" + 63 * "0", "sha256:" + 64 * "g", "sha256:" + 64 * "0"):
        assert running.request("DELETE", f"/v1/controllers/{text}").status == 404


def test_store_check(start, tmp_path):
    """What is sound, what is damaged, and a loss that is another one with a right checksum."""
    state = tmp_path / "state"

    def check(*flags):
        ended = subprocess.run([BINARY, "store", "check", f"--state-dir={state}", *flags],
                               capture_output=True,
                               text=True,
                               timeout=60,
                               env=ENVIRONMENT,
                               check=False)
        return ended.returncode, ended.stdout, ended.stderr

    running = start(state=state)
    assert running.evaluate({"designs": [DESIGN], "physics": SHORT}).status == 200
    assert check()[0] == 75
    assert running.stop() == 0
    for flags, again in ((), 'losses of the class "cpu'), (("--sample=0", ), ""):
        status, printed, _ = check(*flags)
        assert status == 0 and " 0 findings." in printed and again in printed, printed
        assert "1 differ" not in printed
    for wrong in ("--sample=", "--sample=x", "--sample=-1", "--yes"):
        assert check(wrong)[0] == 64, wrong
    with contextlib.closing(sqlite3.connect(state / "morphod.db")) as database:
        database.execute("UPDATE scores SET losses=CAST(x'00'||substr(losses,2) AS BLOB)")
        database.commit()
    status, printed, said = check()
    assert status == 74 and "losses are damaged: scores, genotype 1" in printed, printed
