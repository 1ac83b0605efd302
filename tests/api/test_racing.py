"""Children that cannot survive are cut short: the same campaign, with scores that are bounds."""

import csv
import io

import pytest

from contract import SOURCE
from service import Service, run
from test_bundles import enter
from test_devices import FLAGS, fake
from ctl import ctl  # noqa: F401
from test_worlds import scene

# Outputs that are held for a while make no child bad enough.
CONTROLLER = f"--default-controller={SOURCE / 'data' / 'controllers' / 'bootstrap.safetensors'}"
# Robots that walk: random bodies are rarely bad enough to be cut short.
FOUNDERS = """
    000800cceec00c8a000c4e20000000000000 0c4e200c8a00cceec0000000000000000000
    0219eb6fdd83fc9f9db8cc793ad1fb107f1a 0ae400c4680048ee00000000000000000000
    0619ab6fdd83fc9f9db8cc793ad1fa107f1a 0619ab6fdd83fc8f9db8cc793ad1fa107f1a
    04c4e200c8a0cc46e4000000000000000000 00c4e202e8a08ccee4000000000000000000
    0219ab6fdd83fc9f9db8cc793ad1fa107f1a 0008eb686ab1fe3d5dfebe3d3de25b1407fa
    07e2f40fd1f711ccdc3eb314000000000000 0008eb687ab9fe3d5dbeb63d3de25b1407fa
""".split()
CAMPAIGN = {"mode": "zero-shot", "population": 12, "generations": 4, "seed": 11,
            "initial": {"designs": [{"id": id} for id in FOUNDERS]},
            "exclude_pretraining": False, "physics": "paper"}
LIVES = ("number", "id", "genotype", "parents", "operator", "born", "died")


def lives(row):
    return [row[name] for name in LIVES]


@pytest.fixture(scope="module", name="service")
def service_with_this_controller():
    running = Service(CONTROLLER)
    yield running
    assert running.close() == 0, running.log_text()


@pytest.fixture(scope="module")
def raced(service):
    return run(service, "campaigns", CAMPAIGN)["id"]


@pytest.fixture(scope="module")
def designs(service, raced):
    return service.pages(f"/v1/campaigns/{raced}/phylogeny")


@pytest.fixture(scope="module")
def whole():
    """The same campaign without races, on a service without its scores."""
    other = Service(CONTROLLER)
    yield other, run(other, "campaigns", CAMPAIGN | {"racing": "off"})["id"]
    assert other.close() == 0, other.log_text()


def generations(service, id):
    return service.get(f"/v1/campaigns/{id}/generations")["items"]


def test_the_same_campaign(service, raced, whole, designs):
    """Populations, births, deaths and statistics are the same. A lower bound is below the score,
    and no survivor has a bound instead of a score."""
    other, id = whole
    full = other.pages(f"/v1/campaigns/{id}/phylogeny")
    assert service.get(f"/v1/campaigns/{raced}")["settings"]["racing"] == "lossless"
    assert other.get(f"/v1/campaigns/{id}")["settings"]["racing"] == "off"
    assert [lives(row) for row in designs] == [lives(row) for row in full]
    assert not any(row["lower_bound"] for row in full)
    for row, known in zip(designs, full):
        if row["lower_bound"]:
            assert row["died"] == row["born"] > 0 and row["score"] <= known["score"]
        else:
            assert row["score"] == known["score"]
    for generation in range(5):
        path = f"population?generation={generation}"
        assert service.get(f"/v1/campaigns/{raced}/{path}") == other.get(
            f"/v1/campaigns/{id}/{path}")
    assert service.get(f"/v1/campaigns/{raced}/champions") == other.get(
        f"/v1/campaigns/{id}/champions")
    for row, known in zip(generations(service, raced), generations(other, id)):
        born = [one for one in designs if one["born"] == row["generation"]]
        assert row["children_cut"] == sum(one["lower_bound"] for one in born)
        assert known["children_cut"] == 0 and known["rollouts"] == 10 * known["born"]
        saved = 10 * row["born"] - row["rollouts"]
        assert 0 <= saved <= 8 * row["children_cut"] and (saved > 0) == (row["children_cut"] > 0)
        for name in set(row) - {"children_cut", "children_mean", "rollouts", "cached",
                                "rollouts_diverged", "seconds"}:
            assert row[name] == known[name], name
        assert row["generation"] == 0 or row["children_mean"] <= known["children_mean"]
    cut = sum(row["lower_bound"] for row in designs)
    assert cut >= 20, "most children are far worse than the worst parent"


def table(service, path):
    text = service.request("GET", path + "?format=csv").body.decode()
    return list(csv.DictReader(io.StringIO(text)))


