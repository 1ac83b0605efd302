"""Certificates: losses are those of evaluations in the same worlds, figures follow from them, and a
report does not depend on what computed or interrupted the job."""

import csv
import io
import itertools
import sqlite3

import numpy
import pytest

from service import Service, await_end, awaited, run, until
from test_devices import FLAGS, fake

AXES = ["base", "precision", "step", "held_out", "chance", "friction", "worlds"]
SIX = {"axes": AXES, "levels": [0.7, 1.2], "held_out": 64, "chance": 2, "worlds": 70, "seed": 9,
       "physics": {"n_steps": 60}}
TRIALS = [("base", None, 10), ("precision", 64, 10), ("step", 2, 10), ("step", 4, 10),
          ("held_out", None, 64), ("chance", None, 20), ("friction", 0.7, 10),
          ("friction", 1.2, 10), ("worlds", None, 70)]
ROLLOUTS = sum(n for _, _, n in TRIALS)
QUICK = {"axes": ["friction"], "levels": [0.5], "physics": {"n_steps": 20}}
ENDED = ("succeeded", "failed", "cancelled")


def bodies(service, n, seed=3):
    made = service.post("/v1/bodies/random", {"count": n, "seed": seed})["items"]
    return [{"id": item["id"] + "@0"} for item in made]


def certify(service, value):
    """Submits a certificate, and returns it at its end and its report."""
    reply = service.request("POST", "/v1/certificates", value)
    assert reply.status == 202, reply.body
    path = f"/v1/certificates/{reply.json()['id']}"
    assert reply.headers["Location"] == path
    done = await_end(service, path).json()
    assert done["state"] == "succeeded", (done, service.log_text()[-2000:])
    return done, service.get(path + "/report")


def scores(report, axis, level=None):
    """Returns the scores of the designs at a level."""
    at = [(row["axis"], row["level"]) for row in report["levels"]].index((axis, level))
    return [design["levels"][at]["score"] for design in report["designs"]]


def evaluated(service, robots, worlds, **more):
    """Returns the mean losses from evaluations, of losses in float32."""
    losses = [[] for _ in robots]
    for i in range(0, len(worlds), 60):
        value = {"designs": [{"id": robot} for robot in robots], "environments": worlds[i:i + 60],
                 "physics": {"n_steps": 60}} | more
        reply = service.evaluate(value, wait=60)
        assert reply.status == 200, reply.body
        for own, result in zip(losses, reply.json()["results"]):
            own += [cell["loss"] if isinstance(cell, dict) else cell for cell in result["losses"]]
    return numpy.array(losses, "float32").astype("float64").mean(1).tolist()


@pytest.fixture(scope="module", name="service")
def service_of_this_module():
    running = Service("--workers=2")
    yield running
    assert running.close() == 0, running.log_text()


@pytest.fixture(scope="module")
def made(service):
    """A certificate of six designs, computed before anything else is scored."""
    job, report = certify(service, SIX | {"designs": bodies(service, 6), "label": "six"})
    with sqlite3.connect(f"file:{service.state}/morphod.db?mode=ro", uri=True) as database:
        for table in ("scores", "set_scores", "conditions"):
            assert database.execute(f"SELECT count(*) FROM {table}").fetchone() == (0, ), table
    return job, report


def test_what_verdicts_say_in_brief(made):
    """The class, the numerics and the axes follow from the levels, by the rules of
    docs/trust.md."""
    report = made[1]
    axes = [row["axis"] for row in report["levels"]]
    finest = len(axes) - 1 - axes[::-1].index("step")
    for design in report["designs"]:
        at = design["levels"][finest]
        kept = not at["diverged"] and abs(at["rank"] - design["rank"]) <= 1
        assert design["numerics"] == {"axis": "step", "kept": kept, "rank": at["rank"],
                                      "diverged": at["diverged"]}
        worse = {axis for axis, one in zip(axes, design["levels"]) if one["diverged"] or (
            one["change"] is not None and one["change"] >= 0.05 and one["change_interval"][0] > 0)}
        worse &= {"held_out", "friction", "worlds"}
        assert set(design["worse"]) == worse
        assert design["class"] == ("in_doubt" if not kept else "depends" if worse else "holds")


