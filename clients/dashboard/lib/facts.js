/** Facts that a list of jobs lacks: the name of each task, and the best design of an evaluation. */

import { getJson, withQuery } from './api.js';
import { countOf, inOwnUnit, score, scoreOf } from './format.js';
import { kindOf, ownScoreOf } from './kinds.js';
import { environmentSet, environmentsAt, isSuite } from './rollouts.js';
import { measureOf, meters, taskNameOf } from './tasks.js';

/** Evaluations with more designs are not read for a list. */
const READ_MAX = 100;
/** Requests at once: the service answers pages first. */
const AT_ONCE = 4;

const facts = new Map(); // of jobs, by id
let busy = 0;
/** Functions that start the work that waits, oldest first. @type {Set<() => void>} */
const waiting = new Set();

/**
 * Runs work when few other requests do. Work that still waits when the signal aborts is dropped.
 * @template T
 * @param {() => Promise<T>} work
 * @param {AbortSignal} signal
 */
async function inTurn(work, signal) {
  if (busy < AT_ONCE) {
    busy++;
  } else {
    await new Promise((resolve, reject) => {
      const drop = () => {
        waiting.delete(start);
        reject(signal.reason);
      };
      const start = () => { // starts in place of work that ended
        waiting.delete(start);
        signal.removeEventListener('abort', drop);
        resolve();
      };
      waiting.add(start);
      signal.addEventListener('abort', drop);
    });
  }
  try {
    signal.throwIfAborted();
    return await work();
  } finally {
    const [next] = waiting;
    if (next) next();
    else busy--;
  }
}

async function worldsOf(job) {
  const kind = kindOf(job);
  const named = kind.worlds(job);
  if (named === null) return { task: 'random terrains', measure: null };
  if (isSuite(named)) return { task: 'all twelve', measure: null };
  const path = kind.environments(job);
  if (typeof named !== 'string' && !path) {
    return { task: countOf(named.count, 'environment'), measure: null };
  }
  const environments = typeof named === 'string' ? await environmentSet(named)
    : await environmentsAt(path);
  return { task: taskNameOf(named, environments), measure: measureOf(environments) };
}

/** Returns the best design of an evaluation; null if it is not known here. */
async function bestOfEvaluation(job) {
  if (job.state !== 'succeeded' || job.n_designs > READ_MAX || isSuite(job.environments)) {
    return null;
  }
  const path = withQuery(`v1/evaluations/${job.id}/results`, { limit: READ_MAX, whole: true });
  const { items } = await getJson(path);
  const scored = items.filter((one) => one.score !== null && one.score !== undefined);
  if (!scored.length) return null;
  const best = scored.reduce((a, b) => (b.score < a.score ? b : a));
  return { score: best.score, isUp: best.unit === 'm',
    text: best.unit === 'm' && best.value !== null ? meters(best.value) : scoreOf(best) };
}

/**
 * Loads the facts of a job once: {task, measure, best}. They never change, except that an
 * evaluation has a best only once it has succeeded. If the signal aborts, what was not yet
 * requested is never requested, and the promise is rejected.
 * @param {any} job
 * @param {AbortSignal} signal
 */
export function factsOf(job, signal) {
  const known = facts.get(job.id);
  if (known && known.state === job.state) return known.load;
  const load = inTurn(async () => {
    const own = await worldsOf(job);
    const best = kindOf(job).score(job) === undefined ? await bestOfEvaluation(job) : null;
    return { ...own, best };
  }, signal);
  const entry = { state: job.state, load, value: known?.value };
  load.then((value) => { entry.value = value; }, () => {
    if (facts.get(job.id) === entry) facts.delete(job.id);
  });
  facts.set(job.id, entry);
  return load;
}

/** Returns the facts of a job if they are loaded. */
export const knownFacts = (job) => {
  const known = facts.get(job.id);
  return known?.state === job.state ? known.value : undefined;
};

/**
 * Returns the best score of a job: {score, text, isUp, own}; null before the first, or if it is not
 * known. isUp: higher is better in the unit of the text; score: lower is always better.
 */
export function bestOf(job) {
  const known = knownFacts(job);
  const value = kindOf(job).score(job);
  if (value === undefined) return known?.best ? { ...known.best, own: null } : null;
  if (value === null) return null;
  const own = ownScoreOf(job);
  if (own) return { score: value, text: inOwnUnit(own, value), isUp: false, own };
  const measure = known?.measure;
  return measure ? { score: value, text: meters(measure.valueOf(value)), isUp: true, own: null }
    : { score: value, text: score(value), isUp: false, own: null };
}
