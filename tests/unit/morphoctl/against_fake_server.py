"""morphoctl against a server that misbehaves on demand: repetition, exit statuses, tables, streams. Speaks TAP.

Usage: against_fake_server.py MORPHOCTL. The real daemon's replies are tested in tests/api."""
import http.server
import json
import os
import re
import socketserver
import struct
import subprocess
import sys
import tempfile
import threading

MORPHOCTL = sys.argv[1]
VOXELS = "1" + "0" * 143
ID = "8" + "0" * 35
JOB = {"id": "7", "kind": "evaluation", "state": "succeeded", "priority": "interactive", "label": None, "attempts": 0, "error": None,
       "created_at": "2026-11-21T10:00:00.000Z", "started_at": "2026-11-21T10:00:00.000Z", "finished_at": "2026-11-21T10:00:01.000Z",
       "controller": {"name": "default", "sha256": "a" * 64}, "environments": "paper-test", "precision": "float32", "record": ["com"],
       "record_stride": 10, "verify": False, "n_designs": 1, "rollouts_total": 2, "rollouts_done": 2, "rollouts_cached": 0,
       "rollouts_diverged": 0, "physics": {"dt_s": 0.004, "n_steps": 20, "impact": "exact"}}
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
                outer.replies.pop(0)(self) if outer.replies else reply(500, {"title": "no reply left"})(self)

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
        threading.Thread(target=self.server.serve_forever, args=(0.02,), daemon=True).start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.server.shutdown()
        self.server.server_close()


def reply(status, body=None, content_type=None, **headers):
    def send(handler):
        data = body if isinstance(body, bytes) else b"" if body is None else json.dumps(body).encode()
        handler.send_response(status)
        handler.send_header("Content-Type", content_type or ("application/problem+json" if status >= 400 else "application/json"))
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
    environment.update({"MORPHOD_SERVER": server if isinstance(server, str) else server.address, "TZ": "UTC", "LC_ALL": "C.UTF-8"}, **variables)
    done = subprocess.run([MORPHOCTL, *arguments], input=input_text, capture_output=True, text=True, timeout=60, env=environment)
    return done.returncode, done.stdout, done.stderr


def event(number, kind, **data):
    body = {"id": str(number), "type": kind, "job": "7", "at": "2026-11-21T10:00:00.000Z", "data": data}
    return f"id: {number}\nevent: {kind}\ndata: {json.dumps(body)}\n\n"


def test_table_and_request():
    with Server([reply(200, {**JOB, "results": [RESULT]})]) as server:
        status, out, err = run(server, "eval", "--label", "x", "--physics", "n_steps=20", "--record", "com",
                               input_text='{"name": "walker", "cells": [[0,0,0]]}')
        assert status == 0, err
        lines = out.splitlines()
        assert re.match(r"#\s+name\s+design\s+voxels\s+score\s+best\s+worst", lines[0]), out
        assert re.match(rf"0\s+walker\s+{ID}\s+1\s+0\.7500\s+0\.5000\s+1\.0000", lines[1]), out
        assert "\033" not in out + err, "colours without a terminal"
        method, path, headers, body = server.seen[0]
        assert (method, path, headers["Content-Type"]) == ("POST", "/v1/evaluations", "application/json")
        assert headers["Prefer"].startswith("wait=") and re.fullmatch("[0-9a-f]{32}", headers["Idempotency-Key"])
        assert json.loads(body) == {"designs": [{"cells": [[0, 0, 0]]}], "label": "x", "physics": {"n_steps": 20}, "record": ["com"]}


def test_text_of_others_is_not_obeyed():
    """Whoever may submit chooses the label, and a terminal must not obey it."""
    evil = "x\033]0;owned\007\033[2J\u009b31m\x7f\ry"
    with Server([reply(200, {"items": [{**JOB, "label": evil}], "next_cursor": None})]) as server:
        status, out, err = run(server, "job", "list")
        assert status == 0 and "x?]0;owned??[2J?31m??y" in out, out + err
    problem = {"type": "about:blank", "title": evil, "status": 422, "detail": "no" + evil, "errors": [{"detail": evil, "pointer": "/" + evil}]}
    metadata = {"name": "a", "sha256": "a" * 64, "metadata": {"k" + evil: evil}}
    shown = []
    with Server([reply(200, {**JOB, "label": evil, "state": "failed", "error": {"code": "io", "detail": evil}}), reply(200, metadata),
                 reply(422, problem), stream(event(1, "job." + evil.replace("\r", ""), state="a" + evil))] +
                [reply(404, problem)] * 3) as server:
        shown.append(run(server, "job", "show", "7"))
        shown.append(run(server, "controller", "info", "a"))
        shown.append(run(server, "job", "show", "8"))
        shown.append(run(server, "watch", "--retry", "0"))
    for status, out, err in shown:
        assert "31m" in out + err, (status, out, err)
        assert not re.search("[\0-\x09\x0b-\x1f\x7f-\x9f]", out + err), (out, err)


