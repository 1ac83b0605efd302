"""Terrains: profiles and families in requests; what is stored and reported, and refusals."""

import math

import pytest

from service import DESIGN
from test_worlds import roll, scene

TALL = {"cells": [[x, y, z] for x in (2, 3) for y in (2, 3) for z in (0, 1)]}
SHORT = {"n_steps": 100, "control_period_s": 0.016}
PLACE = {"light_xy_m": [4.0, 2.5]}
FLOOR = 0.05
DRAWN = {
    "slope": {"degrees": 8},
    "stairs-up": {"rise_m": 0.05, "run_m": 0.3},
    "stairs-down": {"rise_m": 0.05, "run_m": 0.3},
    "hurdles": {"seed": 3, "height_m": 0.06, "every_m": 0.5},
    "gaps": {"seed": 3, "depth_m": 0.1, "gap_m": 0.2, "platform_m": 0.4},
    "steps": {"seed": 3, "height_m": 0.08, "run_m": 0.3},
}


def evaluate(service, *environments, **more):
    reply = service.evaluate({"designs": [TALL], "environments": list(environments),
                              "physics": SHORT, **more})
    assert reply.json()["state"] == "succeeded", reply.json()
    return reply.json()


def world_of(service, terrain, **more):
    """The stored environment of an evaluation with this terrain, and the loss there."""
    job = evaluate(service, {**PLACE, "terrain": terrain, **more})
    world, = service.get(f"/v1/evaluations/{job['id']}/environments")["items"]
    return world, job["results"][0]["losses"][0]


def drawn(service, kind, **fields):
    world, _ = world_of(service, {"kind": kind, **fields})
    terrain = world["terrain"]
    assert terrain["kind"] == "profile" and len(terrain["heights_m"]) == 64
    assert "terrain_heights_m" not in world
    return terrain


@pytest.mark.parametrize("kind", DRAWN)
def test_defaults_are_those_of_the_contract(service, kind):
    """A family without its optional fields is the same terrain as with the documented defaults,
    and it is stored and reported as a profile, which can be sent back."""
    fields = DRAWN[kind]
    seed = {name: value for name, value in fields.items() if name == "seed"}
    world, loss = world_of(service, {"kind": kind, **seed})
    again, same = world_of(service, {"kind": kind, "spacing_m": 0.1, **fields})
    assert (world, loss) == (again, same)
    assert service.get("/v1/environments/" + world["sha256"]) == world
    heights = world["terrain"]["heights_m"]
    assert world["terrain"]["spacing_m"] == 0.1
    assert min(heights) == FLOOR
    level = 28 if kind == "slope" else 31
    assert len(set(heights[:level + 1])) == 1 and len(set(heights)) > 1
    assert max(abs(b - a) for a, b in zip(heights, heights[1:])) <= 0.1 * (1 + 1e-9)
    sent = {name: value for name, value in world.items() if name != "sha256"}
    assert evaluate(service, sent)["rollouts_cached"] == 1


def test_shapes(service):
    """Slopes have their angle; stairs their rises; the seed matters where a family is random."""
    heights = drawn(service, "slope", degrees=-12)["heights_m"]
    assert heights[-1] - heights[0] == pytest.approx(-3.5 * math.tan(math.radians(12)), abs=1e-12)
    heights = drawn(service, "stairs-up", rise_m=0.2, run_m=1, spacing_m=0.25)["heights_m"]
    rises = (0, 1, 1, 1, 1, 2, 2, 2, 2, 3)
    assert heights[13:23] == pytest.approx([FLOOR + 0.2 * n for n in rises])
    assert heights[:14] == [FLOOR] * 14
    for kind in ("hurdles", "gaps", "steps"):
        assert drawn(service, kind, seed=1) != drawn(service, kind, seed=2)
        assert drawn(service, kind, seed=1) == drawn(service, kind, seed=1)


def test_rough_and_flat_are_grids(service):
    """They are the terrain of terrain_sigma_m and seed, with the same hash."""
    for terrain, sigma, seed in (({"kind": "rough", "seed": 4, "sigma_m": 0.07}, 0.07, 4),
                                 ({"kind": "rough", "seed": 4}, 0.05, 4),
                                 ({"kind": "flat"}, 0, 1)):
        world, loss = world_of(service, terrain)
        job = evaluate(service, {**PLACE, "terrain_sigma_m": sigma, "seed": seed})
        assert job["rollouts_cached"] == 1 and job["results"][0]["losses"] == [loss]
        assert "terrain" not in world and len(world["terrain_heights_m"]) == 64


