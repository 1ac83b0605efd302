"""Comparisons in Python return the same numbers and refusals as morphoctl."""

import json
import math

import morphod
import numpy as np
import pytest
from ctl import ctl  # noqa: F401
from morphod.comparisons import crossed, student_quantile, welch

SMALL = {"population": 6, "generations": 2, "physics": {"n_steps": 20},
         "exclude_pretraining": False,
         "environments": [{"light_xy_m": [4.0, 3.0], "terrain_sigma_m": 0.05, "seed": 3}]}


def alike(own, other):
    """Compares with the JSON of morphoctl, where null stands for NaN."""
    if isinstance(own, dict):
        assert set(own) >= set(other), (own, other)
        for name in other:
            alike(own[name], other[name])
    elif isinstance(own, list):
        assert len(own) == len(other)
        for one, another in zip(own, other):
            alike(one, another)
    elif isinstance(own, float):
        assert math.isnan(own) if other is None else own == pytest.approx(other, rel=1e-12)
    else:
        assert own == other


def test_campaigns(m, ctl):  # noqa: F811
    a, b = (m.campaign("zero-shot", **SMALL, replicates=3, seed=seed, experiment="pair",
                       **more) for seed, more in ((1, {}), (11, {"mutation": {"rate": 0.1}})))
    for group in (a, b):
        group.wait()
    b[2].extend(1000)
    b[2].cancel()
    found = m.compare_campaigns(a[1], b[0].id)
    alike(found.data, json.loads(ctl(f"campaign compare {a[1].id} {b[0].id} --json")[1]))
    assert found.generation == 2 and [len(side["replicates"]) for side in found.sides] == [3, 2]
    assert found.sides[1]["left_out"] == [{"id": b[2].id, "state": "cancelled"}]
    text = repr(found)
    assert f"campaign {b[2].id}, a replicate of {b[0].id}, is left out: cancelled" in text
    assert f"campaign {b[0].id} differs in settings.mutation.rate: 0.1, not " in text
    assert "confidence" in text.splitlines()[-1]
    table = found.frame()
    assert table["runs"].tolist() == [3, 2]
    assert table["differs_in"].tolist() == ["", "settings.mutation.rate"]
    grouped = m.compare_campaigns(m.campaigns(experiment="pair"))
    assert {side["campaign"] for side in grouped.sides} == {a[0].id, b[0].id}
    a[2].edit(archived=True)
    assert m.compare_campaigns(a[1], b[0].id).data == found.data
    alone = m.compare_campaigns(a[0], a[1])
    assert math.isnan(alone.sides[1]["low"]) and "at least two replicates" in repr(alone)
    for campaigns in ([a], [a[0]], [m.campaigns(experiment="no such")]):
        with pytest.raises(morphod.MorphodError, match="at least two campaigns"):
            m.compare_campaigns(*campaigns)
    with pytest.raises(morphod.MorphodError, match=f"campaign {a[1].id} is given twice"):
        m.compare_campaigns(a[1], b, int(a[1].id))
    with pytest.raises(morphod.NotFoundError):
        m.compare_campaigns(a[0], 10**9)


def test_campaigns_that_do_not_compare(m):
    first = m.campaign("zero-shot", **SMALL)[0]
    elsewhere = [{"light_xy_m": [1, 1], "terrain_sigma_m": 0, "seed": 1}]
    for more, words in (({"physics": {"n_steps": 21}}, r"differ in physics.n_steps \(20, 21\)"),
                        ({"environments": elsewhere}, "are in different environments"),
                        ({"aggregate": {"kind": "cvar", "level": 0.5}},
                         r"settings for settings.aggregate.kind \(\"mean\", \"cvar\"\)")):
        other = m.campaign("zero-shot", **{**SMALL, **more})[0]
        with pytest.raises(morphod.MorphodError, match=words):
            m.compare_campaigns(first, other)
    long = {**SMALL, "population": 64, "physics": {"n_steps": 20000}}
    begun = [m.campaign("zero-shot", **long, seed=seed)[0] for seed in (1, 2)]
    with pytest.raises(morphod.MorphodError, match="no complete generation yet"):
        m.compare_campaigns(*begun)
    for one in begun:
        one.cancel()


