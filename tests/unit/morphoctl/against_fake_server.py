"""morphoctl against a server that misbehaves on demand: repetition, exit statuses, tables, streams.
Speaks TAP.

Usage: against_fake_server.py MORPHOCTL. The real daemon's replies are tested in tests/api."""
import fcntl
import http.server
import json
import os
import pty
import re
import signal
import socketserver
import struct
import subprocess
import sys
import tempfile
import termios
import threading
import time

MORPHOCTL = sys.argv[1]
VOXELS = "1" + "0" * 143
ID = "8" + "0" * 35
JOB = {
    "id": "7", "kind": "evaluation", "state": "succeeded", "priority": "interactive", "label": None,
    "attempts": 0, "error": None, "created_at": "2026-11-21T10:00:00.000Z",
    "started_at": "2026-11-21T10:00:00.000Z", "finished_at": "2026-11-21T10:00:01.000Z",
    "controller": {"name": "default", "sha256": "a" * 64}, "environments": "paper-test",
    "precision": "float32", "record": ["com"], "record_stride": 10, "verify": False, "n_designs": 1,
    "rollouts_total": 2, "rollouts_done": 2, "rollouts_cached": 0, "rollouts_diverged": 0,
    "physics": {"dt_s": 0.004, "n_steps": 20, "impact": "exact"}
}
RESULT = {"id": ID, "genotype": VOXELS, "score": 0.75, "losses": [0.5, 1.0], "diverged": []}


