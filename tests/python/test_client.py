"""Scores, recordings and objectives through the package, and its connections."""

import json
import math
import re
import warnings

import morphod
import numpy as np
import pytest
from morphod.bodies import largest_pieces
from service import DESIGN
from workers import Workers

SHORT = {"n_steps": 20}
BAR = {"cells": [[0, 0, 0], [1, 0, 0]]}
ONE = {"cells": [[0, 0, 0]]}
WORLD = [{"light_xy_m": [4.5, 2.5], "terrain_sigma_m": 0.05, "seed": 7}]


def test_scores_are_those_of_the_service(m, service):
    evaluation = m.evaluate([DESIGN, np.ones((2, 1, 1), dtype=int)], physics=SHORT, label="mine")
    shown = service.get(f"/v1/evaluations/{evaluation.id}")
    assert evaluation.state == "succeeded" and evaluation.label == "mine" and len(evaluation) == 2
    assert evaluation.scores.tolist() == [row["score"] for row in shown["results"]]
    assert evaluation.losses.tolist() == [row["losses"] for row in shown["results"]]
    assert evaluation.ids == [row["id"] for row in shown["results"]]
    assert evaluation[1].body.footprint() == 2 and evaluation[1].lost == ()
    assert [result.score for result in evaluation] == evaluation.scores.tolist()
    table = evaluation.frame()
    assert list(table.columns) == ["id", "robot", "orientation", "genotype", "score",
                                   "lower_bound", "diverged", "voxels", "masses", "springs",
                                   "footprint", "repaired", "path_length_m", "fault",
                                   *(f"loss_{n}" for n in range(10))]
    assert table["loss_3"].tolist() == evaluation.losses[:, 3].tolist()
    again = m.evaluation(evaluation.id)
    assert (again.losses == evaluation.losses).all() and again[0].lost == ()


def test_values_of_tasks(m, tmp_path):
    """Entries of losses with tasks are objects: losses, values and units are read from them, in
    results, tables, batches of studies, scenes and players."""
    done = m.evaluate([BAR, ONE], [{"task": "walk"}, {"task": "climb"}],
                      physics={"n_steps": 200})
    assert done.losses.shape == done.values.shape == (2, 2) and done.units == ["m", "m"]
    assert done.values[:, 0] == pytest.approx(-np.log(done.losses[:, 0]))
    assert done[1].values == pytest.approx(done.values[1])
    assert done[1].losses == pytest.approx(done.losses[1])
    table = done.frame()
    assert list(table["value"]) == pytest.approx(list(done.values.mean(axis=1)))
    assert set(table["unit"]) == {"m"} and list(table["value_1"]) == list(done.values[:, 1])
    plain = m.evaluate([BAR], physics={"n_steps": 20})
    assert plain.values == pytest.approx(1 - plain.losses) and set(plain.units) == {""}
    assert "value" not in plain.frame()
    scene = m.rollouts([BAR], [{"task": "walk"}], physics={"n_steps": 200},
                       record=["masses"])
    assert scene[0].unit == "m" and scene[0].more["lights_m"].shape[1] == 3
    kinds = [morphod.Task.ahead(1.0), morphod.Task.turning(-1.0, distance_m=2),
             morphod.Task.path([(3, 2.5)], objective="climb"),
             morphod.Task.moving([4, 3], velocity_m_per_s=[0.1, 0]), morphod.Task.fixed("approach"),
             morphod.Task.ahead(objective={"travel": 1, "work_j": -2e-5}),
             morphod.Task.fixed("jump")]
    made = m.evaluate([ONE], [task.environment(**(
        {"light_xy_m": [4, 3]} if task["guide"]["kind"] == "fixed" else {})) for task in kinds],
        physics={"n_steps": 20})
    assert made.units == ["m", "m", "m", "", "", "", "m"] and np.isfinite(made.values).all()
    path = m.evaluate([ONE], [{"task": "path"}], physics={"n_steps": 200})
    path.show().save(tmp_path / "player.html")
    assert '"points": [[3.5, 2.5]' in (tmp_path / "player.html").read_text()


