"""Atlas files without a service: all bodies of at most ten voxels, with their scores.

docs/atlas.md has the definitions of all queries, docs/search.md those of the benchmark (`Problem`)
and of the statistics of a landscape.
"""

from .graph import Basins, Steps
from .landscapes import Epistasis, Landscape, SizeStatistics, landscape
from .layout import AtlasError, Block, Header
from .pairs import Comparison, kendall_tau
from .problem import BudgetError, Measures, Outside, Problem
from .reader import GROW_SHRINK, Atlas, Neighbor, OutsideError, Rank, Similar, Where

__all__ = [
    "GROW_SHRINK", "Atlas", "AtlasError", "Basins", "Block", "BudgetError", "Comparison",
    "Epistasis", "Header", "Landscape", "Measures", "Neighbor", "Outside", "OutsideError",
    "Problem", "Rank", "Similar", "SizeStatistics", "Steps", "Where", "kendall_tau", "landscape",
]
