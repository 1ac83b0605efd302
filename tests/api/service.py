"""A running morphod, and a client that holds every reply against the contract."""

import http.client
import json
import os
import pathlib
import signal
import socket
import struct
import subprocess
import tempfile
import time

from contract import SOURCE, Contract

CONTRACT = Contract()
BINARY = os.environ.get("MORPHOD", str(SOURCE / "build" / "src" / "daemon" / "morphod"))
BOOTSTRAP = SOURCE / "data" / "controllers" / "bootstrap.safetensors"
DESIGN = {"cells": [[2, 2, 0], [3, 2, 0], [2, 3, 0], [2, 2, 1]]}
SHORT = {"n_steps": 20}  # physics of evaluations that need no long life


class Reply:
    def __init__(self, status, headers, body):
        self.status, self.headers, self.body = status, headers, body

    def json(self):
        return json.loads(self.body)

    def pointers(self):
        return [fault.get("pointer") for fault in self.json()["errors"]]


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
    def __init__(self,
                 *flags,
                 listen=("127.0.0.1:0", ),
                 state=None,
                 token=None,
                 wait=True,
                 environment=None,
                 stderr=None,
                 user=None):
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
        if not any(flag.startswith("--devices")
                   for flag in flags):  # tests are of processors but where they say otherwise
            command.append("--devices=none")
        environment = {
            **{key: value
               for key, value in os.environ.items() if not key.startswith("MORPHOD")},
            **(environment or {})
        }
        if user is not None:
            os.chown(base, user, user)
            command = ["setpriv", f"--reuid={user}", f"--regid={user}", "--clear-groups", *command]
        self.process = subprocess.Popen(command,
                                        stdout=self.log,
                                        stderr=stderr or self.log,
                                        env=environment)
        deadline = time.monotonic() + 30
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
        """The log, once no more comes: a thread of its own writes it."""
        self.log.flush()
        text = None
        while text != (text := pathlib.Path(self.log.name).read_text(errors="replace")):
            time.sleep(0.05)
        return text

    def stop(self, number=signal.SIGTERM):
        if self.process.poll() is None:
            self.process.send_signal(number)
        return self.process.wait(timeout=30)

    def close(self):
        try:
            return self.stop()
        finally:
            self.log.close()
            self.folder.cleanup()

    def connection(self, timeout=30, unix=False):
        if unix:
            return UnixConnection(self.unix, timeout)
        return http.client.HTTPConnection(self.host, self.port, timeout=timeout)

    def request(self,
                method,
                path,
                value=None,
                body=None,
                headers=None,
                connection=None,
                unix=False):
        """Sends `value` as JSON, or `body` as it is; checks the reply against the contract."""
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
        CONTRACT.check(method, path, reply.status, reply.headers, reply.body)
        return reply

    def evaluate(self, value, wait=30, **headers):
        """An evaluation, waited for."""
        fields = {"Prefer": f"wait={wait}"}
        fields.update({name.replace("_", "-"): text for name, text in headers.items()})
        return self.request("POST", "/v1/evaluations", value, headers=fields)

    def raw(self, data, timeout=10, finish=False):
        """Sends bytes, reads until the other side ends or is silent for a moment; returns (bytes,
        ended)."""
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


def awaited(service, path, holds, seconds=60):
    """What GET gives as soon as holds(it)."""
    deadline = time.monotonic() + seconds
    while True:
        seen = service.request("GET", path).json()
        if holds(seen):
            return seen
        assert time.monotonic() < deadline, f"{seen}\n{service.log_text()[-2000:]}"
        time.sleep(0.01)


def await_end(service, path, seconds=60):
    """The reply that tells of the end of a job."""
    deadline = time.monotonic() + seconds
    while True:
        reply = service.request("GET", path, headers={"Prefer": "wait=10"})
        if reply.json()["state"] in ("succeeded", "failed", "cancelled"):
            return reply
        assert time.monotonic() < deadline, reply.body


def tiny_controller(service):
    """Stores a controller of 1 × 1 × 1 voxels, made here, as "tiny"; returns the file."""
    shapes = {
        "net.0.weight": [256, 13], "net.0.bias": [256], "net.1.weight": [256], "net.1.bias": [256],
        "net.3.weight": [256, 256], "net.3.bias": [256], "net.4.weight": [256], "net.4.bias": [256],
        "net.6.weight": [256, 256], "net.6.bias": [256], "net.7.weight": [256], "net.7.bias": [256],
        "net.9.weight": [24, 256], "net.9.bias": [24]
    }
    header, at = {"__metadata__": {"workspace": "1x1x1"}}, 0
    for name, shape in shapes.items():
        size = 4
        for side in shape:
            size *= side
        header[name] = {"dtype": "F32", "shape": shape, "data_offsets": [at, at + size]}
        at += size
    text = json.dumps(header).encode()
    body = struct.pack("<Q", len(text)) + text + bytes(at)
    put = service.request("PUT",
                          "/v1/controllers/tiny/file",
                          body=body,
                          headers={"Content-Type": "application/octet-stream"})
    assert put.status in (200, 201), put.body
    return body


def split_replies(received):
    """The replies in what a connection gave: [(status, headers in lower case, body)]. Only those
    with Content-Length."""
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