def test_a_profile_is_what_was_sent(service):
    """Heights and spacing come back; two heights are enough; a level profile gives the same score
    as flat ground at that height, to rounding."""
    terrain = {"kind": "profile", "heights_m": [0.05, -1.5, 2, 1e-3], "spacing_m": 0.73}
    assert world_of(service, terrain)[0]["terrain"] == terrain
    level = {"kind": "profile", "heights_m": [0.05, 0.05], "spacing_m": 1}
    _, loss = world_of(service, level)
    _, flat = world_of(service, {"kind": "flat"})
    assert loss == pytest.approx(flat, abs=1e-5)
    tilted = {"kind": "profile", "heights_m": [0, 1], "spacing_m": 1}
    assert len({world_of(service, each)[0]["sha256"] for each in (terrain, level, tilted)}) == 3


def test_profiles_go_with_tasks(service):
    """A light that leads stands on the profile, and a body gains height on a slope under it."""
    ramp = {"kind": "profile", "heights_m": [0, 0.5, 1, 1.5, 2, 2.5], "spacing_m": 1}
    asked = {"designs": [DESIGN], "physics": SHORT, "record": ["com", "masses"],
             "record_stride": 20, "environments": [{"task": "walk", "terrain": ramp}]}
    header, array = scene(roll(service, asked))
    assert header["environments"][0]["terrain"] == ramp
    assert "terrain_heights_m" not in header["environments"][0]
    rollout, = header["rollouts"]
    lights = array(rollout["lights_m"])
    for frame in range(6):
        x, _, z = lights[3 * frame:3 * frame + 3]
        assert z == pytest.approx(x / 2, abs=1e-5)
    for x, _, z in zip(*[iter(array(rollout["masses_m"]))] * 3):
        assert z >= x / 2 - 1e-5


def rows_of(columns, rows, step=0.01):
    return [[round(step * ((3 * i + 5 * j) % 7), 6) for i in range(columns)] for j in range(rows)]


def test_a_grid_is_what_was_sent(service):
    """Rows and spacing come back; what is stored can be sent again, and is the same world."""
    worlds = set()
    for terrain in ({"kind": "grid", "heights_m": [[0.05, -1.5, 2], [1e-3, 0, 100]],
                     "spacing_m": 1.73},
                    {"kind": "grid", "heights_m": rows_of(128, 128), "spacing_m": 0.02},
                    {"kind": "grid", "heights_m": rows_of(2, 40), "spacing_m": 2}):
        world, loss = world_of(service, terrain)
        assert world["terrain"] == terrain and "terrain_heights_m" not in world
        assert service.get("/v1/environments/" + world["sha256"]) == world
        sent = {name: value for name, value in world.items() if name != "sha256"}
        again = evaluate(service, sent)
        assert again["rollouts_cached"] == 1 and again["results"][0]["losses"] == [loss]
        worlds.add(world["sha256"])
    assert len(worlds) == 3


def test_a_grid_of_the_usual_size_gives_the_usual_losses(service):
    heights = rows_of(8, 8, 0.03)
    grid = {"kind": "grid", "heights_m": heights, "spacing_m": 5 / 7}
    job = evaluate(service, {**PLACE, "terrain": grid}, {**PLACE, "terrain_heights_m": heights})
    first, second = job["results"][0]["losses"]
    assert first == second
    here, there = service.get(f"/v1/evaluations/{job['id']}/environments")["items"]
    assert here["sha256"] != there["sha256"]


def test_grids_go_with_tasks_and_scenes(service):
    """A light that leads stands on the grid, rows are along y, and the middle is at the start."""
    ramp = {"kind": "grid", "heights_m": [[0, 0, 0], [1, 1, 1]], "spacing_m": 2}
    asked = {"designs": [DESIGN], "physics": SHORT, "record": ["com", "masses"],
             "record_stride": 20, "environments": [{"task": "walk", "terrain": ramp}]}
    header, array = scene(roll(service, asked))
    assert header["environments"][0]["terrain"] == ramp
    lights = array(header["rollouts"][0]["lights_m"])
    for frame in range(6):
        _, y, z = lights[3 * frame:3 * frame + 3]
        assert z == pytest.approx((y - 1.5) / 2, abs=1e-5)


