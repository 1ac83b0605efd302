"""`"re_evaluate"` of campaigns: the best designs in fresh worlds; and certificates in lists."""

import csv
import io
import math
import sqlite3

import pytest

from archives import altered, pack, put, unpack
from contract import SOURCE
from ctl import ctl  # noqa: F401
from service import await_end, awaited, run
from test_bundles import enter
from test_campaign_measures import PLACES, history
from test_certificates import certify
from test_devices import FLAGS, fake

CAMPAIGN = {"mode": "zero-shot", "population": 16, "generations": 3, "seed": 5,
            "physics": {"n_steps": 120}, "exclude_pretraining": False}
EVERY = {"every": 2, "environments": 70, "designs": 3}
WALK = CAMPAIGN | {"environments": "morpho-12-walk", "re_evaluate": EVERY | {"environments": 64}}
LEARNING = CAMPAIGN | {"mode": "few-shot", "name": "held-out", "population": 6,
                       "learning": {"parent_steps": 1, "child_steps": 1}}
# P(|T| < t) = 0.95 for 63 and 69 degrees of freedom.
STUDENT = {64: 1.998341, 70: 1.994945}


def philox(key, counter):
    """Philox4x32-10, from its definition."""
    k, c = list(key), list(counter)
    for _ in range(10):
        p, q = 0xD2511F53 * c[0], 0xCD9E8D57 * c[2]
        c = [q >> 32 ^ c[1] ^ k[0], q & 0xffffffff, p >> 32 ^ c[3] ^ k[1], p & 0xffffffff]
        k = [(k[0] + 0x9E3779B9) & 0xffffffff, (k[1] + 0xBB67AE85) & 0xffffffff]
    return c


def seed_of(seed, generation):
    """Returns the seed of the fresh worlds of a generation: stream 20."""
    low, high, *_ = philox((seed & 0xffffffff, seed >> 32), (0, 0, generation, 20 << 16))
    return (low | high << 32) >> 11


def held_out(service, id):
    """Returns every result, by generation and number."""
    with sqlite3.connect(f"file:{service.state}/morphod.db?mode=ro", uri=True) as database:
        return database.execute("SELECT generation,number,worlds,diverged,mean,standard_error FROM"
                                " campaign_held_out WHERE job=? ORDER BY 1,2", (id, )).fetchall()


def without(items, *names):
    return [{key: value for key, value in row.items() if key not in names} for row in items]


def results(service, id):
    """Returns the history of a campaign, and its results, without certificates."""
    return [without(part, "certificate") for part in history(service, id)], held_out(service, id)


@pytest.fixture(scope="module", name="made")
def re_evaluated_campaign(service):
    return run(service, "campaigns", CAMPAIGN | {"re_evaluate": EVERY})


def test_it_selects_nothing(service, made):
    """All designs, scores and statistics have the same bits; without it, nothing is new."""
    plain = run(service, "campaigns", CAMPAIGN)
    assert plain["settings"]["re_evaluate"] is None and made["settings"]["re_evaluate"] == EVERY
    one, other = history(service, plain["id"]), history(service, made["id"])
    for curve in (one[0], other[0]):
        for row in curve:
            del row["cached"]
    assert [without(part, "held_out", "certificate") for part in one] == [
        without(part, "held_out", "certificate") for part in other]
    assert all(row["held_out"] is None for row in one[1]) and not held_out(service, plain["id"])
    assert all(row["held_out"]["worlds"] == row["held_out"]["rollouts"] == 0 and
               row["held_out"]["mean"] is None for row in one[0])
    champions = service.get(f"/v1/campaigns/{plain['id']}/champions")
    assert "fresh_worlds" not in champions and "re_evaluated" not in champions