def test_no_proxy_between_loopback_addresses():
    with Server([reply(200, JOB)]) as server:
        assert run(server, "job", "show", "7", "--retry", "0", http_proxy="http://127.0.0.1:1", all_proxy="http://127.0.0.1:1")[0] == 0
        assert server.seen[0][1] == "/v1/jobs/7"


def test_json_is_the_apis():
    evaluation = {**JOB, "results": [RESULT]}
    with Server([reply(200, evaluation)]) as server:
        status, out, _ = run(server, "eval", "--json", input_text=VOXELS)
        assert status == 0 and json.loads(out) == evaluation


def test_waits_for_the_end():
    with Server([reply(202, {**JOB, "state": "queued"}), reply(200, {**JOB, "state": "running", "rollouts_done": 1}), reply(200, JOB),
                 reply(200, {**JOB, "results": [RESULT]})]) as server:
        status, out, _ = run(server, "eval", input_text=ID)
        assert status == 0 and "0.7500" in out
        assert [s[1] for s in server.seen] == ["/v1/evaluations", "/v1/jobs/7", "/v1/jobs/7", "/v1/evaluations/7"]


def test_no_wait():
    with Server([reply(202, {**JOB, "state": "queued"})]) as server:
        status, out, _ = run(server, "eval", "--no-wait", input_text=ID)
        assert (status, out) == (0, "7\n")
        assert "Prefer" not in server.seen[0][2]


def test_failed_job():
    failed = {**JOB, "state": "failed", "error": {"code": "crashed", "detail": "it crashed three times"}}
    with Server([reply(200, failed)]) as server:
        status, _, err = run(server, "eval", input_text=ID)
        assert status == 3 and "it crashed three times" in err


def test_diverged():
    with Server([reply(200, {**JOB, "results": [{**RESULT, "score": None, "losses": [None, 1.0],
                                                 "diverged": [{"environment": 0, "step": 17}]}]})]) as server:
        status, out, _ = run(server, "eval", input_text=ID)
        assert status == 0 and "diverged in 1 of 2 (environment 0, step 17)" in out, out


def test_repeats_with_the_same_key():
    with Server([broken, reply(503, {"title": "busy"}, Retry_After="0"), reply(429, {"title": "busy"}, Retry_After="1"),
                 reply(200, {**JOB, "results": [RESULT]})]) as server:
        status, _, err = run(server, "eval", input_text=ID)
        assert status == 0, err
        keys = {s[2]["Idempotency-Key"] for s in server.seen}
        assert len(server.seen) == 4 and len(keys) == 1
        assert len({s[3] for s in server.seen}) == 1


def test_gives_up():
    with Server([reply(503, {"title": "Draining", "detail": "the service stops"}, Retry_After="30")]) as server:
        status, _, err = run(server, "eval", "--retry", "1", input_text=ID)
        assert status == 7 and "Draining: the service stops (503)" in err, err
    status, _, err = run("127.0.0.1:1", "job", "list", "--retry", "0")
    assert status == 4 and "127.0.0.1:1" in err


def test_faults_are_printed():
    problem = {"type": "about:blank", "title": "Unprocessable Content", "status": 422, "detail": "2 faults", "instance": "/",
               "request_id": "0" * 16, "errors": [{"detail": "not contiguous", "pointer": "/designs/0/cells/1"},
                                                  {"detail": "unknown", "header": "Prefer"}]}
    with Server([reply(422, problem)]) as server:
        status, out, err = run(server, "eval", input_text="[[0,0,0],[5,5,3]]")
        assert status == 6 and out == ""
        assert "/designs/0/cells/1: not contiguous" in err and "Prefer: unknown" in err, err


def test_exit_statuses():
    for code, expected in ((401, 5), (403, 5), (404, 3), (409, 3), (400, 6), (413, 6), (500, 1), (507, 7)):
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
            assert run(server, "job", "show", "7", "--token-file", file.name, MORPHOD_TOKEN="from-a-variable")[0] == 0
            assert run(server, "job", "show", "7")[0] == 0
            assert [s[2].get("Authorization") for s in server.seen] == ["Bearer from-a-variable", "Bearer from-a-file", None]


