"""The benchmark for search and the statistics of a landscape, against plain programs."""

import csv
import math
import re
import subprocess
import sys

import numpy as np
import pytest
from morphod.atlas import (
    Atlas,
    BudgetError,
    Measures,
    OutsideError,
    Problem,
    landscape,
)
from morphod.bodies import largest_pieces, voxels_of
from test_atlas import ANSWERS

SOURCE = ANSWERS.parents[4]


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    path = tmp_path_factory.mktemp("atlas") / "a.atlas"
    subprocess.run([ANSWERS, path, "6", "6", "4", "5", "30"], check=True, capture_output=True)
    return path


@pytest.fixture(scope="module")
def atlas(path):
    return Atlas.open(path)


# ---- the problem ----

def test_evaluations_are_counted(atlas):
    problem = Problem(atlas)
    assert math.isinf(problem.regret) and problem.best is None
    losses = [problem.evaluate(atlas.genotype(at)) for at in (5, 9, 5)]
    assert losses == [atlas.score(at) for at in (5, 9, 5)] and problem(atlas.id(9)) == losses[1]
    assert (problem.evaluations, problem.distinct, problem.outside) == (4, 2, 0)
    assert problem.best_loss == min(losses) and atlas.score(problem.best) == min(losses)
    assert problem.regret == min(losses) - atlas.score(int(atlas.best()[0]))
    assert problem.evaluate(atlas.genotype(problem.optimum)) == problem.optimum_loss
    assert problem.regret == 0 and problem.best == problem.optimum
    problem.reset()
    assert problem.evaluations == problem.distinct == 0 and problem.improvements == []


def test_bodies_outside_are_never_repaired(atlas):
    problem = Problem(atlas)
    too_large, loose = np.zeros((2, 6, 6, 4), dtype=bool)
    too_large[:6, 0, 0] = loose[0, 0, 0] = loose[2, 0, 0] = True
    assert math.isinf(problem.evaluate(too_large)) and math.isinf(problem.evaluate(loose))
    assert np.isinf(problem.evaluate_all(np.stack([too_large, loose]))).all()
    assert (problem.evaluations, problem.outside, problem.distinct) == (4, 4, 0)
    assert problem.best is None and np.isinf(problem.regrets([0, 4])).all()
    strict = Problem(atlas, outside="raise")
    with pytest.raises(OutsideError):
        strict.evaluate(loose)
    with pytest.raises(OutsideError, match="6 voxels"):
        strict.evaluate_all(np.stack([voxels_of([atlas.genotype(3)])[0], too_large]))
    assert strict.evaluations == 3
    with pytest.raises(ValueError, match="outside must be"):
        Problem(atlas, outside="repair")


def test_many_are_as_one_by_one(atlas):
    draw = np.random.default_rng(3)
    one, many, listed = Problem(atlas), Problem(atlas), Problem(atlas)
    for n in (1, 7, 40):
        texts = [one.random(draw) for _ in range(n)]
        losses = [one.evaluate(text) for text in texts]
        assert many.evaluate_all(voxels_of(texts)).tolist() == losses
        assert listed.evaluate_all(texts).tolist() == losses
    for other in (many, listed):
        assert other.improvements == one.improvements and other.best == one.best
        assert other.distinct == one.distinct and other.evaluations == 48
    at = [n for n in range(50)]
    regrets = one.regrets(at)
    for n in at:
        known = [loss for place, loss in one.improvements if place <= n]
        assert regrets[n] == min(known, default=math.inf) - one.optimum_loss


def test_budget(atlas):
    problem = Problem(atlas, budget=3)
    problem.evaluate_all([atlas.genotype(1)] * 2)
    with pytest.raises(BudgetError, match="budget of 3 evaluations is exhausted: 2 were used"):
        problem.evaluate_all([atlas.genotype(1)] * 2)
    problem.evaluate(atlas.genotype(1))
    with pytest.raises(BudgetError):
        problem.evaluate(atlas.genotype(1))
    assert problem.evaluations == 3


def test_random_bodies_are_uniform(atlas):
    problem = Problem(atlas)
    draw = np.random.default_rng(1)
    drawn = [atlas.find(problem.random(draw)) for _ in range(124 * 40)]
    counts = np.bincount(drawn, minlength=len(atlas))
    assert len(atlas) == 124 and counts.min() >= 15 and counts.max() <= 75


def grown(values, most):
    """The body of a vector by the definition."""
    values = values.reshape(6, 6, 4)
    body = [tuple(int(at) for at in np.unravel_index(values.argmax(), values.shape))]
    while len(body) < most:
        near = {tuple(np.add(cell, step)) for cell in body
                for step in [*np.eye(3, dtype=int), *-np.eye(3, dtype=int)]}
        free = [cell for cell in near - set(body)
                if all(0 <= at < side for at, side in zip(cell, values.shape))]
        best = max(free, key=lambda cell: values[cell])
        if values[best] <= 0:
            break
        body.append(tuple(int(at) for at in best))
    return set(body)


