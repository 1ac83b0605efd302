"""Scores: exchange between services by content, and refusals."""

import json
import random

import pytest

from archives import altered, block, blocks, lies, put, unpack
from service import BOOTSTRAP, DESIGN, run

ZSTD = {"Content-Type": "application/zstd"}
HERE = [{"light_xy_m": [4.0, 3.0], "terrain_sigma_m": 0.05, "seed": seed} for seed in range(17)]
HERE += [{"light_xy_m": [4.0, 3.0], "terrain": {"kind": "grid", "spacing_m": 0.3, "heights_m": [
    [0.01 * (i * j % 5) for i in range(30)] for j in range(20)]}}]
CAMPAIGN = {"mode": "zero-shot", "population": 20, "generations": 3, "physics": {"n_steps": 5},
            "exclude_pretraining": False}
EVALUATIONS = [
    {"designs": [DESIGN, {"voxels": "1" * 144}], "physics": {"n_steps": 5}},
    {"designs": [DESIGN], "physics": {"n_steps": 7}, "environments": HERE},
    {"designs": [DESIGN], "physics": {"integrator": "paper", "n_steps": 500, "dt_s": 0.05,
                                      "control_period_s": 0.05}},  # diverges
    {"designs": [DESIGN]},
    {"designs": [DESIGN], "physics": {"n_steps": 5}, "precision": "float64"},
    {"designs": [DESIGN], "physics": {"n_steps": 5}, "controller": "another"},
]


def enter(service, data):
    return service.request("POST", "/v1/scores", body=data, headers=ZSTD)


def counts(reply):
    assert reply.status == 200, reply.body
    return [reply.json()[name] for name in ("new", "known", "different")]


def fetch(service, query=""):
    reply = service.request("GET", "/v1/scores" + query)
    assert reply.status == 200 and reply.headers["Content-Type"] == "application/zstd"
    return reply.body


def content(service):
    """Returns all scores of all designs, without the numbers of rows."""
    return {design["id"]: [(one["genotype"], sorted(one["scores"], key=str))
                           for one in service.get(f"/v1/designs/{design['id']}")["orientations"]]
            for design in service.pages("/v1/designs")}


@pytest.fixture(scope="module")
def home():
    """A separate service, with scores of every kind."""
    from service import Service
    running = Service()
    another = bytearray(BOOTSTRAP.read_bytes())
    another[-1] ^= 1
    assert running.upload("another", bytes(another)).status == 201
    for request in EVALUATIONS:
        assert running.evaluate(request).json()["state"] == "succeeded"
    run(running, "campaigns", CAMPAIGN)
    yield running
    assert running.close() == 0, running.log_text()


@pytest.fixture(scope="module")
def file(home):
    return fetch(home)


def test_the_same_scores(home, start, file):
    """The scores are the same there, are used there, and are imported only once."""
    other = start()
    other.evaluate({"designs": [{"voxels": "1" * 144}], "physics": {"n_steps": 3}})  # ids differ
    before = content(other)
    assert len(blocks(file)) == 2, "weights of one controller for each block"
    first = enter(other, file)
    assert counts(first)[0] > 100 and counts(first)[1:] == [0, 0]
    assert first.json()["blocks"] == 2 and first.json()["last"]
    there = content(other)
    for id, orientations in content(home).items():
        have = dict(there[id])
        old = dict(before.get(id, []))
        for genotype, scores in orientations:
            assert [one for one in have[genotype] if one not in old.get(genotype, [])] == scores
    events = other.get("/v1/events?format=json&after=0&limit=1000")["items"]
    shown = [event["data"] for event in events if event["type"] == "scores.imported"]
    assert sum(data["new"] for data in shown) == counts(first)[0]
    newest = other.get("/v1/events?format=json")["newest"]
    assert counts(enter(other, file)) == [0, counts(first)[0], 0]
    assert counts(enter(home, file)) == [0, counts(first)[0], 0]
    assert other.get("/v1/events?format=json")["newest"] == newest and content(other) == there
    computed = other.metric("morphod_rollouts_total")
    another = other.get("/v1/controllers?limit=10")["items"]
    assert {row["name"] for row in another} == {"default", "bootstrap"}, "no names travel"
    sha256 = home.get("/v1/controllers/another")["sha256"]
    for request in EVALUATIONS:
        if "controller" in request:
            request = request | {"controller": "sha256:" + sha256}
        done = other.evaluate(request).json()
        assert done["rollouts_cached"] == done["rollouts_total"]
    run(other, "campaigns", CAMPAIGN)
    assert other.metric("morphod_rollouts_total") == computed
    ranked = "/v1/designs?sort=score"
    verified = other.evaluate(EVALUATIONS[0] | {"verify": True}).json()["results"]
    assert [row["agrees"] for row in verified] == [True, True]
    assert home.get(ranked)["items"][0]["id"] == other.get(ranked)["items"][0]["id"]


