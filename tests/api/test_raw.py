"""Requests that no well-behaved client sends, byte by byte. None may hang, crash, be read twice, or
be understood differently by a proxy."""

import json
import os
import random
import select
import socket

import pytest

from service import CONTRACT, split_replies, tiny_controller, until

HOST = b"Host: 127.0.0.1\r\n"
GET = b"GET /healthz HTTP/1.1\r\n" + HOST
POST = b"POST /v1/evaluations HTTP/1.1\r\n" + HOST + b"Content-Type: application/json\r\n"
SMUGGLED = b"GET /v1/threads HTTP/1.1\r\n" + HOST + b"\r\n"
END = b"\r\n"
HIDDEN = b"DELETE /v1/controllers/tiny HTTP/1.1\r\n" + HOST + b"\r\n"

# name: (bytes, allowed statuses; 0: closed without a reply, whether the connection must close)
REFUSED = {
    "no host": (b"GET /healthz HTTP/1.1\r\n\r\n", {400}, True),
    "two hosts": (GET + HOST + END, {400}, True),
    "two equal lengths": (POST + b"Content-Length: 2\r\nContent-Length: 2\r\n\r\n{}", {400}, True),
    "two different lengths": (POST + b"Content-Length: 2\r\nContent-Length: 50\r\n\r\n{}" +
                              SMUGGLED, {400}, True),
    "length and coding": (POST +
                          b"Content-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n" +
                          SMUGGLED, {400}, True),
    "coding and length": (POST +
                          b"Transfer-Encoding: chunked\r\nContent-Length: 5\r\n\r\n0\r\n\r\n" +
                          SMUGGLED, {400}, True),
    "space before the colon": (POST + b"Content-Length : 50\r\n\r\n" + SMUGGLED, {400}, True),
    "tab before the colon": (POST + b"Content-Length\t: 50\r\n\r\n" + SMUGGLED, {400}, True),
    "space in a name": (GET + b"X Y: 1\r\n\r\n", {400}, True),
    "plus in the length": (POST + b"Content-Length: +2\r\n\r\n{}", {400}, True),
    "negative length": (POST + b"Content-Length: -2\r\n\r\n{}", {400}, True),
    "hexadecimal length": (POST + b"Content-Length: 0x2\r\n\r\n{}", {400}, True),
    "list of lengths": (POST + b"Content-Length: 2, 2\r\n\r\n{}", {400}, True),
    "length with letters": (POST + b"Content-Length: 2x\r\n\r\n{}", {400}, True),
    "empty length": (POST + b"Content-Length: \r\n\r\n", {400}, True),
    "endless length": (POST + b"Content-Length: 99999999999999999999999\r\n\r\n{}", {413}, True),
    "length of 2^63": (POST + b"Content-Length: 9223372036854775808\r\n\r\n{}", {400, 413}, True),
    "coding gzip": (POST + b"Transfer-Encoding: gzip\r\n\r\n", {501}, True),
    "coding gzip, chunked": (POST + b"Transfer-Encoding: gzip, chunked\r\n\r\n0\r\n\r\n", {501},
                             True),
    "coding chunked, gzip": (POST + b"Transfer-Encoding: chunked, gzip\r\n\r\n0\r\n\r\n", {501},
                             True),
    "coding xchunked": (POST + b"Transfer-Encoding: xchunked\r\n\r\n0\r\n\r\n", {501}, True),
    "coding identity": (POST + b"Transfer-Encoding: identity\r\n\r\n", {501}, True),
    "coding twice": (POST +
                     b"Transfer-Encoding: chunked\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n",
                     {400}, True),
    "coding in HTTP/1.0": (
        b"POST /v1/evaluations HTTP/1.0\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n", {400, 411
                                                                                          }, True),
    "chunk size not hexadecimal": (POST +
                                   b"Transfer-Encoding: chunked\r\n\r\nzz\r\n{}\r\n0\r\n\r\n",
                                   {400}, True),
    "chunk size overflow": (
        POST + b"Transfer-Encoding: chunked\r\n\r\nFFFFFFFFFFFFFFFFFF\r\n{}\r\n0\r\n\r\n", {413},
        True),
    "negative chunk size": (POST + b"Transfer-Encoding: chunked\r\n\r\n-2\r\n{}\r\n0\r\n\r\n",
                            {400}, True),
    "chunk beyond its size": (POST + b"Transfer-Encoding: chunked\r\n\r\n2\r\n{}{}{}\r\n0\r\n\r\n",
                               {400}, True),
    "NUL escaped in the path": (b"GET /healthz%00 HTTP/1.1\r\n" + HOST + END, {400}, True),
    "NUL escaped in the query": (b"GET /v1/jobs?state=%00 HTTP/1.1\r\n" + HOST + END, {400}, True),
    "NUL in a value": (GET + b"X: a\x00b\r\n\r\n", {0, 200, 400}, False),
    "NUL in a name": (GET + b"X\x00Y: a\r\n\r\n", {0, 200, 400}, False),
    "control byte in a name": (GET + b"X\x01: a\r\n\r\n", {400}, True),
    "control byte in a value": (GET + b"X: a\x01b\r\n\r\n", {400}, True),
    "carriage return in a value": (GET + b"X: a\rb\r\n\r\n", {0, 400}, True),
    "two authorizations": (GET + b"Authorization: x\r\nAuthorization: y\r\n\r\n", {400}, True),
    "empty name": (GET + b": a\r\n\r\n", {0, 200, 400}, False),  # the library drops the line
    "line without a colon": (GET + b"nonsense\r\n\r\n", {400}, True),
    "HTTP/2.0": (b"GET /healthz HTTP/2.0\r\n" + HOST + END, {505}, True),
    "HTTP/9.9": (b"GET /healthz HTTP/9.9\r\n" + HOST + END, {505}, True),
    "not a version": (b"GET /healthz FTP/1.1\r\n" + HOST + END, {400}, True),
    "HTTP/2 preface": (b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", {505}, True),
    "TLS hello": (bytes.fromhex("16030100c8010000c40303") + os.urandom(64) + b"\r\n\r\n",
                  {0, 400, 505}, True),
    "endless target": (b"GET /" + b"a" * 70000 + b" HTTP/1.1\r\n" + HOST + END, {414}, True),
    "long target": (b"GET /" + b"a" * 20000 + b" HTTP/1.1\r\n" + HOST + END, {431}, True),
    "target that fills the memory": (b"GET /" + b"a" * 32700 + b" HTTP/1.1\r\n" + HOST + END, {431},
                                     True),
    "endless field": (GET + b"X: " + b"a" * 70000 + b"\r\n\r\n", {431}, True),
    "long field": (GET + b"X: " + b"a" * 17000 + b"\r\n\r\n", {431}, True),
    "field that fills the memory": (GET + b"X: " + b"a" * 32500 + b"\r\n\r\n", {431}, True),
    "400 fields": (GET + b"X: 1\r\n" * 400 + END, {431}, True),
    "1000 cookies": (GET + b"Cookie: " + b"a;" * 1000 + END + END, {431}, True),
    "space in the target": (b"GET /a b HTTP/1.1\r\n" + HOST + END, {0},
                            True),  # the library says nothing
    "folded length": (POST + b"Content-Length:\r\n %d\r\n\r\n" % len(HIDDEN) + HIDDEN, {400}, True),
    "folded length": (POST + b"Content-Length: 4\r\n 5\r\n\r\n" + HIDDEN, {400}, True),
    "length folded twice": (POST + b"Content-Length:\r\n \r\n\t%d\r\n\r\n" % len(HIDDEN) + HIDDEN,
                            {400}, True),
    "folded coding": (POST + b"Transfer-Encoding:\r\n chunked\r\n\r\n" + HIDDEN, {400}, True),
    "empty coding": (POST + b"Transfer-Encoding:\r\n\r\n" + HIDDEN, {400}, True),
    "200 fields": (GET + b"".join(b"X%d: 1\r\n" % i for i in range(200)) + END, {431}, True),
    "CONNECT": (b"CONNECT example.com:443 HTTP/1.1\r\n" + HOST + END, {400}, True),
    "backslash in the target": (b"GET /v1\\jobs HTTP/1.1\r\n" + HOST + END, {400}, True),
    "fragment in the target": (b"GET /healthz#x HTTP/1.1\r\n" + HOST + END, {400}, True),
    "bytes above ASCII in the target": (b"GET /\xff HTTP/1.1\r\n" + HOST + END, {400}, True),
    "target without a slash": (b"GET healthz HTTP/1.1\r\n" + HOST + END, {400}, True),
    "unknown expectation": (POST + b"Expect: magic\r\nContent-Length: 2\r\n\r\n{}", {417}, True),
    "body longer than declared": (GET + b"\r\n" + b"\x00\x01garbage\r\n\r\n", {200}, False),
}

ANSWERED = {
    "absolute form": (b"GET http://127.0.0.1/healthz HTTP/1.1\r\n" + HOST + END, 200),
    "absolute form, foreign host": (b"GET http://evil.example/healthz HTTP/1.1\r\n" + HOST + END,
                                    403),
    "foreign host": (b"GET /healthz HTTP/1.1\r\nHost: evil.example\r\n\r\n", 403),
    "user in the host": (b"GET /healthz HTTP/1.1\r\nHost: a@127.0.0.1\r\n\r\n", 403),
    "OPTIONS *": (b"OPTIONS * HTTP/1.1\r\n" + HOST + END, 204),
    "GET *": (b"GET * HTTP/1.1\r\n" + HOST + END, 404),
    "method in lower case": (b"get /healthz HTTP/1.1\r\n" + HOST + END, 405),
    "unknown method": (b"BREW /healthz HTTP/1.1\r\n" + HOST + END, 405),
    "TRACE": (b"TRACE /healthz HTTP/1.1\r\n" + HOST + END, 405),
    "path upwards": (b"GET /v1/../../etc/passwd HTTP/1.1\r\n" + HOST + END, 404),
    "escaped traversal": (b"GET /v1/controllers/%2e%2e%2f%2e%2e HTTP/1.1\r\n" + HOST + END, 404),
    "double slash": (b"GET //healthz HTTP/1.1\r\n" + HOST + END, 404),
    "slash at the end": (b"GET /v1/jobs/ HTTP/1.1\r\n" + HOST + END, 404),
    "tab in a value": (GET + b"X: tab\tis fine\r\n\r\n", 200),
    "upgrade": (GET + b"Connection: Upgrade\r\nUpgrade: websocket\r\n\r\n", 200),
    "empty line first": (b"\r\n" + GET + END, 200),
    "HTTP/1.0 without host": (b"GET /healthz HTTP/1.0\r\n\r\n", 200),
    "body without length": (POST + END, 411),
    "body of a GET": (GET + b"Content-Length: 5\r\n\r\nhello", 200),
    "chunks with extensions": (POST + b"Transfer-Encoding: chunked\r\n\r\n2;a=b\r\n{}\r\n0\r\n\r\n",
                               422),
    "chunks with trailers": (POST +
                             b"Transfer-Encoding: chunked\r\n\r\n2\r\n{}\r\n0\r\nX: y\r\n\r\n",
                             422),
    "too large and asks first": (POST + b"Expect: 100-continue\r\nContent-Length: 99999999\r\n\r\n",
                                 413),
}


def alive(service):
    assert service.request("GET", "/healthz").status == 200


@pytest.mark.parametrize("name", REFUSED)
def test_refused(service, name):
    data, statuses, must_end = REFUSED[name]
    if HIDDEN in data:
        tiny_controller(service)
    received, ended = service.raw(data)
    replies = split_replies(received)
    assert (replies[0][0] if replies else 0) in statuses, received
    assert ended or not must_end, "the connection stays open"
    if must_end:
        assert len(replies) <= 1, "trailing bytes were read as another request"
    for status, headers, body in replies:
        if status >= 400:
            assert headers[
                "content-type"] == "application/problem+json" and "x-request-id" in headers, headers
            assert not must_end or headers["connection"] == "close"
            CONTRACT.validate({"$ref": "#/components/schemas/Problem"}, json.loads(body), name)
            assert json.loads(body)["status"] == status
    if HIDDEN in data:
        assert service.request(
            "GET", "/v1/controllers/tiny").status == 200, "the hidden request was carried out"
    alive(service)


@pytest.mark.parametrize("name", ANSWERED)
def test_answered(service, name):
    data, status = ANSWERED[name]
    received, _ = service.raw(data)
    replies = split_replies(received)
    assert [reply[0] for reply in replies] == [status], received
    if status >= 400:
        CONTRACT.validate({"$ref": "#/components/schemas/Problem"}, json.loads(replies[0][2]), name)
    alive(service)


@pytest.mark.parametrize("ending", [b"\n", b"\r"])
def test_bare_line_ends_do_not_hang_or_split(service, ending):
    data = (GET + b"X: 1" + ending + b"Content-Length: 50\r\n\r\n" + SMUGGLED)
    received, _ = service.raw(data, timeout=1)
    assert len(split_replies(received)) <= 1, received
    alive(service)


def test_pipelined(service):
    received, _ = service.raw((GET + END) * 3)
    assert [reply[0] for reply in split_replies(received)] == [200, 200, 200]


def test_refused_body_is_not_the_next_request(service):
    body = SMUGGLED
    received, _ = service.raw(b"POST /nowhere HTTP/1.1\r\n" + HOST +
                              b"Content-Length: %d\r\n\r\n" % len(body) + body + GET + END)
    assert [reply[0] for reply in split_replies(received)] == [404, 200]


def test_noise(service):
    source = random.Random(7)
    seeds = [REFUSED[name][0] for name in REFUSED] + [ANSWERED[name][0] for name in ANSWERED]
    for _ in range(150):
        data = bytearray(source.choice(seeds)[:2000])
        for _ in range(source.randint(1, 6)):
            at = source.randrange(len(data))
            if source.random() < 0.5:
                data[at] = source.randrange(256)
            else:
                del data[at:at + source.randint(1, 8)]
            if not data:
                data = bytearray(b"\r\n")
        service.raw(bytes(data), timeout=0.05, finish=True)
    alive(service)


def test_early_ends(service):
    for data in (b"", b"G", b"GET / HT", GET, POST + b"Content-Length: 50\r\n\r\n{",
                 POST + b"Transfer-Encoding: chunked\r\n\r\n5\r\nab"):
        service.raw(data, timeout=0.2, finish=True)
    alive(service)


def test_endless_chunked_body_is_answered(service):
    """The body is longer than what the service reads and discards, so the reply arrives in the
    middle of it."""
    chunk = b"100000\r\n" + bytes(1 << 20) + b"\r\n"
    with socket.create_connection((service.host, service.port), timeout=300) as sock:
        sock.sendall(b"POST /v1/jobs/1/pause HTTP/1.1\r\n" + HOST +
                     b"Transfer-Encoding: chunked\r\n\r\n")
        for _ in range(200):
            sock.sendall(chunk)
            if select.select([sock], [], [], 0)[0]:
                break
        (status, headers, body), = split_replies(sock.makefile("rb").read())
    assert status == 413 and headers["content-type"] == "application/problem+json" and headers[
        "connection"] == "close"
    assert json.loads(body)["status"] == 413
    alive(service)


def test_last_replies_survive_what_is_still_sent(service):
    """Closing with unread bytes resets a connection, which may discard the reply."""
    for data in (GET + b"X: " + b"a" * 2000000, b"GET /" + b"a" * 2000000,
                 POST + b"Content-Length: x\r\n\r\n" + bytes(2000000)):
        with socket.create_connection((service.host, service.port), timeout=300) as sock:
            sock.sendall(data)
            (status, _, _), = split_replies(sock.makefile("rb").read())
            assert status in (400, 414, 431)


def test_what_the_library_refuses_is_logged_and_counted(start):
    service = start()
    service.raw(b"GET /" + b"a" * 70000 + b" HTTP/1.1\r\n" + HOST + END)
    service.raw(b"GET /healthz HTTP/3.0\r\n" + HOST + END)
    wanted = [
        'morphod_http_requests_total{route="other",code="414"} 1\n',
        'morphod_http_requests_total{route="other",code="505"} 1\n',
        "morphod_http_requests_in_flight 1\n"
    ]
    # They end just after their replies.
    until(lambda: all(line in service.request("GET", "/metrics").body.decode() for line in wanted))
    assert "status=414" in service.log_text() and "status=505" in service.log_text()