def test_grids_are_arrays(m, service):
    """The heights of a grid may be an array of rows; a player draws them."""
    heights = np.arange(12).reshape(3, 4) / 100
    world = {"task": "walk",
             "terrain": {"kind": "grid", "heights_m": heights, "spacing_m": np.float64(0.5)}}
    scored = m.evaluate([DESIGN], [world], physics=SHORT)
    known, = service.get(f"/v1/evaluations/{scored.id}/environments")["items"]
    assert known["terrain"] == {"kind": "grid", "heights_m": heights.tolist(), "spacing_m": 0.5}
    page = m.show([DESIGN], physics=SHORT, environments=[world]).html
    assert json.loads(re.search(r"const DATA=(.*);\n", page)[1])["worlds"][0]["columns"] == 4


def test_the_best_of_many(m):
    bodies = m.random_bodies(40, seed=8)
    whole = m.evaluate(bodies)
    raced = m.evaluate(bodies, best=3)
    exact = ~raced.lower_bound
    assert raced.data["best"] == 3 and not whole.lower_bound.any()
    assert exact[np.argsort(whole.scores)[:3]].all()
    assert (raced.scores[exact] == whole.scores[exact]).all()
    assert (raced.scores[~exact] > np.sort(whole.scores)[2]).all()
    assert raced.frame()["lower_bound"].tolist() == [result.lower_bound for result in raced]
    assert raced.lower_bound.any() and np.isnan(raced.losses[~exact]).any(axis=1).all()
    with pytest.raises(morphod.ApiError):
        m.evaluate(bodies, best=41)


def test_errors_of_scores(m, service):
    scored = m.evaluate([DESIGN, np.ones((2, 1, 1), dtype=int)], error=True, physics=SHORT)
    shown = service.get(f"/v1/evaluations/{scored.id}")["results"]
    for result, row in zip(scored, shown):
        assert isinstance(result.error, morphod.ScoreError) and result.error.data == row["error"]
        assert result.error.low <= result.score <= result.error.high
        assert result.error.bifurcates == tuple(row["error"]["bifurcates"])
    table = scored.frame()
    assert table["rounding"].tolist() == [row["error"]["rounding"] for row in shown]
    assert table["low"].tolist() == [result.error.low for result in scored]
    drawn = m.evaluate_random(3, seed=3, environments=WORLD, physics=SHORT, error=True)
    assert all(math.isnan(result.error.standard_error) for result in drawn)
    assert (drawn.table()["high"] >= drawn.scores).all()
    plain = m.evaluate([DESIGN], physics=SHORT)
    assert plain[0].error is None and "low" not in plain.frame()
    with pytest.raises(morphod.InvalidError, match="is supported only on CPUs"):
        m.evaluate([DESIGN], error=True, device="cuda")


def test_measures_of_rollouts(m, service):
    names = ["work_j", "displacement_m"]
    scored = m.evaluate([BAR, ONE], measures=names, physics=SHORT)
    shown = service.get(f"/v1/evaluations/{scored.id}")["results"]
    assert set(scored.measures) == set(names) and scored.losses.shape == (2, 10)
    for place, (result, row) in enumerate(zip(scored, shown)):
        assert result.measures == row["measures"] and result.flags == tuple(row["flags"])
        for name in names:
            values = [entry["measures"][name] for entry in row["losses"]]
            assert result.measured[name].tolist() == values
            assert scored.measures[name][place].tolist() == values
    table = scored.frame()
    assert table["measures_work_j"].tolist() == [row["measures"]["work_j"] for row in shown]
    assert table["flags"].tolist() == [tuple(row["flags"]) for row in shown]
    drawn = m.evaluate_random(3, seed=3, environments=WORLD, physics=SHORT, measures=True)
    assert len(drawn.measures) == 20 and (drawn.table()["measures_path_length_m"] >= 0).all()
    plain = m.evaluate([BAR, ONE], physics=SHORT)
    assert (plain.losses == scored.losses).all()
    assert plain.measures == {} == plain[0].measures == plain[0].measured
    assert plain[0].flags == () and "flags" not in plain.frame()
    with pytest.raises(morphod.InvalidError, match="inverted_voxels"):
        m.evaluate([BAR], measures=["speed"])
    with pytest.raises(morphod.MorphodError, match="array of names"):
        m.evaluate([BAR], measures="work_j")


