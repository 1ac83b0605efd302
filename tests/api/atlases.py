"""Atlas files for tests, and a plain reading of them that shares no code with the service."""

import functools
import math
import pathlib
import struct
import subprocess
import tempfile

from service import BINARY

WRITER = pathlib.Path(BINARY).parents[2] / "tests" / "unit" / "atlas" / "atlas-file"
SIDES = (6, 6, 4)
INFINITY = float("inf")
MEASURES = ("displacement_m", "path_length_m", "mean_speed_m_per_s", "straightness",
            "heading_error_rad", "sideways_m", "peak_height_m", "mean_height_m", "tilt_rad",
            "yaw_rate_rad_per_s", "air_share", "contact_front_share", "contact_back_share",
            "contact_left_share", "contact_right_share", "hops_per_s", "work_j",
            "cost_of_transport", "peak_strain", "inverted_voxels")


def write(path, voxels=5, levels=1000, seed=1, orientations="canonical", side=0, measures=()):
    """Writes a file with invented losses and measures (tests/unit/atlas/atlas_file.c)."""
    bits = sum(1 << MEASURES.index(name) for name in measures)
    command = [WRITER, path, voxels, levels, seed, orientations, side, bits]
    subprocess.run([str(part) for part in command], check=True)


@functools.cache
def file_of(voxels=5, levels=1000, seed=1, orientations="canonical", side=0, measures=()):
    """Returns the bytes of such a file."""
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "a.atlas"
        write(path, voxels, levels, seed, orientations, side, measures)
        return path.read_bytes()


def unrank(key, n, of=144):
    """Returns the set of n voxels at a place in the order of their sorted lists."""
    voxels, voxel = [], 0
    while n > 0:
        beginning = math.comb(of - voxel - 1, n - 1)  # sets whose next voxel is this one
        if key < beginning:
            voxels.append(voxel)
            n -= 1
        else:
            key -= beginning
        voxel += 1
    return tuple(voxels)