class Server:
    """Replies come from a list of functions, one per request; the requests are kept."""
    def __init__(self, replies, path=None):
        self.replies, self.seen = list(replies), []
        outer = self

        class Handler(http.server.BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def handle_any(self):
                body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
                outer.seen.append((self.command, self.path, dict(self.headers), body))
                outer.replies.pop(0)(self) if outer.replies else reply(
                    500, {"title": "no reply left"})(self)

            do_GET = do_POST = do_PUT = do_DELETE = handle_any

            def address_string(self):
                return "fake"

            def log_message(self, *_):
                pass

        if path is not None:

            class UnixServer(socketserver.ThreadingUnixStreamServer):
                def get_request(self):
                    connection, _ = super().get_request()
                    return connection, ("unix", 0)

            self.server = UnixServer(path, Handler)
            self.address = "unix:" + path
        else:
            self.server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
            self.address = f"http://127.0.0.1:{self.server.server_address[1]}"
        self.server.daemon_threads = True
        threading.Thread(target=self.server.serve_forever, args=(0.02, ), daemon=True).start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.server.shutdown()
        self.server.server_close()


def reply(status, body=None, content_type=None, **headers):
    def send(handler):
        data = body if isinstance(body,
                                  bytes) else b"" if body is None else json.dumps(body).encode()
        handler.send_response(status)
        handler.send_header(
            "Content-Type", content_type or
            ("application/problem+json" if status >= 400 else "application/json"))
        handler.send_header("Content-Length", str(len(data)))
        for name, value in headers.items():
            handler.send_header(name.replace("_", "-"), value)
        handler.end_headers()
        handler.wfile.write(data)

    return send


def broken(handler):
    """Ends the connection without a reply."""
    handler.close_connection = True
    handler.connection.shutdown(2)


def stream(text):
    def send(handler):
        handler.send_response(200)
        handler.send_header("Content-Type", "text/event-stream")
        handler.send_header("Connection", "close")
        handler.end_headers()
        handler.wfile.write(text.encode())
        handler.close_connection = True

    return send


def run(server, *arguments, input_text="", **variables):
    environment = {k: v for k, v in os.environ.items() if not k.startswith("MORPHOD_")}
    environment.update(
        {
            "MORPHOD_SERVER": server if isinstance(server, str) else server.address, "TZ": "UTC",
            "LC_ALL": "C.UTF-8"
        }, **variables)
    done = subprocess.run([MORPHOCTL, *arguments],
                          input=input_text,
                          capture_output=True,
                          text=True,
                          timeout=60,
                          env=environment)
    return done.returncode, done.stdout, done.stderr


def event(number, kind, **data):
    body = {
        "id": str(number), "type": kind, "job": "7", "at": "2026-11-21T10:00:00.000Z", "data": data
    }
    return f"id: {number}\nevent: {kind}\ndata: {json.dumps(body)}\n\n"


def test_table_and_request():
    with Server([reply(200, {**JOB, "results": [RESULT]})]) as server:
        status, out, err = run(server,
                               "eval",
                               "--label",
                               "x",
                               "--physics",
                               "n_steps=20",
                               "--record",
                               "com",
                               input_text='{"name": "walker", "cells": [[0,0,0]]}')
        assert status == 0, err
        lines = out.splitlines()
        assert re.match(r"#\s+name\s+design\s+voxels\s+score\s+best\s+worst", lines[0]), out
        assert re.match(rf"0\s+walker\s+{ID}\s+1\s+0\.7500\s+0\.5000\s+1\.0000", lines[1]), out
        assert "\033" not in out + err, "colors without a terminal"
        method, path, headers, body = server.seen[0]
        assert (method, path, headers["Content-Type"]) == ("POST", "/v1/evaluations",
                                                           "application/json")
        assert headers["Prefer"].startswith("wait=") and re.fullmatch("[0-9a-f]{32}",
                                                                      headers["Idempotency-Key"])
        assert json.loads(body) == {
            "designs": [{"cells": [[0, 0, 0]]}], "label": "x", "physics": {"n_steps": 20},
            "record": ["com"]
        }


def test_text_of_others_is_not_obeyed():
    """Any submitter chooses the label, and a terminal must not obey it."""
    evil = "x\033]0;owned\007\033[2J\u009b31m\x7f\ry"
    with Server([reply(200, {"items": [{**JOB, "label": evil}], "next_cursor": None})]) as server:
        status, out, err = run(server, "job", "list")
        assert status == 0 and "x?]0;owned??[2J?31m??y" in out, out + err
    hidden = "a\u202egpj\u2066b\u200fc\u061cd\U000e0041e\u200b é😀ü"
    with Server([reply(200, {"items": [{**JOB, "label": hidden}], "next_cursor": None})]) as server:
        status, out, err = run(server, "job", "list")
        assert status == 0, out + err
        assert r"a\u202egpj\u2066b\u200fc\u061cd\U000e0041e\u200b é😀ü" in out, out + err
    with Server([reply(200, {**JOB, "label": hidden})]) as server:
        status, out, err = run(server, "job", "show", "7")
        assert status == 0 and r"a\u202egpj\u2066b" in out and "\u202e" not in out, out + err
    problem = {
        "type": "about:blank", "title": evil, "status": 422, "detail": "no" + evil,
        "errors": [{"detail": evil, "pointer": "/" + evil}]
    }
    metadata = {"name": "a", "sha256": "a" * 64, "metadata": {"k" + evil: evil}}
    shown = []
    with Server([
            reply(
                200,
                {**JOB, "label": evil, "state": "failed", "error": {"code": "io", "detail": evil}}),
            reply(200, metadata),
            reply(422, problem),
            stream(event(1, "job." + evil.replace("\r", ""), state="a" + evil))
    ] + [reply(404, problem)] * 3) as server:
        shown.append(run(server, "job", "show", "7"))
        shown.append(run(server, "controller", "info", "a"))
        shown.append(run(server, "job", "show", "8"))
        shown.append(run(server, "watch", "--retry", "0"))
    for status, out, err in shown:
        assert "31m" in out + err, (status, out, err)
        assert not re.search("[\0-\x09\x0b-\x1f\x7f-\x9f]", out + err), (out, err)


def test_no_proxy_between_loopback_addresses():
    with Server([reply(200, JOB)]) as server:
        assert run(server,
                   "job",
                   "show",
                   "7",
                   "--retry",
                   "0",
                   http_proxy="http://127.0.0.1:1",
                   all_proxy="http://127.0.0.1:1")[0] == 0
        assert server.seen[0][1] == "/v1/jobs/7"


def test_json_is_the_apis():
    evaluation = {**JOB, "results": [RESULT]}
    with Server([reply(200, evaluation)]) as server:
        status, out, _ = run(server, "eval", "--json", input_text=VOXELS)
        assert status == 0 and json.loads(out) == evaluation


def test_json_keeps_numbers_as_they_came():
    text = (
        '{"items":[0.9,1.5e-07,1e+22,-0.1,0.30000000000000004,2.5e-308,17,-3,9007199254740993,'
        '{"1.50":"1.50 \\" 0.90000000000000002"},true,null],"next_cursor":null}')
    with Server([reply(200, text.encode())] * 2) as server:
        assert run(server, "job", "show", "7", "--json")[1] == text + "\n"
        assert run(server, "job", "list", "--json")[1] == text + "\n"
    hidden = "a\u202e\x7f\u009b\U000e0041é"
    with Server([reply(200, {"label": hidden})]) as server:
        assert run(server, "job", "show", "7",
                   "--json")[1] == r'{"label":"a\u202e\u007f\u009b\udb40\udc41é"}' + "\n"


def test_waits_for_the_end():
    with Server([
            reply(202, {**JOB, "state": "queued"}),
            reply(200, {**JOB, "state": "running", "rollouts_done": 1}),
            reply(200, JOB),
            reply(200, {**JOB, "results": [RESULT]})
    ]) as server:
        status, out, _ = run(server, "eval", input_text=ID)
        assert status == 0 and "0.7500" in out
        assert [s[1] for s in server.seen
                ] == ["/v1/evaluations", "/v1/jobs/7", "/v1/jobs/7", "/v1/evaluations/7"]


def test_no_wait():
    with Server([reply(202, {**JOB, "state": "queued"})]) as server:
        status, out, _ = run(server, "eval", "--no-wait", input_text=ID)
        assert (status, out) == (0, "7\n")
        assert "Prefer" not in server.seen[0][2]


def test_failed_job():
    failed = {
        **JOB, "state": "failed", "error": {"code": "crashed", "detail": "it crashed three times"}
    }
    with Server([reply(200, failed)]) as server:
        status, _, err = run(server, "eval", input_text=ID)
        assert status == 3 and "it crashed three times" in err


def test_diverged():
    with Server([
            reply(
                200, {
                    **JOB, "results": [{
                        **RESULT, "score": None, "losses": [None, 1.0],
                        "diverged": [{"environment": 0, "step": 17}]
                    }]
                })
    ]) as server:
        status, out, _ = run(server, "eval", input_text=ID)
        assert status == 0 and "diverged in 1 of 2 (environment 0, step 17)" in out, out


def test_repeats_with_the_same_key():
    with Server([
            broken,
            reply(503, {"title": "busy"}, Retry_After="0"),
            reply(429, {"title": "busy"}, Retry_After="1"),
            reply(200, {**JOB, "results": [RESULT]})
    ]) as server:
        status, _, err = run(server, "eval", input_text=ID)
        assert status == 0, err
        keys = {s[2]["Idempotency-Key"] for s in server.seen}
        assert len(server.seen) == 4 and len(keys) == 1
        assert len({s[3] for s in server.seen}) == 1


def test_gives_up():
    with Server(
        [reply(503, {"title": "Draining", "detail": "the service stops"},
               Retry_After="30")]) as server:
        status, _, err = run(server, "eval", "--retry", "1", input_text=ID)
        assert status == 7 and "Draining: the service stops (503)" in err, err
    status, _, err = run("127.0.0.1:1", "job", "list", "--retry", "0")
    assert status == 4 and "127.0.0.1:1: " in err, err
    assert "that of MORPHOD_SERVER" in err and "--server" in err, err
    status, _, err = run("127.0.0.1:1", "job", "list", "--retry", "0", "--server", "unix:/nowhere")
    assert status == 4 and "unix:/nowhere" in err and "that of --server" in err, err
    status, _, err = run("127.0.0.1:1", "watch", "--retry", "0")
    assert status == 4 and "MORPHOD_SERVER" in err, err
    status, _, err = run("", "job", "list", "--retry", "0", http_proxy="http://127.0.0.1:1")
    assert "127.0.0.1:8765" not in err or "the default" in err, err


def test_faults_are_printed():
    problem = {
        "type": "about:blank", "title": "Unprocessable Content", "status": 422,
        "detail": "2 faults", "instance": "/", "request_id": "0" * 16,
        "errors": [{"detail": "not contiguous", "pointer": "/designs/0/cells/1"},
                   {"detail": "unknown", "header": "Prefer"}]
    }
    with Server([reply(422, problem)]) as server:
        status, out, err = run(server, "eval", input_text="[[0,0,0],[5,5,3]]")
        assert status == 6 and out == ""
        assert "/designs/0/cells/1: not contiguous" in err and "Prefer: unknown" in err, err


def test_exit_statuses():
    for code, expected in ((401, 5), (403, 5), (404, 3), (409, 3), (400, 6), (413, 6), (500, 1),
                           (507, 7)):
        with Server([reply(code, {"title": "T", "detail": "D"})]) as server:
            status, _, err = run(server, "job", "show", "7", "--retry", "0")
            assert status == expected, (code, status, err)
    with Server([reply(200, b"<html>", "text/html")]) as server:
        assert run(server, "job", "show", "7")[0] == 1


def test_token():
    with tempfile.NamedTemporaryFile("w") as file:
        file.write("# the token\n\nfrom-a-file\n")
        file.flush()
        with Server([reply(200, JOB), reply(200, JOB), reply(200, JOB)]) as server:
            assert run(server, "job", "show", "7", MORPHOD_TOKEN="from-a-variable")[0] == 0
            assert run(server,
                       "job",
                       "show",
                       "7",
                       "--token-file",
                       file.name,
                       MORPHOD_TOKEN="from-a-variable")[0] == 0
            assert run(server, "job", "show", "7")[0] == 0
            assert [s[2].get("Authorization")
                    for s in server.seen] == ["Bearer from-a-variable", "Bearer from-a-file", None]


def test_unix_socket():
    with tempfile.TemporaryDirectory() as folder, Server([reply(200, JOB)],
                                                         path=folder + "/s") as server:
        status, out, err = run(server, "job", "show", "7")
        assert status == 0 and "succeeded" in out, err


def test_watch_goes_on_after_a_break():
    with Server([
            reply(200, {**JOB, "state": "running"}),
            stream(event(3, "job.created", state="queued") + "id: 4\nevent: job.pro"),
            stream(
                event(4, "job.progress", state="running", rollouts_done=1, rollouts_total=2) +
                event(5, "job.finished", state="succeeded"))
    ]) as server:
        status, out, err = run(server, "watch", "7")
        assert status == 0, err
        assert [l.split()[2]
                for l in out.splitlines()] == ["job.created", "job.progress", "job.finished"], out
        assert server.seen[1][1] == "/v1/events?job=7&after=0" and server.seen[2][2][
            "Last-Event-ID"] == "3"


def test_watch_a_failure_in_json():
    with Server(
        [reply(200, {**JOB, "state": "running"}),
         stream(event(5, "job.finished", state="failed"))]) as server:
        status, out, _ = run(server, "watch", "7", "--json")
        assert status == 3 and json.loads(out)["data"] == {"state": "failed"}


def test_trajectories_are_numpy_files():
    data = struct.pack("<6f", *range(6))
    recording = reply(200, data, "application/octet-stream", Morphod_Shape="2,3")
    with tempfile.TemporaryDirectory() as folder, \
            Server([reply(200, {**JOB, "results": [RESULT]})] + [recording] * 2) as server:
        status, _, err = run(server,
                             "eval",
                             "--record",
                             "com",
                             "--output",
                             folder + "/out",
                             input_text=ID)
        assert status == 0, err
        assert server.seen[1][1] == "/v1/evaluations/7/trajectories/0/file?environment=0&array=com"
        with open(folder + "/out/design-0000-environment-01-com.npy", "rb") as file:
            content = file.read()
        assert content[:8] == b"\x93NUMPY\x01\x00"
        length = struct.unpack("<H", content[8:10])[0]
        assert (10 + length) % 64 == 0
        head = content[10:10 + length]
        assert eval(head) == {"descr": "<f4", "fortran_order": False, "shape": (2, 3)
                              } and head.endswith(b"\n")
        assert content[10 + length:] == data
        with open(folder + "/out/evaluation.json", encoding="utf-8") as file:
            assert json.load(file)["id"] == "7"


def test_pages():
    first, second = {"items": [JOB] * 2,
                     "next_cursor": "a/b"}, {"items": [JOB], "next_cursor": None}
    with Server([reply(200, first), reply(200, second)]) as server:
        status, out, _ = run(server, "job", "list", "--all")
        assert status == 0 and len(out.splitlines()) == 4
        assert [s[1] for s in server.seen
                ] == ["/v1/jobs?limit=1000", "/v1/jobs?limit=1000&cursor=a%2Fb"]


def test_verify():
    for agrees, expected in ((True, 0), (False, 3), (None, 3)):
        with Server([
                reply(
                    200,
                    {**JOB, "results": [{**RESULT, "stored_losses": [0.5, 1.0], "agrees": agrees}]})
        ]) as server:
            status, out, _ = run(server, "verify", VOXELS)
            assert status == expected, out
            assert json.loads(server.seen[0][3])["verify"] is True


def test_verify_an_id_asks_for_its_orientations():
    design = {"id": ID, "orientations": [{"genotype": VOXELS, "scores": []}]}
    with Server([
            reply(200, design),
            reply(200,
                  {**JOB, "results": [{**RESULT, "stored_losses": [0.5, 1.0], "agrees": True}]})
    ]) as server:
        assert run(server, "verify", ID)[0] == 0
        assert json.loads(server.seen[1][3])["designs"] == [{"voxels": VOXELS}]


def test_controller_files():
    with tempfile.TemporaryDirectory() as folder:
        path = folder + "/c.safetensors"
        with open(path, "wb") as file:
            file.write(bytes(range(256)) * 100)
        described = {"name": "c", "sha256": "b" * 64}
        with Server([
                reply(201, described),
                reply(200,
                      bytes(range(256)) * 100, "application/octet-stream"),
                reply(204)
        ]) as server:
            assert run(server, "controller", "put", "c", path)[0] == 0
            assert run(server, "controller", "get", "c", "-o", path + ".copy")[0] == 0
            assert run(server, "controller", "delete", "c")[0] == 0
            assert server.seen[0][:2] == (
                "PUT", "/v1/controllers/c/file") and server.seen[0][3] == bytes(range(256)) * 100
            with open(path + ".copy", "rb") as file:
                assert file.read() == bytes(range(256)) * 100


TRAINING = {
    "id": "7", "kind": "pretrain", "name": "walker", "state": "running", "priority": "batch",
    "label": None, "attempts": 0, "error": None, "created_at": "2026-11-21T10:00:00.000Z",
    "started_at": "2026-11-21T10:00:00.000Z", "finished_at": None, "reason": None,
    "phase": "learning", "parent": None, "validation": None, "checkpoint_step": None,
    "controller": None, "settings": {
        "steps": 1400, "batch": 256, "seed": 1, "sensor": "inverse_sqrt", "n_designs": None,
        "population": None, "schedule": {"kind": "cosine", "peak": 0.002, "floor": 1e-05},
        "adam": {"beta1": 0.9, "beta2": 0.999, "epsilon": 1e-08
                 }, "gradient_norm_limit": 1.0, "adjoint_bound": 2.0, "adjoint_rule": "clip",
        "restart_weight": 3.0, "physics": {"dt_s": 0.004, "n_steps": 20, "impact": "exact"},
        "validation": {"every_steps": 50, "designs": 64, "environments": 8
                       }, "checkpoint": {"every_steps": 0, "every_s": 60, "keep": 3}
    }, "progress": {
        "step": 2, "steps": 1400, "mean_loss": 0.75, "gradient_norm": 0.5, "rate": 0.001,
        "clipped_share": 0.03, "diverged": 0, "zeroed": 0, "bodies_per_s": 100.0,
        "seconds_left": 3600.0, "replayed": 0, "replay_total": 0
    }
}
NEWEST = reply(200, {"items": [], "next_cursor": None, "newest": "41", "reset": True})
NO_ROWS = reply(200, {"items": [], "next_cursor": None})
DONE = {
    **TRAINING, "state": "succeeded", "phase": "idle",
    "controller": {"name": "walker",
                   "sha256": "c" * 64}, "progress": {**TRAINING["progress"], "step": 1400}
}


def step_rows(first, last, more=False):
    rows = [{"step": n, "mean_loss": 1 / n} for n in range(first, last + 1)]
    return reply(200, {"items": rows, "next_cursor": str(last) if more else None})


def test_train_start_sends_what_was_asked_for():
    with Server([reply(202, TRAINING)]) as server:
        status, out, err = run(
            server, "train", "start", "pretrain", "--name", "walker", "--steps", "1400", "-b",
            "256", "--seed", "3", "--sensor", "inverse_square", "--schedule", "restarts", "--peak",
            "2e-3", "--floor", "1e-5", "--decay", "0.7", "--cycle-steps", "10", "--cycle-growth",
            "2", "--warmup-steps", "5", "--beta1", "0.8", "--beta2", "0.99", "--epsilon", "1e-7",
            "--gradient-norm-limit", "0", "--adjoint-bound", "8", "--adjoint-rule", "restart",
            "--restart-weight", "0.5", "-p", "n_steps=20", "--validate-every", "5",
            "--validation-designs", "4", "--validation-environments", "2", "--checkpoint-steps",
            "7", "--checkpoint-seconds", "0", "--checkpoint-keep", "2", "--priority", "batch",
            "--label", "x")
        assert (status, out) == (0, "7\n") and "morphoctl train watch 7" in err, (out, err)
        method, path, headers, body = server.seen[0]
        assert (method, path) == ("POST", "/v1/trainings") and re.fullmatch(
            "[0-9a-f]{32}", headers["Idempotency-Key"]) and "Prefer" not in headers
        assert json.loads(body) == {
            "kind": "pretrain", "name": "walker", "steps": 1400, "batch": 256, "seed": 3,
            "sensor": "inverse_square", "schedule": {
                "kind": "restarts", "peak": 0.002, "floor": 1e-05, "decay": 0.7, "cycle_steps": 10,
                "cycle_growth": 2, "warmup_steps": 5
            }, "adam": {"beta1": 0.8, "beta2": 0.99,
                        "epsilon": 1e-07}, "gradient_norm_limit": 0.0, "adjoint_bound": 8.0,
            "adjoint_rule": "restart", "restart_weight": 0.5, "physics": {"n_steps": 20},
            "validation": {"every_steps": 5, "designs": 4, "environments": 2},
            "checkpoint": {"every_steps": 7, "every_s": 0,
                           "keep": 2}, "priority": "batch", "label": "x"
        }


def test_train_start_finetune():
    with Server([
            reply(202, TRAINING),
            reply(200, JOB),
            reply(202, TRAINING),
            reply(200, {**JOB, "kind": "campaign"}),
            reply(202, TRAINING),
            reply(202, TRAINING)
    ]) as server:
        assert run(server, "train", "start", "finetune", VOXELS, "-c", "walker", "--schedule",
                   "one-cosine")[0] == 0
        assert json.loads(server.seen[0][3]) == {
            "kind": "finetune", "controller": "walker", "designs": [{"voxels": VOXELS}],
            "schedule": "one-cosine"
        }
        assert run(server, "train", "start", "finetune", "--population", "12", "--best",
                   "64")[0] == 0
        assert server.seen[1][:2] == ("GET", "/v1/jobs/12")  # whose population it is
        assert json.loads(server.seen[2][3]) == {
            "kind": "finetune", "population": {"evaluation": "12", "best": 64}
        }
        assert run(server, "train", "start", "finetune", "--population", "13")[0] == 0
        assert json.loads(
            server.seen[4][3]) == {"kind": "finetune", "population": {"campaign": "13"}}
        assert run(server, "train", "start", "finetune", "--random", "5", "--random-seed",
                   "9")[0] == 0
        assert len(json.loads(server.seen[5][3])["designs"]) == 5


def test_train_start_that_makes_no_sense():
    with Server([]) as server:
        for words in (["x"], ["finetune"], ["pretrain", VOXELS], ["pretrain", "--random", "3"],
                      ["pretrain", "--population", "1"], ["finetune", VOXELS, "--population",
                                                          "1"], ["finetune", VOXELS, "--best", "2"],
                      ["pretrain", "--peak",
                       "1e-3"], ["pretrain", "--schedule", "one-cosine", "--peak",
                                 "1e-3"], ["pretrain", "--steps",
                                           "1e3"], ["pretrain", "--steps", "9" * 30],
                      ["pretrain", "--adjoint-bound",
                       "inf"], ["pretrain", "--beta1",
                                ""], ["pretrain", "-p",
                                      "gravity=1"], ["finetune", "--population",
                                                     "x"], ["pretrain", "--stepps", "3"]):
            status, out, err = run(server, "train", "start", *words)
            assert status == 2 and out == "" and err.startswith("morphoctl: "), (words, status, err)
        assert server.seen == []


def test_train_watch_goes_on_after_a_break():
    progress = {
        "id": "7", "step": 4, "steps": 1400, "mean_loss": 0.5, "gradient_norm": 0.25, "rate": 0.002,
        "clipped_share": 0.125, "bodies_per_s": 123.4, "seconds_left": 90061.0
    }
    with Server([
            NEWEST,
            reply(200, TRAINING),
            step_rows(1, 2), NO_ROWS,
            stream(event(42, "training.progress", **progress) + "id: 43\nevent: trai"),
            reply(200, TRAINING), NO_ROWS, NO_ROWS,
            stream(
                event(43,
                      "training.validation",
                      id="7",
                      step=50,
                      mean_score=0.25,
                      standard_error=0.01,
                      rollouts=512,
                      diverged=3) + event(44, "training.checkpoint", id="7", step=50) +
                event(45, "job.paused", state="paused")),
            reply(200, {**TRAINING, "state": "paused", "phase": "idle"}), NO_ROWS, NO_ROWS,
            reply(200, {**TRAINING, "state": "paused", "phase": "idle"}), NO_ROWS, NO_ROWS,
            stream(event(46, "job.finished", state="succeeded")),
            reply(200, DONE), NO_ROWS, NO_ROWS
    ]) as server:
        status, out, err = run(server, "train", "watch", "7")
        assert status == 0, (out, err)
        lines = out.splitlines()
        assert lines[0] == "training 7 (pretrain walker) is running, step 2 of 1,400"
        assert lines[1] == (
            "2026-11-21 10:00:00  step 4 of 1,400  loss 0.5000  gradient 0.25  rate 0.002  clipped "
            "12.5 %  123.4 bodies/s  "
            "25:01:01 left")
        assert lines[2].endswith("validation 0.2500 ± 0.0100 at step 50, 3 of 512 rollouts diverged"
                                 ) and lines[3].endswith("checkpoint of step 50")
        assert lines[4].endswith("job.paused  paused") and lines[5].endswith(
            "job.finished  succeeded")
        assert lines[6] == "controller walker: sha256:" + "c" * 64 and len(lines) == 7
        streams = [(path, headers.get("Last-Event-ID")) for _, path, headers, _ in server.seen
                   if path.startswith("/v1/events?job")]
        assert streams == [("/v1/events?job=7&after=41", None), ("/v1/events?job=7", "42"),
                           ("/v1/events?job=7", "45")]
        assert "\033" not in out


def test_train_watch_one_that_has_ended():
    for ended, expected in ((DONE, 0), ({**DONE, "state": "cancelled", "controller": None}, 3), ({
            **DONE, "state": "failed", "controller": None,
            "error": {"code": "io", "detail": "the disk broke"}
    }, 3)):
        with Server([NEWEST, reply(200, ended), step_rows(1, 5), NO_ROWS]) as server:
            status, _, err = run(server, "train", "watch", "7")
            assert status == expected and ("the disk broke" in err) == (ended["error"]
                                                                        is not None), err


def test_train_watch_is_left_with_an_interrupt():
    arrived = threading.Event()

    def silent(handler):
        stream(event(42, "training.progress", step=3, mean_loss=0.5))(handler)
        handler.wfile.flush()
        arrived.set()
        time.sleep(20)

    with Server([NEWEST, reply(200, TRAINING), step_rows(1, 2), NO_ROWS, silent]) as server:
        environment = {**os.environ, "MORPHOD_SERVER": server.address, "LC_ALL": "C.UTF-8"}
        process = subprocess.Popen([MORPHOCTL, "train", "watch", "7"],
                                   stdout=subprocess.PIPE,
                                   stderr=subprocess.PIPE,
                                   text=True,
                                   env=environment)
        assert arrived.wait(20)
        assert process.stdout.readline().startswith(
            "training 7") and "step 3" in process.stdout.readline()
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=20)
        assert process.returncode == 130 and all(f"morphoctl train {verb} 7" in err
                                                 for verb in ("watch", "pause", "cancel")), err


