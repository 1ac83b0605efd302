"""A disk that is full, a folder that cannot be written: clear refusals, nothing broken, and on it
goes when there is room."""
import os
import pathlib
import shutil
import subprocess
import time

import pytest
from daemon import MORPHOD, Daemon, bodies, check_database, stored_scores

PHYSICS = {"n_steps": 100}


def fill(path):
    """Takes all room but nothing of what is there; returns the file that does."""
    filler = pathlib.Path(path) / "filler"
    with open(filler, "ab", buffering=0) as file:
        try:
            while True:
                file.write(b"\0" * 65536)
        except OSError:
            pass
        try:
            while True:
                file.write(b"\0" * 512)
        except OSError:
            pass
    return filler


@pytest.fixture(name="one")
def daemon_on_small_disk(small_disk):
    """Its state is on the small disk, what it tells is not. Tests start it."""
    one = Daemon(small_disk + "/d")
    one.log = pathlib.Path(small_disk).parent / "log"
    one.port_file = pathlib.Path(small_disk).parent / "address"
    yield one
    one.close()


def test_full_disk(one, small_disk, seed):
    one.start()
    before = one.score({"designs": bodies(seed, 5), "physics": PHYSICS})
    filler = fill(small_disk)
    refusals = 0
    accepted = []
    for k in range(8):
        reply = one.post({"designs": bodies(seed + 100 + k, 200), "physics": PHYSICS},
                         key=f"full {k}")
        if reply.status_code in (200, 202):
            accepted.append(
                reply.json()["id"])  # the write-ahead log had a few pages of its own left
            continue
        assert reply.status_code in (503, 507), reply.text
        assert reply.headers["Content-Type"].startswith("application/problem+json")
        assert "Retry-After" in reply.headers
        assert "space" in reply.text or "full" in reply.text or "room" in reply.text, reply.text
        refusals += 1
    assert refusals > 0
    assert one.process.poll() is None, one.tail()
    assert one.get("/healthz").status_code == 200
    # What is stored can be read all the while.
    assert one.get(f"/v1/evaluations/{before['id']}").json()["results"] == before["results"]
    filler.unlink()
    until = time.monotonic() + 20
    while True:
        reply = one.post({"designs": bodies(seed + 7, 5), "physics": PHYSICS}, key="after")
        if reply.status_code in (200, 202):
            break
        assert reply.status_code in (503, 507) and time.monotonic() < until, reply.text
        time.sleep(0.2)
    assert one.finish(reply.json()["id"])["state"] == "succeeded"
    for job in accepted:
        assert one.finish(job)["state"] == "succeeded"
    again = one.score({"designs": bodies(seed, 5), "physics": PHYSICS})
    assert again["results"] == before["results"]
    assert one.stop()[0] == 0
    check_database(one.state)


def test_full_disk_while_it_computes(one, small_disk, seed):
    """Room runs out while scores are being saved: the job waits, and ends when there is room."""
    one.start()
    job = one.submit({"designs": bodies(seed, 400), "physics": {"n_steps": 300}})
    filler = fill(small_disk)
    time.sleep(2)
    assert one.process.poll() is None, one.tail()
    assert one.get("/healthz").status_code == 200
    filler.unlink()
    evaluation = one.finish(job)
    assert evaluation["state"] == "succeeded", evaluation
    assert one.stop()[0] == 0
    check_database(one.state)
    full = stored_scores(one.state)
    quiet = Daemon(pathlib.Path(small_disk).parent / "quiet")
    with quiet:
        quiet.score({"designs": bodies(seed, 400), "physics": {"n_steps": 300}})
        assert quiet.stop()[0] == 0
    assert stored_scores(quiet.state) == full


