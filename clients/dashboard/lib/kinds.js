/**
 * The kinds of jobs. Everything that depends on the kind of a job is in a row of this table: its
 * name on pages, the address of its page, its tabs, and how its progress and its best score are
 * described. A new kind needs a row here and a page.
 */

import {
  CAMPAIGN_PRESETS, TRAINING_PRESETS, usualCampaign, usualEvaluation, usualTraining,
} from './defaults.js';
import { count, countOf } from './format.js';

/** Returns the members that only one kind has: a list of jobs has them in a member of that name. */
export const partOf = (job) => job[job.kind] ?? job;

/** Returns the progress of a job; lists have it in a short form. */
const progressIn = (job) => job.progress ?? { under_way: null, total: 0, ...partOf(job) };

/** What is counted within a generation of a campaign, by phase. */
const WITHIN = { learning: 'steps learned', scoring: 'designs scored' };

/** Describes the progress of a job that counts what is done. */
const counted = (done, total, what, secondsLeft) => ({
  share: total ? done / total : 0, text: `${count(done)} of ${count(total)} ${what}`, secondsLeft,
});

const progressOfEvaluation = (job) => (job.n_waiting > 0
  ? counted(job.n_designs - job.n_waiting, job.n_designs, 'designs stored', null)
  : counted(job.rollouts_done, job.rollouts_total, 'rollouts', job.progress?.seconds_left));

function progressOfTraining(job) {
  const progress = progressIn(job);
  const secondsLeft = progress.seconds_left;
  const text = `step ${count(progress.step)} of ${count(progress.steps)}`;
  if (job.phase === 'replaying' && progress.replay_total) {
    return {
      share: progress.replayed / progress.replay_total, secondsLeft,
      text: `${text}; regenerating earlier bodies: ${count(progress.replayed)} of ` +
        count(progress.replay_total),
    };
  }
  return { share: progress.step / progress.steps, text, secondsLeft };
}

function progressOfCampaign(job) {
  const progress = progressIn(job);
  const secondsLeft = progress.seconds_left;
  if (job.phase === 'preparing') {
    const { done, total } = progress;
    return {
      share: total ? done / total : null, secondsLeft,
      text: 'Leaving out pretraining bodies' +
        (total ? `: ${count(done)} of ${count(total)} redrawn` : ''),
    };
  }
  const within = progress.total > 0 ? progress.done / progress.total : 0;
  const generation = progress.generation ?? 0;
  const begun = generation + (progress.under_way === null ? 0 : within);
  const what = progress.total > 0 ? WITHIN[job.phase] : undefined;
  return {
    share: Math.min(1, begun / Math.max(1, progress.generations)),
    text: `generation ${count(generation)} of ${count(progress.generations)}` +
      (what ? `; ${count(progress.done)} of ${count(progress.total)} ${what}` : ''),
    secondsLeft,
  };
}

function progressOfStudy(job) {
  const batches = countOf((progressIn(job).generation ?? -1) + 1, 'batch', 'batches');
  return { share: undefined, text: `${batches} received`, secondsLeft: null };
}

/**
 * A kind of job.
 * @typedef {Object} Kind
 * @property {string} name in the singular
 * @property {string} names in the plural
 * @property {string} path of its resources (v1/…), and of its page (#/…)
 * @property {string} kind as the service calls it
 * @property {(job: any) => boolean} [only] which jobs of that kind these are
 * @property {[string, string][]} tabs of its page: the end of the address, and the name
 * @property {string} loses what is deleted with a job
 * @property {string} rate what its progress counts per second
 * @property {boolean} starts whether there is a form for it
 * @property {string} compares what a page of several of them compares
 * @property {(job: any) => {share: number|null|undefined, text: string, secondsLeft: number|null}}
 *   progress share: null if unknown, undefined if the job has no planned end
 * @property {(job: any) => string|null} [waits] the state in words, if it is a special one
 * @property {(job: any) => number|null|undefined} score its best score, where lower is better; null
 *   before the first; undefined if lists do not have it
 * @property {string} scored what that score is
 * @property {(job: any) => any} worlds where it scores or learns: a named set, {count}, or null
 * @property {(job: any) => string|null} environments the path of its environments
 * @property {(job: any) => any} settings as the service used them, by the names of a request
 * @property {(job: any) => string[]} presets that the settings may come from, if the job does not
 *   say
 * @property {(job: any, preset: string, periodS: number, places?: any[]) => any} usual the settings
 *   of a preset, for a controller with this control period, in these environments
 */

