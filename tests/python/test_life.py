"""The lifetime of a client: forks, copies, event loops, interrupts, and its own services."""

import asyncio
import copy
import io
import multiprocessing
import os
import pathlib
import pickle
import signal
import subprocess
import sys
import textwrap
import threading
import time
import types

import morphod
import numpy as np
import pytest
from morphod import progress
from service import BINARY, BOOTSTRAP, PATIENCE_S, SOURCE, soon, until

SHORT = {"n_steps": 5}
WORLD = [{"light_xy_m": [4.5, 2.5], "terrain_sigma_m": 0.05, "seed": 7}]
LOCAL = {"binary": str(BINARY), "default_controller": str(BOOTSTRAP), "devices": "none",
         "workers": 1}


def script(tmp_path, text, **environment):
    """A process that runs a script."""
    path = tmp_path / "script.py"
    path.write_text(textwrap.dedent(text).replace("LOCAL", repr(LOCAL)))
    return subprocess.Popen(
        [sys.executable, str(path)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
        env=os.environ | {"PYTHONPATH": str(SOURCE / "clients" / "python"), **environment})


# ---- forks ----

def ids_of(job):
    client, bodies = job
    return [client.evaluate([body], WORLD, physics=SHORT).ids[0] for body in bodies]


def test_forked_processes_get_their_own_replies(m):
    bodies = m.random_bodies(24, seed=11)
    right = m.canonical(bodies)
    children = []
    for first in range(0, 24, 6):
        read, write = os.pipe()
        child = os.fork()
        if child == 0:
            try:
                found = ids_of((m, bodies[first:first + 6]))
                m.close()
            except BaseException as error:  # noqa: BLE001
                found = repr(error)
            os.write(write, pickle.dumps(found))
            os._exit(0)
        os.close(write)
        children.append((child, read, right[first:first + 6]))
    assert ids_of((m, bodies)) == right
    for child, read, expected in children:
        with open(read, "rb") as file:
            assert pickle.load(file) == expected
        os.waitpid(child, 0)
    assert ids_of((m, bodies[:3])) == right[:3]


def test_a_forked_process_opens_its_own_stream_of_events(m):
    """Both processes see every event, in order."""
    for n in range(3):
        m.evaluate([[[0, 0, 0]]], WORLD, physics={"n_steps": 5 + n})
    numbers = [int(event["id"]) for event, _ in zip(m.events(after=0), range(9))]
    events = m.events(after=0)
    assert int(next(events)["id"]) == numbers[0]
    child = os.fork()
    if child == 0:
        found = [int(event["id"]) for event, _ in zip(events, range(8))]
        os._exit(found != numbers[1:])
    # If both read one stream, the child has taken all of it by now.
    assert os.waitpid(child, 0)[1] == 0
    assert [int(event["id"]) for event, _ in zip(events, range(8))] == numbers[1:]


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_a_pool_gets_copies_of_a_client(m, method):
    bodies = m.random_bodies(8, seed=12)
    with multiprocessing.get_context(method).Pool(2) as pool:
        found = pool.map_async(ids_of, [(m, bodies[:4]), (m, bodies[4:])]).get(60)
    assert sum(found, []) == m.canonical(bodies)


def refused(client):
    client.evaluation(10**9)


def test_errors_return_from_a_pool(m):
    with multiprocessing.get_context("fork").Pool(1) as pool, pytest.raises(
            morphod.NotFoundError) as caught:
        pool.map_async(refused, [m]).get(60)
    assert caught.value.status == 404 and caught.value.request_id


@pytest.mark.parametrize("error", [
    morphod.MorphodError("a"), morphod.BodyError("b"), morphod.UnreachableError("c"),
    morphod.WaitError("d"), morphod.JobError("e", {"id": "1", "error": {"detail": "f"}}),
    morphod.ApiError(418, {"detail": "g"}),
    morphod.InvalidError(422, {"title": "h", "errors": [{"pointer": "/x", "detail": "i"}]}),
    morphod.ConflictError(409, {"detail": "j", "request_id": "k"}),
], ids=lambda error: type(error).__name__)
def test_errors_can_be_copied(error):
    for again in (pickle.loads(pickle.dumps(error)), copy.deepcopy(error), copy.copy(error)):
        assert type(again) is type(error) and str(again) == str(error)
        assert again.__dict__ == error.__dict__


def test_clients_and_objectives_can_be_copied(m):
    objective = m.objective(environments=WORLD, physics=SHORT)
    right = objective(np.ones(144))
    evaluation = m.evaluate([np.ones((6, 6, 4))], WORLD, physics=SHORT)
    for again in (pickle.loads(pickle.dumps([m, objective, evaluation])),
                  copy.deepcopy([m, objective, evaluation])):
        assert again[0].version() == m.version() and again[1](np.ones(144)) == right
        again[2].refresh()
        assert again[2].scores[0] == right
        again[0].close()
    assert m.version()


def test_one_asynchronous_client_in_two_loops_and_a_child(service):
    client = morphod.AsyncClient(f"http://{service.host}:{service.port}")

    async def version():
        return await client.version()

    right = asyncio.run(version())
    assert asyncio.run(version()) == right
    found = []
    threads = [threading.Thread(target=lambda: found.append(asyncio.run(version())))
               for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [right] * 3
    child = os.fork()
    if child == 0:
        os._exit(asyncio.run(version()) != right)
    assert os.waitpid(child, 0)[1] == 0
    assert asyncio.run(version()) == right


def test_the_synchronous_client_in_a_running_loop(m):
    async def cell():
        return m.version()

    assert asyncio.run(cell()) == m.version()


# ---- interrupts ----

LONG = """
    import morphod, numpy as np
    client = morphod.Client({address!r})
    print("ready", flush=True)
    {what}
"""


@pytest.mark.parametrize("what, noun", [
    ("client.evaluate(client.random_bodies(2000, seed=5), physics={'n_steps': 3000})",
     "evaluation"),
    ("client.campaign('zero-shot', preset='demo', generations=100000, replicates=2,"
     " exclude_pretraining=False).wait()", "campaign"),
    ("client.campaign('zero-shot', preset='demo', generations=100000,"
     " exclude_pretraining=False).live()", "campaign"),
])
def test_an_interrupt_names_the_continuing_job(service, m, tmp_path, what, noun):
    address = f"http://{service.host}:{service.port}"
    process = script(tmp_path, LONG.format(address=address, what=what))
    assert process.stdout.readline() == "ready\n"
    until(lambda: len(m.jobs(state="running")))
    # Once it knows the job's id, it has a request that waits, or shows the job's progress.
    if what.endswith(".live()"):
        assert "0 of 100000" in process.stderr.readline()
    else:
        until(lambda: service.metric("morphod_http_requests_in_flight") >= 2)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=PATIENCE_S)
    open_jobs = m.jobs()
    mine = [id for id, state in zip(open_jobs["id"], open_jobs["state"])
            if state in ("queued", "running")]
    try:
        assert process.returncode == -signal.SIGINT or process.returncode == 1
        assert mine
        for id in mine:
            assert f"{noun} {id} continues" in errors and f"morphoctl job cancel {id}" in errors
        traced = errors[errors.index("Traceback"):]  # before it: lines of progress, as many as come
        assert "httpcore" not in traced and traced.count("\n") < 10, errors
    finally:
        for id in mine:
            m.request("POST", f"/v1/jobs/{id}/cancel")


# ---- services of a program ----

def is_alive(pid):
    try:
        return pathlib.Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_an_interrupt_of_the_process_group_leaves_the_service(tmp_path):
    process = script(tmp_path, """
        import morphod, os, signal
        m = morphod.local(**LOCAL)
        try:
            os.killpg(0, signal.SIGINT)
            signal.pause()
        except KeyboardInterrupt:
            pass
        print(m.version(), m._process.pid)
        """)
    out, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, errors
    assert not is_alive(int(out.split()[1]))


def test_a_service_ends_with_its_process_not_with_a_thread(tmp_path):
    """However the process ends, so does its service. A forked child neither ends the service nor
    keeps it running."""
    process = script(tmp_path, """
        import morphod, os, sys, threading, time
        found = []
        thread = threading.Thread(target=lambda: found.append(morphod.local(**LOCAL)))
        thread.start()
        thread.join()
        time.sleep(0.1)  # a service that ended with the thread would end at once
        m = found[0]
        child = os.fork()
        if child == 0:
            m.version()
            sys.exit(0)  # with its functions of atexit
        assert os.waitpid(child, 0)[1] == 0
        child = os.fork()
        if child == 0:
            time.sleep(120)
            os._exit(0)
        print(m.version(), m._process.pid, child, m.state_dir, flush=True)
        time.sleep(120)
        """)
    _, pid, child, state = process.stdout.readline().split()
    assert is_alive(pid) and os.path.isdir(state)
    process.kill()
    process.wait()
    try:
        until(lambda: not is_alive(pid))
        assert is_alive(child)
    finally:
        os.kill(int(child), signal.SIGKILL)
    process.communicate()


def test_a_long_folder_for_temporary_files(tmp_path):
    folder = tmp_path / ("long " * 25)
    folder.mkdir()
    process = script(tmp_path, """
        import morphod
        with morphod.local(**LOCAL) as m:
            print(len(str(m.state_dir)), m.version())
        """, TMPDIR=str(folder))
    out, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0 and int(out.split()[0]) > 130, errors
    assert list(folder.iterdir()) == []


def test_a_copy_of_a_local_client_leaves_the_service():
    with morphod.local(**LOCAL) as m:
        again = pickle.loads(pickle.dumps(m))
        assert type(again) is morphod.Client and again.version() == m.version()
        again.close()
        copy.deepcopy(m).close()
        assert m.version()


def test_a_service_that_is_not_there_is_reported_at_once(tmp_path):
    process = script(tmp_path, f"""
        import morphod
        morphod.Client("unix:{tmp_path}/nothing", retry_s=60).version()
        """)
    with soon():
        line = process.stderr.readline()
    process.kill()
    process.communicate()
    assert f"no reply from {tmp_path}/nothing" in line and "60 s" in line, line


# ---- progress ----

def test_progress_names_the_phase(monkeypatch, capsys):
    preparing = {"state": "running", "phase": "preparing", "progress": {
        "done": 230000, "total": 11500000, "seconds_left": 140.2}}
    assert progress.doing(preparing) == "drawing the pretraining bodies, 2 %, 2:20 left"
    assert progress.doing({"state": "queued", "reason": "no\x1b room"}) == "queued, no\\x1b room"
    assert progress.doing({"state": "succeeded", "phase": "idle", "progress": {}}) == ""
    assert progress.clock(3740) == "1:02:20"
    with progress.Bar("campaign 7", 9, " generations") as bar:
        bar.update(0, 9, progress.doing(preparing))
        bar.update(0, 9, "something else")  # within a few seconds of the last line
        bar.update(9, 9, best=0.5)
    assert capsys.readouterr().err == (
        "campaign 7: 0 of 9, drawing the pretraining bodies, 2 %, 2:20 left\n"
        "campaign 7: 9 of 9, best 0.5\n")
    # On a terminal, tqdm draws the progress if it is installed.
    made = []

    class Tqdm:
        def __init__(self, **given):
            made.append(given)

        def set_description_str(self, text, refresh):
            made.append(text)

        def set_postfix(self, known, refresh):
            made.append(known)

        def refresh(self):
            pass

        close = refresh

    monkeypatch.setitem(sys.modules, "tqdm", types.ModuleType("tqdm"))
    monkeypatch.setitem(sys.modules, "tqdm.auto", types.SimpleNamespace(tqdm=Tqdm))
    terminal = io.StringIO()
    terminal.isatty = lambda: True
    monkeypatch.setattr(sys, "stderr", terminal)
    with progress.Bar("campaign 7", 9, " generations") as bar:
        bar.update(1, 9, progress.doing(preparing), best=None)
    assert made == [{"total": 9, "desc": "campaign 7", "unit": " generations"},
                    "campaign 7: drawing the pretraining bodies, 2 %, 2:20 left", {}]
