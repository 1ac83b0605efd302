"""Orderly stops and reloads."""
import ctypes
import json
import os
import re
import signal
import socket
import subprocess
import time

import pytest
from daemon import BUILD, MORPHOCTL, PATIENCE_S, STOP_S, bodies, check_database

LONG = {"n_steps": 1000}


def saturate(daemon, seed):
    job = daemon.submit({"designs": bodies(seed, 600), "physics": LONG})
    daemon.awaited(f"/v1/jobs/{job}", lambda now: now["rollouts_done"] > 0)
    return job


def test_sigterm_while_saturated(daemon, seed):
    """Exit status 0, in time. The work continues at the next start and loses no saved state.
    """
    print(f"seed {seed}")
    one = daemon("stop").start()
    job = saturate(one, seed)
    status, seconds = one.stop()
    assert status == 0, one.tail()
    print(f"stopped after {seconds:.2f} s")
    check_database(one.state)
    one.start()
    before = one.json(f"/v1/jobs/{job}")
    assert before["state"] in ("queued", "running") and before["attempts"] == 0
    assert before["rollouts_done"] > 0
    one.act(job, "cancel")
    assert one.finish(job)["state"] == "cancelled"
    assert one.stop()[0] == 0


def test_second_sigterm_is_quick(daemon, seed):
    one = daemon("quick", drain_timeout="60s").start()
    saturate(one, seed)
    begin = time.monotonic()
    one.process.send_signal(signal.SIGTERM)
    reply = one.until(lambda: one.get("/readyz"), holds=lambda reply: reply.status_code != 200)
    assert reply.status_code == 503 and "Retry-After" in reply.headers
    refused = one.evaluate({"designs": bodies(seed, 1)})
    assert refused.status_code == 503 and "Retry-After" in refused.headers
    assert one.json("/v1/jobs") and one.json("/healthz")
    one.process.send_signal(signal.SIGTERM)
    assert one.process.wait(STOP_S) == 0
    assert time.monotonic() - begin < STOP_S


@pytest.mark.parametrize("number", (signal.SIGTERM, signal.SIGINT))
def test_idle_stop_is_immediate(daemon, number):
    one = daemon("idle", drain_timeout="60s").start()
    one.process.send_signal(number)
    assert one.process.wait(STOP_S) == 0
    assert not one.port_file.exists() and not (one.state / "crash-marker").exists()


def test_logs(daemon, seed):
    """Every line is a record; requests, job transitions and the stop are logged."""
    one = daemon("logs", log_format="json", log_level="debug").start()
    job = one.score(
        {"designs": bodies(seed, 2), "physics": {"n_steps": 50, "control_period_s": 0.016},
         "label": 'a "label"\nwith lines'})["id"]
    one.get("/no/such\x01path\n")
    assert one.stop()[0] == 0
    lines = [json.loads(line) for line in one.log.read_text().splitlines() if line.startswith("{")]
    assert all(line["level"] in ("error", "warning", "info", "debug") and line["time"].endswith("Z")
               for line in lines)
    posted = [line for line in lines if line["msg"] == "request" and line["method"] == "POST"]
    assert len(
        posted) == 1 and posted[0]["path"] == "/v1/evaluations" and posted[0]["status"] == 202
    assert re.fullmatch("[0-9a-f]{16}",
                        posted[0]["request"]) and posted[0]["client"].startswith("127.0.0.1:")
    transitions = [
        line["msg"] for line in lines
        if line.get("job") == int(job) and line["msg"] != "job.progress"
    ]
    assert transitions == ["job.created", "job.started", "job.finished"]
    assert next(line for line in lines if line["msg"] == "job.finished")["state"] == "succeeded"
    assert lines[-1]["msg"] == "stopped" and lines[-1]["work"] == "finished"


def test_sighup_reloads_tokens_and_level(daemon):
    one = daemon("hup", token_on_loopback="yes", config="")
    one.folder.mkdir(parents=True)
    tokens, config = one.folder / "tokens", one.folder / "morphod.conf"
    tokens.write_text("first-token-0123456789\n")
    tokens.chmod(0o600)
    config.write_text(f"token_file = {tokens}\nworkers = 1\n")
    one.settings["config"] = config
    one.settings.pop("log_level")
    one.start()

    def status(token):
        return one.get("/v1/jobs", headers={"Authorization": f"Bearer {token}"}).status_code

    def reload(word):
        seen = one.log.read_text().count(word)
        one.process.send_signal(signal.SIGHUP)
        one.until(lambda: one.log.read_text().count(word) > seen)

    assert one.get("/v1/jobs").status_code == 401
    assert status("first-token-0123456789") == 200
    tokens.write_text("# changed\nsecond-token-0123456789\n")
    config.write_text(f"token_file = {tokens}\nworkers = 2\nlog_level = debug\n")
    reload("reloaded")
    assert status("first-token-0123456789") == 401
    assert status("second-token-0123456789") == 200
    log = one.log.read_text()
    assert "setting=log_level" in log
    assert "needs a restart" in log and "setting=workers" in log
    # A reload with a fault changes nothing.
    config.write_text(f"token_file = {tokens}\nlog_level = loud\n")
    reload("reload failed")
    assert status("second-token-0123456789") == 200
    assert one.stop()[0] == 0


