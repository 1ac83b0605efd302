"""`"measures"` and `"select_by"` of campaigns: measures of every design, and selection by one."""

import csv
import io
import math
import signal

import pytest

from archives import altered, pack, put, unpack
from ctl import ctl  # noqa: F401
from service import await_end, awaited, run
from test_bundles import enter
from test_measures import NAMES, PLACES
from test_racing import CAMPAIGN as RACED, CONTROLLER
from test_worlds import scene

WANTED = ["work_j", "displacement_m", "air_share"]
KEPT = ["displacement_m", "air_share", "work_j"]  # in their fixed order
CAMPAIGN = {"mode": "zero-shot", "population": 10, "generations": 3, "environments": PLACES,
            "physics": {"n_steps": 120}, "seed": 5}
LEARNING = CAMPAIGN | {"mode": "few-shot", "generations": 2, "population": 6, "name": "measured",
                       "learning": {"parent_steps": 1, "child_steps": 1}}
WAIT = {"Prefer": "wait=30"}
FAR = {"measure": "displacement_m", "direction": "max"}


def history(service, id):
    """Returns what must not depend on measures, threads or restarts."""
    path = f"/v1/campaigns/{id}"
    curve = [{key: value for key, value in row.items() if key not in ("seconds", "stored_at")}
             for row in service.pages(path + "/generations")]
    return curve, service.pages(path + "/phylogeny"), service.get(path + "/population")["items"]


def without_measures(items):
    return [{key: value for key, value in row.items() if key != "measures"} for row in items]


@pytest.fixture(scope="module", name="plain")
def plain_campaign(service):
    return run(service, "campaigns", CAMPAIGN)


@pytest.fixture(scope="module", name="measured")
def measured_campaign(service, plain):
    assert plain["state"] == "succeeded"
    return run(service, "campaigns", CAMPAIGN | {"measures": WANTED, "racing": "off"})


def evaluated(service, rows, **more):
    """Returns the measures that an evaluation finds stored for these designs."""
    value = run(service, "evaluations", {
        "designs": [{"voxels": row["genotype"]} for row in rows], "environments": PLACES,
        "physics": CAMPAIGN["physics"], "measures": True, **more})
    assert value["rollouts_cached"] == value["rollouts_total"]
    return value["results"]


def test_measures_change_nothing_else(service, plain, measured):
    """The losses were stored by the first campaign, without measures: they are computed again."""
    assert plain["settings"]["measures"] == [] and plain["settings"]["select_by"] is None
    assert measured["settings"]["measures"] == KEPT and "own_score" not in measured
    one, other = history(service, plain["id"]), history(service, measured["id"])
    for row, whole in zip(one[1], without_measures(other[1]), strict=True):
        if not row["lower_bound"]:
            assert row == whole
    assert one[2] == without_measures(other[2])
    assert all("measures" not in row for row in one[1])
    assert sum(row["cached"] for row in other[0]) == 0


def test_measures_are_those_of_evaluations(service, measured):
    """They are stored like those of an evaluation, which finds all twenty, and appear everywhere
    that the designs do."""
    path = f"/v1/campaigns/{measured['id']}"
    rows = service.pages(path + "/phylogeny")
    assert len(rows) == 40
    for row, found in zip(rows, evaluated(service, rows)):
        assert list(row["measures"]) == KEPT and list(found["measures"]) == NAMES
        assert row["measures"] == {name: found["measures"][name] for name in KEPT}
        assert row["score"] == found["score"]
    by_number = {row["number"]: row["measures"] for row in rows}
    population = service.get(path + "/population")["items"]
    champions = service.get(path + "/champions?count=3")["items"]
    one = service.get(f"{path}/designs/{population[0]['number']}")
    for row in [*population, *champions, one]:
        assert row["measures"] == by_number[row["number"]]
    table = list(csv.DictReader(io.StringIO(
        service.request("GET", path + "/phylogeny?format=csv").body.decode())))
    for row in table:
        for name in KEPT:
            known = by_number[int(row["id"])][name]
            assert row[f"measures.{name}"] == "" if known is None else (
                float(row[f"measures.{name}"]) == known)
    header, array = scene(service.request("GET", path + "/phylogeny?format=columns"))
    for name in KEPT:
        column = array(header["columns"][f"measures.{name}"])
        assert [None if math.isnan(x) else x for x in column] == [
            by_number[i][name] for i in range(40)]


