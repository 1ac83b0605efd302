/** What a request will take here, from the time that earlier rollouts took (GET /v1/rates). */

import { getJson, post } from './api.js';
import { CAMPAIGN_STEPS, VALIDATION, physicsOf, randomPeriodS } from './defaults.js';
import { h, say } from './dom.js';
import { countOf, duration } from './format.js';

/** Environments, unless a request says otherwise; bodies of a measurement, and their steps. */
const [ENVIRONMENTS, MEASURED, MEASURED_STEPS] = [10, 3, 400];
/** Fewer steps say little. */
const STEPS_MIN = 10000;
/** The mean number of springs of random bodies; their survivors have about twice as many. */
const [RANDOM, EVOLVED] = [250, 500];
/** A gradient takes about as long as this many rollouts. */
const GRADIENT = 6;

/** Rollouts from which `auto` computes an evaluation on a device. */
const DEVICE_ROLLOUTS = 1000;

/** Returns roughly the springs of a body, from its voxels: binary or hexadecimal digits. */
const springsOf = ({ voxels, id = voxels }) => 24 * [...id.split('@')[0]].reduce((n, digit) =>
  n + Number('0112122312232334'[parseInt(digit, 16)] ?? 0), 0) ** 0.85 || RANDOM;

/** The time of rollouts is proportional to this; a processor takes two more for each block. */
const sizeOf = ({ rollouts, blocks, springs, steps }, device) =>
  (rollouts + (device === 'cpu' ? 2 * blocks : 0)) * steps * (260 + springs);

/** Returns the kind of rollouts, as a text. A controller whose period is 0 acts in every step. */
const likeOf = ({ device, precision, integrator, dt_s: stepS, control_period_s: period }) =>
  [device, precision, integrator, stepS, period || stepS].join();
const isLike = (row, plan, work) => row.work === work && likeOf(row) === plan.like;

/**
 * What a request computes.
 * @typedef {Object} Plan
 * @property {any} physics
 * @property {string} precision
 * @property {string} device cpu or cuda
 * @property {string} like the kind of its rollouts
 * @property {{rollouts: number, blocks: number, springs: number}} scoring
 * @property {{rollouts: number, blocks: number, springs: number}|null} learning robots
 * @property {boolean} isMost some rollouts may turn out not to be needed
 * @property {boolean} isSure the bodies are known
 */

/**
 * Returns what a request computes; null if it lacks designs.
 * @param {string} kind
 * @param {any} request with all numbers, also those that a preset stands for
 * @param {{periodS: number, environments?: number, isUnknown?: boolean}} of periodS: of the
 *   controller; isUnknown: the bodies to learn on are
 * @returns {Plan|null}
 */
function planOf(kind, request, { periodS, environments = ENVIRONMENTS, isUnknown }) {
  const own = typeof request.physics === 'object' ? request.physics : {};
  const isPaper = request.preset === 'paper' || request.physics === 'paper';
  const physics = { ...physicsOf(isPaper, periodS), ...own };
  const listed = request.designs ?? request.initial?.designs ?? [];
  const springs = listed.length
    ? listed.reduce((sum, one) => sum + springsOf(one), 0) / listed.length : RANDOM;
  const plan = { physics, precision: request.precision ?? 'float32', device: 'cpu', like: '',
    learning: null, isMost: false, isSure: listed.length > 0 };
  if (kind === 'evaluation') {
    const { best, tolerance, error, random } = request;
    const blocks = (listed.length || (random?.count ?? 0)) * (tolerance || error ? 5 : 1);
    return blocks ? { ...plan, isMost: Boolean(best || tolerance),
      isSure: plan.isSure && !tolerance,
      scoring: { rollouts: blocks * environments, blocks, springs } } : null;
  }
  if (kind === 'training') {
    /** @type {typeof VALIDATION} */
    const validation = { ...VALIDATION, ...request.validation };
    const { every_steps: every, designs, environments: worlds } = validation;
    const times = every ? Math.floor(request.steps / every) + 1 : 0;
    return { ...plan, isSure: !isUnknown,
      scoring: { rollouts: times * designs * worlds, blocks: times * designs, springs: RANDOM },
      learning: { rollouts: request.steps * request.batch,
        blocks: request.steps * Math.ceil(request.batch / 32), springs } };
  }
  const { population, generations, replicates = 1 } = request;
  /** @type {any} */
  const usual = CAMPAIGN_STEPS[request.mode];
  const steps = usual &&
    { parent_steps: usual, child_steps: usual, batch: population, ...request.learning };
  const designs = replicates * population * (1 + generations * (steps ? 2 : 1));
  const learned = steps ? replicates * steps.batch *
    (steps.child_steps + generations * (steps.parent_steps + steps.child_steps)) : 0;
  const size = generations > 3 ? EVOLVED : springs;
  const learning = { rollouts: learned, blocks: Math.ceil(learned / 32), springs: size };
  return { ...plan, isMost: true, isSure: false,
    scoring: { rollouts: designs * environments, blocks: designs, springs: size },
    learning: steps ? learning : null };
}

