"""Factors and drops of an environment, and worlds that vary: scores, what is stored and reported,
refusals, windows and studies."""

import numpy as np
import pytest

from service import DESIGN, await_end, awaited

TALL = {"cells": [[x, y, z] for x in (2, 3) for y in (2, 3) for z in (0, 1)]}
PLACE = {"light_xy_m": [4.0, 2.5], "terrain_sigma_m": 0.05, "seed": 3}
PHYSICS = {"n_steps": 100, "control_period_s": 0.016}
CONSTANTS = {"stiffness_n_per_m": 15000, "mass_kg": 1, "drag_per_s": 15,
             "gravity_m_per_s2": 9.8, "actuation": 0.2, "friction": 0.9}
BY = {"stiffness": 0.9, "mass": 1.2, "drag": 0.5, "gravity": 0.8, "actuation": 1.1,
      "friction": 0.3}


def evaluate(service, *environments, **more):
    reply = service.evaluate({"designs": [TALL], "environments": list(environments),
                              "physics": PHYSICS, **more})
    assert reply.json()["state"] == "succeeded", reply.json()
    return reply.json()


def product(factors):
    """The constants of an environment with these factors."""
    name = {"stiffness": "stiffness_n_per_m", "mass": "mass_kg", "drag": "drag_per_s",
            "gravity": "gravity_m_per_s2"}
    constants = {name.get(key, key): by for key, by in factors.items()}
    return {key: CONSTANTS[key] * by for key, by in constants.items()}


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_scores_are_those_of_the_products(service, precision):
    """Also where environments with different factors share a block."""
    places = [PLACE, *(PLACE | {"factors": {key: by}} for key, by in BY.items()),
              PLACE | {"factors": BY}]
    losses = evaluate(service, *places, precision=precision)["results"][0]["losses"]
    assert len(set(losses)) == len(places)
    for place, loss in zip(places, losses):
        physics = PHYSICS | product(place.get("factors", {}))
        job = evaluate(service, PLACE, precision=precision, physics=physics)
        assert job["results"][0]["losses"] == [loss]


def test_what_is_reported(service):
    job = evaluate(service, PLACE | {"factors": {"friction": 0.5, "mass": 1}},
                   PLACE | {"factors": {"mass": 1}}, PLACE | {"factors": {}}, PLACE)
    worlds = service.get(f"/v1/evaluations/{job['id']}/environments")["items"]
    assert worlds[0]["factors"] == {"friction": 0.5}
    assert service.get("/v1/environments/" + worlds[0]["sha256"]) == worlds[0]
    assert [world["sha256"] for world in worlds[1:]] == [worlds[3]["sha256"]] * 3
    assert all("factors" not in world for world in worlds[1:])
    world = {key: value for key, value in worlds[0].items() if key != "sha256"}
    again = evaluate(service, world)
    assert again["results"][0]["losses"] == job["results"][0]["losses"][:1]


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_drops_are_those_of_the_physics(service, precision):
    """Also where environments with different drops share a block, and added to drop_height_m."""
    places = [PLACE, PLACE | {"drop_m": 0.05}, PLACE | {"drop_m": 0.2}]
    losses = evaluate(service, *places, precision=precision)["results"][0]["losses"]
    assert len(set(losses)) == 3
    for drop, loss in zip((0, 0.05, 0.2), losses):
        job = evaluate(service, PLACE, precision=precision,
                       physics=PHYSICS | {"drop_height_m": drop})
        assert job["results"][0]["losses"] == [loss]
    physics = PHYSICS | {"drop_height_m": 0.25}
    half = evaluate(service, places[1], precision=precision, physics=PHYSICS | {
        "drop_height_m": 0.25 - 0.0625}, environments=[PLACE | {"drop_m": 0.0625}])
    whole = evaluate(service, PLACE, precision=precision, physics=physics)
    assert half["results"][0]["losses"] == whole["results"][0]["losses"]


