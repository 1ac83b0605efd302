"""Two scores of the same bodies: Kendall's τ, and their common histogram."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclasses.dataclass(frozen=True, eq=False)
class Comparison:
    """`bodies` have two scores. `tau` is Kendall's τ-b of all of them; NaN if one of the two scores
    is the same for all. `counts` (bins, bins) is the histogram of the bodies whose scores are both
    finite, the first score along axis 0, between `edges` and `other_edges` (bins + 1,)."""

    bodies: int
    tau: float
    counts: NDArray[np.int64]
    edges: NDArray[np.float64]
    other_edges: NDArray[np.float64]


def compared(first: NDArray[np.float32], second: NDArray[np.float32], bins: int) -> Comparison:
    finite = np.isfinite(first) & np.isfinite(second)
    counts, edges, other_edges = np.histogram2d(first[finite], second[finite], bins=bins)
    return Comparison(len(first), kendall_tau(first, second), counts.astype(np.int64), edges,
                      other_edges)


def kendall_tau(first: NDArray[np.float32], second: NDArray[np.float32]) -> float:
    """Returns Kendall's τ-b in n log n. NaN if all values of one are equal."""
    n = len(first)
    x = np.unique(first, return_inverse=True)[1].ravel().astype(np.int64)
    y = np.unique(second, return_inverse=True)[1].ravel().astype(np.int64)
    pairs = n * (n - 1) // 2
    tied_x, tied_y = _tied(np.bincount(x)), _tied(np.bincount(y))
    tied_both = _tied(np.unique(x * n + y, return_counts=True)[1])
    if pairs in (tied_x, tied_y):
        return math.nan
    discordant = inversions(y[np.lexsort((y, x))])
    concordant = pairs - tied_x - tied_y + tied_both - discordant
    return (concordant - discordant) / math.sqrt(pairs - tied_x) / math.sqrt(pairs - tied_y)


def _tied(counts: NDArray[np.int64]) -> int:
    return int((counts * (counts - 1) // 2).sum())


def inversions(values: NDArray[np.int64]) -> int:
    """Counts the pairs i < j with values[i] > values[j] ≥ 0.

    From the top bit down, the values are sorted by the bits so far, those with equal ones in their
    first order. A pair is counted at the first bit that differs.
    """
    total = 0
    ordered = values
    for bit in range(int(values.max()).bit_length() - 1, -1, -1) if len(values) else ():
        group = ordered >> (bit + 1)
        is_one = ordered >> bit & 1
        begins = np.flatnonzero(np.r_[True, group[1:] != group[:-1]])
        sizes = np.diff(np.r_[begins, len(ordered)])
        ones = np.cumsum(is_one) - is_one  # before each
        in_group = ones - np.repeat(ones[begins], sizes)
        total += int(in_group[is_one == 0].sum())
        zeros = np.arange(len(ordered)) - np.repeat(begins, sizes) - in_group
        n_zeros = sizes - np.add.reduceat(is_one, begins)
        to = np.repeat(begins, sizes) + np.where(is_one, np.repeat(n_zeros, sizes) + in_group,
                                                 zeros)
        moved = np.empty_like(ordered)
        moved[to] = ordered
        ordered = moved
    return total
