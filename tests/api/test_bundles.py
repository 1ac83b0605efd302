"""Bundles: campaigns exported from one service and imported into another, and refusals."""

import random
import tarfile

import pytest

from archives import altered, pack, put, unpack, zstd
from service import DESIGN, await_end, run

ZSTD = {"Content-Type": "application/zstd"}
HERE = [{"light_xy_m": [4.0, 3.0], "terrain_sigma_m": 0.05, "seed": 3}]
# Also tasks, of every kind of guide.
TASKED = HERE + [{"task": task} for task in ("walk", "circle", "path", "pursue", "climb")]
TASKED += [{"task": {"guide": {"kind": "ahead"}, "objective": objective}} for objective in (
    "efficient", "jump", {"travel": 1, "work_j": -1e-5})]
TASKED += [{"task": "walk", "terrain": {"kind": "grid", "spacing_m": 0.3, "heights_m": [
    [0.01 * (i * j % 5) for i in range(30)] for j in range(20)]}}]
LISTS = ["generations", "population", "phylogeny?limit=1000", "learning", "environments",
         "champions"]


def enter(service, bundle, mode="enter"):
    return service.request("POST", f"/v1/bundles?mode={mode}", body=bundle, headers=ZSTD)


@pytest.fixture(scope="module")
def source(service):
    """Ids of two replicates, of a campaign that learned, and of one that was cancelled."""
    base = {"population": 24, "generations": 4, "physics": {"n_steps": 5},
            "exclude_pretraining": False}
    first = service.post("/v1/campaigns", base | {
        "mode": "zero-shot", "replicates": 2, "label": 'a "label"',
        "initial": {"designs": [DESIGN]}})["id"]
    learned = run(service, "campaigns", base | {
        "mode": "few-shot", "name": "walker", "environments": TASKED, "seed": 7,
        "learning": {"parent_steps": 1, "child_steps": 1, "batch": 4}})["id"]
    long = service.post("/v1/campaigns", base | {"mode": "zero-shot", "generations": 9999,
                                                 "environments": HERE})["id"]
    while (service.get(f"/v1/campaigns/{long}")["progress"]["generation"] or 0) < 2:
        pass
    service.act(long, "cancel")
    ids = [first, str(int(first) + 1), learned, long]
    for id in ids:
        await_end(service, f"/v1/campaigns/{id}")
    return ids


@pytest.fixture(scope="module")
def bundle(service, source):
    reply = service.request("GET", f"/v1/bundles?campaigns={','.join(source)}")
    assert reply.status == 200 and reply.headers["Content-Type"] == "application/zstd"
    return reply.body


def test_the_same_campaigns(service, start, source, bundle):
    """Every list is the same in both services, and a bundle from the second service has the same
    history."""
    other = start()
    other.evaluate({"designs": [DESIGN], "physics": {"n_steps": 5}})  # ids differ
    checked = enter(other, bundle, "verify").json()
    assert [item["campaign"] for item in checked["items"]] == [None] * 4
    assert other.get("/v1/campaigns")["items"] == []
    entered = enter(other, bundle)
    assert entered.status == 201
    items = entered.json()["items"]
    assert [item["source"]["campaign"] for item in items] == source
    assert [item["digest"] for item in items] == [item["digest"] for item in checked["items"]]
    assert all(item["entered"] for item in items) and entered.json()["losses_stored"] > 0
    for old, item in zip(source, items):
        new = item["campaign"]
        for name in LISTS:
            assert service.get(f"/v1/campaigns/{old}/{name}") == other.get(
                f"/v1/campaigns/{new}/{name}"), name
        before, after = service.get(f"/v1/campaigns/{old}"), other.get(f"/v1/campaigns/{new}")
        for name in ("mode", "preset", "name", "state", "label", "settings", "progress", "end",
                     "created_at", "finished_at", "newest", "result", "controller"):
            assert before[name] == after[name], name
        assert before["imported"] is None and after["imported"]["campaign"] == old
        assert after["imported"]["store"] == item["source"]["store"]
    assert [other.get(f"/v1/campaigns/{item['campaign']}")["group"]["id"]
            for item in items[:2]] == [items[0]["campaign"]] * 2
    assert other.get(f"/v1/events?format=json&job={items[0]['campaign']}")["items"][0][
        "type"] == "campaign.imported"
    again = other.request("GET", "/v1/bundles").body
    shown = enter(service, again, "verify").json()["items"]
    assert [item["digest"] for item in shown] == [item["digest"] for item in items]
    assert [item["campaign"] for item in shown] == source, "at home it is known"


