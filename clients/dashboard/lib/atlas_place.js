/** For pictures of neighbors: turns and moves a canonical form so that it looks like another
 * body. */

import { WORKSPACE, cellsOf, genotypeOf, genotypeOfId } from './body.js';

/** Returns a number for a cell, even for one outside the workspace by less than its sides. Numbers
 * are fast: a page places some twenty bodies at once. */
const nameOf = (x, y, z) => (x + 16) * 4096 + (y + 16) * 64 + z + 16;

/**
 * Returns the image of a body that shares the most voxels with another one, in the workspace, and
 * its voxels that the other one does not have.
 * @param {string} genotype the body that it is to look like
 * @param {string} id of the body
 * @returns {{genotype: string, added: Set<string>}} added: cells as "x,y,z"
 */
export function placeLike(genotype, id) {
  const other = cellsOf(genotype);
  const taken = new Set(other.map(([x, y, z]) => nameOf(x, y, z)));
  let best = { shared: -1, cells: [] };
  for (let k = 0; k < 8; k++) {
    const image = cellsOf(genotypeOfId(`${id}@${k}`));
    const tried = new Set();
    for (const from of image) {
      for (const to of other) {
        const [dx, dy, dz] = to.map((v, axis) => v - from[axis]);
        const name = nameOf(dx, dy, dz);
        if (tried.has(name)) continue;
        tried.add(name);
        let shared = 0;
        for (const [x, y, z] of image) {
          if (taken.has(nameOf(x + dx, y + dy, z + dz))) shared++;
        }
        if (shared > best.shared) {
          best = { shared, cells: image.map(([x, y, z]) => [x + dx, y + dy, z + dz]) };
        }
      }
    }
  }
  const isNew = best.cells.map(([x, y, z]) => !taken.has(nameOf(x, y, z)));
  // The image may extend beyond the workspace if the other body is at its edge.
  const back = WORKSPACE.map((side, axis) => {
    const at = best.cells.map((cell) => cell[axis]);
    return Math.max(0, -Math.min(...at)) + Math.min(0, side - 1 - Math.max(...at));
  });
  const cells = best.cells.map((cell) => cell.map((v, axis) => v + back[axis]));
  return { genotype: genotypeOf(cells),
    added: new Set(cells.filter((_, i) => isNew[i]).map(String)) };
}

/** Returns a genotype in the middle of the workspace, on the ground, so that there is room to
 * build. */
export function centered(genotype) {
  const cells = cellsOf(genotype);
  const step = WORKSPACE.map((side, axis) => {
    const at = cells.map((cell) => cell[axis]);
    const [low, high] = [Math.min(...at), Math.max(...at)];
    return axis === 2 ? -low : Math.floor((side - 1 - high + low) / 2) - low;
  });
  return genotypeOf(cells.map((cell) => cell.map((v, axis) => v + step[axis])));
}
