/** Tasks: the choice that forms offer, their pictures, and scores in the unit of a task. */

import { svg } from './dom.js';
import { countOf, score } from './format.js';

/** Ground of the tasks in forms: flat, then rougher and rougher. */
const ROUGH = [0.02, 0.04, 0.06];
const onRoughGround = (task) => [{ task },
  ...ROUGH.map((sigma, i) => ({ task, terrain_sigma_m: sigma, seed: i + 1 }))];

/** Ground that rises along x by this much per meter. */
const slope = (rise) => Array.from({ length: 64 },
  (_, k) => Number(((k % 8) * (5 / 7) * rise).toFixed(6)));

/** The sets in which pages score a task; the others are scored in the worlds of the form. */
const SETS = { photo: 'paper-test', walk: 'morpho-12-walk', climb: 'morpho-12-up',
  circle: 'morpho-12-circle', path: 'morpho-12-path', shuttle: 'morpho-12-shuttle' };

/**
 * The tasks in forms and in the bar: title, sentence, what a request has as its environments
 * (undefined: the default set), and a picture: the way as the path of an SVG of 64 × 36, and where
 * the light is.
 */
export const TASKS = [
  { name: 'photo', title: 'Reach the light', about: 'ten lights on rough ground (paper-test)',
    environments: undefined, way: 'M8 28C22 30 34 18 46 12', light: [52, 9] },
  { name: 'walk', title: 'Walk', about: 'in one direction, as far as possible in 4 s',
    environments: onRoughGround('walk'), way: 'M8 24H46', light: [56, 24] },
  { name: 'climb', title: 'Climb', about: 'gain height on slopes of 1 in 10 and 1 in 7',
    environments: [{ task: 'climb', terrain_heights_m: slope(0.1) },
      { task: 'climb', terrain_heights_m: slope(0.14) }],
    way: 'M8 30L48 14', light: [56, 10], ground: 'M2 34L62 10' },
  { name: 'circle', title: 'Circle', about: 'walk in a direction that turns once in 4 s',
    environments: onRoughGround('circle'), way: 'M32 30A11 11 0 1 0 21 19', light: [20, 12] },
  { name: 'path', title: 'Path', about: 'follow three way-points',
    environments: onRoughGround('path'), way: 'M10 30H44V10H22', light: [14, 10],
    points: [[44, 30], [44, 10], [22, 10]] },
  { name: 'shuttle', title: 'Shuttle', about: 'back and forth, twice',
    environments: onRoughGround('shuttle'), way: 'M10 14H48V20H10V26H48', light: [54, 26],
    points: [[48, 20], [10, 20]] },
  { name: 'pursue', title: 'Pursue', about: 'stay close to a light that flees at 0.3 m/s',
    environments: onRoughGround('pursue'), way: 'M8 24H34', light: [52, 24],
    flight: 'M42 24H48M44 20L48 24L44 28' },
  { name: 'efficient', title: 'Walk on little energy', about: 'meters per kilojoule of the springs',
    environments: onRoughGround({ guide: { kind: 'ahead' }, objective: 'efficient' }),
    way: 'M8 26H46', light: [56, 26], ground: 'M8 31H24' },
  { name: 'jump', title: 'Jump', about: 'on the spot; the light circles once per second',
    environments: [{ task: { guide: { kind: 'moving', light_xy_m: [4, 2.5], turn_rad_per_s: 6.28 },
      objective: 'jump' } }],
    way: 'M28 32V10M24 15L28 10L32 15', light: [52, 22], ground: 'M14 33H42' },
].map((task) => ({ ...task, set: SETS[task.name] }));

/** All tasks of the suite, which only evaluations are in. */
export const SUITE = { name: 'morpho-12', title: 'All twelve tasks',
  about: 'ten worlds of each (morpho-12)',
  environments: 'morpho-12', count: 120, light: [32, 18],
  way: 'M32 4L40 9L47 18L40 25L32 31L25 26L15 18L23 9Z',
  ground: 'M32 4V31M15 18H47M23 9L40 25M40 9L25 26' };

/**
 * Returns the picture of a task.
 * @param {{way: string, light: number[], points?: number[][], ground?: string, flight?: string}}
 *   task
 */
export function taskPicture({ way, light, points = [], ground, flight }) {
  const [cx, cy] = light;
  const path = (name, d) => (d ? svg('path', { class: name, d }) : null);
  return svg('svg', { viewBox: '0 0 64 36', class: 'sketch', 'aria-hidden': 'true' },
    [path('ground', ground), path('way', way), path('flight', flight),
      ...points.map(([x, y]) => svg('circle', { class: 'point', cx: x, cy: y, r: 2 })),
      svg('circle', { class: 'halo', cx, cy, r: 6 }),
      svg('circle', { class: 'lamp', cx, cy, r: 3 }),
    ].filter(Boolean));
}

/** Values of objectives that are measured in meters, from losses: −scale · ln(loss). */
const SCALES_M = { travel: 1, follow: 1, climb: 0.1, jump: 0.1 };
const VERBS = { travel: 'walked', follow: 'followed', climb: 'climbed', jump: 'jumped' };

/**
 * Returns how to show the scores of a job in meters: its verb, and a function that turns a mean
 * loss into the value that has this loss. That value is at most the mean of the values. Returns
 * null unless all environments have the same objective, one that is measured in meters.
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
 * the light, because that is the score of no world.
 * @param {{value?: number|null, unit?: string, loss?: number|null, driven?: boolean}} rollout
 */
export const resultOf = ({ value = null, unit, loss, driven }) => {
  if (driven) return 'driven';
  if (unit === 'm') return meters(value);
  return unit === 'm/kJ' && value !== null ? `${value.toFixed(3)} m/kJ` : score(loss);
};

/** Which scores in a unit of `resultOf` are better. */
export const betterOf = (unit) => (unit === 'm' || unit === 'm/kJ' ? '↑ higher is better'
  : '↓ lower is better');

/** Describes the worlds in which pages score a task. */
export const worldWords = ({ set, environments }) => (set ? `mean over the ten worlds of ${set}`
  : environments.length === 1 ? 'in one world' : `mean over ${environments.length} worlds`);

/**
 * Describes a loss of the task `photo`, which is the distance to the light at the end over that at
 * the start: [what stands out, the rest of the sentence]. The share of the way is rounded down.
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

/** Describes where a training learns: in a set, in listed environments, or in random ones. */
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