def test_who_is_scored_and_when(service, made):
    """The best three and the twelve champions, in generations 0 and 2 and in the last."""
    path = f"/v1/campaigns/{made['id']}"
    stored = held_out(service, made["id"])
    for row in service.pages(path + "/generations"):
        generation, is_due = row["generation"], row["generation"] in (0, 2, 3)
        found = [one for one in stored if one[0] == generation]
        population = service.get(f"{path}/population?generation={generation}")["items"]
        listed = service.get(f"{path}/champions?generation={generation}")
        champions = listed["items"]
        assert listed["re_evaluated"] == {"generation": 0 if generation == 1 else generation,
                                          "designs": 3, "champions": 12}
        assert not is_due or all(one["held_out"] for one in champions), "the usual list has them"
        elite = {one["number"] for one in population[:3] + champions}
        assert [one[1] for one in found] == (sorted(elite) if is_due else [])
        summary = row["held_out"]
        assert summary["designs"] == len(found) and summary["rollouts"] == 70 * len(found)
        if not is_due:
            continue
        assert 12 <= len(elite) < 16
        for one in population:
            assert (one["held_out"] or {}).get("generation") == (
                generation if one["number"] in elite else
                max((g for g, number, *_ in stored if number == one["number"] and
                     g <= generation), default=None))
        best = population[0]
        assert {key: summary[key] for key in ("mean", "standard_error", "low", "high")} == {
            key: best["held_out"][key] for key in ("mean", "standard_error", "low", "high")}
        assert row["score"]["quantiles"]["p0"] == best["score"]
        assert summary["top_score"] == pytest.approx(
            sum(one["score"] for one in population[:3]) / 3)
        assert summary["top_mean"] == pytest.approx(
            sum(one["held_out"]["mean"] for one in population[:3]) / 3)


def test_the_worlds_are_those_of_a_certificate(service, made):
    """With the seed of the generation, its axis `held_out` has the same worlds, scores and
    intervals."""
    path = f"/v1/campaigns/{made['id']}"
    for generation in (0, 3):
        champions = service.get(f"{path}/champions?generation={generation}")
        assert "lights 0.4 to 2 m away" in champions["fresh_worlds"]
        _, report = certify(service, {
            "designs": [{"id": one["robot"]} for one in champions["items"]], "held_out": 70,
            "axes": ["held_out"], "seed": seed_of(5, generation), "physics": CAMPAIGN["physics"]})
        assert [row["axis"] for row in report["levels"]] == ["base", "held_out"]
        for one, certified in zip(champions["items"], report["designs"], strict=True):
            base, fresh = certified["levels"]
            result = one["held_out"]
            assert (result["generation"], result["worlds"]) == (generation, 70)
            # A certificate stores losses in float32.
            assert result["mean"] == pytest.approx(fresh["score"], rel=1e-6)
            assert base["score"] == pytest.approx(one["score"], rel=1e-6)
            assert [result["low"], result["high"]] == pytest.approx(fresh["interval"], rel=1e-5)
            assert result["high"] - result["mean"] == pytest.approx(
                STUDENT[70] * result["standard_error"], rel=1e-5)
    seeds = {seed_of(5, generation) for generation in (0, 2, 3)}
    assert len(seeds) == 3, "each generation has new worlds"


def test_a_suite_has_held_out_worlds(service):
    value = run(service, "campaigns", WALK)
    champions = service.get(f"/v1/campaigns/{value['id']}/champions")
    assert champions["fresh_worlds"] is None
    reply = service.evaluate({
        "designs": [{"id": one["robot"]} for one in champions["items"]],
        "environments": "morpho-12-walk-held-out", "physics": WALK["physics"]})
    for one, result in zip(champions["items"], reply.json()["results"], strict=True):
        losses = [cell["loss"] if isinstance(cell, dict) else cell for cell in result["losses"]]
        mean = math.fsum(losses) / 64
        deviation = math.sqrt(math.fsum((loss - mean) ** 2 for loss in losses) / 63)
        assert one["held_out"]["mean"] == pytest.approx(mean, rel=1e-13)
        assert one["held_out"]["standard_error"] == pytest.approx(deviation / 8, rel=1e-12)
        assert one["held_out"]["low"] == pytest.approx(mean - STUDENT[64] * deviation / 8, rel=1e-6)


def test_the_measure_to_select_by(service):
    """The mean is that of the measure, with the sign of the score; measures do not matter."""
    far = {"measure": "displacement_m", "direction": "max"}
    value = run(service, "campaigns", WALK | {"select_by": far, "generations": 0})
    champions = service.get(f"/v1/campaigns/{value['id']}/champions")["items"]
    reply = service.evaluate({
        "designs": [{"id": one["robot"]} for one in champions], "measures": ["displacement_m"],
        "environments": "morpho-12-walk-held-out", "physics": WALK["physics"]})
    for one, result in zip(champions, reply.json()["results"], strict=True):
        assert one["held_out"]["mean"] == pytest.approx(-result["measures"]["displacement_m"])


