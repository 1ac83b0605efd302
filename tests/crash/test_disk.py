"""A full disk, a folder that cannot be written: clear refusals, no damage, and work continues when
there is room."""
import contextlib
import os
import pathlib
import shutil
import sqlite3
import subprocess
import time

import pytest
import requests
from daemon import MORPHOD, PATIENCE_S, Daemon, bodies, stored_scores
from surroundings import fill

PHYSICS = {"n_steps": 100}
FULL = (503, 507)  # statuses


def rows_of(daemon, job):
    with contextlib.closing(sqlite3.connect(f"file:{daemon.state}/morphod.db?mode=ro",
                                            uri=True)) as db:
        return db.execute("SELECT id FROM jobs WHERE id=?", [job]).fetchall()


@pytest.fixture(name="one")
def daemon_on_small_disk(small_disk):
    """A daemon with its state, but not its log, on the small disk. Tests start it."""
    one = Daemon(small_disk / "d", small_disk.parent)
    yield one
    one.close()


def test_full_disk(one, small_disk, seed):
    one.start()
    before = one.score({"designs": bodies(seed, 5), "physics": PHYSICS})
    old = one.score({"designs": bodies(seed, 5), "physics": PHYSICS, "record": ["com"]})["id"]
    filler = fill(small_disk)
    refusals = 0
    accepted = []
    for k in range(8):
        reply = one.evaluate({"designs": bodies(seed + 100 + k, 200), "physics": PHYSICS},
                         key=f"full {k}")
        if reply.status_code in (200, 202):
            accepted.append(
                reply.json()["id"])  # the write-ahead log still had a few free pages
            continue
        assert reply.status_code in FULL, reply.text
        assert reply.headers["Content-Type"].startswith("application/problem+json")
        assert "Retry-After" in reply.headers
        assert "space" in reply.text or "full" in reply.text or "room" in reply.text, reply.text
        refusals += 1
    assert refusals > 0
    assert one.process.poll() is None, one.tail()
    assert one.get("/healthz").status_code == 200
    # Stored data can be read all the time.
    assert one.get(f"/v1/evaluations/{before['id']}").json()["results"] == before["results"]
    # Jobs that have ended can be deleted as well; their rows are removed when there is space.
    assert requests.delete(f"{one.address}/v1/jobs/{old}").status_code == 200
    assert one.get(f"/v1/jobs/{old}").status_code == 404
    filler.unlink()
    request = {"designs": bodies(seed + 7, 5), "physics": PHYSICS}
    reply = one.until(lambda: one.evaluate(request, key="after"), 20,
                      lambda reply: reply.status_code not in FULL)
    for job in (*accepted, reply.json()["id"]):
        one.succeed(job)
    again = one.score({"designs": bodies(seed, 5), "physics": PHYSICS})
    assert again["results"] == before["results"]
    one.end()
    one.start()
    one.until(lambda: not rows_of(one, old))
    one.end()


def test_full_disk_while_it_computes(one, small_disk, seed):
    """The disk fills up while scores are being saved: the job waits, and ends when there is
    room."""
    one.start()
    job = one.submit({"designs": bodies(seed, 400), "physics": {"n_steps": 80}})
    filler = fill(small_disk)
    one.until(lambda: one.failed_writes() > 0)
    assert one.get("/readyz").status_code == 503
    assert one.process.poll() is None, one.tail()
    assert one.get("/healthz").status_code == 200
    filler.unlink()
    one.succeed(job)
    one.end()
    full = stored_scores(one.state)
    quiet = Daemon(small_disk.parent / "quiet")
    with quiet:
        quiet.score({"designs": bodies(seed, 400), "physics": {"n_steps": 80}})
        assert quiet.stop()[0] == 0
    assert stored_scores(quiet.state) == full