@pytest.mark.parametrize("kind", ["campaign", "verify"])
def test_an_environment_twice(start, kind):
    """A row that contains an environment twice is exported with it once, and used there."""
    here, other = start(), start()
    names = [HERE[0], HERE[1], HERE[0], HERE[0]]
    campaign = CAMPAIGN | {"population": 4, "generations": 1, "environments": names}
    evaluation = {"designs": [DESIGN], "physics": {"n_steps": 5}, "environments": names}
    if kind == "campaign":
        id = run(here, "campaigns", campaign)["id"]
        bundle = here.request("GET", f"/v1/bundles?campaigns={id}").body
        assert start().request("POST", "/v1/bundles", body=bundle, headers=ZSTD).status == 201
    else:
        assert here.evaluate(evaluation | {"verify": True}).json()["state"] == "succeeded"
    file = fetch(here)
    archive, = blocks(file)
    places = [json.loads(line)["environments"] for name, body in unpack(archive)
              if name.startswith("scores/") for line in body.splitlines()]
    assert len(places) > 0 and all(row == [0, 1] for row in places)
    assert counts(enter(other, file)) == [2 * len(places), 0, 0]
    assert counts(enter(here, file)) == [0, 2 * len(places), 0]
    if kind == "campaign":
        run(other, "campaigns", campaign)
        assert other.metric("morphod_rollouts_total") == 0
    else:
        assert other.evaluate(evaluation).json()["rollouts_cached"] == len(names)


def test_which_scores(home, start, file):
    def rows(query):
        return sum(body.count(b"\n") for archive in blocks(fetch(home, query))
                   for name, body in unpack(archive) if name.startswith("scores/"))

    every = rows("")
    sha256 = home.get("/v1/controllers/another")["sha256"]
    assert rows("?controller=another") == rows(f"?controller=sha256:{sha256}") == 1
    assert rows("?controller=default") == every - 1
    one, = home.get("/v1/designs?sort=score")["items"]
    own = content(home)[one["id"]][0][1][0]["fingerprint"].replace("64", "32")
    classes = [own, own.replace("float32", "float64"), "no such class"]
    found = [rows("?class=" + one.replace(" ", "%20")) for one in classes]
    assert found[0] >= every - 1 and found[2] == 0
    assert rows("?since=2020-01-01T00:00:00Z") == every
    assert rows("?since=2120-01-01T00:00:00.123Z") == 0
    home.refuses("/v1/scores", "?since=yesterday", "?since=2026-01-01", "?odd=1", "?class=",
                 "?since=2026-1-1T0:0:0Z", "?since=2026-01-01T00:00:00.Z",
                 "?since=2026-01-01T00:00:00-02:00")
    home.refuses("/v1/scores", "?controller=nobody", status=404)
    assert home.request("GET", "/v1/scores", headers={"Accept": "text/csv"}).status == 406
    nothing = enter(start(), fetch(home, "?since=2120-01-01T00:00:00Z"))
    assert counts(nothing) == [0, 0, 0] and nothing.json()["last"]


CHANGES = [
    ("scores.json", lambda line: line.replace(b'"version":1', b'"version":2'), 0),
    ("scores.json", put("host", 'a"b'), 0),
    ("scores.json", put("store", "x"), 0),
    ("scores.json", put("more", 1), 0),
    ("conditions", put("controller", "0" * 63), 0),
    ("conditions", put("controller", "0" * 64), 0),
    ("conditions", put("sensor", "inverse_square"), 0),
    ("conditions", put("physics.friction", 0.123), 0),
    ("conditions", put("physics.n_steps", -1), 0),
    ("environments", put("light_xy_m", [1, 2]), 0),
    ("designs", put("genotype", "1" + "0" * 142 + "1"), 0),
    ("designs", put("genotype", "1" + "0" * 143), 0),
    ("scores/", put("number", 4096), 0),
    ("scores/", put("environments", lambda places: [1024] + places[1:]), 0),
    ("scores/", put("environments", lambda places: places[:1] * len(places)), 0),
    ("scores/", put("losses", lambda losses: [-1.0] + losses[1:]), 0),
    ("scores/", put("diverged_steps", lambda steps: [99] + steps[1:]), 0),
    ("scores/", put("origin", "\n"), 0),
    ("scores/", lambda line: b"", 0),
    ("scores/", lambda line: b"[" * 10000, 0),
]