def test_drops_are_reported(service):
    job = evaluate(service, PLACE | {"drop_m": 0.125}, PLACE | {"drop_m": 0}, PLACE)
    worlds = service.get(f"/v1/evaluations/{job['id']}/environments")["items"]
    assert worlds[0]["drop_m"] == 0.125 and "drop_m" not in worlds[1]
    assert worlds[1]["sha256"] == worlds[2]["sha256"] != worlds[0]["sha256"]
    assert service.get("/v1/environments/" + worlds[0]["sha256"]) == worlds[0]
    reply = service.request("POST", "/v1/rollouts", {
        "designs": [TALL], "environments": [PLACE | {"drop_m": 0.125}], "physics": PHYSICS})
    assert reply.json()["environments"][0]["drop_m"] == 0.125


@pytest.mark.parametrize("drop", [-0.1, 1.1, "high", None])
def test_drops_are_refused(service, drop):
    reply = service.request("POST", "/v1/evaluations", {
        "designs": [DESIGN], "environments": [PLACE | {"drop_m": drop}]})
    assert reply.status == 422 and reply.pointers() == ["/environments/0/drop_m"]


def test_drops_count_as_heights(service):
    """Estimates of errors in float32 need starts below 1 m; a drop counts like the drop height."""
    value = {"designs": [TALL], "physics": PHYSICS, "error": True, "device": "cpu"}
    for more in ({"environments": [PLACE | {"drop_m": 1}]},
                 {"environments": [PLACE], "physics": PHYSICS | {"drop_height_m": 1}}):
        reply = service.request("POST", "/v1/evaluations", value | more)
        assert reply.status == 422 and "float64" in reply.json()["errors"][0]["detail"]


@pytest.mark.parametrize("factors, pointer, says", [
    ({"mass": 0}, "/mass", "0.01"),
    ({"friction": -1}, "/friction", "at most 100"),
    ({"friction": "low"}, "/friction", "number"),
    ({"slip": 1}, "/slip", "friction"),
    ({"actuation": 5}, "", "actuation must be"),
    ({"drag": 40}, "", "use smaller steps"),
])
def test_refusals(service, factors, pointer, says):
    for kind in ("evaluations", "rollouts"):
        reply = service.request("POST", f"/v1/{kind}", {
            "designs": [DESIGN], "environments": [PLACE, PLACE | {"factors": factors}],
            "physics": PHYSICS})
        assert reply.status == 422
        fault, = reply.json()["errors"]
        assert fault["pointer"] == "/environments/1/factors" + pointer and says in fault["detail"]


def test_learning_kinds_refuse_products_out_of_range(service):
    places = [PLACE | {"factors": {"actuation": 5}}]
    for kind, value in (("campaigns", {"mode": "zero-shot"}), ("trainings", {"kind": "pretrain"})):
        reply = service.request("POST", f"/v1/{kind}", value | {"environments": places})
        assert reply.status == 422
        assert "/environments/0/factors" in reply.pointers()


def test_unstable_steps_are_named(service):
    """The step is stable with the constants of the request, but not with those of a world."""
    place = PLACE | {"factors": {"stiffness": 10}}
    job = evaluate(service, PLACE, place)
    warning, = [one for one in job["warnings"] if one["code"] == "unstable_step"]
    assert "environment 1" in warning["detail"] and "150000" in warning["detail"]
    assert not evaluate(service, PLACE)["warnings"]
    scene = service.request("POST", "/v1/rollouts", {
        "designs": [TALL], "environments": [PLACE, place], "physics": PHYSICS}).json()
    assert [one["code"] for one in scene["warnings"]] == ["unstable_step"]
    scene = service.request("POST", "/v1/rollouts", {
        "designs": [TALL], "environments": [PLACE, place], "physics": {"n_steps": 8}}).json()
    assert "unstable_step" in [one["code"] for one in scene["warnings"]]