def test_a_request_has_few_large_grids(service):
    large = {**PLACE, "terrain": {"kind": "grid", "heights_m": [[0] * 128] * 128,
                                  "spacing_m": 0.1}}
    reply = service.request("POST", "/v1/evaluations",
                            {"designs": [DESIGN], "environments": [large] * 17})
    assert reply.status == 422
    fault, = reply.json()["errors"]
    assert fault["pointer"] == "/environments" and "at most 262144 heights" in fault["detail"]


def test_tables_have_profiles(service):
    job = evaluate(service, {**PLACE, "terrain": {"kind": "profile", "heights_m": [1, 2],
                                                  "spacing_m": 0.5}},
                   {**PLACE, "terrain": {"kind": "flat"}})
    rows = service.table(f"/v1/evaluations/{job['id']}/environments?format=csv")
    assert '"heights_m":[1,2]' in rows[0]["terrain"].replace(" ", "")
    assert rows[0]["terrain_heights_m"] == "" and rows[1]["terrain"] == ""


REFUSED = [
    ({"kind": "mars"}, "/kind", 'must be "rough"'),
    ({}, "", "kind is missing"),
    ([], "", "object"),
    ({"kind": "profile", "spacing_m": 0.1}, "", "heights_m is missing"),
    ({"kind": "profile", "heights_m": [1, 2]}, "", "spacing_m is missing"),
    ({"kind": "profile", "heights_m": [1], "spacing_m": 0.1}, "/heights_m",
     "must have 2 to 64 heights, got 1"),
    ({"kind": "profile", "heights_m": [0] * 65, "spacing_m": 0.1}, "/heights_m", "got 65"),
    ({"kind": "profile", "heights_m": [0, 101], "spacing_m": 0.1}, "/heights_m/1", "must be"),
    ({"kind": "profile", "heights_m": [0, None], "spacing_m": 0.1}, "/heights_m/1", "number"),
    ({"kind": "profile", "heights_m": [0, 1], "spacing_m": 0.01}, "/spacing_m", "at least 0.02"),
    ({"kind": "profile", "heights_m": [0, 1], "spacing_m": 1, "seed": 1}, "", "has no seed"),
    ({"kind": "profile", "heights_m": [0, 1], "spacing_m": 1.5}, "/spacing_m", "from 0.02 to 1"),
    ({"kind": "profile", "heights_m": [[0, 1], [0, 1]], "spacing_m": 1}, "/heights_m",
     'for rows of heights, use "grid"'),
    ({"kind": "grid", "heights_m": [0, 1], "spacing_m": 1}, "/heights_m", 'use "profile"'),
    ({"kind": "grid", "heights_m": [[0, 1]], "spacing_m": 1}, "/heights_m",
     "must have 2 to 128 rows, got 1"),
    ({"kind": "grid", "heights_m": [[0, 1]] * 129, "spacing_m": 1}, "/heights_m", "got 129"),
    ({"kind": "grid", "heights_m": [[0], [1]], "spacing_m": 1}, "/heights_m/0",
     "must have 2 to 128 heights, got 1"),
    ({"kind": "grid", "heights_m": [[0] * 129] * 2, "spacing_m": 1}, "/heights_m/0", "got 129"),
    ({"kind": "grid", "heights_m": [[0, 1], [0, 1, 2]], "spacing_m": 1}, "/heights_m/1",
     "must have 2 heights, as many as the first row, got 3"),
    ({"kind": "grid", "heights_m": [[0, 1], 3], "spacing_m": 1}, "/heights_m/1", "array"),
    ({"kind": "grid", "heights_m": [[0, 1], [0, 101]], "spacing_m": 1}, "/heights_m/1/1",
     "must be"),
    ({"kind": "grid", "heights_m": [[0, 1], [0, 1]], "spacing_m": 2.5}, "/spacing_m", "at most 2"),
    ({"kind": "grid", "heights_m": [[0, 1], [0, 1]]}, "", "spacing_m is missing"),
    ({"kind": "grid", "spacing_m": 1}, "", "heights_m is missing"),
    ({"kind": "grid", "heights_m": [[0, 1], [0, 1]], "spacing_m": 1, "seed": 1}, "",
     "has no seed"),
    ({"kind": "hurdles"}, "", 'seed is missing; a terrain of kind "hurdles" needs it'),
    ({"kind": "slope", "seed": 1}, "", 'a terrain of kind "slope" has no seed; remove it'),
    ({"kind": "flat", "sigma_m": 0}, "", "has no sigma_m"),
    ({"kind": "slope", "degrees": 46}, "/degrees", "at most 45"),
    ({"kind": "slope", "spacing_m": 0.05}, "", "spacing_m must be at least 0.08"),
    ({"kind": "stairs-up", "rise_m": 0.2}, "", "at most spacing_m (0.1), so that no ramp"),
    ({"kind": "stairs-up", "run_m": 0.25}, "", "run_m must be a whole number of spacings"),
    ({"kind": "steps", "seed": 1, "height_m": 0}, "/height_m", "above 0"),
    ({"kind": "gaps", "seed": 1, "gap_m": 0.1}, "", "at least 2"),
    ({"kind": "slope", "tilt": 3}, "/tilt", "unknown field"),
    ({"kind": "rough", "seed": 1, "sigma_m": 11}, "/sigma_m", "at most 10"),
]


