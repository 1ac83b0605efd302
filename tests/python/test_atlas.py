"""Atlas files without a service, against the answers of the C library and plain programs."""

import hashlib
import itertools
import json
import math
import pathlib
import pickle
import subprocess

import numpy as np
import pytest
from morphod import Body, BodyError
from morphod.atlas import (
    GROW_SHRINK,
    Atlas,
    AtlasError,
    OutsideError,
    kendall_tau,
)

ANSWERS = (pathlib.Path(__file__).resolve().parents[2] / "build" / "tests" / "unit" / "atlas" /
           "atlas-answers")
STEPS = [("add", ), ("remove", ), GROW_SHRINK, ("add", "remove", "move")]
MEASURED = 1 << 0 | 1 << 2 | 1 << 16
NAMES = ("displacement_m", "mean_speed_m_per_s", "work_j")
WORDS = {1: "add", 2: "remove", 4: "move"}


def made(folder, *scope):
    path = folder / f"{'-'.join(map(str, scope))}.atlas"
    lines = subprocess.run([ANSWERS, path, *map(str, scope)], check=True, capture_output=True,
                           text=True).stdout.splitlines()
    head, *bodies = map(json.loads, lines)
    return path, head, bodies


@pytest.fixture(scope="module", params=[(6, 6, 4, 5, 1000003), (6, 6, 4, 5, 4), (3, 5, 2, 6, 40),
                                        (4, 2, 3, 6, 40), (1, 2, 1, 4, 40),
                                        (6, 6, 4, 4, 30, MEASURED), (3, 5, 2, 6, 5, (1 << 20) - 1)],
                ids=lambda scope: "-".join(map(str, scope)))
def answers(request, tmp_path_factory):
    """An atlas and what the library says about it: with and without many equal scores, and in
    workspaces that are not square."""
    path, head, bodies = made(tmp_path_factory.mktemp("atlas"), *request.param)
    return Atlas.open(path, check=True), head, bodies


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    path, _, bodies = made(tmp_path_factory.mktemp("atlas"), 6, 6, 4, 4, 1000003)
    return path, bodies


@pytest.fixture(scope="module")
def blocks(tmp_path_factory):
    """An atlas with more than one block of a size."""
    return made(tmp_path_factory.mktemp("atlas"), 5, 5, 4, 8, 1000003)


def number(value):
    return math.inf if value is None else value


def test_bodies_and_scores(answers):
    atlas, _, bodies = answers
    assert len(atlas) == len(bodies) == sum(atlas.sizes.values())
    for body in bodies:
        at = body["position"]
        assert atlas.genotype(at) == body["genotype"] and atlas.id(at) == body["id"]
        assert atlas.score(at) == np.float32(number(body["score"]))
        assert atlas.losses(at).astype(np.float32).tolist() == [
            np.float32(number(loss)) for loss in body["losses"]]
        assert len(atlas.voxels(at)) == len(atlas.cells(at)) == body["voxels"]
        assert at in atlas.positions(body["voxels"])


def test_every_image_is_found(answers):
    atlas, _, bodies = answers
    texts = [(body["position"], image) for body in bodies
             for image in [body["genotype"], *body["images"]]]
    assert [atlas.find(text) for _, text in texts] == [position for position, _ in texts]
    shape = atlas.workspace
    arrays = np.array([[digit == "1" for digit in text] for _, text in texts]).reshape(-1, *shape)
    assert atlas.find_all(arrays).tolist() == [position for position, _ in texts]
    for position, text in texts[::17]:
        array = np.array([digit == "1" for digit in text]).reshape(shape)
        assert atlas.find(array) == position


def test_ranks(answers):
    atlas, _, bodies = answers
    for body in bodies:
        at = body["position"]
        for within_size, name in ((False, "rank"), (True, "rank_of_size")):
            rank = atlas.rank(at, within_size=within_size)
            assert [rank.better, rank.equal, rank.worse, rank.percentile] == body[name]
            assert atlas.percentile(at, within_size=within_size) == body[name][3]
        assert rank.rank == rank.better + 1
    assert atlas.order().tolist() == [body["nth"] for body in bodies]
    assert atlas.best(3).tolist() == [body["nth"] for body in bodies[:3]]
    for voxels in atlas.sizes:
        assert atlas.best(10**6, voxels).tolist() == [
            at for at in atlas.order() if at in atlas.positions(voxels)]


def test_neighbors_and_ascents(answers):
    atlas, _, bodies = answers
    for body in bodies:
        at = body["position"]
        for steps, neighbors, path in zip(STEPS, body["neighbors"], body["paths"]):
            found = atlas.neighbors(at, steps)
            assert [(one.position, one.score, one.step) for one in found] == [
                (to, np.float32(number(score)), WORDS[step]) for to, score, step in neighbors]
            assert atlas.ascend(at, steps) == path
            best = atlas.best_step(at, steps)
            assert (best is None) == (len(path) == 1)
            assert best is None or best.position == path[1]