def test_campaigns_learn_in_such_worlds(service):
    """Random worlds have no factors, so learning defaults to the campaign's own."""
    value = {"mode": "few-shot", "population": 4, "generations": 1, "seed": 1, "physics": PHYSICS,
             "learning": {"parent_steps": 1, "child_steps": 1, "batch": 2}}
    for places, worlds in (([PLACE], "random"), ([PLACE | {"factors": BY}], "environments")):
        id = service.post("/v1/campaigns", value | {"environments": places})["id"]
        job = await_end(service, f"/v1/campaigns/{id}").json()
        assert job["state"] == "succeeded", job
        assert job["settings"]["learning"]["worlds"] == worlds


def learned(service, name, **more):
    """The score, in an ordinary world, of a controller that learned with these settings."""
    value = {"kind": "finetune", "designs": [TALL], "steps": 2, "batch": 4, "physics": PHYSICS,
             "schedule": {"kind": "constant", "peak": 0.01}, "name": name,
             "validation": {"every_steps": 0}}
    id = service.post("/v1/trainings", value | more)["id"]
    job = await_end(service, f"/v1/trainings/{id}").json()
    assert job["state"] == "succeeded", job
    return evaluate(service, PLACE, controller=name, precision="float64")["results"][0]["score"]


def test_trainings_learn_in_such_worlds(service):
    """What the factors change is what is learned."""
    slippery = [PLACE | {"factors": {"friction": 0.3}}]
    scores = [learned(service, "plain", environments=[PLACE]),
              learned(service, "slippery", environments=slippery),
              learned(service, "again", environments=slippery)]
    assert scores[1] == scores[2] != scores[0]


def drawn(service, environments):
    """The stored environments of an evaluation that asks for these, without their hashes."""
    job = service.post("/v1/evaluations", {"designs": [TALL], "environments": environments,
                                           "physics": {"n_steps": 8, "control_period_s": 0.016}})
    worlds = service.get(f"/v1/evaluations/{job['id']}/environments")["items"]
    return [{key: value for key, value in world.items() if key != "sha256"} for world in worlds]


def test_environments_are_varied_by_latin_hypercubes(service):
    ranges = {"friction": [0.5, 1.5], "mass": [0.8, 1.2]}
    request = {"of": [PLACE, {"task": "walk"}], "vary": ranges, "count": 64}
    worlds = drawn(service, request)
    for name, (low, high) in ranges.items():
        parts = [int((world["factors"][name] - low) / (high - low) * 64) for world in worlds]
        assert sorted(parts) == list(range(64))
    assert [world.get("task") is None for world in worlds] == [True, False] * 32
    assert worlds == drawn(service, request | {"seed": 1})
    assert worlds != drawn(service, request | {"seed": 2})
    assert worlds == drawn(service, worlds)


def test_sets_are_varied(service):
    plain = drawn(service, "paper-test")
    worlds = drawn(service, {"vary": {"friction": [0.5, 0.5]}})
    assert worlds == [world | {"factors": {"friction": 0.5}} for world in plain]
    worlds = drawn(service, {"of": "morpho-12-walk", "vary": {"drag": [0.9, 1.1]}, "count": 4})
    assert len(worlds) == 4 and all("task" in world for world in worlds)
    own = [PLACE | {"factors": {"friction": 2, "mass": 0.5}}]
    worlds = drawn(service, {"of": own, "vary": {"friction": [0.5, 0.5]}})
    assert worlds[0]["factors"] == {"mass": 0.5}


