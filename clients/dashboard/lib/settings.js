/** The settings of a job as the service used them: in words, and compared with its preset's. */

import { countOf } from './format.js';
import { kindOf } from './kinds.js';
import { taskWords } from './tasks.js';

/** Units at the end of names; the longest come first. */
const UNITS = [['_m_per_s2', 'm/s²'], ['_n_per_m', 'N/m'], ['_per_s', '1/s'], ['_kg', 'kg'],
  ['_m', 'm'], ['_s', 's']];
/** Members whose names are not words. */
const NAMES = { dt_s: 'Time step', n_steps: 'Steps', n_designs: 'Designs', adam: 'Adam',
  every_s: 'Interval (time)', every_steps: 'Interval (steps)', random: 'Random bodies' };
const GROUPS = { '': 'Settings', 'learning.schedule': 'Learning: schedule',
  'learning.adam': 'Learning: Adam' };

const ending = (name) => UNITS.find(([end]) => name.endsWith(end)) ?? ['', ''];
const capital = (text) => text[0].toUpperCase() + text.slice(1);

/** Returns the title of a setting: "Drop height". */
function titleOfSetting(name) {
  return NAMES[name] ?? capital(name.slice(0, name.length - ending(name)[0].length)
    .replaceAll('_', ' '));
}

const figure = (value) => (Number.isInteger(value) && Math.abs(value) >= 10000
  ? value.toLocaleString('en-US') : String(value));

/** Members of `vary` that are not factors. */
const NAMES_ADDED = ['drop_m', 'slope_degrees'];

/** Objects in words, by the name of the member. */
const WORDS = {
  environments: (value) => countOf(value.count, 'listed environment'),
  initial: (value) => (value.campaign ? `the population of campaign ${value.campaign}`
    : countOf(value.count, 'listed design')),
  population: (value) => (value.atlas
    ? `${countOf(value.count, 'body', 'bodies')} of atlas ${value.atlas}, seed ${value.seed}`
    : value.campaign ? `from campaign ${value.campaign}`
    : `from evaluation ${value.evaluation}`),
  aggregate: (value) => Object.values(value).join(' '),
  select_by: ({ measure, direction }) => `${direction} ${measure}`,
  random: ({ seed, first }) => `seed ${seed}, starting at number ${first}`,
  vary: (value) => Object.entries(value)
    .filter(([name, [low, high]]) => NAMES_ADDED.includes(name) || low !== 1 || high !== 1)
    .map(([name, range]) => `${name} ${range.join(' to ')}`).join(', '),
  workspace: (value) => `${value.join(' × ')} voxels`,
  tasks: (value) => value.map((task) => taskWords([{ task }]) || 'photo').join(', '),
};

/** Formats the value of a setting, exactly. */
export function inWords(name, value) {
  if (value === null || value === undefined) return 'none';
  if (typeof value === 'boolean') return value ? 'yes' : 'no';
  if (WORDS[name] && typeof value === 'object') return WORDS[name](value);
  if (Array.isArray(value)) return value.join(', ') || 'none';
  if (typeof value === 'object') return JSON.stringify(value);
  if (typeof value === 'string') return value;
  const [, unit] = ending(name);
  return figure(value) + (unit ? ` ${unit}` : '');
}

const isGroup = (name, value) => value !== null && typeof value === 'object' &&
  !Array.isArray(value) && !WORDS[name];

/** Returns a value as text that does not depend on the order of its members. */
const inOrder = (value) => JSON.stringify(value,
  value?.constructor === Object ? Object.keys(value).sort() : null);

/**
 * Returns the settings as rows, in groups.
 * @param {any} settings
 * @param {any} usual the preset's, of the same shape; undefined where it has none
 * @returns {{group: string, name: string, path: string[], title: string, text: string, value: any,
 *   usual: any, differs: boolean, isUnknown: boolean}[]} isUnknown: the preset does not have it
 */
export function rowsOfSettings(settings, usual, path = []) {
  return Object.entries(settings).flatMap(([name, value]) => {
    const own = usual?.[name];
    if (isGroup(name, value)) return rowsOfSettings(value, own, [...path, name]);
    const differs = own !== undefined && inOrder(own) !== inOrder(value);
    const group = path.join('.');
    return [{ group: GROUPS[group] ?? capital(path.join(': ').replaceAll('_', ' ')), name,
      path: [...path, name], title: titleOfSetting(name), text: inWords(name, value), value,
      usual: differs ? inWords(name, own) : null, differs, isUnknown: own === undefined }];
  });
}

/**
 * Returns the settings of a job with those of its preset. If the service does not store the preset,
 * the one with the fewest differences is assumed.
 * @param {any} job
 * @param {number|null} periodS control period of the controller that it starts with; null: unknown
 * @param {any[]} [places] its environments, which decide where a campaign learns by default
 */
export function settingsOf(job, periodS, places) {
  const kind = kindOf(job);
  const settings = kind.settings(job);
  const own = settings.physics.control_period_s;
  const presets = job.preset ? [job.preset] : kind.presets(job);
  const all = presets.map((preset) => ({ preset,
    rows: rowsOfSettings(settings, kind.usual(job, preset, periodS ?? own, places)) }));
  const differences = ({ rows }) => rows.filter(({ differs }) => differs).length;
  return all.reduce((a, b) => (differences(b) < differences(a) ? b : a));
}
