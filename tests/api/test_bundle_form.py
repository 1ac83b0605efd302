"""Bundles have exactly one form, and the time to read one is bounded by its size."""

import json
import os
import pathlib
import resource
import time

import pytest

from archives import altered, pack, put, unpack, zstd
from service import DESIGN, run, until

ZSTD = {"Content-Type": "application/zstd"}
HERE = [{"light_xy_m": [4.0, 3.0], "terrain_sigma_m": 0.05, "seed": 3}]


def enter(service, bundle, mode="enter"):
    return service.request("POST", f"/v1/bundles?mode={mode}", body=bundle, headers=ZSTD)


@pytest.fixture(scope="module")
def bundles(service):
    """Returns the members of a bundle of two campaigns with scores and recordings, and of a bundle
    of a campaign that learned.
    """
    base = {"population": 16, "generations": 3, "physics": {"n_steps": 5}, "environments": HERE,
            "exclude_pretraining": False}
    ids = [run(service, "campaigns", base | {"mode": "zero-shot", "seed": seed,
                                             "initial": {"designs": [DESIGN]}})["id"]
           for seed in (1, 2)]
    service.evaluate({"designs": [DESIGN], "environments": HERE, "physics": {"n_steps": 5},
                      "record": ["com"]})
    learned = run(service, "campaigns", base | {
        "mode": "few-shot", "name": "walker",
        "learning": {"parent_steps": 1, "child_steps": 2, "batch": 4}})["id"]
    return [unpack(service.request("GET", f"/v1/bundles?campaigns={which}&recordings=true").body)
            for which in (",".join(ids), learned)]


def renamed(members, old, new):
    assert any(old in name for name, _ in members)
    return [(name.replace(old, new), body) for name, body in members]


def without(members, part):
    kept = [(name, body) for name, body in members if part not in name]
    assert len(kept) < len(members)
    return kept


def twice(members, part, name=lambda name: name):
    at = next(i for i, (own, _) in enumerate(members) if part in own)
    own, body = members[at]
    return members[:at + 1] + [(name(own), body)] + members[at + 1:]


def head(members, change):
    return [(name, change(body)) if name == "bundle.json" else (name, body)
            for name, body in members]


def second(name):
    return name.replace("00000000", "00000001")


def cut(members, part):
    """Removes the last byte of a part: the end of its last line."""
    return [(name, body[:-1] if part in name else body) for name, body in members]