def test_train_watch_draws_on_a_terminal():
    """In a pseudo-terminal of 80 × 24: the same lines again and again, never more than there are.
    """
    rows = "".join(
        event(42 + n, "training.progress", step=n + 3, mean_loss=0.5 / (n + 1)) for n in range(5))
    evil = {**TRAINING, "name": "w\033]0;x\007", "label": "\033[2J"}
    with Server([
            NEWEST,
            reply(200, evil),
            step_rows(1, 2), NO_ROWS,
            stream(rows + event(60, "job.finished", state="succeeded")),
            reply(200, {**DONE, "name": "w"}),
            step_rows(3, 500),
            reply(200, {"items": [{"step": 0, "mean_score": 0.9}], "next_cursor": None})
    ]) as server:
        child, terminal = pty.fork()
        if child == 0:
            os.environ.update(MORPHOD_SERVER=server.address, LC_ALL="C.UTF-8", TERM="xterm")
            os.execv(MORPHOCTL, [MORPHOCTL, "train", "watch", "7"])
        fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
        data = b""
        while True:
            try:
                piece = os.read(terminal, 65536)
            except OSError:
                break
            if not piece:
                break
            data += piece
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0, data
        text = data.decode()
        assert "\033]0" not in text and "\033[2J" not in text and "w?]0;x?" in text
        frames = text.split("\033[J")
        assert len(frames) >= 3 and "Ctrl-C leaves" in frames[0] and "◆" in frames[
            -2] and "step 500" in frames[-2]
        for frame in frames[:-1]:
            assert frame.count("\n") <= 23, frame
            for line in re.sub(r"\033\[[0-9]*[A-Za-z]", "", frame).replace("\r", "").split("\n"):
                assert len(line) <= 80, line
        up = re.findall(r"\033\[(\d+)A", text)
        assert [int(n) for n in up] == [frame.count("\n") for frame in frames[:len(up)]]


