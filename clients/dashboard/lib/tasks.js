/** Tasks: the choice that forms offer, and scores in the unit of a task. */

import { countOf, score } from './format.js';

/** Ground for the tasks in forms: flat, then rougher and rougher. */
const ROUGH = [0.02, 0.04, 0.06];
const onRoughGround = (task) => [{ task },
  ...ROUGH.map((sigma, i) => ({ task, terrain_sigma_m: sigma, seed: i + 1 }))];

/** Ground that rises along x by this much per meter. */
const slope = (rise) => Array.from({ length: 64 },
  (_, k) => Number(((k % 8) * (5 / 7) * rise).toFixed(6)));

/** The sets in which pages score a task; the others are scored in the worlds of the form. */
const SETS = { photo: 'paper-test', walk: 'morpho-12-walk', climb: 'morpho-12-up',
  circle: 'morpho-12-circle', path: 'morpho-12-path', shuttle: 'morpho-12-shuttle' };

/** The tasks in forms and in the bar: title, what the robot is to do, and the environments of a
 * request (undefined: the default set). */
export const TASKS = [
  { name: 'photo', title: 'Reach the light', about: 'Go to ten lights on rough ground (paper-test)',
    environments: undefined },
  { name: 'walk', title: 'Walk', about: 'Walk in one direction for 4 s',
    environments: onRoughGround('walk') },
  { name: 'climb', title: 'Climb', about: 'Gain height on slopes of 1 in 10 and 1 in 7',
    environments: [{ task: 'climb', terrain_heights_m: slope(0.1) },
      { task: 'climb', terrain_heights_m: slope(0.14) }] },
  { name: 'circle', title: 'Circle', about: 'Walk in a direction that turns once in 4 s',
    environments: onRoughGround('circle') },
  { name: 'path', title: 'Path', about: 'Follow three waypoints',
    environments: onRoughGround('path') },
  { name: 'shuttle', title: 'Shuttle', about: 'Walk back and forth, twice',
    environments: onRoughGround('shuttle') },
  { name: 'pursue', title: 'Pursue', about: 'Stay close to a light that flees at 0.3 m/s',
    environments: onRoughGround('pursue') },
  { name: 'efficient', title: 'Walk efficiently', about: 'Walk far with little spring work',
    environments: onRoughGround({ guide: { kind: 'ahead' }, objective: 'efficient' }) },
  { name: 'jump', title: 'Jump', about: 'Jump in place; the light circles once per second',
    environments: [{ task: { guide: { kind: 'moving', light_xy_m: [4, 2.5], turn_rad_per_s: 6.28 },
      objective: 'jump' } }] },
].map((task) => ({ ...task, set: SETS[task.name] }));

/** A path has at most this many waypoints, each this close to the origin: bounds of the API. */
export const POINTS_MAX = 16;
const FAR_M = 1000;
/** Number('') is 0, and Number('0x3') is 3. */
const DECIMAL = /^-?\d+(\.\d+)?$/;

/** Reads waypoints, as x_y,x_y in links; null: they are invalid. @param {string} text */
export function pointsIn(text) {
  const points = text.split(',').map((point) => point.split('_')
    .map((value) => (DECIMAL.test(value) ? Number(value) : NaN)));
  return points.length <= POINTS_MAX && points.every((point) =>
    point.length === 2 && point.every((value) => Math.abs(value) <= FAR_M)) ? points : null;
}

/** Writes waypoints in that form. @param {number[][]} points */
export const pointsText = (points) => points.map((point) => point.join('_')).join(',');

const DRAWN = 'drawn:';

/** Returns the task of following a path that the user drew. @param {number[][]} points */
export const drawnTask = (points) => ({
  name: DRAWN + pointsText(points), title: 'Your path', points,
  about: `Follow your ${countOf(points.length, 'waypoint')}`,
  environments: onRoughGround({ guide: { kind: 'path', points_m: points }, objective: 'follow' }),
});

/** Returns the task that has this name in a link, or undefined. */
export function taskOf(name) {
  const points = name?.startsWith(DRAWN) ? pointsIn(name.slice(DRAWN.length)) : null;
  return points ? drawnTask(points) : TASKS.find((task) => task.name === name);
}