@pytest.mark.parametrize("case", range(len(REFUSED)))
def test_invalid_terrains_are_refused(service, case):
    terrain, below, words = REFUSED[case]
    reply = service.request("POST", "/v1/evaluations",
                            {"designs": [DESIGN], "environments": [{**PLACE, "terrain": terrain}]})
    assert reply.status == 422, reply.json()
    faults = {fault["pointer"]: fault["detail"] for fault in reply.json()["errors"]}
    assert words in faults.get("/environments/0/terrain" + below, ""), faults


@pytest.mark.parametrize("more", [{"terrain_sigma_m": 0.1, "seed": 1}, {"seed": 1},
                                  {"terrain_heights_m": [0] * 64}])
def test_a_terrain_is_given_once(service, more):
    reply = service.request(
        "POST", "/v1/evaluations",
        {"designs": [DESIGN], "environments": [{**PLACE, "terrain": {"kind": "flat"}, **more}]})
    assert reply.status == 422
    assert "give the terrain either as terrain" in reply.json()["errors"][0]["detail"]


def test_studies_name_a_terrain_that_differs(service):
    environment = {**PLACE, "terrain": {"kind": "slope"}}
    study = {"mode": "study", "population": 16, "environments": [environment], "physics": SHORT,
             "label": "a study on a slope"}
    service.post("/v1/campaigns", study)
    for terrain, below in (({"kind": "slope", "degrees": 9}, "/heights_m/29"),
                           ({"kind": "slope", "spacing_m": 0.2}, ""), ({"kind": "flat"}, ""),
                           ({"kind": "grid", "heights_m": [[0, 0], [0, 1]], "spacing_m": 1}, "")):
        other = study | {"environments": [{**PLACE, "terrain": terrain}], "if_exists": "return"}
        reply = service.request("POST", "/v1/campaigns", other)
        assert "/environments/0/terrain" + below in reply.pointers(), reply.json()


@pytest.mark.parametrize("kind", ["flat", "rough"])
def test_ground_on_a_slope(service, kind):
    """The heights rise by the angle, whatever lies on it; the reply has them as a grid."""
    seed = {"seed": 4} if kind == "rough" else {}
    level, _ = world_of(service, {"kind": kind, **seed})
    slope = {"degrees": 10, "toward_rad": math.pi / 2}
    world, loss = world_of(service, {"kind": kind, **seed, **slope})
    heights, before = world["terrain_heights_m"], level["terrain_heights_m"]
    assert min(heights) == FLOOR and isinstance(loss, float)
    rises = [b - a - (d - c) for a, b, c, d in
             zip(heights, heights[8:], before, before[8:])]
    assert rises == pytest.approx([math.tan(math.radians(10)) * 5 / 7] * 56)
    again, same = world_of(service, {"kind": kind, **seed, "degrees": 0, "toward_rad": 2})
    assert again == level