def test_train_show_and_list():
    with Server([
            reply(200, {
                **TRAINING, "parent": {"name": "default", "sha256": "d" * 64}, "reason": "no space"
            }),
            step_rows(1, 2), NO_ROWS,
            reply(
                200, {
                    **TRAINING, "settings": {
                        **TRAINING["settings"], "adjoint_bound": 8.0, "adjoint_rule": "restart"
                    }
                }), NO_ROWS, NO_ROWS,
            reply(200, {"items": [TRAINING, DONE], "next_cursor": None})
    ]) as server:
        status, out, err = run(server, "train", "show", "7")
        assert status == 0, err
        assert "gradient 1, adjoint 2 (clip)\n" in out, out
        assert re.search(r"^from +default, sha256:d+$", out, re.M) and re.search(
            "^progress +step 2 of 1,400$", out, re.M) and "⠁" <= max(out) <= "⣿", out
        assert re.search(r"^reason +no space$", out, re.M)
        assert "gradient 1, adjoint 8 (restart, weight 3)\n" in run(server, "train", "show", "7")[1]
        status, out, _ = run(server, "train", "list", "--state", "running")
        assert status == 0 and len(
            out.splitlines()) == 3 and server.seen[-1][1] == "/v1/trainings?state=running&limit=50"
        assert run(server, "train", "list", "--state", "ended")[0] == 2


