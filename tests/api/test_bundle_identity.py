"""Bundles: which campaigns, scores and recordings exist here already, and which only seem to."""

import json
import shutil
import sqlite3

import pytest

from archives import altered, pack, put, unpack
from service import await_end, run

ZSTD = {"Content-Type": "application/zstd"}
HERE = [{"light_xy_m": [4.0, 3.0], "terrain_sigma_m": 0.05, "seed": 3}]
CAMPAIGN = {"mode": "zero-shot", "population": 16, "generations": 3, "environments": HERE,
            "physics": {"n_steps": 5}, "exclude_pretraining": False}


def enter(service, bundle, mode="enter"):
    return service.request("POST", f"/v1/bundles?mode={mode}", body=bundle, headers=ZSTD)


def export(service, id, query=""):
    reply = service.request("GET", f"/v1/bundles?campaigns={id}{query}")
    assert reply.status == 200
    return reply.body


def tables(service, id):
    return [service.get(f"/v1/campaigns/{id}/{name}") for name in ("generations", "phylogeny")]


def record(service, id, n):
    best = service.get(f"/v1/campaigns/{id}/population?limit={n}")["items"]
    return service.evaluate({"designs": [{"voxels": row["genotype"]} for row in best],
                             "environments": HERE, "physics": {"n_steps": 5},
                             "record": ["com"]}).json()["id"]


def recording(service, id):
    return service.request("GET", f"/v1/evaluations/{id}/trajectories?array=com").body


@pytest.fixture
def restored(start, tmp_path):
    """A service from a restored backup, and what it lost: a campaign and an evaluation with
    recordings. Other jobs have these numbers now."""
    state, backup = tmp_path / "state", tmp_path / "backup.db"
    state.mkdir(mode=0o700)
    service = start(state=state)
    run(service, "campaigns", CAMPAIGN)
    with sqlite3.connect(state / "morphod.db") as database:
        database.execute("VACUUM INTO ?", (str(backup), ))
    database.close()
    lost = run(service, "campaigns", CAMPAIGN | {"seed": 2})["id"]
    evaluation = record(service, lost, 3)
    found = {"campaign": lost, "tables": tables(service, lost), "evaluation": evaluation,
             "recording": recording(service, evaluation),
             "bundle": export(service, lost, "&recordings=true")}
    service.stop()
    for name in ("morphod.db-wal", "morphod.db-shm"):
        (state / name).unlink(missing_ok=True)
    shutil.copy(backup, state / "morphod.db")
    service = start(state=state)
    assert run(service, "campaigns", CAMPAIGN | {"seed": 3})["id"] == lost, "its number is taken"
    assert record(service, lost, 2) == evaluation
    return service, found


def test_a_lost_campaign_enters(restored):
    """The number of a campaign that a restored backup lost now names another one."""
    service, found = restored
    before = tables(service, found["campaign"])
    checked = enter(service, found["bundle"], "verify")
    assert checked.status == 200 and checked.json()["items"][0]["campaign"] is None
    entered = enter(service, found["bundle"])
    assert entered.status == 201, entered.body
    new = entered.json()["items"][0]
    assert new["entered"] and new["campaign"] != found["campaign"]
    assert tables(service, new["campaign"]) == found["tables"]
    assert tables(service, found["campaign"]) == before
    recorded = [one["id"] for one in service.get("/v1/evaluations")["items"]]
    assert found["evaluation"] in recorded and len(recorded) == 2
    assert recording(service, max(recorded, key=int)) == found["recording"]
    again = enter(service, found["bundle"])
    assert again.status == 200 and again.json()["items"][0]["campaign"] == new["campaign"]
    assert len(service.get("/v1/evaluations")["items"]) == 2


def test_a_bundle_that_names_another_store(start, restored):
    """The id of a store and a number in it do not identify the content of a bundle."""
    lost = restored[1]["bundle"]
    other = start()
    own = run(other, "campaigns", CAMPAIGN | {"seed": 9})["id"]
    head = json.loads(dict(unpack(export(other, own)))[f"campaigns/{own}/campaign.json"])
    forged = altered(unpack(lost), "campaign.json", put("source", head["source"]))
    reply = enter(other, pack(forged))
    assert reply.status == 201 and reply.json()["items"][0]["campaign"] != own
    assert enter(other, export(other, own)).json()["items"][0]["campaign"] == own


def test_an_earlier_state_is_another_campaign(start):
    """A campaign that was extended after the export has another history."""
    service = start()
    id = run(service, "campaigns", CAMPAIGN)["id"]
    bundle = export(service, id)
    assert enter(service, bundle).status == 200
    service.post(f"/v1/campaigns/{id}/extend", {"generations": 1})
    await_end(service, f"/v1/campaigns/{id}")
    reply = enter(service, bundle)
    assert reply.status == 201 and reply.json()["items"][0]["campaign"] != id
    assert enter(service, bundle).status == 200
    assert enter(service, export(service, id)).json()["items"][0]["campaign"] == id


