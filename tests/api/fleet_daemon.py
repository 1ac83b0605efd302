"""A fake daemon for tests of `morphod worker`: it issues leases and keeps the results. It
implements the messages that src/fleet/wire.h describes independently."""

import base64
import hashlib
import http.server
import json
import os
import pathlib
import re
import signal
import socket
import ssl
import struct
import subprocess
import tempfile
import threading

from relay import relay
from service import BINARY

HEADER, LEASE, RESULT = struct.Struct("<8sIIQ"), struct.Struct("<QQIIII32s"), \
    struct.Struct("<QQIIdd")
DONE, GIVEN_BACK, FAILED = range(3)
PASSIVE = bytes(32)


def digest(body):
    return "sha-256=:" + base64.b64encode(hashlib.sha256(body).digest()).decode() + ":"


def message(kind, items):
    body = b"".join(items)
    return HEADER.pack(b"MOFLEET" + kind, 1, len(items), HEADER.size + len(body)) + body


def packed_physics(physics):
    """Returns the version and the bytes of a JSON object: a lease uses the first version that has
    all settings that are not the paper's."""
    split = physics["integrator"] == "split"
    version = 3 if split else 2 if physics["control_period_s"] else 1
    names = ("dt_s", "control_period_s", "stiffness_n_per_m", "mass_kg", "drag_per_s",
             "gravity_m_per_s2", "actuation", "friction", "friction_cap", "drop_height_m")
    numbers = [physics[name] for name in names if version > 1 or name != "control_period_s"]
    words = [physics["n_steps"], 0, 8] + [1] * split
    return version, struct.pack(f"<{len(numbers)}d{len(words)}I", *numbers, *words)