def test_the_job(service, made):
    job, report = made
    shown = job["certificate"]
    assert job["kind"] == "certificate" and job["priority"] == "batch" and job["error"] is None
    assert shown["environments"] == "paper-test" and shown["controller"]["name"] == "default"
    assert shown["axes"] == AXES and shown["levels"] == [0.7, 1.2] and shown["seed"] == 9
    assert shown["top"] == 1 and shown["from_population"] == [] and job["population"] is None
    assert shown["designs"] == 6 and shown["ranges"]["friction"] == [1 / 3, 4 / 3]
    assert shown["trials_done"] == shown["trials"] == len(TRIALS)
    assert shown["rollouts_done"] == shown["rollouts"] == 6 * ROLLOUTS
    assert shown["phase"] == "idle" and job["core_seconds"] > 0
    assert job["left_out"] == report["left_out"] == [] and job["notes"] == []
    assert job["links"]["report"] == f"/v1/certificates/{job['id']}/report"
    brief = {name: job[name] for name in job if name not in (
        "population", "left_out", "axis_notes", "notes", "links")}
    assert service.get(f"/v1/jobs/{job['id']}") == brief
    assert brief in service.get("/v1/jobs?kind=certificate")["items"]
    assert brief in service.get("/v1/certificates")["items"]
    line = service.table("/v1/certificates?format=csv&label=six")[-1]
    assert line["certificate_rollouts"] == str(6 * ROLLOUTS)
    events = service.get(f"/v1/events?format=json&job={job['id']}&limit=1000")["items"]
    assert events[0]["type"] == "job.created" and events[-1]["type"] == "job.finished"
    progress = [event["data"] for event in events if event["type"] == "certificate.progress"]
    assert progress[-1]["rollouts_done"] == 6 * ROLLOUTS
    assert service.metric("morphod_certificate_rollouts_total") >= 6 * ROLLOUTS
    assert service.metric("morphod_certificates_running") == 0


def test_losses_are_those_of_evaluations(service, made):
    """The base, precision, steps, friction, and fresh worlds, each from evaluations of the same."""
    _, report = made
    robots = [design["design"] for design in report["designs"]]
    shown = [(row["axis"], row["level"], row["environments"]) for row in report["levels"]]
    assert shown == TRIALS and report["complete"] and report["n_designs"] == 6
    worlds = service.get("/v1/environment-sets/paper-test")["items"]
    worlds = [{name: world[name] for name in ("light_xy_m", "terrain_heights_m")}
              for world in worlds]
    # 4 · 60 steps of dt / 4
    fine = {level: {"n_steps": 60 * level, "dt_s": 0.002 / level} for level in (2, 4)}
    fresh = service.get("/v1/held-out?seed=9&designs=1&environments=64")["environments"]
    for axis, level, expected in (
            ("base", None, evaluated(service, robots, worlds)),
            ("precision", 64, evaluated(service, robots, worlds, precision="float64")),
            ("step", 2, evaluated(service, robots, worlds, precision="float64", physics=fine[2])),
            ("step", 4, evaluated(service, robots, worlds, precision="float64", physics=fine[4])),
            ("friction", 0.7, evaluated(service, robots, [
                world | {"factors": {"friction": 0.7}} for world in worlds])),
            ("held_out", None, evaluated(service, robots, fresh))):
        assert scores(report, axis, level) == pytest.approx(expected, rel=1e-12), axis
    base = scores(report, "base")
    assert len(set(base)) > 3
    for axis, level, _ in TRIALS[1:]:
        assert scores(report, axis, level) != base, axis


def test_more_worlds_than_a_part(service):
    """66 worlds: those of the base in turn, each with the friction that the ranges allow."""
    worlds = [{"task": "walk"}, {"task": "circle"}, *(
        {"light_xy_m": [4, 2.5], "terrain_sigma_m": 0.05, "seed": seed} for seed in range(3))]
    ones = {name: [1, 1] for name in ("stiffness", "mass", "drag", "gravity", "actuation")}
    value = {"designs": bodies(service, 5), "axes": ["worlds"], "worlds": 66,
             "environments": worlds, "ranges": ones | {"friction": [0.7, 0.7]},
             "physics": {"n_steps": 80}}
    _, report = certify(service, value)
    assert [row["environments"] for row in report["levels"]] == [5, 66]
    robots = [design["design"] for design in report["designs"]]
    apart = [evaluated(service, robots, [world | {"factors": {"friction": 0.7}}],
                       physics={"n_steps": 80}) for world in worlds]
    for d, design in enumerate(report["designs"]):
        expected = sum(apart[k % 5][d] for k in range(66)) / 66
        assert design["levels"][1]["score"] == pytest.approx(expected, rel=1e-12)