/** The first choice of training runs, which only they offer. */
export const ANY_LIGHT = { name: 'random', title: 'Reach the light',
  about: 'Go to stationary lights', environments: undefined };

/** All tasks of the suite, which only evaluations support. */
export const SUITE = { name: 'morpho-12', title: 'All twelve tasks',
  about: 'Ten worlds of each task (morpho-12)', environments: 'morpho-12', count: 120 };

/** What the names of tasks in requests mean. */
const ahead = { kind: 'ahead' };
const path = (...points) => ({ kind: 'path', points_m: points });
const NAMED = {
  walk: { guide: ahead, objective: 'travel' }, climb: { guide: ahead, objective: 'climb' },
  circle: { guide: { kind: 'turning', turn_rad_per_s: 1.57 }, objective: 'travel' },
  path: { guide: path([3.5, 2.5], [3.5, 3.5], [2.5, 3.5]), objective: 'follow' },
  shuttle: { guide: path([3.25, 2.5], [2.5, 2.5], [3.25, 2.5], [2.5, 2.5]), objective: 'follow' },
  pursue: { guide: { kind: 'moving', light_xy_m: [4, 2.5], velocity_m_per_s: [0.3, 0] },
    objective: 'pursue' },
};

/**
 * Returns a task of a request with its guide and objective.
 * @returns {{guide: any, objective: any}}
 */
export const spelledOut = (task) => NAMED[task] ??
  { guide: { kind: 'fixed' }, objective: 'reach', ...(typeof task === 'object' ? task : {}) };

/** What the scores of objectives measure, with the unit; without a unit, lower is better. */
const closeness = 'mean distance to the light, 1 at the start';
const SCORES = {
  reach: 'distance to the light at the end, 1 at the start', approach: closeness,
  pursue: closeness, travel: 'meters in the direction of the light',
  follow: 'meters along the path, minus the mean distance from it', climb: 'meters of height',
  efficient: 'meters per kilojoule', jump: 'meters of height, minus half the distance',
};

/**
 * Describes what the score of a task is, and which scores are better.
 * @param {string|any[]|undefined} environments
 * @param {string} kind of the job: some show the loss
 */
export function scoreWords(environments = [{}], kind) {
  if (typeof environments === 'string') return 'Score: each task in its own unit';
  const [objective, ...others] = new Set(environments.map(({ task }) =>
    spelledOut(task).objective));
  const isLoss = kind === 'training' || (kind === 'campaign' && objective === 'efficient');
  const words = isLoss || others.length ? undefined : SCORES[objective];
  return words ? `Score: ${words}; ${betterOf(words.startsWith('meters') ? 'm' : '')}`
    : `Loss: ${objective === 'pursue' ? 'more than ' : ''}1 if it stands still; ${betterOf('')}`;
}

/** Values of objectives that are measured in meters, from losses: −scale · ln(loss). */
const SCALES_M = { travel: 1, follow: 1, climb: 0.1, jump: 0.1 };
const VERBS = { travel: 'walked', follow: 'followed', climb: 'climbed', jump: 'jumped' };

/**
 * Returns how to show the scores of a job in meters: a verb, and a function from a mean loss to the
 * value with this loss. That value is at most the mean of the values. Returns null unless all
 * environments have the same objective, one that is measured in meters.
 * @param {{task?: {objective: string}}[]} environments
 */
export function measureOf(environments) {
  const objectives = [...new Set(environments.map(({ task }) => task?.objective ?? 'reach'))];
  const scale = objectives.length === 1 ? SCALES_M[objectives[0]] : undefined;
  if (!scale) return null;
  return { verb: VERBS[objectives[0]],
    valueOf: (loss) => (loss === null || loss === undefined ? null : -scale * Math.log(loss)) };
}

/** Formats a value in meters. */
export const meters = (value) => (value === null || !Number.isFinite(value) ? '–'
  : `${value.toFixed(Math.abs(value) < 0.995 ? 3 : 2)} m`);