def test_campaigns_without_a_generation_differ(start):
    """Campaigns without a history that could distinguish them."""
    service, other = start(), start()
    slow = {"mode": "zero-shot", "population": 512, "generations": 1, "environments": HERE}
    ids = [service.post("/v1/campaigns", slow | {"seed": seed})["id"] for seed in (1, 2)]
    for id in ids:
        service.act(id, "cancel")
        assert await_end(service, f"/v1/campaigns/{id}").json()["progress"]["generation"] is None
    bundle = service.request("GET", f"/v1/bundles?campaigns={','.join(ids)}").body
    entered = enter(other, bundle)
    assert entered.status == 201, entered.body
    assert [item["entered"] for item in entered.json()["items"]] == [True, True]
    assert len({item["campaign"] for item in entered.json()["items"]}) == 2
    for where in (service, other):
        assert [item["entered"] for item in enter(where, bundle).json()["items"]] == [False, False]


# ---- stored results of the same rollouts ----


@pytest.fixture(scope="module")
def source(service):
    return run(service, "campaigns", CAMPAIGN | {"seed": 5})["id"]


def with_loss(members, number, loss):
    """Returns a bundle of one environment in which a design has another loss, and the score that
    follows from it."""
    score = put("score", loss)
    members = altered(members, "/designs/", score, number)

    def change(line):
        row = json.loads(line)
        if number in row["numbers"]:
            row["scores"][row["numbers"].index(number)] = loss
        return json.dumps(row, separators=(",", ":")).encode()
    name = next(name for name, _ in members if "/generations/" in name)
    body = b"\n".join(change(line) if line else line
                      for line in dict(members)[name].split(b"\n"))
    members = [(own, body if own == name else old) for own, old in members]
    return altered(members, "/scores/", put("losses", [loss]), number)


def test_altered_losses_do_not_stay(service, start, source):
    """If a bundle with an altered loss was imported first, the genuine one reports this, in both
    modes."""
    other = start()
    members = unpack(export(service, source))
    forged = with_loss(members, 0, 0.001)
    reply = enter(other, pack(forged))
    assert reply.status == 201, reply.body
    for mode in ("verify", "enter"):
        reply = enter(other, pack(members), mode)
        assert reply.status == 409, mode
        assert f"a loss of design 0 of campaign {source}" in reply.json()["detail"], mode
    # A known campaign with a different loss is refused, and so is a new one.
    for mode in ("verify", "enter"):
        assert enter(service, pack(altered(members, "/scores/", put("losses", [0.5]))),
                     mode).status == 409, mode
        assert enter(service, pack(forged), mode).status == 409, mode


def test_a_score_is_the_mean_of_its_losses(service, start, source):
    """Bit for bit: the last digit of a loss counts."""
    other = start()
    many = run(service, "campaigns", {key: value for key, value in CAMPAIGN.items()
                                      if key != "environments"} | {"seed": 6})["id"]
    for id in (source, many):
        members = unpack(export(service, id))
        assert enter(other, pack(members), "verify").status == 200

        def nudge(losses):
            return losses[:-1] + [losses[-1] * (1 + 1e-14) if losses[-1] is not None else 0.5]
        for number in (0, 7):
            reply = enter(other, pack(altered(members, "/scores/", put("losses", nudge), number)))
            assert reply.status == 422, (id, number)
            assert f"the score of design {number}" in reply.json()["errors"][0]["detail"]
    # Some of its losses do not yield the mean; a design without losses does not contradict it.
    for key in ("losses", "environments", "diverged_steps"):
        members = altered(members, "/scores/", put(key, lambda values: values[:-1]))
    reply = enter(other, pack(members))
    assert reply.status == 422 and "is not the mean" in reply.json()["errors"][0]["detail"]
    bare = [(name, body) for name, body in unpack(export(service, many)) if "/scores/" not in name]
    assert enter(other, pack(bare)).status == 201


def test_settings_belong_to_a_campaign(service, start, source):
    """A bundle with another setting has the same digest, but is not the campaign."""
    other = start()
    members = unpack(export(service, source))
    assert enter(other, pack(members)).status == 201
    for change in (put("settings.seed", 77), put("settings.mutation.share", 0.5),
                   put("created_us", 5), put("back_end", 1), put("listed", 1)):
        forged = pack(altered(members, "campaign.json", change))
        for mode in ("verify", "enter"):
            reply = enter(other, forged, mode)
            assert reply.status == 409, reply.body
            assert "different settings" in reply.json()["detail"]
    for change in (put("label", "else"), put("note", "x"), put("weight", 2)):
        reply = enter(other, pack(altered(members, "campaign.json", change)))
        assert reply.status == 200, "people change these"


def test_altered_recordings_do_not_stay(service, start, source):
    other = start()
    record(service, source, 2)
    members = unpack(export(service, source, "&recordings=true"))
    assert enter(other, pack(members)).status == 201
    forged = [(name, body[:-1] + bytes([body[-1] ^ 1]) if name.endswith("com.npy") else body)
              for name, body in members]
    for where in (service, other):
        for mode in ("verify", "enter"):
            reply = enter(where, pack(forged), mode)
            assert reply.status == 409 and "a different recording" in reply.json()["detail"]
        assert enter(where, pack(members)).status == 200
