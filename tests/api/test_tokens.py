"""Tokens with names and rights: which routes they allow, and where names are shown."""

import http.client
import signal
import socket
import threading

import pytest

from relay import relay
from service import CONTRACT, DESIGN, PATIENCE_S, run

TOKENS = {right: f"a-token-that-may-{right}-and-no-more" for right in ("read", "submit", "admin")}
NAMES = {"read": "<b>rita</b>", "submit": "sam", "admin": "ada"}
RIGHTS = list(TOKENS)
# Routes that need more than the right to read; all other methods and paths need only that.
SUBMIT = {("POST", path) for path in (
    "/v1/evaluations", "/v1/trainings", "/v1/campaigns", "/v1/campaigns/{id}/extend",
    "/v1/campaigns/{id}/champions", "/v1/jobs/{id}/cancel", "/v1/jobs/{id}/pause",
    "/v1/jobs/{id}/resume", "/v1/jobs/{id}/weight",
    "/v1/campaigns/{id}/tell", "/v1/campaigns/{id}/finish",
    "/v1/atlases", "/v1/certificates")} | {("PATCH", "/v1/jobs/{id}")}
ADMIN = {("POST", "/v1/bundles"), ("POST", "/v1/scores"), ("PUT", "/v1/controllers/{name}/file"),
         ("DELETE", "/v1/controllers/{name}"), ("PUT", "/v1/atlases/{name}/file"),
         ("DELETE", "/v1/atlases/{name}"),
         ("DELETE", "/v1/trainings/{id}/checkpoints"), ("DELETE", "/v1/jobs/{id}"),
         ("DELETE", "/v1/trainings/{id}/checkpoints/{step}"),
         ("DELETE", "/v1/campaigns/{id}/checkpoints"),
         ("DELETE", "/v1/evaluations/{id}/trajectories"),
         ("POST", "/v1/fleet/sessions/{id}/drain"),
         ("POST", "/v1/fleet/verify")}
WORK = {"designs": [DESIGN], "physics": {"n_steps": 20}}


def as_(right):
    return {"Authorization": "Bearer " + TOKENS[right]}


def write(path, text, mode=0o600):
    path.write_text(text)
    path.chmod(mode)
    return path


@pytest.fixture
def tokens(tmp_path):
    """A file with all rights, and with comments and blank lines."""
    lines = [f"{NAMES[right]}\t{right}   {TOKENS[right]}  # {right}s" for right in RIGHTS]
    return write(tmp_path / "tokens", "# who may do what\n\n" + "\r\n".join(lines) + "\n")


@pytest.fixture
def service(start, tokens):
    return start(f"--token-file={tokens}", "--token-on-loopback=yes", token=TOKENS["admin"])


def routes():
    for path, methods in CONTRACT.document["paths"].items():
        for method in set(methods) & {"get", "head", "post", "put", "patch", "delete"}:
            yield method.upper(), path


def test_every_route_has_its_right(service):
    """A missing right is reported before anything else in the request is checked."""
    assert SUBMIT | ADMIN < set(routes())
    for method, path in routes():
        needed = ("submit" if (method, path) in SUBMIT else
                  "admin" if (method, path) in ADMIN else "read")
        target = path
        for name, value in (("{id}", "77"), ("{n}", "0"), ("{sha256}", "0" * 64), ("{step}", "5"),
                            ("{number}", "1"), ("{version}", "0" * 16), ("{file}", "app.js"),
                            ("{folder}", "lib")):
            target = target.replace(name, value)
        target = target.replace("{name}", "nobody")
        for right in RIGHTS:
            if path == "/v1/events":
                target = path + "?format=json&after=0"
            body = b"{}" if method in ("POST", "PUT", "PATCH") else None
            reply = service.request(method, target, body=body, headers=as_(right))
            if RIGHTS.index(right) >= RIGHTS.index(needed):
                assert reply.status not in (401, 403), (method, path, right)
            else:
                assert reply.status == 403, (method, path, right)
                detail = reply.json()["detail"]
                assert all(word in detail for word in (f'"{needed}"', f'"{right}"', NAMES[right]))
    assert service.get("/v1/jobs")["items"] == []
    assert [one["name"] for one in service.get("/v1/controllers")["items"]
            if one["name"] == "nobody"] == []


