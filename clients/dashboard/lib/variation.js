/** Changes to a body in the Lab. A body that walks is in one piece: its voxels share faces. */

import { WORKSPACE, cellsOf, genotypeOf } from './body.js';

/** @type {function(number[]): string} */
const key = (cell) => cell.join(',');
const STEPS = [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]];

/** Returns the connected components of a list of cells, largest first. */
export function components(cells) {
  const left = new Map(cells.map((cell) => [key(cell), cell]));
  const parts = [];
  while (left.size) {
    const [first] = left.values();
    left.delete(key(first));
    const part = [first];
    for (let i = 0; i < part.length; i++) {
      for (const step of STEPS) {
        const near = part[i].map((v, axis) => v + step[axis]);
        if (left.delete(key(near))) part.push(near);
      }
    }
    parts.push(part);
  }
  return parts.sort((a, b) => b.length - a.length);
}

/**
 * Returns the loose voxels of a body: those that are not in its largest piece. The body can walk
 * only without them.
 */
export const looseOf = (genotype) => components(cellsOf(genotype)).slice(1).flat();

/**
 * Sets or clears one voxel.
 * @param {string} genotype
 * @param {number[]} cell
 * @param {boolean} on
 */
export function withVoxel(genotype, [x, y, z], on) {
  const at = (x * WORKSPACE[1] + y) * WORKSPACE[2] + z;
  return genotype.slice(0, at) + (on ? '1' : '0') + genotype.slice(at + 1);
}

/** Returns the union of a body with its mirror image along x (0) or y (1). */
export function mirror(genotype, axis) {
  const cells = cellsOf(genotype);
  const images =
    cells.map((cell) => cell.map((v, i) => (i === axis ? WORKSPACE[axis] - 1 - v : v)));
  return genotypeOf([...cells, ...images]);
}

/** Moves the body by one voxel; returns null if it would leave the workspace. */
export function shift(genotype, [dx, dy, dz]) {
  const cells = cellsOf(genotype).map(([x, y, z]) => [x + dx, y + dy, z + dz]);
  const inside = cells.every((cell) => cell.every((v, axis) => v >= 0 && v < WORKSPACE[axis]));
  return inside ? genotypeOf(cells) : null;
}

/**
 * Reads a body from a text: a robot (ID@K) or an id, 144 voxel digits, a list of cells, or an
 * EvoGym array (rows of materials, 0 is empty), which is given a depth of two voxels.
 * @returns {{id?: string, genotype?: string, lost?: string}} an id or a genotype, and what the
 * conversion lost; throws an explanation
 */
export function readBody(text) {
  const trimmed = text.trim();
  if (/^[0-9a-f]{36}(@[0-7])?$/i.test(trimmed)) return { id: trimmed.toLowerCase() };
  if (/^[01]{144}$/.test(trimmed)) return { genotype: trimmed };
  let rows;
  try {
    rows = JSON.parse(trimmed.replace(/\)|\(|array|np\.|numpy\./g, '')
      .replace(/(\d)\.(?=\D)/g, '$1'));
  } catch {
    rows = trimmed.replaceAll('array', '').replace(/[()]/g, ' ').split('\n')
      .map((line) => line.replace(/[[\],]/g, ' ').trim().split(/\s+/).map(Number));
  }
  if (!Array.isArray(rows) || !rows.length ||
    !rows.every((row) => Array.isArray(row) && row.every(Number.isFinite))) {
    throw new Error(
      'This is not an id, 144 digits, a list of cells, or an EvoGym array.');
  }
  const isList = trimmed.startsWith('[') && trimmed.includes(',');
  const isCells = isList && rows.every((row) => row.length === 3);
  if (isCells && (new Set(rows.map(key)).size !== rows.length || components(rows).length !== 1)) {
    throw new Error('Read as cells [x, y, z], this is not in one piece or repeats a cell; for ' +
      'EvoGym rows, write array([[…], …]).');
  }
  const wrong = rows.flat().find((value) => !Number.isInteger(value) || value < 0);
  if (wrong !== undefined) {
    throw new Error(`${wrong} is not a coordinate or material: use whole numbers from 0.`);
  }
  const materials = isCells ? [] : [...new Set(rows.flat())].filter((one) => one !== 0).sort();
  const cells = isCells ? rows : rows.flatMap((row, up) => row.flatMap((material, x) =>
    (material === 0 ? [] : [2, 3].map((y) => [x, y, rows.length - 1 - up]))));
  const isOutside = (v, axis) => !Number.isInteger(v) || v < 0 || v >= WORKSPACE[axis];
  if (cells.some((cell) => cell.some(isOutside))) {
    throw new Error(`A voxel lies outside the workspace of ${WORKSPACE.join(' × ')}.`);
  }
  const lost = materials.length > 1 ? `Materials ${materials.join(', ')} were merged.` : '';
  return { genotype: genotypeOf(cells), lost };
}
