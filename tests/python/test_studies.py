"""Studies: a custom search that the service stores."""

import asyncio
import pickle
import random
import signal

import morphod
import numpy as np
import pytest
from service import DESIGN

WORLD = [{"light_xy_m": [4.5, 2.5], "terrain_sigma_m": 0.05, "seed": 7}]
SHORT = {"environments": WORLD, "physics": {"n_steps": 12}}


class Climber:
    """Flips voxels of the best body, with a seed."""

    def __init__(self):
        self.random = random.Random(4)
        self.best, self.score = np.ones(144), np.inf

    def ask(self, n):
        self.asked = []
        for _ in range(n):
            vector = self.best.copy()
            for _ in range(12):
                place = self.random.randrange(144)
                vector[place] = 1 - vector[place]
            self.asked.append(vector)
        return self.asked

    def tell(self, scores):
        for vector, score in zip(self.asked, scores):
            if score < self.score:
                self.best, self.score = vector, score


def climb(m, name, batches, dies):
    """Climbs to the end of a study. Raises an exception where it is supposed to crash, and
    continues when it is called again."""
    with m.study(name, seed=9, **SHORT) as study:
        objective = study.objective()
        climber, known = Climber(), study.restore()
        if known is not None:
            climber = pickle.loads(known[0])
            climber.tell(objective.again(known[1]))
        while study.next_batch < batches:
            solutions = climber.ask(6)
            state = pickle.dumps(climber)
            dies(study.next_batch)
            climber.tell(objective(solutions, sampler_state=state))
    assert study.state == "succeeded"
    return study, climber


def test_a_search_continues_where_it_died(m, start, tmp_path):
    """Either side crashes, but the result is the same. The study is found by its name."""
    study, climber = climb(m, "undisturbed", 8, lambda batch: None)
    running, deaths = start(state=tmp_path / "state"), []

    def die(batch):
        if batch in (2, 5) and batch not in deaths:
            deaths.append(batch)
            raise KeyboardInterrupt

    for _ in range(3):
        client = morphod.Client(f"http://{running.host}:{running.port}")
        try:
            other, again = climb(client, "disturbed", 8, die)
        except KeyboardInterrupt:
            running.stop(signal.SIGKILL)
            running = start(state=tmp_path / "state")
    assert deaths == [2, 5] and again.score == climber.score < 1
    assert (again.best == climber.best).all()
    ours, theirs = study.phylogeny(), other.phylogeny()
    assert (ours.score == theirs.score).all() and ours.operators[-1] == "sampler"
    assert len(client.campaigns(label="disturbed")) == 1


def test_ask_tell_and_select(m):
    study = m.study("by hand", population=20, **SHORT)
    assert study.restore() is None
    asked = study.ask(6)
    batch = study.tell(asked, measures={"size": [len(body) for body in asked.bodies]})
    assert batch.number == 0 and batch.numbers == list(range(6)) and len(batch.frame()) == 6
    assert batch.losses.shape == (6, 1) and (batch.losses[:, 0] == batch.scores).all()
    best = [int(place) for place in np.argsort(batch.scores)[:2]]
    asked = study.ask(4, parents=best)
    assert {parent for parents in asked.parents for parent in parents} <= set(best)
    batch = study.tell([[], DESIGN["cells"], [[0, 0, 0], [1, 0, 0], [3, 0, 0]]], survivors=best,
                       parents=[[], best, best[:1]], operator=["a", "b", "c"], on_fault="skip",
                       repair="largest", measures={"size": [0, 4, np.nan], "own": [1, 2, 3]},
                       sampler_state=b"mine")
    assert batch.numbers == [None, 6, 7] and np.isnan(batch.scores[0]) and batch.bodies[0] is None
    assert [note["repaired"] for note in batch.notes] == [0, 1]
    same = m.study("by hand")
    assert same.id == study.id and same.next_batch == 2
    state, known = same.restore()
    assert state == b"mine" and known.data == batch.data
    assert set(study.population()["number"]) == {*best, 6, 7}
    assert study.population()["measures_own"].notna().sum() == 2
    history = study.phylogeny()
    table = history.frame()
    assert list(table["operator"][6:]) == ["b", "c"] and table["measures_size"][6] == 4
    assert np.isnan(history.measures["own"][:6]).all() and history.measures["own"][7] == 3
    with pytest.raises(morphod.ConflictError, match="different content"):
        study.next_batch = 1
        study.tell([DESIGN["cells"]])
    with pytest.raises(ValueError, match="2 for 1 children"):
        study.tell([DESIGN["cells"]], parents=[[], []])
    with pytest.raises(morphod.ConflictError, match="/population: got 30, but study .* has 20"):
        m.study("by hand", population=30)
    with pytest.raises(morphod.ConflictError, match="/physics/n_steps: got 500, .* has 12"):
        m.study("by hand", physics={"n_steps": 500})
    same.finish(survivors=[6])
    assert same.ended and list(same.population()["number"]) == [6]
    assert m.study("by hand", **SHORT).id != same.id