@pytest.mark.parametrize("mode", [CAMPAIGN, LEARNING], ids=["zero-shot", "few-shot"])
def test_the_bits_depend_on_nothing_else(start, tmp_path, mode):
    """Not on threads, or on a stop in the middle of a re-evaluation."""
    value = mode | {"re_evaluate": EVERY | {"every": 1, "environments": 200},
                    "physics": {"n_steps": 600}, "generations": 2, "environments": "paper-test"}
    whole = start("--workers=2")
    id = run(whole, "campaigns", value)["id"]
    expected = history(whole, id)[1:], held_out(whole, id)
    assert len(expected[1]) >= 3 * min(value["population"], 12)
    first = start("--workers=1", state=tmp_path)
    path = f"/v1/campaigns/{first.post('/v1/campaigns', value)['id']}"
    elite = sum(row[0] == 1 for row in expected[1])
    assert elite < value["population"] * (2 if mode is LEARNING else 1), "the totals differ"

    def is_amid(job):
        now = job["progress"]
        return (now["under_way"], job["phase"], now["total"]) == (1, "scoring", elite) and (
            1 <= now["done"] < elite - 1)

    awaited(first, path, is_amid)
    assert first.stop() == 0, first.log_text()
    with sqlite3.connect(f"file:{tmp_path}/morphod.db?mode=ro", uri=True) as database:
        for table in ("campaign_generations", "campaign_held_out"):
            newest = f"SELECT max(generation) FROM {table}"
            assert database.execute(newest).fetchone() == (0, ), "the stop came too late"
    last = start("--workers=2", state=tmp_path)
    assert await_end(last, path).json()["state"] == "succeeded"
    assert (history(last, id)[1:], held_out(last, id)) == expected


def test_devices_have_results_too(start):
    value = CAMPAIGN | {"re_evaluate": EVERY, "generations": 1}
    one = start(*FLAGS, environment=fake())
    jobs = [run(one, "campaigns", value | {"device": device})["id"] for device in ("cuda", "cpu")]
    by_device, by_cpu = [held_out(one, id) for id in jobs]
    assert [row[:4] for row in by_device] == [row[:4] for row in by_cpu] and by_cpu
    for ours, theirs in zip(by_device, by_cpu):
        assert ours[4] == pytest.approx(theirs[4], rel=0.05)


def test_more_generations(service, made):
    """Those that were the last keep their results."""
    id = run(service, "campaigns", CAMPAIGN | {"re_evaluate": EVERY})["id"]
    before = held_out(service, id)
    assert before == held_out(service, made["id"])
    service.post(f"/v1/campaigns/{id}/extend", {"generations": 2})
    assert await_end(service, f"/v1/campaigns/{id}").json()["state"] == "succeeded"
    after = held_out(service, id)
    assert after[:len(before)] == before
    assert {row[0] for row in after} == {0, 2, 3, 4, 5}


def test_tables(service, made):
    path = f"/v1/campaigns/{made['id']}"
    champions = service.get(path + "/champions")["items"]
    rows = list(csv.DictReader(io.StringIO(
        service.request("GET", path + "/champions?format=csv").body.decode())))
    assert [float(row["held_out_mean"]) for row in rows] == [
        one["held_out"]["mean"] for one in champions]
    phylogeny = list(csv.DictReader(io.StringIO(
        service.request("GET", path + "/phylogeny?format=csv").body.decode())))
    for row, one in zip(phylogeny, service.pages(path + "/phylogeny"), strict=True):
        result = one["held_out"] or {}
        for key in ("mean", "low", "high"):
            assert row["held_out_" + key] == ("" if not result else repr(result[key]))
    curve = list(csv.DictReader(io.StringIO(
        service.request("GET", path + "/generations?format=csv").body.decode())))
    assert [row["held_out_worlds"] for row in curve] == ["70", "0", "70", "70"]
    assert [row["held_out_mean"] == "" for row in curve] == [False, True, False, False]