def test_a_race_leaves_gaps(start):
    """A child that is cut short has no measures: its score is a lower bound."""
    service = start(CONTROLLER)
    value = run(service, "campaigns", RACED | {"measures": True})
    rows = service.pages(f"/v1/campaigns/{value['id']}/phylogeny")
    cut = [row for row in rows if row["lower_bound"]]
    assert cut and value["settings"]["racing"] == "lossless"
    for row in rows:
        if row["lower_bound"]:
            assert row["measures"] == dict.fromkeys(NAMES)
        else:
            assert row["measures"]["work_j"] is not None


def test_parents_that_learn_are_measured_again(service):
    value = run(service, "campaigns", LEARNING | {"measures": WANTED})
    path = f"/v1/campaigns/{value['id']}"
    first = {row["number"]: row["measures"]
             for row in service.get(path + "/population?generation=2")["items"]}
    rows = service.pages(path + "/phylogeny")
    assert all(row["measures"]["work_j"] > 0 for row in rows)
    assert {row["number"]: row["measures"] for row in rows if row["died"] is None} == first
    # The survivors' measures belong to the newest weights, as their scores do.
    newest = run(service, "evaluations", {
        "designs": [{"voxels": row["genotype"]} for row in rows if row["died"] is None],
        "environments": PLACES, "physics": CAMPAIGN["physics"], "measures": KEPT,
        "controller": "measured"})
    assert [row["measures"] for row in newest["results"]] == [
        row["measures"] for row in rows if row["died"] is None]


def test_selection_by_a_measure(service):
    """The score is the mean of the measure, with its sign changed for the largest; the population
    is what remains of parents and children in that order."""
    value = run(service, "campaigns", CAMPAIGN | {"select_by": FAR, "seed": 6})
    path = f"/v1/campaigns/{value['id']}"
    own = {"name": "-displacement_m", "unit": "m"}
    assert value["settings"]["select_by"] == FAR and value["settings"]["racing"] == "off"
    assert value["settings"]["measures"] == ["displacement_m"] and value["own_score"] == own
    rows = service.pages(path + "/phylogeny")
    for row in rows:
        mean = row["measures"]["displacement_m"]
        assert row["score"] == (None if mean is None else -mean) and not row["lower_bound"]
    best = sorted(rows, key=lambda row: (row["score"], row["number"]))[:10]
    population = service.get(path + "/population")
    assert [row["number"] for row in population["items"]] == [row["number"] for row in best]
    champions = service.get(path + "/champions?count=1")
    curve = service.pages(path + "/generations")
    assert champions["items"][0]["number"] == best[0]["number"]
    assert curve[-1]["score"]["quantiles"]["p0"] == best[0]["score"] < curve[0]["score"]["mean"]
    assert all(row["children_cut"] == 0 for row in curve)
    assert population["own_score"] == champions["own_score"] == own
    exported = service.get(f"/v1/campaigns/generations?campaigns={value['id']}")["items"]
    assert {row["own_score"] for row in exported} == {"-displacement_m"}
    # It is another search than that by the loss, and `min` is the opposite one.
    least = run(service, "campaigns", CAMPAIGN | {
        "select_by": FAR | {"direction": "min"}, "seed": 6, "measures": ["work_j"]})
    assert least["settings"]["measures"] == ["displacement_m", "work_j"]
    assert least["own_score"] == {"name": "displacement_m", "unit": "m"}
    near = service.get(f"/v1/campaigns/{least['id']}/population")["items"]
    assert all(row["score"] == row["measures"]["displacement_m"] for row in near)
    assert near[-1]["score"] < -population["items"][-1]["score"]


def test_a_design_without_the_measure_is_last(service):
    """The heading error of a robot that stays where it is has no value: the design ranks last."""
    value = run(service, "campaigns", CAMPAIGN | {
        "select_by": {"measure": "heading_error_rad", "direction": "min"}, "generations": 1,
        "physics": {"n_steps": 30}})
    rows = service.pages(f"/v1/campaigns/{value['id']}/phylogeny")
    without = [row for row in rows if row["measures"]["heading_error_rad"] is None]
    assert without and all(row["score"] is None for row in without)
    population = service.get(f"/v1/campaigns/{value['id']}/population")["items"]
    scores = [row["score"] for row in population]
    assert scores == sorted(scores, key=lambda score: math.inf if score is None else score)


def test_designs_without_the_measure_have_not_diverged(service):
    value = run(service, "campaigns", CAMPAIGN | {
        "select_by": {"measure": "cost_of_transport", "direction": "min"}, "generations": 1,
        "physics": {"n_steps": 1}})
    assert [warning["code"] for warning in value["warnings"]] == ["no_measure"]
    assert "10 of 10 designs of generation 1" in value["warnings"][0]["detail"]