def test_no_second_form(service, start, bundles):
    """A bundle in another form could import the same campaign again, under another digest."""
    other = start()
    two, learned = bundles
    ids = json.loads(dict(two)["bundle.json"])["campaigns"]
    numbered = ("designs/", "generations/", "scores/", "recordings/")
    forged = [renamed(two, f"/{part}00000000", f"/{part}{name}")
              for part in numbered for name in ("7", "00000007", "0", "../x", "000000000")]
    forged += [renamed(two, f"/{part}00000000.ndjson", f"/{part}{name}")
               for part in numbered[:3]
               for name in ("00000000", "00000000.ndjson.x", "00000000.json")]
    forged += [renamed(two, f"/{name}", f"/{name}x")
               for name in ("campaign.json", "environments.ndjson")]
    forged += [renamed(two, f"campaigns/{ids[0]}/", f"campaigns/{other_id}/")
               for other_id in ("0" + ids[0], "999", ids[1])]
    forged += [twice(two, part, name) for part in numbered
               for name in (lambda name: name, second)]
    forged += [cut(two, part) for part in ("bundle.json", "/environments", *numbered[:3])]
    forged += [twice(two, part) for part in ("controllers/", "campaign.json", "/environments")]
    forged += [two[:-1] + [(f"campaigns/{ids[1]}/{part}/00000001.ndjson", b"")]
               for part in ("scores", "learning")]
    forged += [without(two, f"campaigns/{ids[1]}/"), without(two, f"campaigns/{ids[0]}/")]
    forged += [head(two, change) for change in (
        lambda body: body.replace(b'"version":2,', b'"version":2,"x":1e999,'),
        lambda body: body.replace(b"}", b',"more":1}'),
        lambda body: body.replace(b'"program":', b'"program": '),
        lambda body: body.replace(b'"program":', b'"programs":'),
        lambda body: body.replace(b"[", b"[[").replace(b"]", b"]]"),
        lambda body: body + b"\n", lambda body: body + body,
        lambda body: b'{"format":"morphod-bundle","version":2,}\n',
        lambda body: body.replace(b'"version":2,', b'"version":02,'))]
    stranger = dict(learned)
    extra = next(name for name in stranger if "controllers/" in name and name not in dict(two))
    forged += [two[:2] + [(extra, stranger[extra])] + two[2:]]
    weights = [i for i, (name, _) in enumerate(learned) if "controllers/" in name]
    assert len(weights) == 2
    forged += [learned[:1] + learned[2:3] + learned[1:2] + learned[3:]]
    # The whole learning curve belongs to the campaign.
    forged += [without(learned, "/learning/"), cut(learned, "/learning/"),
               altered(learned, "/learning/", lambda line: b"", -2),
               twice(learned, "/learning/", second)]
    lines = next(body for name, body in learned if "/learning/" in name).splitlines(True)
    assert len(lines) == 2 + 3 * 3
    for short in (lines[:-1], lines[1:], lines[:4] + lines[5:], lines + lines[-1:]):
        forged += [[(name, b"".join(short) if "/learning/" in name else body)
                    for name, body in learned]]
    curve = next(member for member in learned if "/learning/" in member[0])
    forged += [two[:-1] + [(f"campaigns/{ids[1]}/learning/00000000.ndjson", curve[1])]]
    for number, members in enumerate(forged):
        reply = enter(other, pack(members))
        assert reply.status == 422, (number, [name for name, _ in members])
    reply = enter(other, pack(head(two, lambda body: body.replace(b'"version":2', b'"version":3'))))
    assert "version 3" in reply.json()["errors"][0]["detail"]
    assert other.get("/v1/jobs")["items"] == []
    for members in bundles:
        assert enter(other, pack(members)).status == 201


def test_a_frame_has_a_checksum(start, bundles):
    other = start()
    plain = zstd(pack(bundles[0]), "-d")
    assert enter(other, zstd(plain), "verify").status == 200
    reply = enter(other, zstd(plain, "--no-check"))
    assert reply.status == 422 and "checksum" in reply.json()["errors"][0]["detail"]
    skipped = b"\x5d\x2a\x4d\x18\x01\x00\x00\x00x"  # a frame that zstd skips
    assert enter(other, skipped + zstd(plain)).status == 422
    assert enter(other, zstd(plain) + skipped).status == 422


def test_parts_are_full(service, start):
    """A part ends at a fixed place: the lines of two parts cannot be split differently."""
    other = start()
    id = run(service, "campaigns", {"mode": "zero-shot", "population": 700, "generations": 1,
                                    "environments": HERE, "physics": {"n_steps": 1},
                                    "exclude_pretraining": False})["id"]
    members = unpack(service.request("GET", f"/v1/bundles?campaigns={id}").body)
    for part in ("designs", "scores"):
        names = [name for name, _ in members if f"/{part}/" in name]
        assert len(names) == 2
        first, last = (dict(members)[name].splitlines(True) for name in names)
        assert len(first) == 1000
        for moved in (999, 1001):
            lines = first + last
            bodies = dict(zip(names, (b"".join(lines[:moved]), b"".join(lines[moved:]))))
            reply = enter(other, pack([(name, bodies.get(name, body)) for name, body in members]))
            assert reply.status == 422 and "wrong part" in reply.json()["errors"][0]["detail"]
    name, body = next(member for member in members if "/generations/" in member[0])
    lines = body.splitlines(True)
    at = next(i for i, (own, _) in enumerate(members) if own == name)
    split = [(name, lines[0]), (second(name), b"".join(lines[1:]))]
    assert enter(other, pack(members[:at] + split + members[at + 1:])).status == 422
    # Without scores of designs, a part is omitted.
    bare = [(own, body) for own, body in members if not own.endswith("scores/00000000.ndjson")]
    assert enter(other, pack(bare)).status == 201


