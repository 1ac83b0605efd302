"""Robots: a design in one orientation, ID@K, to which a score belongs."""

import numpy as np
import pytest

import morphod

QUICK = {"n_steps": 30}


def images(voxels):
    """Returns the 8 images of a body in the workspace, which is square."""
    for k in range(8):
        turned = voxels.swapaxes(0, 1) if k & 4 else voxels
        yield turned[::-1 if k & 1 else 1, ::-1 if k & 2 else 1]


def test_robots_have_their_scores(m):
    bodies = np.array([image for body in m.random_bodies(6, seed=8) for image in images(body)])
    scored = m.evaluate(bodies, physics=QUICK)
    again = m.evaluate(scored.robots, physics=QUICK)
    assert again.robots == scored.robots and again.ids == scored.ids
    assert again.scores.tolist() == scored.scores.tolist()
    assert [row.genotype for row in again] == [row.genotype for row in scored]
    assert all(row.orientation is None for row in again)
    # A robot that is passed as a body is that robot in the service.
    made = m.evaluate([morphod.Body.of(robot) for robot in scored.robots], physics=QUICK)
    assert made.robots == scored.robots
    assert scored.frame()["robot"].tolist() == scored.robots
    # An id without an orientation is the best of its orientations: the first of the 8 images with
    # that score.
    alone = m.evaluate(scored.ids[::8], physics=QUICK)
    for place, row in enumerate(alone):
        eight = [other for other in scored if other.id == row.id]
        best = min(eight, key=lambda other: (other.score, other.robot))
        assert (row.robot, row.score, row.orientation) == (best.robot, best.score, "best")
    [row] = m.evaluate(scored.ids[:1], physics={"n_steps": 31})
    assert row.robot == row.id + "@0" and row.orientation == "canonical"


def test_what_takes_a_robot(m):
    [row] = m.evaluate([[[0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 1, 1]]], physics=QUICK)
    genotype = morphod.Body.of(row.genotype)
    assert m.mutate([row.robot], seed=4).tolist() == m.mutate([genotype], seed=4).tolist()
    assert m.rollouts([row.robot], physics=QUICK).designs[0]["genotype"] == row.genotype
    assert m.canonical([row.robot, "d" + row.robot]) == [row.id] * 2
    objects = m.evaluate([{"id": row.robot}, {"id": row.id}], physics=QUICK)
    assert objects.robots == [row.robot] * 2
    assert [one.orientation for one in objects] == [None, "best"]
    for wrong in ("@8", "@", "@00", "@-1"):
        with pytest.raises(morphod.BodyError):
            morphod.Body.of(row.id + wrong)


def test_ids_without_an_orientation_warn_if_there_is_no_result(m):
    # No test draws this body at random: the shared daemon has only the score of this evaluation.
    corner = [[x, 0, 0] for x in range(6)] + [[5, y, 0] for y in range(1, 6)]
    [row] = m.evaluate([corner], physics=QUICK)
    short = {"population": 2, "generations": 0, "physics": QUICK, "exclude_pretraining": False}
    with pytest.warns(UserWarning, match=f"without an orientation: using {row.robot}"):
        m.campaign("zero-shot", initial=[row.id], **short)
    with pytest.warns(UserWarning, match=f"using {row.id}@0, the canonical orientation"):
        m.finetune([row.id], steps=1, batch=1, physics={"n_steps": 5}).cancel()


def test_a_campaign_prints_its_robots(m, campaign):
    best = m.get_campaign(campaign[0]).population().head(3)
    scored = m.evaluate(best["robot"].tolist(), physics={"n_steps": 60})
    assert scored.scores.tolist() == best["score"].tolist()
    assert scored.ids == best["id"].tolist()