def test_the_batch_of_a_study_is_bounded(service):
    study = STUDY | {"environments": "morpho-12-walk-held-out", "measures": True}
    reply = service.request("POST", "/v1/campaigns", study | {"population": 1563})
    assert reply.status == 422 and "1563 designs" in reply.body.decode()
    assert service.request("POST", "/v1/campaigns", study | {"population": 1562}).status == 202


@pytest.mark.parametrize("more, pointer, words", [
    ({"measures": ["speed"]}, "/measures/0", "\"displacement_m\", \"path_length_m\""),
    ({"measures": []}, "/measures", "at least one"),
    ({"select_by": {"measure": "speed", "direction": "max"}}, "/select_by/measure", "work_j"),
    ({"select_by": {"measure": "work_j"}}, "/select_by", "direction is missing"),
    ({"select_by": {"direction": "max"}}, "/select_by", "measure is missing"),
    ({"select_by": {"measure": "work_j", "direction": "up"}}, "/select_by/direction", "\"max\""),
    ({"select_by": FAR, "racing": "lossless"}, "/racing", "cannot race")])
def test_refusals(service, more, pointer, words):
    reply = service.request("POST", "/v1/campaigns", CAMPAIGN | more)
    assert reply.status == 422 and reply.pointers() == [pointer], reply.json()
    assert words in reply.json()["errors"][0]["detail"]


@pytest.mark.parametrize("more", [{"measures": True}, {"select_by": FAR}])
@pytest.mark.parametrize("mode", [CAMPAIGN, LEARNING], ids=lambda value: value["mode"])
def test_measures_survive_kills(start, tmp_path, mode, more):
    """A campaign that is killed again and again ends as one that is not, with any number of
    threads."""
    value = mode | more | {"physics": {"n_steps": 1500}}
    whole = start("--workers=2")
    expected = history(whole, run(whole, "campaigns", value)["id"])
    id, seen = None, 0
    for round in range(4):
        one = start(f"--workers={1 + round % 2}", state=tmp_path)
        id = id or one.post("/v1/campaigns", value)["id"]
        path = f"/v1/campaigns/{id}"
        now = awaited(one, path, lambda now, least=seen: now["state"] == "succeeded" or (
            now["phase"] == "scoring" and 1 <= now["progress"]["done"] and
            now["progress"]["under_way"] >= least))
        seen = (now["progress"]["under_way"] or 0) + 1
        assert one.stop(signal.SIGKILL) == -9, one.log_text()
    last = start(state=tmp_path)
    if last.get(path)["state"] == "failed":  # it was killed three times in one generation
        last.post(f"/v1/jobs/{id}/resume", {})
    assert await_end(last, path).json()["state"] == "succeeded"
    rows = history(last, id)
    assert rows[1:] == expected[1:]
    assert [{k: v for k, v in row.items() if k != "rollouts"} for row in rows[0]] == [
        {k: v for k, v in row.items() if k != "rollouts"} for row in expected[0]]


STUDY = {"mode": "study", "population": 4, "environments": PLACES, "physics": {"n_steps": 120},
         "exclude_pretraining": False}
BODIES = [{"cells": cells} for cells in (
    [[2, 2, 0], [3, 2, 0]], [[2, 2, 0], [2, 2, 1], [3, 2, 0]], [[2, 2, 0], [2, 3, 0], [2, 4, 0]])]


def tell(service, id, batch, children, **more):
    reply = service.request("POST", f"/v1/campaigns/{id}/tell", {
        "batch": batch, "children": children, **more}, headers=WAIT)
    assert reply.status == 200, reply.body
    return reply.json()["children"]


