/**
 * Lanes of a race. All robots start at the same place; each is drawn with its own shift across the
 * line from the start to the light, with a strip of its terrain. Recordings are not changed.
 */

import { heightAt, project } from './math.js';
import { centerOfMass } from './robot.js';

/** Maximum number of lanes, and that for narrow canvases: more would be too thin to see. */
const LANES_MAX = 16;
const FEW_LANES = 8;
export const NARROW_PX = 640;
/** Margin around the area of the robots and their lights, and gap between lanes. */
const MARGIN_M = 0.06;
const GAP_M = 0.05;
/** Maximum distance to the side within a lane; smaller for many robots. */
const strayM = (n) => (n <= 4 ? 1.3 : n <= 8 ? 0.75 : 0.5);
/** With little perspective, robots in far lanes are as large as others. */
const LENS = 3;
/** A light that leads is drawn this close to its robot, to stay within the lane. */
const LEAD_M = 0.45;
const LAMP_M = 0.06;
/** Masses are checked in every n-th frame. */
const EVERY = 3;

/** Returns whether the light of a robot only shows the way: the distance to it does not count. */
const isGuide = ({ lights, world: { task } }) => Boolean(lights && task) &&
  !['reach', 'approach', 'pursue'].includes(task.objective);

/** Returns where a robot's light is drawn at a time, in frames. */
export function lampOf(robot, frame, isInLane = false) {
  const { world, lights } = robot;
  let [x, y] = world.light;
  if (lights) {
    const row = Math.floor(frame);
    [x, y] = lights.slice(3 * row, 3 * row + 2);
    if (isInLane && isGuide(robot)) {
      const [cx, cy] = centerOfMass(robot, frame);
      const away = Math.hypot(x - cx, y - cy);
      const share = Math.min(1, LEAD_M / (away || 1));
      [x, y] = [cx + (x - cx) * share, cy + (y - cy) * share];
    }
  }
  return [x, y, heightAt(world, x, y) + LAMP_M];
}

/** Returns the robots that have lanes: if there are too many, those with the best scores. */
function chosen(robots, max) {
  if (robots.length <= max) return robots;
  const better = (a, b) => (a.loss ?? Infinity) - (b.loss ?? Infinity) || 0;
  const best = new Set([...robots].sort(better).slice(0, max));
  return robots.filter((robot) => best.has(robot));
}

/** Returns how many lanes there are at most in a picture of this width on the page. */
export const lanesIn = (widthPx) => (widthPx < NARROW_PX ? FEW_LANES : LANES_MAX);

/**
 * Returns the lanes of a race, in the order of the robots from left to right. Coordinates along and
 * across a lane are in meters from the start; `lane` has their ranges. Ghosts share the whole
 * ground: nothing is shifted, and there is no `lane`.
 * @param {import('./stage.js').Robot[]} all
 * @param {number} max number of lanes
 */
export function lanesOf(all, max, areGhosts = false) {
  const robots = chosen(all, max);
  const [first] = robots;
  const start = centerOfMass(first, 0);
  const toLight = first.world.light.map((value, axis) => value - start[axis]);
  const away = Math.hypot(...toLight);
  const [ax, ay] = away > 0.01 ? toLight.map((value) => value / away) : [1, 0];
  const goal = !first.lights && away > 0.01 ? away : 0;
  let [from, to, low, high, top] = [0, goal, 0, 0, 0];
  const cover = (x, y) => {
    const [dx, dy] = [x - start[0], y - start[1]];
    const [along, across] = [dx * ax + dy * ay, dx * ay - dy * ax];
    if (!(Math.hypot(dx, dy) < 20)) return; // it diverged
    [from, to] = [Math.min(from, along), Math.max(to, along)];
    [low, high] = [Math.min(low, across), Math.max(high, across)];
  };
  for (const robot of robots) {
    const { track, frames, body: { nMasses } } = robot;
    for (let frame = 0; frame < frames; frame += EVERY) {
      for (let at = 3 * frame * nMasses, end = at + 3 * nMasses; at < end; at += 3) {
        cover(track[at], track[at + 1]);
        if (track[at + 2] < 3) top = Math.max(top, track[at + 2]);
      }
      if (robot.lights) cover(...lampOf(robot, frame, !areGhosts));
    }
  }
  for (const [x, y] of first.world.points ?? []) cover(x, y);
  const stray = strayM(areGhosts ? 1 : robots.length);
  const lane = [from - 0.25, to + 0.3, Math.max(low, -stray) - MARGIN_M,
    Math.min(high, stray) + MARGIN_M];
  const pitch = lane[3] - lane[2] + GAP_M;
  const shifts = new Map(robots.map((robot, i) => {
    const across = areGhosts ? 0 : (i - (robots.length - 1) / 2) * pitch;
    return [robot, [ay * across, -ax * across, 0]];
  }));
  const side = ((areGhosts ? 1 : robots.length) * pitch) / 2;
  const ground = heightAt(first.world, start[0], start[1]);
  const middle = (lane[2] + lane[3]) / 2;
  const sides = [middle - side, middle + side];
  const corners = [lane[0], lane[1]].flatMap((along) => sides.flatMap((across) =>
    [ground, Math.max(top, ground + 0.3)].map((z) =>
      [start[0] + along * ax + across * ay, start[1] + along * ay - across * ax, z])));
  return { robots, shifts, lane: areGhosts ? null : lane, lens: areGhosts ? 1 : LENS, corners,
    along: [ax, ay], course: [start[0], start[1], ax, ay], goal,
    marks: first.world.task?.guide.kind === 'ahead' ? 0.5 : 0 };
}

/** Half of the height of a picture at a distance of 1 m. */
const HALF_M = Math.tan((19 * Math.PI) / 180);
/** Pitches to try for a race; the one at which the ground appears largest is used. */
const PITCHES = [1.15, 0.9, 0.6];
/** Returns how large the ground of the lanes is in a picture. */
const sizeIn = ({ pitch, distanceM }) => Math.sin(pitch) / distanceM ** 2;

/**
 * Points a camera so that all lanes fit in a view of this size in pixels. The robots walk away from
 * it.
 * @param {ReturnType<typeof lanesOf>} lanes
 * @param {import('./camera.js').Camera} camera
 * @param {number} covered share of the width, at the right, that the list of robots covers
 */
export function frameLanes({ corners, lens, along: [ax, ay] }, camera, width, height, covered) {
  const views = PITCHES.map((pitch) => {
    const view = Object.assign(Object.create(Object.getPrototypeOf(camera)), camera, {
      yaw: Math.atan2(ax, ay), pitch, lens, distanceM: 6,
    });
    view.target = [0, 1, 2].map((axis) => corners.reduce((sum, at) => sum + at[axis], 0) / 8);
    for (let i = 0; i < 8; i++) {
      const matrix = view.matrix(width, height);
      const seen = corners.map((at) => project(matrix, at));
      const [[left, right], [bottom, above]] = [0, 1].map((axis) => {
        const all = seen.map((at) => at[axis]);
        return [Math.min(...all), Math.max(...all)];
      });
      const scale = HALF_M * view.distanceM;
      view.move(((left + right) / 2 + covered) * scale * (width / height),
        (((bottom + above) / 2) * scale) / Math.sin(view.pitch));
      view.distanceM *= Math.max((right - left) / (1.9 - 2 * covered), (above - bottom) / 1.8);
    }
    return view;
  });
  Object.assign(camera, views.reduce((best, view) =>
    (sizeIn(view) > sizeIn(best) ? view : best)));
}
