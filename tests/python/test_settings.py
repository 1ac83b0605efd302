"""Settings from NumPy, absent settings, and settings that a service corrects."""

import fractions
import types

import morphod
import numpy as np
import pytest
from service import DESIGN

HEIGHTS = np.linspace(0, 1.75, 64, dtype=np.float32).reshape(8, 8)


def test_settings_of_numpy(m):
    """NumPy scalars and arrays count as the numbers that they contain."""
    plain = m.evaluate([DESIGN], [{"light_xy_m": [4.5, 2.5],
                                   "terrain_heights_m": HEIGHTS.ravel().tolist()}],
                       physics={"n_steps": 20, "friction": 0.5}, best=1, weight=2.0)
    light = np.array([4.5, 2.5])
    for heights in (HEIGHTS, HEIGHTS.astype(np.float64).ravel(), HEIGHTS.tolist(),
                    tuple(map(tuple, HEIGHTS.tolist()))):
        other = m.evaluate(
            [DESIGN], [{"light_xy_m": light, "terrain_heights_m": heights}],
            physics={"n_steps": np.int64(20), "friction": np.float32(0.5)}, best=np.uint8(1),
            weight=np.float64(2), verify=np.bool_(False))
        assert other.scores == plain.scores and other.data["rollouts_cached"] == 1
        other = m.evaluate([DESIGN], [{"light_xy_m": light, "terrain_heights_m": heights}],
                           physics={"n_steps": np.int64(20)}, record=np.array(["com"]),
                           record_stride=np.int16(5))
        assert other.recording(np.int64(0), environment=np.int32(0), array="com").shape == (5, 3)
    scene = m.rollouts([DESIGN], [{"light_xy_m": light, "terrain_heights_m": HEIGHTS}],
                       physics={"n_steps": np.int64(20)})
    world = scene.environments[0]
    assert (world["terrain_heights_m"] == HEIGHTS).all()
    again = m.rollouts([DESIGN], [{name: world[name] for name in
                                   ("light_xy_m", "terrain_heights_m")}], physics={"n_steps": 20})
    assert again.scores == scene.scores
    assert (m.random_bodies(np.int64(3), seed=np.uint64(7)) == m.random_bodies(3, seed=7)).all()
    assert len(m.mutate([DESIGN], seed=np.int8(1), children=np.int64(2), rate=np.float32(0.1))) == 2
    group = m.campaign("zero-shot", population=np.int64(4), generations=np.int32(0),
                       seed=np.random.default_rng(1).integers(9), replicates=np.int64(2),
                       workspace=np.array([4, 4, 4]), exclude_pretraining=np.bool_(False),
                       mutation={"rate": np.float32(0.25)},
                       physics=types.MappingProxyType({"n_steps": np.int64(5)}))
    group.wait()
    settings = group[0].data["settings"]
    assert settings["workspace"] == [4, 4, 4] and settings["mutation"]["rate"] == 0.25
    with m.study("of numpy", population=np.int64(8), seed=np.int64(3),
                 physics={"n_steps": np.int64(5)}) as study:
        batch = study.tell(study.ask(np.int64(2)), measures={"x": np.array([1, 2])})
        study.tell([DESIGN["cells"]], parents=np.array([[0, 1]]), survivors=np.array([0]))
        assert m.study("of numpy", population=8, seed=3).id == study.id and len(batch) == 2


def test_none_is_absent(m):
    plain = m.evaluate([DESIGN], physics={"n_steps": 5})
    other = m.evaluate([DESIGN], physics={"n_steps": 5, "friction": None}, best=None, label=None,
                       repair=None, priority=None)
    assert other.scores == plain.scores
    assert (m.random_bodies(2, seed=None) == m.random_bodies(2, seed=1)).all()
    assert (m.mutate([DESIGN], seed=None, rate=None) == m.mutate([DESIGN])).all()
    world = {"light_xy_m": [4.5, 2.5], "terrain_heights_m": None, "terrain_sigma_m": 0.05,
             "seed": 7}
    assert len(m.rollouts([DESIGN], [world], physics={"n_steps": 20, "dt_s": None})) == 1
    group = m.campaign("zero-shot", preset="demo", population=4, generations=0, seed=None,
                       selection=None, mutation={"rate": None, "share": None}, experiment=None,
                       exclude_pretraining=False, physics={"n_steps": 5}, workspace=None)
    group.wait()
    assert group[0].data["settings"]["seed"] == 1
    job = m.evaluate([DESIGN], physics={"n_steps": 5}, label="a")
    job.edit(label=None)
    assert job.label is None


