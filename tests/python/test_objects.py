"""Any object that is passed as a body becomes the body that it depicts, or raises a `BodyError`
that says what to do; never anything else.

Each object is made from a picture, a set of cells that is drawn first, so that the tests know what
the object depicts without using the package.
"""

import json

import numpy as np
import pandas
import pytest
from morphod import Body, BodyError, read_bodies
from morphod.objectives import Plan
from test_bodies import pieces

SIDES = (6, 6, 4)
DTYPES = ["?", "i1", "u1", "<i2", ">i4", "u4", "i8", ">u8", "f2", "f4", ">f8", "f8", "g"]
UNREADABLE = ["U1", "S1", "O", "c8", "c16", "m8[s]", "M8[s]", "V4"]


class Refused:
    """Checks that the message contains these words."""

    def __init__(self, *words):
        self.words = words


def draw(rng):
    """Draws a picture: cells in the workspace, in one piece or not."""
    density = rng.choice([0.02, 0.1, 0.5, 1.0])
    full = rng.random(SIDES) < density
    full[tuple(rng.integers(SIDES))] = True
    return full


def shape_of(picture):
    """Moves cells to the origin: the position of a body in the workspace does not matter."""
    cells = np.argwhere(picture)
    return {tuple(cell) for cell in (cells - cells.min(axis=0)).tolist()}


def cells_of(picture, rng):
    cells = np.argwhere(picture).tolist()
    rng.shuffle(cells)
    return cells


def held(array, rng):
    """Returns the same array with another memory layout."""
    how = rng.integers(5)
    if how == 0:
        return np.asfortranarray(array)
    if how == 1:
        return np.repeat(array, 2, axis=0)[::2]
    if how == 2:
        return array[::-1][::-1]
    if how == 3:
        array = array.copy()
        array.flags.writeable = False
    return array


def cut(picture):
    low, high = (edge(np.argwhere(picture), axis=0) for edge in (np.min, np.max))
    return picture[tuple(slice(a, b + 1) for a, b in zip(low, high))]


# ---- accepted objects ----


def zeros_and_ones(picture, rng):
    array = [picture, cut(picture), np.pad(picture, rng.integers(1, 4))][rng.integers(3)]
    if array.shape != SIDES and sorted(array.shape) == sorted(SIDES):
        array = picture
    return held(array.astype(rng.choice(DTYPES)), rng), picture


def material_numbers(picture, rng):
    array = picture * rng.integers(1, rng.choice([2, 6, 120]), SIDES)
    return held(array.astype(rng.choice(["i1", "u1", ">i4", "u8"])), rng), picture


def listed_cells(picture, rng):
    """A list is refused if it could be a robot of EvoGym with three columns."""
    cells = cells_of(picture, rng)
    row = rng.choice([list, tuple, np.array])
    value = [list, tuple][rng.integers(2)](row(cell) for cell in cells)
    is_torn = len(pieces(picture)) > 1
    if is_torn and any(cells[0]) and max(map(max, cells)) <= 4:
        return value, Refused("Body.evogym", '{"cells": it}')
    return value, picture


def named_cells(picture, rng):
    cells = cells_of(picture, rng)
    return {"cells": cells if rng.integers(2) else np.array(cells, dtype=">i4"),
            **({"name": "worm"} if rng.integers(2) else {})}, picture


def texts(picture, rng):
    digits = "".join("01"[voxel] for voxel in picture.ravel().tolist())
    packed = np.packbits(picture.ravel()).tobytes().hex()
    return [digits, "g" + digits, packed, "d" + packed.upper(), {"voxels": digits},
            {"id": packed}, np.str_(digits), Body(picture)][rng.integers(8)], picture


def rows(picture, rng):
    """A robot of EvoGym, read by its name; the depth is two voxels."""
    picture = picture.copy()
    picture[:, 1:] = picture[:, :1]
    picture[:, 2:] = False
    if not picture.any():
        picture[0, :2, 0] = True
    robot = picture[:, 0].T[::-1] * rng.integers(1, 6, (4, 6))
    given = [robot, robot.astype(float), robot.tolist(), tuple(map(tuple, robot)),
             (robot, connections(robot)), held(robot, rng)][rng.integers(6)]
    return Body.evogym(given), picture