def test_scores_are_used_and_compared(service, start, source, bundle):
    other = start()
    enter(other, bundle)
    best = service.get(f"/v1/campaigns/{source[0]}/population?limit=3")["items"]
    request = {"designs": [{"voxels": row["genotype"]} for row in best], "physics": {"n_steps": 5}}
    cached = other.evaluate(request).json()
    assert cached["rollouts_cached"] == 30
    verified = other.evaluate(request | {"verify": True}).json()
    assert [result["agrees"] for result in verified["results"]] == [True] * 3
    ranking = f"/v1/designs/{best[0]['id']}"
    assert [one["scores"] for one in other.get(ranking)["orientations"]] == [
        one["scores"] for one in service.get(ranking)["orientations"]]


def test_entering_twice_changes_nothing(service, start, source, bundle):
    other = start()
    first = enter(other, bundle).json()["items"]
    counts = [len(other.pages("/v1/designs")), len(other.get("/v1/jobs")["items"]),
              other.get("/v1/events?format=json")["newest"]]
    again = enter(other, bundle)
    assert again.status == 200 and again.json()["losses_stored"] == 0
    assert [(item["campaign"], item["entered"]) for item in again.json()["items"]] == [
        (item["campaign"], False) for item in first]
    assert counts == [len(other.pages("/v1/designs")), len(other.get("/v1/jobs")["items"]),
                      other.get("/v1/events?format=json")["newest"]]
    assert enter(service, bundle).json()["items"][0]["campaign"] == source[0]
    # A deleted campaign is imported again.
    learned = first[2]["campaign"]
    assert other.request("DELETE", f"/v1/jobs/{learned}").status == 200
    back = enter(other, bundle)
    assert [item["entered"] for item in back.json()["items"]] == [False, False, True, False]
    # An imported campaign can be extended here.
    other.post(f"/v1/campaigns/{first[0]['campaign']}/extend", {"generations": 1})
    grown = await_end(other, f"/v1/campaigns/{first[0]['campaign']}").json()
    assert grown["state"] == "succeeded" and grown["progress"]["generation"] == 5


def test_what_cannot_leave(service, source):
    running = service.post("/v1/campaigns", {"mode": "zero-shot", "population": 64,
                                             "generations": 9999, "environments": HERE})["id"]
    for query, status in ((f"campaigns={running}", 409), ("label=none", 404), ("campaigns=x", 400),
                          ("group=1&label=x", 400), ("campaigns=999999", 404)):
        assert service.request("GET", f"/v1/bundles?{query}").status == status, query
    service.act(running, "cancel")
    assert service.request("GET", f"/v1/bundles?campaigns={source[0]}",
                           headers={"Accept": "text/csv"}).status == 406


# ---- refusals ----

CHANGES = [
    ("bundle.json", lambda line: line.replace(b'"version":2', b'"version":1'), 0),
    ("campaign.json", put("designs", lambda n: n + 1), 0),
    ("campaign.json", put("generation", lambda n: n - 1), 0),
    ("campaign.json", put("state", "running"), 0),
    ("campaign.json", put("settings.population", 10**9), 0),
    ("campaign.json", put("settings.physics.friction", 0.123), 0),
    ("campaign.json", put("controller.sha256", "0" * 64), 0),
    ("campaign.json", put("name", "../x"), 0),
    ("campaign.json", put("replicates", 1000), 0),
    ("campaign.json", put("weight", 1e9), 0),
    ("campaign.json", put("environments", 65), 0),
    ("campaign.json", put("source.campaign", "-1"), 0),
    ("environments", put("light_xy_m", [1, 2]), 0),
    ("environments", put("light_xy_m", [1e300, 2]), 0),
    ("environments", lambda line: line + b"\n" + line, 0),
    ("designs", put("number", 5), 0),
    ("designs", put("operator", "mutation"), 0),
    ("designs", put("operator", "magic"), 0),
    ("designs", put("parents", [30]), 30),
    ("designs", put("born", 99), 30),
    ("designs", put("died", 0), 30),
    ("designs", put("score", -1), 0),
    ("designs", put("lower_bound", True), 0),
    ("designs", put("voxels", 1), 0),
    ("designs", put("genotype", lambda text: text[::-1]), 0),
    ("designs", put("genotype", "1" * 2000), 0),
    ("designs", lambda line: line.replace(b",", b", ", 1), 0),
    ("designs", lambda line: line[:-1] + b',"more":1}', 0),
    ("designs", lambda line: b"[" * 10000, 0),
    ("designs", lambda line: b"", 3),
    ("generations", put("population", 7), 1),
    ("generations", put("born", 7), 1),
    ("generations", put("children_cut", 1), 1),
    ("generations", put("generation", 0), 1),
    ("generations", put("numbers", lambda numbers: numbers[:1] * len(numbers)), 1),
    ("generations", put("numbers", lambda numbers: numbers[:-1]), 1),
    ("generations", put("scores", lambda scores: [2.0] * len(scores)), 4),
    ("generations", put("score.mean", "x"), 0),
    ("scores", put("number", 10**9), 0),
    ("scores", put("losses", lambda losses: [-1.0] + losses[1:]), 0),
    ("scores", put("losses", lambda losses: [None] + losses[1:]), 0),
    ("scores", put("environments", lambda places: [64] + places[1:]), 0),
    ("scores", put("environments", lambda places: places[:1] * len(places)), 0),
    ("scores", put("class", "x" * 500), 0),
    ("scores", put("origin", ""), 0),
]