def test_full_disk_while_designs_are_stored(one, small_disk):
    """A large evaluation reports why it waits, and continues when there is room."""
    one.start()
    filler = fill(small_disk)
    request = {"random": {"count": 12_000, "seed": 5}, "physics": {"n_steps": 1},
               "environments": [{"light_xy_m": [4, 3], "terrain_sigma_m": 0, "seed": 1}]}
    reply = one.send("/v1/evaluations", request)
    if reply.status_code == 507:  # no room even for the submission
        filler.unlink()
        reply = one.send("/v1/evaluations", request)
        filler = fill(small_disk)
    job = reply.json()["id"]
    full = one.awaited(f"/v1/jobs/{job}", lambda seen: seen["reason"] or not seen["n_waiting"], 300)
    assert "the disk of the state folder is full" in full["reason"] and full["n_waiting"] > 0
    filler.unlink()
    done = one.awaited(f"/v1/jobs/{job}", lambda seen: seen["state"] == "succeeded", 300)
    assert done["n_waiting"] == 0 and done["reason"] is None
    one.end()


def test_campaigns_wait_on_a_full_disk(one, small_disk, seed):
    """No matter which jobs wait for room and how often they retry, users can pause, cancel and
    read. The reserved room is restored first."""
    reserve = one.state / "reserve"

    def held():
        return reserve.stat().st_size if reserve.exists() else 0

    def campaign(job):
        return one.json(f"/v1/campaigns/{job}")

    def generation(job):
        done = campaign(job)["progress"]["generation"]
        return -1 if done is None else done

    def ask(verb, job, *expected):
        reply = one.send(f"/v1/jobs/{job}/{verb}")
        assert reply.status_code in expected, f"{verb} {job}: {reply.text}\n{one.tail()}"
        assert reply.status_code != 507 or "full" in reply.json()["detail"], reply.text
        return reply.status_code

    one.start()
    first, second, third = jobs = [
        one.submit({"mode": "zero-shot", "population": 64, "generations": 100000,
                    "seed": seed + k, "physics": {"n_steps": 30}, "exclude_pretraining": False},
                   "campaigns") for k in range(3)
    ]
    one.until(lambda: all(generation(job) >= 2 for job in jobs))
    whole = held()
    filler = fill(small_disk)
    one.until(lambda: all("no space" in (campaign(job)["reason"] or "") for job in jobs))
    for k in range(30):  # the log may still have a few free pages
        one.act(first, "pause")
        ask("resume", first, 200, 202, 507)
        time.sleep(0.3)  # the others try again every second, which may free pages again
        if k >= 4 and held() < whole:
            break
    assert one.get("/readyz").status_code == 503
    one.act(second, "cancel")
    assert campaign(second)["state"] == "cancelled"
    one.act(third, "pause")
    assert ask("resume", third, 200, 202, 507) == 507, "the reserved room is not for that"
    one.act(third, "cancel")
    one.act(first, "pause")
    assert one.json("/v1/jobs") and one.json(f"/v1/campaigns/{first}/population")
    assert held() < whole
    filler.unlink()
    one.until(lambda: held() == whole and one.get("/readyz").status_code == 200)
    one.act(first, "resume")
    before = generation(first)
    one.until(lambda: generation(first) > before)
    one.act(first, "cancel")
    one.end()