def test_figures_follow_from_scores(made):
    _, report = made
    base = scores(report, "base")
    ranks = [1 + sum(other < own for other in base) for own in base]
    assert [design["rank"] for design in report["designs"]] == ranks
    for t, row in enumerate(report["levels"]):
        own = [design["levels"][t]["score"] for design in report["designs"]]
        assert row["mean_score"] == pytest.approx(numpy.mean(own))
        assert row["precision"] == ("float64" if row["axis"] in ("precision", "step")
                                    else "float32")
        assert row["fingerprint"].split()[2] == row["precision"]
        if t == 0 or row["axis"] == "chance":  # chance: means over copies
            continue
        pairs = list(itertools.combinations(range(6), 2))
        tau = sum(numpy.sign((base[i] - base[j]) * (own[i] - own[j])) for i, j in pairs)
        assert row["tau"] == pytest.approx(tau / len(pairs))
        best = own[base.index(min(base))]
        assert row["top_score"] == pytest.approx(best)
        assert row["regret"] == pytest.approx(best - min(own))
        for design, score, first in zip(report["designs"], own, base):
            cell = design["levels"][t]
            assert cell["change"] == pytest.approx(score - first)
            low, high = cell["interval"]
            assert low < score < high and cell["diverged"] == 0
            assert cell["change_interval"][0] < cell["change"] < cell["change_interval"][1]
    first = report["levels"][0]
    assert first["tau"] is first["tau_interval"] is first["regret"] is None
    assert all(design["levels"][0]["change"] is None for design in report["designs"])


def test_flags_are_those_of_the_base(service, made):
    _, report = made
    value = {"designs": [{"id": design["design"]} for design in report["designs"]],
             "physics": {"n_steps": 60}, "measures": ["peak_strain", "inverted_voxels"]}
    results = service.evaluate(value).json()["results"]
    for design, result in zip(report["designs"], results):
        measures = [cell["measures"] for cell in result["losses"]]
        for name in ("peak_strain", "inverted_voxels"):
            assert design[name] == max(one[name] for one in measures)
        assert design["flags"] == result["flags"] and design["id"] == design["design"][:36]
        assert design["verdict"]


def test_csv(service, made):
    job, report = made
    path = f"/v1/certificates/{job['id']}/report"
    service.tagged(path)
    reply = service.tagged(path + ".csv")
    assert reply.headers["Content-Type"].startswith("text/csv")
    lines = list(csv.DictReader(io.StringIO(reply.body.decode())))
    assert len(lines) == 6 * len(TRIALS)
    cells = [(design, row, cell) for design in report["designs"]
             for row, cell in zip(report["levels"], design["levels"])]
    for line, (design, row, cell) in zip(lines, cells):
        assert line["id"] == "d" + design["id"] and line["robot"] == design["design"]
        assert (line["axis"], line["precision"]) == (row["axis"], row["precision"])
        ends = cell["change_interval"] or [None, None]
        for name, value in (("level", row["level"]), ("score", cell["score"]),
                            ("change", cell["change"]), ("change_low", ends[0]),
                            ("change_high", ends[1]), ("score_high", cell["interval"][1])):
            assert (float(line[name]) if line[name] else None) == value, name
        assert int(line["rank"]) == cell["rank"] and int(line["diverged"]) == cell["diverged"]


def test_the_same_report_elsewhere(service, made, start):
    """One worker instead of two."""
    job, report = made
    other = start("--workers=1")
    again, elsewhere = certify(other, SIX | {"designs": bodies(other, 6)})
    assert elsewhere | {"id": ""} == report | {"id": ""}
    assert again["certificate"] == job["certificate"]
    _, seeded = certify(service, SIX | {"designs": bodies(service, 6), "seed": 10})
    assert scores(seeded, "base") == scores(report, "base")
    assert scores(seeded, "worlds") != scores(report, "worlds")


def test_devices(service, made, start):
    """Devices compute float32, here with the same bits, and processors float64."""
    _, report = made
    on_device = start(*FLAGS, environment=fake(devices=2))
    job, other = certify(on_device, SIX | {"designs": bodies(on_device, 6), "device": "cuda"})
    assert job["device"] == "cuda" and job["device_seconds"] > 0
    for row, own in zip(other["levels"], report["levels"]):
        kind = "fake" if row["precision"] == "float32" else "cpu"
        assert row["fingerprint"].split()[0] == kind, row
        assert row | {"fingerprint": ""} == own | {"fingerprint": ""}
    assert other["designs"] == report["designs"]


# ---- designs of other jobs ----

