"""Statistics of the landscape of an atlas: how hard it is to search. docs/search.md defines them.

The graph is that of all bodies, with an edge where adding or removing a voxel leads from one to the
other. Bodies that diverged (+infinity) are left out, except where stated."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import numpy as np

from .forms import stays_whole
from .graph import Steps
from .reader import Atlas

if TYPE_CHECKING:
    from numpy.typing import NDArray

LAGS = 10


@dataclasses.dataclass(frozen=True)
class Epistasis:
    """Shares of the pairs of voxels that can be removed from a body one by one and both: whether
    the effect of the one depends on the other (`magnitude`), changes its sign with it (`sign`), or
    both change their signs (`reciprocal`). `none`: the sum of both, within the tolerance."""

    pairs: int
    none: float
    magnitude: float
    sign: float
    reciprocal: float


@dataclasses.dataclass(frozen=True)
class SizeStatistics:
    """`optima` counts local optima of this size. `no_growth`: share of the bodies that no added
    voxel improves; NaN for the most voxels. `grown`: whether the best body is the best of one voxel
    less, with one added. `ends_at`: the score at which the steepest ascent from the best body
    ends."""

    voxels: int
    bodies: int
    diverged: int
    best: float
    median: float
    optima: int
    no_growth: float
    grown: bool
    ends_at: float


@dataclasses.dataclass(frozen=True)
class Landscape:
    """`autocorrelation[k]`: of the scores along random walks, k steps apart; exact, over all walks.
    `within_sizes`: the same for the differences from the mean of the size. `correlation_length`: in
    steps, −1 / ln of the first. `neutral`: share of neighbors whose scores differ by at most
    `tolerance`. `optima` counts all local optima, `best_basin` is the basin of the best body and
    `median_basin` the median of all basins, in bodies. `ascent_steps` is the mean length of
    steepest ascents from all bodies, `ascent_regret` the median of how much their ends are above
    the optimum. `shrinks`: share of the bodies smaller than the best one whose best change is to
    remove a voxel."""

    bodies: int
    diverged: int
    tolerance: float
    autocorrelation: tuple[float, ...]
    within_sizes: tuple[float, ...]
    neighbors: float
    neutral: float
    optima: int
    best_basin: int
    median_basin: float
    ascent_steps: float
    ascent_regret: float
    shrinks: float
    epistasis: Epistasis
    sizes: tuple[SizeStatistics, ...]

    @property
    def correlation_length(self) -> float:
        return _length(self.autocorrelation[1])


def landscape(atlas: Atlas, *, tolerance: float = 0.001, sample: int = 20000,
              seed: int = 1) -> Landscape:
    """Computes the statistics. tolerance: of neutrality and epistasis, in units of the loss.
    sample: the bodies whose pairs of voxels are examined for epistasis, drawn with the seed, or all
    if there are not more."""
    scores = atlas.scores().astype(np.float64)
    finite = np.isfinite(scores)
    steps = _between(atlas.steps(), finite)
    basins = atlas.basins()
    sizes = np.repeat(list(atlas.sizes), list(atlas.sizes.values()))
    means = np.array([scores[finite & (sizes == n)].mean() if (finite & (sizes == n)).any() else 0
                      for n in range(atlas.voxels_max + 1)])
    ends = scores[basins.optimum[finite]]
    best = int(atlas.best(1)[0])
    by_adding, by_removing = _best_neighbors(scores, steps)
    below = finite & (sizes < sizes[best])
    shrinks = below & (by_removing < scores) & (by_removing <= by_adding)
    return Landscape(
        bodies=len(atlas), diverged=int((~finite).sum()), tolerance=tolerance,
        autocorrelation=_autocorrelation(np.where(finite, scores, 0), steps),
        within_sizes=_autocorrelation(np.where(finite, scores - means[sizes], 0), steps),
        neighbors=2 * len(atlas.steps()) / len(atlas),
        neutral=_share(np.abs(scores[steps.larger] - scores[steps.smaller]) <= tolerance),
        optima=int(basins.is_optimum.sum()), best_basin=int(basins.size[basins.optimum[best]]),
        median_basin=float(np.median(basins.size[basins.is_optimum])),
        ascent_steps=float(basins.steps[finite].mean()),
        ascent_regret=float(np.median(ends) - scores[best]),
        shrinks=_share(shrinks[below]),
        epistasis=_epistasis(atlas, scores, tolerance, sample, seed),
        sizes=tuple(_of_size(atlas, n, scores, by_adding) for n in atlas.sizes if atlas.sizes[n]))


def _share(which: NDArray[np.bool_]) -> float:
    return float(which.mean()) if which.size else math.nan


def _length(first: float) -> float:
    return -1 / math.log(abs(first)) if 0 < abs(first) < 1 else math.nan


def _between(steps: Steps, kept: NDArray[np.bool_]) -> Steps:
    used = kept[steps.larger] & kept[steps.smaller]
    return Steps(steps.larger[used], steps.smaller[used])


def _autocorrelation(values: NDArray[np.float64], steps: Steps) -> tuple[float, ...]:
    """A walk goes to each neighbor with the same probability, and is at each body in proportion to
    its neighbors."""
    n = len(values)
    degree = (np.bincount(steps.larger, minlength=n) +
              np.bincount(steps.smaller, minlength=n)).astype(np.float64)
    weight = degree / max(degree.sum(), 1)
    centered = values - (weight * values).sum()
    variance = float((weight * centered**2).sum())
    correlations = []
    later = centered
    for _ in range(LAGS + 1):
        covariance = float((weight * centered * later).sum())
        correlations.append(covariance / variance if variance > 0 else math.nan)
        total = (np.bincount(steps.larger, later[steps.smaller], n) +
                 np.bincount(steps.smaller, later[steps.larger], n))
        later = total / np.maximum(degree, 1)
    return tuple(correlations)


def _best_neighbors(scores: NDArray[np.float64], steps: Steps
                    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the best score of the neighbors with one voxel more, and with one less."""
    by_adding, by_removing = np.full(len(scores), np.inf), np.full(len(scores), np.inf)
    np.minimum.at(by_adding, steps.smaller, scores[steps.larger])
    np.minimum.at(by_removing, steps.larger, scores[steps.smaller])
    return by_adding, by_removing


