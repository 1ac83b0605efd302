"""Health, metrics, the contract itself, tokens, Host and Origin, the unix socket, methods and
headers that every path shares."""

import json
import os
import re
import socket
import stat
import subprocess
import threading
import time
from urllib.parse import quote

import pytest

from service import CONTRACT, DESIGN, PATIENCE_S, SHORT, SOON_S, until

TOKEN = "a-token-of-more-than-16-characters"


def test_health(service):
    reply = service.request("GET", "/healthz")
    assert reply.status == 200 and reply.json()["status"] == "ok"
    assert service.request("GET", "/readyz").json()["status"] == "ready"


def plain(node):
    """The contract without its examples, which are in a separate file."""
    if isinstance(node, dict):
        return {key: plain(value) for key, value in node.items() if key != "examples"}
    return [plain(value) for value in node] if isinstance(node, list) else node


def test_index_and_contract(service):
    assert b"openapi.json" in service.request("GET", "/").body
    reply = service.tagged("/openapi.json")
    assert plain(reply.json()) == plain(json.loads(json.dumps(CONTRACT.document)))
    again = service.request("GET", "/openapi.json",
                            headers={"If-None-Match": reply.headers["ETag"]})
    assert again.headers["Content-Length"] == str(len(reply.body)), "the length is that of the 200"


def test_contract_lists_every_operation(service):
    """Every path of the contract exists, with exactly its methods, as Allow shows."""
    examples = {"id": "1", "n": "0", "number": "0", "step": "1", "name": "default",
                "sha256": "0" * 64, "version": "0" * 16, "folder": "lib", "file": "dom.js"}
    for path, item in CONTRACT.document["paths"].items():
        concrete = re.sub(r"\{(\w+)\}", lambda match: examples[match.group(1)], path)
        allow = service.request("OPTIONS", concrete).headers["Allow"].split(", ")
        listed = {method.upper() for method in item} & {"GET", "PUT", "POST", "DELETE", "PATCH"}
        if "GET" in listed:
            listed.add("HEAD")
        assert set(allow) == listed | {"OPTIONS"}, path
        for method in {"GET", "PUT", "POST", "DELETE", "PATCH"} - listed:
            assert service.request(method, concrete).status == 405, (method, path)


def test_head(service):
    for path in ("/healthz", "/metrics", "/v1/jobs", "/v1/controllers",
                 "/v1/controllers/default/file", "/v1/events"):
        reply = service.request("HEAD", path)
        assert reply.status == 200 and reply.body == b""
        assert not path.endswith("/file") or int(reply.headers["Content-Length"]) > 2_000_000


def test_not_found(service):
    service.refuses("", "/nothing", "/v1", "/v2/jobs", "/v1/jobs/0", "/v1/jobs/x",
                    "/v1/jobs/99999999", "/v1/evaluations/01", "/v1/jobs/1e3", "/v1/designs/xyz",
                    "/v1/designs/" + "0" * 36, "/v1/controllers/nobody", "/v1/controllers/UPPER",
                    "/v1/controllers/sha256:" + "0" * 64, "/v1/controllers/nobody/file",
                    "/v1/evaluations/99999999/trajectories/0", "/v1/jobs/" + "9" * 40, status=404)


@pytest.mark.parametrize("query", [
    "/v1/jobs?state=lost", "/v1/jobs?kind=magic", "/v1/jobs?limit=0", "/v1/jobs?limit=1001",
    "/v1/jobs?limit=ten", "/v1/jobs?cursor=x", "/v1/jobs?limit=1&limit=2", "/v1/jobs?color=red",
    "/v1/jobs?state=%zz", "/v1/jobs?cursor=" + "1" * 600, "/v1/designs?sort=age",
    "/v1/designs?order=up", "/v1/designs?controller=default", "/v1/designs?sort=score&cursor=7",
    "/v1/designs?sort=score&environments=moon", "/v1/events?format=xml",
    "/v1/events?format=json&after=-1", "/v1/events?format=json&cursor=x", "/v1/events?cursor=1",
    "/v1/events?format=json&job=x", "/v1/controllers?cursor=A",
    "/healthz?x=1", "/v1/threads?full=1"
])
def test_bad_parameters(service, query):
    reply = service.request("GET", query)
    assert reply.status == 400
    assert all("parameter" in fault for fault in reply.json()["errors"])