def test_a_missing_or_wrong_token(service):
    service.token = None
    for method, path in (("GET", "/v1/whoami"), ("POST", "/v1/evaluations"), ("GET", "/metrics"),
                         ("DELETE", "/v1/controllers/default")):
        body = b"{}" if method == "POST" else None
        assert service.request(method, path, body=body).status == 401
        # Too long, too short, the beginning of another one, and one in another format.
        for token in (TOKENS["read"] + "x", TOKENS["read"][:-1], "", "x" * 600):
            headers = {"Authorization": "Bearer " + token}
            assert service.request(method, path, body=body, headers=headers).status == 401


def test_whoami(service, start):
    for right in RIGHTS:
        assert service.get("/v1/whoami", headers=as_(right)) == {
            "name": NAMES[right], "right": right, "dashboard": "on"}
    free = start("--dashboard=read-only")
    assert free.get("/v1/whoami") == {"name": None, "right": "admin", "dashboard": "read-only"}


def test_who_submitted(service):
    """Every job shows who submitted it, and lists can filter by it."""
    service.token = TOKENS["submit"]
    mine = run(service, "evaluations", WORK)["id"]
    campaign = run(service, "campaigns", {
        "mode": "zero-shot", "population": 4, "generations": 1, "physics": {"n_steps": 20},
        "exclude_pretraining": False, "replicates": 2,
        "environments": [{"light_xy_m": [4.0, 3.0], "terrain_sigma_m": 0.05, "seed": 3}]})
    champions = service.post(f"/v1/campaigns/{campaign['id']}/champions", {"count": 2})
    service.token = TOKENS["admin"]
    theirs = run(service, "evaluations", dict(WORK, label="a label"))["id"]
    assert champions["submitted_by"] == "sam"
    for path, by in ((f"/v1/evaluations/{mine}", "sam"), (f"/v1/jobs/{mine}", "sam"),
                     (f"/v1/campaigns/{campaign['id']}", "sam"), (f"/v1/jobs/{theirs}", "ada")):
        assert service.get(path)["submitted_by"] == by

    def ids(path, query):
        return {one["id"] for one in service.get(f"/v1/{path}?{query}")["items"]}
    assert ids("jobs", "submitted_by=ada") == {theirs}
    assert len(ids("campaigns", "submitted_by=sam")) == 2
    assert ids("evaluations", "submitted_by=sam") == {mine, champions["id"]}
    assert ids("jobs", "submitted_by=ada&label=a%20label&state=succeeded") == {theirs}
    assert ids("jobs", "submitted_by=sam&label=a%20label") == set()
    assert ids("jobs", "submitted_by=nobody") == set()
    for bad in ("", "x" * 65, "%C3%97"):
        reply = service.request("GET", f"/v1/jobs?submitted_by={bad}")
        assert reply.status == 400 and reply.json()["errors"][0]["parameter"] == "submitted_by"


def test_a_submission_without_a_token(start):
    service = start()
    job = run(service, "evaluations", WORK)
    assert job["submitted_by"] is None
    assert service.get(f"/v1/jobs/{job['id']}")["submitted_by"] is None


def test_a_lone_token_is_an_administrators(start, tmp_path):
    path = write(tmp_path / "token", "# two\nthe-old-token-of-this\nthe-new-token-of-this\n")
    service = start(f"--token-file={path}", "--token-on-loopback=yes",
                    token="the-old-token-of-this")
    for token in ("the-old-token-of-this", "the-new-token-of-this"):
        assert service.get("/v1/whoami", headers={"Authorization": f"Bearer {token}"}) == {
            "name": "admin", "right": "admin", "dashboard": "on"}


GOOD = "anna read a-token-of-more-than-16\n"


@pytest.mark.parametrize("text, words", (
    (GOOD + "ben submit\n", ("line 2", "NAME RIGHT TOKEN")),
    (GOOD + "ben submit a token-of-more-than-16\n", ("line 2", "more than three")),
    (GOOD + "\nben write b-token-of-more-than-16\n", ("line 3", "read, submit, admin or worker")),
    (GOOD + "ben submit short-secret\n", ("line 2", "got 12", "16 to 512")),
    (GOOD + "ben submit b-tökèn-of-more-than-16\n", ("line 2", "printable ASCII")),
    (GOOD + "b" * 65 + " submit b-token-of-more-than-16\n", ("line 2", "got 65", "1 to 64")),
    (GOOD + "ben submit a-token-of-more-than-16\n", ("line 2", '"anna"', "its own token")),
    (GOOD + "anna submit b-token-of-more-than-16\n", ("line 2", "one right")),
    ("".join(f"n{i} read token-number-{i:08}\n" for i in range(65)), ("line 65", "64 tokens")),
    ("# nothing\n", ("has no tokens", "NAME RIGHT TOKEN")),
))
def test_errors_of_the_file(start, tmp_path, text, words):
    """Each error names the line, says what to do, and shows no token."""
    path = write(tmp_path / "tokens", text)
    service = start(f"--token-file={path}", wait=False)
    assert service.process.wait(PATIENCE_S) == 78
    log = service.log_text()
    assert all(word in log for word in ("token_file", *words)), log
    for line in filter(None, text.splitlines()):
        secret = line.split()[-1]
        assert len(secret) < 10 or secret not in log