@pytest.mark.parametrize("value, pointer, words", [
    (CAMPAIGN | {"environments": PLACES, "re_evaluate": {}}, "/re_evaluate",
     "no fresh worlds can be drawn: "),
    (CAMPAIGN | {"environments": "morpho-12-walk-held-out", "re_evaluate": {}}, "/re_evaluate",
     "already a held-out set"),
    (WALK | {"re_evaluate": {"environments": 65}}, "/re_evaluate/environments", "at most 64"),
    (CAMPAIGN | {"re_evaluate": {"every": 0}}, "/re_evaluate/every", "1 to"),
    (CAMPAIGN | {"re_evaluate": {"environments": 1}}, "/re_evaluate/environments", "2 to 1024"),
    (CAMPAIGN | {"re_evaluate": {"designs": 101}}, "/re_evaluate/designs", "1 to 100"),
    (CAMPAIGN | {"re_evaluate": {"worlds": 5}}, "/re_evaluate/worlds", "unknown"),
    (CAMPAIGN | {"re_evaluate": 5}, "/re_evaluate", "object"),
    ({"mode": "study", "population": 4, "re_evaluate": {}}, "/re_evaluate", "a study does not")])
def test_refusals(service, value, pointer, words):
    reply = service.request("POST", "/v1/campaigns", value)
    assert reply.status == 422, reply.body
    fault, = reply.json()["errors"]
    assert fault["pointer"] == pointer and words in fault["detail"], fault


def test_usual_settings(service):
    for given in ({}, {"every": 10}):
        value = run(service, "campaigns", CAMPAIGN | {"generations": 0, "re_evaluate": given})
        assert value["settings"]["re_evaluate"] == {"every": 10, "environments": 64, "designs": 10}
    value = run(service, "campaigns", CAMPAIGN | {"generations": 0, "re_evaluate": None})
    assert value["settings"]["re_evaluate"] is None


# ---- bundles ----

def members_of(service, id):
    return unpack(service.request("GET", f"/v1/bundles?campaigns={id}").body)


def test_bundles_keep_the_results(service, start, made):
    other = start()
    sent = service.request("GET", f"/v1/bundles?campaigns={made['id']}").body
    reply = enter(other, sent)
    assert reply.status == 201, reply.body
    new = reply.json()["items"][0]["campaign"]
    assert results(other, new) == results(service, made["id"])
    assert other.get(f"/v1/campaigns/{new}")["settings"] == made["settings"]
    again = members_of(other, new)
    for (_, one), (name, body) in zip(again, members_of(service, made["id"]), strict=True):
        if "/generations/" in name:
            assert one == body and b'"held_out":[{' in body


def test_other_bundles_have_their_old_form(service):
    plain = run(service, "campaigns", CAMPAIGN | {"seed": 6})
    for name, body in members_of(service, plain["id"]):
        assert b"held_out" not in body and b"re_evaluate" not in body, name


@pytest.mark.parametrize("member, change, line, words", [
    ("generations/", put("held_out", lambda rows: rows[::-1]), 0, "out of order"),
    ("generations/", put("held_out", lambda rows: [rows[0] | {"number": 4000}]), 0,
     "not in the population"),
    ("generations/", put("held_out", lambda rows: [rows[0] | {"diverged": 3}]), 0,
     "contradicts its divergences"),
    ("generations/", put("held_out", lambda rows: [rows[0] | {"mean": None}]), 0,
     "contradicts its divergences"),
    ("generations/", put("held_out", lambda rows: [rows[0] | {"more": 1}]), 0, "expected"),
    ("generations/", put("held_out", lambda rows: rows * 10), 0, "too many designs"),
    ("campaign.json", put("settings", lambda settings: {
        key: value for key, value in settings.items() if key != "re_evaluate"}), 0,
     "does not re-evaluate")])
def test_other_results_are_refused(service, start, made, member, change, line, words):
    sent = pack(altered(members_of(service, made["id"]), member, change, line))
    reply = enter(start(), sent, "verify")
    assert reply.status == 422 and words in reply.json()["errors"][0]["detail"], reply.json()


# ---- certificates in lists ----