def connections(robot):
    there = [at for at in range(robot.size) if robot.flat[at]]
    width = robot.shape[1]
    pairs = [(a, b) for a in there for b in there
             if b - a == width or (b - a == 1 and b % width)]
    return np.array(pairs).T if pairs else np.empty((0, 2)).T


# ---- refused objects ----


def densities(picture, rng):
    array = np.where(picture, 0.9, 0.1).astype(rng.choice(["f2", "f4", ">f8", "g"]))
    return held(array, rng), Refused("> 0.5", "[0, 0, 0]")


def no_numbers(picture, rng):
    array = picture.astype(rng.choice(["f4", "f8"]))
    place = tuple(rng.integers(SIDES).tolist())
    array[place] = rng.choice([np.nan, np.inf, -np.inf])
    return held(array, rng), Refused(str(list(place)))


def negative(picture, rng):
    return np.where(picture, 1, -1) if not picture.all() else -1 * picture, Refused("> 0", "-1")


def masked(picture, rng):
    return np.ma.array(picture.astype(rng.choice(DTYPES)), mask=rng.random(SIDES) < 0.5), (
        Refused("filled(0)"))


def no_voxels(picture, rng):
    kind = rng.choice(UNREADABLE)
    plain = picture.astype("u1")
    return plain.view("V1") if kind == "V4" else plain.astype(kind), Refused("this is an array of")


def other_order(picture, rng):
    order = [(2, 0, 1), (2, 1, 0), (0, 2, 1)][rng.integers(3)]
    return picture.transpose(order), Refused("[x, y, z]", "transpose")


def two_dimensions(picture, rng):
    cells = np.argwhere(picture)
    value = [cells, picture[:, 0], picture[0], cells.view(np.matrix),
             picture.reshape(1, 144)][rng.integers(5)]
    return held(value.astype(rng.choice(DTYPES)), rng), Refused("Body.evogym")


def other_dimensions(picture, rng):
    return [picture.ravel(), picture.ravel()[:143], picture[np.newaxis], np.array(1.0),
            np.zeros(0), np.zeros((0, 6, 4)), np.zeros(SIDES), picture[None, None]
            ][rng.integers(8)], Refused("a")


def too_long(picture, rng):
    axis = rng.integers(3)
    sides = [1, 1, 1]
    sides[axis] = SIDES[axis] + 1 + rng.integers(4)
    return np.ones(sides, dtype=rng.choice(DTYPES)), Refused(
        f"{sides[axis]} voxels long on axis {axis} ({'xyz'[axis]}); the workspace has {SIDES[axis]}"
    )


def wrong_cells(picture, rng):
    """A list of cells with one fault."""
    cells = cells_of(picture, rng)
    at, axis = rng.integers(len(cells)), rng.integers(3)
    value = [0.5, 1.0, True, "1", None, float("nan"), 6, -1, [1], 10**30, np.float64(1), np.True_,
             2j][rng.integers(13)]
    cells[at] = [*cells[at]]
    cells[at][axis] = value
    return cells if rng.integers(2) else {"cells": cells}, Refused(f"cell {at} has {'xyz'[axis]}")


def twice(picture, rng):
    cells = cells_of(picture, rng)
    cells.append(cells[rng.integers(len(cells))])
    return cells, Refused()


def no_cells(picture, rng):
    cells = cells_of(picture, rng)
    return [[cell + [0] for cell in cells], cells + [[1, 2]], picture.tolist(), [cells], cells[0],
            np.array(cells).tolist() + ["000"], [picture], (picture[0] * 1, np.zeros((2, 0))),
            {"cells": np.array(cells) * 1.0}, {"cells": picture.tolist()}, {"cells": "000"},
            {"cells": 3}][rng.integers(12)], Refused()


def nested(value):
    for _ in range(2000):  # more than repr() follows
        value = [value]
    return value


