"""A running morphod, and a client that checks every reply against the contract."""

import atexit
import contextlib
import csv
import functools
import gzip
import http.client
import io
import json
import math
import os
import pathlib
import re
import shutil
import signal
import socket
import struct
import subprocess
import tempfile
import time

from contract import SOURCE, Contract

CONTRACT = Contract()
BINARY = os.environ.get("MORPHOD", str(SOURCE / "build" / "src" / "daemon" / "morphod"))
DESIGN = {"cells": [[2, 2, 0], [3, 2, 0], [2, 3, 0], [2, 2, 1]]}
SHORT = {"n_steps": 20}  # physics of evaluations that need no long rollout
# A wait ends when its condition holds; a test fails after this limit. The limit is far above the
# usual time, because the machine may be slow and busy.
PATIENCE_S = 300
# An immediate reply arrives within this many seconds even on such a machine. Anything that the
# reply must not wait for takes longer.
SOON_S = 20


def with_metadata(file, **metadata):
    """Returns the bytes of a safetensors file with further metadata."""
    size = struct.unpack("<Q", file[:8])[0]
    header = json.loads(file[8:8 + size])
    header["__metadata__"].update(metadata)
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + file[8 + size:]


def held_bootstrap():
    """Stores the bootstrap controller with the default control period in a temporary file."""
    folder = tempfile.mkdtemp(prefix="morphod-bootstrap-")
    atexit.register(shutil.rmtree, folder)
    os.chmod(folder, 0o755)  # for daemons of other users
    path = pathlib.Path(folder) / "bootstrap.safetensors"
    path.write_bytes(
        with_metadata((SOURCE / "data" / "controllers" / path.name).read_bytes(),
                      control_period_s="0.016"))
    return path


BOOTSTRAP = held_bootstrap()


class Reply:
    def __init__(self, status, headers, body):
        self.status, self.headers, self.body = status, headers, body

    def json(self):
        return json.loads(self.body)

    def pointers(self):
        return [fault.get("pointer") for fault in self.json()["errors"]]


def decoded(reply):
    """Returns the body of a reply, decompressed if necessary."""
    packed = reply.headers.get("Content-Encoding") == "gzip" and reply.body
    return gzip.decompress(reply.body) if packed else reply.body


class UnixConnection(http.client.HTTPConnection):
    def __init__(self, path, timeout):
        super().__init__("localhost", timeout=timeout)
        self.path = path

    def connect(self):
        self.sock = socket.socket(socket.AF_UNIX)
        self.sock.settimeout(self.timeout)
        self.sock.connect(self.path)


