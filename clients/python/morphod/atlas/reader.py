"""An atlas file: looking bodies up, and queries that need nothing but their scores. The definitions
are those of docs/atlas.md."""

from __future__ import annotations

import dataclasses
import math
import os
from bisect import bisect_right
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Literal, Union

import numpy as np

from ..bodies import Body, BodyLike
from ..errors import BodyError, counted
from .forms import Cell, Space, around, is_whole
from .graph import Basins, Steps, basins_of, steps_of
from .layout import AtlasError, Block, Header, check_all, read_blocks, read_header
from .pairs import Comparison, compared

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

Where = Union[int, BodyLike]
"""A position in an atlas, or a body in any place and orientation."""

GROW_SHRINK = ("add", "remove")
_STEPS = ("add", "remove", "move")


class OutsideError(BodyError):
    """A body is not in the atlas.

    `reason` is `empty`, `voxels` (it has too many), `workspace` (it does not fit) or `pieces`
    (it is not in one piece).
    """

    def __init__(self, message: str, reason: str) -> None:
        super().__init__(message)
        self.reason = reason

    def __reduce__(self) -> Any:
        return type(self), (str(self), self.reason)


@dataclasses.dataclass(frozen=True)
class Neighbor:
    """A body one step away from another: `step` is `add`, `remove` or `move`."""

    position: int
    score: float
    step: str


@dataclasses.dataclass(frozen=True)
class Similar:
    """A body that is `distance` steps (1 or 2) of adding or removing a voxel away from another."""

    position: int
    score: float
    distance: int


@dataclasses.dataclass(frozen=True)
class Rank:
    """How many other bodies have a lower (`better`), an equal (`equal`) and a higher score
    (`worse`)."""

    better: int
    equal: int
    worse: int

    @property
    def rank(self) -> int:
        """1 for the best."""
        return self.better + 1

    @property
    def percentile(self) -> float:
        """The percentage of the other bodies that are worse, plus half of those that are equal."""
        others = self.better + self.equal + self.worse
        return 100 * (self.worse + self.equal / 2) / others if others else 100.0


