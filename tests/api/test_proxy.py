"""Behind nginx, configured as in docs/operations.md: hostile framing does not reach the service as
a second request."""

import json
import os
import pathlib
import re
import shutil
import socket
import subprocess

import pytest

from service import PATIENCE_S, SOURCE, Service, split_replies, tiny_controller, until

HOST = b"Host: lab.example\r\n"
POST = b"POST /v1/evaluations HTTP/1.1\r\n" + HOST + b"Content-Type: application/json\r\n"
GET = b"GET /healthz HTTP/1.1\r\n" + HOST
DELETE = b"DELETE /v1/controllers/tiny HTTP/1.1\r\n" + HOST + b"\r\n"
LENGTH = b"Content-Length: %d" % len(DELETE)
CHUNKED = b"Transfer-Encoding: chunked"

# The last request of each would be executed if nginx and the service disagreed about where the
# first one ends.
HOSTILE = {
    "folded length": POST + LENGTH.replace(b": ", b":\r\n ") + b"\r\n\r\n" + DELETE,
    "folded coding": POST + b"Transfer-Encoding:\r\n chunked\r\n\r\n" + DELETE,
    "folded length": POST + b"Content-Length: 0\r\n 50\r\n\r\n" + DELETE,
    "two lengths": POST + b"Content-Length: 0\r\n" + LENGTH + b"\r\n\r\n" + DELETE,
    "length and coding": POST + LENGTH + b"\r\n" + CHUNKED + b"\r\n\r\n0\r\n\r\n" + DELETE,
    "space before the colon": POST + LENGTH.replace(b":", b" :") + b"\r\n\r\n" + DELETE,
    "coding with a control byte": POST + b"Transfer-Encoding: \x0bchunked\r\n\r\n" + DELETE,
    "NUL in a length": POST + b"Content-Length: 0\x00" + LENGTH[-2:] + b"\r\n\r\n" + DELETE,
    "NUL ends the header": GET + b"\x00: x\r\n" + DELETE,
    "NUL in a name": POST + b"Content-Length\x00: 5\r\n\r\n" + DELETE,
    "bare LF before the length": POST + b"X: 1\n" + LENGTH + b"\r\n\r\n" + DELETE,
    "bare LF ends the header": POST + LENGTH + b"\n\n" + DELETE,
    "bare CR before the length": POST + b"X: 1\r" + LENGTH + b"\r\n\r\n" + DELETE,
    "bare LF between chunks": POST + CHUNKED + b"\r\n\r\n%x\n" % len(DELETE) + DELETE + b"\n0\n\n",
    "field without a name": POST + b": 1\r\n" + LENGTH + b"\r\n\r\n" + DELETE,
}


class Nginx:
    def __init__(self, folder, upstream):
        text = (SOURCE / "docs" / "operations.md").read_text(encoding="utf-8")
        server, = re.findall(r"```nginx\n(.*?)```", text, re.S)
        self.path = folder / "front"
        for given, own in (("127.0.0.1:8080", f"unix:{self.path}"), ("/run/morphod.sock",
                                                                     str(upstream))):
            assert server.count(given) == 1
            server = server.replace(given, own)
        places = "".join(f"{name}_temp_path {folder}/{name};"
                         for name in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi"))
        config = folder / "nginx.conf"
        config.write_text(
            f"daemon off; master_process off; pid {folder}/pid; error_log {folder}/errors; events "
            f"{{}}\n"
            f"http {{ access_log off; {places}\n{server}}}\n")
        program = shutil.which("nginx", path="/usr/sbin:" + os.environ["PATH"])
        assert program, "nginx is missing: tools/packages names it"
        self.process = subprocess.Popen(
            [program, "-e", folder / "errors", "-p", folder, "-c", config],
            stderr=subprocess.DEVNULL)
        until(lambda: self.path.exists())

    def raw(self, data):
        with socket.socket(socket.AF_UNIX) as sock:
            sock.settimeout(PATIENCE_S)
            sock.connect(str(self.path))
            sock.sendall(data)
            received = b""
            try:
                while piece := sock.recv(65536):
                    received += piece
                    sock.settimeout(
                        0.5
                    )  # if nginx keeps the connection, a hidden request is answered now
            except (ConnectionResetError, socket.timeout):
                pass
            return received

    def close(self):
        self.process.terminate()
        self.process.wait(timeout=300)


@pytest.fixture(scope="module")
def behind(tmp_path_factory):
    folder = pathlib.Path(tmp_path_factory.mktemp("proxy"))
    service = Service("--allowed-hosts=lab.example",
                      listen=("127.0.0.1:0", f"unix:{folder / 'socket'}"))
    nginx = Nginx(folder, folder / "socket")
    yield service, nginx
    nginx.close()
    assert service.close() == 0


@pytest.mark.parametrize("name", HOSTILE)
def test_no_hidden_request(behind, name):
    service, nginx = behind
    tiny_controller(service)
    assert HOSTILE[name].count(DELETE) == 1
    received = nginx.raw(HOSTILE[name])
    assert service.request(
        "GET", "/v1/controllers/tiny").status == 200, "the hidden request was carried out"
    assert "method=DELETE" not in service.log_text()
    assert received.count(b"HTTP/1.1 ") == 1, received


def test_requests_pass(behind):
    """The tests above rely on this: the same request by itself is executed, and refusals of the
    service are passed on."""
    service, nginx = behind
    (status, _, body), = split_replies(nginx.raw(GET + b"Connection: close\r\n\r\n"))
    assert status == 200 and json.loads(body)["status"] == "ok"
    assert nginx.raw(GET.replace(b"lab", b"evil") + b"\r\n").startswith(b"HTTP/1.1 403 ")
    tiny_controller(service)
    assert nginx.raw(DELETE).startswith(b"HTTP/1.1 204 ")
    assert service.request("GET", "/v1/controllers/tiny").status == 404
