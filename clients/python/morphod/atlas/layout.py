"""The layout of an atlas file (docs/atlas.md, "A file"): its header and its blocks."""

from __future__ import annotations

import dataclasses
import hashlib
import struct
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from ..errors import MorphodError
from .forms import VOXELS_MAX

if TYPE_CHECKING:
    from numpy.typing import NDArray

MAGIC = b"morphod atlas\r\n\0"
VERSION = 1
MEASURED = 2
"""The version of files with measures."""
MEASURES = (
    "displacement_m", "path_length_m", "mean_speed_m_per_s", "straightness", "heading_error_rad",
    "sideways_m", "peak_height_m", "mean_height_m", "tilt_rad", "yaw_rate_rad_per_s", "air_share",
    "contact_front_share", "contact_back_share", "contact_left_share", "contact_right_share",
    "hops_per_s", "work_j", "cost_of_transport", "peak_strain", "inverted_voxels")
"""All measures, in the order of their bits in a file."""
_ORDER = 0x01020304
_BLOCK = 4096
_NO_VALUE = 0x7fc00000
_VOXELS_OF_WORKSPACE_MAX = 192
_ENVIRONMENTS_MAX = 64
_HEADER = struct.Struct("<16s2I3I I 2I 2I 10Q 32s32s32s 64s Q")
_WORD = struct.Struct("<Q")
_BLOCK_HEADER = struct.Struct("<2IQ")
_ORIENTATIONS = ("canonical", "images")
_REMEDY = "remove it and write the atlas again"
_64_BITS = (1 << 64) - 1


class AtlasError(MorphodError, ValueError):
    """A file is not an atlas, or is damaged, or two atlases do not belong together."""


@dataclasses.dataclass(frozen=True)
class Header:
    """The information in a file's header."""

    workspace: tuple[int, int, int]
    voxels_max: int
    orientations: str
    n_environments: int
    environments_bytes: int
    counts: tuple[int, ...]
    controller_sha256: str
    physics_sha256: str
    environments_sha256: str
    fingerprint: str
    measures: tuple[str, ...] = ()
    header_bytes: int = _HEADER.size


@dataclasses.dataclass(frozen=True, eq=False)
class Block:
    """Up to 4096 bodies of one size: arrays that are views of the mapped file, read-only.

    `position` is that of the first body. `keys` (n,) are uint64, `scores` (n,) float32, `losses`
    (n, environments) float16, and `measures` has float32 (n,) by name.
    """

    voxels: int
    position: int
    keys: NDArray[np.uint64]
    scores: NDArray[np.float32]
    losses: NDArray[np.float16]
    measures: Mapping[str, NDArray[np.float32]]

    def __len__(self) -> int:
        return len(self.keys)


def _padded(n_bytes: int) -> int:
    return (n_bytes + 7) // 8 * 8


def _checked_bytes(n: int, header: Header) -> int:
    """Returns the bytes of a block before its checksum."""
    return (_BLOCK_HEADER.size + 8 * n + _padded(4 * n) + _padded(2 * n * header.n_environments) +
            _padded(4 * n * len(header.measures)))


def _mix(a: int, b: int) -> int:
    product = a * b
    return (product ^ product >> 64) & _64_BITS


def checksum(data: bytes) -> int:
    """Returns the checksum of the bytes of a header or a block, whose number is a multiple of 8."""
    words = struct.unpack(f"<{len(data) // 8}Q", data)
    state = 0x9e3779b97f4a7c15 ^ len(data)
    last = (len(words) - 1) // 2 * 2
    for i in range(0, last, 2):
        state = _mix(words[i] ^ 0xa0761d6478bd642f, words[i + 1] ^ state)
    second = words[last + 1] if last + 1 < len(words) else 0
    state = _mix(words[last] ^ 0xe7037ed1a0b428db, second ^ state)
    return _mix(state ^ 0x8ebc6af09c88c6e3, 0x589965cc75374cc3)


