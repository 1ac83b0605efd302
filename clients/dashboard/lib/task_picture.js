/**
 * Pictures of tasks, drawn from what a request specifies: from above, the path and the light; below
 * them, the ground from the side.
 */

import { svg } from './dom.js';
import { spelledOut } from './tasks.js';

/** Pixels: the box of the path, and the largest scale, per meter. */
const [LEFT, TOP, WIDE, HIGH, SCALE_MAX] = [7, 6, 50, 21, 40];
/** Factor by which the ground is drawn steeper, its largest height above the lowest point, and its
 * position. */
const [STEEPER, GROUND_HIGH, GROUND_Y] = [40, 9, 41];
const START_M = [2.5, 2.5];
/** Distance that the robot walks: the median of random bodies in 4 s. */
const WALK_M = 1.6;
const PARTS = 24;

/** @param {number[]} from @param {number} angle */
const go = ([x, y], angle, lengthM) =>
  [x + lengthM * Math.cos(angle), y + lengthM * Math.sin(angle)];

/** Returns a walk in a direction that may turn, and the light ahead of it. */
function led({ heading_rad: heading = 0, turn_rad_per_s: turn = 0 }) {
  const way = [START_M];
  const angle = (part) => heading + (4 * turn * part) / PARTS;
  for (let i = 0; i < PARTS; i++) way.push(go(way[i], angle(i + 0.5), WALK_M / PARTS));
  return { way, lamp: go(way[PARTS], angle(PARTS), 0.5) };
}

/** Returns the light's own motion: on a line, or around a center. */
function moved({ light_xy_m: lamp, velocity_m_per_s: [dx, dy] = [0, 0], turn_rad_per_s: turn,
  center_m: [cx, cy] = START_M }) {
  const [x, y] = lamp;
  if (!turn) {
    return { way: [START_M, [x - 0.6, y]], lamp, flight: [lamp, [x + 2 * dx, y + 2 * dy]] };
  }
  const flight = Array.from({ length: 17 }, (_, i) => go([cx, cy],
    Math.atan2(y - cy, x - cx) + Math.sign(turn) * 0.2 * i, Math.hypot(x - cx, y - cy)));
  return { way: [], lamp, flight };
}

function followed({ points_m: points }) {
  // Paths there and back on one line are drawn next to each other.
  const isLine = points.every(([, y]) => y === START_M[1]);
  const way = [START_M, ...points].map(([x, y], i) => [x, isLine ? y - 0.14 * i : y]);
  return { way, points: way.slice(1, -1), lamp: way.at(-1) };
}

const SHAPES = { ahead: led, turning: led, path: followed, moving: moved };

/** Returns heights along x: as given, or waves as rough as a random grid. */
function profileOf({ terrain, terrain_heights_m: grid, terrain_sigma_m: sigma = 0 }) {
  const heights = terrain?.heights_m ?? grid?.flat().slice(24, 32) ??
    Array.from({ length: 33 }, (_, i) => sigma * (Math.sin(i * 0.7) + Math.sin(i * 1.9)));
  return heights[0].length ? heights[heights.length >> 1] : heights;
}

const line = (points) => `M${points.map((at) => at.map((value) => value.toFixed(1))).join('L')}`;

/**
 * Returns the picture of a task.
 * @param {string|any[]|undefined} environments of its request; the last of a list is drawn
 */
export function taskPicture(environments) {
  const parts = [];
  const path = (name, d) => parts.push(svg('path', { class: name, d }));
  const dot = (name, at, r) => parts.push(svg('circle', { class: name, cx: at[0], cy: at[1], r }));
  if (typeof environments === 'string') { // of a suite: its twelve tasks
    for (let i = 0; i < 12; i++) dot('lamp', [14 + 12 * (i % 4), 10 + 12 * (i >> 2)], 3);
  } else {
    const environment = environments?.at(-1) ?? { terrain_sigma_m: 0.05 };
    const { guide, objective } = spelledOut(environment.task);
    const light = environment.light_xy_m ?? [4.3, 3.3];
    const { way, lamp, points = [], flight = [] } = SHAPES[guide.kind]?.(guide) ??
      { way: [START_M, light], lamp: light };
    const [[left, right], [low, high]] = [0, 1].map((axis) => {
      const values = [START_M, lamp, ...way, ...flight].map((at) => at[axis]);
      return [Math.min(...values), Math.max(...values)];
    });
    const scale = Math.min(SCALE_MAX, WIDE / (right - left), HIGH / (high - low));
    const place = (at) => [LEFT + WIDE / 2 + (at[0] - (left + right) / 2) * scale,
      TOP + HIGH / 2 - (at[1] - (low + high) / 2) * scale];
    const heights = profileOf(environment);
    const lowest = Math.min(...heights);
    const steep = Math.min(STEEPER, GROUND_HIGH / (Math.max(...heights) - lowest || 1));
    path('ground', line(heights.map((height, i) =>
      [3 + (58 * i) / (heights.length - 1), GROUND_Y - (height - lowest) * steep])));
    if (flight.length) path('flight', line(flight.map(place)));
    if (way.length) path(objective === 'efficient' ? 'saving' : 'route', line(way.map(place)));
    const start = place(START_M);
    if (objective === 'jump') path('route', `M${start}v-9m-4 5l4-5l4 5`);
    dot('start', start, 2.5);
    for (const point of points) dot('point', place(point), 2);
    dot('halo', place(lamp), 6);
    dot('lamp', place(lamp), 3);
  }
  return svg('svg', { viewBox: '0 0 64 44', class: 'sketch', 'aria-hidden': 'true' }, parts);
}