def test_tolerances(m, service):
    scored = m.evaluate([DESIGN, np.ones((2, 1, 1), dtype=int)], tolerance=0.001, physics=SHORT)
    shown = service.get(f"/v1/evaluations/{scored.id}")["results"]
    for result, row in zip(scored, shown):
        seen = result.tolerance
        assert isinstance(seen, morphod.Climb) and seen.data == row["tolerance"]
        assert seen.reached and seen.asked == 0.001 >= seen.estimated_error and not seen.bifurcates
        assert (seen.dt_s, seen.precision) == (row["tolerance"]["dt_s"], "float32")
        assert seen.rungs[-1]["score"] == result.score
        assert result.error.data == row["error"]
    table = scored.frame()
    assert table["reached"].all() and table["dt_s"].tolist() == [0.002, 0.002]
    drawn = m.evaluate_random(3, seed=3, environments=WORLD, physics=SHORT, tolerance=0.001)
    assert drawn.table()["estimated_error"].max() <= 0.001
    plain = m.evaluate([DESIGN], physics=SHORT, error=True)
    assert plain[0].tolerance is None and "reached" not in plain.frame()
    skipped = m.evaluate([DESIGN, {"cells": [[9, 0, 0]]}], tolerance=0.001, physics=SHORT,
                         on_fault="skip")[1].tolerance
    assert not skipped.reached and math.isnan(skipped.estimated_error) and skipped.dt_s is None
    with pytest.raises(morphod.InvalidError, match="is supported only on CPUs"):
        m.evaluate([DESIGN], tolerance=0.001, device="cuda")


def test_diverged_rollouts_are_nan(m):
    wild = {"integrator": "paper", "n_steps": 200, "dt_s": 0.1, "control_period_s": 0.1}
    with pytest.warns(UserWarning, match="every rollout diverged"):
        evaluation = m.evaluate([DESIGN], WORLD, physics=wild)
    assert math.isnan(evaluation.scores[0]) and math.isnan(evaluation.losses[0, 0])
    assert evaluation.frame()["diverged"].tolist() == [1]
    objective = m.objective(environments=WORLD, physics=wild, worst=3.0)
    with pytest.warns(UserWarning, match="every rollout diverged"):
        assert objective(DESIGN["cells"]) == 3.0


def test_repair_is_reported(m):
    apart = [[0, 0, 0], [1, 0, 0], [4, 0, 0]]
    with pytest.raises(morphod.InvalidError) as caught:
        m.evaluate([apart])
    assert caught.value.status == 422 and "/designs/0" in str(caught.value)
    assert '"repair": "largest" keep' in str(caught.value)
    assert caught.value.faults and re.fullmatch("[0-9a-f]{16}", caught.value.request_id)
    evaluation = m.evaluate([apart], physics=SHORT, repair="largest")
    assert evaluation[0].lost == ("1 voxel that was not part of the largest piece", )
    assert evaluation[0].genotype.count("1") == 2


def test_faults_are_reported_per_design(m):
    """Whether a fault is found by the package or by the service, designs keep their positions, also
    in recordings and tables."""
    bodies = [np.ones((7, 1, 1)), [[0, 0, 0]], [[0, 0, 0], [4, 0, 0]], np.zeros((6, 6, 4)),
              "0" * 36]
    evaluation = m.evaluate(bodies, physics=SHORT, on_fault="skip", record=["com", "masses"])
    assert np.isnan(evaluation.scores).tolist() == [True, False, True, True, True]
    faults = [result.fault for result in evaluation]
    assert faults[1] is None and "axis 0 (x)" in faults[0] and "not connected" in faults[2]
    assert evaluation.frame()["voxels"].isna().tolist() == [True, False, True, True, True]
    for array in ("com", "masses"):
        recorded = evaluation.recordings(array)
        assert recorded.shape[:2] == (5, 10)
        own = np.stack([evaluation.recording(1, k, array) for k in range(10)])
        assert (recorded[1].astype(np.float32) == own).all()
        assert np.isnan(recorded[[0, 2, 3, 4]]).all()
    path = np.linalg.norm(np.diff(evaluation.recordings("com")[1], axis=1), axis=-1).sum(axis=1)
    shown = evaluation.frame()["path_length_m"]
    assert math.isclose(shown[1], path.mean(), rel_tol=1e-12) and shown.isna().sum() == 4
    with pytest.warns(UserWarning, match="body 0: skipped, the body is 7 .* axis 0 .x."):
        group = m.campaign("zero-shot", preset="demo", population=4, generations=0, physics=SHORT,
                           initial=bodies, on_fault="skip", repair="largest")
    assert [row["place"] for row in group[0].data["founders"]] == [0, 2, 3, 4]
    group.wait()