def test_a_study_gets_measures(service):
    """`tell` returns the measures of each rollout, from which the client computes what it likes,
    beside the measures that the client sends."""
    id = service.post("/v1/campaigns", STUDY | {"measures": WANTED})["id"]
    children = [{"body": body, "measures": {"reach": i}} for i, body in enumerate(BODIES)]
    told = tell(service, id, 0, children)
    assert service.get(f"/v1/campaigns/{id}")["study"]["measures"] == [*KEPT, "reach"]
    for i, (row, found) in enumerate(zip(told, evaluated(service, told))):
        assert row["measures"] == {name: found["measures"][name] for name in KEPT} | {"reach": i}
        assert row["flags"] == found["flags"]
        for entry, whole in zip(row["losses"], found["losses"], strict=True):
            assert entry["loss"] == whole["loss"] and entry["flags"] == whole["flags"]
            assert entry["measures"] == {name: whole["measures"][name] for name in KEPT}
    # A body that is told again is found, and so is a batch that is read again.
    again = tell(service, id, 1, [{"body": BODIES[1], "measures": {"reach": 7, "more": 1}}])
    assert again[0]["losses"] == told[1]["losses"]
    assert again[0]["measures"] == told[1]["measures"] | {"reach": 7, "more": 1}
    assert service.get(f"/v1/campaigns/{id}/batch")["children"] == again
    first = service.pages(f"/v1/campaigns/{id}/phylogeny")[0]
    assert first["measures"] == told[0]["measures"] | {"more": None}
    # The names of the service's measures are taken.
    reply = service.request("POST", f"/v1/campaigns/{id}/tell", {
        "batch": 2, "children": [{"body": BODIES[0], "measures": {"work_j": 1}}]})
    assert reply.status == 422 and reply.pointers() == ["/children/0/measures/work_j"]


def test_a_study_selects_by_a_measure(service):
    """The service selects; the client sends no scores."""
    id = service.post("/v1/campaigns", STUDY | {"select_by": FAR, "population": 3})["id"]
    told = tell(service, id, 0, [{"body": body} for body in BODIES])
    assert [row["score"] for row in told] == [-row["measures"]["displacement_m"] for row in told]
    more = tell(service, id, 1, [{"body": {"cells": [[x, 2, 0] for x in range(n)]}}
                                 for n in (3, 4)])
    population = service.get(f"/v1/campaigns/{id}/population")
    best = sorted(row["score"] for row in told + more)[:3]
    assert [row["score"] for row in population["items"]] == best
    assert population["own_score"] == {"name": "-displacement_m", "unit": "m"}
    assert service.get(f"/v1/campaigns/{id}")["study"]["own_score"] is None
    reply = service.request("POST", f"/v1/campaigns/{id}/tell", {
        "batch": 2, "children": [{"body": BODIES[0], "score": 1}]})
    assert reply.status == 422 and reply.pointers() == ["/children/0/score"]


def test_a_study_is_found_by_its_measures(service):
    """Measures belong to the settings that an opened study must match."""
    one = STUDY | {"label": "measured", "if_exists": "return", "measures": ["work_j"],
                   "select_by": FAR}
    id = service.post("/v1/campaigns", one)["id"]
    assert service.post("/v1/campaigns", one)["id"] == id
    for more, pointer in (({"measures": ["tilt_rad"]}, "/measures"),
                          ({"select_by": FAR | {"direction": "min"}}, "/select_by")):
        reply = service.request("POST", "/v1/campaigns", one | more)
        assert reply.status == 409 and pointer in reply.pointers(), reply.json()
    # A client's own score is another setting, even under the name that the service uses.
    scored = STUDY | {"label": "measured", "if_exists": "return", "measures": ["work_j"],
                      "own_score": {"name": "-displacement_m", "unit": "m"}}
    reply = service.request("POST", "/v1/campaigns", scored)
    assert reply.status == 409, reply.json()


def test_a_client_scores_by_measures(service):
    """An own score that is computed from an evaluation costs `tell` nothing but the look-up."""
    found = run(service, "evaluations", {
        "designs": BODIES, "environments": PLACES, "physics": STUDY["physics"], "measures": KEPT})
    effort = [row["measures"]["work_j"] / max(row["measures"]["displacement_m"], 0.01)
              for row in found["results"]]
    id = service.post("/v1/campaigns", STUDY | {
        "measures": KEPT, "own_score": {"name": "effort", "unit": "J/m"}})["id"]
    told = tell(service, id, 0, [{"body": body, "score": score}
                                 for body, score in zip(BODIES, effort)])
    assert [row["score"] for row in told] == effort
    assert [row["measures"] for row in told] == [row["measures"] for row in found["results"]]
    curve = service.pages(f"/v1/campaigns/{id}/generations")
    assert curve[0]["cached"] == curve[0]["rollouts"] == len(BODIES) * len(PLACES)