CAMPAIGN = {"mode": "zero-shot", "population": 6, "generations": 1, "seed": 4,
            "physics": {"n_steps": 24}, "environments": [
                {"light_xy_m": [4, 2.5], "terrain_sigma_m": 0.05, "seed": 3}, {"task": "walk"}]}


def test_a_campaign(service):
    campaign = run(service, "campaigns", CAMPAIGN | {"controller": "default"})
    source = {"campaign": campaign["id"], "best": 3}
    job, report = certify(service, {"population": source, "axes": ["chance"]})
    shown = job["certificate"]
    assert shown["from_population"] == ["controller", "environments", "physics"]
    assert shown["environments"] == {"count": 2} and shown["physics"]["n_steps"] == 24
    assert shown["controller"]["sha256"] == campaign["controller"]["sha256"]
    assert job["population"] == {"campaign": campaign["id"]} and report["n_designs"] == 3
    best = service.get(f"/v1/campaigns/{campaign['id']}/population")["items"][:3]
    assert [design["design"] for design in report["designs"]] == [row["robot"] for row in best]
    assert scores(report, "base") == pytest.approx([row["score"] for row in best], rel=1e-6)
    refused = service.request("DELETE", f"/v1/jobs/{campaign['id']}")
    assert refused.status == 409 and "is about its designs" in refused.json()["detail"]
    given = {"population": source, "environments": "morpho-12-walk", "physics": {"n_steps": 30},
             "controller": "default", "axes": ["base"]}
    shown = certify(service, given)[0]["certificate"]
    assert shown["from_population"] == [] and shown["environments"] == "morpho-12-walk"
    assert shown["physics"]["n_steps"] == 30 and shown["controller"]["name"] == "default"
    assert shown["designs"] == 3


def test_a_campaign_that_learned(service):
    """Its own controller scores, not the one that it started with."""
    campaign = run(service, "campaigns", CAMPAIGN | {
        "mode": "simultaneous", "population": 3, "name": "clever",
        "learning": {"parent_steps": 1, "child_steps": 1, "batch": 2}})
    job, report = certify(service, {"population": {"campaign": campaign["id"]}, "axes": ["base"]})
    made = service.get("/v1/controllers/clever")["sha256"]
    assert job["certificate"]["controller"] == {"name": None, "sha256": made}
    assert report["n_designs"] == 3
    unfinished = service.post("/v1/campaigns", CAMPAIGN | {
        "mode": "simultaneous", "controller": None, "generations": 100000,
        "learning": {"parent_steps": 1, "child_steps": 1, "batch": 2}})["id"]
    awaited(service, f"/v1/campaigns/{unfinished}",
            lambda now: now["progress"]["generation"] is not None)
    reply = service.request("POST", "/v1/certificates", {"population": {"campaign": unfinished}})
    assert reply.status == 422 and reply.pointers() == ["/controller"], reply.body
    service.act(unfinished, "cancel")


def test_an_evaluation(service):
    value = {"designs": bodies(service, 30, 8), "physics": {"n_steps": 20},
             "environments": CAMPAIGN["environments"]}
    evaluation = service.evaluate(value).json()
    best = sorted(evaluation["results"], key=lambda result: result["score"])
    request = {"population": {"evaluation": evaluation["id"]}, "axes": ["base"]}
    job, report = certify(service, request)
    shown = job["certificate"]
    assert shown["from_population"] == ["controller", "environments", "physics"]
    assert shown["environments"] == {"count": 2} and shown["physics"]["n_steps"] == 20
    assert shown["controller"]["sha256"] == evaluation["controller"]["sha256"]
    assert report["n_designs"] == 20
    assert scores(report, "base") == pytest.approx([row["score"] for row in best[:20]], rel=1e-6)
    assert [design["design"] for design in report["designs"]] == [
        result["robot"] for result in best[:20]]
    losses = [design["score"] for design in report["designs"]]
    assert [design["rank"] for design in report["designs"]] == [
        1 + sum(other < own for other in losses) for own in losses]
    assert report["top"] == 2
    given = request | {"environments": "paper-test", "physics": {"n_steps": 10}}
    shown = certify(service, given)[0]["certificate"]
    assert shown["from_population"] == ["controller"]
    assert shown["environments"] == "paper-test"