def test_train_export():
    head = b"step,mean_loss\n"
    with tempfile.TemporaryDirectory() as folder, \
            Server([reply(200, b"weights", "application/octet-stream", Morphod_Step="4"),
                    reply(200, head + b"1,0.5\n2,0.25\n3,0.125\n", "text/csv"),
                    reply(200, b"step,mean_score\n0,1.5\n", "text/csv")]) as server:
        status, out, err = run(server, "train", "export", "7", "--step", "4", "-o", folder + "/c",
                               "--curve", folder + "/curve", "--validations", "-")
        assert status == 0 and out == "step,mean_score\n0,1.5\n", (out, err)
        with open(folder + "/c", "rb") as file:
            assert file.read() == b"weights"
        with open(folder + "/curve", "rb") as file:
            assert file.read() == head + b"1,0.5\n2,0.25\n3,0.125\n"
        assert [path for _, path, _, _ in server.seen] == [
            "/v1/trainings/7/controller?step=4", "/v1/trainings/7/steps",
            "/v1/trainings/7/validations"
        ]
    with Server([reply(404, {"title": "Not Found", "detail": "no checkpoint yet"})]) as server:
        assert run(server, "train", "export", "7")[0] == 3


def scored(identity, scores):
    results = [{
        **RESULT, "score": score, "losses": [score, score],
        "diverged": [] if score is not None else [{"environment": 0, "step": 3}]
    } for score in scores]
    return reply(200, {
        **JOB, "id": identity, "controller": {"name": "x", "sha256": "e" * 64}, "results": results
    })


