"""A worker in Python: the messages of src/fleet/wire.h, valid and invalid ones, and the server for
workers of a service."""

import base64
import hashlib
import http.client
import json
import re
import ssl
import struct

VERSION = 1
HEADER = struct.Struct("<8sIIQ")
RESULT = struct.Struct("<QQIIdd")
LEASE = struct.Struct("<QQIIII32s")
# Of packed physics, by their version. The third has the integrator of split.
PHYSICS_BYTES = {1: 9 * 8 + 3 * 4, 2: 10 * 8 + 3 * 4, 3: 10 * 8 + 4 * 4}
ENVIRONMENT_BYTES, GENOTYPE_BYTES, GRADIENT_BYTES = 66 * 8, 18, 32
GRADIENT = 2  # flag of a lease
MEASURED = 5  # state of a result


def result(lease, losses, steps=None, state=0, epoch=None, rows=None, measures=None):
    """Encodes the rows of a lease (a pair of epoch and number) for a message. measures: all of
    each row."""
    steps = steps or [0] * len(losses)
    if measures is not None:
        whole = result(lease, losses, steps, MEASURED, epoch, rows)
        return whole + struct.pack("<II", len(measures[0]), 0) + b"".join(
            struct.pack(f"<{len(row)}d", *row) for row in measures)
    return (RESULT.pack(lease[0] if epoch is None else epoch, lease[1], state,
                        len(losses) if rows is None else rows, 0.5, 0.5) +
            struct.pack(f"<{len(losses)}d", *losses) + struct.pack(f"<{len(steps)}I", *steps))


def results(*items, magic=b"MOFLEETR", version=VERSION, n=None, size=None):
    body = b"".join(items)
    return HEADER.pack(magic, version, len(items) if n is None else n,
                       HEADER.size + len(body) if size is None else size) + body


def read_leases(message):
    """Returns pairs of the id of a lease (epoch, number) and its number of rows."""
    magic, version, n, size = HEADER.unpack_from(message)
    assert (magic, version, size) == (b"MOFLEETL", VERSION, len(message))
    at, leases = HEADER.size, []
    for _ in range(n):
        epoch, number, flags, n_environments, n_blocks, n_rows, _ = LEASE.unpack_from(message, at)
        at += LEASE.size + PHYSICS_BYTES[1 + (flags >> 8 & 255)] + 4
        at += n_environments * ENVIRONMENT_BYTES
        at += GRADIENT_BYTES if flags & GRADIENT else 0
        for _ in range(n_blocks):
            at += GENOTYPE_BYTES + 1 + 2 * message[at + GENOTYPE_BYTES]
        leases.append(((epoch, number), n_rows))
    assert at == len(message)
    return leases


def digest(body):
    return "sha-256=:" + base64.b64encode(hashlib.sha256(body).digest()).decode() + ":"


class Workers:
    """The server for workers of a service, as a worker sees it."""
    def __init__(self, service, certificate=None, token=None):
        self.service, self.token = service, token
        scheme, _, address = service.addresses[-1].partition("://")
        assert scheme == ("https" if certificate else "http")
        self.host, port = address.rsplit(":", 1)
        self.port, self.context = int(port), None
        if certificate:
            self.context = ssl.create_default_context(cafile=certificate[0])

    def connection(self, context=None):
        context = context or self.context
        if context:
            return http.client.HTTPSConnection(self.host, self.port, timeout=300, context=context)
        return http.client.HTTPConnection(self.host, self.port, timeout=300)

    def send(self, connection, method, path, body=None, **headers):
        headers = {name.replace("_", "-"): value for name, value in headers.items() if value}
        if self.token:
            headers.setdefault("Authorization", f"Bearer {self.token}")
        connection.request(method, path, body=body, headers=headers)
        return connection

    def request(self, method, path, body=None, connection=None, **headers):
        """Returns status, header and body of a reply."""
        connection = connection or self.connection()
        try:
            reply = self.send(connection, method, path, body, **headers).getresponse()
            return reply.status, reply.headers, reply.read()
        finally:
            connection.close()

    def refuses(self, status, words, *request, **how):
        got, headers, body = self.request(*request, **how)
        assert got == status and headers["Content-Type"] == "application/problem+json", (got, body)
        assert words in json.loads(body)["detail"], body

    def offer(self, **others):
        """Returns the request of a worker that matches this service. The service reveals its canary
        in the refusal of a wrong one."""
        kind = self.service.get("/v1/fleet")["classes"]["cpu"]
        wanted = {"protocol": 7, "name": "node", "host": "node.test", "n_threads": 1,
                  "n_devices": 0, "version": self.service.get("/healthz")["version"],
                  "classes": {"cpu": {"scores": kind["scores"], "gradients": kind["gradients"],
                                      "canary": "0" * 64}}}
        refusal = self.request("POST", "/v1/fleet/sessions", json.dumps(wanted),
                               Content_Type="application/json")
        assert refusal[0] == 409, refusal[2]
        hashes = re.findall("[0-9a-f]{64}", json.loads(refusal[2])["detail"])
        wanted["classes"]["cpu"]["canary"] = next(one for one in hashes if one != "0" * 64)
        return wanted | others

    def join(self, **others):
        """Joins, and returns the path of a new session."""
        status, headers, body = self.request("POST", "/v1/fleet/sessions",
                                             json.dumps(self.offer(**others)),
                                             Content_Type="application/json")
        assert status == 201, body
        assert headers["Location"] == "/v1/fleet/sessions/" + json.loads(body)["session"]
        return headers["Location"]

    def exchange(self, session, body=None, wait=None, **headers):
        body = results() if body is None else body
        headers = {"Content_Type": "application/octet-stream", "Content_Digest": digest(body),
                   "Prefer": wait and f"wait={wait}"} | headers
        return self.request("POST", session + "/exchange", body, **headers)

    def take(self, session, wait=20):
        """Leases."""
        status, headers, body = self.exchange(session, wait=wait)
        assert status == 200 and headers["Content-Digest"] == digest(body), body
        return read_leases(body)

    def orders(self, session, wait=None):
        status, _, body = self.request("GET", session + "/orders", Prefer=wait and f"wait={wait}")
        return json.loads(body) if status == 200 else status

    def status(self):
        return self.service.get("/v1/fleet")