def test_no_token_in_the_log(service, tokens):
    """The log contains names but no tokens, no matter if a token is sent correctly, incorrectly, in
    a query, or reloaded."""
    wrong = "an-unknown-token-of-some-length"
    service.request("GET", "/v1/jobs", headers=as_("read"))
    service.request("DELETE", "/v1/controllers/x", headers=as_("read"))
    service.request("GET", "/v1/jobs", headers={"Authorization": "Bearer " + wrong})
    service.request("GET", f"/v1/jobs?token={TOKENS['read']}", headers=as_("read"))
    write(tokens, f"eve read {TOKENS['read']}\nsam write {wrong}\n")
    service.process.send_signal(1)
    while "reload failed" not in service.log_text():
        pass
    log = service.log_text()
    assert all(secret not in log for secret in (*TOKENS.values(), wrong))
    assert f'user="{NAMES["read"]}"' in log or f"user={NAMES['read']}" in log
    assert "line 2" in log
    # The refused file changed nothing.
    assert service.get("/v1/whoami", headers=as_("read"))["name"] == NAMES["read"]


def test_rights_are_read_again(service, tokens):
    write(tokens, f"rita submit {TOKENS['read']}\nada admin {TOKENS['admin']}\n")
    service.process.send_signal(1)
    while service.get("/v1/whoami", headers=as_("read"))["name"] != "rita":
        pass
    assert service.get("/v1/whoami", headers=as_("read"))["right"] == "submit"
    assert service.request("GET", "/v1/jobs", headers=as_("submit")).status == 401


def test_a_token_on_loopback_and_on_the_unix_socket(start, tokens, tmp_path):
    """Even if no token is needed, a token that is sent counts. A user of the unix socket needs
    none."""
    service = start(f"--token-file={tokens}", listen=("127.0.0.1:0", f"unix:{tmp_path}/socket"))
    for unix in (False, True):
        assert service.get("/v1/whoami", unix=unix)["right"] == "admin"
        assert service.get("/v1/whoami", unix=unix, headers=as_("read"))["right"] == "read"
        assert service.request("POST", "/v1/evaluations", WORK, unix=unix,
                               headers=as_("read")).status == 403
    wrong = {"Authorization": "Bearer of-nobody-in-the-file"}
    assert service.request("GET", "/v1/whoami", headers=wrong).status == 401
    assert service.get("/v1/whoami", unix=True, headers=wrong)["name"] is None


def test_blanks_around_a_token(service):
    for blanks in ("{} ", " {}", "{}\t", "  {}  "):
        header = {"Authorization": "Bearer " + blanks.format(TOKENS["read"])}
        assert service.request("GET", "/v1/whoami", headers=header).status == 200, blanks
    for wrong in (TOKENS["read"][:-1] + " ", TOKENS["read"] + " x"):
        header = {"Authorization": "Bearer " + wrong}
        assert service.request("GET", "/v1/whoami", headers=header).status == 401, wrong


def test_a_revoked_token_loses_its_stream(service, tokens):
    """Streams of the remaining tokens continue."""
    streams = {}
    for right in ("read", "admin"):
        streams[right] = socket.create_connection((service.host, service.port),
                                                  timeout=PATIENCE_S)
        streams[right].sendall(b"GET /v1/events HTTP/1.1\r\nHost: localhost\r\n"
                               b"Authorization: Bearer %s\r\n\r\n" % TOKENS[right].encode())
        assert streams[right].recv(65536).startswith(b"HTTP/1.1 200")
    write(tokens, f"{NAMES['admin']} admin {TOKENS['admin']}\n")
    service.process.send_signal(signal.SIGHUP)
    received = b""
    while not received.endswith(b"0\r\n\r\n"):  # the end of the reply
        assert (more := streams["read"].recv(65536)), received
        received += more
    assert service.evaluate(WORK).status == 200
    while b"job.finished" not in received:
        assert (more := streams["admin"].recv(65536))
        received += more
    for stream in streams.values():
        stream.close()


# ---- the pages ----


