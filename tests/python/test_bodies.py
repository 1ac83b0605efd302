"""Bodies in the formats that users have them in."""

import numpy as np
import pandas
import pytest
from morphod import Body, BodyError
from morphod.bodies import (
    WORKSPACE,
    genotypes_of,
    largest_pieces,
    requests_of,
    voxels_of,
)

ALL = np.ones(WORKSPACE, dtype=bool)


def pieces(voxels):
    """Returns the pieces of a body as sets of cells, found cell by cell."""
    left = {tuple(cell) for cell in np.argwhere(voxels)}
    found = []
    while left:
        piece, edge = set(), [left.pop()]
        while edge:
            cell = edge.pop()
            piece.add(cell)
            for axis in range(3):
                for step in (-1, 1):
                    near = tuple(at + step * (axis == own) for own, at in enumerate(cell))
                    if near in left:
                        left.remove(near)
                        edge.append(near)
        found.append(piece)
    return found


def test_genotype_index():
    body = Body.of([[1, 2, 3]])
    assert body.genotype.index("1") == (1 * 6 + 2) * 4 + 3 and body.genotype.count("1") == 1
    assert body.cells == [(1, 2, 3)] and len(body) == 1 and body.footprint() == 1


@pytest.mark.parametrize("same", [
    np.array([[[1], [1]]]),
    np.array([[[True], [True]]]),
    [[0, 0, 0], [0, 1, 0]],
    ((0, 1, 0), (0, 0, 0)),
    {"cells": [[0, 0, 0], [0, 1, 0]]},
    {"voxels": "10001" + "0" * 139},
    "10001" + "0" * 139,
    "g10001" + "0" * 139,
    "88" + "0" * 34,
    "d88" + "0" * 34,
    {"id": "88" + "0" * 34},
    np.pad(np.ones((1, 2, 1)), 9),
])
def test_one_body_in_all_forms(same):
    body = Body.of(same)
    moved = body.voxels[np.ix_(*(np.flatnonzero(body.voxels.any(axis=tuple(
        other for other in range(3) if other != axis))) for axis in range(3)))]
    assert moved.shape == (1, 2, 1) and moved.all() and body.lost == ()


def test_evogym_rows_come_from_the_top():
    body = Body.evogym(np.array([[0, 0, 3], [1, 1, 1]]))
    assert set(body.cells) == {(x, y, 0) for x in range(3) for y in (2, 3)} | {(2, 2, 1), (2, 3, 1)}
    assert body.lost == ("materials 1, 3 were merged into one", )


def test_evogym_connections():
    """Robots of EvoGym's `sample_robot`. Voxels that it does not connect are reported."""
    robot = np.array([[3.0, 3.0], [3.0, 0.0]])
    joined = Body.evogym((robot, np.array([[0, 0], [1, 2]])))
    assert joined == Body.evogym(robot.tolist()) and (
        joined.lost == ("material 3 became morphod's only material", ))
    apart = Body.evogym(robot, np.array([[0], [1]]))
    assert apart == joined and apart.lost[1:] == (
        "1 pair of adjacent voxels that was not connected is now connected", )
    assert Body.evogym(robot, np.empty((0, 2)).T).lost[1].startswith("2 pairs of adjacent voxels")
    assert Body.evogym(np.array([[1, 0, 1]]), repair="largest").lost == (
        "material 1 became morphod's only material",
        "2 voxels that were not part of the largest piece")


@pytest.mark.parametrize("wrong, said", [
    ((np.ones((5, 5)), ), "5 voxels high (axis 0 of the array); the workspace has 4 along z"),
    ((np.ones((2, 7)), ), "7 voxels long on axis 0 (x); the workspace has 6"),
    (([[1, 1], [1]], ), "different lengths"),
    (([[1, 6]], ), "the value at [0, 1] is 6: EvoGym materials are 0"),
    (([[1, float("nan")]], ), "[0, 1] is nan"),
    (([[0.5]], ), "[0, 0] is 0.5"),
    (([["1"]], ), "texts"),
    ((np.ones((2, 2, 2)), ), "2 dimensions [row, column], not 3"),
    (([[0, 0]], ), "at least one voxel"),
    (("33", ), "str is not an EvoGym robot"),
    (([[1, 1]], [[0, 1]]), "(2, n)"),
    (([[1, 1]], [[0, 1], [1]]), "(2, n)"),
    (([[1, 1]], [[0], [2]]), "indices from 0 to 1"),
    (([[1, 0, 1]], [[0], [2]]), "join the indices 0 and 2"),
])
def test_wrong_robots_of_evogym(wrong, said):
    with pytest.raises(BodyError) as caught:
        Body.evogym(*wrong)
    assert said in str(caught.value)