def test_what_a_result_does_not_show_is_a_warning(m):
    stiff = {"n_steps": 20, "stiffness_n_per_m": 1e6}
    with pytest.warns(UserWarning, match="job [0-9]+: every rollout diverged .10."):
        evaluation = m.evaluate([[[0, 0, 0]]], physics=stiff)
    assert np.isnan(evaluation.scores).all()
    assert len(evaluation.warnings) == 2 and "dt_s" in evaluation.warnings[0]
    assert repr(evaluation).endswith(": succeeded, all_diverged, unstable_step>")
    with pytest.warns(UserWarning, match="linear stability bound"):
        assert "linear stability bound" in m.rollouts([[[0, 0, 0]]], physics=stiff).warnings[0]
    with pytest.warns(UserWarning, match="no unseen bodies are left"):
        campaign = m.campaign("zero-shot", population=4, generations=5, workspace=[2, 1, 1],
                              physics={"n_steps": 20}, exclude_pretraining=False)
        campaign.wait()
    with pytest.warns(UserWarning, match="no unseen bodies are left"):
        campaign.live()
    with pytest.raises(morphod.JobError, match="in the first 2 steps, every robot diverged"):
        m.finetune([[[0, 0, 0]]], steps=2, batch=2, physics=stiff,
                   validation={"every_steps": 0}).wait()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert m.evaluate([[[0, 0, 0]]], physics={"n_steps": 20}).warnings == []


def test_what_is_lost_is_a_warning(m):
    """There is a warning only if the result has no place for the message; a `Body` has already
    reported it."""
    materials = np.zeros((2, 6, 6, 4), dtype=int)
    materials[:, 2:4, 2, 0] = [1, 3]
    for use in (m.canonical, m.mutate, lambda bodies: m.cross(bodies, [[[0, 0, 0]]] * 2),
                lambda bodies: m.rollouts(bodies, WORLD, physics=SHORT)):
        with pytest.warns(UserWarning, match="body 0: materials 1, 3 were merged .*and 1 more bod"):
            use(materials)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            use([morphod.Body.of(body) for body in materials])


def test_bodies_of_the_service(m):
    random = m.random_bodies(40, seed=3)
    assert random.shape == (40, 6, 6, 4) and (m.random_bodies(7, seed=3) == random[:7]).all()
    assert (m.random_bodies(5, seed=3, first=30) == random[30:35]).all()
    many = m.random_bodies(10_003, seed=3, first=7)  # several requests
    assert many.shape == (10_003, 6, 6, 4) and (many[:33] == random[7:]).all()
    assert (many[-3:] == m.random_bodies(3, seed=3, first=10_007)).all()
    for count, first in ((2, 999_999), (0, 0), (1, -1)):
        with pytest.raises(ValueError, match="a seed has bodies 0 to 999999"):
            m.random_bodies(count, first=first)
    ids = m.canonical(random)
    assert len(set(ids)) == 40 and m.canonical(random[:, ::-1]) == ids == m.canonical(ids)
    mutants = m.mutate(random, children=2, rate=0.01)
    assert mutants.shape == (80, 6, 6, 4) and not {*m.canonical(mutants)} & {*ids}
    children = m.cross(random[:-1], random[1:])
    assert len(m.canonical(children)) == 39 and not m.cross(random[:1], random[:1]).any()
    torn = np.random.default_rng(2).random((50, 6, 6, 4)) > 0.6
    scored = m.evaluate(torn, physics={"n_steps": 1}, repair="largest")
    assert scored.ids == m.canonical(largest_pieces(torn))  # the same piece as in the service


