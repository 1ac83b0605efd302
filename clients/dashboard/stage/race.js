/** The order in a race, by what its task measures, at every moment. */

import { resultOf } from '../lib/tasks.js';
import { centerOfMass } from './robot.js';

/** A robot whose center of mass is this close to the light, in x and y, has arrived. */
const ARRIVAL_M = 0.1;
/** A waypoint counts as reached within this distance, and a jump only after this time. */
const POINT_M = 0.2;
const SETTLED_S = 0.4;

const distance = ([ax, ay], [bx, by]) => Math.hypot(ax - bx, ay - by);

/** Functions that measure a robot, frame by frame. All get the center of mass and the light. */
const MEASURES = {
  reach: () => distance,
  approach: () => {
    let [first, sum, n] = [0, 0, 0];
    return (center, light) => {
      if (!first) {
        first = distance(center, light);
        return 0;
      }
      sum += distance(center, light);
      n++;
      return 1 - sum / (n * first);
    };
  },
  travel: ({ frameS, world: { task: { guide } } }) => {
    let [before, sum, frame] = [null, 0, 0];
    return (center) => {
      // The heading that the guide had in the middle of the frame.
      const heading = (guide.heading_rad ?? 0) +
        (guide.turn_rad_per_s ?? 0) * (frame - 0.5) * frameS;
      if (before) {
        sum += (center[0] - before[0]) * Math.cos(heading) +
          (center[1] - before[1]) * Math.sin(heading);
      }
      before = center;
      frame++;
      return sum;
    };
  },
  follow: ({ world: { points } }) => {
    let [leg, along, done, off, n] = [0, 0, 0, 0, 0];
    let path;
    return (center) => {
      path ??= [center, ...points];
      const lengthOf = (i) => distance(path[i], path[i + 1]);
      while (leg < path.length - 2 && distance(center, path[leg + 1]) <= POINT_M) {
        done += lengthOf(leg);
        [leg, along] = [leg + 1, 0];
      }
      const length = lengthOf(leg);
      const unit = [0, 1].map((axis) => (path[leg + 1][axis] - path[leg][axis]) / (length || 1));
      const at = Math.min(length, Math.max(0, [0, 1].reduce((sum, axis) =>
        sum + (center[axis] - path[leg][axis]) * unit[axis], 0)));
      along = Math.max(along, at);
      if (n++) off += distance(center, path[leg].map((value, axis) => value + at * unit[axis]));
      return done + along - off / Math.max(1, n - 1);
    };
  },
  climb: () => {
    let first;
    return (center) => center[2] - (first ??= center[2]);
  },
  jump: ({ frameS }) => {
    let [start, top, frame] = [null, 0, 0];
    return (center) => {
      start ??= center;
      if (frame++ * frameS >= SETTLED_S) top = Math.max(top, center[2] - start[2]);
      return top - distance(center, start) / 2;
    };
  },
  way: () => {
    let start;
    return (center) => distance(center, start ??= center);
  },
};
MEASURES.pursue = MEASURES.approach;

const TITLES = {
  reach: 'distance to the light', approach: 'closeness so far', pursue: 'closeness so far',
  travel: 'distance walked', follow: 'progress along the path', climb: 'height gained',
  jump: 'height of the jump', way: 'distance from the start',
};

/**
 * @typedef {Object} Race
 * @property {string} title what is measured
 * @property {string} about how the order is determined
 * @property {boolean} isLower whether a lower value is better
 * @property {boolean} isShare whether values are shares, not meters
 * @property {number} durationS
 * @property {Map<import('./stage.js').Robot, {values: Float32Array, arrivalS: number}>} rows
 *   the value at each frame, and when the robot arrives, or Infinity
 */

/**
 * Measures a race.
 * @param {import('./stage.js').Robot[]} robots in the same world
 * @returns {Race}
 */