def test_unix_socket():
    with tempfile.TemporaryDirectory() as folder, Server([reply(200, JOB)], path=folder + "/s") as server:
        status, out, err = run(server, "job", "show", "7")
        assert status == 0 and "succeeded" in out, err


def test_watch_goes_on_after_a_break():
    with Server([reply(200, {**JOB, "state": "running"}), stream(event(3, "job.created", state="queued") + "id: 4\nevent: job.pro"),
                 stream(event(4, "job.progress", state="running", rollouts_done=1, rollouts_total=2) +
                        event(5, "job.finished", state="succeeded"))]) as server:
        status, out, err = run(server, "watch", "7")
        assert status == 0, err
        assert [l.split()[2] for l in out.splitlines()] == ["job.created", "job.progress", "job.finished"], out
        assert server.seen[1][1] == "/v1/events?job=7&after=0" and server.seen[2][2]["Last-Event-ID"] == "3"


def test_watch_a_failure_in_json():
    with Server([reply(200, {**JOB, "state": "running"}), stream(event(5, "job.finished", state="failed"))]) as server:
        status, out, _ = run(server, "watch", "7", "--json")
        assert status == 3 and json.loads(out)["data"] == {"state": "failed"}


def test_trajectories_are_numpy_files():
    data = struct.pack("<6f", *range(6))
    with tempfile.TemporaryDirectory() as folder, \
            Server([reply(200, {**JOB, "results": [RESULT]})] +
                   [reply(200, data, "application/octet-stream", Morphod_Shape="2,3")] * 2) as server:
        status, _, err = run(server, "eval", "--record", "com", "--output", folder + "/out", input_text=ID)
        assert status == 0, err
        assert server.seen[1][1] == "/v1/evaluations/7/trajectories/0?environment=0&array=com"
        with open(folder + "/out/design-0000-environment-01-com.npy", "rb") as file:
            content = file.read()
        assert content[:8] == b"\x93NUMPY\x01\x00"
        length = struct.unpack("<H", content[8:10])[0]
        assert (10 + length) % 64 == 0
        head = content[10:10 + length]
        assert eval(head) == {"descr": "<f4", "fortran_order": False, "shape": (2, 3)} and head.endswith(b"\n")
        assert content[10 + length:] == data
        with open(folder + "/out/evaluation.json", encoding="utf-8") as file:
            assert json.load(file)["id"] == "7"


def test_pages():
    first, second = {"items": [JOB] * 2, "next_cursor": "a/b"}, {"items": [JOB], "next_cursor": None}
    with Server([reply(200, first), reply(200, second)]) as server:
        status, out, _ = run(server, "job", "list", "--all")
        assert status == 0 and len(out.splitlines()) == 4
        assert [s[1] for s in server.seen] == ["/v1/jobs?limit=1000", "/v1/jobs?limit=1000&cursor=a%2Fb"]


def test_verify():
    for agrees, expected in ((True, 0), (False, 3), (None, 3)):
        with Server([reply(200, {**JOB, "results": [{**RESULT, "stored_losses": [0.5, 1.0], "agrees": agrees}]})]) as server:
            status, out, _ = run(server, "verify", VOXELS)
            assert status == expected, out
            assert json.loads(server.seen[0][3])["verify"] is True


def test_verify_an_id_asks_for_its_orientations():
    design = {"id": ID, "orientations": [{"genotype": VOXELS, "scores": []}]}
    with Server([reply(200, design), reply(200, {**JOB, "results": [{**RESULT, "stored_losses": [0.5, 1.0], "agrees": True}]})]) as server:
        assert run(server, "verify", ID)[0] == 0
        assert json.loads(server.seen[1][3])["designs"] == [{"voxels": VOXELS}]


def test_controller_files():
    with tempfile.TemporaryDirectory() as folder:
        path = folder + "/c.safetensors"
        with open(path, "wb") as file:
            file.write(bytes(range(256)) * 100)
        described = {"name": "c", "sha256": "b" * 64}
        with Server([reply(201, described), reply(200, bytes(range(256)) * 100, "application/octet-stream"), reply(204)]) as server:
            assert run(server, "controller", "put", "c", path)[0] == 0
            assert run(server, "controller", "get", "c", "-o", path + ".copy")[0] == 0
            assert run(server, "controller", "delete", "c")[0] == 0
            assert server.seen[0][:2] == ("PUT", "/v1/controllers/c") and server.seen[0][3] == bytes(range(256)) * 100
            with open(path + ".copy", "rb") as file:
                assert file.read() == bytes(range(256)) * 100


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
