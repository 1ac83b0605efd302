"""The suite morpho-12: its table and its picture."""

import xml.etree.ElementTree

import morphod
import numpy as np
import pytest
from service import DESIGN

TASKS = ["photo", "photo-auc", "walk", "rough", "up", "down", "hurdle", "gap", "circle", "shuttle",
         "path", "damage"]
PHYSICS = {"n_steps": 60}


def test_a_table_with_a_column_for_each_task(m):
    before = len(m.jobs())
    table = m.suite([DESIGN, [[2, 2, 0], [3, 2, 0]]], physics=PHYSICS)
    assert len(m.jobs()) == before + 1
    assert list(table.columns) == [*TASKS, "mean_loss", "left_out"] and len(table) == 2
    evaluation = m.evaluate(list(table.index), "morpho-12", physics=PHYSICS, wait=False)
    evaluation.wait()
    assert evaluation.suite_table().equals(table)
    assert evaluation.losses.shape == (2, 120) and evaluation.robots == list(table.index)
    assert table["mean_loss"].to_numpy() == pytest.approx(evaluation.losses.mean(axis=1))
    assert table["walk"].to_numpy() == pytest.approx(evaluation.values[:, 20:30].mean(axis=1))
    found = m.evaluation(evaluation.id)
    assert found.suite_table().equals(table)
    del found.data["results"]  # as in a reply that would be too long
    assert found.suite_table().equals(table)


def test_what_has_no_value(m):
    table = m.evaluate([[[0, 0, 0], [3, 3, 3]], DESIGN], "morpho-12-held-out", physics=PHYSICS,
                       on_fault="skip").suite_table()
    assert np.isnan(table.iloc[0]["walk"]) and table.iloc[0]["left_out"] == tuple(TASKS)
    assert np.isfinite(table.iloc[1]["walk"]) and table.iloc[1]["left_out"] == ()
    plain = m.evaluate([DESIGN], physics=PHYSICS)
    with pytest.raises(morphod.MorphodError, match="not in a suite"):
        plain.suite_table()
    with pytest.raises(morphod.NotFoundError):
        plain.picture()


def test_the_picture_of_the_champions(m, campaign):
    champions = m.get_campaign(campaign[0])
    evaluation = champions.evaluate_champions(count=3)
    assert evaluation.data["environments"] == "morpho-12"
    assert evaluation.robots == list(champions.champions(3)["robot"])
    picture = evaluation.picture([2, 0], theme="dark", width=400)
    assert picture._repr_svg_() == picture
    drawn = xml.etree.ElementTree.fromstring(picture)
    assert drawn.get("width") == "400"
    assert len(drawn.findall("{http://www.w3.org/2000/svg}path")) == 2
    held = champions.evaluate_champions("morpho-12-walk-held-out", count=2, label="far", wait=False)
    held.wait()
    assert held.losses.shape == (2, 64) and held.label == "far"