def test_every_form_says_so(service, raced, designs):
    path = f"/v1/campaigns/{raced}/phylogeny"
    flags = [row["lower_bound"] for row in designs]
    assert [row["lower_bound"] == "1" for row in table(service, path)] == flags
    bound = next(row for row in designs if row["lower_bound"])
    parent = bound["parents"][0]
    assert service.get(f"/v1/campaigns/{raced}/designs/{bound['number']}")["lower_bound"]
    reported = {row["number"]: row["lower_bound"] for row in table(
        service, f"/v1/campaigns/{raced}/designs/{parent}/descendants")}
    assert reported[str(bound["number"])] == "1"
    header, array = scene(service.request("GET", path + "?format=columns"))
    scores = array(header["columns"]["score"])
    assert [score < 0 for score in scores] == flags
    assert all(abs(score) == pytest.approx(row["score"], rel=1e-6)
               for score, row in zip(scores, designs))
    page = service.get(f"/v1/designs/{bound['id']}")
    assert [one["lower_bound"] for one in page["campaigns"] if one["campaign"] == raced] == [True]


def test_a_bundle_keeps_them(service, start, raced, designs):
    """Losses in only some of the environments are imported, have no effect the second time, and are
    exported again."""
    other = start(CONTROLLER)
    bundle = service.request("GET", f"/v1/bundles?campaigns={raced}").body
    entered = enter(other, bundle)
    assert entered.status == 201
    rows = generations(service, raced)
    assert entered.json()["losses_stored"] == sum(row["rollouts"] for row in rows)
    id = entered.json()["items"][0]["campaign"]
    assert other.pages(f"/v1/campaigns/{id}/phylogeny") == designs
    assert generations(other, id) == rows
    again = enter(other, bundle)
    assert again.status == 200 and again.json()["losses_stored"] == 0
    back = other.request("GET", f"/v1/bundles?campaigns={id}").body
    assert enter(service, back, "verify").json()["items"][0]["campaign"] == raced
    # The losses of a child that was cut short are also used there.
    bound = next(row for row in designs if row["lower_bound"])
    assert evaluated(other, bound)["rollouts_cached"] in (2, 8)


def evaluated(service, row):
    return service.evaluate({"designs": [{"voxels": row["genotype"]}], "physics": "paper"}).json()


def test_an_evaluation_computes_the_rest(service, raced, whole, designs, ctl):  # noqa: F811
    """Stored losses are used. The complete score is that of the campaign without races, and does
    not change the campaign's replies."""
    other, id = whole
    bound = next(row for row in reversed(designs) if row["lower_bound"])
    score = other.get(f"/v1/campaigns/{id}/designs/{bound['number']}")["score"]

    def reported():
        stored = service.get(f"/v1/designs/{bound['id']}")["orientations"][0]["scores"]
        best = service.pages("/v1/designs?sort=score&physics=paper")
        return ([(one["score"], one["lower_bound"]) for one in stored],
                bound["id"] in [one["id"] for one in best])

    assert reported() == ([(bound["score"], True)], False), "a lower bound is not ranked"
    assert f"≥ {bound['score']:.4f} " in ctl(f"design show {bound['id']}")[1]
    assert "truncation, racing off\n" in ctl(f"campaign show {id}", server=other.addresses[0])[1]
    assert "truncation\n" in ctl(f"campaign show {raced}")[1]
    first = evaluated(service, bound)
    assert first["rollouts_cached"] in (2, 8)
    assert first["results"][0]["score"] == score
    assert reported() == ([(score, False)], True)
    assert evaluated(service, bound)["rollouts_cached"] == 10
    again = service.get(f"/v1/campaigns/{raced}/designs/{bound['number']}")
    assert again["lower_bound"] and again["score"] == bound["score"]


def test_few_children_on_a_device(start, whole):
    """A device is idle at the end of each wave, so a race of few children would take longer."""
    service = start(CONTROLLER, *FLAGS, environment=fake(devices=1))
    id = run(service, "campaigns", CAMPAIGN | {"device": "cuda"})["id"]
    assert [row["children_cut"] for row in generations(service, id)] == [0] * 5
    other, same = whole
    assert [lives(row) for row in service.pages(f"/v1/campaigns/{id}/phylogeny")] == [
        lives(row) for row in other.pages(f"/v1/campaigns/{same}/phylogeny")]


def test_no_client_waits_in_vain(start):
    """Children that do not race are scored in one call with parents that have learned."""
    request = {"mode": "simultaneous", "population": 12, "generations": 4, "device": "cuda",
               "controller": "default", "exclude_pretraining": False, "learning": {"batch": 4},
               "physics": {"n_steps": 20}}
    calls = {}
    for racing in ("off", "lossless"):
        service = start(*FLAGS, environment=fake(devices=1))
        run(service, "campaigns", request | {"racing": racing})
        calls[racing] = service.get("/v1/devices")["items"][0]["calls"]
    assert calls["off"] == calls["lossless"] >= 5


@pytest.mark.parametrize("selection", ["tournament", "novelty", "age-layered"])
def test_only_truncation_has_a_bound(service, selection):
    value = run(service, "campaigns", CAMPAIGN | {"generations": 1, "selection": selection})
    assert value["settings"]["racing"] == "lossless"
    assert [row["children_cut"] for row in generations(service, value["id"])] == [0] * 2


# ---- the best of many ----

LIGHTS = [{"light_xy_m": [4.5 - 0.4 * k, 1.5 + 0.1 * k], "terrain_sigma_m": 0.03, "seed": k}
          for k in range(9)]
