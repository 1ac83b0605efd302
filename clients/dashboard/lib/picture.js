/** A drawing of a design: its voxels in isometric projection, as SVG. */

import { cellsOf, hasVoxel } from './body.js';
import { svg } from './dom.js';

const COS = Math.cos(Math.PI / 6);
const SIN = 0.5;

/** Returns where the lattice point (x, y, z) is drawn, one unit per voxel; x runs to the lower
 * right. */
const at = (x, y, z) => [(x - y) * COS, (x + y) * SIN - z];

/** The three visible sides of a voxel, and their corners. */
const SIDES = [
  { step: [0, 0, 1], name: 'voxel-top', corners: [[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]] },
  { step: [0, 1, 0], name: 'voxel-left', corners: [[0, 1, 0], [1, 1, 0], [1, 1, 1], [0, 1, 1]] },
  { step: [1, 0, 0], name: 'voxel-right', corners: [[1, 0, 0], [1, 1, 0], [1, 1, 1], [1, 0, 1]] },
];

/**
 * @param {string} genotype
 * @param {string} [label] read by screen readers; without a label the drawing is decoration
 * @param {Set<string>} [marked] cells as "x,y,z" in a different color
 */
export function picture(genotype, label, marked) {
  // Painter's algorithm: back to front.
  const cells = cellsOf(genotype).sort((a, b) => a[0] + a[1] + a[2] - (b[0] + b[1] + b[2]));
  const paths = [];
  const [low, high] = [[Infinity, Infinity], [-Infinity, -Infinity]];
  for (const [x, y, z] of cells) {
    for (const { step, name, corners } of SIDES) {
      if (hasVoxel(genotype, x + step[0], y + step[1], z + step[2])) continue;
      const points = corners.map(([i, j, k]) => at(x + i, y + j, z + k));
      for (const point of points) {
        for (const axis of [0, 1]) {
          low[axis] = Math.min(low[axis], point[axis]);
          high[axis] = Math.max(high[axis], point[axis]);
        }
      }
      const d = `M${points.map((p) => p.map((v) => v.toFixed(2)).join(' ')).join('L')}Z`;
      const mark = marked?.has(`${x},${y},${z}`) ? ' marked' : '';
      paths.push(svg('path', { class: name + mark, d, 'vector-effect': 'non-scaling-stroke' }));
    }
  }
  if (!cells.length) [low[0], low[1], high[0], high[1]] = [0, 0, 1, 1];
  // Small robots are not enlarged to the size of large ones.
  const [width, height] = [Math.max(high[0] - low[0], 5), Math.max(high[1] - low[1], 4)];
  const [midX, midY] = [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2];
  const box = [midX - width / 2 - 0.1, midY - height / 2 - 0.1, width + 0.2, height + 0.2];
  return svg('svg', {
    viewBox: box.map((v) => v.toFixed(2)).join(' '), class: 'voxels',
    ...(label ? { role: 'img', 'aria-label': label } : { 'aria-hidden': 'true' }),
  }, paths);
}