def read_header(data: NDArray[np.uint8]) -> Header:
    """Reads and checks the header of a file with these bytes. Raises `AtlasError`."""
    raw = bytes(data[:_HEADER.size])
    if raw[:16] != MAGIC:
        raise AtlasError("this is not an atlas file: check its name")
    if len(raw) < _HEADER.size:
        raise AtlasError(f"the atlas file is truncated: {_REMEDY}")
    (_, order, version, nx, ny, nz, voxels_max, orientations, n_environments, block,
     environments_bytes, *rest) = _HEADER.unpack(raw)
    counts, (controller, physics, environments, fingerprint, total) = rest[:10], rest[10:]
    if order != _ORDER:
        raise AtlasError("the atlas file has another byte order: write it on a little-endian "
                         "machine")
    if version not in (VERSION, MEASURED):
        raise AtlasError(f"the atlas file has version {version}; this package reads versions "
                         f"{VERSION} and {MEASURED}: use the package version of the program that "
                         "wrote it")
    bits = 0
    if version == MEASURED:  # the checksum comes after the measures
        bits, raw = total, bytes(data[:_HEADER.size + _WORD.size])
        if len(raw) < _HEADER.size + _WORD.size:
            raise AtlasError(f"the atlas file is truncated: {_REMEDY}")
        total, = _WORD.unpack(raw[-8:])
    sound = (total == checksum(raw[:-8]) and (bits > 0) == (version == MEASURED) and
             1 <= voxels_max <= VOXELS_MAX and
             nx > 0 and ny > 0 and nz > 0 and nx * ny * nz <= _VOXELS_OF_WORKSPACE_MAX and
             orientations < len(_ORIENTATIONS) and 1 <= n_environments <= _ENVIRONMENTS_MAX and
             block == _BLOCK and environments_bytes % 8 == 0 and b"\0" in fingerprint and
             not any(counts[voxels_max:]) and sum(counts) > 0)
    if not sound:
        raise AtlasError(f"the header of the atlas file is damaged: {_REMEDY}")
    if bits >> len(MEASURES):
        raise AtlasError("the atlas file has unknown measures: use the package version "
                         "of the program that wrote it")
    header = Header((nx, ny, nz), voxels_max, _ORIENTATIONS[orientations], n_environments,
                environments_bytes, tuple(counts[:voxels_max]), controller.hex(), physics.hex(),
                environments.hex(), fingerprint.partition(b"\0")[0].decode("ascii", "replace"),
                tuple(name for bit, name in enumerate(MEASURES) if bits >> bit & 1), len(raw))
    should = _begin_of_blocks(header) + sum(
        bytes_of for _, _, _, bytes_of in _blocks(header, _begin_of_blocks(header)))
    if should != len(data):
        raise AtlasError(f"the atlas file has {len(data)} bytes, but should have {should}: "
                         f"{_REMEDY}")
    return header


def _begin_of_blocks(header: Header) -> int:
    return header.header_bytes + header.environments_bytes


def _blocks(header: Header, begin: int) -> Iterator[tuple[int, int, int, int]]:
    """Yields the number of voxels, the number of bodies, the place and the bytes of each block."""
    for voxels, count in enumerate(header.counts, 1):
        for before in range(0, count, _BLOCK):
            n = min(_BLOCK, count - before)
            size = _checked_bytes(n, header) + 8
            yield voxels, n, begin, size
            begin += size


def read_blocks(data: NDArray[np.uint8], header: Header) -> list[Block]:
    """Returns views of all blocks. Raises `AtlasError` if the header of a block does not match
    the header of the file."""
    blocks = []
    position = 0
    for voxels, n, begin, _ in _blocks(header, _begin_of_blocks(header)):
        keys_at = begin + _BLOCK_HEADER.size
        if _BLOCK_HEADER.unpack(bytes(data[begin:keys_at])) != (voxels, n, position):
            raise AtlasError(f"a block of the atlas file is damaged: {_REMEDY}")
        scores_at = keys_at + 8 * n
        losses_at = scores_at + _padded(4 * n)
        keys: NDArray[np.uint64] = data[keys_at:scores_at].view("<u8")
        scores: NDArray[np.float32] = data[scores_at:scores_at + 4 * n].view("<f4")
        losses_bytes = 2 * n * header.n_environments
        losses: NDArray[np.float16] = data[losses_at:losses_at + losses_bytes].view(
            "<f2").reshape(n, header.n_environments)
        measures_at = losses_at + _padded(losses_bytes)
        columns = data[measures_at:measures_at + 4 * n * len(header.measures)].view("<f4").reshape(
            len(header.measures), n)
        blocks.append(Block(voxels, position, keys, scores, losses,
                            MappingProxyType(dict(zip(header.measures, columns)))))
        position += n
    return blocks


def _are_wrong(values: NDArray[np.float32]) -> bool:
    """Whether values of a measure are infinite, or a NaN other than the format's."""
    return bool((~np.isfinite(values) & (values.view("<u4") != _NO_VALUE)).any())


def check_all(data: NDArray[np.uint8], header: Header, blocks: list[Block]) -> None:
    """Checks every byte of a file: checksums, the order of keys, and that values are numbers.
    Raises `AtlasError`."""
    begin = _begin_of_blocks(header)
    environments = bytes(data[header.header_bytes:begin])
    if hashlib.sha256(environments).hexdigest() != header.environments_sha256:
        raise AtlasError(f"the environments of the atlas file are damaged: {_REMEDY}")
    last: dict[int, np.uint64] = {}
    for block, (voxels, _, at, size) in zip(blocks, _blocks(header, begin)):
        raw = bytes(data[at:at + size])
        ascends = bool((block.keys[1:] > block.keys[:-1]).all()) and (
            voxels not in last or bool(block.keys[0] > last[voxels]))
        last[voxels] = block.keys[-1]
        if (checksum(raw[:-8]) != struct.unpack("<Q", raw[-8:])[0] or not ascends or
                np.isnan(block.scores).any() or np.isnan(block.losses).any() or
                any(_are_wrong(values) for values in block.measures.values())):
            raise AtlasError(f"a block of the atlas file is damaged or unsorted: {_REMEDY}")