def test_train_compare():
    held_out = {
        "designs": [{"voxels": VOXELS}] * 5,
        "environments": [{"light_xy_m": [1, 2], "terrain_sigma_m": 0, "seed": 1}] * 2
    }
    a, b = [2.0, 4.0, 6.0, 1.0, None], [1.0, 2.0, 3.0, 1.0, 0.5]
    with Server([
            reply(200, held_out),
            scored("8", a),
            scored("9", b),
            reply(200, held_out),
            scored("8", a),
            scored("9", b)
    ]) as server:
        status, out, err = run(server, "train", "compare", "old", "new", "--seed", "3", "--designs",
                               "5", "--environments", "2")
        assert status == 0, err
        assert server.seen[0][1] == "/v1/held-out?seed=3&designs=5&environments=2"
        assert [json.loads(s[3]) for s in server.seen[1:3]] == [{**held_out, "controller": "old"},
                                                                {**held_out, "controller": "new"}]
        # Differences -1, -2, -3, 0: mean -1.5, deviation sqrt(5/3), t(0.975, 3) = 3.182446.
        half = 3.182446305284263 * (5 / 3 / 4)**0.5
        assert (f"-1.5000, 95 % confidence {-1.5 - half:+.4f} to {-1.5 + half:+.4f} "
                "(Student t, 4 pairs)") in out, out
        assert "3 of 4 designs (75.0 %), 1 equal" in out
        assert "1 design that diverged" in out
        assert "is not shown" in out
        assert re.search(r"^A +old +3\.2500 +1 of 5 +1 of 10 ", out, re.M) and re.search(
            r"^B +new +1\.7500 +0 of 5 +0 of 10 ", out, re.M), out
        value = json.loads(run(server, "train", "compare", "old", "new", "--json")[1])
        assert value["pairs"] == 4 and value["difference"] == -1.5 and abs(
            value["high"] - (half - 1.5)) < 1e-12 and value["verdict"] == "undecided"
        assert value["a"]["designs_diverged"] == 1 and value["improved"] == 3 and value[
            "held_out"] == {"seed": 1, "designs": 5, "environments": 8}
    for scores, verdict in (([0.5, 0.6, 0.5, 0.6,
                              0.5], "better"), ([1.5, 1.6, 1.5, 1.6,
                                                 1.5], "worse"), ([None] * 5, "undecided")):
        with Server([reply(200, held_out),
                     scored("8", [1.0] * 5),
                     scored("9", scores)] * 2) as server:
            assert json.loads(run(server, "train", "compare", "a", "b",
                                  "--json")[1])["verdict"] == verdict
            words = {
                "better": "b is better than a", "worse": "b is worse than a",
                "undecided": "Too few designs"
            }[verdict]
            assert words in run(server, "train", "compare", "a", "b")[1]


