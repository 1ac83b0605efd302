"""Names of controllers that are damaged: lists serve all others and name these behind them, and every cursor leads on."""

import contextlib
import sqlite3
import subprocess
import urllib.parse

import pytest
from service import BOOTSTRAP, DESIGN, SHORT
from test_damage import unclean
from test_morphoctl import MORPHOCTL

FILE = {"Content-Type": "application/octet-stream"}
WORDS = "controller_names.name is no name"
# As bytes, and as they are shown.
DAMAGED = {
    b"": "", b"{}": "{}", b'a"b': 'a"b', b"x\ny\tz": "x\ny\tz", b"A" * 100: "A" * 64, b"A" * 100 + b"b": "A" * 64, b"b" * 65: "b" * 64,
    b"default\0x": "default", b"~1": "~1", b"\xfe\xffq": "\ufffd\ufffdq", b"zz zz": "zz zz", b"-minus": "-minus", "é".encode(): "é",
}


def pages(service, limit):
    cursor, seen = "", []
    while cursor is not None:
        assert len(seen) < 40
        reply = service.request("GET", f"/v1/controllers?limit={limit}{cursor}")  # and holds it against the contract
        assert reply.status == 200, reply.body
        seen.append(reply.json())
        cursor = None if seen[-1]["next_cursor"] is None else f"&cursor={urllib.parse.quote(seen[-1]['next_cursor'])}"
    return seen


def test_damaged_names(start):
    service = start("--log-format=logfmt")
    for name in ("a-good-one", "m", "n", "zzz"):
        assert service.request("PUT", f"/v1/controllers/{name}", body=BOOTSTRAP.read_bytes(), headers=FILE).status == 201
    whole = service.request("GET", "/v1/controllers").json()["items"]
    with contextlib.closing(sqlite3.connect(service.state / "morphod.db", isolation_level=None)) as database:
        assert database.execute("UPDATE controller_names SET name = '{}' WHERE name = 'n'").rowcount == 1
        for name in DAMAGED.keys() - {b"{}"}:
            database.execute("INSERT INTO controller_names SELECT CAST(? AS TEXT), controller, version, stored_us FROM controller_names WHERE name = 'm'", (name,))
    left = [item for item in whole if item["name"] != "n"]
    entries = sorted(({"id": shown, "kind": "controller", "detail": WORDS} for shown in DAMAGED.values()), key=lambda one: one["id"])
    for limit in (1, 2, 3, len(left), len(left) + 1, len(left) + len(DAMAGED), 1000):
        got = pages(service, limit)
        assert [item for page in got for item in page["items"]] == left
        assert sorted((one for page in got for one in page.get("unreadable", [])), key=lambda one: one["id"]) == entries
        assert all(len(page["items"]) + len(page.get("unreadable", [])) == limit for page in got[:-1])
    line = unclean(service, [service.request("GET", "/v1/controllers")])[-1]
    assert f"controller -minus cannot be read: {WORDS}; " in line and "; and 7 more" in line and "level=warning" in line
    line = unclean(service, [service.request("GET", "/v1/controllers?limit=1&cursor=~7")])[-1]
    assert f'reason="controller x\\ny\\u0009z cannot be read: {WORDS}"' in line
    # Each by itself, where a path can have it; and others as ever.
    for name in ("{}", 'a"b', "~1", "zz zz", "-minus"):
        reply = service.request("GET", f"/v1/controllers/{urllib.parse.quote(name)}")
        assert reply.status == 500 and f"Controller {name} cannot be read: {WORDS}." in reply.json()["detail"], reply.body
    for name in ("default", f"sha256:{whole[0]['sha256']}"):
        assert service.request("GET", f"/v1/controllers/{name}", headers={"Accept": "application/json"}).status == 200
    assert service.request("GET", "/v1/controllers/n").status == 404
    shown = subprocess.run([MORPHOCTL, "controller", "list", "--server", service.addresses[0]], capture_output=True, text=True, timeout=60, check=True)
    assert shown.stderr.count(f"cannot be read by the server: {WORDS}") == len(DAMAGED) and "a-good-one" in shown.stdout
    assert service.evaluate({"designs": [DESIGN], "physics": SHORT}).json()["state"] == "succeeded"


@pytest.mark.parametrize("cursor", ["~", "~0", "~-1", "~x", "~1x", "~99999999999999999999", "{}", "", "UPPER", "a" * 65])
def test_cursors_that_no_page_gave(service, cursor):
    reply = service.request("GET", f"/v1/controllers?cursor={urllib.parse.quote(cursor)}")
    assert reply.status == 400, reply.body


def test_a_cursor_behind_the_last(service):
    reply = service.request("GET", "/v1/controllers?cursor=~999999999999999999")
    assert reply.status == 200 and reply.json() == {"items": [], "next_cursor": None}