def genotype_bytes(text):
    """Encodes a text of 0 and 1."""
    value = sum(1 << v for v, bit in enumerate(text) if bit == "1")
    return value.to_bytes((len(text) + 7) // 8, "little")


class Lease:
    """blocks: [(genotype as text, [environment, …])]; environments: [66 numbers]."""

    def __init__(self, epoch, number, controller, physics, environments, blocks, on_device=False):
        self.id, self.controller, self.on_device = (epoch, number), controller, on_device
        self.physics, self.environments, self.blocks = physics, environments, blocks
        self.rows = sum(len(chosen) for _, chosen in blocks)

    def encode(self):
        version, physics = packed_physics(self.physics)
        head = LEASE.pack(*self.id,
                          int(self.on_device) | version - 1 << 8, len(self.environments),
                          len(self.blocks), self.rows, self.controller) + physics + bytes(4)
        worlds = b"".join(struct.pack("<66d", *numbers) for numbers in self.environments)
        return head + worlds + b"".join(
            genotype_bytes(text) + struct.pack(f"<B{len(chosen)}H", len(chosen), *chosen)
            for text, chosen in self.blocks)


def decode_results(body):
    """Returns [(id, state, busy_s, losses, diverged)] of a message."""
    magic, version, n, size = HEADER.unpack_from(body)
    assert (magic, version, size) == (b"MOFLEETR", 1, len(body))
    at, found = HEADER.size, []
    for _ in range(n):
        epoch, number, state, rows, busy_s, _ = RESULT.unpack_from(body, at)
        at += RESULT.size
        losses = struct.unpack_from(f"<{rows}d", body, at)
        diverged = struct.unpack_from(f"<{rows}I", body, at + 8 * rows)
        at += 12 * rows
        found.append(((epoch, number), state, busy_s, losses, diverged))
    assert at == len(body)
    return found


class FakeDaemon:
    """`answers` (end of the path: function of the handler) replace the action of a route. If the
    function returns False, the route continues."""

    def __init__(self, epoch=1, port=0, tls=None, sessions=1, host="127.0.0.1"):
        self.epoch, self.first_session = epoch, sessions
        self.changed = threading.Condition(threading.RLock())
        self.queue, self.out, self.results, self.controllers = [], {}, [], {}
        self.sessions, self.offers, self.requests, self.answers = {}, [], [], {}
        self.server = http.server.ThreadingHTTPServer((host, port), self.handler())
        self.server.daemon_threads = True
        self.server.handle_error = lambda *_: None  # workers that left
        self.connections = []
        if tls:
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
            context.load_cert_chain(*tls)
            self.server.socket = context.wrap_socket(self.server.socket, server_side=True)
        self.port = self.server.server_address[1]
        self.url = f"http{'s' if tls else ''}://{host}:{self.port}"
        threading.Thread(target=self.server.serve_forever, args=(0.02, ), daemon=True).start()

    def close(self):
        """Ends like a killed process: its connections break."""
        self.server.shutdown()
        self.server.server_close()
        for connection in self.connections:
            try:
                connection.shutdown(2)
            except OSError:
                pass
        with self.changed:
            self.changed.notify_all()

    # Actions of tests. All of them take the lock.

    def give(self, *leases):
        with self.changed:
            self.queue += leases
            self.changed.notify_all()

    def drop(self, *ids):
        with self.changed:
            for session in self.sessions.values():
                session["dropped"] += ids
            for i in ids:
                self.out.pop(i, None)
            self.changed.notify_all()

    def forget(self):
        """Ends all sessions: their requests get no more replies."""
        with self.changed:
            for session in self.sessions.values():
                session["state"] = "lost"
            self.sessions.clear()
            self.out.clear()
            self.changed.notify_all()

    def until(self, holds, seconds=300):
        with self.changed:
            seen = self.changed.wait_for(holds, seconds)
        assert seen, f"it did not happen: {self.requests[-5:]}, {len(self.results)} results"
        return seen

    def done(self, i):
        """Returns the losses of a lease, or None while it is not done."""
        return next((losses for k, state, _, losses, _ in self.results
                     if k == i and state == DONE), None)

    # The routes.

    def join(self, offer):
        number = str(self.first_session + len(self.offers))
        self.offers.append(offer)
        self.forget()  # there is one worker
        self.sessions[number] = {"state": "active", "dropped": [], "held": []}
        return 201, {"session": number, "epoch": str(self.epoch), "silence_s": 6,
                     "workspace": [6, 6, 4], "wait_s": 30}

    def exchange(self, session, body, wait_s):
        for result in decode_results(body):
            self.results.append(result)
            self.out.pop(result[0], None)
            session["held"] = [i for i in session["held"] if i != result[0]]
        self.changed.notify_all()

        def can():
            session["held"] = [i for i in session["held"] if i in self.out]
            if not self.queue or session["state"] != "active":
                return False
            same = [i for i in session["held"]
                    if self.out[i].on_device == getattr(self.queue[0], "on_device", False)]
            return len(same) < 2

        if wait_s and not can():
            self.changed.wait_for(can, wait_s)
        items = []
        while can():
            lease = self.queue.pop(0)
            if isinstance(lease, bytes):  # hostile: sent unchanged
                return lease
            self.out[lease.id] = lease
            session["held"].append(lease.id)
            items.append(lease.encode())
        return message(b"L", items)

    def handler(fake):
        class Handler(http.server.BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def setup(self):
                super().setup()
                fake.connections.append(self.connection)

            def reply(self, status, body=b"", kind="application/json", **headers):
                body = json.dumps(body).encode() if not isinstance(body, bytes) else body
                self.send_response(status)
                headers = {"Content-Type": kind, "Content-Digest": digest(body)} | {
                    name.replace("_", "-"): value for name, value in headers.items()}
                for name, value in headers.items():
                    self.send_header(name, value)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)
                return True

            def problem(self, status, detail=""):
                return self.reply(status, {"title": "no", "status": status, "detail": detail},
                                  "application/problem+json")

            def handle_any(self):
                self.body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
                if self.body:
                    assert self.headers["Content-Digest"] == digest(self.body)
                wait = re.fullmatch(r"wait=(\d+)", self.headers.get("Prefer", ""))
                with fake.changed:
                    fake.requests.append((self.command, self.path))
                    fake.changed.notify_all()
                    for end, answer in list(fake.answers.items()):
                        if self.path.endswith(end) and answer(self) is not False:
                            return
                    self.route(int(wait[1]) if wait else 0)

            def route(self, wait_s):
                path = self.path.removeprefix("/v1/fleet/")
                kind, _, rest = path.partition("/")
                if path == "sessions":
                    self.reply(*fake.join(json.loads(self.body)))
                    return
                if kind == "controllers":
                    body = fake.controllers.get(rest)
                    self.reply(200, body, "application/octet-stream") if body else \
                        self.problem(404)
                    return
                number, _, what = rest.partition("/")
                session = fake.sessions.get(number)
                if session is None:
                    self.problem(404)
                elif what == "exchange":
                    body = fake.exchange(session, self.body, wait_s)
                    self.reply(200, body, "application/octet-stream")
                elif what == "orders":
                    fake.changed.wait_for(lambda: session["dropped"] or
                                          session["state"] != "active" or
                                          number not in fake.sessions, wait_s)
                    if number not in fake.sessions:
                        self.problem(404)
                        return
                    shown = [[str(part) for part in i] for i in session["dropped"]]
                    session["dropped"] = []
                    wanted = {"wanted": session["wanted"]} if "wanted" in session else {}
                    self.reply(200, {"state": session["state"], "dropped": shown} | wanted)
                else:
                    assert self.command == "DELETE" and what == ""
                    fake.forget()
                    self.reply(204)

            def log_message(self, *_):
                pass

            do_GET = do_POST = do_DELETE = handle_any

        return Handler


class Proxy:
    """A proxy for CONNECT."""

    def __init__(self):
        self.asked = []
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self.listener.getsockname()[1]}"
        threading.Thread(target=self.serve, daemon=True).start()

    def serve(self):
        while True:
            try:
                client = self.listener.accept()[0]
            except OSError:
                return
            head = b""
            while not head.endswith(b"\r\n\r\n"):
                head += client.recv(1)
            self.asked.append(head.split(b" ")[1].decode())
            host, port = self.asked[-1].split(":")
            daemon = socket.create_connection((host, int(port)))
            client.sendall(b"HTTP/1.1 200 OK\r\n\r\n")
            relay(client, daemon)

    def close(self):
        self.listener.close()


class Worker:
    def __init__(self, url, *flags, binary=BINARY, environment=None):
        self.folder = tempfile.TemporaryDirectory(prefix="morphod-worker-")
        self.log = open(pathlib.Path(self.folder.name) / "log", "w+b")
        inherited = {key: value for key, value in os.environ.items()
                     if not key.startswith(("MORPHOD", "SLURM"))}
        usual = ["--threads=1"] + ["--devices=none"] * ("--devices=auto" not in flags)
        command = [binary, "worker", f"--server={url}", *usual, *flags]
        self.process = subprocess.Popen(command, stdout=self.log, stderr=self.log,
                                        env=inherited | (environment or {}))

    def log_text(self):
        return pathlib.Path(self.log.name).read_text(errors="replace")

    def ends(self, seconds=300):
        """Returns the exit status."""
        try:
            return self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            raise AssertionError(self.log_text()) from None

    def stop(self):
        """Sends SIGTERM and returns the exit status."""
        self.process.send_signal(signal.SIGTERM)
        return self.ends()

    def close(self):
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        self.log.close()
        self.folder.cleanup()
