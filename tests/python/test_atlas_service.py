"""Atlases of the service by the client, compared with the file."""

import asyncio
import math

import morphod
import morphod.atlas
import numpy as np
import pytest
from test_atlas import made


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return made(tmp_path_factory.mktemp("atlas"), 6, 6, 4, 4, 40)[0]


@pytest.fixture
def stored(m, path):
    atlas = m.put_atlas("invented", path)
    yield atlas
    atlas.delete()


def number(score):
    return math.inf if score is None else score


def test_put_list_open_delete(m, path, tmp_path):
    put = m.put_atlas("mine", path)
    assert put.name == "mine" and m.atlas("mine").data["bodies"] == 29 and "mine" in repr(put)
    assert "mine" in list(m.atlases()["name"])
    opened = put.open(tmp_path / "copy.atlas")
    assert (tmp_path / "copy.atlas").read_bytes() == path.read_bytes() and len(opened) == 29
    put.refresh()
    put.delete()
    with pytest.raises(morphod.NotFoundError):
        m.atlas("mine")
    (tmp_path / "bad.atlas").write_bytes(path.read_bytes()[:-8])
    with pytest.raises(morphod.ApiError):
        m.put_atlas("mine", tmp_path / "bad.atlas")


def test_queries_are_those_of_the_file(stored, path):
    atlas = morphod.atlas.Atlas.open(path)
    for position in (0, 5, 20, 28):
        body = stored.body(position)
        assert body["id"] == atlas.id(position) and body["position"] == position
        assert number(body["score"]) == pytest.approx(atlas.score(position))
        assert body["rank"] == atlas.rank(position).rank
        for given in (body["id"], body["genotype"], atlas.body(position), np.int64(position)):
            assert stored.body(given)["position"] == position
        for steps in (("add", ), ("add", "remove", "move")):
            assert [(one["position"], one["step"]) for one in stored.neighbors(position, steps)
                    ] == [(one.position, one.step) for one in atlas.neighbors(position, steps)]
            assert [one["position"] for one in stored.ascent(position, steps)] == atlas.ascend(
                position, steps)
        assert [(one["position"], one["distance"]) for one in stored.similar(position, limit=1000)
                ] == [(one.position, one.distance) for one in atlas.similar(position)]
    assert [one["position"] for one in stored.best(5, voxels=4)] == atlas.best(5, 4).tolist()
    changes = stored.body(3, steps="add", changes=1)["best_changes"]
    assert [one["step"] for one in changes] == ["add"]
    assert stored.optima()["optima"] == len(atlas.optima())
    assert {row["footprint"]: (row["bodies"], row["best"]["position"])
            for row in stored.footprints()} == atlas.footprints()
    histogram = stored.histogram(8, 4)
    assert sum(histogram["counts"][0]) + histogram["outside"][0] == atlas.sizes[4]
    assert stored.compare(stored)["kendall_tau"] == pytest.approx(1)


def test_build(m, path):
    job = m.build_atlas(2, orientations="canonical", name="tiny", physics={"n_steps": 20})
    assert job.live() is job and job.state == "succeeded"
    atlas = job.atlas()
    assert atlas.name == "tiny" and atlas.data["bodies"] == 3
    scores = m.evaluate([body["genotype"] for body in atlas.best(3)],
                        physics={"n_steps": 20}).scores
    assert [body["score"] for body in atlas.best(3)] == pytest.approx(scores.tolist(), rel=1e-6)
    atlas.delete()


def test_measures(m, tmp_path):
    """A built atlas has the means of an evaluation; the service and the file answer the same."""
    names = ["mean_speed_m_per_s", "displacement_m"]
    job = m.build_atlas(3, orientations="canonical", name="moving", physics={"n_steps": 40},
                        measures=names).live()
    atlas = job.atlas()
    assert atlas.data["measures"] == sorted(names)
    file = atlas.open(tmp_path / "moving.atlas")
    evaluation = m.evaluate([file.genotype(at) for at in range(8)], physics={"n_steps": 40},
                            measures=names)
    for name in names:
        means = evaluation.frame()[f"measures_{name}"]
        np.testing.assert_array_equal(file.all_measures(name), np.float32(means))
        assert [body["position"] for body in atlas.best(8, measure=name)] == file.best_by(
            name, 8).tolist()
        lowest = atlas.best(8, 3, measure=name, order="ascending")
        assert [body["position"] for body in lowest] == file.best_by(
            name, 8, 3, order="ascending").tolist()
        middle, score = (float(np.median(all)) for all in (file.all_measures(name), file.scores()))
        for ends in ({"lo": middle}, {"hi": middle}, {"score_lo": score},
                     {"hi": middle, "score_hi": score}):
            for order in ("descending", "ascending"):
                listed = atlas.best(8, measure=name, order=order, **ends)
                assert [body["position"] for body in listed] == file.best_by(
                    name, 8, order=order, **ends).tolist(), ends
        assert [body["position"] for body in atlas.best(8, lo=score)] == file.best(
            8, lo=score).tolist()
        body = atlas.body(5)
        assert np.float32(body["measures"][name]) == np.float32(file.measure(name, 5))
        assert body["of_size"]["measures"][name] == pytest.approx(
            file.measure_percentile(name, 5))
        histogram = atlas.histogram(4, 3, measure=name)
        assert sum(histogram["counts"][0]) == 5 and histogram["outside"] == [0]
        assert atlas.map(name)["kendall_tau"] == pytest.approx(file.map(name).tau)
    atlas.delete()


def test_for_asyncio(service, path):
    async def use():
        async with morphod.AsyncClient(f"http://{service.host}:{service.port}") as client:
            atlas = await client.put_atlas("async", path)
            best = await atlas.best(1)
            await atlas.delete()
            return best

    assert len(asyncio.run(use())) == 1


def test_zero_shot_scores_of_a_sample_are_those_of_the_atlas(m, tmp_path):
    """The example of docs/atlas.md."""
    world = {"environments": "paper-test", "physics": {"n_steps": 30}}
    job = m.build_atlas(4, orientations="canonical", name="sampled", **world)
    job.wait()
    atlas = job.atlas().open(tmp_path / "sampled.atlas")
    training = m.finetune(population=job.atlas().sample(5, seed=2), each=True, steps=1, batch=2,
                          **world)
    training.wait()
    table = training.each()
    places = training.data["sample"]["places"]
    assert table["place"].tolist() == places and places == sorted(set(places))
    positions = [int(position) for position in atlas.order()[places]]
    assert table["id"].tolist() == [atlas.id(position) for position in positions]
    scores = [atlas.score(position) for position in positions]
    assert table["zero_shot"].tolist() == pytest.approx(scores, rel=1e-6) and scores == sorted(
        scores)