def test_altered_bundles_leave_nothing(service, start, source):
    """Every alteration, even with new hashes everywhere, is refused with an explanation, and does
    not change the service."""
    other = start()
    bundle = service.request("GET", f"/v1/bundles?campaigns={source[0]}").body
    members = unpack(bundle)
    assert enter(other, pack(members), "verify").status == 200
    newest = other.get("/v1/events?format=json")["newest"]
    generator = random.Random(1)

    def refused(data, why):
        reply = enter(other, data)
        assert reply.status == 422, (why, reply.body)
        assert "nothing was stored" in reply.json()["detail"], why

    for change in CHANGES:
        name, how, line = change
        refused(pack(altered(members, name, how, line)), change)
    for n in (0, 1, 100, len(bundle) // 2, len(bundle) - 1):
        refused(bundle[:n], n)
    for _ in range(10):
        at = generator.randrange(len(bundle))
        refused(bundle[:at] + bytes([bundle[at] ^ 1 << generator.randrange(8)]) + bundle[at + 1:],
                at)
    refused(bundle + b"x", "something behind")
    refused(bundle + bundle, "two frames")
    refused(pack(members[:-1], sums=False), "no sums")
    refused(pack(members[:1] + members, sums=False), "other sums")
    refused(pack([("SHA256SUMS", b"")] + members, sums=False), "sums first")
    for place, (name, _) in enumerate(members[:-1]):
        if "/scores/" not in name and "/learning/" not in name:
            refused(pack(members[:place] + members[place + 1:]), name)
    refused(pack(members[:1] + members[2:] + members[1:2]), "the controller last")
    for name in ("../../x", "/x", "controllers/x", "campaigns/1", "campaigns/1/odd", "x" * 101):
        extra = [(name, b"x")] if len(name) <= 100 else [("x" * 99, b"x")]
        refused(pack(members + extra), name)
    for header in ({"type": tarfile.SYMTYPE, "linkname": "/etc/passwd"}, {"mode": 0o4755},
                   {"uid": 1}, {"mtime": 5}, {"type": tarfile.DIRTYPE}):
        refused(pack(members, **header), header)
    refused(pack(members[:1] + [("campaigns/1/campaign.json", bytes(65 * 2**20))]), "a bomb")
    refused(zstd(bytes(2**20), "--long=27"), "a window of 128 MiB")
    assert other.get("/v1/events?format=json")["newest"] == newest
    assert other.get("/v1/jobs")["items"] == [] and other.get("/v1/designs")["items"] == []
    assert len(list((other.state / "controllers").iterdir())) == 1
    assert other.request("POST", "/v1/bundles", body=bundle).status == 415
    assert enter(other, bundle, "odd").status == 400


@pytest.fixture(scope="module")
def recorded(service, source):
    """Returns the evaluation that recorded three designs of the first campaign, and a bundle with
    it."""
    best = service.get(f"/v1/campaigns/{source[0]}/population?limit=3")["items"]
    request = {"designs": [{"voxels": row["genotype"]} for row in best], "physics": {"n_steps": 5},
               "record": ["com", "masses", "contacts", "actuation"], "record_stride": 2,
               "label": "champions", "experiment": "walks"}
    id = service.evaluate(request).json()["id"]
    service.evaluate(request | {"designs": [DESIGN, {"voxels": "1" * 144}]})
    for job, words in ((source[0], "the campaign"), (id, "its champions")):
        assert service.request("PATCH", f"/v1/jobs/{job}", {
            "note": words, "experiment": "walks"}).status == 200
    return id, service.request("GET", f"/v1/bundles?campaigns={source[0]}&recordings=true").body


def test_recordings(service, start, source, recorded):
    """Recordings are the same there, bit for bit, with experiment and note. Recordings of an
    evaluation with another body are not exported."""
    id, bundle = recorded
    other = start()
    entered = enter(other, bundle).json()["items"][0]
    assert entered["recordings"] == 1
    jobs = other.get("/v1/jobs")["items"]
    assert [(job["kind"], job["note"], job["experiment"]) for job in jobs] == [
        ("evaluation", "its champions", "walks"), ("campaign", "the campaign", "walks")]
    new = jobs[0]["id"]
    before, after = (one.get(f"/v1/evaluations/{job}")
                     for one, job in ((service, id), (other, new)))
    own = {"id", "priority", "weight", "core_seconds", "device_seconds", "submitted_by"}
    assert {name for name in before if before[name] != after[name]} <= own
    for array in ("com", "masses", "contacts", "actuation"):
        here, there = (one.request("GET", f"/v1/evaluations/{job}/trajectories?array={array}")
                       for one, job in ((service, id), (other, new)))
        assert here.status == there.status == 200 and here.body == there.body, array
    newest = other.get("/v1/events?format=json")["newest"]
    assert enter(other, bundle).status == 200
    again = other.request("GET", "/v1/bundles?recordings=true").body
    assert [body for name, body in unpack(again) if "/recordings/" in name] == [
        body for name, body in unpack(bundle) if "/recordings/" in name]
    assert other.get("/v1/events?format=json")["newest"] == newest
    # If only the campaign was deleted, its recordings exist already.
    other.request("DELETE", f"/v1/jobs/{entered['campaign']}")
    assert enter(other, bundle).status == 201
    assert len(other.get("/v1/evaluations")["items"]) == 1
    assert enter(service, bundle).json()["items"][0]["campaign"] == source[0]


def test_altered_recordings_are_refused(start, recorded):
    other = start()
    members = unpack(recorded[1])
    first = next(i for i, (name, _) in enumerate(members) if "/recordings/" in name)
    head = "recordings/00000000/evaluation.json"
    for change in (put("numbers", lambda numbers: [10**6] + numbers[1:]), put("numbers", []),
                   put("environments", lambda places: places[:1] * len(places)),
                   put("environments", [64]), put("record", 0), put("record", 16),
                   put("stride", 0), put("stride", 1), put("stride", 6), put("class", ""),
                   put("workers_class", "\n"), put("note", "x" * 1001),
                   put("experiment", ""), put("controller", "../x"), put("more", 1),
                   put("source.evaluation", "0"), put("created_us", -1)):
        reply = enter(other, pack(altered(members, head, change)))
        assert reply.status == 422, [cell.cell_contents for cell in change.__closure__]
    forged = altered(altered(members, head, put("class", "another")), head,
                     put("workers_class", ""))
    assert enter(other, pack(forged)).status == 422, "it has no losses of this class"
    arrays = members[first + 1:-1]
    assert len(arrays) == 3 * 10 * 4
    for forged in (members[:first] + arrays, members[:-2], members[:first + 1],
                   members[:first + 2] + members[first + 3:],
                   members[:first + 1] + arrays[1::-1] + arrays[2:],
                   members[:-1] + arrays[:1],
                   members[:first + 1] + [(arrays[0][0], arrays[0][1][:-1])] + arrays[1:],
                   members[:first + 1] + [(arrays[0][0], arrays[1][1])] + arrays[1:],
                   [member for member in members if "/scores/" not in member[0]]):
        assert enter(other, pack(forged)).status == 422
    assert other.get("/v1/jobs")["items"] == [] and other.get("/v1/designs")["items"] == []


def test_altered_learning_is_refused(service, start, source):
    other = start()
    members = unpack(service.request("GET", f"/v1/bundles?campaigns={source[2]}").body)
    for change in (put("step", 0), put("generation", 99), put("on", "both"), put("rate", "x")):
        assert enter(other, pack(altered(members, "learning", change))).status == 422
    assert other.get("/v1/jobs")["items"] == []


def test_a_score_that_contradicts_a_stored_one(start, bundle):
    """The bundle comes from another store, and has a different loss of the same class."""
    other = start()
    enter(other, bundle)
    members = unpack(bundle)
    move = put("source.store", "0" * 15 + "1")
    other_store = [(name, move(body) if name.endswith("campaign.json") else body)
                   for name, body in members]
    newest = other.get("/v1/events?format=json")["newest"]
    other_store = altered(other_store, "generations", put("seconds", lambda seconds: seconds + 1))
    for n in (None, 2):  # a whole block of environments, and a part of it, which is another block
        forged = altered(other_store, "scores", put("losses", lambda old: ([0.5] + old[1:])[:n]))
        for key in ("environments", "diverged_steps"):
            forged = altered(forged, "scores", put(key, lambda values: values[:n]))
        reply = enter(other, pack(forged))
        assert reply.status == 409 and "a loss of design 0" in reply.json()["detail"], n
    assert other.get("/v1/events?format=json")["newest"] == newest


def test_rights(start, tmp_path, bundle):
    tokens = tmp_path / "tokens"
    tokens.write_text("anna submit 0123456789abcdef\nroot admin fedcba9876543210\n")
    tokens.chmod(0o600)
    service = start(f"--token-file={tokens}", "--token-on-loopback=yes", token="0123456789abcdef")
    assert enter(service, bundle).status == 403
    assert service.request("GET", "/v1/bundles").status == 404, "there is no campaign"