/**
 * Measures a kind of work with a few random bodies, if the service has not yet computed any.
 * @param {Plan} plan
 * @param {string} controller any: only its period matters
 * @returns {Promise<any[]>} the rates
 */
async function measured(plan, controller) {
  const { items } = await getJson('v1/rates');
  const { dt_s, integrator, control_period_s: period } = plan.physics;
  if (plan.device !== 'cpu' || items.some((row) =>
    isLike(row, plan, 'rollouts') && row.steps >= STEPS_MIN)) return items;
  const { items: bodies } = await post('v1/bodies/random', { count: MEASURED });
  for (const { genotype } of bodies) { // one thread computes a body in all its environments
    await post('v1/rollouts', { designs: [{ voxels: genotype }], environments: 'paper-test',
      record: [], precision: plan.precision, controller,
      physics: { dt_s, integrator, control_period_s: period || dt_s, n_steps: MEASURED_STEPS } });
  }
  return (await getJson('v1/rates')).items;
}

/** Returns the seconds of a part of a plan, and what they are based on; null if that is unknown. */
function secondsOf(part, plan, work, rates) {
  const row = rates.find((one) => isLike(one, plan, work));
  if (!row) return null;
  const size = sizeOf({ ...row, steps: row.steps / row.rollouts }, plan.device);
  return { rollouts: row.rollouts, seconds: row.seconds / size *
    sizeOf({ ...part, steps: plan.physics.n_steps }, plan.device) };
}

/**
 * Describes what a request takes.
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
    return `${what}. Nothing like these was measured here yet.`;
  }
  const seconds = (scored?.seconds ?? 0) + (learned?.seconds ?? 0);
  const used = Math.min(n, scoring.blocks + (learning?.blocks ?? 0));
  const where = device === 'cpu' ? 'core' : 'device';
  return `${what}: ${plan.isSure && (own || !learning) ? 'about' : 'roughly'} ` +
    `${countOf(Number(seconds.toPrecision(2)), `${where}-second`)}, ${duration(seconds / used)} ` +
    `here if nothing else runs. Based on ${both(own, scored)} like these since the service ` +
    `started${learning && !own ? '; no gradients yet' : ''}.`;
}

/** The line of a form that says what its request will take. */
export class Estimate {
  /** @param {string} kind @param {number|undefined} threads @param {number} devices working */
  constructor(kind, threads, devices) {
    this.kind = kind;
    this.threads = threads;
    this.devices = devices;
    this.like = '';
    /** @type {Plan|null} */
    this.plan = null;
    this.element = h('p.wide.muted.estimate', { 'aria-live': 'polite' });
    /** @type {any[]|null} */
    this.rates = null;
  }

  static async make(kind) {
    const [threads, devices] = await Promise.all(['v1/threads', 'v1/devices'].map((path) =>
      getJson(path).catch(() => null)));
    return new Estimate(kind, threads?.n_threads,
      devices?.items.filter(({ state }) => state === 'working').length ?? 0);
  }

  /**
   * Shows the estimate of a request.
   * @param {any} request with the numbers that its empty fields stand for
   * @param {any[]} controllers
   * @param {{environments?: number, isUnknown?: boolean}} of see planOf
   */
  show(request, controllers, of) {
    const isRandom = request.kind === 'pretrain' || request.mode === 'simultaneous';
    const named = request.controller ?? (isRandom ? null : 'default');
    const periodS = named === null ? randomPeriodS(request.preset === 'paper')
      : controllers.find(({ name, sha256 }) => [name, `sha256:${sha256}`].includes(named))
        ?.control_period_s ?? 0;
    this.plan = planOf(this.kind, request, { ...of, periodS });
    const { plan } = this;
    if (plan) {
      const { device = 'auto' } = request;
      const suits = this.kind !== 'evaluation' ||
        (plan.precision === 'float32' && plan.scoring.rollouts >= DEVICE_ROLLOUTS);
      if (device === 'cuda' || (device === 'auto' && this.devices && suits)) plan.device = 'cuda';
      plan.like = likeOf({ ...plan.physics, ...plan });
    }
    this.write();
    if (!plan || plan.like === this.like) return;
    const { like } = plan;
    this.like = like;
    measured(plan, named ?? 'default').then((rates) => {
      this.rates = rates;
      if (like === this.like) this.write();
    }).catch(() => {}); // the number of rollouts is still shown
  }

  write() {
    const n = this.plan?.device === 'cpu' ? this.threads : this.devices;
    say(this.element, estimateOf(this.plan, this.threads ? this.rates : null, n || 1));
  }
}
