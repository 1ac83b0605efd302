"""One client cannot lock out the others: rates, connections, memory of bodies, and what counts as
one client."""

import contextlib
import ctypes
import json
import os
import re
import resource
import select
import socket
import time

import pytest

import service as service_module
from service import BOOTSTRAP, CONTRACT, DESIGN, PATIENCE_S, SHORT, until

EVALUATION = {"designs": [DESIGN], "physics": SHORT}
USERS = (4001, 4002)  # without accounts; only root can open connections as these users
IN_FLIGHT = "morphod_http_requests_in_flight"
LIBC = ctypes.CDLL(None)
as_root = pytest.mark.skipif(os.geteuid() != 0, reason="connections of several users need root")


@contextlib.contextmanager
def user(uid):
    """Sockets that are opened inside belong to this user (setfsuid affects only this thread)."""
    LIBC.setfsuid(uid)
    try:
        yield
    finally:
        LIBC.setfsuid(os.geteuid())


def dial(service, uid=None):
    with user(uid) if uid is not None else contextlib.nullcontext():
        return socket.create_connection((service.host, service.port), timeout=300)


def half(sock, size, sent):
    """Sends the beginning of a submission: `sent` of its `size` bytes."""
    sock.sendall(
        b"POST /v1/evaluations HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
        b"Content-Length: %d\r\n\r\n" % size + b" " * sent)
    return sock


def endless(service, **how):
    """Submits a job that never ends."""
    value = EVALUATION | {"priority": "batch", "precision": "float64",
                          "physics": {"n_steps": 100000}}
    job = service.post("/v1/evaluations", value, **how)["id"]
    assert service.act(job, "pause", **how).status in (200, 202)
    return job


def status(sock):
    """Returns the status of the next reply; 0 if the connection closes without one."""
    with contextlib.suppress(ConnectionError):
        return int(sock.recv(65536)[9:12] or 0)
    return 0


def test_rate_covers_whatever_submits_or_stores(start):
    service = start("--client-rate=1")
    upload = {
        "body": BOOTSTRAP.read_bytes(), "headers": {"Content-Type": "application/octet-stream"}
    }
    asked = [("PUT", "/v1/controllers/again/file", upload),
             ("POST", "/v1/evaluations", {"value": EVALUATION}),
             ("POST", "/v1/campaigns/1/extend", {"value": {"generations": 2}}),
             ("POST", "/v1/campaigns/1/champions", {"value": {}})]
    for method, path, content in asked:
        seen = [service.request(method, path, **content) for _ in range(12)]
        refused = [reply for reply in seen if reply.status == 429]
        assert refused, (path, [reply.status for reply in seen])
        assert all(reply.headers["Retry-After"] == "1" for reply in refused)
    # A client that sends too much can still stop its jobs.
    assert 429 not in {service.request("POST", "/v1/jobs/1/pause").status for _ in range(12)}


@as_root
@pytest.mark.parametrize("address", ["127.0.0.1:0", "[::1]:0"])
def test_over_loopback_a_client_is_a_user(start, address):
    try:
        service = start("--client-rate=1", listen=(address, ))
    except RuntimeError:
        pytest.skip(f"{address} is not served here")

    def submit(uid):
        with user(uid):
            return service.request("POST", "/v1/evaluations", EVALUATION).status

    assert 429 in [submit(USERS[0]) for _ in range(12)]
    assert submit(USERS[1]) == 202  # its first
    for uid in USERS:
        assert re.search(rf"{re.escape(address[:-1])}\d+ uid {uid}\b",
                         service.log_text()), service.log_text()[-2000:]


@as_root
def test_a_user_is_one_client_over_tcp_and_the_unix_socket(start, tmp_path):
    service = start("--client-rate=1", listen=("127.0.0.1:0", f"unix:{tmp_path}/socket"))
    seen = [
        service.request("POST", "/v1/evaluations", EVALUATION, unix=i % 2 == 0).status
        for i in range(12)
    ]
    assert 429 in seen[0::2] and 429 in seen[1::2], seen
    with user(USERS[0]):
        assert service.request("POST", "/v1/evaluations", EVALUATION).status == 202