@pytest.mark.parametrize("wrong, said", [
    (np.ones((7, 1, 1)), "7 voxels long on axis 0 (x); the workspace has 6"),
    (np.ones((1, 7, 1)), "axis 1 (y)"),
    (np.ones((1, 1, 5)), "axis 2 (z); the workspace has 4"),
    (np.ones((2, 7)), "Body.evogym(it) reads EvoGym rows"),
    (np.array([[0, 2, 0], [1, 2, 0]]), '{"cells": it} reads cells'),
    ([[0, 3, 3], [1, 1, 0], [4, 0, 0]], "ambiguous: Body.evogym(it)"),
    ([[3, 3, 3], [3, 3, 3]], "duplicate of cell 0; Body.evogym(it) reads EvoGym rows"),
    ([[3, 3, 4], [4, 4, 4]], "z = 4; the workspace has 0 to 3; Body.evogym(it) reads EvoGym rows"),
    ([[5, 3, 3], [5, 3, 3]], "cell 1 is a duplicate of cell 0"),
    ((np.ones((2, 2)), np.zeros((2, 4))), "Body.evogym(pair)"),
    (np.full(WORKSPACE, np.nan), "the value at [0, 0, 0] is nan"),
    (np.full(WORKSPACE, 0.3), "array > 0.5"),
    (np.ones((4, 6, 6)), "a different order"),
    (np.ma.array(np.ones(WORKSPACE), mask=True), "filled(0)"),
    (np.full(WORKSPACE, "0"), "an array of texts: convert it"),
    (np.ones(3), "3 dimensions"),
    (np.zeros((2, 2, 2)), "at least one voxel"),
    ([], "at least one voxel"),
    ([[0, 0, 4]], "cell 0 has z = 4; the workspace has 0 to 3"),
    ([[0, 0, 0], [-1, 0, 0]], "cell 1 has x = -1"),
    ([[0.5, 0, 0]], "x = 0.5"),
    ([[0, 0]], "cell 0 is not [x, y, z]"),
    ("01", "neither a genotype"),
    ("2" * 144, "neither a genotype"),
    ({"cell": []}, '"cells", "voxels" and "id"'),
    ({"cells": [[0, 0, 0]], "genotype": "0"}, "optionally a name, but no 'genotype'"),
    (7, "int is not a body"),
])
def test_errors_name_what_is_wrong(wrong, said):
    with pytest.raises(BodyError) as caught:
        Body.of(wrong)
    assert said in str(caught.value)


def test_errors_name_the_body():
    with pytest.raises(BodyError, match="body 2: the body is 7"):
        requests_of([[[0, 0, 0]], "0" * 36, np.ones((7, 1, 1))])
    bodies = np.stack([ALL, ~ALL])
    with pytest.raises(BodyError, match="body 1: a body needs"):
        requests_of(bodies)
    bodies = np.zeros((3, *WORKSPACE))
    bodies[:, 0, 0, 0] = 1
    bodies[2, 1, 2, 3] = 0.5
    with pytest.raises(BodyError, match=r"body 2: the value at \[1, 2, 3\] is 0.5"):
        requests_of(bodies)
    assert list(requests_of(bodies, "skip")[2]) == [2]


@pytest.mark.parametrize("one", ["0" * 36, Body(ALL), {"id": "0" * 36}, ALL, np.ones((2, 2, 2)),
                                 [[0, 0, 0], [1, 0, 0]], np.argwhere(ALL).tolist(), b"0"])
def test_one_body_is_not_a_list(one):
    with pytest.raises(BodyError, match="put this one in brackets"):
        requests_of(one)


@pytest.mark.parametrize("wrong, said", [
    (np.argwhere(ALL), '{"cells": it} reads cells'),
    (np.ones((5, 144)), r"the shape \(n, 6, 6, 4\), not \(5, 144\)"),
    (np.ones((2, 4, 6, 6)), "body 0: the shape .* in a different order"),
    (np.ma.ones((2, *WORKSPACE)), "body 0: a masked array"),
    (pandas.DataFrame({"genotype": ["0" * 144]}), 'such as table."genotype"'),
    ({"0" * 36}, "no order"),
    (7, "int is not a list of bodies"),
])
def test_what_is_not_a_list_of_bodies(wrong, said):
    with pytest.raises(BodyError, match=said):
        requests_of(wrong)


def test_columns_and_generators_are_lists():
    genotypes = genotypes_of(np.stack([ALL, ALL]))
    designs = [{"voxels": genotype} for genotype in genotypes]
    for bodies in (pandas.Series(genotypes), np.array(genotypes), iter(genotypes),
                   np.array(genotypes, dtype=object)):
        assert requests_of(bodies)[0] == designs
    assert requests_of([{"id": "8" + "0" * 35}])[0] == [{"id": "8" + "0" * 35}]


def test_a_body_has_booleans():
    for voxels in (np.ones(WORKSPACE), np.ones((2, 2, 2), dtype=bool), [[0, 0, 0]]):
        with pytest.raises(BodyError, match="Body.of reads other forms"):
            Body(voxels)


def test_largest_piece():
    bodies = np.random.default_rng(7).random((300, *WORKSPACE)) > 0.75
    kept = largest_pieces(bodies)
    for body, own in zip(bodies, kept):
        cells = {tuple(cell) for cell in np.argwhere(own)}
        found = pieces(body)
        assert cells in found and len(cells) == max(len(piece) for piece in found)
        gone = int(body.sum() - own.sum())
        one = Body.of(body, "largest")
        assert (one.voxels == own).all()
        many = "voxels that were" if gone > 1 else "voxel that was"
        assert one.lost == ((f"{gone} {many} not part of the largest piece", ) if gone else ())


def test_arrays_and_lists_are_one():
    bodies = np.random.default_rng(8).integers(0, 3, (20, *WORKSPACE))
    assert requests_of(bodies) == requests_of(list(bodies))
    assert (voxels_of(genotypes_of(bodies != 0)) == (bodies != 0)).all()
    assert not voxels_of([None]).any()


def test_what_is_skipped_keeps_its_place():
    designs, _, faults = requests_of([[[0, 0, 0]], np.ones((7, 1, 1)), "d" + "0" * 36], "skip")
    assert list(faults) == [1] and "axis 0 (x)" in faults[1]
    assert [design.get("voxels", "").count("1") for design in designs] == [1, 0, 0]


def test_equal_bodies():
    assert Body.of([[0, 0, 0]]) == Body.of("1" + "0" * 143) and len({Body.of([[0, 0, 0]]),
                                                                      Body.of([[0, 0, 0]])}) == 1
    assert Body.of([[0, 0, 0]]) != Body.of([[0, 0, 1]]) and Body.of([[0, 0, 0]]) != "1"