def test_drops_and_slopes_vary(service):
    """Drops in each part of their range; slopes of the ground as terrains of a family have them."""
    flat = {"light_xy_m": [4.0, 2.5], "terrain": {"kind": "flat"}, "drop_m": 0.25}
    ranges = {"drop_m": [0.1, 0.3], "slope_degrees": [5, 10]}
    request = {"of": [flat], "vary": ranges, "count": 64}
    worlds = drawn(service, request)
    parts = [int((world["drop_m"] - 0.35) / 0.2 * 64) for world in worlds]
    assert sorted(parts) == list(range(64))
    slopes, directions = [], []
    for world in worlds:
        assert "factors" not in world
        rows = np.array(world["terrain_heights_m"]).reshape(8, 8)
        assert rows.min() == pytest.approx(0.05)
        by_y, by_x = np.diff(rows, axis=0) * 1.4, np.diff(rows, axis=1) * 1.4
        assert np.ptp(by_x) < 1e-9 and np.ptp(by_y) < 1e-9
        slopes.append(np.degrees(np.arctan(np.hypot(by_x[0, 0], by_y[0, 0]))))
        directions.append(np.arctan2(by_y[0, 0], by_x[0, 0]) % (2 * np.pi))
    assert sorted(int((slope - 5) / 5 * 64) for slope in slopes) == list(range(64))
    assert sorted(int(angle / (2 * np.pi) * 64) for angle in directions) == list(range(64))
    both = drawn(service, request | {"vary": ranges | {"friction": [0.5, 1]}})
    assert [{key: value for key, value in world.items() if key != "factors"}
            for world in both] == worlds
    assert worlds == drawn(service, worlds)


STAIRS = {"light_xy_m": [4.0, 2.5], "terrain": {"kind": "stairs-up"}}
GRID = {"light_xy_m": [4.0, 2.5], "terrain": {"kind": "grid", "spacing_m": 0.1,
                                              "heights_m": [[0.0] * 3] * 3}}


def test_ground_that_cannot_slope(service):
    """It is refused by name, wherever worlds vary."""
    slope = {"slope_degrees": [0, 5]}
    for place, word in ((STAIRS, "profile"), (GRID, "custom grid")):
        reply = service.request("POST", "/v1/evaluations", {
            "designs": [TALL], "environments": {"of": [PLACE, place], "vary": slope}})
        assert reply.status == 422 and reply.pointers() == ["/environments/vary"]
        detail = reply.json()["errors"][0]["detail"]
        assert "environment 1" in detail and f"a {word} cannot slope" in detail
    reply = service.request("POST", "/v1/trainings", {
        "kind": "pretrain", "environments": [PLACE, STAIRS], "vary": slope})
    assert reply.status == 422 and reply.pointers() == ["/environments/1"]
    few = {"mode": "few-shot", "environments": [STAIRS], "learning": {"vary": slope}}
    reply = service.request("POST", "/v1/campaigns", few)
    assert reply.status == 422 and "cannot slope" in reply.json()["errors"][0]["detail"]
    reply = service.request("POST", "/v1/trainings", {
        "kind": "pretrain", "environments": "morpho-12-hurdle", "vary": slope})
    assert reply.status == 422 and reply.pointers() == ["/environments"]
    assert "morpho-12-hurdle" in reply.json()["errors"][0]["detail"]
    assert len(drawn(service, {"of": [STAIRS, GRID], "vary": {"drop_m": [0, 0.1]}})) == 2


def test_drops_have_a_limit(service):
    high = [PLACE | {"drop_m": 0.9}]
    vary = {"drop_m": [0, 0.2]}
    reply = service.request("POST", "/v1/evaluations", {
        "designs": [TALL], "environments": {"of": high, "vary": vary}})
    assert reply.status == 422 and reply.pointers() == ["/environments/vary"]
    reply = service.request("POST", "/v1/trainings", {
        "kind": "pretrain", "environments": high, "vary": vary})
    assert reply.status == 422 and reply.pointers() == ["/environments/0"]


