/** Estimates how long a request will take here from the time that earlier rollouts took (GET
 * /v1/rates). */

import { getJson, post } from './api.js';
import { CAMPAIGN_STEPS, VALIDATION, physicsOf, randomPeriodS } from './defaults.js';
import { h, say } from './dom.js';
import { countOf, duration } from './format.js';

/** Environments, unless a request says otherwise; bodies of a measurement, and their steps. */
const [ENVIRONMENTS, MEASURED, MEASURED_STEPS] = [10, 3, 400];
/** Fewer steps are not enough for an estimate. */
const STEPS_MIN = 10000;
/** The mean number of springs of random bodies; bodies that survive evolution have about twice as
 * many. */
const [RANDOM, EVOLVED] = [250, 500];
/** A gradient takes about as long as this many rollouts. */
const GRADIENT = 6;

/** The number of rollouts at which `auto` starts to compute an evaluation on a device. */
const DEVICE_ROLLOUTS = 1000;

/** Returns roughly the springs of a body, from its voxels: binary or hexadecimal digits. */
const springsOf = ({ voxels, id = voxels }) => 24 * [...id.split('@')[0]].reduce((n, digit) =>
  n + Number('0112122312232334'[parseInt(digit, 16)] ?? 0), 0) ** 0.85 || RANDOM;

/** Returns a number that the time of rollouts is proportional to; for a CPU, each block adds
 * two. */
const sizeOf = ({ rollouts, blocks, springs, steps }, device) =>
  (rollouts + (device === 'cpu' ? 2 * blocks : 0)) * steps * (260 + springs);

/** Returns the kind of rollouts, as a text. A controller whose period is 0 acts in every step. */
const likeOf = ({ device, precision, integrator, dt_s: stepS, control_period_s: period }) =>
  [device, precision, integrator, stepS, period || stepS].join();
const rowOf = (rates, plan, work) => rates.find((row) =>
  row.work === work && row.steps >= STEPS_MIN && likeOf(row) === plan.like);

/**
 * What a request computes.
 * @typedef {Object} Plan
 * @property {any} physics
 * @property {string} precision
 * @property {string} device cpu or cuda: at first, what `auto` stands for if a device works
 * @property {string} [like] the kind of its rollouts
 * @property {{rollouts: number, blocks: number, springs: number}} scoring
 * @property {{rollouts: number, blocks: number, springs: number}|null} [learning] robots
 * @property {any} [isMost] some rollouts may turn out not to be needed
 * @property {boolean} isSure the bodies are known
 */

const partOf = (blocks, worlds, springs) => ({ rollouts: blocks * worlds, blocks, springs });

/**
 * Returns what a request computes; null if it lacks designs.
 * @param {string} kind
 * @param {any} request with all numbers, including those that a preset stands for
 * @param {{periodS: number, environments?: number, isUnknown?: boolean}} of periodS: of the
 *   controller; isUnknown: the bodies to learn on are unknown
 * @returns {Plan|null}
 */
function planOf(kind, request, { periodS, environments = ENVIRONMENTS, isUnknown }) {
  const { physics: own, preset } = request;
  const physics = { ...physicsOf(own === 'paper' || preset === 'paper', periodS),
    ...(typeof own === 'object' && own) };
  const listed = request.designs ?? request.initial?.designs ?? [];
  const springs =
    listed.reduce((sum, one) => sum + springsOf(one) / listed.length, 0) || RANDOM;
  const plan = { physics, precision: request.precision ?? 'float32', device: 'cuda',
    isSure: listed.length > 0 };
  if (kind === 'evaluation') {
    const { best, tolerance, error, random, record, measures, verify } = request;
    const blocks = (listed.length || random?.count || 0) * (tolerance || error ? 5 : 1);
    const isLeft = blocks * environments < DEVICE_ROLLOUTS || plan.precision === 'float64' ||
      tolerance || error || record || verify;
    return blocks ? { ...plan, device: isLeft ? 'cpu' : 'cuda', isMost: best || tolerance,
      isSure: plan.isSure && !(tolerance || record || measures),
      scoring: partOf(blocks, environments, springs) } : null;
  }
  if (kind === 'training') {
    const { steps, batch } = request;
    const { every_steps: every, designs, environments: worlds } =
      /** @type {typeof VALIDATION} */ ({ ...VALIDATION, ...request.validation });
    const times = every ? Math.floor(steps / every) + 1 : 0;
    return { ...plan, isSure: !isUnknown,
      scoring: partOf(times * designs, worlds, RANDOM),
      learning: { ...partOf(steps, batch, springs), blocks: steps * Math.ceil(batch / 32) } };
  }
  const { population, generations, replicates = 1, mode, learning } = request;
  const usual = CAMPAIGN_STEPS[mode];
  const { parent_steps: onParents = usual, child_steps: onChildren = usual, batch = population } =
    learning ?? {};
  const size = generations > 3 ? EVOLVED : springs;
  return { ...plan, isMost: true, isSure: false,
    scoring: partOf(replicates * population * (1 + generations * (usual ? 2 : 1)), environments,
      size),
    learning: usual && partOf(replicates * batch / 32 *
      (onChildren + generations * (onParents + onChildren)), 32, size) };
}

