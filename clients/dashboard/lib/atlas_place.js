/** Pictures of neighbors: a canonical form, turned and moved so that it looks like another body. */

import { WORKSPACE, cellsOf, genotypeOf, genotypeOfId } from './body.js';

/** @type {function(number[]): string} */
const key = (cell) => cell.join(',');

/**
 * Returns the image of a body that shares the most voxels with another one, in the workspace, and
 * its voxels that the other one does not have.
 * @param {string} genotype the body that it is to look like
 * @param {string} id of the body
 * @returns {{genotype: string, added: Set<string>}} added: cells as "x,y,z"
 */
export function placeLike(genotype, id) {
  const other = cellsOf(genotype);
  const taken = new Set(other.map(key));
  let best = { shared: -1, cells: [] };
  for (let k = 0; k < 8; k++) {
    const image = cellsOf(genotypeOfId(`${id}@${k}`));
    const tried = new Set();
    for (const from of image) {
      for (const to of other) {
        const step = to.map((v, axis) => v - from[axis]);
        if (tried.has(key(step))) continue;
        tried.add(key(step));
        const cells = image.map((cell) => cell.map((v, axis) => v + step[axis]));
        const shared = cells.filter((cell) => taken.has(key(cell))).length;
        if (shared > best.shared) best = { shared, cells };
      }
    }
  }
  const isNew = best.cells.map((cell) => !taken.has(key(cell)));
  // It may reach out of the workspace where the other body stands at its edge.
  const back = WORKSPACE.map((side, axis) => {
    const at = best.cells.map((cell) => cell[axis]);
    return Math.max(0, -Math.min(...at)) + Math.min(0, side - 1 - Math.max(...at));
  });
  const cells = best.cells.map((cell) => cell.map((v, axis) => v + back[axis]));
  return { genotype: genotypeOf(cells),
    added: new Set(cells.filter((_, i) => isNew[i]).map(key)) };
}

/** Returns a genotype in the middle of the workspace, on the ground: there is room to build. */
export function centered(genotype) {
  const cells = cellsOf(genotype);
  const step = WORKSPACE.map((side, axis) => {
    const at = cells.map((cell) => cell[axis]);
    const [low, high] = [Math.min(...at), Math.max(...at)];
    return axis === 2 ? -low : Math.floor((side - 1 - high + low) / 2) - low;
  });
  return genotypeOf(cells.map((cell) => cell.map((v, axis) => v + step[axis])));
}