def test_campaigns_wait_on_a_full_disk(one, small_disk, seed):
    """Whatever waits for room, and however often it tries, people can pause, cancel and read; the
    room that is set aside comes back first."""
    reserve = one.state / "reserve"

    def held():
        return reserve.stat().st_size if reserve.exists() else 0

    def generation(job):
        done = one.get(f"/v1/campaigns/{job}").json()["progress"]["generation"]
        return -1 if done is None else done

    def state(job):
        reply = one.get(f"/v1/campaigns/{job}")
        assert reply.status_code == 200, reply.text
        return reply.json()["state"], reply.json()["reason"]

    def ask(verb, job, *expected):
        reply = one.session.post(f"{one.address}/v1/jobs/{job}/{verb}")
        assert reply.status_code in expected, f"{verb} {job}: {reply.text}\n{one.tail()}"
        if reply.status_code == 507:
            assert "full" in reply.json()["detail"], reply.text
        return reply.status_code

    def until(condition, what):
        end = time.monotonic() + 30
        while not condition():
            assert time.monotonic() < end, f"{what}\n{one.tail()}"
            time.sleep(0.05)

    one.start()
    jobs = []
    for k in range(3):
        reply = one.session.post(one.address + "/v1/campaigns",
                                 json={
                                     "mode": "zero-shot", "population": 64, "generations": 100000,
                                     "seed": seed + k, "physics": {"n_steps": 30},
                                     "exclude_pretraining": False
                                 })
        assert reply.status_code == 202, reply.text
        jobs.append(reply.json()["id"])
    until(lambda: all(generation(job) >= 2 for job in jobs), "nothing runs")
    whole = held()
    filler = fill(small_disk)
    until(lambda: all(reason and "no space" in reason for _, reason in map(state, jobs)),
          "no campaign waits")
    first, second, third = jobs
    for k in range(30):  # the log may have a few pages of its own left
        ask("pause", first, 200, 202)
        time.sleep(0.3)
        ask("resume", first, 200, 202, 507)
        time.sleep(0.3)  # the others try again every second
        if k >= 4 and held() < whole:
            break
    assert one.get("/readyz").status_code == 503
    ask("cancel", second, 200, 202)
    assert state(second)[0] == "cancelled"
    ask("pause", third, 200, 202)
    assert ask("resume", third, 200, 202, 507) == 507, "what is set aside is not for that"
    ask("cancel", third, 200, 202)
    ask("pause", first, 200, 202)
    assert one.get("/v1/jobs").status_code == 200 and one.get(
        f"/v1/campaigns/{first}/population").status_code == 200
    assert held() < whole
    filler.unlink()
    until(lambda: held() == whole and one.get("/readyz").status_code == 200, "no room is seen")
    ask("resume", first, 200, 202)
    before = generation(first)
    until(lambda: generation(first) > before, "it does not go on")
    ask("cancel", first, 200, 202)
    assert one.stop()[0] == 0
    check_database(one.state)