export function raceOf(robots) {
  const objective = robots[0].world.task?.objective ?? 'reach';
  const kind = MEASURES[objective] ? objective : 'way';
  const isLower = kind === 'reach';
  const rows = new Map(robots.map((robot) => {
    const measure = MEASURES[kind](robot);
    const { frames, frameS, lights, world } = robot;
    let arrivalS = Infinity;
    const values = Float32Array.from({ length: frames }, (_, frame) => measure(
      centerOfMass(robot, frame), lights ? lights.slice(3 * frame, 3 * frame + 2) : world.light));
    if (isLower && robot.loss !== null) { // a diverged robot arrives nowhere
      const at = values.findIndex((value) => value <= ARRIVAL_M);
      const [before, after] = [values[at - 1], values[at]];
      const share = at > 0 ? (before - ARRIVAL_M) / (before - after) : 1;
      if (at >= 0) arrivalS = Math.max(0, at - 1 + share) * frameS;
    }
    return [robot, { values, arrivalS }];
  }));
  return {
    title: TITLES[kind], isLower, isShare: MEASURES[kind] === MEASURES.approach, rows,
    durationS: Math.max(...robots.map(({ frames, frameS }) => (frames - 1) * frameS)),
    about: isLower ? `A robot arrives when its center of mass is within ${ARRIVAL_M} m of the ` +
      'light; the number is then its time. The others are ordered by their distance.'
      : kind === 'way' ? 'The value of this task is known only at the end. Until then, the order ' +
        'is by the distance from the start.' : 'Ordered by the value of the task so far.',
  };
}

/**
 * Returns the robots in their order at a time, the leader first, with the value as a text.
 * @param {Race} race
 */
export function orderAt({ rows, isLower, isShare, durationS }, timeS) {
  const isEnd = !isLower && timeS >= durationS; // at the end, the exact values of the service are
                                                // used
  const all = [...rows].map(([robot, { values, arrivalS }]) => {
    const frame = Math.min(timeS / robot.frameS, robot.frames - 1);
    const [low, high] = [Math.floor(frame), Math.ceil(frame)];
    let value = values[low] + (values[high] - values[low]) * (frame - low);
    if (robot.loss === null && timeS >= durationS) value = NaN;
    else if (isEnd && robot.value !== undefined) value = robot.value ?? -Infinity;
    if (!Number.isFinite(value)) value = isLower ? Infinity : -Infinity;
    return { robot, value, arrivalS: arrivalS <= timeS ? arrivalS : Infinity };
  });
  const order = (a, b) => (isLower ? a - b : b - a) || 0;
  all.sort((a, b) => (a.arrivalS === b.arrivalS ? order(a.value, b.value)
    : a.arrivalS - b.arrivalS));
  return all.map(({ robot, value, arrivalS }) => {
    const isArrived = arrivalS < Infinity;
    const isMeters = isEnd ? robot.unit === 'm' : !isShare;
    const text = isArrived ? `${arrivalS.toFixed(2)} s` : !Number.isFinite(value) ? '–'
      : isMeters ? `${value.toFixed(2)} m`
        : isEnd && robot.unit ? resultOf(robot) : value.toFixed(3);
    return { robot, text, isArrived };
  });
}

/** Around the first arrival, or before the end, a race is this much slower. */
const SLOWER = 4;
const [BEFORE_S, AFTER_S] = [0.35, 0.2];

/** Returns the part of a race that is shown in slow motion: [from, to] in seconds. */
export function slowPart({ rows, durationS }) {
  const first = Math.min(...[...rows.values()].map(({ arrivalS }) => arrivalS));
  const at = Math.min(first, durationS);
  return [Math.max(0, at - BEFORE_S), Math.min(durationS, at + AFTER_S)];
}

/**
 * Returns the playback speed of a race at a time.
 * @param {number[]} part in slow motion
 */
export const paceAt = ([from, to], timeS) => (timeS >= from && timeS < to ? 1 / SLOWER : 1);

/**
 * Returns the length of a film of a race, and the time in the race at a time in the film.
 * @param {number[]} part in slow motion
 */
export function filmTimes([from, to], durationS) {
  const longer = (to - from) * (SLOWER - 1);
  return {
    durationS: durationS + longer,
    timeAt: (filmS) => (filmS < from ? filmS
      : Math.max(Math.min(to, from + (filmS - from) / SLOWER), filmS - longer)),
  };
}