def test_waiting_takes_no_place(start):
    service = start("--max-in-flight=2")
    job = endless(service)
    waiting = [service.connection() for _ in range(20)]
    asking = service.connection()
    for n, connection in enumerate(waiting, 1):
        seen = 0  # times in a row that all these requests are present
        while seen < 3:
            if connection.sock is None or select.select([connection.sock], [], [], 0)[0]:
                if connection.sock is not None:  # two others were not parked yet, or had just ended
                    refused = connection.getresponse()
                    assert refused.status == 429 and refused.read()
                connection.request("GET", f"/v1/evaluations/{job}", headers={"Prefer": "wait=60"})
                seen = 0
            seen = seen + 1 if service.metric(IN_FLIGHT, connection=asking) == n + 1 else 0
    asking.close()
    assert service.act(job, "cancel").status in (200, 202)
    # All get a reply, although they are more than may be in flight.
    for connection in waiting:
        reply = connection.getresponse()
        assert reply.status == 200 and b'"cancelled"' in reply.read()


FLOODS = {
    "bodies": (16, "/v1/bodies/mutate", {"designs": [{"cells": [[0, 0, 0]]}], "children": 10000}),
    "rollouts": (64, "/v1/rollouts", {
        "designs": [{"cells": [[x, y, z] for x in range(6) for y in range(6) for z in range(4)]}],
        "environments": "paper-test", "physics": {"n_steps": 600}}),
}


@pytest.mark.parametrize("flood", FLOODS)
@pytest.mark.parametrize("who", ["user", "token"])
def test_a_heavy_client_delays_no_other_client(start, tmp_path, flood, who):
    """While requests of one client compute, another client gets its lists, rollouts and bodies."""
    if who == "user" and os.geteuid() != 0:
        pytest.skip("connections of several users need root")
    n, path, value = FLOODS[flood]
    tokens = tmp_path / "tokens"
    tokens.write_text("ann read secret-of-ann-1234\nbob read secret-of-bob-1234\n")
    tokens.chmod(0o600)
    service = start(f"--token-file={tokens}")
    body = json.dumps(value).encode()
    head = (f"POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
            "Authorization: Bearer secret-of-ann-1234\r\n"
            f"Content-Length: {len(body)}\r\n\r\n").encode()
    flooding = [dial(service, USERS[0] if who == "user" else None) for _ in range(n)]
    for sock in flooding:
        sock.sendall(head + body)
    until(lambda: service.metric("morphod_http_requests_queued") >= n - 3)
    own = {"Authorization": f"Bearer secret-of-{'ann' if who == 'user' else 'bob'}-1234"}
    one = {"designs": [DESIGN], "environments": "paper-test", "physics": SHORT}
    asked = [("GET", "/v1/jobs?limit=1", None), ("POST", "/v1/rollouts", one),
             ("POST", "/v1/bodies/random", {"count": 3, "seed": 1})]
    for method, where, content in asked * 2:
        assert service.request(method, where, content, headers=own).status == 200
    # Most of the others still wait: later requests did not wait for them.
    assert len(select.select(flooding, [], [], 0)[0]) < n // 2
    for sock in flooding:
        sock.close()


def until_in_flight(service, n):
    """Waits for n requests in addition to this one. This one always uses the same connection:
    otherwise, the end of an earlier request on another connection might be counted late, instead of
    one that has not arrived."""
    asking = service.connection()
    until(lambda: service.metric(IN_FLIGHT, connection=asking) == n + 1)
    asking.close()