def cells_of(voxels):
    return [(v // 24, v // 4 % 6, v % 4) for v in voxels]


@functools.cache
def canonical(cells):
    """Returns the voxels of the canonical form, or None if the cells do not fit the workspace."""
    forms = []
    for image in range(8):
        turned = [(y, x, z) if image & 4 else (x, y, z) for x, y, z in cells]
        turned = [(-x if image & 1 else x, -y if image & 2 else y, z) for x, y, z in turned]
        low = [min(axis) for axis in zip(*turned)]
        moved = sorted(tuple(a - b for a, b in zip(cell, low)) for cell in turned)
        sides = tuple(max(axis) + 1 for axis in zip(*moved))
        if all(side <= most for side, most in zip(sides, SIDES)):
            voxels = tuple((x * 6 + y) * 4 + z for x, y, z in moved)
            bits = "".join("1" if v in voxels else "0" for v in range(144))
            forms.append((sides, bits, voxels))
    return min(forms)[2] if forms else None


def in_one_piece(cells):
    reached, rest = {cells[0]}, set(cells[1:])
    while True:
        near = {c for c in rest if any(sum(abs(a - b) for a, b in zip(c, r)) == 1 for r in reached)}
        if not near:
            return not rest
        reached |= near
        rest -= near


def shortest(score):
    """Returns the number in the fewest of 6 to 9 digits that read back as the same float32; None
    for infinity."""
    for digits in range(6, 10) if score < INFINITY else ():
        shown = float(f"{score:.{digits}g}")
        if struct.pack("f", shown) == struct.pack("f", score):
            return shown
    return None


class Plain:
    """All bodies of a file, in lists."""
    def __init__(self, data):
        self.sides = struct.unpack_from("<3I", data, 24)
        n_environments, = struct.unpack_from("<I", data, 44)
        environments_bytes, = struct.unpack_from("<I", data, 52)
        counts = struct.unpack_from("<10Q", data, 56)
        self.controller, self.physics = data[136:168].hex(), data[168:200].hex()
        self.counts = [n for n in counts if n]
        self.voxels, self.scores, self.losses = [], [], []
        version, = struct.unpack_from("<I", data, 20)
        bits, = struct.unpack_from("<Q", data, 296)
        self.measures = {name: [] for m, name in enumerate(MEASURES)
                         if version == 2 and bits >> m & 1}
        at = (312 if version == 2 else 304) + environments_bytes
        while at < len(data):
            n_voxels, n, position = struct.unpack_from("<IIQ", data, at)
            assert position == len(self.voxels)
            keys = struct.unpack_from(f"<{n}Q", data, at + 16)
            scores_at = at + 16 + 8 * n
            losses_at = scores_at + (4 * n + 7) // 8 * 8
            self.voxels += [unrank(key, n_voxels) for key in keys]
            self.scores += struct.unpack_from(f"<{n}f", data, scores_at)
            flat = struct.unpack_from(f"<{n * n_environments}e", data, losses_at)
            self.losses += [flat[i * n_environments:(i + 1) * n_environments] for i in range(n)]
            at = losses_at + (2 * n * n_environments + 7) // 8 * 8
            for k, values in enumerate(self.measures.values()):
                values += struct.unpack_from(f"<{n}f", data, at + 4 * n * k)
            at += (4 * n * len(self.measures) + 7) // 8 * 8 + 8
        self.position = {voxels: i for i, voxels in enumerate(self.voxels)}
        self.order = sorted(range(len(self.scores)), key=lambda i: (self.scores[i], i))

    def bits(self, position):
        return "".join("1" if v in self.voxels[position] else "0" for v in range(144))

    def size(self, n):
        return [i for i in self.order if len(self.voxels[i]) == n]

    def rank(self, position, among=None):
        """Returns rank and percentile."""
        scores = [self.scores[i] for i in (self.order if among is None else among)]
        own = self.scores[position]
        better = sum(score < own for score in scores)
        equal = sum(score == own for score in scores) - 1
        worse = len(scores) - better - equal - 1
        return better + 1, 100 * (worse + equal / 2) / (len(scores) - 1) if len(scores) > 1 else 100

    def percentile(self, name, position):
        """Returns the percentile of a measure among the bodies of the size."""
        values = self.measures[name]
        others = [values[i] for i in self.size(len(self.voxels[position])) if i != position and
                  not math.isnan(values[i])]
        own = values[position]
        if math.isnan(own):
            return None
        return 100 * sum((value < own) + (value == own) / 2 for value in others) / len(
            others) if others else 100

    def by(self, name, highest, among):
        """Returns positions in the order of a measure."""
        values, sign = self.measures[name], -1 if highest else 1
        return sorted(among, key=lambda i: (math.isnan(values[i]), sign * values[i]
                                            if not math.isnan(values[i]) else 0, i))

    @functools.cache
    def neighbors(self, position, steps=("add", "remove")):
        """Returns {position: step}, the best first."""
        cells = cells_of(self.voxels[position])
        found = {}

        def note(changed, step):
            form = canonical(tuple(sorted(changed)))
            other = self.position.get(form)
            if other is not None and other != position and step in steps:
                found.setdefault(other, step)

        def larger(some, step, never=None):
            room = {tuple(c + d * (axis == k) for k, c in enumerate(cell))
                    for cell in some for axis in range(3) for d in (-1, 1)} - set(some) - {never}
            for cell in room:
                note([*some, cell], step)

        larger(cells, "add")
        for gone in cells if len(cells) > 1 else ():
            rest = [cell for cell in cells if cell != gone]
            if in_one_piece(rest):
                note(rest, "remove")
                larger(rest, "move", gone)
        return dict(sorted(found.items(), key=lambda item: (self.scores[item[0]], item[0])))

    def ascend(self, position, steps=("add", "remove")):
        path = [position]
        while True:
            best = next(iter(self.neighbors(path[-1], steps)), None)
            if best is None or self.scores[best] >= self.scores[path[-1]]:
                return path
            path.append(best)

    def body(self, position):
        """Returns the body as replies have it."""
        rank, percentile = self.rank(position)
        bits, score = self.bits(position), self.scores[position]
        body = {"id": f"{int(bits, 2):036x}", "voxels": len(self.voxels[position]),
                "genotype": bits, "position": position,
                "score": shortest(score), "diverged": score == INFINITY,
                "rank": rank, "percentile": percentile}
        if self.measures:
            body["measures"] = {
                name: None if math.isnan(values[position]) else shortest(values[position])
                for name, values in self.measures.items()}
        return body