class Atlas:
    """All bodies of at most `voxels_max` voxels with their scores, in a mapped file; no service is
    needed. Scores are mean losses: lower is better, +infinity if a rollout diverged.

    A body is given as its position, or as anything that `Body.of` accepts, in any place and
    orientation. Queries that are computed from all bodies (ranks, basins) keep their result.
    """

    def __init__(self, data: NDArray[np.uint8], path: str, check: bool) -> None:
        header = read_header(data)
        self.path = path
        self.header: Header = header
        self.workspace = header.workspace
        self.voxels_max = header.voxels_max
        self.orientations = header.orientations
        self.n_environments = header.n_environments
        self.measures = header.measures
        self._blocks = read_blocks(data, header)
        if check:
            check_all(data, header, self._blocks)
        self._space = Space(header.workspace, header.voxels_max)
        self._firsts = [0]
        for count in header.counts:
            self._firsts.append(self._firsts[-1] + count)
        # By size: the first key of each block, then the keys and scores of each, as plain numbers.
        of_size = [[block for block in self._blocks if block.voxels == voxels]
                   for voxels in range(self.voxels_max + 1)]
        self._of_size = of_size
        self._first_keys = [[int(block.keys[0]) for block in blocks] for blocks in of_size]
        self._keys = [[memoryview(block.keys) for block in blocks]  # type: ignore[arg-type]
                      for blocks in of_size]
        self._scores_of = [[memoryview(block.scores) for block in blocks]  # type: ignore[arg-type]
                           for blocks in of_size]
        self._all_scores: NDArray[np.float32] | None = None
        self._all_keys: NDArray[np.uint64] | None = None
        self._all_measures: dict[str, NDArray[np.float32]] = {}
        self._orders: dict[int, tuple[NDArray[np.int64], NDArray[np.float32]]] = {}
        self._steps: Steps | None = None
        self._basins: Basins | None = None

    @classmethod
    def open(cls, path: str | os.PathLike[str], *, check: bool = False) -> Atlas:
        """Maps a file. Its header and the headers of its blocks are always checked; with `check`,
        all bytes are: checksums, keys in order, numbers. Raises `AtlasError`, and `OSError`."""
        name = os.fspath(path)
        if os.path.getsize(name) == 0:
            raise AtlasError("this is not an atlas file: check its name")
        return cls(np.asarray(np.memmap(name, dtype=np.uint8, mode="r")), name, check)

    def __len__(self) -> int:
        return self._firsts[-1]

    def __repr__(self) -> str:
        return (f"Atlas({counted(len(self), 'body', 'bodies')} of at most "
                f"{counted(self.voxels_max, 'voxel')}, "
                f"{counted(self.n_environments, 'environment')}, {self.orientations})")

    # ---- bodies ----

    @property
    def sizes(self) -> dict[int, int]:
        """How many bodies there are of each number of voxels."""
        return dict(enumerate(self.header.counts, 1))

    def positions(self, voxels: int | None = None) -> range:
        """The positions of the bodies with this number of voxels, or of all."""
        if voxels is None:
            return range(len(self))
        if not 1 <= voxels <= self.voxels_max:
            raise OutsideError(f"the atlas has bodies of 1 to {self.voxels_max} voxels, not "
                               f"{voxels}", "voxels")
        return range(self._firsts[voxels - 1], self._firsts[voxels])

    def blocks(self, voxels: int | None = None) -> list[Block]:
        """The file's own arrays, without copies, in the order of positions."""
        if voxels is None:
            return list(self._blocks)
        self.positions(voxels)
        return list(self._of_size[voxels])

    def find(self, body: BodyLike) -> int:
        """Returns the position of a body. Raises `OutsideError`, which says why it has none."""
        if isinstance(body, str) and len(body) == self._space.voxels and not body.strip("01"):
            return self._find_text(body)
        if isinstance(body, np.ndarray) and body.dtype == np.bool_ and (
                body.shape == self.workspace):
            return self._find_cells([(int(x), int(y), int(z)) for x, y, z in np.argwhere(body)])
        return self._find_cells(Body.of(body).cells)

    def find_all(self, bodies: NDArray[np.bool_] | Sequence[BodyLike]) -> NDArray[np.int64]:
        """Returns the positions of many bodies, fast for an array (n, x, y, z) of booleans; −1 for
        those that are not in the atlas."""
        if isinstance(bodies, np.ndarray) and bodies.dtype == np.bool_ and (
                bodies.shape[1:] == self.workspace):
            return self._find_array(bodies)
        found = np.full(len(bodies), -1, dtype=np.int64)
        for i, body in enumerate(bodies):
            try:
                found[i] = self.find(body)
            except OutsideError:
                pass
        return found

    def _find_array(self, bodies: NDArray[np.bool_]) -> NDArray[np.int64]:
        found = np.full(len(bodies), -1, dtype=np.int64)
        counts = bodies.reshape(len(bodies), self._space.voxels).sum(axis=1)
        for n in range(1, self.voxels_max + 1):
            rows = np.flatnonzero(counts == n)
            if rows.size:
                cells = np.argwhere(bodies[rows])[:, 1:].astype(np.int16).reshape(-1, n, 3)
                found[rows] = self.find_cells(cells)
        return found

    def find_cells(self, cells: NDArray[np.int16]) -> NDArray[np.int64]:
        """Returns the positions of bodies (bodies, n, 3) of n cells anywhere; −1 for those that are
        not in the atlas."""
        n = cells.shape[1]
        if not 1 <= n <= self.voxels_max or not self.sizes[n]:
            return np.full(len(cells), -1, dtype=np.int64)
        keys, fits = self._space.keys_of(cells)
        known = self.keys(n)
        at = np.searchsorted(known, keys)
        is_known = fits & (known[np.minimum(at, len(known) - 1)] == keys)
        return np.where(is_known, at + self._firsts[n - 1], -1).astype(np.int64)

    def _find_text(self, text: str) -> int:
        n = text.count("1")
        if 1 <= n <= self.voxels_max:
            key = self._space.key_of_text(text)
            position = self._find_key(*key) if key else None
            if position is not None:
                return position
        voxels = [voxel for voxel, digit in enumerate(text) if digit == "1"]
        raise self._outside(self._space.cells_of_voxels(voxels))

    def _find_cells(self, cells: list[Cell]) -> int:
        if 1 <= len(cells) <= self.voxels_max:
            key = self._space.key_of_cells(cells)
            position = self._find_key(*key) if key else None
            if position is not None:
                return position
        raise self._outside(cells)

    def _find_key(self, n: int, key: int) -> int | None:
        block = bisect_right(self._first_keys[n], key) - 1
        if block < 0:
            return None
        keys = self._keys[n][block]
        at = bisect_right(keys, key) - 1
        return self._of_size[n][block].position + at if keys[at] == key else None

    def _outside(self, cells: list[Cell]) -> OutsideError:
        if not cells:
            return OutsideError("this body is empty", "empty")
        if len(cells) > self.voxels_max:
            return OutsideError(f"this body has {len(cells)} voxels; the atlas has bodies of at "
                                f"most {self.voxels_max}", "voxels")
        if not is_whole(cells):
            return OutsideError("this body is not in one piece; the atlas has only bodies in one "
                                "piece", "pieces")
        return OutsideError(f"this body does not fit the atlas's workspace of {self.workspace}",
                            "workspace")

    def position(self, where: Where) -> int:
        """Returns a position as it is, and the position of a body."""
        if isinstance(where, (int, np.integer)) and not isinstance(where, bool):
            if not 0 <= where < len(self):
                raise IndexError(f"the atlas has positions 0 to {len(self) - 1}, not {where}")
            return int(where)
        return self.find(where)  # type: ignore[arg-type]

    def _place(self, position: int) -> tuple[int, int, int]:
        """Returns the number of voxels of a position, its block among those of the size, and its
        place in it."""
        n = bisect_right(self._firsts, position)
        return n, *divmod(position - self._firsts[n - 1], len(self._of_size[n][0]))

    def voxels(self, where: Where) -> list[int]:
        """The voxel indices of the canonical form, ascending."""
        n, block, i = self._place(self.position(where))
        return self._space.voxels_of_key(n, self._keys[n][block][i])

    def genotype(self, where: Where) -> str:
        """The canonical form, a digit per voxel of the workspace."""
        filled = set(self.voxels(where))
        return "".join("1" if voxel in filled else "0" for voxel in range(self._space.voxels))

    def id(self, where: Where) -> str:
        """The id: hexadecimal digits of the canonical form, the first voxel in the top bit."""
        genotype = self.genotype(where)
        digits = (len(genotype) + 3) // 4
        return f"{int(genotype.ljust(4 * digits, '0'), 2):0{digits}x}"

    def cells(self, where: Where) -> list[Cell]:
        """The voxels of the canonical form as (x, y, z)."""
        return self._space.cells_of_voxels(self.voxels(where))

    def body(self, where: Where) -> Body:
        """The canonical form as a `Body`."""
        return Body.of(self.cells(where))

    def cells_of(self, positions: NDArray[np.int64], voxels: int) -> NDArray[np.int16]:
        """Returns the cells (positions, voxels, 3) of bodies with this number of voxels."""
        return self._space.cells_of(self.keys(voxels)[positions - self._firsts[voxels - 1]], voxels)

    def keys(self, voxels: int) -> NDArray[np.uint64]:
        """The keys of a size in one array, a cached copy."""
        if self._all_keys is None:
            self._all_keys = np.concatenate([block.keys for block in self._blocks])
            self._all_keys.flags.writeable = False
        span = self.positions(voxels)
        return self._all_keys[span.start:span.stop]

    # ---- scores ----

    def score(self, where: Where) -> float:
        """The mean loss over the environments."""
        n, block, i = self._place(self.position(where))
        score: float = self._scores_of[n][block][i]
        return score

    def scores(self, voxels: int | None = None) -> NDArray[np.float32]:
        """The scores of a size, or of all bodies, in one array, a cached copy; `blocks` has
        the arrays of the file itself."""
        if self._all_scores is None:
            self._all_scores = np.concatenate([block.scores for block in self._blocks])
            self._all_scores.flags.writeable = False
        span = self.positions(voxels)
        return self._all_scores[span.start:span.stop]

    def losses(self, where: Where) -> NDArray[np.float16]:
        """The losses of a body by environment: a view of the file, rounded to 11 bits each."""
        n, block, i = self._place(self.position(where))
        losses: NDArray[np.float16] = self._of_size[n][block].losses[i]
        return losses

    def all_losses(self, voxels: int | None = None) -> NDArray[np.float16]:
        """The losses (bodies, environments) of a size, or of all bodies, in one new array."""
        return np.concatenate([block.losses for block in self.blocks(voxels)])

    def measure(self, name: str, where: Where) -> float:
        """The mean of a measure over the environments (and the images) of a body; NaN: a rollout
        has no value, for example because it diverged. `measures` has the names."""
        n, block, i = self._place(self.position(where))
        return float(self._of_size[n][block].measures[self._known(name)][i])

    def all_measures(self, name: str, voxels: int | None = None) -> NDArray[np.float32]:
        """A measure of a size, or of all bodies, in one array, a cached copy; `blocks` has
        the arrays of the file itself."""
        if name not in self._all_measures:
            values = np.concatenate([block.measures[self._known(name)] for block in self._blocks])
            values.flags.writeable = False
            self._all_measures[name] = values
        span = self.positions(voxels)
        return self._all_measures[name][span.start:span.stop]

    def measure_percentile(self, name: str, where: Where) -> float:
        """The percentage of the other bodies of the same size with a value that have a lower
        one, plus half of those with an equal one; 100 if there are no others, NaN if the body has
        no value."""
        position = self.position(where)
        value = np.float32(self.measure(name, position))
        values = self.all_measures(name, self._place(position)[0])
        others = int((values == values).sum()) - 1
        if np.isnan(value):
            return math.nan
        lower, equal = int((values < value).sum()), int((values == value).sum()) - 1
        return 100 * (lower + equal / 2) / others if others else 100.0

    def best_by(self, name: str, k: int = 1, voxels: int | None = None, *,
                order: Literal["descending", "ascending"] = "descending",
                lo: float | None = None, hi: float | None = None,
                score_lo: float | None = None, score_hi: float | None = None) -> NDArray[np.int64]:
        """The positions of the k bodies with the highest values of a measure, or with the lowest;
        ties by lowest position. Only bodies with lo ≤ value < hi and score_lo ≤ score < score_hi,
        as far as these are given; they are rounded to float32, as values and scores are. Bodies
        without a value come last, unless the range has an end there; a range of scores leaves
        diverged bodies out."""
        if order not in ("descending", "ascending"):
            raise ValueError(f"order must be descending or ascending, not {order!r}")
        values, scores = self.all_measures(name, voxels), self.scores(voxels)
        low, high = _range("lo", lo, "hi", hi)
        kept = ~((values < low) | (values >= high))
        if (lo if order == "descending" else hi) is not None:
            kept &= ~np.isnan(values)
        if score_lo is not None or score_hi is not None:
            low, high = _range("score_lo", score_lo, "score_hi", score_hi)
            kept &= (scores >= low) & (scores < high)
        found = np.argsort(-values if order == "descending" else values, kind="stable")
        found = found[kept[found]][:k].astype(np.int64)
        return found + self.positions(voxels).start

    def _known(self, name: str) -> str:
        if name in self.measures:
            return name
        raise KeyError(f"the atlas does not have the measure {name!r}; it has "
                       f"{', '.join(self.measures) or 'none'}")

    def order(self, voxels: int | None = None) -> NDArray[np.int64]:
        """The positions of a size, or of all bodies, the best first; ties by lowest position."""
        return self._sorted(voxels)[0]

    def _sorted(self, voxels: int | None) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        if (voxels or 0) not in self._orders:
            scores = self.scores(voxels)
            order = np.argsort(scores, kind="stable")
            self._orders[voxels or 0] = order + self.positions(voxels).start, scores[order]
        return self._orders[voxels or 0]

    def rank(self, where: Where, *, within_size: bool = False) -> Rank:
        """Ranks a body among all bodies, or among those of its size."""
        position = self.position(where)
        scores = self._sorted(self._place(position)[0] if within_size else None)[1]
        score = np.float32(self.score(position))
        better = int(np.searchsorted(scores, score, "left"))
        up_to = int(np.searchsorted(scores, score, "right"))
        return Rank(better, up_to - better - 1, len(scores) - up_to)

    def percentile(self, where: Where, *, within_size: bool = False) -> float:
        """100 for the single best body, 0 for the single worst."""
        return self.rank(where, within_size=within_size).percentile

    def best(self, k: int = 1, voxels: int | None = None, *, lo: float | None = None,
             hi: float | None = None) -> NDArray[np.int64]:
        """The positions of the k best bodies, or all if there are fewer: of those with
        lo ≤ score < hi, as far as these are given; they are rounded to float32, as scores are."""
        order, scores = self._sorted(voxels)
        begin, end = np.searchsorted(scores, _range("lo", lo, "hi", hi)).tolist()
        return order[begin:len(order) if hi is None else end][:k]

    def histogram(self, edges: ArrayLike, voxels: int | None = None, *,
                  measure: str | None = None) -> NDArray[np.int64]:
        """Counts the bodies with edges[i] ≤ score < edges[i + 1], or by a measure. edges:
        ascending; they are rounded to float32, as scores are."""
        bounds = np.asarray(edges, dtype=np.float32)
        if bounds.ndim != 1 or len(bounds) < 2 or not (bounds[1:] >= bounds[:-1]).all():
            raise ValueError("edges must be at least two ascending numbers")
        ordered = (self._sorted(voxels)[1] if measure is None
                   else np.sort(self.all_measures(measure, voxels)))
        return np.diff(np.searchsorted(ordered, bounds))

    def footprints(self) -> dict[int, tuple[int, int]]:
        """For each footprint (columns with a voxel): the number of bodies, and the position of the
        best."""
        ordered = self.order()
        columns = self.footprint_of()[ordered]
        found, first, counts = np.unique(columns, return_index=True, return_counts=True)
        return {int(footprint): (int(count), int(ordered[at]))
                for footprint, at, count in zip(found, first, counts)}

    def footprint_of(self) -> NDArray[np.int64]:
        """The footprint of every body."""
        found = np.empty(len(self), dtype=np.int64)
        for n in range(1, self.voxels_max + 1):
            span = self.positions(n)
            cells = self.cells_of(np.arange(span.start, span.stop), n)
            # Voxels are in order, so those of a column follow each other.
            found[span.start:span.stop] = 1 + (cells[:, 1:, :2] != cells[:, :-1, :2]).any(
                axis=2).sum(axis=1)
        return found

    # ---- neighbors ----

    def neighbors(self, where: Where, steps: Iterable[str] = GROW_SHRINK) -> list[Neighbor]:
        """Lists the bodies one step away from a body, each once, best first. `steps` are
        some of `add`, `remove` and `move`."""
        wanted = _checked(steps)
        position = self.position(where)
        found: dict[int, str] = {}

        def keep(cells: list[Cell], step: str) -> None:
            key = self._space.key_of_cells(cells) if 1 <= len(cells) <= self.voxels_max else None
            at = self._find_key(*key) if key else None
            if at is not None and at != position:
                found.setdefault(at, step)

        def keep_larger(cells: list[Cell], never: Cell | None, step: str) -> None:
            taken = set(cells) | ({never} if never else set())
            for room in {near: None for cell in cells for near in around(cell)}:
                if room not in taken:
                    keep([*cells, room], step)

        cells = self.cells(position)
        if "add" in wanted:
            keep_larger(cells, None, "add")
        if wanted & {"remove", "move"}:
            for i, gone in enumerate(cells):
                rest = cells[:i] + cells[i + 1:]
                if is_whole(rest):
                    if "remove" in wanted:
                        keep(rest, "remove")
                    if "move" in wanted:
                        keep_larger(rest, gone, "move")
        neighbors = [Neighbor(at, self.score(at), step) for at, step in found.items()]
        return sorted(neighbors, key=lambda neighbor: (neighbor.score, neighbor.position))

    def best_step(self, where: Where, steps: Iterable[str] = GROW_SHRINK) -> Neighbor | None:
        """Returns the best neighbor if it is better than the body; None for a local optimum."""
        position = self.position(where)
        neighbors = self.neighbors(position, steps)
        return neighbors[0] if neighbors and neighbors[0].score < self.score(position) else None

    def ascend(self, where: Where, steps: Iterable[str] = GROW_SHRINK) -> list[int]:
        """Follows the best changes from a body to a local optimum: steepest ascent. Returns all
        positions of the path, the body's first."""
        wanted = _checked(steps)
        path = [self.position(where)]
        while (step := self.best_step(path[-1], wanted)) is not None:
            path.append(step.position)
        return path

    def similar(self, where: Where) -> list[Similar]:
        """Lists the bodies within two steps of adding or removing a voxel, best first. A moved
        voxel is two steps."""
        position = self.position(where)
        found = {position: 0}
        edge = [position]
        for distance in (1, 2):
            edge = [near.position for at in edge for near in self.neighbors(at)]
            for at in edge:
                found.setdefault(at, distance)
        similar = [Similar(at, self.score(at), distance) for at, distance in found.items()
                   if distance]
        return sorted(similar, key=lambda body: (body.score, body.position))

    def steps(self) -> Steps:
        """All pairs of neighbors by adding and removing a voxel."""
        if self._steps is None:
            self._steps = steps_of(self)
        return self._steps

    def basins(self) -> Basins:
        """Where steepest ascent by adding and removing ends, for all bodies."""
        if self._basins is None:
            self._basins = basins_of(self.steps(), self.scores(), self.order())
        return self._basins

    def optima(self) -> NDArray[np.int64]:
        """The positions of all local optima by adding and removing, the best first."""
        optima: NDArray[np.int64] = self.order()[self.basins().is_optimum[self.order()]]
        return optima

    # ---- with another atlas ----

    def compare(self, other: Atlas, *, bins: int = 64) -> Comparison:
        """Compares the scores of the bodies that both atlases have: Kendall's τ of both rankings
        (exact, τ-b) and a histogram of both scores."""
        if self.workspace != other.workspace:
            raise AtlasError(f"the atlases have different workspaces: {self.workspace} and "
                             f"{other.workspace}")
        # Positions begin with the smallest sizes, so common bodies have common positions.
        common = min(len(self), len(other))
        return compared(self.scores()[:common], other.scores()[:common], bins)

    def map(self, measure: str, *, bins: int = 64) -> Comparison:
        """Compares the scores with a measure, over the bodies that have a value: Kendall's τ, and
        a histogram of score (`edges`) and measure (`other_edges`)."""
        values = self.all_measures(measure)
        known = ~np.isnan(values)
        return compared(self.scores()[known], values[known], bins)


def _range(low: str, lo: float | None, high: str, hi: float | None
           ) -> tuple[np.float32, np.float32]:
    """Returns the ends of a range of scores or values."""
    ends = (np.float32(-math.inf if lo is None else lo), np.float32(math.inf if hi is None else hi))
    if not ends[0] < ends[1]:
        raise ValueError(f"{low} must be below {high}, got {lo} and {hi}")
    return ends


def _checked(steps: Iterable[str]) -> set[str]:
    wanted = {steps} if isinstance(steps, str) else set(steps)
    if not wanted or wanted - set(_STEPS):
        raise ValueError(f"steps must be from {', '.join(_STEPS)}, got {sorted(wanted)}")
    return wanted