def streams(service, n):
    """Opens connections that are never closed in favor of others. One after the other: while they
    are idle, they give way, as to a connection of an earlier check whose end was not seen yet."""
    held = []
    for _ in range(n):
        held.append(dial(service))
        held[-1].sendall(b"GET /v1/events HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert status(held[-1]) == 200
    return held


def await_no_connections(service):
    """Waits until the readiness checks have closed their connections."""
    until(lambda: service.metric("morphod_http_connections") == 1)  # the one that asks


def ended(sock):
    """Returns whether the service has closed it without a reply."""
    sock.settimeout(PATIENCE_S)
    try:
        return sock.recv(100) == b""
    except ConnectionError:
        return True


def is_open(sock):
    sock.setblocking(False)
    try:
        return sock.recv(100) != b""
    except BlockingIOError:
        return True
    except ConnectionError:
        return False


def is_quiet(sock):
    return not select.select([sock], [], [], 0)[0]


def test_idle_connections_give_way_oldest_first(start):
    service = start("--max-connections=64", "--header-timeout=60s")  # 8 of them are kept
    used = service.connection()  # first, but not idle the longest
    used.connect()
    # The readiness checks have closed their connections.
    until(lambda: service.metric("morphod_http_connections", connection=used) == 1)
    working = streams(service, 20)
    waiting = service.connection()
    waiting.request("GET", f"/v1/jobs/{endless(service)}", headers={"Prefer": "wait=60"})
    # The connections that submitted the job are closed, or the first would give way to the last.
    until(lambda: service.metric("morphod_http_connections", connection=used) == 1 + 20 + 1)
    idle = [dial(service) for _ in range(34)]
    until(lambda: service.metric("morphod_http_connections", connection=used) == 1 + 20 + 1 + 34)
    for _ in range(30):
        assert service.request("GET", "/v1/jobs").status == 200
    # At most one for each, or fewer if the connection of an earlier request is already closed.
    gone = service.metric("morphod_http_connections_gave_way_total")
    closed = [not is_open(sock) for sock in idle]
    assert sum(closed) <= gone <= 40 and closed == sorted(closed, reverse=True), (gone, closed)
    assert all(is_open(sock) for sock in working + [used.sock, waiting.sock])
    flood = [dial(service) for _ in range(200)]
    assert service.request("GET", "/v1/jobs").status == 200
    assert sum(closed) >= 1 and ended(used.sock) and all(ended(sock) for sock in idle + flood[:100])
    assert all(is_open(sock) for sock in working + [waiting.sock])


def test_requests_that_stop_coming_give_way(start):
    service = start("--max-connections=8")
    await_no_connections(service)
    held = [half(dial(service), 1000, 10) for _ in range(4)]
    held += [dial(service) for _ in range(3)]
    for sock in held[4:]:
        sock.sendall(b"GET /v1/jobs HTTP/1.1\r\n")
    for _ in range(7):
        assert streams(service, 1)


def test_kept_connections_are_for_health(start, tmp_path):
    service = start("--max-connections=64", listen=("127.0.0.1:0", f"unix:{tmp_path}/socket"))
    await_no_connections(service)
    held = streams(service, 56)
    for _ in range(20):  # more often than there are kept connections
        for path in ("/healthz", "/readyz", "/metrics"):
            assert service.request("GET", path).status == 200
        connection = service.connection()
        reply = service.request("GET", "/v1/jobs", connection=connection)
        assert reply.status == 503 and reply.headers["Retry-After"] and reply.headers[
            "Connection"] == "close"
        connection = service.connection(unix=True)
        assert service.request("GET", "/v1/jobs", connection=connection).status == 200
    # The same holds on the unix socket: the rest is for health checks.
    waiting = [service.connection(unix=True) for _ in range(4)]
    job = endless(service, unix=True)
    until_in_flight(service, 56)
    for connection in waiting:
        connection.request("GET", f"/v1/jobs/{job}", headers={"Prefer": "wait=60"})
    until_in_flight(service, 56 + 4)
    assert service.request("GET", "/v1/jobs", unix=True).status == 503
    assert service.request("GET", "/healthz", unix=True).status == 200
    assert service.request("GET", "/healthz").status == 200
    for sock in held:
        sock.close()
    until(lambda: service.request("GET", "/v1/jobs").status == 200)


def whole(service, size):
    """Returns the status of a submission of this many bytes."""
    body = json.dumps(EVALUATION).ljust(size)
    return service.request("POST", "/v1/evaluations", body=body).status


def test_half_sent_bodies_give_way_to_whole_ones(start):
    # 8 MiB, of which 4 for one client.
    service = start("--max-body=1M", "--max-controller=1M", "--max-bundle=1M")
    held = [half(dial(service), 1000000, 600000) for _ in range(4)]
    for _ in range(20):
        held[0].sendall(b" " * 17000)  # this one continues slowly: its pace is what counts
        time.sleep(0.5)
        if (last := whole(service, 900000)) == 202:
            break
    assert last == 202
    received = [sock.recv(65536) for sock in held[1:] if not is_quiet(sock)]
    assert received
    for reply in received:
        head, _, problem = reply.partition(b"\r\n\r\n")
        assert head.startswith(
            b"HTTP/1.1 503 ") and b"\r\nRetry-After: 1" in head and b"\r\nConnection: close" in head
        CONTRACT.validate({"$ref": "#/components/schemas/Problem"}, json.loads(problem), "503")
    assert service.metric("morphod_http_bodies_gave_way_total") == len(received)
    assert "status=503" in service.log_text()
    assert "other requests needed its memory" in service.log_text()
    assert is_quiet(held[0])


@as_root
def test_unread_replies_take_half_of_the_memory(start):
    """Clients that do not read large replies still leave memory for uploads."""
    # 24 MiB: 12 for one client, 21 for all large bodies and replies.
    service = start("--max-body=1M", "--max-controller=3M", "--max-bundle=1M")
    scene = json.dumps({  # of 4.8 MB
        "designs": [{"cells": [[x, y, 0] for x in range(4) for y in range(3)]}],
        "environments": "paper-test", "physics": "paper", "record": ["masses"],
        "record_stride": 1}).encode()
    seen = []
    for _ in range(5):
        with user(USERS[0]):
            sock = socket.socket(socket.AF_INET)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            sock.connect((service.host, service.port))
        sock.sendall(b"POST /v1/rollouts HTTP/1.1\r\nHost: localhost\r\n"
                     b"Content-Type: application/json\r\nAccept: application/vnd.morphod.scene\r\n"
                     b"Content-Length: %d\r\n\r\n" % len(scene) + scene)
        seen.append((sock, sock.recv(1000)))
    assert [int(head[9:12]) for _, head in seen] == [200, 200, 429, 429, 429]
    assert b"\r\nRetry-After: 5\r\n" in seen[2][1]
    upload = service.request("PUT", "/v1/controllers/mine/file", body=BOOTSTRAP.read_bytes(),
                             headers={"Content-Type": "application/octet-stream"})
    assert upload.status in (200, 201), upload.body
    for sock, _ in seen:
        sock.close()
    # Unread replies are dropped with their connection.
    until(lambda: service.metric(IN_FLIGHT) == 1)
    with user(USERS[0]):
        reply = service.request("POST", "/v1/rollouts", body=scene, headers={
            "Content-Type": "application/json", "Accept": "application/vnd.morphod.scene"})
    assert reply.status == 200 and len(reply.body) > 4500000


@as_root
def test_half_sent_bodies_of_all_users_give_way(start):
    service = start("--max-body=1M", "--max-controller=1M", "--max-bundle=1M")
    held = [half(dial(service, uid), 1000000, 600000) for uid in USERS for _ in range(4)]
    time.sleep(0.5)  # no metric shows that all of them have arrived; they give way after a second
    assert whole(service, 1000) == 202  # from the memory reserved for small ones
    until(lambda: whole(service, 900000) == 202)
    assert not all(is_quiet(sock) for sock in held)


def test_connections_fit_the_limit_of_open_files(start, monkeypatch, tmp_path):
    wrapper = tmp_path / "morphod"
    wrapper.write_text(f'#!/bin/sh\nulimit -n 256\nexec {service_module.BINARY} "$@"\n')
    wrapper.chmod(0o755)
    monkeypatch.setattr(service_module, "BINARY", str(wrapper))
    service = start("--header-timeout=60s")
    held = [dial(service) for _ in range(300)]
    assert service.evaluate(EVALUATION).status == 200
    assert 64 <= service.metric("morphod_http_connections_max") <= 192
    assert re.search(r"warning: the limit on open files .*max_connections=1024 used=\d+",
                     service.log_text())
    assert held


def test_connections_that_fit_need_no_word(start):
    service = start("--max-connections=64")
    assert service.metric("morphod_http_connections_max") == 64
    assert "limit on open files" not in service.log_text()


@as_root
def test_one_user_does_not_shut_out_another(start):
    """64 waits, 1,024 idle connections and four half-sent bodies of one user. Prints the effect on
    another user and on health checks."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, min(hard, 4096)), hard))
    service = start("--header-timeout=10min")
    job = endless(service)
    waiting = [dial(service, USERS[0]) for _ in range(64)]
    for sock in waiting:
        sock.sendall(
            f"GET /v1/jobs/{job} HTTP/1.1\r\nHost: localhost\r\nPrefer: wait=300\r\n\r\n".encode())
    bodies = [half(dial(service, USERS[0]), 30 << 20, 20 << 20) for _ in range(4)]
    until_in_flight(service, 64 + 4)
    idle = [dial(service, USERS[0]) for _ in range(1024)]

    def seconds(ask):
        begun = time.monotonic()
        assert ask().status == 200
        return time.monotonic() - begun

    with user(USERS[1]):
        evaluations = sorted(
            seconds(lambda n=n: service.evaluate({**EVALUATION, "physics": {"n_steps": 20 + n}}))
            for n in range(50))
    health = sorted(seconds(lambda: service.request("GET", "/healthz")) for _ in range(500))
    print(
        f"another user's evaluation: median {evaluations[25] * 1e3:.1f} ms, longest "
        f"{evaluations[-1] * 1e3:.1f} ms; "
        f"/healthz: median {health[250] * 1e3:.2f} ms, p99 {health[495] * 1e3:.2f} ms")
    assert evaluations[-1] < 1 and health[495] < 0.2  # 50 ms where nothing else runs
    assert all(is_quiet(sock) for sock in waiting + bodies) and len(idle) == 1024