def test_the_dashboard_is_off(start):
    service = start("--dashboard=off")
    page = service.request("GET", "/")
    assert page.status == 404 and "dashboard = on" in page.json()["detail"]
    for path in ("/assets/0123456789abcdef/app.js", "/assets/0123456789abcdef/lib/api.js"):
        assert "dashboard = on" in service.request("GET", path).json()["detail"]
    assert service.get("/v1/whoami")["dashboard"] == "off"
    assert service.request("GET", "/v1/jobs").status == 200


def test_no_reply_is_framed_or_read_by_other_sites(service):
    """For any reply: a page, one of its files, JSON, a stream, a refusal, a reply to something that
    is not HTTP."""
    service.token = TOKENS["admin"]
    page = service.request("GET", "/").body.decode()
    script = next(word for word in page.split('"') if word.endswith("app.js"))
    for path in ("/", "/" + script.lstrip("/"), "/v1/jobs", "/metrics", "/openapi.json", "/nothing",
                 "/v1/controllers/default/file", "/v1/jobs?x=1"):
        headers = service.request("GET", path).headers
        assert "frame-ancestors 'none'" in headers["Content-Security-Policy"], path
        assert headers["Cross-Origin-Opener-Policy"] == "same-origin"
        assert headers["Cross-Origin-Resource-Policy"] == "same-origin"
        assert headers["X-Content-Type-Options"] == "nosniff"
    for bad in (b"GET / HTTP/9.9\r\n\r\n", b"GET / HTTP/1.1\r\nHost: x\r\nHost: y\r\n\r\n"):
        with socket.create_connection((service.host, service.port), timeout=PATIENCE_S) as raw:
            raw.sendall(bad)
            head = raw.makefile("rb").read().split(b"\r\n\r\n")[0]
            assert b"Content-Security-Policy: frame-ancestors 'none'" in head


# ---- a socket that is forwarded to a port ----


class Forwarder:
    """Forwards a port of loopback to a unix socket, as `ssh -L port:/path/of/socket` does."""
    def __init__(self, path):
        self.path = path
        self.server = socket.create_server(("127.0.0.1", 0))
        self.port = self.server.getsockname()[1]
        threading.Thread(target=self.accept, daemon=True).start()

    def accept(self):
        while True:
            try:
                near, _ = self.server.accept()
            except OSError:
                return
            far = socket.socket(socket.AF_UNIX)
            far.connect(self.path)
            relay(near, far)

    def status(self, method, path, **headers):
        """Returns the status of a request with only these header fields."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=300)
        connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
        for name, value in headers.items():
            connection.putheader(name.replace("_", "-"), value)
        connection.endheaders()
        status = connection.getresponse().status
        connection.close()
        return status


@pytest.fixture
def forwarded(start, tmp_path):
    service = start(listen=(f"unix:{tmp_path}/socket", ))
    forwarder = Forwarder(service.unix)
    yield forwarder
    forwarder.server.close()


def test_no_page_reaches_a_forwarded_socket(forwarded):
    """A browser sends the host of the page's address; only loopback names are accepted."""
    own = f"localhost:{forwarded.port}"
    for host in (own, f"127.0.0.1:{forwarded.port}", f"[::1]:{forwarded.port}"):
        for path in ("/", "/v1/jobs", "/v1/whoami"):
            assert forwarded.status("GET", path, Host=host) == 200, host
            assert forwarded.status("GET", path, Host=host, Origin=f"http://{host}",
                                    Sec_Fetch_Site="same-origin") == 200
    # A name that resolves to 127.0.0.1 at the second request of the page: DNS rebinding.
    for host in ("rebound.example", f"rebound.example:{forwarded.port}", "localhost.example",
                 f"127.0.0.1.example:{forwarded.port}", "192.0.2.7", "[2001:db8::1]"):
        for method, path in (("GET", "/"), ("GET", "/v1/jobs"), ("POST", "/v1/evaluations")):
            assert forwarded.status(method, path, Host=host) == 403, host
            assert forwarded.status(method, path, Host=host, Origin=f"http://{host}") == 403
    # A page of another site, or of another port, that sends its own origin.
    for origin in ("http://evil.example", "null", "http://localhost:1", "https://localhost"):
        for method in ("GET", "POST", "DELETE"):
            assert forwarded.status(method, "/v1/jobs/1/cancel", Host=own, Origin=origin) == 403
    # A form or an image of another page: no Origin, but the browser sends the site.
    for site in ("cross-site", "same-site"):
        assert forwarded.status("GET", "/v1/jobs", Host=own, Sec_Fetch_Site=site) == 403
        assert forwarded.status("POST", "/v1/jobs/1/cancel", Host=own, Sec_Fetch_Site=site) == 403