def no_body(picture, rng):
    cells = cells_of(picture, rng)
    digits = "".join("01"[voxel] for voxel in picture.ravel().tolist())
    return [None, 1, 0.5, True, digits[:-1], digits + "\n", digits.encode(), set(map(tuple, cells)),
            (cell for cell in cells), iter(cells), pandas.DataFrame(cells), pandas.Series(digits),
            pandas.DataFrame(picture[0]), range(3), {"cells": cells, "id": "0" * 36}, {},
            {"cells": cells, "genotype": digits}, {"voxels": cells}, {"id": digits}, object(),
            np.float64(1), bytearray(3), Body, memoryview(picture), memoryview(np.array(cells)),
            [nested(cells)]][rng.integers(26)], Refused()


READ = [zeros_and_ones, material_numbers, listed_cells, named_cells, texts, rows]
WRONG = [densities, no_numbers, negative, masked, no_voxels, other_order, two_dimensions,
         other_dimensions, too_long, wrong_cells, twice, no_cells, no_body]


def check(read, expected):
    """`read()` returns the body of the picture, or refuses the object for the expected reason."""
    if isinstance(expected, Refused):
        with pytest.raises(BodyError) as caught:
            read()
        text = str(caught.value)
        assert all(word in text for word in expected.words) and 20 < len(text) < 400, text
        return None
    body = read()
    assert shape_of(body.voxels) == shape_of(expected)
    assert body.voxels.dtype == bool and body.voxels.shape == SIDES
    assert all(len(sentence) < 200 for sentence in body.lost)
    return body


def test_objects_are_their_picture_or_refused():
    rng = np.random.default_rng(20)
    kinds = READ + WRONG
    for turn in range(2000):
        make = kinds[turn % len(kinds)]
        value, expected = make(draw(rng), rng)
        try:
            check(lambda: Body.of(value), expected)
        except BaseException as error:
            raise AssertionError(f"{make.__name__} {turn}: {value!r:.300}") from error


def test_lost_names_the_materials():
    rng = np.random.default_rng(21)
    for _ in range(100):
        array = draw(rng) * rng.integers(1, rng.choice([2, 6, 120]), SIDES)
        used = sorted({*array.ravel().tolist()} - {0})
        lost = Body.of(array).lost
        assert (lost == ()) == (used == [1])
        assert all(str(kind) in lost[0] for kind in (used[:5] if used != [1] else ()))
        assert not lost or len(used) < 6 or lost[0].startswith(f"{len(used)} materials")


# ---- files ----


def write_npy(path, picture, rng):
    np.save(path.with_suffix(".npy"), picture.astype(rng.choice(DTYPES))[np.newaxis])
    return ".npy", picture


def write_pickle(path, picture, rng):
    np.save(path.with_suffix(".npy"), np.array([picture, None], dtype=object))
    return ".npy", Refused("cannot be read", "allow_pickle=False")


def write_flat(path, picture, rng):
    np.savez(path.with_suffix(".npz"), np.argwhere(picture))
    return ".npz", Refused("Body.evogym")


def write_robot(path, picture, rng):
    shown = np.repeat(picture[:, :1], 2, axis=1)
    if not shown.any():
        shown[:, :, 0] = True
    robot = (shown[:, 0].T[::-1] * rng.integers(1, 5, (4, 6))).astype(rng.choice(["f8", "i8"]))
    np.savez(path.with_suffix(".npz"), robot, connections(robot))
    return ".npz", shown


def write_density(path, picture, rng):
    np.savez(path.with_suffix(".npz"), bodies=picture * 0.5)
    return ".npz", Refused("> 0.5")


def write_world(path, picture, rng):
    shown = np.repeat(picture[:, :1], 2, axis=1)
    if not shown.any():
        shown[:, :, 0] = True
    indices = [int((z + 1) * 20 + x + 3) for x, z in np.argwhere(shown[:, 0])]
    path.with_suffix(".json").write_text(json.dumps({"grid_width": 20, "objects": {
        "ground": {"indices": [*range(20)], "types": [5] * 20},
        "robot": {"indices": indices, "types": rng.integers(1, 5, len(indices)).tolist()}}}))
    return ".json", shown


def test_files_are_their_picture_or_refused(tmp_path):
    rng = np.random.default_rng(22)
    kinds = [write_npy, write_pickle, write_flat, write_robot, write_density, write_world]
    for turn in range(120):
        make = kinds[turn % len(kinds)]
        suffix, expected = make(tmp_path / "file", draw(rng), rng)
        body = check(lambda: read_bodies(tmp_path / f"file{suffix}")[0], expected)
        if make is write_world:
            assert body.name == "robot" and "left out of the file: ground (fixed)" in body.lost


