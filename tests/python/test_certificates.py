"""Certificates by the client: submission, progress, and the report as objects and tables."""

import asyncio
import csv
import io
import math

import morphod
import numpy as np
import pytest

SHORT = {"n_steps": 40}
SMALL = {"axes": ["step", "chance", "friction"], "chance": 3, "physics": SHORT}


@pytest.fixture(scope="module")
def certified(service):
    """A certificate that is complete."""
    with morphod.Client(f"http://{service.host}:{service.port}") as client:
        certificate = client.certify(client.random_bodies(5, seed=3), label="certified", **SMALL)
        assert isinstance(certificate, morphod.Certificate)
        certificate.wait()
        yield certificate


def test_report(m, certified):
    assert certified.state == "succeeded" and certified.label == "certified"
    assert certified._steps() == (5 * 10 * (1 + 2 + 3 + 4), ) * 2
    report = certified.report()
    assert report.complete and report.id == certified.id and report.verdict
    assert [level.name for level in report.levels] == [
        "base", "step 2", "step 4", "chance", "friction 0.7", "friction 0.9", "friction 1.1",
        "friction 1.3"]
    assert [level.precision for level in report.levels[:3]] == ["float32", "float64", "float64"]
    assert [level.environments for level in report.levels[2:5]] == [10, 30, 10]
    base = report.levels[0]
    assert all(math.isnan(number) for number in (base.level, base.tau, base.regret,
                                                 *base.tau_interval))
    assert all(-1 <= level.tau_interval[0] <= level.tau <= level.tau_interval[1] <= 1
               and level.regret >= 0 for level in report.levels[1:])
    again = m.evaluate([design.body for design in report.designs], physics=SHORT)
    for design, score in zip(report.designs, again.scores):
        assert design.levels[0].score == design.score == pytest.approx(score, abs=1e-6)
        assert design.interval[0] < design.score < design.interval[1] and design.verdict
        assert math.isnan(design.levels[0].change)
        for level in design.levels[1:]:
            assert level.change == pytest.approx(level.score - design.score, abs=1e-12)
            assert level.change_interval[0] <= level.change <= level.change_interval[1]
    ranks = [design.rank for design in report.designs]
    assert ranks == [1 + sum(other < score for other in again.scores) for score in again.scores]


def test_tables(certified):
    report = certified.report()
    table, levels = report.frame(), report.level_frame()
    assert len(table) == 5 * 8 and len(levels) == 8
    rows = list(csv.DictReader(io.StringIO(certified.csv())))
    for (_, row), line in zip(table.iterrows(), rows, strict=True):
        assert (row["design"], row["axis"], row["precision"], row["rank"], row["diverged"]) == (
            line["robot"], line["axis"], line["precision"], int(line["rank"]),
            int(line["diverged"]))
        for name, column in (("level", "level"), ("score", "score"), ("low", "score_low"),
                             ("high", "score_high"), ("change", "change"),
                             ("change_low", "change_low"), ("change_high", "change_high")):
            value = float(line[column]) if line[column] else math.nan
            assert row[name] == pytest.approx(value, nan_ok=True, rel=1e-12)
    assert levels["tau"].tolist() == pytest.approx([level.tau for level in report.levels],
                                                   nan_ok=True)
    assert set(table["certificate"]) == {certified.id}


def test_populations(m, campaign):
    certificate = m.certify(campaign=campaign[0], best=3, axes=["friction"], levels=[0.5])
    assert certificate.live() is certificate
    settings = certificate.data["certificate"]
    assert settings["designs"] == 3 and settings["physics"]["n_steps"] == 60
    assert set(settings["from_population"]) == {"controller", "environments", "physics"}
    assert settings["levels"] == [0.5]
    newest = m.get_campaign(campaign[0]).population()
    report = certificate.report()
    assert [design.robot for design in report.designs] == list(newest["robot"][:3])
    assert [level.level for level in report.levels[1:]] == [0.5]
    evaluation = m.evaluate(m.random_bodies(6, seed=4), physics=SHORT)
    certificate = m.certify(evaluation=evaluation, best=2, physics=SHORT, axes=["chance"],
                            chance=np.int64(2))
    certificate.wait()
    best = sorted(range(6), key=lambda place: evaluation.scores[place])[:2]
    assert [design.robot for design in certificate.report().designs] == [
        evaluation[place].robot for place in best]


def test_axes_that_do_not_apply(m):
    worlds = [{"task": "walk"}]
    report_of = m.certify([[[0, 0, 0], [1, 0, 0]]], environments=worlds, physics=SHORT,
                          axes=["held_out", "drop"], label="axes")
    report_of.wait()
    report = report_of.report()
    assert list(report.left_out) == ["held_out"] and report.left_out["held_out"]
    assert [level.axis for level in report.levels] == ["base", "drop", "drop"]
    assert m.certificates(label="axes")["id"].tolist() == [report_of.id]
    assert m.certificate(report_of.id).report().data == report.data


def test_refusals(m):
    body = [[0, 0, 0]]
    for given in {}, {"designs": [body], "campaign": 1}, {"campaign": 1, "evaluation": 2}:
        with pytest.raises(ValueError, match="one of designs, campaign and evaluation"):
            m.certify(**given)
    with pytest.raises(ValueError, match="best needs"):
        m.certify([body], best=3)
    with pytest.raises(morphod.InvalidError, match="/axes/0"):
        m.certify([body], axes=["luck"])
    with pytest.raises(morphod.InvalidError, match="/axes"):
        m.certify([body], axes="friction")
    with pytest.raises(morphod.InvalidError, match="/population/campaign"):
        m.certify(campaign=999999)
    with pytest.warns(UserWarning, match="without an orientation"):
        m.certify(["8" + "0" * 35], axes=["drop"], physics=SHORT).wait()


def test_no_report_yet(m):
    certificate = m.certify(m.random_bodies(200), weight=0.001)
    certificate.cancel()
    assert certificate.state == "cancelled"
    if certificate.data["certificate"]["trials_done"] == 0:
        with pytest.raises(morphod.ConflictError, match="no complete trial"):
            certificate.report()
    with pytest.raises(morphod.JobError, match="cancelled"):
        certificate.wait()


def test_for_asyncio(service):
    async def use():
        async with morphod.AsyncClient(f"http://{service.host}:{service.port}") as client:
            certificate = await client.certify([[[0, 0, 0]], [[0, 0, 0], [1, 0, 0]]],
                                               axes=["precision"], physics=SHORT)
            await certificate.wait()
            return await certificate.report()

    report = asyncio.run(use())
    assert [level.name for level in report.levels] == ["base", "precision 64"]
    assert "precision 64" in repr(report.levels[1]) and report.id in repr(report)