def test_random_designs(m):
    """An evaluation of random bodies equals one of a list of them."""
    short = {"n_steps": 5}
    listed = m.evaluate(m.random_bodies(30, seed=3, first=7), WORLD, physics=short)
    random = m.evaluate_random(30, seed=3, first=7, environments=WORLD, physics=short, best=2)
    assert random.ids == listed.ids and random.data["random"]["drawn"] == 30
    table = listed.table()
    assert list(table.number) == [*range(30)] and (table.score == listed.scores).all()
    best = random.table(whole=True)
    assert list(best.score[:2]) == sorted(listed.scores)[:2] and not best.lower_bound.any()
    many = m.evaluate_random(10_001, environments=WORLD[:1], physics={"n_steps": 1})
    assert len(many) == 10_001 and len(many.table()) == 10_001
    with pytest.raises(morphod.MorphodError, match="use table.. to read"):
        many.scores
    sent = m.evaluate(m.random_bodies(10_001), WORLD[:1], physics={"n_steps": 1})
    assert len(sent) == 10_001 and (sent.table().score == many.table().score).all()
    soft = [[3, 3], [0, 1]]  # materials of EvoGym, which are merged
    with pytest.warns(UserWarning, match="body 0: .*and 10000 more bodies"):
        m.evaluate([morphod.Body.evogym(soft)] * 10_001, WORLD[:1], physics={"n_steps": 1})


def test_recordings(m, service):
    bodies = [DESIGN, {"cells": [[0, 0, 0]]}]
    worlds = WORLD + [{**WORLD[0], "seed": 8}]
    evaluation = m.evaluate(bodies, worlds, physics=SHORT, record=["com", "masses"],
                            record_stride=5)
    path = f"/v1/evaluations/{evaluation.id}/trajectories/0?environment=1"
    shown = service.get(path)
    masses = evaluation.recording(0, environment=1)
    assert masses.tolist() == np.asarray(shown["masses_m"], dtype=np.float32).tolist()
    com = evaluation.recordings("com")
    assert com.shape == (2, 2, 5, 3)
    assert com[0, 1].tolist() == shown["com_m"]
    both = evaluation.recordings("masses")
    assert both.shape == (2, 2, 5, 20, 3) and (both[0, 1] == masses).all()
    assert (both[1, 0, :, :8] == evaluation.recording(1)).all()
    assert np.isnan(both[1, :, :, 8:]).all()
    with pytest.raises(morphod.NotFoundError):
        evaluation.recordings("contacts")
    with pytest.raises(morphod.NotFoundError):
        evaluation.recording(2)


def test_rollouts_are_stored_nowhere(m, service):
    before = len(m.jobs())
    scene = m.rollouts([DESIGN], WORLD, physics=SHORT, record=["masses", "com"])
    assert len(m.jobs()) == before
    stored = m.evaluate([DESIGN], WORLD, physics=SHORT, record=["masses"])
    assert scene.scores.tolist() == stored.scores.tolist()
    assert (scene[0].masses_m == stored.recording(0)).all() and len(scene[0].com_m) == 3
    assert scene.frame_s == pytest.approx(0.02) and len(scene) == 1
    with pytest.raises(ValueError):
        scene[0].masses_m[:] = 0  # a view into the reply


def test_rollouts_continue_from_states(m):
    """Two windows are one rollout, and a light that moves between them changes the second."""
    def window(n_steps, light=4.5, **more):
        world = WORLD[0] | {"light_xy_m": [light, 2.5]}
        return m.rollouts([DESIGN, BAR], [world], physics={"n_steps": n_steps}, record_stride=1,
                          final_states=True, **more)

    whole, first = window(100), window(37)
    second = window(63, states=first.states)
    for one, two, three in zip(whole, first, second):
        assert (one.masses_m == np.concatenate([two.masses_m, three.masses_m[1:]])).all()
        assert (one.loss, one.state) == (three.loss, three.state) and one.more == {}
    moved = window(63, 0.5, states=first.states)
    assert moved[0].state["positions_m"] != second[0].state["positions_m"]
    with pytest.raises(morphod.InvalidError, match="one for each rollout"):
        window(1, states=first.states[:1])
    assert m.rollouts([DESIGN], WORLD, physics=SHORT).states == [None]