def test_what_cannot_be_sent_is_named(m):
    with pytest.raises(ValueError, match="/physics/friction: nan"):
        m.evaluate([DESIGN], physics={"friction": np.nan})
    heights = HEIGHTS.copy()
    heights[2, 3] = np.inf
    with pytest.raises(ValueError, match="/environments/0/terrain_heights_m/2/3: inf"):
        m.evaluate([DESIGN], [{"light_xy_m": [1, 1], "terrain_heights_m": heights}])
    with pytest.raises(TypeError, match="Fraction cannot be sent"):
        m.evaluate([DESIGN], physics={"friction": fractions.Fraction(1, 2)})


def test_founders_that_do_not_fit(m):
    cube = [[x, y, z] for x in range(3) for y in range(3) for z in range(3)]
    short = {"population": 4, "generations": 0, "exclude_pretraining": False,
             "physics": {"n_steps": 5}}
    parent = m.campaign("zero-shot", initial=[DESIGN["cells"], cube],
                        **short | {"population": 2})[0]
    parent.wait()
    with pytest.warns(UserWarning, match=f"{parent.id} has 1 design outside the workspace"):
        group = m.campaign("zero-shot", initial=parent, workspace=[3, 3, 2], **short)
    assert len(group[0].left_out) == 1
    with pytest.warns(UserWarning, match="1 design outside"):
        group = m.campaign("zero-shot", initial=parent, workspace=[3, 3, 2], replicates=2, **short)
    assert [len(member.left_out) for member in group] == [1, 1]
    with pytest.raises(morphod.InvalidError, match="/initial/campaign: no design of that campaign"):
        m.campaign("zero-shot", initial=parent, workspace=(1, 1, 1), **short)


def test_a_world_that_is_not_there(m):
    evaluation = m.evaluate([DESIGN], physics={"n_steps": 5})
    for show in (lambda: evaluation.show(environment=12), lambda: m.show([DESIGN], environment=12),
                 lambda: m.show([DESIGN], [{"light_xy_m": [1, 1], "terrain_sigma_m": 0, "seed": 1}],
                                environment=1)):
        with pytest.raises(morphod.MorphodError, match="there is no environment 1"):
            show()


def test_an_evaluation_in_a_notebook(m):
    evaluation = m.evaluate([DESIGN], physics={"n_steps": 5})
    assert evaluation[0].id in evaluation._repr_html_()


def test_a_sampler_that_was_not_saved(m):
    study = m.study("without a sampler", physics={"n_steps": 5})
    with pytest.raises(ValueError, match="'reach' is inf"):
        study.tell([DESIGN["cells"]], measures={"reach": [np.inf]})
    study.tell([DESIGN["cells"]])
    with pytest.raises(morphod.MorphodError, match="was sent without sampler_state"):
        study.restore()
    study.finish()


def test_recording_has_every_channel(m):
    evaluation = m.evaluate([DESIGN], [{"light_xy_m": [4.5, 2.5], "terrain_sigma_m": 0.05,
                                        "seed": 7}], physics={"n_steps": 20}, record_stride=5,
                            record=["com", "masses", "actuation", "contacts"])
    row = evaluation[0].data
    for array, kind, shape in (("com", "f4", (5, 3)), ("masses", "f4", (5, row["masses"], 3)),
                               ("actuation", "i1", (5, row["springs"])),
                               ("contacts", "u1", (5, row["masses"]))):
        found = evaluation.recording(0, array=array)
        assert found.dtype == np.dtype(kind) and found.shape == shape
        assert (found == evaluation.recordings(array)[0, 0].astype(kind)).all()
