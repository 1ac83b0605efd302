"""Files of scores: blocks, each preceded by 12 bytes with its length."""

from __future__ import annotations

import dataclasses
import os
import struct
from collections.abc import Iterator, Mapping
from typing import Any

from .errors import MorphodError

_MAGIC = 0x184D2A5D
_BLOCK_MAX = 96 << 20


@dataclasses.dataclass
class Entered:
    """The result of importing a file of scores, in rollouts.

    `new` were not stored before, `known` were already stored with the same bits; `different` are
    stored with different bits and were left out. `differences` has the first ones of each block, as
    reported by the service.
    """

    new: int = 0
    known: int = 0
    different: int = 0
    differences: list[Mapping[str, Any]] = dataclasses.field(default_factory=list)

    def add(self, reply: Mapping[str, Any]) -> None:
        """Adds the counts of a block."""
        self.new += reply["new"]
        self.known += reply["known"]
        self.different += reply["different"]
        self.differences += reply["differences"]


def blocks(path: str | os.PathLike[str]) -> Iterator[bytes]:
    """Yields the blocks of a file one by one."""
    with open(path, "rb") as file:
        while head := file.read(12):
            size = 0
            if len(head) == 12:
                magic, four, size = struct.unpack("<3I", head)
                if magic != _MAGIC or four != 4 or size > _BLOCK_MAX:
                    raise MorphodError(f"{path}: no block of scores begins at byte "
                                       f"{file.tell() - 12}")
            block = head + file.read(size)
            if len(block) != 12 + size:
                raise MorphodError(f"{path} ends early")
            yield block