def test_watch_tells_of_trainings():
    with Server([
            stream(
                event(1,
                      "training.progress",
                      step=2,
                      steps=9,
                      mean_loss=0.5,
                      gradient_norm=1,
                      rate=0.1,
                      clipped_share=0) + event(2,
                                               "training.validation",
                                               step=2,
                                               mean_score=0.25,
                                               standard_error=0.5,
                                               rollouts=8,
                                               diverged=0) +
                event(3, "training.checkpoint", step=2) + event(4, "training.other", x=1))
    ]) as server:
        out = run(server, "watch", "--retry", "0")[1].splitlines()
        assert [line[21:] for line in out] == [
            "training.progress job 7  step 2 of 9  loss 0.5000  gradient 1  rate 0.1  clipped 0.0 "
            "%",
            "training.validation job 7  0.2500 ± 0.5000 at step 2",
            "training.checkpoint job 7  of step 2", "training.other  job 7"
        ], out


def test_campaign_whose_generation_is_committed_between_two_requests():
    campaign = {
        "id": "7", "mode": "zero-shot", "state": "running", "phase": "scoring",
        "progress": {"generation": None, "generations": 3}
    }
    rows = {"items": [{"generation": 0, "score": {"mean": 0.5}}], "next_cursor": None}
    with Server([reply(200, campaign),
                 reply(200, rows),
                 reply(200, {"items": [], "next_cursor": None})]) as server:
        status, out, err = run(server, "campaign", "show", "7")
        assert status == 0 and "generation 0 of 3" in out and "before generation" not in out, (
            status, out, err)
        assert [path for _, path, _, _ in server.seen
                ] == ["/v1/campaigns/7", "/v1/campaigns/7/generations?limit=1000"]