def test_accept(service):
    for path, accept, status in (("/v1/jobs", "text/html", 406),
                                 ("/v1/jobs", "text/html, */*;q=0.1", 200),
                                 ("/v1/events", "application/json", 406),
                                 ("/v1/controllers/default", "image/png", 406),
                                 ("/v1/controllers/default/file", "image/png", 406)):
        assert service.request("GET", path, headers={"Accept": accept}).status == status, path


def metrics(service):
    text = service.request("GET", "/metrics").body.decode()
    values, kinds, helped = {}, {}, set()
    for line in text.splitlines():
        if line.startswith("# HELP "):
            helped.add(line.split(" ")[2])
        elif line.startswith("# TYPE "):
            name, kind = line.split(" ")[2:]
            assert name not in kinds and kind in ("counter", "gauge", "histogram")
            kinds[name] = kind
        else:
            label = r'[a-z]+="(?:[^"\\]|\\[\\n"])*"'
            match = re.fullmatch(rf"([a-z_]+)(\{{{label}(,{label})*\}})? (\S+)", line)
            assert match, line
            name = match.group(1)
            family = re.sub("_(bucket|sum|count)$", "", name) if name not in kinds else name
            assert family in kinds and family in helped, line
            assert name.startswith("morphod_") and (kinds[family] != "counter" or
                                                    name.endswith("_total")), line
            assert (name, match.group(2)) not in values, line
            values[name, match.group(2)] = float(match.group(4))
    return values, kinds


def test_metrics(service):
    before, kinds = metrics(service)
    for _ in range(5):
        service.request("GET", "/v1/jobs/123456789")
    key = ("morphod_http_requests_total", '{route="/v1/jobs/{id}",code="404"}')
    # A request is counted once its reply has been sent.
    until(lambda: metrics(service)[0].get(key, 0) - before.get(key, 0) >= 5)
    after, _ = metrics(service)
    assert after[key] - before.get(key, 0) == 5
    for (name, labels), value in before.items():
        if kinds.get(name) == "counter" or name.endswith(("_bucket", "_count")):
            assert after[name, labels] >= value, name
    assert not any("123456789" in str(labels) for _, labels in after)
    buckets = [value for (name, _), value in after.items() if name.endswith("seconds_bucket")]
    assert buckets == sorted(buckets) and buckets[-1] == after[
        "morphod_http_request_duration_seconds_count", None]


def test_threads(service):
    reply = service.request("GET", "/v1/threads").json()
    assert reply["n_threads"] == 1 and "float32" in reply["fingerprints"]["float32"]


@pytest.mark.parametrize("host, status",
                         [("localhost", 200), ("LocalHost:9", 200), ("[::1]:80", 200),
                          ("10.1.2.3", 200), ("robots.example", 403),
                          ("localhost.robots.example", 403), ("127.0.0.1.nip.io", 403), ("", 403)])
def test_host(service, host, status):
    assert service.request("GET", "/healthz", headers={"Host": host}).status == status


def test_origin(service):
    own = f"http://{service.host}:{service.port}"
    assert service.request("GET", "/v1/jobs", headers={"Origin": own}).status == 200
    for origin in ("http://robots.example", "null", f"http://localhost:{service.port}",
                   f"http://{service.host}:1"):
        assert service.request("GET", "/v1/jobs", headers={"Origin": origin}).status == 403, origin


def test_allowed_hosts(start):
    running = start("--allowed-hosts=lab.example")
    for headers, status in (({"Host": "lab.example:8765"}, 200), ({"Host": "other.example"}, 403),
                            ({"Host": "localhost", "Origin": "https://lab.example"}, 200)):
        assert running.request("GET", "/healthz", headers=headers).status == status


def token_file(tmp_path, *tokens):
    path = tmp_path / "token"
    path.write_text("\n".join(tokens) + "\n")
    path.chmod(0o600)
    return path


