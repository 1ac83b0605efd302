/** Recordings of a drive, for the stage to play and export, and the path of the light. */

import { POINTS_MAX } from '../lib/tasks.js';
import { repeat } from './live.js';
import { heightAt } from './math.js';

/** Points this close to the rest of a path are left out. */
const CLOSE_M = 0.05;

/** Returns the windows that have played, or play now. */
const playedOf = ({ windows, first, current }) => windows.slice(0, current - first + 1);

/**
 * Returns the robots of a drive with all of their frames that are kept, up to the one that is
 * shown.
 * @param {import('./drive.js').Drive} drive
 * @param {import('./live.js').Live} live
 * @returns {import('./stage.js').Robot[]}
 */
export function drivenRobots(drive, live) {
  const { perWindow, frameS } = live;
  const played = playedOf(drive);
  // If earlier windows were discarded, the first one that is kept is needed only for its last
  // frame.
  const skipped = drive.first > 0 ? 1 : 0;
  const start = (drive.first + skipped) * perWindow;
  const frames = Math.max(1, Math.round(drive.timeS / frameS) - start + 1);
  const rest = played.slice(skipped);
  const lights = new Float32Array(3 * frames);
  for (let frame = 0; frame < frames; frame++) {
    const window = rest[Math.max(0, Math.ceil(frame / perWindow) - 1)] ?? played.at(-1);
    const [x, y] = window.light;
    lights.set([x, y, heightAt(live.world, x, y)], 3 * frame);
  }
  const world = { ...live.world, light: [lights[0], lights[1]] };
  return live.robots.map((robot, i) => {
    const { nMasses, nSprings } = robot.body;
    const joined = (name, perFrame, Type, from) => {
      const all = new Type((1 + rest.length * perWindow) * perFrame);
      const first = skipped ? played[0].parts[i]?.[name].slice(-perFrame) : from;
      if (first) all.set(first);
      rest.forEach(({ parts }, k) => {
        const at = (1 + k * perWindow) * perFrame;
        if (parts[i]) all.set(parts[i][name], at);
        else repeat(all, at, perFrame, perWindow);
      });
      return all.subarray(0, frames * perFrame);
    };
    return {
      ...robot, frames, frameS, lights, world, centers: undefined, gpu: undefined,
      track: joined('track', 3 * nMasses, Float32Array, live.starts[i]),
      actuation: robot.actuation && joined('actuation', nSprings, Int8Array, null),
      contacts: robot.contacts && joined('contacts', nMasses, Uint8Array, null),
    };
  });
}

/**
 * Returns the path of the light, as at most 16 points.
 * @param {import('./drive.js').Drive} drive
 */
export function pathOf(drive) {
  const points = [];
  for (const { light: [x, y] } of playedOf(drive)) {
    const last = points.at(-1);
    if (!last || last[0] !== x || last[1] !== y) points.push([x, y]);
  }
  return inFew(points, POINTS_MAX).path
    .map((point) => point.map((value) => Math.round(value * 100) / 100));
}

/**
 * Returns a path with at most this many points, and whether it is coarser than usual, because it
 * would have more.
 */
export function inFew(points, most, close = CLOSE_M) {
  const path = simplified(points, close);
  return path.length > most ? inFew(points, most, close * 1.25)
    : { path, isCoarse: close > CLOSE_M };
}

/** Leaves out points that are closer than this to the line between the others (Ramer, Douglas and
 * Peucker). */
function simplified(points, close) {
  if (points.length < 3) return points;
  const [from, to] = [points[0], points.at(-1)];
  const [dx, dy] = [to[0] - from[0], to[1] - from[1]];
  const squared = dx * dx + dy * dy;
  let [farthest, most] = [0, close];
  points.slice(1, -1).forEach(([x, y], i) => {
    const along = squared
      ? Math.min(1, Math.max(0, ((x - from[0]) * dx + (y - from[1]) * dy) / squared)) : 0;
    const off = Math.hypot(x - from[0] - along * dx, y - from[1] - along * dy);
    if (off > most) [farthest, most] = [i + 1, off];
  });
  if (!farthest) return [from, to];
  return simplified(points.slice(0, farthest + 1), close).slice(0, -1)
    .concat(simplified(points.slice(farthest), close));
}