def test_job_lists_name_trainings():
    short = {
        **{
            k: TRAINING[k]
            for k in ("id", "state", "priority", "label", "created_at", "started_at", "finished_at",
                      "attempts", "error", "reason")
        }, "kind": "training",
        "training": {"kind": "finetune", "name": "walker", "step": 350, "steps": 1400}
    }
    with Server([reply(200, {"items": [short, JOB], "next_cursor": None}),
                 reply(200, short)]) as server:
        out = run(server, "job", "list")[1]
        assert re.search(r"7 +finetune +running +batch +1,400 steps +25 %", out) and re.search(
            r"7 +evaluation +succeeded .* 2 rollouts +100 %", out), out
        out = run(server, "job", "show", "7")[1]
        assert "step 350 of 1,400; morphoctl train show 7" in out, out


tests = [(name, value) for name, value in sorted(globals().items()) if name.startswith("test_")]
print(f"1..{len(tests)}")
failed = 0
for number, (name, test) in enumerate(tests, 1):
    try:
        test()
        print(f"ok {number} - {name[5:].replace('_', ' ')}")
    except Exception as error:  # a failed test must not hide the others
        failed += 1
        print(f"# {type(error).__name__}: {str(error)[:2000]!r}")
        print(f"not ok {number} - {name[5:].replace('_', ' ')}")
    sys.stdout.flush()
sys.exit(1 if failed else 0)