def test_token_is_needed_beyond_loopback(start, tmp_path):
    with pytest.raises(RuntimeError):
        start(listen=("0.0.0.0:0", ))
    running = start(f"--token-file={token_file(tmp_path, TOKEN)}", listen=("0.0.0.0:0", ),
                    token=TOKEN)
    running.host = "127.0.0.1"
    running.refuses("/v1/jobs", "", status=200)
    running.token = None
    running.refuses("", "/v1/jobs", "/metrics", "/v1/events", "/nothing", status=401)
    running.refuses("", "/healthz", "/readyz", "/openapi.json", "/", status=200)
    for authorization in ("Bearer x", "Bearer " + TOKEN + "x", "Bearer " + TOKEN[:-1],
                          "Basic " + TOKEN, TOKEN, ""):
        headers = {"Authorization": authorization}
        assert running.request("GET", "/v1/jobs", headers=headers).status == 401, authorization


def test_unix_socket(start, tmp_path):
    path = tmp_path / "socket"
    running = start(listen=("127.0.0.1:0", f"unix:{path}"))
    assert stat.S_ISSOCK(os.stat(path).st_mode)
    assert running.request("GET", "/v1/jobs", unix=True).status == 200
    if os.geteuid() == 0:  # another user is refused
        for folder in (tmp_path, *tmp_path.parents[:3]):
            if str(folder).startswith("/tmp/"):
                folder.chmod(0o755)
        done = subprocess.run(["setpriv", "--reuid=65534", "--regid=65534", "--clear-groups",
                               "curl", "-sSi", "--unix-socket", path, "http://x/v1/jobs"],
                              capture_output=True, text=True, check=False)
        assert done.stdout.startswith("HTTP/1.1 403 "), (done.stdout, done.stderr)
        assert "application/problem+json" in done.stdout


def raw_unix(path, lines):
    """Returns the status of a request with these header lines, sent over the unix socket."""
    with socket.socket(socket.AF_UNIX) as sock:
        sock.settimeout(PATIENCE_S)
        sock.connect(str(path))
        sock.sendall("\r\n".join([*lines, "Connection: close", "", ""]).encode())
        return int(sock.makefile("rb").read().split(b" ")[1])


def test_host_on_the_unix_socket(start, tmp_path):
    path = tmp_path / "socket"
    running = start("--allowed-hosts=lab.example", listen=("127.0.0.1:0", f"unix:{path}"))
    get, evil = "GET /v1/jobs HTTP/1.1", "http://evil.example"
    assert raw_unix(path, ["GET /v1/jobs HTTP/1.0"]) == 200
    for host in ("", "localhost", "localhost:8765", "127.0.0.1:8765", "127.8.9.1", "[::1]",
                 "lab.example:80"):
        assert raw_unix(path, [get, f"Host: {host}"]) == 200, host
    for lines in (*([get, f"Host: {host}"] for host in (
            "evil.example:8765", "evil.example", "10.0.0.7", "[fe80::1]",
            "localhost.evil.example")), [f"GET {evil}/v1/jobs HTTP/1.1", "Host: localhost"],
                  [get, "Host: localhost:8765", f"Origin: {evil}:8765"],
                  [get, "Host: localhost:8765", "Origin: null"],
                  [get, "Host:", f"Origin: {evil}"]):
        assert raw_unix(path, lines) == 403, lines
    assert raw_unix(path, [get, "Host: localhost:8765", "Origin: http://localhost:8765"]) == 200
    evaluation = {"designs": [DESIGN], "physics": SHORT}
    page = {"Host": "evil.example:8765", "Origin": f"{evil}:8765"}
    assert running.request("POST", "/v1/evaluations", evaluation, headers=page,
                           unix=True).status == 403
    done = subprocess.run(["curl", "-sS", "--unix-socket", path, "-o", os.devnull, "-w",
                           "%{http_code}", "http://localhost/v1/jobs"],
                          capture_output=True, text=True, check=True)
    assert done.stdout == "200"


@pytest.mark.parametrize("unix", [False, True])
def test_pages_of_other_sites(start, tmp_path, unix):
    running = start("--allowed-hosts=lab.example",
                    listen=("127.0.0.1:0", f"unix:{tmp_path / 'socket'}"))

    def ask(method, path, site):
        headers = {"Host": "lab.example", "Sec-Fetch-Site": site}
        return running.request(method, path, headers=headers, unix=unix)

    for site, status in (("cross-site", 403), ("same-site", 403), ("Cross-Site", 403),
                         ("same-origin", 200), ("none", 200)):
        assert ask("GET", "/v1/jobs", site).status == status, site
        assert ask("GET", "/healthz", site).status == 200, site
    reply = ask("POST", "/v1/jobs/1/cancel", "cross-site")
    assert reply.status == 403 and reply.json()["errors"][0]["header"] == "Sec-Fetch-Site"