/**
 * Formats the result of a rollout: its value with its unit, or its loss; "driven" if the user moved
 * the light, because such a result is not a score in any world.
 * @param {{value?: number|null, unit?: string, loss?: number|null, driven?: boolean}} rollout
 */
export const resultOf = ({ value = null, unit, loss, driven }) => {
  if (driven) return 'driven';
  if (unit === 'm') return meters(value);
  return unit === 'm/kJ' && value !== null ? `${value.toFixed(3)} m/kJ` : score(loss);
};

/** Says which scores are better, for a unit of `resultOf`. */
export const betterOf = (unit) => (unit === 'm' || unit === 'm/kJ' ? '↑ higher is better'
  : '↓ lower is better');

/** Describes the worlds in which pages score a task. */
export const worldWords = ({ set, environments }) => (set ? `mean over the ten worlds of ${set}`
  : environments.length === 1 ? 'in one world' : `mean over ${environments.length} worlds`);

/**
 * Describes a loss of the task `photo`, which is the distance to the light at the end, divided by
 * that at the start: [the emphasized part, the rest of the sentence]. The share of the distance is
 * rounded down.
 */
export function wayOf(loss) {
  if (loss === null) return ['It diverged', ', so it has no score.'];
  if (loss >= 1) return ['It got no closer', ' to the light in 4 s.'];
  const share = Math.floor(1000 * (1 - loss)) / 10;
  return [`${share.toFixed(1)} %`, ' of the way to the light in 4 s'];
}

/** Returns an objective in words: its name, or "1 travel − 0.001 work_j". */
const objectiveWords = (objective) => (typeof objective === 'string' ? objective
  : Object.entries(objective).map(([term, weight], i) => (
    `${weight < 0 ? '− ' : i > 0 ? '+ ' : ''}${Math.abs(weight)} ${term}`)).join(' '));

/**
 * Returns the name of the task of a job in a few words: of a set of the suite its name, or else the
 * objectives of the environments.
 * @param {string|{count: number}} named a set, or how many environments are listed
 * @param {{task?: {objective: string, guide: {kind: string}}}[]} environments
 */
export function taskNameOf(named, environments) {
  const set = typeof named === 'string' ? /^morpho-12-(.+?)(-held-out)?$/.exec(named) : null;
  return set ? set[1] : taskWords(environments) || 'photo';
}

/** Describes where a training run learns: in a set, in listed environments, or in random ones. */
export function worldsOfTraining({ settings: { environments, tasks } }) {
  if (tasks) {
    const names = tasks.map((task) => (task.objective === 'reach' && task.guide.kind === 'fixed'
      ? 'photo' : taskWords([{ task }])));
    return `random terrains, with the tasks ${[...new Set(names)].map((name) => {
      const n = names.filter((other) => other === name).length;
      return n > 1 ? `${n} × ${name}` : name;
    }).join(', ')}`;
  }
  if (typeof environments === 'string') return `environments of ${environments}`;
  return environments ? countOf(environments.count, 'listed environment')
    : 'random terrains and lights';
}

/** Formats a value in the unit of its task: meters, or a share. */
export const inUnit = (value, unit) => (value === null || value === undefined ? '–'
  : unit === 'm' ? meters(value) : value.toFixed(3));

/** Units at the end of the names of measures; the longest of them come first. */
const MEASURED = [['_rad_per_s', 'rad/s'], ['_m_per_s', 'm/s'], ['_per_s', '1/s'], ['_rad', 'rad'],
  ['_m', 'm'], ['_j', 'J']];

/** Returns the name of a measure in words, with its unit: "mean speed, m/s". */
export function measureTitle(name) {
  const [ending, unit] = MEASURED.find(([end]) => name.endsWith(end)) ?? ['', ''];
  const words = name.slice(0, name.length - ending.length).replaceAll('_', ' ');
  return unit ? `${words}, ${unit}` : words;
}

/** Describes the tasks of environments in a word, or returns "" if all are `photo`. */
export function taskWords(environments) {
  const words = new Set(environments.map(({ task }) => (task
    ? `${objectiveWords(task.objective)} (${task.guide.kind})` : '')));
  return [...words].filter(Boolean).join(', ');
}