def test_similar(answers):
    atlas, _, bodies = answers
    near = [{to for to, _, _ in body["neighbors"][2]} for body in bodies]
    for at in range(0, len(bodies), 7):
        second = {to for one in near[at] for to in near[one]} - near[at] - {at}
        found = atlas.similar(at)
        assert {body.position for body in found if body.distance == 1} == near[at]
        assert {body.position for body in found if body.distance == 2} == second
        assert len(found) == len(near[at]) + len(second)
        order = [(body.score, body.position) for body in found]
        assert order == sorted(order) and all(score == atlas.score(to) for score, to in order)


def test_basins(answers):
    atlas, _, bodies = answers
    basins = atlas.basins()
    assert basins.optimum.tolist() == [body["optimum"] for body in bodies]
    assert basins.size.tolist() == [body["basin"] for body in bodies]
    assert basins.steps.tolist() == [len(body["paths"][2]) - 1 for body in bodies]
    optima = atlas.optima().tolist()
    assert sorted(optima) == [body["position"] for body in bodies if body["basin"]]
    assert [atlas.score(at) for at in optima] == sorted(atlas.score(at) for at in optima)
    steps = atlas.steps()
    assert sorted(zip(steps.larger.tolist(), steps.smaller.tolist())) == sorted(
        (body["position"], to) for body in bodies for to, _, _ in body["neighbors"][1])


def test_histograms_and_footprints(answers):
    atlas, head, _ = answers
    edges = np.arange(11, dtype=np.float32) / 10
    for voxels, counts in enumerate(head["histograms"]):
        assert atlas.histogram(edges, voxels or None).tolist() == counts
    assert atlas.footprints() == {footprint: (bodies, best) for footprint, (bodies, best)
                                  in enumerate(head["footprints"]) if bodies}
    with pytest.raises(ValueError, match="ascending"):
        atlas.histogram([1, 0])


def test_measures(answers):
    """Values and percentiles, for every body."""
    atlas, _, bodies = answers
    for body in bodies:
        at = body["position"]
        assert tuple(body["measures"]) == atlas.measures
        for name, (value, percentile) in body["measures"].items():
            found = atlas.measure(name, at)
            assert math.isnan(found) if value is None else found == np.float32(value)
            found = atlas.measure_percentile(name, at)
            assert math.isnan(found) if value is None else found == pytest.approx(percentile)


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """An atlas with measures and more than one block of a size."""
    return made(tmp_path_factory.mktemp("atlas"), 6, 6, 4, 7, 50, MEASURED)


def test_arrays_of_measures(measured):
    path, _, bodies = measured
    atlas = Atlas.open(path, check=True)
    assert atlas.measures == NAMES and len(atlas) == len(bodies) > 3000
    for name in NAMES:
        expected = [math.nan if body["measures"][name][0] is None else
                    np.float32(body["measures"][name][0]) for body in bodies]
        np.testing.assert_array_equal(atlas.all_measures(name), expected)
        for block in atlas.blocks():
            values = block.measures[name]
            assert values.shape == (len(block), ) and values.dtype == np.float32
            assert not values.flags.owndata and not values.flags.writeable
            assert values.flags.c_contiguous and np.may_share_memory(values, block.keys.base)
    assert not atlas.all_measures("work_j").flags.writeable
    with pytest.raises(KeyError, match="does not have the measure 'tilt_rad'; it has displacement"):
        atlas.measure("tilt_rad", 0)