def test_slow_clients_are_cut_off(start):
    """Sending a byte now and then does not keep a connection open: the limits count from its
    start."""
    running = start("--header-timeout=1s", "--body-timeout=2s", "--idle-timeout=2s")
    beginnings = {
        "header": (b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nX: ", 1),
        "line": (b"GET /heal", 1), "body": (
            b"POST /v1/evaluations HTTP/1.1\r\nHost: localhost\r\nContent-Type: "
            b"application/json\r\nContent-Length: 1000\r\n\r\n{",
            2), "idle": (b"", 1)
    }
    ended = {}

    def drip(name, beginning):
        with socket.create_connection((running.host, running.port)) as sock:
            begun = time.monotonic()
            sock.settimeout(0.2)
            try:
                sock.sendall(beginning)
                while time.monotonic() - begun < SOON_S:
                    if name != "idle":
                        sock.sendall(b"a")
                    try:
                        if sock.recv(4096) == b"":
                            break
                    except socket.timeout:
                        pass
            except (ConnectionResetError, BrokenPipeError):
                pass
            ended[name] = time.monotonic() - begun

    threads = [
        threading.Thread(target=drip, args=(name, beginning))
        for name, (beginning, _) in beginnings.items()
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for name, (_, limit) in beginnings.items():
        assert limit * 0.8 < ended[name] < SOON_S, ended
    # The same between requests on one connection.
    with socket.create_connection((running.host, running.port)) as sock:
        sock.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
        sock.settimeout(SOON_S)
        begun = time.monotonic()
        while sock.recv(4096):
            pass
        assert 1.5 < time.monotonic() - begun < SOON_S
    assert running.request("GET", "/healthz").status == 200
    values, _ = metrics(running)
    assert values["morphod_http_connections_timed_out_total", None] >= 4


def test_what_is_missing_is_named(service):
    """By the name in the request, which is cut between two characters if it is long."""
    job = "/v1/campaigns/8888/designs/"
    long = "é" * 41
    for path, words in (
            ("/v1/jobs/7777", 'job "7777".'), ("/v1/trainings/7777/steps", 'training "7777".'),
            ("/v1/jobs/x", 'job "x": an id'), ("/v1/controllers/strider", 'controller "strider".'),
            ("/v1/controllers/a%22b", 'controller "a"b".'),
            (f"/v1/controllers/{quote(long)}", f'controller "{long[:40]}…".'),
            (f"/v1/controllers/{quote('x' + long)}", f'controller "x{long[:39]}…".'),
            ("/v1/atlases/flat", 'atlas "flat".'), ("/v1/designs/12", 'design "12": an id'),
            ("/v1/atlases/flat/compare?with=hilly", 'atlas "flat".'),
            ("/v1/designs?sort=score&controller=strider", 'controller "strider".'),
            ("/v1/scores?controller=strider", 'controller "strider".'),
            ("/v1/environment-sets/moon", 'set of environments "moon".'),
            ("/v1/bundles?campaigns=7777", 'campaign "7777".'),
            ("/v1/campaigns/generations?campaigns=7777", 'campaign "7777".'),
            ("/v1/events?job=7777", 'job "7777".'), (f"{job}1", 'campaign "8888".'),
            ("/problems/none", 'type of problem "none".')):
        reply = service.request("GET", path)
        assert reply.status == 404, (path, reply.body)
        assert reply.json()["detail"].startswith(f"There is no {words}"), (path, reply.body)
    reply = service.request("POST", "/v1/fleet/verify", {"origin": "one@there"})
    assert reply.json()["detail"] == 'There is no origin "one@there".'


def test_unknown_parameters_and_where_they_belong(service):
    """A path below may have the parameter."""
    for path, words in (("/v1/evaluations/1?format=csv", "; give it to trajectories/{n}, results or"
                         " environments below it"), ("/v1/trainings/1?stride=2",
                                                     "; give it to steps below it"),
                        ("/v1/evaluations/1?wind=1", ""), ("/v1/jobs?wind=1", "")):
        [fault] = service.request("GET", path).json()["errors"]
        assert fault["detail"] == "unknown parameter for this path" + words, path
