"""Clients that try to exhaust the memory of the service."""

import contextlib
import json
import os
import pathlib
import re
import socket
import time

from service import split_replies, until

N_CONNECTIONS = int(os.environ.get("MORPHOD_TEST_HOSTILE",
                                   "20000"))  # 100000 shows more, but takes minutes
HOST = b"Host: 127.0.0.1\r\n"
POST = b"POST /v1/evaluations HTTP/1.1\r\n" + HOST + b"Content-Type: application/json\r\n"

HOSTILE = {
    "thousands of parameters": b"GET /?" + b"a&" * 15000 + b" HTTP/1.1\r\n",
    "hundreds of parameters": b"GET /?" + b"a=b&" * 1200 + b" HTTP/1.1\r\n" + HOST + b"\r\n",
    "half a header": b"GET /v1/jobs?" + b"a" * 8000 + b" HTTP/1.1\r\n" + HOST + b"X: ",
    "endless line": b"GET /" + b"a" * 40000,
    "endless field": b"GET / HTTP/1.1\r\n" + HOST + b"X: " + b"a" * 40000,
    "endless cookies": b"GET / HTTP/1.1\r\n" + HOST + b"Cookie: " + b"a;" * 4000 + b"\r\n\r\n",
    "malformed chunk": POST + b"Transfer-Encoding: chunked\r\n\r\n4\r\n{\"a\"\r\nzz\r\n",
    "folded length": POST + b"Content-Length:\r\n 50\r\n\r\nDELETE /v1/jobs/1 HTTP/1.1\r\n" + HOST +
    b"\r\n",
    "half a body": POST + b"Content-Length: 60000\r\n\r\n" + b" " * 20000,
    "foreign host": b"GET /v1/jobs HTTP/1.1\r\nHost: evil.example\r\n\r\n",
}


def memory(service):
    """Returns the resident bytes that do not belong to a file."""
    text = pathlib.Path(f"/proc/{service.process.pid}/status").read_text()
    return 1024 * int(re.search(r"RssAnon:\s+(\d+) kB", text)[1])


def attack(service, n, at_once=100):
    """Opens connections in groups: each sends a request, some read the reply, and all
    disconnect."""
    kinds = list(HOSTILE.values())
    for first in range(0, n, at_once):
        with contextlib.ExitStack() as stack:
            group = [
                stack.enter_context(
                    socket.create_connection((service.host, service.port), timeout=300))
                for _ in range(min(at_once, n - first))
            ]
            for i, sock in enumerate(group):
                with contextlib.suppress(ConnectionError):
                    sock.sendall(kinds[i % len(kinds)])
            time.sleep(0.02)
            for sock in group[::3]:
                sock.setblocking(False)
                with contextlib.suppress(ConnectionError, BlockingIOError):
                    sock.recv(4096)


def await_quiet(service):
    """Waits until the service has only this connection."""
    until(lambda: service.metric("morphod_http_connections") == 1)


def test_hostile_connections_leave_nothing_behind(start):
    service = start("--log-level=error", "--header-timeout=1s", "--body-timeout=1s",
                    "--max-connections=2048")
    attack(service, 2000)  # memory that a service allocates once
    await_quiet(service)
    before = memory(service)
    attack(service, N_CONNECTIONS)
    await_quiet(service)
    until(lambda: memory(service) - before <= 8 << 20)
    print(f"{N_CONNECTIONS} connections: {memory(service) - before} bytes more than {before}")
    until(lambda: service.metric("morphod_http_requests_in_flight") == 1)


def test_many_parameters_are_answered(service):
    for n in (600, 1200, 7000):
        target = b"/v1/jobs?" + b"a&" * n
        received, _ = service.raw(b"GET " + target + b" HTTP/1.1\r\n" + HOST +
                                  b"Connection: close\r\n\r\n")
        (status, headers, body), = split_replies(received)
        assert status == 400 and headers["content-type"] == "application/problem+json", received
        assert "unknown parameter" in json.loads(body)["detail"]