def test_decode(atlas):
    problem = Problem(atlas)
    draw = np.random.default_rng(5)
    sizes = set()
    for shift in np.linspace(-1.5, 1.5, 60):
        values = draw.normal(shift, size=problem.dimensions)
        voxels = voxels_of([problem.decode(values)])[0]
        assert set(map(tuple, np.argwhere(voxels).tolist())) == grown(values, 5)
        sizes.add(int(voxels.sum()))
        assert atlas.find(voxels) >= 0
    assert len(sizes) > 3
    for position in range(len(atlas)):  # every body has a vector
        voxels = voxels_of([atlas.genotype(position)])[0]
        assert atlas.find(problem.decode(np.where(voxels, 1.0, -1.0))) == position
    for wrong in (np.zeros(143), np.full(144, np.nan)):
        with pytest.raises(ValueError, match="144 numbers"):
            problem.decode(wrong)


def test_measures(atlas):
    problem = Problem(atlas)
    for position in range(len(atlas)):
        voxels = voxels_of([atlas.genotype(position)])[0]
        assert problem.measures(position) == Measures(
            int(voxels.sum()), int(voxels.any(axis=2).sum()),
            int(voxels.any(axis=(0, 1)).sum()))
    assert problem.evaluations == 0


# ---- the landscape ----

def plain_graph(atlas):
    return [[neighbor.position for neighbor in atlas.neighbors(at)] for at in range(len(atlas))]


def test_autocorrelation_is_that_of_walks(atlas):
    """Compared with the chain's matrix, without the bodies that diverged."""
    scores = atlas.scores().astype(float)
    finite = np.isfinite(scores)
    assert 0 < (~finite).sum() < 10
    n = len(atlas)
    edges = np.zeros((n, n))
    for at, neighbors in enumerate(plain_graph(atlas)):
        for near in neighbors:
            edges[at, near] = finite[at] and finite[near]
    degree = edges.sum(axis=1)
    weight = degree / degree.sum()
    walk = edges / np.maximum(degree, 1)[:, np.newaxis]
    sizes = np.repeat(list(atlas.sizes), list(atlas.sizes.values()))
    found = landscape(atlas)
    for values, correlations in ((scores, found.autocorrelation),
                                 (scores - np.array([scores[finite & (sizes == size)].mean()
                                                     for size in sizes]), found.within_sizes)):
        values = np.where(finite, values, 0)
        centered = values - weight @ values
        later = centered
        for correlation in correlations:
            assert correlation == pytest.approx(weight @ (centered * later) /
                                                (weight @ centered**2))
            later = walk @ later
    assert found.autocorrelation[0] == pytest.approx(1)
    assert found.correlation_length == pytest.approx(-1 / math.log(abs(found.autocorrelation[1])))


def test_optima_and_neutrality(atlas):
    found = landscape(atlas, tolerance=0.02)
    graph = plain_graph(atlas)
    scores = [atlas.score(at) for at in range(len(atlas))]
    optima = [at for at, near in enumerate(graph) if all(scores[at] <= scores[to] for to in near)]
    assert found.optima == len(optima) and found.bodies == len(atlas)
    assert found.neighbors == pytest.approx(np.mean([len(near) for near in graph]))
    paths = [atlas.ascend(at) for at in range(len(atlas)) if math.isfinite(scores[at])]
    best = min(scores)
    assert found.ascent_steps == pytest.approx(np.mean([len(path) - 1 for path in paths]))
    assert found.ascent_regret == pytest.approx(np.median([scores[path[-1]] for path in paths]) -
                                                best)
    pairs = [abs(scores[at] - scores[to]) for at, near in enumerate(graph) for to in near
             if to > at and math.isfinite(scores[at]) and math.isfinite(scores[to])]
    assert found.neutral == pytest.approx(np.mean([pair <= 0.02 for pair in pairs]))
    ends = [atlas.ascend(at)[-1] for at in range(len(atlas))]
    assert found.best_basin == ends.count(scores.index(best))
    assert found.median_basin == np.median([ends.count(at) for at in optima])
    assert sum(size.optima for size in found.sizes) == found.optima