@pytest.mark.parametrize("environments, pointer, says", [
    ({"of": "paper-test"}, "", "vary is missing"),
    ({"vary": {"drop_m": [0, 1.5]}}, "/vary/drop_m/1", "from 0 to 1"),
    ({"vary": {"slope_degrees": [0, 31]}}, "/vary/slope_degrees/1", "from 0 to 30"),
    ({"vary": {"slope_degrees": [3, 2]}}, "/vary", "lowest"),
    ({"vary": {"friction": [2, 1]}}, "/vary", "lowest"),
    ({"vary": {"slip": [1, 2]}}, "/vary/slip", "friction"),
    ({"vary": {"friction": [0.5, 1]}, "count": 65}, "/count", "64"),
    ({"vary": {"friction": [0.5, 1]}, "of": {"vary": {}}}, "/of", "name of a set"),
    ({"vary": {"friction": [0.5, 1]}, "of": "morpho-12"}, "/of", "suite"),
    ({"vary": {"friction": [0.5, 1]}, "of": "nowhere"}, "/of", "unknown set"),
    ({"vary": {"friction": [0.5, 1]}, "n": 3}, "/n", "count"),
])
def test_variations_are_refused(service, environments, pointer, says):
    reply = service.request("POST", "/v1/evaluations", {"designs": [DESIGN],
                                                        "environments": environments})
    assert reply.status == 422
    fault, = reply.json()["errors"]
    assert fault["pointer"] == "/environments" + pointer and says in fault["detail"]


def test_campaigns_and_trainings_take_varied_worlds(service):
    vary = {"of": [PLACE], "vary": {"friction": [0.5, 1.5]}, "count": 3}
    for kind, value in (("trainings", {"kind": "finetune", "designs": [TALL], "steps": 1,
                                       "batch": 2}),
                        ("campaigns", {"mode": "zero-shot", "population": 4, "generations": 1})):
        job = service.post(f"/v1/{kind}", value | {"environments": vary, "physics": PHYSICS})
        assert await_end(service, f"/v1/{kind}/{job['id']}").json()["state"] == "succeeded"
    worlds = service.get(f"/v1/campaigns/{job['id']}/environments")["items"]
    assert len({world["factors"]["friction"] for world in worlds}) == 3


VARY = {"friction": [1 / 3, 4 / 3], "mass": [0.9, 1.1]}
MORE = VARY | {"drop_m": [0, 0.1], "slope_degrees": [0, 10]}


def test_trainings_vary_their_worlds(service):
    """The same seed learns the same; ranges change it, and are reported."""
    scores = []
    for number, vary in enumerate((None, VARY, VARY, VARY | {"mass": [1, 1]}, {}, MORE, MORE)):
        scores.append(learned(service, f"varied-{number}", environments=[PLACE], vary=vary))
        seen = service.get("/v1/trainings?limit=1")["items"][0]["settings"]["vary"]
        assert seen == (vary and {"stiffness": [1, 1], "drag": [1, 1], "gravity": [1, 1],
                                  "actuation": [1, 1]} | vary or None)
    assert scores[1] == scores[2] and scores[0] == scores[4] and scores[5] == scores[6]
    assert len(set(scores)) == 4


def test_the_preset_robust(service):
    """It is phototaxis in worlds that vary; a request overrides its ranges one by one."""
    value = {"kind": "pretrain", "steps": 1, "batch": 4, "physics": PHYSICS,
             "validation": {"every_steps": 0}}
    settings = {}
    for name, more in (("robust", {}), ("phototaxis", {}), ("robust", {"vary": None}),
                       ("robust", {"vary": {"mass": [0.5, 1]}})):
        job = service.post("/v1/trainings", value | {"preset": name} | more)
        job = await_end(service, f"/v1/trainings/{job['id']}").json()
        assert job["state"] == "succeeded" and not job["warnings"], job
        settings[name, *more.get("vary") or more] = job["settings"]
    vary = {name: [1, 1] for name in ("stiffness", "mass", "drag", "gravity", "actuation")}
    vary["friction"] = [0.4, 1]
    plain = settings["phototaxis",]
    assert settings["robust",] == plain | {"vary": vary}
    assert settings["robust", "vary"] == plain
    assert settings["robust", "mass"] == plain | {"vary": vary | {"mass": [0.5, 1]}}
    reply = service.request("POST", "/v1/trainings", {
        "kind": "finetune", "designs": [TALL], "preset": "robust"})
    assert reply.status == 422 and reply.pointers() == ["/preset"]