def test_players_are_one_file(m, tmp_path):
    player = m.evaluate([DESIGN], WORLD, physics=SHORT).show()
    player.save(tmp_path / "player.html")
    with pytest.raises(ValueError, match="name it .html"):
        player.save(tmp_path / "player.mp4")
    assert [path.name for path in tmp_path.iterdir()] == ["player.html"]
    page = (tmp_path / "player.html").read_text()
    assert "const DATA=" in page and "class Stage" in page and "bodyOf(" in page
    # The page loads nothing from elsewhere.
    assert not re.search(r"\bimport\b[^(\n]*from|https?://|src=|fetch\(", page)
    data = json.loads(re.search(r"const DATA=(.*);\n", page)[1])
    assert data["robots"][0]["frames"] == 3 and len(data["worlds"][0]["heights"]) == 64
    assert player._repr_html_().startswith("<iframe srcdoc=")
    assert "Two &lt;robots&gt;" in m.show([DESIGN, DESIGN], physics=SHORT, environment=3,
                                          title="Two <robots>").html


def test_objectives(m):
    settings = {"environments": WORLD, "physics": SHORT}
    vectors = np.random.default_rng(3).random((4, 144))
    vectors[2] = 0
    losses = m.objective(**settings)(vectors)
    assert losses.shape == (4, ) and losses[2] == 10
    bodies = [morphod.Body.of(vector.reshape(6, 6, 4) > 0.5, "largest") for vector in vectors
              if vector.any()]
    assert losses[[0, 1, 3]].tolist() == m.evaluate(bodies, **settings).scores.tolist()
    asked = ["voxels", "height", "path_length_m", morphod.Body.footprint]
    quality, measures = m.objective(asked, **settings)(vectors)
    assert quality.tolist() == (-losses).tolist() and measures.shape == (4, 4)
    assert measures[[0, 1, 3], 0].tolist() == [len(body) for body in bodies]
    assert measures[2].tolist() == [0, 0, 0, 0] and (measures[[0, 1, 3], 2] > 0).all()
    one = m.objective(decode=lambda n: [[0, 0, 0], [int(n[0]) % 2, 0, 1 - int(n[0]) % 2]],
                      **settings)
    assert isinstance(one(np.array([3.0])), float)
    assert one(np.array([[1.0], [2], [4]])).shape == (3, )
    with pytest.raises(ValueError, match="must be a function or one of"):
        m.objective(["weight"])


def test_tokens_and_addresses(start, monkeypatch, tmp_path):
    token = tmp_path / "token"
    token.write_text("t" * 40)
    token.chmod(0o600)
    service = start(f"--token-file={token}", "--token-on-loopback=yes", token="t" * 40)
    url = f"http://{service.host}:{service.port}"
    with morphod.Client(url) as client, pytest.raises(morphod.AccessError):
        client.jobs()
    with morphod.Client(url, token="t" * 40) as client:
        assert client.jobs().empty
    monkeypatch.setenv("MORPHOD_SERVER", url)
    monkeypatch.setenv("MORPHOD_TOKEN", "t" * 40)
    with morphod.Client() as client:
        assert client.jobs().empty and url in repr(client)
    with pytest.raises(morphod.MorphodError, match="unix:/path"):
        morphod.Client("ftp://x")
    with morphod.Client("http://127.0.0.1:1", retry_s=0) as client, pytest.raises(
            morphod.UnreachableError, match="is the service running"):
        client.jobs()


def test_fleet(start):
    """Workers on other machines: their status, and actions on them."""
    workers = Workers(start("--fleet-listen=127.0.0.1:0"))
    session = workers.join(name="a node").rsplit("/", 1)[1]
    m = morphod.Client(workers.service.addresses[0])
    fleet = m.fleet()
    assert repr(fleet) == "<1 worker with 1 thread and 0 GPUs, 0 rollouts/s>"
    row = fleet.sessions.iloc[0]
    assert (row["id"], row["name"], row["state"]) == (session, "a node", "active")
    assert row["classes_cpu_scores"] == fleet.data["classes"]["cpu"]["scores"]
    fleet.drain(session, upgrade=True)
    row = fleet.refresh().sessions.iloc[0]
    assert row["state"] == "draining" and row["why"].startswith("to upgrade to version ")
    with pytest.raises(morphod.NotFoundError):
        fleet.drain("1")