def test_an_evaluation_in_a_suite(service):
    """There is no base in many tasks: one of them must be given."""
    suite = service.evaluate({"designs": bodies(service, 2, 8), "physics": {"n_steps": 2},
                              "environments": "morpho-12"}).json()
    request = {"population": {"evaluation": suite["id"]}, "axes": ["base"]}
    reply = service.request("POST", "/v1/certificates", request)
    assert reply.status == 409 and "give environments" in reply.json()["detail"], reply.body
    job, _ = certify(service, request | {"environments": "morpho-12-walk"})
    assert job["certificate"]["from_population"] == ["controller", "physics"]


def test_notes(service):
    """Skipped, repaired and turned designs are reported."""
    designs = [{"cells": [[0, 0, 0], [2, 2, 0], [3, 2, 0]]}, {"cells": []},
               {"id": bodies(service, 1)[0]["id"][:36]}]
    job, report = certify(service, QUICK | {"designs": designs, "on_fault": "skip",
                                            "repair": "largest"})
    assert [(note["place"], note["repaired"], note["fault"] is None, note["orientation"])
            for note in job["notes"]] == [(0, 1, True, None), (1, 0, False, None),
                                          (2, 0, True, "canonical")]
    assert report["n_designs"] == 2
    reply = service.request("POST", "/v1/certificates",
                            {"designs": [{"cells": []}], "on_fault": "skip"})
    assert reply.status == 422 and reply.pointers() == ["/designs"]


def test_axes_that_do_not_apply(service):
    stairs = [{"task": "walk", "terrain": {"kind": "stairs-up"}}]
    value = QUICK | {"designs": bodies(service, 4), "environments": stairs,
                     "axes": ["held_out", "friction", "drag"], "physics": {
                         "n_steps": 20, "drag_per_s": 0}}
    job, report = certify(service, value)
    assert [row["axis"] for row in report["left_out"]] == ["held_out", "drag"]
    assert job["left_out"] == report["left_out"] and all(
        len(row["reason"]) > 20 for row in report["left_out"])
    assert [row["axis"] for row in report["levels"]] == ["base", "friction"]
    assert job["certificate"]["trials"] == 2


@pytest.mark.parametrize("change,pointer", [
    ({"designs": None}, "/designs"),
    ({"axes": []}, "/axes"), ({"axes": ["wind"]}, "/axes/0"), ({"levels": [1]}, "/levels"),
    ({"levels": [1.2, 0.7]}, "/levels"), ({"held_out": 1}, "/held_out"),
    ({"worlds": 257}, "/worlds"), ({"chance": 65}, "/chance"), ({"top": 257}, "/top"),
    ({"ranges": {"friction": [1.2, 0.7]}}, "/ranges"),
    ({"ranges": {"wind": [1, 2]}}, "/ranges/wind"),
    ({"environments": "morpho-12"}, "/environments"), ({"controller": "nobody"}, "/controller"),
    ({"controller": None}, "/controller"), ({"priority": "interactive"}, "/priority"),
    ({"physics": {"dt_s": -1}}, "/physics/dt_s"), ({"physics": {"dt_s": 0.003}}, "/physics"),
    ({"voxels": 3}, "/voxels")])
def test_refusals(service, change, pointer):
    value = QUICK | {"designs": bodies(service, 2)} | change
    reply = service.request("POST", "/v1/certificates", value)
    assert reply.status == 422 and reply.pointers() == [pointer], reply.body


@pytest.mark.parametrize("population,status,pointer", [
    ({"campaign": "999"}, 422, "/population/campaign"), ({"best": 3}, 422, "/population"),
    ({"evaluation": "999"}, 422, "/population/evaluation"),
    ({"evaluation": "1", "best": 257}, 422, "/population/best")])
def test_refused_populations(service, population, status, pointer):
    reply = service.request("POST", "/v1/certificates", {"population": population})
    assert reply.status == status and pointer in reply.pointers(), reply.body
    both = service.request("POST", "/v1/certificates", {
        "population": population, "designs": bodies(service, 1)})
    assert "both designs and population are given" in both.body.decode()
    neither = service.request("POST", "/v1/certificates", {})
    assert neither.status == 422 and neither.pointers() == [""]


def test_too_many_designs(service):
    reply = service.request("POST", "/v1/certificates", {"designs": bodies(service, 257)})
    assert reply.status == 422 and reply.pointers() == ["/designs"]


def test_keys(service):
    value, headers = QUICK | {"designs": bodies(service, 2)}, {"Idempotency-Key": "one of them"}
    first = service.post("/v1/certificates", value, headers=headers)
    assert service.post("/v1/certificates", value, headers=headers)["id"] == first["id"]
    assert service.request("POST", "/v1/certificates", value | {"seed": 2},
                           headers=headers).status == 422