class Service:
    """Starts the daemon on a free port (or as `listen` says) with its state in a temporary folder.
    """
    def __init__(self, *flags, listen=("127.0.0.1:0", ), state=None, token=None, wait=True,
                 environment=None, stderr=None, user=None):
        self.folder = tempfile.TemporaryDirectory(prefix="morphod-test-")
        base = pathlib.Path(self.folder.name)
        self.state = pathlib.Path(state) if state else base / "state"
        self.state.mkdir(mode=0o700, exist_ok=True)
        self.token = token
        self.log = open(base / "log", "w+b")
        port_file = base / "addresses"
        command = [BINARY, f"--state-dir={self.state}", f"--port-file={port_file}", "--workers=1"]
        command += [f"--listen={address}" for address in listen]
        command += [f"--default-controller={BOOTSTRAP}", *flags]
        # Unless a test says otherwise, it uses the processors, and a stop parks running work: how
        # much is left after a restart must not depend on the machine's speed.
        for flag in ("--devices=none", "--drain-timeout=0s"):
            if not any(given.startswith(flag.split("=")[0]) for given in flags):
                command.append(flag)
        inherited = {key: value for key, value in os.environ.items()
                     if not key.startswith("MORPHOD")}
        if user is not None:
            os.chown(base, user, user)
            command = ["setpriv", f"--reuid={user}", f"--regid={user}", "--clear-groups", *command]
        self.process = subprocess.Popen(command, stdout=self.log, stderr=stderr or self.log,
                                        env=inherited | (environment or {}))
        deadline = time.monotonic() + PATIENCE_S
        while wait and not (port_file.exists() and
                            port_file.read_text().count("\n") >= len(listen)):
            if self.process.poll() is not None or time.monotonic() > deadline:
                self.stop()
                raise RuntimeError("morphod did not start:\n" + self.log_text())
            time.sleep(0.02)
        self.addresses = port_file.read_text().split() if wait else []
        tcp = [address for address in self.addresses if address.startswith("http://")]
        if tcp:
            self.host, port = tcp[0][len("http://"):].rsplit(":", 1)
            self.host, self.port = self.host.strip("[]"), int(port)
        self.unix = next((address[len("unix:"):]
                          for address in self.addresses if address.startswith("unix:")), None)
        while wait and tcp and self.request("GET", "/readyz").status != 200:
            time.sleep(0.02)

    def log_text(self):
        """Returns the log once it is complete: a separate thread writes it."""
        self.log.flush()
        text = None
        while text != (text := pathlib.Path(self.log.name).read_text(errors="replace")):
            time.sleep(0.05)
        return text

    def stop(self, number=signal.SIGTERM):
        if self.process.poll() is None:
            self.process.send_signal(number)
        return self.process.wait(timeout=PATIENCE_S)

    def close(self):
        try:
            return self.stop()
        finally:
            self.log.close()
            self.folder.cleanup()

    def connection(self, timeout=PATIENCE_S, unix=False):
        if unix:
            return UnixConnection(self.unix, timeout)
        return http.client.HTTPConnection(self.host, self.port, timeout=timeout)

    def request(self, method, path, value=None, body=None, headers=None, connection=None,
                unix=False):
        """Sends `value` as JSON, or `body` unchanged. Checks the reply against the contract."""
        headers = dict(headers or {})
        if value is not None:
            body = json.dumps(value)
        if body is not None:
            headers.setdefault("Content-Type", "application/json")
        if self.token:
            headers.setdefault("Authorization", f"Bearer {self.token}")
        own = connection is None
        connection = connection or self.connection(unix=unix)
        try:
            connection.request(method, path, body=body, headers=headers)
            response = connection.getresponse()
            reply = Reply(response.status, response.headers, response.read())
        finally:
            if own:
                connection.close()
        CONTRACT.check(method, path, reply.status, reply.headers, decoded(reply))
        return reply

    def get(self, path, **how):
        """Returns the JSON of a resource."""
        reply = self.request("GET", path, **how)
        assert reply.status == 200, reply.body
        return reply.json()

    def post(self, path, value=None, **how):
        """Returns the JSON reply to a request that must be accepted."""
        reply = self.request("POST", path, value, **how)
        assert reply.status in (200, 202), reply.body
        return reply.json()

    def act(self, job, verb, **how):
        """Pauses, resumes or cancels a job, and returns the reply."""
        return self.request("POST", f"/v1/jobs/{job}/{verb}", **how)

    def withdraw(self, job):
        """Cancels a job whose settings are all that matters. On a fast machine it has ended."""
        assert self.act(job, "cancel").status in (200, 202, 409)

    def upload(self, name, file):
        """Uploads the file of a controller, and returns the reply."""
        return self.request("PUT", f"/v1/controllers/{name}/file", body=file,
                            headers={"Content-Type": "application/octet-stream"})

    def pages(self, path, limit=1000):
        """Returns all items of a list, page by page."""
        items, cursor = [], ""
        query = path + ("&" if "?" in path else "?") + f"limit={limit}"
        while cursor is not None:
            page = self.get(query + (f"&cursor={cursor}" if cursor else ""))
            assert len(page["items"]) <= limit
            items += page["items"]
            cursor = page["next_cursor"]
        return items

    def table(self, path, **headers):
        """Returns the rows of a CSV."""
        reply = self.request("GET", path, headers=headers)
        assert reply.headers["Content-Type"].startswith("text/csv")
        return list(csv.DictReader(io.StringIO(reply.body.decode())))

    def tagged(self, path):
        """Returns a reply with an ETag. Checks that it is not sent again to a client that has it,
        and that HEAD shows the tag."""
        reply = self.request("GET", path)
        again = self.request("GET", path, headers={"If-None-Match": reply.headers["ETag"]})
        assert reply.status == 200 and again.status == 304 and again.body == b"", path
        assert self.request("HEAD", path).headers["ETag"] == reply.headers["ETag"]
        return reply

    def refuses(self, path, *queries, status=400):
        for query in queries:
            assert self.request("GET", path + query).status == status, path + query

    def metric(self, name, **how):
        """Returns a number of /metrics without labels, or None if it is absent."""
        text = self.request("GET", "/metrics", **how).body.decode()
        found = re.search(rf"^{name} (\S+)$", text, re.M)
        return json.loads(found[1]) if found else None

    def evaluate(self, value, wait=30):
        """Evaluates, waits for the end, and returns the reply."""
        return self.request("POST", "/v1/evaluations", value, headers={"Prefer": f"wait={wait}"})

    def raw(self, data, timeout=PATIENCE_S, finish=False):
        """Sends bytes, and reads until the other side closes or is silent for a moment. Returns
        (bytes, ended)."""
        with socket.create_connection((self.host, self.port), timeout=timeout) as sock:
            received, ended = b"", False
            try:
                sock.sendall(data)
                if finish:
                    sock.shutdown(socket.SHUT_WR)
                sock.settimeout(timeout)
                while True:
                    piece = sock.recv(65536)
                    if not piece:
                        ended = True
                        break
                    received += piece
                    sock.settimeout(0.15)
            except (ConnectionResetError, BrokenPipeError):
                ended = True
            except socket.timeout:
                pass
            return received, ended


@contextlib.contextmanager
def soon():
    """Checks that the statements inside need not wait for anything else."""
    begun = time.monotonic()
    yield
    took = time.monotonic() - begun
    assert took < SOON_S, f"{took:.1f} s"