MANY = {"environments": LIGHTS,
        "physics": {"integrator": "paper", "dt_s": 0.004, "n_steps": 800}}


@pytest.fixture(scope="module")
def many(service):
    """Bodies, two of them twice, and an invalid one."""
    items = service.post("/v1/bodies/random", {"count": 100, "seed": 5})["items"]
    bodies = [{"voxels": item["genotype"]} for item in items]
    return [*bodies[:60], bodies[3], {"cells": [[9, 0, 0]]}, *bodies[60:], bodies[90]]


def best_of(results, k):
    """Returns the results of the k best designs and their ties, by position."""
    scores = sorted(row["score"] for row in results if row["score"] is not None)
    return {place: row for place, row in enumerate(results)
            if row["score"] is not None and row["score"] <= scores[k - 1]}


def test_the_best_are_exact(service, start, many, ctl):  # noqa: F811
    """They are the best designs of the full evaluation, including ties. Bounds of the others are
    valid and do not change. Services with more workers, or with devices, send the same reply."""
    request = MANY | {"designs": many, "on_fault": "skip", "best": 5}
    raced = run(service, "evaluations", request)
    assert raced["best"] == 5 and raced["n_skipped"] == 1 and raced["rollouts_cut"] > 0
    assert raced["rollouts_done"] == raced["rollouts_total"] == 9 * 102
    full = run(service, "evaluations", {name: request[name] for name in request if name != "best"})
    assert full["best"] is None and full["rollouts_cut"] == 0
    # A body that is listed twice gets its losses from the store.
    assert full["rollouts_cached"] >= full["rollouts_total"] - raced["rollouts_cut"]
    best = best_of(full["results"], 5)
    assert len(best) >= 5 and {place: raced["results"][place] for place in best} == best
    worst = max(row["score"] for row in best.values())
    for row, known in zip(raced["results"], full["results"]):
        if row["lower_bound"]:
            assert worst < row["score"] <= known["score"]
            known_losses = [loss or 0 for loss in row["losses"]]
            assert row["score"] == pytest.approx(sum(known_losses) / 9, rel=1e-12)
            assert all(a in (None, b) for a, b in zip(row["losses"], known["losses"]))
        else:
            assert row == known
    assert service.get(f"/v1/evaluations/{raced['id']}") == raced
    # Stored losses do not change the plan, and are not recomputed.
    again = run(service, "evaluations", request | {"label": "again"})
    assert again["results"] == raced["results"] and again["rollouts_cut"] == raced["rollouts_cut"]
    assert again["rollouts_cached"] == again["rollouts_total"] - again["rollouts_cut"]
    for flags, devices in ((("--workers=7", ), {}), (FLAGS, fake(devices=2))):
        other = run(start(CONTROLLER, *flags, environment=devices), "evaluations",
                    request | ({"device": "cuda"} if devices else {}))
        assert other["results"] == raced["results"]
    shown = ctl(f"job show {raced['id']} --results")[1]
    assert "103, the 5 best of them" in shown
    assert shown.count("≥ ") == sum(row["lower_bound"] for row in raced["results"])


def test_what_goes_with_best(service, many):
    """`best` is a number of designs, without recording or verification."""
    request = MANY | {"designs": many[:4]}
    for more in ({"best": 5}, {"best": 2, "record": ["com"]}, {"best": 2, "verify": True}):
        reply = service.request("POST", "/v1/evaluations", request | more)
        assert reply.status == 422 and reply.pointers() == ["/best"], more
    for more in ({"best": 0}, {"best": 1.5}, {"best": None}, {"best": 10001}):
        reply = service.request("POST", "/v1/evaluations", request | more)
        assert reply.status == 422 and reply.pointers() == ["/best"], more
    # All of them are requested, so none is cut short.
    value = run(service, "evaluations", request | {"best": 4})
    assert value["rollouts_cut"] == 0 and not any(row["lower_bound"] for row in value["results"])
    skipped = run(service, "evaluations", MANY | {
        "designs": [*many[:3], {"cells": [[9, 0, 0]]}], "on_fault": "skip", "best": 4})
    assert [row["score"] for row in skipped["results"][:3]] == [
        row["score"] for row in value["results"][:3]]
    assert not any(row["lower_bound"] for row in skipped["results"])
    none = run(service, "evaluations", MANY | {
        "designs": [{"cells": [[9, 0, 0]]}], "on_fault": "skip", "best": 1})
    assert none["state"] == "succeeded" and none["rollouts_total"] == 0


def test_the_best_where_all_diverge(service, many):
    """No design is better than another, and none has a bound."""
    value = run(service, "evaluations", {
        "designs": many[:40], "best": 2, "physics": {
            "integrator": "paper", "dt_s": 0.05, "control_period_s": 0.05, "n_steps": 400}})
    assert value["rollouts_diverged"] == value["rollouts_total"] and value["rollouts_cut"] == 0
    assert {(row["score"], row["lower_bound"]) for row in value["results"]} == {(None, False)}