def _of_size(atlas: Atlas, voxels: int, scores: NDArray[np.float64],
             by_adding: NDArray[np.float64]) -> SizeStatistics:
    span = atlas.positions(voxels)
    here = slice(span.start, span.stop)
    finite = np.isfinite(scores[here])
    best = int(atlas.best(1, voxels)[0])
    smaller = atlas.best(1, voxels - 1)[:1].tolist() if voxels > 1 else []
    grown = any(neighbor.position in smaller for neighbor in atlas.neighbors(best, "remove"))
    basins = atlas.basins()
    return SizeStatistics(
        voxels=voxels, bodies=len(span), diverged=int((~finite).sum()),
        best=float(scores[best]),
        median=float(np.median(scores[here][finite])) if finite.any() else math.inf,
        optima=int(basins.is_optimum[here].sum()),
        no_growth=(_share((by_adding[here] >= scores[here])[finite])
                   if voxels < atlas.voxels_max else math.nan),
        grown=grown, ends_at=float(scores[basins.optimum[best]]))


def _epistasis(atlas: Atlas, scores: NDArray[np.float64], tolerance: float, sample: int,
               seed: int) -> Epistasis:
    chosen = np.arange(len(atlas))
    if len(chosen) > sample:
        chosen = np.sort(np.random.default_rng(seed).choice(chosen, sample, replace=False))
    counts = np.zeros(4, dtype=np.int64)
    for n in range(3, atlas.voxels_max + 1):
        span = atlas.positions(n)
        positions = chosen[(chosen >= span.start) & (chosen < span.stop)]
        if positions.size:
            counts += _pairs_of(atlas, scores, positions, n, tolerance)
    total = int(counts.sum())
    shares = (counts / total if total else np.full(4, math.nan)).tolist()
    return Epistasis(total, *shares)


def _pairs_of(atlas: Atlas, scores: NDArray[np.float64], positions: NDArray[np.int64], n: int,
              tolerance: float) -> NDArray[np.int64]:
    """Counts the pairs of voxels of bodies with n voxels by their kind."""
    counts = np.zeros(4, dtype=np.int64)
    cells = atlas.cells_of(positions, n)
    whole = stays_whole(cells)
    both = scores[positions]
    without = np.full(whole.shape, np.nan)
    for i in range(n):
        rows = np.flatnonzero(whole[:, i])
        without[rows, i] = scores[atlas.find_cells(np.delete(cells[rows], i, axis=1))]
    for i in range(n):
        rest = np.delete(cells, i, axis=1)
        still_whole = stays_whole(rest)
        for k in range(i + 1, n):
            rows = np.flatnonzero(whole[:, i] & whole[:, k] & still_whole[:, k - 1])
            if not rows.size:
                continue
            none = scores[atlas.find_cells(np.delete(rest[rows], k - 1, axis=1))]
            all_four = np.stack([none, without[rows, k], without[rows, i], both[rows]])
            counts += _kinds(all_four[:, np.isfinite(all_four).all(axis=0)], tolerance)
    return counts


def _kinds(scores: NDArray[np.float64], tolerance: float) -> NDArray[np.int64]:
    """scores (4, pairs): without both voxels, with the first, with the second, with both."""
    none, first, second, both = scores
    interacts = np.abs(both - first - second + none) > tolerance
    turned = ((first - none) * (both - second) < 0).astype(np.int64) + (
        (second - none) * (both - first) < 0)
    return np.array([(~interacts).sum(), *((interacts & (turned == k)).sum() for k in range(3))])
