"""Worlds of EvoGym as terrains: files that are drawn here, row by row from the top."""

import json

import morphod
import numpy as np
import pytest
from morphod import BodyError, MorphodError, read_world

KINDS = {"#": ("ground", 5), "s": ("ground", 2), "B": ("box", 1), "h": ("robot", 3),
         "v": ("robot", 4), "H": ("other", 3)}
ENDS = "the ends: the ground continues at the height of its first and last cell"


@pytest.fixture
def draw(tmp_path):
    """Returns a function that writes a world: each character is a voxel of an object, in the
    documented form: indices count cells from the lower left, row by row."""
    def write(*rows, **more):
        width, objects = len(rows[0]), {}
        assert {len(row) for row in rows} == {width}
        for z, row in enumerate(reversed(rows)):
            for x, kind in enumerate(row):
                if kind in KINDS:
                    name, material = KINDS[kind]
                    one = objects.setdefault(name, {"indices": [], "types": [], "neighbors": {}})
                    one["indices"].append(z * width + x)
                    one["types"].append(material)
        for one in objects.values():
            there = set(one["indices"])
            one["neighbors"] = {str(k): [n for n in (k - 1, k + 1, k - width, k + width)
                                         if n in there and (abs(n - k) > 1 or
                                                            n // width == k // width)]
                                for k in there}
        path = tmp_path / "drawn.json"
        path.write_text(json.dumps({"grid_width": width, "grid_height": len(rows),
                                    "objects": objects, **more}))
        return path
    return write


def cells_of(world, n, start=3):
    """Returns the heights of the first n cells of a file, in cells; the start is at x = 2.5 m."""
    assert world["spacing_m"] == 0.1
    return [round(h * 10, 6) for h in world["heights_m"][25 - start:25 - start + n]]


def test_steps(draw):
    world = read_world(draw("............",
                            "........##..",
                            "......####..",
                            "############"))
    assert world["kind"] == "profile" and len(world["heights_m"]) == 25 - 3 + 12
    assert cells_of(world, 12) == [0] * 6 + [1, 1, 2, 2, 0, 0]
    assert set(world["heights_m"][:22]) == {0}
    assert world.lost == ("vertical walls: steps are ramps 0.1 m long, up to 63° steep", ENDS)
    assert world.bodies == [] and world.ditches == []
    flat = read_world(draw("#" * 8))
    assert set(flat["heights_m"]) == {0} and flat.lost == (ENDS, )


def test_robots_are_bodies(draw):
    """The robot's middle is at the start, and heights count from its ground."""
    path = draw("......hvh.......",
                "......h.h.......",
                "................",
                "#############...",
                "################")
    world = read_world(path)
    body, = world.bodies
    assert body == morphod.read_bodies(path)[0] and body.name == "robot"
    assert body.lost[0] == "materials 3, 4 were merged into one"
    assert cells_of(world, 16, start=7) == [0] * 13 + [-1] * 3
    assert "robot robot starts on the ground, 1 cell lower" in world.lost
    other = read_world(draw("......hh....HH..", "################"))
    assert [one.name for one in other.bodies] == ["robot", "other"]
    assert "half a cell of the start: the middle of cell 6 is at x = 2.5 m" in other.lost
    assert any(said.startswith("the position of robot other") for said in other.lost)
    tall = read_world(draw(*["..h....."] * 5, "########"))
    assert tall.bodies == [] and any("5 voxels high" in said for said in tall.lost)


def test_gaps_are_ditches(draw):
    path = draw("......####..",
                "####..####.#")
    world = read_world(path)
    assert cells_of(world, 12) == [0] * 4 + [-1] * 2 + [1] * 4 + [-1, 0]
    assert world.ditches == [(4, 6), (10, 11)]
    assert world.lost[0] == ("2 gaps without ground (the first from cell 4 to 6): a ditch 0.1 m "
                             "deep, not a fall")
    deep = read_world(path, ditch_m=0.35)
    assert cells_of(deep, 6) == [0] * 4 + [-3.5] * 2


def test_ceilings_and_overhangs(draw):
    """The way goes through the cave, under its ceiling."""
    world = read_world(draw("###.......###",
                            "..######.....",
                            ".......#.....",
                            "...#.........",
                            "####..#######"))
    assert cells_of(world, 13) == [-1, -1, -1, 0, -2, -2] + [-1] * 7
    assert "13 cells above the ground: ceilings, overhangs or other levels" in world.lost
    hollow = read_world(draw("########",
                             "#......#",
                             "########"), start_row=3)
    assert set(hollow["heights_m"]) == {0}
    assert "6 cells of free space under the ground" in hollow.lost
    inside = read_world(draw("########",
                             "#......#",
                             "########"))
    assert cells_of(inside, 8) == [2, 0, 0, 0, 0, 0, 0, 2]
    assert "other floors at the start: rows 3 of its column; start_row chooses one" in inside.lost
    assert "the way is blocked at cell 0: the terrain continues above it" in inside.lost


def test_what_moves_or_is_soft(draw):
    world = read_world(draw(".........BB.",
                            "######ssssss",
                            "############"))
    assert cells_of(world, 12) == [0] * 12
    assert world.lost == ("ground: 6 voxels of other materials became rigid ground",
                          "moving objects: box", ENDS)


def test_long_worlds(draw):
    """The part around the start is exact; with a larger spacing there is more of it."""
    far = "." * 70 + "#" * 10
    path = draw(far, "#" * 80)
    world = read_world(path)
    assert len(world["heights_m"]) == 64 and set(world["heights_m"]) == {0}
    assert world.lost[0] == ("38 cells after x = 6.3 m, because a terrain has 64 heights; a larger "
                             "spacing_m keeps more")
    coarse = read_world(path, spacing_m=0.25)
    assert coarse["spacing_m"] == 0.25 and coarse["heights_m"][-1] == 0.1
    assert "details shorter than 0.25 m: each height is a mean" in coarse.lost
    x = 0.25 * np.arange(len(coarse["heights_m"]))
    edge = 2.5 + (70 - 3.5) / 10  # of the step
    expected = np.clip((x + 0.125 - edge) / 0.25, 0, 1) * 0.1
    assert np.allclose(coarse["heights_m"], expected, atol=1e-9)
    late = read_world(path, start_cell=72.5)
    assert late["heights_m"][25] == 0 and late["heights_m"][22] == -0.1
    assert not any("because a terrain" in said for said in late.lost)  # level before that


def test_what_is_no_world(draw, tmp_path):
    with pytest.raises(MorphodError, match="has no ground: .*use read_bodies to read its robots"):
        read_world(draw("hv"))
    with pytest.raises(MorphodError, match="is at cell 3.5, but the ground extends from 0 to 2"):
        read_world(draw("##."))
    assert read_world(draw("##."), start_cell=1)["heights_m"]
    with pytest.raises(BodyError, match="grid_height is 1, but its objects have 2 rows"):
        read_world(draw("#....", "#####", grid_height=1))
    with pytest.raises(ValueError, match="spacing_m must be 0.02 to 1"):
        read_world(draw("#####"), spacing_m=2)
    for text, words in (("{", "not JSON"), ("[]", "not an EvoGym world"),
                        ('{"grid_width": 4, "objects": {"a": {"indices": [0], "types": []}}}',
                         "do not match")):
        (tmp_path / "bad.json").write_text(text)
        with pytest.raises(BodyError, match=words):
            read_world(tmp_path / "bad.json")


def test_robots_walk_in_it(m, service, draw):
    """The service takes the terrain as it is, and reports it with the same heights."""
    world = read_world(draw("..hhh...........#...",
                            "..h.h.....##....#...",
                            "####################"))
    scored = m.evaluate(world.bodies, [world.environment(), {"task": "climb", "terrain": world}],
                        physics={"n_steps": 40})
    assert np.isfinite(scored.scores).all() and scored.units == ["m", "m"]
    stored = m.evaluate(world.bodies, [world.environment(None, light_xy_m=[4, 2.5])],
                        physics={"n_steps": 40})
    known, = service.get(f"/v1/evaluations/{stored.id}/environments")["items"]
    assert known["terrain"] == dict(world)


def test_a_huge_world_is_refused(tmp_path):
    """A small file must not take a lot of memory."""
    path = tmp_path / "huge.json"
    path.write_text('{"grid_width": 1000, "grid_height": 10000001, "objects": {"ground": '
                    '{"indices": [10000000000], "types": [5], "neighbors": {"10000000000": []}}}}')
    with pytest.raises(morphod.BodyError, match="cells; at most 4096"):
        morphod.read_world(path)