def test_controllers(m, ctl):  # noqa: F811
    physics, size = {"n_steps": 40}, {"designs": 6, "environments": 3}
    training = m.pretrain(name="compared", steps=2, batch=4, physics=physics,
                          validation={"designs": 2, "environments": 1})
    with pytest.raises(morphod.MorphodError, match="has no controller yet"):
        m.compare_controllers("default", training)
    training.wait()
    found = m.compare_controllers("default", training, physics=physics, **size)
    status, out, err = ctl("train compare default compared --designs 6 --environments 3 "
                           "--physics n_steps=40 --json")
    assert status == 0, err
    alike({**found.data, "a": {**found.data["a"], "evaluation": None},
           "b": {**found.data["b"], "evaluation": None}},
          {**json.loads(out), "a": {**json.loads(out)["a"], "evaluation": None},
           "b": {**json.loads(out)["b"], "evaluation": None}})
    assert found.pairs == 6 and found.low < found.difference < found.high
    assert "compared" in repr(found) and "default" in repr(found)
    bodies, worlds = m.held_out(**size)
    whole = m.evaluate(bodies, worlds, controller="default", physics=physics)
    assert found.data["a"]["mean_score"] == pytest.approx(whole.scores.mean(), rel=1e-12)
    before = len(m.jobs())
    with pytest.raises(morphod.NotFoundError):
        m.compare_controllers("default", "no-such", **size)
    same = training.data["controller"]["sha256"]
    with pytest.raises(morphod.MorphodError, match="are the same controller"):
        m.compare_controllers(training, f"sha256:{same}", **size)
    assert len(m.jobs()) == before, "both names are checked first"


def test_controllers_whose_trainings_differ(m):
    size = {"designs": 6, "environments": 3}
    common = {"steps": 1, "validation": {"every_steps": 0}}
    first = m.pretrain(name="first", batch=4, physics={"n_steps": 40}, **common)
    second = m.pretrain(name="second", batch=2, seed=7, physics={"n_steps": 30, "integrator":
                                                                 "paper"}, **common)
    first.wait()
    second.wait()
    found = m.compare_controllers(first, "second", physics={"n_steps": 40}, **size)
    differences = {one["setting"]: one["values"] for one in found.differences}
    assert differences["settings.batch"] == [4, 2], differences
    assert differences["settings.physics.n_steps"] == [40, 30]
    assert differences["settings.physics.integrator"] == ["split", "paper"]
    assert "seed" not in differences and len(differences) == 3, differences
    assert "second differs in settings.batch: 2, not 4\n" in repr(found)
    found = m.compare_controllers("default", "second", physics={"n_steps": 40}, **size)
    assert [found.data[side]["training_known"] for side in "ab"] == [False, True]
    assert "not known: how default was trained\n" in repr(found)


def test_intervals():
    """Known quantiles, and the paired t interval that remains if all environments are alike."""
    for p, freedom, t in ((0.975, 1, math.tan(0.475 * math.pi)), (0.5, 7, 0),
                          (0.975, 2, 0.95 * (2 / (1 - 0.95**2))**0.5),
                          (0.975, 3, 3.182446305284263)):
        assert student_quantile(p, freedom) == pytest.approx(t, rel=1e-12)
    a = np.array([2.0, 4.0, 6.0, 1.0, np.nan])[:, None] * np.ones(2)
    b = np.array([1.0, 2.0, 3.0, 1.0, 0.5])[:, None] * np.ones(2)
    found = crossed(a, b)
    half = 3.182446305284263 * (5 / 3 / 4)**0.5
    assert (found["pairs"], found["difference"], found["improved"]) == (4, -1.5, 3)
    assert found["high"] == pytest.approx(half - 1.5, rel=1e-12)
    assert found["verdict"] == "undecided" and found["sign_test_p"] == pytest.approx(0.25)
    assert crossed(a[:1], b[:1])["verdict"] == "undecided"
    assert welch([1, 1], [1, 1])["low"] == 0 and math.isnan(welch([1], [1, 2])["low"])
    assert welch([1.0, 1.1], [2.0, 2.1])["verdict"] == "worse"