def test_in_the_order_of_a_measure(measured):
    atlas = Atlas.open(measured[0])
    values = atlas.all_measures("work_j", 6)
    first = atlas.positions(6).start
    known = [int(at) for at in np.flatnonzero(~np.isnan(values))]
    for order, sign in (("descending", -1), ("ascending", 1)):
        expected = sorted(known, key=lambda at, sign=sign: (sign * values[at], at))
        found = atlas.best_by("work_j", 10**6, 6, order=order) - first
        assert found[:len(known)].tolist() == expected
        assert np.isnan(values[found[len(known):]]).all() and len(found) == len(values)
    assert len(atlas.best_by("work_j", 3)) == 3
    with pytest.raises(ValueError, match="descending or ascending"):
        atlas.best_by("work_j", order="up")
    scores, some = atlas.scores(6), (np.float32(0.2), np.float32(0.7))
    for lo, hi, low, high in itertools.product((None, 0.5), (None, 2.5), (None, some[0]),
                                               (None, some[1])):
        def inside(at, lo=lo, hi=hi, low=low, high=high):
            value, score = values[at], scores[at]
            # Bodies without a value are last, where the lowest values are.
            known = lo is None if math.isnan(value) else (
                (lo is None or value >= lo) and (hi is None or value < hi))
            return known and (low is high is None or (low or 0) <= score < (high or math.inf))

        expected = sorted(filter(inside, range(len(values))),
                          key=lambda at: (math.isnan(values[at]), -np.nan_to_num(values[at]), at))
        found = atlas.best_by("work_j", 10**6, 6, lo=lo, hi=hi, score_lo=low, score_hi=high) - first
        assert found.tolist() == expected and expected
        expected = [at for at in atlas.order(6) if (low or 0) <= scores[at - first] and
                    (high is None or scores[at - first] < high)]
        assert atlas.best(10**6, 6, lo=low, hi=high).tolist() == expected
        assert atlas.best(3, 6, lo=low, hi=high).tolist() == expected[:3]
    for ends, words in (({"lo": 1, "hi": 1}, "lo must be below hi"),
                        ({"score_lo": 2, "score_hi": 1}, "score_lo must be below score_hi")):
        with pytest.raises(ValueError, match=words):
            atlas.best_by("work_j", **ends)
    edges = np.float32([-3, -1, 0.5, 5])
    assert atlas.histogram(edges, 6, measure="work_j").tolist() == [
        int(((lo <= values) & (values < hi)).sum()) for lo, hi in zip(edges, edges[1:])]
    shown = atlas.map("work_j", bins=6)
    every = atlas.all_measures("work_j")
    assert shown.bodies == int((~np.isnan(every)).sum())
    assert shown.tau == kendall_tau(atlas.scores()[~np.isnan(every)], every[~np.isnan(every)])