def test_a_restart_draws_the_same_worlds(start, tmp_path):
    """A training run that continues from a checkpoint gets the factors of its steps."""
    value = {"kind": "finetune", "designs": [TALL], "steps": 40, "batch": 4, "physics": PHYSICS,
             "vary": MORE, "environments": [PLACE], "validation": {"every_steps": 0},
             "checkpoint": {"every_steps": 4}, "name": "varied"}
    first = start(state=tmp_path)
    path = f"/v1/trainings/{first.post('/v1/trainings', value)['id']}"
    awaited(first, path, lambda seen: seen["progress"]["step"] >= 2)
    assert first.stop() == 0
    second = start(state=tmp_path)
    assert await_end(second, path).json()["state"] == "succeeded"
    other = start()
    whole = other.post("/v1/trainings", value)["id"]
    assert await_end(other, f"/v1/trainings/{whole}").json()["state"] == "succeeded"
    scores = [evaluate(one, PLACE, controller="varied")["results"] for one in (second, other)]
    assert scores[0] == scores[1]


def test_unstable_ranges_are_named(service):
    value = {"kind": "pretrain", "steps": 1, "batch": 1, "physics": PHYSICS,
             "validation": {"every_steps": 0}}
    for vary, n in (({"stiffness": [1, 50]}, 1), ({"mass": [0.01, 1]}, 1),
                    ({"stiffness": [0.9, 1.1]}, 0)):
        job = service.post("/v1/trainings", value | {"vary": vary})
        codes = [one["code"] for one in job["warnings"]]
        assert codes == ["unstable_step"] * n, job["warnings"]


def test_what_is_at_fault_is_named(service):
    """An invalid physics is not the fault of factors, nor a varied list that of its members."""
    bad = {"n_steps": 100, "control_period_s": 0.003}
    for kind, value in (("trainings", {"kind": "pretrain"}), ("campaigns", {"mode": "zero-shot"})):
        reply = service.request("POST", f"/v1/{kind}", value | {
            "environments": [PLACE | {"factors": {"friction": 0.5}}], "physics": bad})
        assert reply.status == 422
        assert not any("factors" in (pointer or "") for pointer in reply.pointers())
    varied = {"vary": {"actuation": [1, 10]}, "count": 64}
    reply = service.request("POST", "/v1/evaluations", {"designs": [TALL],
                                                        "environments": varied})
    assert reply.status == 422 and reply.pointers() == ["/environments/vary"]
    few = {"mode": "few-shot", "environments": [PLACE | {"factors": {"actuation": 3}}],
           "learning": {"vary": {"actuation": [1, 2]}, "worlds": "random"}}
    service.act(service.post("/v1/campaigns", few)["id"], "cancel")
    few["learning"]["worlds"] = "environments"
    reply = service.request("POST", "/v1/campaigns", few)
    assert reply.status == 422 and "learning draws" in reply.json()["errors"][0]["detail"]


def test_custom_grids(service):
    """They share the limit of heights, and learning does not vary them."""
    grid = {"light_xy_m": [4.0, 2.5], "terrain": {
        "kind": "grid", "heights_m": [[0.0] * 128] * 128, "spacing_m": 0.1}}
    varied = {"of": [grid], "vary": {"friction": [0.5, 1]}, "count": 17}
    reply = service.request("POST", "/v1/evaluations", {"designs": [TALL],
                                                        "environments": varied})
    assert reply.status == 422 and reply.pointers() == ["/environments/count"]
    assert len(drawn(service, varied | {"count": 2})) == 2
    reply = service.request("POST", "/v1/trainings", {
        "kind": "pretrain", "environments": [grid], "vary": VARY})
    assert reply.status == 422 and reply.pointers() == ["/environments/0/terrain"]


