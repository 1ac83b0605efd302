"""The phylogeny of a campaign: every design ever born, with its parents."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from .errors import MorphodError, counted, reading
from .frames import pandas
from .scenes import read_envelope

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray

NONE = 4294967295
"""In the columns of parents: no parent."""


class Phylogeny:
    """Columns with one row per design, in order of birth.

    `number`, `parent` and `other_parent` are uint32 (`NONE`: no parent). `born` and `died` are
    generations (`alive` marks the living). `operator` has indices into `operators`. `score` is
    float32, with NaN if a rollout diverged. `lower_bound` is bool: the design could not survive, so
    it was cut short, and its score is at least this. `own_score` is None, or the name and unit of
    the own score of a study, or of a campaign that selects by a measure. `voxels` and `footprint`
    are uint8. `measures` are float64, by name: those that the campaign names, and those of a study.
    A million designs are a few arrays of a few megabytes.
    """

    @reading()
    def __init__(self, data: bytes) -> None:
        header = read_envelope(data)
        columns: dict[str, NDArray[Any]] = header["columns"]
        self.parent = columns["parent"]
        self.other_parent = columns["other_parent"]
        self.born = columns["born"]
        self.died = columns["died"]
        self.operator = columns["operator"]
        self.operators: tuple[str, ...] = tuple(header["operators"])
        # A lower bound comes with its sign changed; an own score of a study is never a bound.
        own: dict[str, str] | None = header.get("own_score")
        self.own_score = own
        self.lower_bound: NDArray[np.bool_] = (columns["score"] < 0) & (own is None)
        self.score = np.abs(columns["score"]) if own is None else columns["score"]
        self.voxels = columns["voxels"]
        self.footprint = columns["footprint"]
        self.measures = {name.partition(".")[2]: column for name, column in columns.items()
                         if name.startswith("measures.")}
        # A whole phylogeny may come without numbers, because they equal the positions.
        self.number = columns.get("number", np.arange(len(self.parent), dtype=np.uint32))
        self.alive: NDArray[np.bool_] = self.died == np.iinfo(self.died.dtype).max

    def __len__(self) -> int:
        return len(self.parent)

    def __repr__(self) -> str:
        return f"Phylogeny({counted(len(self), 'design')}, {int(self.alive.sum())} alive)"

    def frame(self) -> pd.DataFrame:
        """Returns a table with the index `number`: parent and other_parent (nullable integers),
        born, died (nullable), operator (categories), score, lower_bound, voxels, footprint, and the
        measures."""
        module = pandas()

        def nullable(column: NDArray[Any], absent: NDArray[np.bool_]) -> Any:
            return module.arrays.IntegerArray(column.astype(np.int64), absent)

        table: pd.DataFrame = module.DataFrame(
            {
                "parent": nullable(self.parent, self.parent == NONE),
                "other_parent": nullable(self.other_parent, self.other_parent == NONE),
                "born": self.born.astype(np.int64),
                "died": nullable(self.died, self.alive),
                "operator": module.Categorical.from_codes(self.operator.astype(np.int8),
                                                          self.operators),
                "score": self.score,
                "lower_bound": self.lower_bound,
                "voxels": self.voxels.astype(np.int64),
                "footprint": self.footprint.astype(np.int64),
                **{f"measures_{name}": column for name, column in self.measures.items()},
            },
            index=module.Index(self.number.astype(np.int64), name="number"))
        return table

    def to_networkx(self) -> Any:
        """Returns a `networkx.DiGraph` with an edge from each parent to its child. Needs
        networkx."""
        try:
            import networkx
        except ImportError:
            raise MorphodError("to_networkx needs networkx: pip install networkx") from None
        graph = networkx.DiGraph()
        rows = zip(self.number.tolist(), self.born.tolist(), self.died.tolist(),
                   self.alive.tolist(), self.operator.tolist(), self.score.tolist(),
                   self.lower_bound.tolist())
        for number, born, died, alive, operator, score, is_bound in rows:
            graph.add_node(number, born=born, died=None if alive else died,
                           operator=self.operators[operator], score=score, lower_bound=is_bound)
        for column in (self.parent, self.other_parent):
            present = column != NONE
            graph.add_edges_from(zip(column[present].tolist(), self.number[present].tolist()))
        return graph

    def to_newick(self) -> str:
        """Returns each design below its first parent, one tree per line; labels are n and the
        number, and branch lengths are generations."""
        children: dict[int, list[int]] = {}
        place = {number: at for at, number in enumerate(self.number.tolist())}
        parents = self.parent.tolist()
        roots = []
        for number, parent in zip(self.number.tolist(), parents):
            if parent in place:
                children.setdefault(parent, []).append(number)
            else:
                roots.append(number)
        born = self.born.tolist()
        # From last to first: children are born after their parents.
        text: dict[int, str] = {}
        for number in reversed(self.number.tolist()):
            own = children.get(number, ())
            inside = f"({','.join(text.pop(child) for child in own)})" if own else ""
            parent = parents[place[number]]
            length = f":{born[place[number]] - born[place[parent]]}" if parent in place else ""
            text[number] = f"{inside}n{number}{length}"
        return "".join(f"{text[root]};\n" for root in roots)

    def to_dendropy(self) -> Any:
        """Returns a `dendropy.TreeList` of the trees of `to_newick`. Needs DendroPy."""
        try:
            import dendropy
        except ImportError:
            raise MorphodError("to_dendropy needs DendroPy: pip install dendropy") from None
        return dendropy.TreeList.get(data=self.to_newick(), schema="newick",
                                     suppress_internal_node_taxa=True)