def test_deceptive_sizes(atlas):
    found = landscape(atlas)
    finite = [at for at in range(len(atlas)) if math.isfinite(atlas.score(at))]
    best_voxels = len(atlas.voxels(int(atlas.best()[0])))
    below = [at for at in finite if len(atlas.voxels(at)) < best_voxels]
    steps = [atlas.best_step(at) for at in below]
    assert found.shrinks == pytest.approx(np.mean([
        step is not None and step.step == "remove" for step in steps]))
    for size in found.sizes:
        own = [at for at in finite if at in atlas.positions(size.voxels)]
        best = min(own, key=atlas.score)
        assert size.best == atlas.score(best) and size.bodies == atlas.sizes[size.voxels]
        assert size.median == pytest.approx(np.median([atlas.score(at) for at in own]))
        assert size.ends_at == atlas.score(atlas.ascend(best)[-1])
        blocked = [all(near.score >= atlas.score(at) for near in atlas.neighbors(at, "add"))
                   for at in own]
        assert size.no_growth == pytest.approx(
            np.mean(blocked) if size.voxels < atlas.voxels_max else math.nan, nan_ok=True)
        if size.voxels > 1:
            smaller = int(atlas.best(1, size.voxels - 1)[0])
            assert size.grown == (smaller in [
                near.position for near in atlas.neighbors(best, "remove")])


def test_epistasis(atlas):
    """All pairs, cell by cell."""
    tolerance = 0.05
    counts = {"none": 0, "magnitude": 0, "sign": 0, "reciprocal": 0}
    for at in range(len(atlas)):
        cells = atlas.cells(at)
        for i, first in enumerate(cells):
            for second in cells[i + 1:]:
                four = [[cell for cell in cells if cell not in gone] for gone in
                        ((first, second), (second, ), (first, ), ())]
                if not all(four) or not all(whole(body) for body in four):
                    continue
                none, one, other, both = (atlas.score(body) for body in four)
                if not all(map(math.isfinite, (none, one, other, both))):
                    continue
                turned = [(one - none) * (both - other) < 0, (other - none) * (both - one) < 0]
                kind = "none" if abs(both - one - other + none) <= tolerance else [
                    "magnitude", "sign", "reciprocal"][sum(turned)]
                counts[kind] += 1
    assert all(counts.values())
    found = landscape(atlas, tolerance=tolerance).epistasis
    assert found.pairs == sum(counts.values())
    for kind, count in counts.items():
        assert getattr(found, kind) == pytest.approx(count / found.pairs)
    fewer = landscape(atlas, tolerance=tolerance, sample=30, seed=2).epistasis
    assert 0 < fewer.pairs < found.pairs


def whole(cells):
    voxels = np.zeros((1, 6, 6, 4), dtype=bool)
    for cell in cells:
        voxels[0][cell] = True
    return bool((largest_pieces(voxels) == voxels).all())


# ---- the commands ----

def bench(*arguments):
    return subprocess.run([sys.executable, *map(str, arguments)], cwd=SOURCE, text=True,
                          capture_output=True, check=True).stdout


def test_bench_search(path, tmp_path):
    """The same numbers at each call, in a table, a CSV and a chart."""
    tables, curves = [], []
    for name in ("a", "b"):
        tables.append(bench("experiments/search.py", path, "--seeds", 2, "--evaluations", 60,
                            "--methods", "random,ga,climbing,climbing-moves,map-elites", "--jobs",
                            2, "--csv", tmp_path / f"{name}.csv", "--svg", tmp_path / f"{name}.svg"
                            ))
        curves.append((tmp_path / f"{name}.csv").read_text())
    assert tables[0] == tables[1] and curves[0] == curves[1]
    assert (tmp_path / "a.svg").read_text() == (tmp_path / "b.svg").read_text()
    assert "124 bodies of at most 5 voxels, images, 3 environments" in tables[0]
    rows = list(csv.DictReader(curves[0].splitlines()))
    assert {row["seed"] for row in rows} == {"1", "2"}
    for method in ("random", "ga", "climbing", "climbing-moves"):
        for seed in ("1", "2"):
            regrets = [float(row["regret"]) for row in rows
                       if (row["method"], row["seed"]) == (method, seed)]
            assert regrets == sorted(regrets, reverse=True) and min(regrets) >= 0
    table = [line.split(" | ") for line in tables[0].splitlines() if line.startswith("| ")]
    assert len(table) == 7 and table[2][0] == "| random search"
    try:
        import ribs  # noqa: F401
    except ImportError:
        assert table[6][1] == "not run: no package ribs"


def test_examples_of_the_documents(tmp_path, monkeypatch):
    subprocess.run([ANSWERS, tmp_path / "walk-7.atlas", "6", "6", "4", "6", "1000", str(1 << 16)],
                   check=True, capture_output=True)  # with work_j
    monkeypatch.chdir(tmp_path)
    for page in ("docs/atlas.md", "docs/search.md", "clients/python/README.md"):
        examples = re.findall(r"```python\n(.*?)```", (SOURCE / page).read_text(), re.DOTALL)
        assert len(examples) == 1
        for example in examples:
            exec(compile(example, page, "exec"), {"np": np})  # noqa: S102


def test_bench_speed(path):
    once, each = bench("experiments/search.py", path, "--speed").splitlines()
    assert once.startswith("124 bodies, computed once: opening ") and "loss of a genotype " in each


def test_bench_landscape(path):
    text = bench("experiments/landscape.py", path, path)
    assert text.count("124") >= 2 and "| epistasis" in text