/**
 * Measures a kind of work with a few random bodies, if the service has not yet computed any.
 * @param {Plan} plan
 * @returns {Promise<any[]>} the rates
 */
async function measured(plan) {
  const { items } = await getJson('v1/rates');
  const { dt_s, integrator, control_period_s: period } = plan.physics;
  if (plan.device !== 'cpu' || rowOf(items, plan, 'rollouts')) return items;
  const { items: bodies } = await post('v1/bodies/random', { count: MEASURED });
  for (const { genotype } of bodies) { // one thread computes a body in all its environments
    await post('v1/rollouts', { designs: [{ voxels: genotype }], environments: 'paper-test',
      record: [], precision: plan.precision,
      physics: { dt_s, integrator, control_period_s: period || dt_s, n_steps: MEASURED_STEPS } });
  }
  return (await getJson('v1/rates')).items;
}

/** Returns the seconds of a part of a plan, and what they are based on; undefined: unknown. */
function secondsOf(part, plan, work, rates) {
  const row = rowOf(rates, plan, work);
  const sizeFor = (one, steps) => sizeOf({ ...one, steps }, plan.device);
  return row && { rollouts: row.rollouts, seconds: row.seconds *
    sizeFor(part, plan.physics.n_steps) / sizeFor(row, row.steps / row.rollouts) };
}

/**
 * Describes how long a request takes.
 * @param {Plan|null} plan
 * @param {any[]|null} rates null: unknown
 * @param {number} n threads, or devices
 */
function estimateOf(plan, rates, n) {
  if (!plan) return '';
  const { scoring, learning, device } = plan;
  const both = (gradients, rollouts) => [gradients && countOf(gradients.rollouts, 'gradient'),
    rollouts?.rollouts && countOf(rollouts.rollouts, 'rollout')].filter(Boolean).join(' and ');
  const what = `${plan.isMost ? 'Up to ' : ''}${both(learning, scoring)}`;
  if (!rates) return `${what}.`;
  const scored = secondsOf(scoring, plan, 'rollouts', rates);
  const own = learning && secondsOf(learning, plan, 'gradients', rates);
  const learned = own ?? (learning && scored &&
    secondsOf({ ...learning, rollouts: GRADIENT * learning.rollouts }, plan, 'rollouts', rates));
  if ((!scored && scoring.rollouts) || (learning && !learned)) {
    return `${what}. Nothing similar was measured here.`;
  }
  const seconds = (scored?.seconds ?? 0) + (learned?.seconds ?? 0);
  // The steps of a training run and the generations of a campaign run one after another.
  const leastS = seconds / Math.min(n, scoring.blocks + (learning?.blocks ?? 0));
  const about = seconds < 0.01 ? 'less than' : plan.isSure && own === learned ? 'about' : 'roughly';
  return `${what}: ${about} ${countOf(Number(Math.max(0.01, seconds).toPrecision(2)),
    device === 'cpu' ? 'core-second' : 'device-second')}${
    leastS < 0.01 ? '' : `, at least ${duration(leastS)} here`}. Measured here on ${
    both(own, (scoring.rollouts || !own) && scored)} with the same settings.`;
}

/** Whether devices cannot compute an environment of a request. */
const isUnsuited = ({ terrain }) => terrain?.kind === 'grid';

/**
 * Returns the line of a form that says how long its request will take.
 * @param {string} kind of the job
 */
export async function estimateFor(kind) {
  const [threads, devices] = await Promise.all(['v1/threads', 'v1/devices'].map((path) =>
    getJson(path).catch(() => null)));
  const working = devices?.items.filter(({ state }) => state === 'working').length;
  const element = h('p.wide.muted.estimate', { 'aria-live': 'polite' });
  /** @type {Plan|null} */
  let plan = null;
  /** @type {any[]|null} */
  let rates = null;

  const write = () => say(element, estimateOf(plan, threads && rates,
    (plan?.device === 'cpu' ? threads?.n_threads : working) || 1));

  /**
   * Shows the estimate of a request.
   * @param {any} request with the numbers that its empty fields stand for
   * @param {any[]} controllers
   * @param {{environments?: number, isUnknown?: boolean}} of see planOf
   */
  function show(request, controllers, of) {
    const { controller, kind: name, mode, preset, device = 'auto', environments = [] } = request;
    const named = controller ?? (name === 'pretrain' || mode === 'simultaneous' ? '' : 'default');
    const periodS = named ? controllers.find(({ name, sha256 }) =>
      [name, `sha256:${sha256}`].includes(named))?.control_period_s ?? 0
      : randomPeriodS(preset === 'paper');
    const before = plan?.like;
    plan = planOf(kind, request, { ...of, periodS });
    if (plan) {
      if (device !== 'auto') plan.device = device;
      else if (!working || [environments].flat().some(isUnsuited)) plan.device = 'cpu';
      plan.like = likeOf({ ...plan.physics, ...plan });
    }
    write();
    const like = plan?.like;
    if (!like || like === before) return;
    measured(plan).then((found) => {
      if (like !== plan?.like) return;
      rates = found;
      write();
    }).catch(() => {}); // the number of rollouts is still shown
  }

  return { element, show };
}