def test_lists_name_certificates(service, start, ctl):  # noqa: F811
    """The newest that has succeeded, under the controller of the campaign."""
    value = run(service, "campaigns", CAMPAIGN | {"seed": 8, "population": 6, "generations": 1})
    path = f"/v1/campaigns/{value['id']}"
    # A campaign of another test may share a robot, which has its certificates in all lists.
    expected = {one["robot"]: one["certificate"] for one in service.pages(path + "/phylogeny")}
    quick = {"axes": ["step", "friction"], "levels": [0.5], "population": {
        "campaign": value["id"], "best": 4}}
    ids = []
    for _ in range(2):
        job, report = certify(service, quick)
        ids.append(job["id"])
    classes = {design["design"]: design["class"] for design in report["designs"]}
    assert len(classes) == 4
    expected |= {robot: {"id": ids[1], "class": name} for robot, name in classes.items()}
    for rows in (service.get(path + "/champions")["items"], service.pages(path + "/phylogeny"),
                 service.get(path + "/population")["items"]):
        assert {one["robot"] for one in rows} >= set(classes)
        for one in rows:
            assert one["certificate"] == expected[one["robot"]]
    robot = report["designs"][0]["design"]
    found, = [one for one in service.get(f"/v1/designs/{robot}")["orientations"]
              if one["robot"] == robot]
    assert found["certificate"] == {"id": ids[1], "class": classes[robot]}
    rows = list(csv.DictReader(io.StringIO(
        service.request("GET", path + "/phylogeny?format=csv").body.decode())))
    assert {row["robot"]: row["certificate_class"] for row in rows
            if row["certificate"] == ids[1]} == classes
    status, out, _ = ctl(f"campaign champions {value['id']}")
    assert status == 0 and f"{ids[1]} ({classes[robot]})" in out
    assert service.request("DELETE", f"/v1/jobs/{ids[1]}").status in (200, 204)
    assert {one["certificate"]["id"] for one in service.get(path + "/population")["items"]
            if one["robot"] in classes} == {ids[0]}


def test_certificates_of_other_controllers(service):
    """They say nothing about the scores of the campaign."""
    value = run(service, "campaigns", CAMPAIGN | {"seed": 9, "population": 6, "generations": 0})
    best = service.get(f"/v1/campaigns/{value['id']}/champions")["items"][0]
    path = f"/v1/campaigns/{value['id']}/population"
    before = service.get(path)["items"][0]["certificate"]
    other = "bootstrap"
    service.upload(other, (SOURCE / "data" / "controllers" / "bootstrap.safetensors").read_bytes())
    job, _ = certify(service, {"designs": [{"id": best["robot"]}], "controller": other,
                               "axes": ["friction"], "levels": [0.5], "physics": {"n_steps": 20}})
    found, = [one for one in service.get(f"/v1/designs/{best['robot']}")["orientations"]
              if one["robot"] == best["robot"]]
    assert found["certificate"]["id"] == job["id"]
    assert service.get(path)["items"][0]["certificate"] == before


# ---- morphoctl ----

def test_morphoctl(service, ctl, made):  # noqa: F811
    settings = "--population 4 --generations 1 --physics n_steps=60"
    for text, expected in (("", None),
                           ("--re-evaluate 5", {"every": 5, "environments": 64, "designs": 10}),
                           ("--re-evaluate 5:16", {"every": 5, "environments": 16, "designs": 10})):
        status, out, err = ctl(f"campaign start zero-shot {settings} {text} -q")
        assert status == 0, err
        path = f"/v1/campaigns/{out.strip()}"
        assert await_end(service, path).json()["settings"]["re_evaluate"] == expected
    for wrong in ("0", "x", "5:", "5:1", "5:16:2"):
        assert ctl(f"campaign start zero-shot {settings} --re-evaluate {wrong} -q")[0] != 0
    status, out, err = ctl(f"campaign champions {made['id']}")
    best = service.get(f"/v1/campaigns/{made['id']}/champions?count=1")["items"][0]
    assert status == 0 and f"{best['held_out']['mean']:.4f}" in out
    assert "lights 0.4 to 2 m away" in err and "held out –" not in err
    status, out, err = ctl(f"campaign champions {made['id']} --generation 1")
    assert status == 0 and "–" in out
    assert ("held out –: not in the re-evaluation of generation 0 (its best 3 and its 12 "
            "champions, without those that diverged), nor in an earlier one") in err
    status, out, _ = ctl(f"campaign show {made['id']}")
    assert status == 0 and "every 2 generations in 70 fresh worlds" in out