def test_killed_on_a_full_disk(one, small_disk, seed):
    """Recovery works after a restart: killed on a full disk, it starts again, still without room.
    If other files took the reserved room, it says what to do."""
    reserve = one.state / "reserve"

    def submit():
        return one.evaluate({"designs": bodies(seed + 50, 1), "physics": PHYSICS}).status_code

    one.start()
    before = one.score({"designs": bodies(seed, 5), "physics": PHYSICS})
    jobs = [
        one.submit({"designs": bodies(seed + 1 + k, 200), "physics": {"n_steps": 20000}})
        for k in range(4)
    ]
    whole = reserve.stat().st_size
    filler = fill(small_disk)
    for _ in range(200):  # the log may still have a few free pages
        if submit() in FULL:
            break
    one.act(jobs[0], "cancel")
    for n in range(12):
        one.kill()
        one.start()
        assert one.get("/healthz").status_code == 200
        assert one.get("/readyz").status_code == 503
        assert submit() in FULL
        assert one.get(f"/v1/evaluations/{before['id']}").json()["results"] == before["results"]
        assert one.get(f"/v1/jobs/{jobs[0]}").json()["state"] == "cancelled"
        if n in (4, 8):
            one.act(jobs[n // 4], "cancel")
    assert reserve.stat().st_size == 0
    one.kill()
    for _ in range(20):
        fill(small_disk)
        one.spawn()
        try:
            status = one.process.wait(3)
            break
        except subprocess.TimeoutExpired:  # the log still had a few free pages
            one.kill()
    assert status == 74, one.tail()
    assert "no space" in one.tail() and "free space" in one.tail(), one.tail()
    filler.unlink()
    one.start()
    one.until(lambda: one.get("/readyz").status_code == 200)
    assert reserve.stat().st_size == whole
    one.act(jobs[3], "cancel")
    again = one.score({"designs": bodies(seed, 5), "physics": PHYSICS})
    assert again["results"] == before["results"]
    one.end()


def test_start_on_a_full_disk(one, small_disk, seed):
    filler = fill(small_disk)
    with contextlib.suppress(OSError):
        one.folder.mkdir(exist_ok=True)
    if one.folder.exists():
        one.spawn()
        assert one.process.wait(PATIENCE_S) == 74, one.tail()
        assert "space" in one.tail().lower(), one.tail()
    filler.unlink()
    with one:
        one.score({"designs": bodies(seed, 2), "physics": PHYSICS})
        one.end()


def test_start_on_a_full_disk_of_small_blocks(small_blocks):
    """However little room is left, the start either succeeds or is refused. The process is never
    killed while it writes to mapped memory."""
    one = Daemon(small_blocks / "d", small_blocks.parent, workers=1)
    with one:
        pass  # killed: the next start creates a new index of the log
    statuses = []
    for free in range(0, 80, 4):
        for name in ("reserve", "morphod.db-shm"):  # created again
            (one.state / name).unlink(missing_ok=True)
        filler = fill(small_blocks)
        with open(filler, "r+b") as file:
            os.fsync(file.fileno())
            file.truncate(filler.stat().st_size - free * 1024)
            os.fsync(file.fileno())
        one.spawn()
        one.until(lambda: one.process.poll() is not None or one.port_file.exists())
        statuses.append(one.process.poll())
        one.close()
    assert set(statuses) <= {None, 74}, f"{statuses}\n{one.tail()}"
    assert statuses[0] == 74 and statuses[-1] is None
    filler.unlink()
    with one:
        one.end()


def refuses(state, user=None, words=()):
    """Checks that a start on this state folder ends with 74, and its check with 78."""
    for flag, status in (("--check-config", 78), ("--listen=127.0.0.1:0", 74)):
        command = [str(MORPHOD), flag, f"--state-dir={state}"]
        if user is not None:
            command = ["setpriv", f"--reuid={user}", "--regid=65534", "--clear-groups", *command]
        environment = {k: v for k, v in os.environ.items() if not k.startswith("MORPHOD_")}
        run = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False,
                             env=environment)
        assert run.returncode == status and str(state) in run.stderr, run
        assert not words or words[status == 74] in run.stderr, run


def test_unwritable_state_folder(folder):
    if os.geteuid() == 0 and shutil.which("setpriv") is None:
        pytest.skip("root can write everywhere, and setpriv is missing")
    user = 65534 if os.geteuid() == 0 else None
    os.chmod(folder, 0o755)
    state = pathlib.Path(folder) / "state"
    state.mkdir()
    state.chmod(0o555)
    if user is not None:
        os.chown(state, user, user)
    refuses(state, user, ("cannot be written", "ermission denied"))
    assert list(state.iterdir()) == []


def test_state_folder_is_a_file(folder):
    file = pathlib.Path(folder) / "file"
    file.write_text("x")
    refuses(file)
    assert file.read_text() == "x"
