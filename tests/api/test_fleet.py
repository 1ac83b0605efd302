"""The server for workers of other machines: TLS, tokens, and what it refuses."""

import http.client
import json
import signal
import socket
import ssl
import subprocess

import pytest

from service import until

TOKENS = {"admin": "a-token-that-may-everything-here", "worker": "a-token-of-a-worker-and-no-more"}


@pytest.fixture(scope="module")
def certificate(tmp_path_factory):
    """Files of a certificate for this machine, and of its key."""
    folder = tmp_path_factory.mktemp("certificate")
    files = folder / "certificate.pem", folder / "key.pem"
    subprocess.run(["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt",
                    "ec_paramgen_curve:prime256v1", "-nodes", "-days", "1", "-subj",
                    "/CN=localhost", "-addext", "subjectAltName=DNS:localhost,IP:127.0.0.1",
                    "-out", files[0], "-keyout", files[1]], check=True, capture_output=True)
    files[1].chmod(0o600)
    return files


def write_tokens(path, **lines):
    path.write_text("".join(f"{name} {right} {token}\n" for name, (right, token) in lines.items()))
    path.chmod(0o600)


@pytest.fixture
def tokens(tmp_path):
    path = tmp_path / "tokens"
    write_tokens(path, ada=("admin", TOKENS["admin"]), node=("worker", TOKENS["worker"]))
    return path


class Fleet:
    """The workers' server of a service."""
    def __init__(self, service, certificate=None):
        self.service = service
        scheme, _, address = service.addresses[-1].partition("://")
        assert scheme == ("https" if certificate else "http")
        self.host, port = address.rsplit(":", 1)
        self.port, self.context, self.token = int(port), None, TOKENS["worker"]
        if certificate:
            self.context = ssl.create_default_context(cafile=certificate[0])

    def connection(self, context=None):
        context = context or self.context
        if context:
            return http.client.HTTPSConnection(self.host, self.port, timeout=30, context=context)
        return http.client.HTTPConnection(self.host, self.port, timeout=30)

    def request(self, method, path, body=None, connection=None, **headers):
        """Status, header and body of a reply."""
        headers = {name.replace("_", "-"): value for name, value in headers.items()}
        if self.token:
            headers.setdefault("Authorization", f"Bearer {self.token}")
        connection = connection or self.connection()
        try:
            connection.request(method, path, body=body, headers=headers)
            reply = connection.getresponse()
            return reply.status, reply.headers, reply.read()
        finally:
            connection.close()

    def refuses(self, status, words, *request, **how):
        got, headers, body = self.request(*request, **how)
        assert got == status and headers["Content-Type"] == "application/problem+json", (got, body)
        assert words in json.loads(body)["detail"], body


@pytest.fixture
def fleet(start, tokens, certificate):
    service = start("--fleet-listen=127.0.0.1:0", f"--token-file={tokens}",
                    f"--fleet-certificate={certificate[0]}", f"--fleet-key={certificate[1]}",
                    token=TOKENS["admin"])
    return Fleet(service, certificate)


def test_only_tls_1_3(fleet):
    assert json.loads(fleet.request("GET", "/healthz")[2])["status"] == "ok"
    with fleet.context.wrap_socket(socket.create_connection((fleet.host, fleet.port)),
                                   server_hostname="localhost") as sock:
        assert sock.version() == "TLSv1.3"
    old = ssl.create_default_context()
    old.check_hostname, old.verify_mode = False, ssl.CERT_NONE
    old.maximum_version = ssl.TLSVersion.TLSv1_2
    with pytest.raises(ssl.SSLError):
        fleet.request("GET", "/healthz", connection=fleet.connection(old))
    plain = http.client.HTTPConnection(fleet.host, fleet.port, timeout=30)
    with pytest.raises((http.client.HTTPException, ConnectionError)):
        fleet.request("GET", "/healthz", connection=plain)
    # Refusals that bypass the library are encrypted, too.
    fleet.refuses(431, "too large", "GET", "/healthz", X_Long="x" * 20000)


def test_tokens_open_one_server_each(fleet, tokens):
    service = fleet.service
    fleet.refuses(404, "nothing at this path", "GET", "/v1/whoami")
    for token in (TOKENS["admin"], TOKENS["worker"] + "x", None):
        fleet.token = token
        fleet.refuses(401, "bearer token", "GET", "/v1/whoami")
    fleet.token = TOKENS["worker"]
    fleet.refuses(403, "Host field", "GET", "/healthz", Host="elsewhere.example")
    worker = {"Authorization": "Bearer " + TOKENS["worker"]}
    assert service.request("GET", "/v1/whoami", headers=worker).status == 401
    assert service.get("/v1/whoami")["right"] == "admin"
    # Tokens are read again: that of the worker is another one now.
    other = "the-token-of-another-node"
    write_tokens(tokens, ada=("admin", TOKENS["admin"]), other=("worker", other))
    service.process.send_signal(signal.SIGHUP)
    until(lambda: fleet.request("GET", "/v1/whoami")[0] == 401)
    fleet.token = other
    fleet.refuses(404, "nothing at this path", "GET", "/v1/whoami")


def test_loopback_needs_no_token_where_there_is_none(start, tokens):
    fleet = Fleet(start("--fleet-listen=127.0.0.1:0"))
    fleet.token = None
    fleet.refuses(404, "nothing at this path", "GET", "/v1/whoami")
    # As soon as there is one of a worker, it is needed.
    write_tokens(tokens, ada=("admin", TOKENS["admin"]))
    service = start("--fleet-listen=127.0.0.1:0", f"--token-file={tokens}", token=TOKENS["admin"])
    fleet = Fleet(service)
    fleet.token = None
    fleet.refuses(404, "nothing at this path", "GET", "/v1/whoami")
    write_tokens(tokens, ada=("admin", TOKENS["admin"]), node=("worker", TOKENS["worker"]))
    service.process.send_signal(signal.SIGHUP)
    until(lambda: fleet.request("GET", "/v1/whoami")[0] == 401)