def test_blocks_are_views_of_the_file(blocks):
    path, _, bodies = blocks
    atlas = Atlas.open(path, check=True)
    assert max(atlas.sizes.values()) > 2 * 4096
    size = max(atlas.sizes, key=atlas.sizes.get)
    assert len(atlas.blocks(size)) == -(-atlas.sizes[size] // 4096)
    for block in atlas.blocks():
        base = block.scores
        while base.base is not None and isinstance(base.base, np.ndarray):
            base = base.base
        assert isinstance(base, np.memmap) and base.nbytes == path.stat().st_size
        assert not block.scores.flags.owndata and not block.scores.flags.writeable
        assert block.losses.shape == (len(block), 3) and block.losses.dtype == np.float16
    scores = np.concatenate([block.scores for block in atlas.blocks(size)])
    assert (scores == atlas.scores(size)).all() and len(atlas.all_losses(size)) == len(scores)
    assert atlas.scores().tolist() == [np.float32(number(body["score"])) for body in bodies]
    for body in bodies[::501] + bodies[-2:]:
        assert atlas.find(body["images"][-1]) == body["position"]
        assert atlas.losses(body["position"]).astype(np.float32).tolist() == [
            np.float32(number(loss)) for loss in body["losses"]]


def test_bodies_in_other_forms(small):
    path, bodies = small
    atlas = Atlas.open(path)
    body = bodies[20]
    made_body = Body.of({"voxels": body["images"][-1]})
    for same in (made_body, made_body.voxels, made_body.cells, body["id"], f"d{body['id']}",
                 {"cells": made_body.cells}, f"{body['id']}@1"):
        assert atlas.find(same) == 20 and atlas.score(same) == np.float32(body["score"])
    assert len(atlas.body(20)) == body["voxels"] and atlas.body(20).genotype == body["genotype"]
    assert atlas.find_all([made_body, "1" * 144, body["id"]]).tolist() == [20, -1, 20]
    assert atlas.position(np.int64(3)) == 3


@pytest.mark.parametrize("cells, reason, text", [
    ([], "empty", "empty"),
    ([(0, 0, 0), (2, 0, 0)], "pieces", "one piece"),
    ([(x, 0, 0) for x in range(5)], "voxels", "5 voxels; the atlas has bodies of at most 4"),
])
def test_bodies_outside_say_why(small, cells, reason, text):
    atlas = Atlas.open(small[0])
    voxels = np.zeros((6, 6, 4), dtype=bool)
    for cell in cells:
        voxels[cell] = True
    genotype = "".join("01"[int(voxel)] for voxel in voxels.ravel())
    for body in (voxels, genotype):
        with pytest.raises(OutsideError, match=text) as caught:
            atlas.find(body)
        assert caught.value.reason == reason and isinstance(caught.value, BodyError)
        assert pickle.loads(pickle.dumps(caught.value)).reason == reason
    assert atlas.find_all(voxels[np.newaxis]).tolist() == [-1]


def test_a_body_that_does_not_fit(answers):
    atlas, _, _ = answers
    if atlas.workspace == (4, 2, 3):
        with pytest.raises(OutsideError) as caught:
            atlas.find([(0, y, 0) for y in range(5)])
        assert caught.value.reason == "workspace"


def test_positions_outside(small):
    atlas = Atlas.open(small[0])
    for position in (-1, len(atlas)):
        with pytest.raises(IndexError):
            atlas.score(position)
    with pytest.raises(OutsideError, match="1 to 4 voxels"):
        atlas.scores(5)
    with pytest.raises(ValueError, match="steps must be"):
        atlas.neighbors(0, "grow")


@pytest.mark.parametrize("measures", (0, MEASURED))
def test_damaged_files_are_refused(tmp_path, measures):
    """Any altered byte is found, and a file of another length."""
    good = made(tmp_path, 6, 6, 4, 4, 1000003, measures)[0].read_bytes()
    path = tmp_path / "bad.atlas"
    for at in [*range(0, 304, 7), *range(304, len(good), 97), len(good) - 1]:
        path.write_bytes(good[:at] + bytes([good[at] ^ 0x40]) + good[at + 1:])
        with pytest.raises(AtlasError):
            Atlas.open(path, check=True)
    for length in (0, 8, 16, 300, 308, len(good) - 1):
        path.write_bytes(good[:length])
        with pytest.raises(AtlasError):
            Atlas.open(path)
    path.write_bytes(good + bytes(8))
    with pytest.raises(AtlasError, match="should have"):
        Atlas.open(path)
    path.write_bytes(good[:20] + b"\7" + good[21:])
    with pytest.raises(AtlasError, match="version 7"):
        Atlas.open(path)
    with pytest.raises(FileNotFoundError):
        Atlas.open(tmp_path / "none.atlas")


def plain_tau(first, second):
    concordant = discordant = tied_first = tied_second = 0
    listed = zip(first.tolist(), second.tolist())
    for (a, b), (c, d) in itertools.combinations(listed, 2):
        sign = (a > c) - (a < c), (b > d) - (b < d)
        concordant += sign[0] * sign[1] > 0
        discordant += sign[0] * sign[1] < 0
        tied_first += sign[0] == 0
        tied_second += sign[1] == 0
    pairs = len(first) * (len(first) - 1) // 2
    if pairs in (tied_first, tied_second):
        return math.nan
    return (concordant - discordant) / math.sqrt((pairs - tied_first) * (pairs - tied_second))


@pytest.mark.parametrize("n, levels", [(2, 9), (3, 2), (40, 3), (64, 10**6), (65, 7), (100, 1)])
def test_kendall_tau(n, levels):
    draw = np.random.default_rng(n)
    for _ in range(5):
        first, second = (draw.integers(levels, size=n).astype(np.float32) for _ in range(2))
        first[0] = math.inf
        assert kendall_tau(first, second) == pytest.approx(plain_tau(first, second), nan_ok=True)


def test_compare(small, blocks, tmp_path):
    atlas = Atlas.open(small[0])
    same = atlas.compare(atlas)
    finite = int(np.isfinite(atlas.scores()).sum())
    assert same.bodies == len(atlas) and same.tau == pytest.approx(1)
    assert same.counts.sum() == finite == np.trace(same.counts)
    path, _, _ = made(tmp_path, 6, 6, 4, 5, 7)
    other = atlas.compare(Atlas.open(path), bins=5)
    first, second = atlas.scores(), Atlas.open(path).scores()[:len(atlas)]
    assert other.bodies == len(atlas) and other.tau == pytest.approx(plain_tau(first, second))
    assert other.counts.shape == (5, 5) and len(other.edges) == len(other.other_edges) == 6
    with pytest.raises(AtlasError, match="workspaces"):
        atlas.compare(Atlas.open(blocks[0]))


def test_the_atlases_that_come_with_morphod():
    """They are whole, belong to the default controller, and have the digests in the document."""
    data = pathlib.Path(__file__).resolve().parents[2] / "data"
    text = (data.parent / "docs" / "atlas.md").read_text(encoding="utf-8")
    controller = (data / "controllers" / "phototaxis-16ms.safetensors").read_bytes()
    files = sorted((data / "atlases").glob("*.atlas"))
    assert [file.stem for file in files] == [
        f"{task}-7" for task in ("circle", "photo", "rough", "shuttle", "up", "walk")]
    for file in files:
        content = file.read_bytes()
        assert f"`{hashlib.sha256(content).hexdigest()}`" in text and len(content) < 200_000
        atlas = Atlas.open(file, check=True)
        assert sum(atlas.sizes.values()) == 3822 and atlas.orientations == "canonical"
        assert atlas.header.controller_sha256 == hashlib.sha256(controller).hexdigest()
        best, n = atlas.score(int(atlas.best(1)[0])), len(atlas.optima())
        assert f"| `{file.name}` | {best:.4f} | {n} |" in text