def rest(begun, least_s):
    """Sleeps between two looks at something that has been awaited since `begun`: longer after a
    long wait, so that looking takes little processor time, and is late by a fiftieth at most."""
    time.sleep(max(least_s, min((time.monotonic() - begun) / 50, 0.1)))


def until(holds, seconds=PATIENCE_S, every=0.02):
    """Waits until holds() is true, and returns its value."""
    begun = time.monotonic()
    while not (seen := holds()):
        assert time.monotonic() < begun + seconds, "it did not happen"
        rest(begun, every)
    return seen


def awaited(service, path, holds, seconds=PATIENCE_S):
    """Returns the JSON of GET as soon as holds(it)."""
    begun = time.monotonic()
    while not holds(seen := service.get(path)):
        assert time.monotonic() < begun + seconds, f"{seen}\n{service.log_text()[-2000:]}"
        rest(begun, 0.01)
    return seen


def await_end(service, path, seconds=PATIENCE_S):
    """Returns the reply that shows the end of a job."""
    deadline = time.monotonic() + seconds
    while True:
        reply = service.request("GET", path, headers={"Prefer": "wait=10"})
        if reply.json()["state"] in ("succeeded", "failed", "cancelled"):
            return reply
        assert time.monotonic() < deadline, reply.body


def run(service, kind, value, seconds=PATIENCE_S):
    """Submits a job and returns it once it has succeeded."""
    path = f"/v1/{kind}/{service.post(f'/v1/{kind}', value)['id']}"
    done = await_end(service, path, seconds).json()
    assert done["state"] == "succeeded", done
    return done


def at(row, path):
    """Returns row["a"]["b"] for "a.b"."""
    return functools.reduce(dict.get, path.split("."), row)


def check_rows(service, path, rows, columns, cursor, **others):
    """Checks that a list of rows is available in pages, after the cursor of a row, and as CSV with
    its columns (name: place in a row), with tags, and in no other form. others: further members of
    a page."""
    for media in ({}, {"Accept": "text/csv"}):
        service.tagged(path + ("?format=csv" if media else ""))
        whole = service.request("GET", path + "?format=json", headers=media)
        assert whole.json() == {"items": rows, "next_cursor": None} | others
    first = service.get(path + "?limit=2")
    assert first["items"] == rows[:2] and first["next_cursor"] == cursor(rows[1])
    assert service.get(f"{path}?cursor={first['next_cursor']}")["items"] == rows[2:]
    assert service.pages(path, 1) == rows
    none = {"items": [], "next_cursor": None} | others
    assert service.get(f"{path}?cursor={cursor(rows[-1])}") == none
    lines = service.table(path + "?format=csv")
    assert lines == service.table(path, Accept="text/csv")
    assert len(service.table(path + f"?format=csv&limit=1&cursor={cursor(rows[0])}")) == 1
    for name in columns:
        place = columns[name] if isinstance(columns, dict) else name
        shown = ["" if at(row, place) is None else at(row, place) for row in rows]
        assert [type(value)(line[name]) for line, value in zip(lines, shown)] == shown, name
    service.refuses(path, "?limit=0", "?limit=1001", "?cursor=x", "?cursor=-1", "?format=newick")
    assert service.request("GET", path, headers={"Accept": "image/png"}).status == 406


def tiny_controller(service):
    """Makes a controller of 1 × 1 × 1 voxels, stores it as "tiny", and returns the file."""
    shapes = {
        "net.0.weight": [256, 13], "net.0.bias": [256], "net.1.weight": [256], "net.1.bias": [256],
        "net.3.weight": [256, 256], "net.3.bias": [256], "net.4.weight": [256], "net.4.bias": [256],
        "net.6.weight": [256, 256], "net.6.bias": [256], "net.7.weight": [256], "net.7.bias": [256],
        "net.9.weight": [24, 256], "net.9.bias": [24]
    }
    header, at = {"__metadata__": {"workspace": "1x1x1"}}, 0
    for name, shape in shapes.items():
        size = 4 * math.prod(shape)
        header[name] = {"dtype": "F32", "shape": shape, "data_offsets": [at, at + size]}
        at += size
    text = json.dumps(header).encode()
    body = struct.pack("<Q", len(text)) + text + bytes(at)
    put = service.upload("tiny", body)
    assert put.status in (200, 201), put.body
    return body


def split_replies(received):
    """Splits the bytes of a connection into replies: [(status, headers in lower case, body)]. Only
    for replies with Content-Length."""
    replies = []
    while received:
        head, separator, rest = received.partition(b"\r\n\r\n")
        assert separator, received
        lines = head.decode("latin-1").split("\r\n")
        status = int(lines[0].split(" ")[1])
        headers = {}
        for line in lines[1:]:
            name, _, value = line.partition(":")
            headers[name.lower()] = value.strip()
        if status == 100:
            received = rest
            continue
        length = int(headers.get("content-length", 0))
        replies.append((status, headers, rest[:length]))
        received = rest[length:]
    return replies