# ---- interruptions ----

LONG = SIX | {"physics": {"n_steps": 2000}, "axes": ["chance", "friction"], "chance": 8}


def test_a_report_of_a_running_job(service):
    id = service.post("/v1/certificates", LONG | {"designs": bodies(service, 20)})["id"]
    waiting = service.post("/v1/certificates", QUICK | {"designs": bodies(service, 2)})["id"]
    path = f"/v1/certificates/{id}"
    reply = service.request("GET", f"/v1/certificates/{waiting}/report")
    assert reply.status == 409 and "no complete trial" in reply.json()["detail"]
    now = awaited(service, path, lambda job: job["certificate"]["trials_done"] > 0 and
                  job["certificate"]["progress"]["rollouts_per_s"] is not None)
    assert now["state"] == "running" and now["certificate"]["phase"] == "scoring"
    assert now["certificate"]["progress"]["seconds_left"] > 0
    report = service.get(path + "/report")
    assert not report["complete"] and 1 <= len(report["levels"]) < 4
    assert [row["axis"] for row in report["levels"]] == ["base", "chance", "friction"][:len(
        report["levels"])]
    assert service.request("DELETE", f"/v1/jobs/{id}").status == 409
    assert service.act(id, "pause").status == 200
    done = until(lambda: service.get(path)["certificate"]["phase"] == "idle" and service.get(path))
    assert done["state"] == "paused"
    assert service.act(id, "resume").status == 200
    assert service.act(id, "cancel").status == 200
    assert not service.get(path + "/report")["complete"]
    assert await_end(service, f"/v1/certificates/{waiting}").json()["state"] == "succeeded"
    deleted = service.request("DELETE", f"/v1/jobs/{id}")
    assert deleted.status == 200 and deleted.json()["kind"] == "certificate"
    assert service.request("GET", path + "/report").status == 404
    with sqlite3.connect(f"file:{service.state}/morphod.db?mode=ro", uri=True) as database:
        count = "SELECT count(*) FROM certificate_losses WHERE job=?"
        until(lambda: database.execute(count, (id, )).fetchone() == (0, ))


def test_lost_losses_are_not_a_lost_certificate(start, tmp_path):
    """The losses of a complete trial are gone: the certificate exists, its report cannot."""
    keeper = start(state=tmp_path / "state")
    job, _ = certify(keeper, QUICK | {"designs": bodies(keeper, 2)})
    assert keeper.stop() == 0
    with sqlite3.connect(tmp_path / "state" / "morphod.db") as database:
        assert database.execute("DELETE FROM certificate_losses WHERE trial=1").rowcount > 0
    keeper = start(state=tmp_path / "state")
    path = f"/v1/certificates/{job['id']}"
    assert keeper.get(path)["state"] == "succeeded"
    for report in ("/report", "/report.csv"):
        reply = keeper.request("GET", path + report)
        assert reply.status == 500 and "corrupt" in reply.json()["detail"]


def test_stops_and_pauses(service, start, tmp_path):
    """A service that stops and starts again, with pauses in between: the same report."""
    value = LONG | {"designs": bodies(service, 20)}
    _, whole = certify(service, value)
    state = tmp_path / "state"
    keeper = start("--workers=1", state=state)
    path = f"/v1/certificates/{keeper.post('/v1/certificates', value)['id']}"
    done, stops, pauses = 0, 0, 0
    for stop in range(4):
        job = awaited(keeper, path, lambda job, least=done: job["state"] in ENDED or
                      job["certificate"]["rollouts_done"] > least)
        done = job["certificate"]["rollouts_done"]
        if stop % 2 == 0 and keeper.act(job["id"], "pause").status == 200:
            assert keeper.get(path)["state"] == "paused"
            pauses += 1
            keeper.act(job["id"], "resume")
        assert keeper.stop() == 0
        with sqlite3.connect(f"file:{state}/morphod.db?mode=ro", uri=True) as database:
            stored, = database.execute("SELECT rollouts_done FROM certificates").fetchone()
        keeper = start("--workers=2", state=state)
        stops += keeper.get(path)["state"] not in ENDED
    assert stops > 0 and pauses > 0, "the job was over too soon"
    job = await_end(keeper, path).json()
    assert job["state"] == "succeeded" and job["attempts"] == 0
    assert keeper.get(path + "/report") | {"id": ""} == whole | {"id": ""}
    computed = keeper.metric("morphod_certificate_rollouts_total")
    assert computed == job["certificate"]["rollouts"] - stored
