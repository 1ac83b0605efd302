"""Canonical forms and keys of bodies (docs/atlas.md, "The bodies"): one at a time with integers,
which takes microseconds, and many at a time with arrays."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

Cell = tuple[int, int, int]

VOXELS_MAX = 10
"""Voxels of the largest bodies of an atlas."""

IMAGES = 8
DIRECTIONS = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))


class Space:
    """The bodies of a workspace as keys: the key of n voxels is the place of the canonical form
    among all sets of n voxels of the workspace.

    The canonical form is the image with the smallest sides (x first) and, among those, the one in
    which the first differing voxel is empty. Its voxels come later, so its key is the largest.
    """

    def __init__(self, workspace: tuple[int, int, int], voxels_max: int) -> None:
        self.workspace = workspace
        self.voxels_max = voxels_max
        nx, ny, nz = workspace
        self.voxels = nx * ny * nz
        self.sets = [math.comb(self.voxels, n) for n in range(voxels_max + 1)]
        # [n][i][v]: how many sets of n voxels come later because their voxel i is above v.
        self._later = [[[math.comb(self.voxels - 1 - v, n - i) for v in range(self.voxels)]
                        for i in range(n)] for n in range(voxels_max + 1)]
        self._later_arrays = [np.array(table, dtype=np.uint64) for table in self._later]
        # Images are taken in a square grid, which mirroring and swapping map to itself. All eight
        # are bits of one integer, the first voxel in the top bit of its image; above them are the
        # projections on x, y and z.
        self._side = max(nx, ny)
        self._grid = self._side * self._side * nz
        self._mask = (1 << self._grid) - 1
        self._images = [self._packed(x, y, z) for x in range(self._side)
                        for y in range(self._side) for z in range(nz)]
        self._by_voxel = [self._images[(x * self._side + y) * nz + z] for x in range(nx)
                          for y in range(ny) for z in range(nz)]
        # From the index in the grid to that in the workspace; those outside are not used.
        self._voxel_of = [(x * ny + y) * nz + z for x in range(self._side)
                          for y in range(self._side) for z in range(nz)]

    def _packed(self, x: int, y: int, z: int) -> int:
        bits = 0
        for k in range(IMAGES):
            a, b = (y, x) if k & 4 else (x, y)
            a = self._side - 1 - a if k & 1 else a
            b = self._side - 1 - b if k & 2 else b
            at = (a * self._side + b) * self.workspace[2] + z
            bits |= 1 << k * self._grid + self._grid - 1 - at
        projections = 1 << x | 1 << self._side + y | 1 << 2 * self._side + z
        return bits | projections << IMAGES * self._grid

    # ---- one body ----

    def key_of_voxels(self, voxels: Iterable[int]) -> tuple[int, int] | None:
        """Returns the number of voxels and the key of a body with these voxel indices of the
        workspace, at most `voxels_max` of them."""
        packed = 0
        for voxel in voxels:
            packed |= self._by_voxel[voxel]
        return self._key(packed)

    def key_of_text(self, text: str) -> tuple[int, int] | None:
        """Returns the same for a genotype of the workspace."""
        packed = 0
        table = self._by_voxel
        voxel = text.find("1")
        while voxel >= 0:
            packed |= table[voxel]
            voxel = text.find("1", voxel + 1)
        return self._key(packed)

    def key_of_cells(self, cells: Iterable[Cell]) -> tuple[int, int] | None:
        """Returns the same for cells anywhere, or None if no image fits the workspace."""
        listed = list(cells)
        x0, y0, z0 = (min(column) for column in zip(*listed))
        packed = 0
        for x, y, z in listed:
            if x - x0 >= self._side or y - y0 >= self._side or z - z0 >= self.workspace[2]:
                return None
            at = ((x - x0) * self._side + y - y0) * self.workspace[2] + z - z0
            packed |= self._images[at]
        return self._key(packed)

    def _key(self, packed: int) -> tuple[int, int] | None:
        form = self._form(packed)
        if form is None:
            return None
        n = form.bit_count()
        later = 0
        for i, terms in enumerate(self._later[n]):
            top = form.bit_length() - 1
            form ^= 1 << top
            later += terms[self._voxel_of[self._grid - 1 - top]]
        return n, self.sets[n] - 1 - later

    def _form(self, packed: int) -> int | None:
        """Returns the canonical form in the grid. The earlier the voxels of an aligned image, the
        greater it is."""
        side, grid = self._side, self._grid
        nx, ny, nz = self.workspace
        projections = packed >> IMAGES * grid
        along_x = projections & (1 << side) - 1
        along_y = projections >> side & (1 << side) - 1
        along_z = projections >> 2 * side
        x0, x1 = (along_x & -along_x).bit_length() - 1, along_x.bit_length() - 1
        y0, y1 = (along_y & -along_y).bit_length() - 1, along_y.bit_length() - 1
        z0 = (along_z & -along_z).bit_length() - 1
        dx, dy = x1 - x0, y1 - y0
        first, last = 0, IMAGES
        upright, turned = dx < nx and dy < ny, dy < nx and dx < ny
        if not upright and not turned:
            return None
        if upright and (dx < dy or not turned):
            last = 4
        elif turned and (dx > dy or not upright):
            first = 4
        smallest = None
        for k in range(first, last):
            a0, a1, b0, b1 = (y0, y1, x0, x1) if k & 4 else (x0, x1, y0, y1)
            a = side - 1 - a1 if k & 1 else a0
            b = side - 1 - b1 if k & 2 else b0
            image = (packed >> k * grid & self._mask) << (a * side + b) * nz + z0
            if smallest is None or image < smallest:
                smallest = image
        return smallest

    def voxels_of_key(self, n: int, key: int) -> list[int]:
        """Returns the voxel indices of a key, ascending."""
        later = self.sets[n] - 1 - key
        voxels: list[int] = []
        voxel = 0
        for terms in self._later[n]:
            while terms[voxel] > later:
                voxel += 1
            later -= terms[voxel]
            voxels.append(voxel)
            voxel += 1
        return voxels

    def cells_of_voxels(self, voxels: Iterable[int]) -> list[Cell]:
        _, ny, nz = self.workspace
        return [(voxel // nz // ny, voxel // nz % ny, voxel % nz) for voxel in voxels]

    # ---- many bodies of one size ----

    def cells_of(self, keys: NDArray[np.uint64], n: int) -> NDArray[np.int16]:
        """Returns the cells (bodies, n, 3) of keys."""
        _, ny, nz = self.workspace
        cells = np.empty((len(keys), n, 3), dtype=np.int16)
        if not len(keys):  # the workspace may be too small for n voxels
            return cells
        later = np.uint64(self.sets[n] - 1) - keys
        for i, terms in enumerate(self._later_arrays[n]):
            # Ascending: the last that is not above.
            from_end = np.searchsorted(terms[::-1], later, side="right") - 1
            later = later - terms[::-1][from_end]
            voxel = self.voxels - 1 - from_end
            cells[:, i, 0], cells[:, i, 1] = voxel // nz // ny, voxel // nz % ny
            cells[:, i, 2] = voxel % nz
        return cells

    def keys_of(self, cells: NDArray[np.int16]) -> tuple[NDArray[np.uint64], NDArray[np.bool_]]:
        """Returns the keys of bodies (bodies, n, 3) anywhere, and whether they fit the
        workspace."""
        n = cells.shape[1]
        nx, ny, nz = self.workspace
        aligned = cells - cells.min(axis=1, keepdims=True)
        side = aligned.max(axis=1)
        dx, dy = side[:, 0], side[:, 1]
        is_low = side[:, 2] < nz
        upright, turned = is_low & (dx < nx) & (dy < ny), is_low & (dy < nx) & (dx < ny)
        later = np.full(len(cells), np.iinfo(np.uint64).max, dtype=np.uint64)
        for swap, used in ((False, upright & ~(turned & (dx > dy))),
                           (True, turned & ~(upright & (dx < dy)))):
            rows = np.flatnonzero(used)
            if not rows.size:
                continue
            body = aligned[rows]
            a, b = (body[:, :, 1], body[:, :, 0]) if swap else (body[:, :, 0], body[:, :, 1])
            z = body[:, :, 2]
            least = later[rows]
            for mirror_a in (a, a.max(axis=1, keepdims=True) - a):
                for mirror_b in (b, b.max(axis=1, keepdims=True) - b):
                    voxels = (mirror_a * ny + mirror_b) * nz + z
                    np.minimum(least, self._later_of(voxels), out=least)
            later[rows] = least
        fits = upright | turned
        return np.where(fits, np.uint64(self.sets[n] - 1) - later, np.uint64(0)), fits

    def _later_of(self, voxels: NDArray[np.int16]) -> NDArray[np.uint64]:
        ordered = np.sort(voxels, axis=1)
        later = np.zeros(len(voxels), dtype=np.uint64)
        for i, terms in enumerate(self._later_arrays[voxels.shape[1]]):
            later += terms[ordered[:, i]]
        return later


def stays_whole(cells: NDArray[np.int16]) -> NDArray[np.bool_]:
    """Returns, for bodies (bodies, n, 3) in one piece, which voxels (bodies, n) can be removed so
    that the rest is in one piece and not empty."""
    bodies, n = cells.shape[:2]
    near = np.zeros((bodies, n), dtype=np.uint16)
    for i in range(n):
        distance = np.abs(cells - cells[:, i:i + 1]).sum(axis=2)
        for k in range(n):
            near[:, i] |= (distance[:, k] == 1).astype(np.uint16) << np.uint16(k)
    whole = np.zeros((bodies, n), dtype=np.bool_)
    for gone in range(n):
        rest = np.uint16((1 << n) - 1 & ~(1 << gone))
        if not rest:
            continue
        reached = np.full(bodies, int(rest) & -int(rest), dtype=np.uint16)
        for _ in range(n):
            before = reached.copy()
            for i in range(n):
                if i != gone:
                    reached |= np.where(reached >> np.uint16(i) & np.uint16(1), near[:, i] & rest,
                                        np.uint16(0))
            if (reached == before).all():
                break
        whole[:, gone] = reached == rest
    return whole


def is_whole(cells: Iterable[Cell]) -> bool:
    """Returns whether cells are one piece; an empty list is not."""
    left = set(cells)
    if not left:
        return False
    edge = [left.pop()]
    while edge:
        for near in around(edge.pop()):
            if near in left:
                left.remove(near)
                edge.append(near)
    return not left


def around(cell: Cell) -> Iterator[Cell]:
    """Yields the six cells next to a cell."""
    x, y, z = cell
    for dx, dy, dz in DIRECTIONS:
        yield x + dx, y + dy, z + dz