def test_killed_on_a_full_disk(one, small_disk, seed):
    """The way out outlives the process: killed on a full disk it starts again, short of room as it
    was; where others took the reserve's room it says what to do."""
    reserve = one.state / "reserve"

    def cancel(job):
        reply = one.session.post(f"{one.address}/v1/jobs/{job}/cancel")
        assert reply.status_code in (200, 202), f"{reply.text}\n{one.tail()}"

    def submit():
        return one.post({"designs": bodies(seed + 50, 1), "physics": PHYSICS}).status_code

    one.start()
    before = one.score({"designs": bodies(seed, 5), "physics": PHYSICS})
    jobs = [
        one.submit({"designs": bodies(seed + 1 + k, 200), "physics": {"n_steps": 20000}})
        for k in range(4)
    ]
    whole = reserve.stat().st_size
    filler = fill(small_disk)
    for _ in range(200):  # the log may have a few pages of its own left
        if submit() in (503, 507):
            break
    cancel(jobs[0])
    for n in range(12):
        one.kill()
        one.start()
        assert one.get("/healthz").status_code == 200
        assert one.get("/readyz").status_code == 503
        assert submit() in (503, 507)
        assert one.get(f"/v1/evaluations/{before['id']}").json()["results"] == before["results"]
        assert one.get(f"/v1/jobs/{jobs[0]}").json()["state"] == "cancelled"
        if n in (4, 8):
            cancel(jobs[n // 4])
    assert reserve.stat().st_size == 0
    one.kill()
    for _ in range(20):
        fill(small_disk)
        one.spawn()
        try:
            status = one.process.wait(3)
            break
        except subprocess.TimeoutExpired:  # the log had a few pages of its own left
            one.kill()
    assert status == 74, one.tail()
    assert "no space" in one.tail() and "make room" in one.tail(), one.tail()
    filler.unlink()
    one.start()
    end = time.monotonic() + 20
    while one.get("/readyz").status_code != 200:
        assert time.monotonic() < end, one.tail()
        time.sleep(0.05)
    assert reserve.stat().st_size == whole
    cancel(jobs[3])
    again = one.score({"designs": bodies(seed, 5), "physics": PHYSICS})
    assert again["results"] == before["results"]
    assert one.stop()[0] == 0
    check_database(one.state)


def test_start_on_a_full_disk(one, small_disk, seed):
    filler = fill(small_disk)
    try:
        one.folder.mkdir(exist_ok=True)
    except OSError:
        pass
    if one.folder.exists():
        one.spawn()
        assert one.process.wait(20) == 74, one.tail()
        assert "space" in one.tail().lower(), one.tail()
    filler.unlink()
    with one:
        one.score({"designs": bodies(seed, 2), "physics": PHYSICS})
        assert one.stop()[0] == 0
    check_database(one.state)


def test_start_on_a_full_disk_of_small_blocks(small_blocks):
    """However little room is left: the start succeeds or is refused, and is never killed while it
    writes to what it has mapped."""
    folder = pathlib.Path(small_blocks)
    one = Daemon(folder / "d", workers=1)
    one.log = folder.parent / "log"
    one.port_file = folder.parent / "address"
    with one:
        pass  # killed: the next start makes a new index of the log
    statuses = []
    for free in range(0, 80, 4):
        for name in ("reserve", "morphod.db-shm"):  # made again
            (one.state / name).unlink(missing_ok=True)
        filler = fill(folder)
        with open(filler, "r+b") as file:
            os.fsync(file.fileno())
            file.truncate(filler.stat().st_size - free * 1024)
            os.fsync(file.fileno())
        one.spawn()
        while one.process.poll() is None and not one.port_file.exists():
            time.sleep(0.01)
        statuses.append(one.process.poll())
        one.close()
    assert set(statuses) <= {None, 74}, f"{statuses}\n{one.tail()}"
    assert statuses[0] == 74 and statuses[-1] is None
    filler.unlink()
    with one:
        assert one.stop()[0] == 0
    check_database(one.state)


def run_check(*flags, user=None):
    command = [str(MORPHOD), "--check-config", *flags]
    if user is not None:
        command = ["setpriv", f"--reuid={user}", "--regid=65534", "--clear-groups", *command]
    return subprocess.run(command,
                          capture_output=True,
                          text=True,
                          timeout=30,
                          env={k: v
                               for k, v in os.environ.items() if not k.startswith("MORPHOD_")})


def test_unwritable_state_folder(folder):
    if os.geteuid() == 0 and shutil.which("setpriv") is None:
        pytest.skip(
            "as root everything can be written, and there is no setpriv to become somebody else")
    user = 65534 if os.geteuid() == 0 else None
    os.chmod(folder, 0o755)
    state = pathlib.Path(folder) / "state"
    state.mkdir()
    state.chmod(0o555)
    if user is not None:
        os.chown(state, user, user)
    check = run_check(f"--state-dir={state}", user=user)
    assert check.returncode == 78 and "cannot be written" in check.stderr, check.stderr
    command = [str(MORPHOD), f"--state-dir={state}", "--listen=127.0.0.1:0"]
    if user is not None:
        command = ["setpriv", f"--reuid={user}", "--regid=65534", "--clear-groups", *command]
    run = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    assert run.returncode == 74, run.stderr
    assert str(state) in run.stderr and "ermission denied" in run.stderr, run.stderr
    assert list(state.iterdir()) == []


def test_state_folder_is_a_file(folder):
    file = pathlib.Path(folder) / "file"
    file.write_text("x")
    assert run_check(f"--state-dir={file}").returncode == 78
    run = subprocess.run([str(MORPHOD), f"--state-dir={file}", "--listen=127.0.0.1:0"],
                         capture_output=True,
                         text=True,
                         timeout=30)
    assert run.returncode == 74, run.stderr
    assert file.read_text() == "x"


def test_newer_database_is_refused(daemon):
    one = daemon("newer")
    with one:
        assert one.stop()[0] == 0
    import sqlite3
    database = sqlite3.connect(one.state / "morphod.db")
    database.execute("PRAGMA user_version = 9999")
    database.commit()
    database.close()
    one.spawn()
    assert one.process.wait(20) == 78
    assert "newer" in one.tail(), one.tail()