def test_morphoctl(service, ctl):  # noqa: F811
    settings = "--population 4 --generations 1 --physics n_steps=60"
    status, out, err = ctl(f"campaign start zero-shot {settings} --measures work_j,tilt_rad "
                           "--select-by displacement_m,max -q")
    assert status == 0, err
    id = out.strip()
    await_end(service, f"/v1/campaigns/{id}")
    status, out, err = ctl(f"campaign show {id}")
    assert status == 0 and "displacement_m, max" in out, err
    assert "displacement_m, tilt_rad, work_j" in out and "racing off" in out
    status, out, err = ctl(f"campaign champions {id}")
    assert status == 0 and all(
        name in out.splitlines()[0] for name in ("displacement_m", "tilt_rad", "work_j")), err
    status, out, err = ctl("campaign start zero-shot --select-by displacement_m")
    assert status != 0 and "displacement_m,max" in err
    status, out, err = ctl("campaign start zero-shot --select-by speed,max")
    assert status != 0 and "inverted_voxels" in err
    plain = ctl(f"campaign start zero-shot {settings} -q")[1].strip()
    await_end(service, f"/v1/campaigns/{plain}")
    status, out, _ = ctl(f"campaign champions {plain}")
    assert status == 0 and "work_j" not in out
    status, _, err = ctl(f"campaign compare {plain} {id}")
    assert status != 0 and "own_score" in err


@pytest.fixture(scope="module", name="bundle")
def bundle_of_measures(service, measured):
    """A campaign with measures, one that selects by one, and one that learned."""
    by = run(service, "campaigns", CAMPAIGN | {"select_by": FAR, "measures": True, "seed": 8})["id"]
    learned = run(service, "campaigns", LEARNING | {
        "measures": ["work_j"], "name": "bundled", "seed": 8})["id"]
    ids = sorted([measured["id"], by, learned], key=int)
    return ids, service.request("GET", f"/v1/bundles?campaigns={','.join(ids)}").body


def test_bundles_have_measures(service, start, bundle):
    """They enter another service with the designs and with the rollouts."""
    ids, sent = bundle
    other = start()
    reply = enter(other, sent)
    assert reply.status == 201, reply.body
    for old, item in zip(ids, reply.json()["items"], strict=True):
        new = item["campaign"]
        assert history(service, old) == history(other, new)
        one, two = service.get(f"/v1/campaigns/{old}"), other.get(f"/v1/campaigns/{new}")
        assert one["settings"] == two["settings"] and one.get("own_score") == two.get("own_score")
        rows = other.pages(f"/v1/campaigns/{new}/phylogeny")
        if two["mode"] == "zero-shot":  # the evaluation finds every measured rollout
            assert [row["measures"] for row in evaluated(other, rows)] == [
                row["measures"] for row in evaluated(service, rows)]
    assert enter(other, sent).status == 200
    # What the other service exports again is the same.
    again = other.request("GET", "/v1/bundles").body
    lines = [[(name.split("/", 2)[-1], body) for name, body in unpack(data)
              if "/designs/" in name or "/scores/" in name] for data in (sent, again)]
    assert lines[0] == lines[1]
    # The campaign goes on there, and selects as before.
    by = reply.json()["items"][1]["campaign"]
    other.post(f"/v1/campaigns/{by}/extend", {"generations": 1})
    service.post(f"/v1/campaigns/{ids[1]}/extend", {"generations": 1})
    ends = [await_end(one, f"/v1/campaigns/{id}").json()["state"]
            for one, id in ((other, by), (service, ids[1]))]
    assert ends == ["succeeded"] * 2
    assert history(other, by)[1:] == history(service, ids[1])[1:]


@pytest.mark.parametrize("name, change, words", [
    ("designs/", put("measures", lambda means: [means[0] + 1, *means[1:]]), "not the means over"),
    ("designs/", put("measures", lambda means: means[1:]), "that the campaign names"),
    ("scores/", put("measures", lambda rows: [[0.5 ** 40, *rows[0][1:]], *rows[1:]]),
     "displacement_m of rollout 0 is not a multiple"),
    ("scores/", put("measures", lambda rows: rows[1:]), "all 20 measures of each"),
    ("scores/", put("measures", lambda rows: [rows[0][1:], *rows[1:]]),
     "all 20 measures of each")])
def test_altered_measures_are_refused(service, start, measured, name, change, words):
    sent = service.request("GET", f"/v1/bundles?campaigns={measured['id']}").body
    reply = enter(start(), pack(altered(unpack(sent), name, change)), "verify")
    assert reply.status == 422 and words in reply.json()["errors"][0]["detail"], reply.json()


def test_another_score_of_a_measure_is_refused(service, start, bundle):
    ids, _ = bundle
    sent = service.request("GET", f"/v1/bundles?campaigns={ids[1]}").body
    reply = enter(start(), pack(altered(unpack(sent), "designs/",
                                        put("score", lambda score: score - 1))), "verify")
    assert reply.status == 422
    assert "does not match the mean of the measure" in reply.json()["errors"][0]["detail"]