def test_objective_with_measures(m):
    with m.study("measured", **SHORT) as study:
        objective = study.objective(["voxels", morphod.Body.footprint], operator="ribs")
        scores, measures = objective(np.array([np.ones(144), np.zeros(144)]))
        assert scores[0] < 0 and scores[1] == -10 and measures.tolist() == [[144, 36], [0, 0]]
        assert objective.again(study.last())[1].tolist() == measures.tolist()
        with pytest.raises(ValueError, match="records no paths"):
            study.objective(["path_length_m"])
    assert study.phylogeny().measures["footprint"].tolist() == [36]


def test_own_scores(m):
    """The study ranks by what the client tells, and says so."""
    own = {"name": "speed_lost", "unit": "m/s"}
    with m.study("own", population=3, own_score=own, **SHORT) as study:
        assert study.own_score == own
        bars = [[[x, 2, 0] for x in range(1 + n)] for n in range(4)]
        with pytest.raises(ValueError, match="score is inf: leave the body out"):
            study.tell(bars, scores=[1, 2, float("inf"), 3])
        with pytest.raises(ValueError, match="score: 1 for 4 children"):
            study.tell(bars, scores=[1])
        with pytest.raises(morphod.InvalidError, match="/children/0/score"):
            study.tell(bars[:3])
        bodies = [bars[0], [], *bars[1:3]]
        batch = study.tell(bodies, scores=np.array([-1.5, np.nan, -0.5, -2.5]), on_fault="skip")
        assert batch.scores[[0, 2, 3]].tolist() == [-1.5, -0.5, -2.5] and np.isnan(batch.scores[1])
        assert (batch.losses[[0, 2, 3]] > 0).all()
        study.tell(bars[3:], scores=[-2.0])
        assert list(study.population()["score"]) == [-2.5, -2.0, -1.5]
        with pytest.raises(morphod.InvalidError, match="already has the score -2.5"):
            study.tell(bars[2:3], scores=[-2.25])
        with pytest.raises(ValueError, match="'speed_lost', which objective\\(\\) cannot compute"):
            study.objective()
    assert m.study("plain", **SHORT).own_score is None
    with pytest.raises(morphod.InvalidError, match="this study has no own_score"):
        m.study("plain").tell(bars[:1], scores=[1.0])
    with pytest.raises(morphod.ConflictError, match="/own_score: got"):
        m.study("plain", own_score=own)
    history = study.phylogeny()
    assert history.score.tolist() == [-1.5, -0.5, -2.5, -2.0] and history.own_score == own
    assert not history.lower_bound.any() and history.frame()["score"][2] == -2.5
    m.study("plain").tell(bars)
    with pytest.raises(morphod.MorphodError, match="settings for own_score .*not comparable"):
        m.compare_campaigns(study, m.study("plain"))


def test_for_asyncio(service):
    async def body():
        async with morphod.AsyncClient(f"http://{service.host}:{service.port}") as m:
            async with await m.study("concurrent", **SHORT) as study:
                batch = await study.tell(await study.ask(3))
                assert len(batch) == 3 and (await study.last()).data == batch.data
                assert np.isfinite(await study.objective()(np.ones(144)))
            assert study.ended

    asyncio.run(body())


def test_measures_of_the_service(m):
    """A study that names measures gets those of each rollout, by name; its tables have the
    means."""
    with m.study("measured", measures=["work_j", "displacement_m"], **SHORT) as study:
        batch = study.tell([DESIGN, [], DESIGN], on_fault="skip")
        assert list(batch.measures) == ["displacement_m", "work_j"]
        work = batch.measures["work_j"]
        assert work.shape == (3, 1) and work[0, 0] > 0 and np.isnan(work[1, 0])
        assert work[2, 0] == work[0, 0] and batch.losses.shape == (3, 1)
        found = m.evaluate([DESIGN], WORLD, physics=SHORT["physics"], measures=["work_j"])
        assert found.measures["work_j"][0, 0] == work[0, 0]
        assert study.population()["measures_work_j"].tolist() == [work[0, 0]] * 2
        assert study.phylogeny().frame()["measures_work_j"].tolist() == [work[0, 0]] * 2
    with m.study("plain", **SHORT) as study:
        assert study.tell([DESIGN]).measures == {}


def test_a_campaign_selects_by_a_measure(m):
    far = {"measure": "displacement_m", "direction": "max"}
    campaign, = m.campaign("zero-shot", population=4, generations=1, measures=["work_j"],
                           select_by=far, **SHORT)
    campaign.wait()
    table = campaign.champions(2)
    assert (table["score"] == -table["measures_displacement_m"]).all()
    assert (table["measures_work_j"] > 0).all()
    history = campaign.phylogeny()
    assert history.own_score == {"name": "-displacement_m", "unit": "m"}
    assert not history.lower_bound.any()
    assert np.allclose(history.score, -history.measures["displacement_m"])
    other, = m.campaign("zero-shot", population=4, generations=1, **SHORT)
    other.wait()
    with pytest.raises(morphod.MorphodError, match="own_score"):
        m.compare_campaigns(campaign, other)
