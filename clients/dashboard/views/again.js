/** Starts a job again: the form of its kind, filled with the settings of a job. */

import { getJson, listOf } from '../lib/api.js';
import { countOf } from '../lib/format.js';
import { kindOf, pathOf } from '../lib/kinds.js';
import { requested } from '../lib/rollouts.js';
import { settingsOf } from '../lib/settings.js';
import { fieldNames, startDialog } from './forms.js';
import { periodOf, placesOf } from './settings.js';

/** Members that a request replaces as a whole. */
const WHOLE = ['selection', 'schedule'];
/** Members that have their own part in the form. */
const OWN_PART = ['environments', 'population', 'initial', 'n_designs', 'random',
  'displaced_starts'];

/** Sets a member of nested objects. */
function put(target, path, value) {
  const name = path.at(-1);
  let at = target;
  for (const step of path.slice(0, -1)) at = at[step] ??= {};
  at[name] = value;
}

/** Returns the member at a path. */
const at = (value, path) => path.reduce((one, name) => one[name], value);

/** Returns the controller of a job for a request: its name, if that still refers to the same
 * file. */
async function controllerOf(job) {
  const file = kindOf(job).kind === 'training' ? job.parent : job.controller;
  if (!file) return undefined;
  const { items } = await getJson('v1/controllers?limit=1000');
  const isSame = items.some((one) => one.name === file.name && one.sha256 === file.sha256);
  return isSame ? file.name : `sha256:${file.sha256}`;
}

/** Returns the founders of a campaign that were listed in its request. */
async function foundersOf(job) {
  const first = await listOf(getJson, `${pathOf(job)}/population`, { generation: 0 });
  return first.filter(({ operator }) => operator === 'listed')
    .map(({ genotype }) => ({ voxels: genotype }));
}

/**
 * The parts that only one kind has: fixed members of the request, values of fields, and what is
 * kept.
 * @type {Object<string, function(any): Promise<{fixed?: any, proposed?: any, kept?: any,
 *   words?: string[], lacks?: string}>>} lacks: what has to be chosen again
 */
const PARTS = {
  async evaluation(job) {
    /** @type {any} */
    const fixed = job.displaced_starts && !job.tolerance ? { error: true } : {};
    if (job.random) {
      fixed.random = { count: job.n_designs, seed: job.random.seed, first: job.random.first };
      return { fixed, words: [countOf(job.n_designs, 'random body', 'random bodies')] };
    }
    const whole = await getJson(pathOf(job));
    if (!whole.results) {
      return { lacks: 'The service does not list its designs; enter designs below.' };
    }
    fixed.designs = whole.results.filter(({ robot }) => robot)
      .map(({ genotype }) => ({ voxels: genotype }));
    return { fixed, words: [countOf(fixed.designs.length, 'design')] };
  },
  async training(job) {
    const { population, n_designs: n } = job.settings;
    if (!population) {
      return n ? { lacks: `The service does not return its ${countOf(n, 'listed design')}: ` +
        'choose the bodies to train on below.' } : {};
    }
    if (population.atlas) return { kept: { population } };
    return { kept: { population: { job: population.campaign ?? population.evaluation, best: n } } };
  },
  async campaign(job) {
    const { initial } = job.settings;
    if (initial === 'random') return {};
    if (initial.campaign) {
      return { fixed: { initial }, words: [`the population of campaign ${initial.campaign}`] };
    }
    return { fixed: { initial: { designs: await foundersOf(job) } } };
  },
};

/** Opens the form of a job's kind with its settings. @param {import('../app.js').app} app */
export async function startAgain(app, job) {
  const kind = kindOf(job).kind;
  const settings = kindOf(job).settings(job);
  const listed = settings.environments ? await placesOf(job, getJson) : [];
  const { preset, rows } = settingsOf(job, await periodOf(job, getJson), listed);
  const { fixed = {}, proposed = {}, kept = {}, words = [], lacks = '' } = await PARTS[kind](job);
  const fields = fieldNames(kind);
  for (const { path, value, differs, isUnknown, title, text, group } of rows) {
    const [name] = path;
    if (path.length === 1 && fields.includes(name)) {
      proposed[name] = value;
    } else if ((differs || (isUnknown && value !== null)) && !OWN_PART.includes(name)) {
      const whole = path.findIndex((step) => WHOLE.includes(step)) + 1;
      const end = whole || path.length;
      put(fixed, path.slice(0, end), at(settings, path.slice(0, end)));
      words.push(`${group === 'Settings' ? title : `${group}: ${title.toLowerCase()}`} ${text}`);
    }
  }
  if (fields.includes('selection') && !fixed.selection) {
    proposed.selection = settings.selection.kind; // its other settings are the defaults
  }
  const named = settings.environments;
  const places = listed.map(requested);
  if (named && places.length) {
    const environments = typeof named === 'string' ? named : places;
    if (kind === 'training') {
      fixed.environments = environments;
      delete fixed.validation?.environments;
      words.push(typeof named === 'string' ? named : countOf(places.length, 'listed environment'));
    } else if (named !== 'paper-test') {
      kept.world = { name: 'same', title: 'Same as before', environments, count: places.length,
        shown: places,
        about: typeof named === 'string' ? named : countOf(places.length, 'listed environment') };
    }
  } else if (named) {
    kept.world = { name: 'same', title: 'Same as before', environments: named, count: 120,
      about: named };
  }
  Object.assign(proposed, {
    mode: job.mode, kind: job.trainingKind, preset, controller: await controllerOf(job),
    label: job.label ?? '', experiment: job.experiment ?? '', weight: job.weight,
    priority: job.priority,
    device: job.device === 'cuda' ? 'cuda' : 'auto',
  });
  for (const [name, value] of Object.entries(proposed)) {
    if (value === undefined || value === null) delete proposed[name];
  }
  if (!fields.includes('priority') && job.priority !== 'batch') {
    fixed.priority = job.priority;
    words.push(`Priority ${job.priority}`);
  }
  kept.words = `Based on ${kindOf(job).name.toLowerCase()} ${job.id}` +
    (words.length ? `, also keeping: ${words.join('; ')}.` : '.') + (lacks && ` ${lacks}`);
  await startDialog(app, kind, fixed, proposed, kept);
}