@pytest.mark.parametrize("vary, pointer, says", [
    ({"mass": [0, 1]}, "/vary/mass/0", "0.01"),
    ({"mass": 1}, "/vary/mass", "array"),
    ({"slip": [0, 1]}, "/vary/slip", "friction"),
    ({"friction": [1.2, 0.3]}, "", "vary.friction must be [lowest, highest], got [1.2, 0.3]"),
    ({"actuation": [1, 5]}, "", "vary puts constants out of range: actuation"),
])
def test_ranges_are_refused(service, vary, pointer, says):
    for kind, value in (("trainings", {"kind": "pretrain", "vary": vary}),
                        ("campaigns", {"mode": "few-shot", "learning": {"vary": vary}})):
        reply = service.request("POST", f"/v1/{kind}", value)
        assert reply.status == 422
        fault, = reply.json()["errors"]
        assert says in fault["detail"]
        assert not pointer or fault["pointer"] == (
            "/learning" if kind == "campaigns" else "") + pointer


def test_products_of_ranges_and_factors_are_checked(service):
    reply = service.request("POST", "/v1/trainings", {
        "kind": "pretrain", "vary": {"actuation": [1, 2]},
        "environments": [PLACE, PLACE | {"factors": {"actuation": 3}}]})
    assert reply.status == 422 and reply.pointers() == ["/environments/1/factors"]


def test_campaigns_learn_in_varied_worlds(service):
    value = {"mode": "few-shot", "population": 4, "generations": 1, "seed": 1, "physics": PHYSICS,
             "learning": {"parent_steps": 1, "child_steps": 1, "batch": 2}}
    best = []
    for vary in (None, VARY):
        id = service.post("/v1/campaigns", value | {
            "learning": value["learning"] | {"vary": vary}})["id"]
        job = await_end(service, f"/v1/campaigns/{id}").json()
        assert job["state"] == "succeeded", job
        best.append([one["score"] for one in service.get(
            f"/v1/campaigns/{id}/population")["items"]])
    assert best[0] != best[1]


def test_windows_keep_their_factors(service):
    """Two windows are one rollout; a window with other factors is refused."""
    value = {"designs": [TALL], "environments": [PLACE | {"factors": BY}], "physics": PHYSICS,
             "final_states": True}

    def roll(**more):
        return service.request("POST", "/v1/rollouts", value | more)

    whole = roll().json()["rollouts"][0]
    half = roll(physics=PHYSICS | {"n_steps": 48}).json()["rollouts"][0]["state"]
    rest = roll(physics=PHYSICS | {"n_steps": 52}, states=[half])
    assert rest.json()["rollouts"][0]["state"] == whole["state"]
    dropped = roll(environments=[PLACE | {"factors": BY, "drop_m": 0.5}], states=[half],
                   physics=PHYSICS | {"n_steps": 52})
    assert dropped.json()["rollouts"][0]["state"] == whole["state"]  # a drop is for the start
    other = roll(environments=[PLACE], states=[half])
    assert other.status == 422 and "factors" in other.json()["errors"][0]["detail"]


def test_a_study_names_factors_that_differ(service):
    value = {"mode": "study", "population": 4, "label": "slippery",
             "if_exists": "return", "physics": PHYSICS,
             "environments": [PLACE | {"factors": {"friction": 0.5}}]}
    assert service.request("POST", "/v1/campaigns", value).status == 202
    reply = service.request("POST", "/v1/campaigns", value | {"environments": [PLACE]})
    assert reply.status == 409, reply.body
    assert "/environments/0/factors/friction" in reply.body.decode()


def test_a_study_names_drops_that_differ(service):
    value = {"mode": "study", "population": 4, "label": "falling", "if_exists": "return",
             "physics": PHYSICS, "environments": [PLACE | {"drop_m": 0.5}]}
    assert service.request("POST", "/v1/campaigns", value).status == 202
    reply = service.request("POST", "/v1/campaigns", value | {"environments": [PLACE]})
    assert reply.status == 409 and "/environments/0/drop_m" in reply.body.decode()
