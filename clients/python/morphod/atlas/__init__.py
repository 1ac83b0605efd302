"""Atlas files without a service: all bodies of at most ten voxels, with their scores.

docs/atlas.md has the definitions of all queries.
"""

from .graph import Basins, Steps
from .layout import AtlasError, Block, Head
from .pairs import Comparison, kendall_tau
from .reader import GROW_SHRINK, Atlas, Neighbor, OutsideError, Rank, Where

__all__ = [
    "GROW_SHRINK", "Atlas", "AtlasError", "Basins", "Block", "Comparison", "Head", "Neighbor",
    "OutsideError", "Rank", "Steps", "Where", "kendall_tau",
]