# ---- the time to read a bundle ----


def cpu(service):
    fields = pathlib.Path(f"/proc/{service.process.pid}/stat").read_text().rsplit(")", 1)[1].split()
    return sum(map(int, fields[11:13])) / os.sysconf("SC_CLK_TCK")


def test_a_score_comes_once(start, bundles):
    other = start()
    members = bundles[0]
    name, body = next(member for member in members if "/scores/" in member[0])
    lines = body.splitlines(True)
    ids = json.loads(dict(members)["bundle.json"])["campaigns"]

    def scores(lines):
        return pack([(own, b"".join(lines) if own == name else old) for own, old in members])
    assert ids[0] in name
    for forged in (lines[:1] + lines, lines + lines[-1:], lines + lines[:1], lines[::-1]):
        assert enter(other, scores(forged)).status == 422

    def again(n):
        """The first line, and the same losses again with other times, as if from other blocks."""
        return scores(lines[:1] + [put("computed_us", 5 + i)(lines[0][:-1]) + b"\n"
                                   for i in range(n)] + lines[1:])
    assert enter(other, again(65), "verify").status == 422, "too many"
    assert enter(other, again(64), "verify").status == 200, "older programs wrote them"


def test_a_byte_does_not_unpack_to_thousands(start, bundles):
    """63 MiB of a single character compress to a few kilobytes."""
    other = start()
    body = bytes(63 * 2**20)
    members = bundles[0][:1] + [(f"controllers/{n:064x}.safetensors", body) for n in range(2)]
    bomb = pack(members)
    assert len(bomb) < 20000
    began = cpu(other)
    reply = enter(other, bomb)
    assert reply.status == 422 and cpu(other) - began < 3


@pytest.fixture(scope="module")
def long(bundles):
    """A bundle that occupies a core for several seconds: 600,000 designs, all the same body."""
    campaign = next((name, body) for name, body in bundles[0] if name.endswith("campaign.json"))
    row = json.loads(campaign[1])
    row["designs"] = 600_000
    members = []
    for name, body in bundles[0]:
        if "/generations/" in name:
            break
        if name == campaign[0]:
            body = json.dumps(row, separators=(",", ":"), ensure_ascii=False).encode()
        if "/designs/" not in name:
            members.append((name, body))
            continue
        line = put("score", "SCORE")(put("died", 0)(body.splitlines()[0])).decode()
        line = line.replace('"number":0', '"number":{0}').replace('"SCORE"', "{1!r}")
        line = "{{" + line[1:-1] + "}}\n"
        for part in range(600):
            text = "".join(line.format(number, 0.5 + number / 2**21)
                           for number in range(1000 * part, 1000 * part + 1000)).encode()
            members.append((name.replace("00000000", f"{part:08d}"), text))
    return pack(members)


def post(service, body, mode="verify"):
    connection = service.connection(timeout=60)
    connection.request("POST", f"/v1/bundles?mode={mode}", body=body, headers=ZSTD)
    return connection


def is_idle(service):
    """Returns whether the daemon uses no processor time for a while."""
    before = cpu(service)
    time.sleep(0.5)
    return cpu(service) - before < 0.05


def ended_cpu():
    """Returns processor seconds of all daemons that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def test_a_reading_ends_with_its_client(start, long):
    other = start()
    began = cpu(other)
    connection = post(other, long)
    until(lambda: cpu(other) - began > 1)
    connection.close()
    until(lambda: is_idle(other))
    assert cpu(other) - began < 4, "it would take far longer"


def test_a_reading_ends_with_the_service(start, long):
    other = start()
    began = cpu(other)
    connection = post(other, long, "enter")
    until(lambda: cpu(other) - began > 1)
    before = ended_cpu()
    assert other.stop() == 0
    assert "stopped work=" in other.log_text(), "it was ended at its deadline"
    assert ended_cpu() - before < 4, "it would take far longer"
    connection.close()
