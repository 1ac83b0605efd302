"""The paper's genetic algorithm on an atlas (docs/evolution.md, "Variation" and "Selection";
docs/search.md says what differs)."""
import numpy as np

from morphod.atlas import OutsideError
from morphod.atlas.forms import around

POPULATION = 32
SHARE, GROWTH = 0.25, 1.025
DISCARDS_MAX = 1000  # of recombinations, before mutants take their places
ATTEMPTS_MAX = 1 << 10  # without a new child
AT_ONCE = 64


def largest_piece(cells):
    """Returns the largest piece of a set of cells; of equal ones that with the first cell."""
    left = set(cells)
    best = []
    while left:
        first = min(left)
        left.remove(first)
        piece = [first]
        for cell in piece:
            for near in around(cell):
                if near in left:
                    left.remove(near)
                    piece.append(near)
        if len(piece) > len(best):
            best = piece
    return best


def placed(cells, workspace):
    """Moves cells to the floor and the middle of the workspace."""
    offsets = [_offset([cell[axis] for cell in cells], workspace[axis]) for axis in (0, 1)]
    offsets.append(-min(z for _, _, z in cells))
    return frozenset(tuple(at + by for at, by in zip(cell, offsets)) for cell in cells)


def _offset(along, side):
    """Returns the move that brings the mean nearest to the middle; of equal ones the lowest."""
    low, high, n = min(along), max(along), len(along)
    return min(range(-low, side - high),
               key=lambda by: (abs(2 * (sum(along) + n * by) - n * (side - 1)), by))


class Evolution:
    def __init__(self, problem, seed, budget):
        self.problem, self.budget = problem, budget
        self.atlas = problem.atlas
        self.rng = np.random.default_rng(seed)
        nx, ny, nz = self.atlas.workspace
        self.all_cells = [(x, y, z) for x in range(nx) for y in range(ny) for z in range(nz)]
        self.seen = set()

    def genotype(self, body):
        _, ny, nz = self.atlas.workspace
        digits = bytearray(b"0" * len(self.all_cells))
        for x, y, z in body:
            digits[(x * ny + y) * nz + z] = ord("1")
        return digits.decode()

    def new(self, cells):
        """Returns the body of the largest piece, placed; None if it is empty, too large or was
        seen."""
        piece = largest_piece(cells)
        if not 1 <= len(piece) <= self.atlas.voxels_max:
            return None
        body = placed(piece, self.atlas.workspace)
        try:
            position = self.atlas.find(self.genotype(body))
        except OutsideError:
            return None
        if position in self.seen:
            return None
        self.seen.add(position)
        return body

    def mutant(self, parent):
        """Flips voxels until the child is new. Flips that touch neither the body nor what is next
        to it leave it as it is: they count as attempts, and are skipped."""
        n = len(self.all_cells)
        beside = parent | {near for cell in parent for near in around(cell)}
        touches = np.array([cell in beside for cell in self.all_cells])
        rates = np.minimum(GROWTH**np.arange(ATTEMPTS_MAX), self.atlas.voxels_max) / n
        for first in range(0, ATTEMPTS_MAX, AT_ONCE):
            flips = self.rng.random((AT_ONCE, n)) < rates[first:first + AT_ONCE, np.newaxis]
            for row in flips[(flips & touches).any(axis=1)]:
                child = self.new(parent ^ {self.all_cells[i] for i in np.flatnonzero(row)})
                if child is not None:
                    return child
        return None

    def recombined(self, group, n):
        """Returns up to n children of a group."""
        children, discards = [], 0
        while len(children) < n and len(group) > 1 and discards < DISCARDS_MAX:
            one, other = self.rng.choice(len(group), 2, replace=False)
            child = self.new(group[one] ^ group[other])
            discards = 0 if child else discards + 1
            children += [child] if child else []
        while len(children) < n:
            child = self.mutant(group[self.rng.integers(len(group))])
            if child is None:
                break
            children.append(child)
        return children

    def score(self, bodies):
        """Returns (loss, body) of the bodies within the budget."""
        bodies = bodies[:self.budget - self.problem.evaluations]
        return [(self.problem.evaluate(self.genotype(body)), body) for body in bodies]

    def run(self):
        initial = []
        for _ in range(ATTEMPTS_MAX):
            body = self.new(self.atlas.cells(self.problem.random(self.rng)))
            initial += [body] if body else []
            if len(initial) == POPULATION:
                break
        parents = sorted(self.score(initial), key=lambda scored: scored[0])
        while self.problem.evaluations < self.budget:
            order = self.rng.permutation(len(parents))
            mutating = round(SHARE * len(parents))
            bodies = [parents[i][1] for i in order]
            mutants = [self.mutant(body) for body in bodies[:mutating]]
            mutants = [body for body in mutants if body]
            children = mutants + self.recombined(bodies[mutating:], len(bodies) - mutating)
            if not children:
                return  # all bodies near the population were seen
            # The sort is stable: of equal ones, the older.
            parents = sorted(parents + self.score(children),
                             key=lambda scored: scored[0])[:POPULATION]


def paper_ga(problem, seed, budget):
    Evolution(problem, seed, budget).run()