# ---- objectives and the service ----


def test_a_solution_has_a_voxel_above_one_half():
    """Whatever its shape and type: a vector, an array, a list, a table."""
    rng = np.random.default_rng(23)
    plan = Plan(None, None, 10.0, False)
    for turn in range(108):
        values = rng.normal(0.4, 1, (3, 144)).astype(rng.choice(["f4", ">f8"]))
        if turn % 3 == 0:
            values = rng.integers(-1, 3, (3, 144))
        shown = [Body.of(row.reshape(SIDES) > 0.5, "largest") for row in values]
        many = [values, values.reshape(3, *SIDES), list(values), values.tolist(),
                list(values.reshape(3, *SIDES)), pandas.DataFrame(values), held(values, rng),
                tuple(map(tuple, values.tolist())), (row for row in values)]
        bodies, single = plan.read(many[turn % len(many)])
        assert not single and bodies == shown
        one = [values[0], values[0].reshape(SIDES), values[0].tolist(), pandas.Series(values[0])]
        bodies, single = plan.read(one[turn % len(one)])
        assert single and bodies == shown[:1]
        wrong = values.astype(float)
        place = int(rng.integers(144))
        wrong[1, place] = rng.choice([np.nan, np.inf])
        with pytest.raises(BodyError, match=rf"solution 1.*\[{place}\]"):
            plan.read(wrong)


def test_decoded_arrays_have_the_same_threshold():
    density = np.random.default_rng(25).random(SIDES)
    for decoded in (density, density.ravel(), density.ravel().tolist()):
        shown = Body.of(np.reshape(decoded, SIDES) > 0.5, "largest")
        assert Plan(None, lambda key: decoded, 10.0, False).read(["a", "b"]) == ([shown] * 2, False)
    assert Plan(None, lambda key: density * 0.5, 10.0, False).read([3.0]) == ([None], True)
    with pytest.raises(BodyError, match="solution 0 is not a body: an array has shape .6, 4."):
        Plan(None, lambda key: density[0], 10.0, False).read(["a"])


@pytest.mark.parametrize("wrong", [
    np.zeros(143), np.zeros((4, 143)), np.zeros((2, 2, 2)), np.zeros((5, 3), dtype=int),
    np.zeros((1, 1, 6, 6, 4)), np.array(0.7), 0.7, [0.7] * 143, [[0.7] * 143],
    np.ma.ones(144), np.full(144, "1"), np.ones((2, 144), dtype=object),
    np.ones(144, dtype=complex), {1, 2}, None, np.ones((4, 6, 6)), [np.ones((6, 4))],
])
def test_other_solutions_are_refused(wrong):
    with pytest.raises(BodyError):
        Plan(None, None, 10.0, False).read(wrong)


@pytest.mark.parametrize("one", [np.ones(144), np.ones((6, 6, 4)), [1.0] * 144, "0" * 36,
                                 [[0, 0, 0]], {"cells": [[0, 0, 0]]}])
def test_objectives_with_measures_take_many_solutions(one):
    with pytest.raises(BodyError, match="brackets"):
        Plan(["voxels"], None, 10.0, True).read(one)


def test_the_service_scores_what_is_shown(m):
    """With `evaluate`, each body that is sent is the depicted one, or is refused before anything is
    sent."""
    rng = np.random.default_rng(24)
    pictures = [picture for picture in (draw(rng) for _ in range(120))
                if len(pieces(picture)) == 1][:24]
    values, shown = [], []
    for place, picture in enumerate(pictures):
        value, expected = READ[place % 5](picture, rng)
        values.append(value)
        shown.append(expected)
    evaluation = m.evaluate(values, physics={"n_steps": 1})
    for result, picture in zip(evaluation, shown):
        assert shape_of(result.body.voxels) == shape_of(picture)
    before = len(m.jobs())
    for turn in range(60):
        value, _ = WRONG[turn % len(WRONG)](draw(rng), rng)
        with pytest.raises(BodyError, match="body 1: "):
            m.evaluate([[[0, 0, 0]], value])
    assert len(m.jobs()) == before