def test_altered_files_leave_nothing(home, start, file):
    """Every alteration, even with recomputed hashes everywhere, is refused with an explanation, and
    nothing of a refused block is stored."""
    other = start()
    first, second = blocks(file)
    members = unpack(first)
    names = [name for name, _ in members]
    generator = random.Random(1)

    def refused(data, why, entered=0):
        reply = enter(other, data)
        assert reply.status == 422, (why, reply.body)
        assert f"imported before it: {entered} block" in reply.json()["detail"], why
        return reply.json()["errors"][0]["detail"]

    for name, how, line in CHANGES:
        shown = refused(block(altered(members, name, how, line)), (name, line))
        assert name.rstrip("/") in shown or "controller" in shown, shown
    for n in (0, 1, 12, 100, len(first) // 2, len(first) - 1):
        refused(file[:n], n)
    for _ in range(20):
        at = generator.randrange(len(first))
        refused(file[:at] + bytes([file[at] ^ 1 << generator.randrange(8)]) + file[at + 1:], at)
    for place, name in enumerate(names):
        if place in (0, 2, 3, 4):
            refused(block(members[:place] + members[place + 1:]), name)
    refused(block(members[:2] + members[3:4] + members[2:3] + members[4:]), "another order")
    refused(block(members[:-1] + [("scores/00000064.ndjson", members[-2][1])]), "of no condition")
    refused(block(members[:-1] + [members[-2]]), "a member twice")
    lines = members[4][1] * 5000
    refused(block(members[:4] + [("designs.ndjson", lines)]), "too many lines")
    refused(block([members[0], (names[2], bytes(65 * 2**20))]), "a bomb")
    refused(b"", "nothing")
    assert other.get("/v1/designs")["items"] == []
    assert len(list((other.state / "controllers").iterdir())) == 1
    without = [one for one in unpack(second) if not one[0].startswith("controllers/")]
    assert "is not stored here" in refused(block(without), "its weights are in an earlier block")
    alike = members[3][1].splitlines(keepends=True)
    alike = ("environments.ndjson", b"".join(alike[:1] + alike[:1] + alike[2:]))
    assert "a duplicate environment: lines 0 and 1" in refused(
        block(members[:3] + [alike] + members[4:]), "two lines with one environment")
    at = len(file) - len(second) // 2
    refused(file[:at] + bytes([file[at] ^ 4]) + file[at + 1:], "the second block", entered=1)
    assert other.get("/v1/designs")["items"] != [] and counts(enter(other, file))[1] > 0
    assert other.request("POST", "/v1/scores", body=file).status == 415


def test_a_host_is_no_format(start, file):
    other = start()
    members = altered(unpack(blocks(file)[0]), "scores.json", put("host", "%s%n%p"))
    assert counts(enter(other, block(members)))[0] > 0
    events = other.get("/v1/events?format=json&after=0&limit=1000")["items"]
    assert [event["data"]["host"] for event in events
            if event["type"] == "scores.imported"] == ["%s%n%p"]


def test_other_bits_are_reported_and_not_stored(home, start, file):
    """Losses from a liar do not replace stored ones. If they arrive first, they are stored with
    their origin, which makes it possible to find and repair them."""
    first = blocks(file)[0]
    lie = lies(first)
    total = sum(counts(enter(home, file[:12 + len(first)])))
    honest = content(home)
    newest = home.get("/v1/events?format=json")["newest"]
    reply = enter(home, lie)
    assert counts(reply) == [0, total - 1, 1]
    row, = reply.json()["differences"]
    assert row["computed"]["loss"] == 0.5 != row["stored"]["loss"]
    assert content(home) == honest
    event, = home.get(f"/v1/events?format=json&after={newest}")["items"]
    assert event["type"] == "scores.differ" and event["data"]["different"] == 1
    assert "the losses of 1 rollout from store" in home.log_text()

    other = start()
    assert counts(enter(other, lie)) == [total, 0, 0]
    done = other.post("/v1/fleet/verify", {"origin": "liar@elsewhere", "repair": True})
    assert len(done["different"]) == 1 and done["different"][0]["stored"]["loss"] == 0.5
    assert counts(enter(other, file))[2] == 0, "it is repaired"