@pytest.mark.skipif(os.uname().machine != "x86_64", reason="the number of a system call")
def test_crash_counts_against_its_job(daemon, seed):
    """A fault inside a block parks its job after three attempts, and affects no other job."""
    libc = ctypes.CDLL(None, use_errno=True)
    one = daemon("crash", workers=1)
    one.start()
    innocent = one.submit({"designs": bodies(seed + 1, 1), "physics": {"n_steps": 100}})
    one.succeed(innocent)
    guilty = one.submit({"designs": bodies(seed, 400), "physics": LONG})
    for attempt in range(3):
        one.awaited(f"/v1/jobs/{guilty}", lambda now: now["state"] == "running")

        def ticks(task):
            with open(f"/proc/{one.process.pid}/task/{task}/stat", encoding="ascii") as file:
                fields = file.read().rsplit(")", 1)[1].split()
            return int(fields[11]) + int(fields[12])

        # The computing thread is soon the one with the most processor time.
        tasks = f"/proc/{one.process.pid}/task"
        _, busiest = one.until(lambda: max((ticks(task), task) for task in os.listdir(tasks)),
                               holds=lambda most: most[0] >= 30)
        assert libc.syscall(234, one.process.pid, int(busiest), int(signal.SIGSEGV)) == 0  # tgkill
        assert one.process.wait(PATIENCE_S) == -signal.SIGSEGV
        marker = (one.state / "crash-marker").read_text()
        assert marker.splitlines()[-1].split()[0] == guilty, marker
        one.start()
        job = one.json(f"/v1/jobs/{guilty}")
        assert job["attempts"] == attempt + 1
    assert job["state"] == "failed" and job["error"] is not None
    one.succeed(innocent)
    one.score({"designs": bodies(seed + 2, 1), "physics": {"n_steps": 100}})
    one.end()


def test_crash_during_a_gradient_counts(daemon, monkeypatch):
    """The same for a fault on the thread that lays out the next robots while a device computes."""
    monkeypatch.setenv("MORPHO_FAKE_FAULT", "1")
    one = daemon("beside", devices="auto",
                 compute_module=BUILD / "tests" / "device" / "fake-device.so")
    one.start()
    request = {
        "kind": "pretrain", "steps": 5, "batch": 32, "physics": {"n_steps": 20}, "device": "cuda"
    }
    guilty = one.submit(request, "trainings")
    assert one.process.wait(PATIENCE_S) == -signal.SIGSEGV
    marker = (one.state / "crash-marker").read_text()
    assert marker.splitlines()[-1].split()[0] == guilty, marker
    monkeypatch.delenv("MORPHO_FAKE_FAULT")
    one.start()
    assert one.json(f"/v1/jobs/{guilty}")["attempts"] == 1
    assert one.stop()[0] == 0


def test_watchdog_and_readiness(daemon):
    """The process notifies the service manager: ready, alive, reloading, stopping."""
    one = daemon("notify")
    one.folder.mkdir(parents=True)
    path = str(one.folder / "notify.sock")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as server:
        server.bind(path)
        server.settimeout(PATIENCE_S)
        one.spawn(NOTIFY_SOCKET=path, WATCHDOG_USEC="1000000")

        def wait_for(word):
            return one.until(lambda: server.recv(4096).decode(),
                             holds=lambda seen: word in seen)

        wait_for("EXTEND_TIMEOUT_USEC=")  # a large database is not a hang
        wait_for("READY=1")
        for _ in range(3):
            wait_for("WATCHDOG=1")
        one.process.send_signal(signal.SIGHUP)
        assert "MONOTONIC_USEC=" in wait_for("RELOADING=1")
        wait_for("READY=1")
        one.process.send_signal(signal.SIGTERM)
        wait_for("STOPPING=1")
    assert one.process.wait(PATIENCE_S) == 0


def test_passed_socket(daemon):
    """A listening socket from the service manager is served instead of the default address."""
    one = daemon("passed")
    one.folder.mkdir(parents=True)
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        command = [c for c in one.command() if not c.startswith("--listen")]
        script = (f"import os, sys; os.dup2({server.fileno()}, 3); os.set_inheritable(3, True); "
                  "os.environ.update(LISTEN_FDS='1', LISTEN_FDNAMES='http', "
                  "LISTEN_PID=str(os.getpid())); os.execv(sys.argv[1], sys.argv[1:])")
        one.spawn(["/usr/bin/python3", "-c", script, *command], [server.fileno()])
        one.await_address()
        assert one.address == f"http://127.0.0.1:{port}"
        assert one.port_file.read_text().count("\n") == 1
        assert one.get("/healthz").status_code == 200
    status = subprocess.run([MORPHOCTL, "status", "--server", one.address], capture_output=True,
                            text=True)
    assert status.returncode == 0, status.stderr
    assert one.stop()[0] == 0