const settingsOfEvaluation = (job) => ({
  n_designs: job.n_designs,
  random: job.random && { seed: job.random.seed, first: job.random.first },
  environments: job.environments, precision: job.precision, record: job.record,
  ...(job.record.length ? { record_stride: job.record_stride } : {}), verify: job.verify,
  best: job.best, measures: job.measures ?? null, tolerance: job.tolerance ?? null,
  displaced_starts: job.displaced_starts ?? null, physics: job.physics,
});

/** @type {Kind} */
const evaluation = {
  name: 'Evaluation', names: 'Evaluations', path: 'evaluations', kind: 'evaluation',
  tabs: [['', 'Results'], ['settings', 'Settings']],
  loses: 'its results and recordings', rate: 'rollouts', starts: true, compares: 'settings',
  progress: progressOfEvaluation, score: () => undefined, scored: 'best score',
  worlds: (job) => job.environments,
  environments: (job) => `v1/evaluations/${job.id}/environments`,
  settings: settingsOfEvaluation, presets: () => [''], usual: usualEvaluation,
};

/** @type {Kind} */
const training = {
  name: 'Training run', names: 'Training runs', path: 'trainings', kind: 'training',
  tabs: [['', 'Curves'], ['settings', 'Settings']],
  loses: 'its curve and checkpoints', rate: 'bodies', starts: true, compares: 'curves',
  progress: progressOfTraining, scored: 'held-out score',
  score: (job) => job.validation?.mean_score ?? partOf(job).score ?? null,
  worlds: (job) => partOf(job).environments ?? job.settings?.environments ?? null,
  environments: () => null,
  settings: (job) => job.settings, usual: usualTraining,
  presets: (job) => Object.keys(TRAINING_PRESETS)
    .filter((name) => job.trainingKind === 'pretrain' || !['phototaxis', 'robust'].includes(name)),
};

/** @type {Kind} */
const campaign = {
  name: 'Campaign', names: 'Campaigns', path: 'campaigns', kind: 'campaign',
  tabs: [['', 'Curves'], ['population', 'Population'], ['phylogeny', 'Phylogeny'],
    ['settings', 'Settings']],
  loses: 'its generations, population, phylogeny and checkpoints', rate: 'rollouts', starts: true,
  compares: 'scores', progress: progressOfCampaign, scored: 'best score',
  score: (job) => job.newest?.score.quantiles.p0 ?? partOf(job).best_score ?? null,
  worlds: (job) => job.settings?.environments ?? partOf(job).environments,
  // Replicates share their environments, and therefore this request.
  environments: (job) => `v1/campaigns/${groupOf(job)?.id ?? job.id}/environments`,
  settings: (job) => job.settings, presets: () => Object.keys(CAMPAIGN_PRESETS),
  usual: usualCampaign,
};

/** @type {Kind} */
const study = {
  ...campaign, name: 'Study', names: 'Studies', starts: false,
  only: (job) => partOf(job).mode === 'study',
  progress: progressOfStudy,
  waits: (job) => (job.state === 'queued' && job.reason ? 'waiting for its client' : null),
};

/** Its page is that of the atlas. @type {Kind} */
const atlas = {
  ...evaluation, name: 'Atlas', names: 'Atlases', path: 'jobs', kind: 'atlas', starts: false,
  tabs: [], loses: 'its settings', score: () => null, environments: () => null,
  progress: ({ atlas: { bodies_done: done, bodies_total: all, progress } }) =>
    counted(done, all, 'bodies', progress.seconds_left),
  worlds: (job) => job.atlas.environments,
};

