"""`"measures"` and `"select_by"` of campaigns: measures of every design, and selection by one."""

import csv
import io
import math
import signal

import pytest

from ctl import ctl  # noqa: F401
from service import await_end, awaited, run
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


@pytest.mark.parametrize("more, pointer, words", [
    ({"measures": ["speed"]}, "/measures/0", "\"displacement_m\", \"path_length_m\""),
    ({"measures": []}, "/measures", "at least one"),
    ({"measures": True, "device": "cuda"}, "/measures", "request \"cpu\" or \"auto\""),
    ({"select_by": FAR, "device": "cuda"}, "/select_by", "request \"cpu\" or \"auto\""),
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
