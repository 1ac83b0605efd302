"""A server that replies as a test specifies, or fails, and runs of morphoctl with it."""
import http.server
import json
import os
import shlex
import subprocess
import sys
import threading

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
    "progress": {"rollouts_per_s": None, "seconds_left": None, "busy_s": None},
    "physics": {"dt_s": 0.004, "n_steps": 20, "impact": "exact"}
}
RESULT = {"id": ID, "robot": ID + "@0", "genotype": VOXELS, "voxels": 1, "repaired": 0,
          "fault": None, "score": 0.75, "losses": [0.5, 1.0], "diverged": []}


class Server:
    """Replies come from a list, one for each request: functions, or JSON with status 200. The
    requests are kept."""

    def __init__(self, replies):
        self.replies, self.seen = list(replies), []
        outer = self

        class Handler(http.server.BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def handle_any(self):
                body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
                outer.seen.append((self.command, self.path, dict(self.headers), body))
                answer = outer.replies.pop(0) if outer.replies else reply(500, {"title": "none"})
                (answer if callable(answer) else reply(200, answer))(self)

            do_GET = do_POST = do_PUT = do_DELETE = handle_any

            def log_message(self, *_):
                pass

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
    """Closes the connection without a reply."""
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


def run(server, command, input_text="", **variables):
    environment = {k: v for k, v in os.environ.items() if not k.startswith("MORPHOD_")}
    address = server if isinstance(server, str) else server.address
    environment.update({"MORPHOD_SERVER": address, "TZ": "UTC", "LC_ALL": "C.UTF-8"}, **variables)
    done = subprocess.run([MORPHOCTL, *shlex.split(command)], input=input_text, text=True,
                          capture_output=True, timeout=300, env=environment)
    return done.returncode, done.stdout, done.stderr


def ask(replies, command, status=0, **more):
    """Runs a command with a server that sends these replies, checks its exit status, and returns
    its standard output, its standard error, and the requests."""
    with Server(replies) as server:
        code, out, err = run(server, command, **more)
        assert code == status, (code, out, err)
        return out, err, server.seen


def event(number, kind, **data):
    body = {
        "id": str(number), "type": kind, "job": "7", "at": "2026-11-21T10:00:00.000Z", "data": data
    }
    return f"id: {number}\nevent: {kind}\ndata: {json.dumps(body)}\n\n"