/** @type {Kind} */
const certificate = {
  ...atlas, name: 'Certificate', names: 'Certificates', path: 'certificates', kind: 'certificate',
  loses: 'its report', worlds: (job) => job.certificate.environments,
  progress: ({ certificate: { rollouts_done: done, rollouts: all, progress } }) =>
    counted(done, all, 'rollouts', progress.seconds_left),
};

/** @type {Object<string, Kind>} */
export const KINDS = { evaluation, training, campaign, study, atlas, certificate };

/** Returns the name of a job's kind in this table. */
export const kindName = (job) => (study.only(job) ? 'study' : job.kind);

/** Returns the row of a job's kind. @returns {Kind} */
export const kindOf = (job) => KINDS[kindName(job)];

/** Returns a resource of its own kind with the members that all jobs have: the `kind` of a training
 * run becomes trainingKind. */
export const asJob = (kind, item) =>
  (kind === 'training' ? { ...item, trainingKind: item.kind, kind } : { ...item, kind });

/** Returns the address of a job's page. */
export const linkOf = (job, tab = '') => (job.kind === 'atlas'
  ? `#/atlas/${job.atlas?.name ?? ''}` : `#/${kindOf(job).path}/${job.id}${tab && `/${tab}`}`);

/** Returns the path of a job as a resource of its kind. */
export const pathOf = (job) => `v1/${kindOf(job).path}/${job.id}`;

/** Describes a job in a few words. */
export const titleOf = (job) =>
  job.label || `${kindOf(job).name} ${job.atlas?.name ?? job.id}`;

/** Returns the group of replicates that a job is in, if it is in one. */
export const groupOf = (job) => partOf(job).group ?? null;

/** Describes which replicate a job is: ", replicate 1 of 3". */
export function replicateOf(job) {
  const group = groupOf(job);
  return group?.replicates > 1 ? `, replicate ${group.replicate + 1} of ${group.replicates}` : '';
}

/** Returns a study's own score, or the measure that ranks a campaign, or null. */
export const ownScoreOf = (job) => partOf(job).own_score ?? null;

/** Returns the seed of a job in a list; undefined if it has none there. */
export const seedOf = (job) => partOf(job).seed;

/** Returns the progress of a job. */
export const progressOf = (job) => kindOf(job).progress(job);

/** Warnings in a few words, by their codes. */
const WARNED = {
  all_diverged: 'every robot diverged', diverged: 'robots diverged',
  no_measure: 'designs lack a value of the measure',
  exhausted: 'no unseen bodies are left', light_near_start: 'a light is near the start',
  unstable_step: 'the time step is too large', every_step: 'the controller acts at every step',
  other_duration: 'rollouts have another duration',
};

/** Describes the state, and warnings that the result does not show. */
export function stateOf(job) {
  const special = kindOf(job).waits?.(job);
  if (special) return special;
  const warned = job.warnings.map(({ code }) => WARNED[code] ?? code);
  return job.state + (warned.length ? `, but ${warned.join(', ')}` : '');
}

/** Returns whether the progress of a job changes without events of the job. */
export const isMoving = (job) =>
  job.state === 'running' || (job.state === 'queued' && job.n_waiting > 0);

/** Describes progress in a few words, for the title of a tab. */
export function shortProgress(job) {
  return isMoving(job) ? progressOf(job).text.split(/[;:]/)[0] : stateOf(job);
}

export const isOver = ({ state }) => ['succeeded', 'failed', 'cancelled'].includes(state);
export const isOpen = ({ state }) => ['queued', 'running', 'paused'].includes(state);

/** Returns how long a job has run, or ran, in seconds; null before its start. */
export function secondsOf({ started_at: started, finished_at: finished }) {
  if (!started) return null;
  return ((finished ? Date.parse(finished) : Date.now()) - Date.parse(started)) / 1000;
}
