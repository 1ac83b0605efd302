/**
 * The layout of a phylogeny. It uses typed arrays, and no object per design, so that a million
 * designs take a fraction of a second. Designs are numbered in order of birth, so a parent's number
 * is always lower.
 */

/** In a column of parents: no parent. */
const NO_PARENT = 0xffffffff;

/** Colors of operators: random, listed, inherited, mutation, crossover, and those of a study. */
export const OPERATOR_HUES = ['--gray', '--gray', '--green', '--orange', '--blue', '--pink',
  '--bad', '--text'];

/**
 * @typedef {Object} Columns
 * @property {Uint32Array} number ascending; numbers may be missing
 * @property {Uint32Array} parent numbers of the first parents
 * @property {Uint32Array} other_parent numbers of the second parents
 * @property {Uint16Array|Uint32Array} born generations
 * @property {Uint16Array|Uint32Array} died generations; the largest value means alive
 * @property {Uint8Array} operator
 * @property {string[]} [operators] names by number
 * @property {Float32Array} score NaN if a rollout diverged
 * @property {{name: string, unit: string}|null} own_score of a study that has one
 * @property {Uint8Array} lower_bound 1 if the score is a lower bound, because the design could not
 * survive
 * @property {Uint8Array} voxels
 * @property {Uint8Array} footprint columns of the body with a voxel
 */

/** Returns the position of each number among the rows, or -1 if it is missing. */
function placesOf(numbers) {
  const n = numbers.length;
  const last = n ? numbers[n - 1] : -1;
  if (last === n - 1) return null;
  const places = new Int32Array(last + 1).fill(-1);
  for (let i = 0; i < n; i++) places[numbers[i]] = i;
  return places;
}

/**
 * Lays out rows: y from 0 to 1 so that each design lies in the middle of its descendants. Also
 * finds the ancestors of the living.
 * @param {Columns} columns
 * @returns {{y: Float32Array, parentRow: Int32Array, lineage: Uint8Array, order: Uint32Array,
 *            size: Uint32Array, nLineage: number, alive: number}}
 *   size: of the family, a design and its descendants; order: rows, the ancestors of the living
 *   last, to be drawn on top; alive: `died` of the living
 */
export function layout(columns) {
  const { number, parent, other_parent: other, died } = columns;
  const n = number.length;
  const alive = died instanceof Uint16Array ? 0xffff : 0xffffffff;
  const places = placesOf(number);
  const rowOf = (design) => (design === NO_PARENT ? -1 : places ? places[design] ?? -1 : design);

  const parentRow = new Int32Array(n);
  const size = new Uint32Array(n).fill(1);
  const lineage = new Uint8Array(n);
  for (let i = n - 1; i >= 0; i--) {
    const row = rowOf(parent[i]);
    parentRow[i] = row;
    if (died[i] === alive) lineage[i] = 1;
    if (row >= 0) size[row] += size[i];
    if (lineage[i]) {
      if (row >= 0) lineage[row] = 1;
      const second = rowOf(other[i]);
      if (second >= 0) lineage[second] = 1;
    }
  }

  const y = new Float32Array(n);
  const next = new Uint32Array(n);
  let roots = 0;
  for (let i = 0; i < n; i++) {
    const row = parentRow[i];
    let start;
    if (row < 0) {
      start = roots;
      roots += size[i];
    } else {
      start = next[row];
      next[row] += size[i];
    }
    next[i] = start + 1;
    y[i] = (start + size[i] / 2) / Math.max(1, n);
  }

  const order = new Uint32Array(n);
  let [low, high] = [0, n];
  for (let i = n - 1; i >= 0; i--) if (lineage[i]) order[--high] = i;
  for (let i = 0; i < n; i++) if (!lineage[i]) order[low++] = i;
  return { y, parentRow, lineage, size, order, nLineage: n - high, alive };
}

/** Returns the row with the life line nearest to a point, in units of the view; -1 if none is
 * near. */
export function nearest({ born, died }, { y, alive }, x, at, perX, perY, reach) {
  let best = -1;
  let bestDistance = reach * reach;
  for (let i = 0; i < y.length; i++) {
    const dy = (y[i] - at) * perY;
    if (dy * dy >= bestDistance) continue;
    const end = died[i] === alive ? Infinity : Math.max(died[i], born[i]);
    const dx = x < born[i] ? (born[i] - x) * perX : x > end ? (x - end) * perX : 0;
    const distance = dx * dx + dy * dy;
    if (distance < bestDistance) [best, bestDistance] = [i, distance];
  }
  return best;
}
