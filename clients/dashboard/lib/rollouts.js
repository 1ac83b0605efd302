/**
 * Robots for the stage: rollouts that the daemon computes without storing them, and recordings.
 */

import { getJson, patient, post, request, withQuery } from './api.js';
import { countOf } from './format.js';
import { nameOf } from './names.js';
import { decodeScene, robotsOf } from './scene.js';
import { taskWords } from './tasks.js';

const lists = new Map();

/** Loads the environments at a path, which never change: [{sha256, light_xy_m, task,
 * terrain_heights_m or terrain}]. */
export async function environmentsAt(path) {
  if (!lists.has(path)) {
    const load = getJson(path);
    load.catch(() => lists.delete(path));
    lists.set(path, load);
  }
  return (await lists.get(path)).items;
}

/** Returns whether a name is a suite (all twelve sets) rather than a single set. */
export const isSuite = (name) => /^morpho-12(-held-out)?$/.test(name);

/** Loads the environments of a named set. */
export const environmentSet = (name) =>
  environmentsAt(`v1/environment-sets/${encodeURIComponent(name)}`);

/** Returns an environment in the format of a request. */
export function requested(environment) {
  const asked = { ...environment };
  delete asked.sha256;
  return asked;
}

/** Loads an evaluation's recording of one of its designs in one of its environments, as a scene. */
export const recordingPath = (evaluation, row, environment) =>
  withQuery(`v1/evaluations/${encodeURIComponent(evaluation)}/trajectories/${row}`,
    { environment, format: 'scene' });

/** Returns the robots of recordings. @param {number[]} rows positions of designs in the
 * evaluation */
export async function recorded(evaluation, rows, environment, signal, onmore) {
  const robots = [];
  for (const row of rows) {
    if (robots.length) onmore([...robots]);
    const path = recordingPath(evaluation, row, environment);
    const response = await patient(() => request(path, { signal }));
    robots.push(...robotsOf(decodeScene(await response.arrayBuffer())));
  }
  return robots;
}

/** The channels that the stage shows. */
export const CHANNELS = ['masses', 'actuation', 'contacts'];

/** Rollouts per request, and concurrent requests: robots arrive in groups, in order. */
const ROLLOUTS_AT_ONCE = 8;
const REQUESTS_AT_ONCE = 2;
const FRAME_S = 0.04;
const STEP_S = 0.002;
const STEPS = 2000;

/**
 * Simulates designs in one environment, and returns them for the stage in the same order.
 * @param {Object[]} designs {voxels} or {id}, as in any request
 * @param {Object} environment
 * @param {{controller?: string, physics?: Object, precision?: string, signal?: AbortSignal,
 *   onmore?: function(Object[]): void}} [options] onmore: gets the robots so far, if more will come
 */
export async function roll(designs, environment, options = {}) {
  const { controller = 'default', physics, precision, signal, onmore } = options;
  const { dt_s: stepS = STEP_S, n_steps: steps = STEPS } = physics ?? {};
  async function group(from) {
    const response = await patient(() => request('v1/rollouts', {
      method: 'POST', signal,
      headers: { Accept: 'application/vnd.morphod.scene' },
      body: {
        designs: designs.slice(from, from + ROLLOUTS_AT_ONCE),
        environments: [requested(environment)],
        controller, physics, precision, record: CHANNELS, masses_int16: true,
        record_stride: Math.max(1, Math.min(Math.round(FRAME_S / stepS), steps)),
      },
    }));
    return robotsOf(decodeScene(await response.arrayBuffer()));
  }
  const robots = [];
  const asked = [];
  for (let next = 0; robots.length < designs.length;) {
    while (asked.length < REQUESTS_AT_ONCE && next < designs.length) {
      asked.push(group(next));
      asked.at(-1).catch(() => {}); // its error is reported when its turn comes
      next += ROLLOUTS_AT_ONCE;
    }
    robots.push(...await asked.shift());
    if (robots.length < designs.length) onmore?.([...robots]);
  }
  return robots;
}

/**
 * Computes the score of a design in a set or a list of environments of one task, with the default
 * controller.
 * @param {Object} design
 * @param {string|Object[]} environments
 * @param {{signal?: AbortSignal}} [options]
 * @returns {Promise<{mean: number|null, value: number|null, unit: string, losses:
 *   (number|null)[]}>} means of losses and values; null: it diverged
 */
export async function scoresOf(design, environments, options = {}) {
  const reply = await patient(() => post('v1/rollouts', {
    designs: [design], environments, record: [],
  }, { signal: options.signal, headers: { Accept: 'application/json' } }));
  const { rollouts, designs: [{ score: mean }] } = reply;
  const losses = rollouts.map(({ loss }) => loss);
  const isLost = losses.includes(null);
  return {
    mean: isLost ? null : mean, losses, unit: rollouts[0].unit,
    value: isLost ? null : rollouts.reduce((sum, one) => sum + one.value, 0) / rollouts.length,
  };
}

/** Returns the environments in which pages score a task. @param {{set?: string, environments?:
 * any[]}} task */
export const worldsOf = async ({ set, environments }) => (set ? environmentSet(set) : environments);

/** Approximate duration of a window of a drive: a robot turns toward the light only when a window
 * ends. */
const WINDOW_S = 0.08;

/** Returns how a drive is cut, with about the same durations for any time step: steps per frame and
 * frames per window. */
export function windowOf({ dt_s: stepS = STEP_S } = {}) {
  const stride = Math.max(1, Math.round(FRAME_S / stepS));
  const frameS = stride * stepS;
  const perWindow = Math.max(1, Math.round(WINDOW_S / frameS));
  return { stride, frameS, perWindow, windowS: perWindow * frameS };
}

/**
 * Simulates n windows of a drive, from the states at the end of the previous window, if any.
 * Returns per rollout the frames of each window, without the one that it starts from, and the state
 * at the end, and the inputs as in the header of a scene.
 * @param {Object[]} designs
 * @param {Object} environment
 * @param {{controller?: string, physics?: Object, precision?: string, signal?: AbortSignal,
 *   states: ?Object[], n: number}} options
 */
export async function rollWindow(designs, environment, options) {
  const { controller = DEFAULT_CONTROLLER, physics, precision, signal, states, n } = options;
  const { stride, perWindow } = windowOf(physics);
  const response = await request('v1/rollouts', {
    method: 'POST', signal, headers: { Accept: 'application/vnd.morphod.scene' },
    body: {
      designs, environments: [environment], controller, precision, record: CHANNELS,
      physics: { ...physics, n_steps: stride * perWindow * n }, record_stride: stride,
      final_states: true, ...(states ? { states } : {}),
    },
  });
  const { header, array } = decodeScene(await response.arrayBuffer());
  const window = (described, k) => {
    const all = array(described);
    const perFrame = all.length / described.shape[0];
    const from = (1 + k * perWindow) * perFrame;
    return all.subarray(from, from + perWindow * perFrame);
  };
  const rows = header.rollouts.map((rollout) => ({
    state: rollout.diverged_step ? null : rollout.state ?? null,
    parts: Array.from({ length: n }, (_, k) => ({
      track: window(rollout.masses_m, k), actuation: window(rollout.actuation, k),
      contacts: window(rollout.contacts, k),
    })),
  }));
  const { controller: sha256, physics_sha256, physics: all, precision: numbers } = header;
  return { rows, inputs: { controller: sha256, physics_sha256, physics: all, precision: numbers } };
}

/** The default controller of rollouts. */
const DEFAULT_CONTROLLER = 'default';

/** Returns a named set of environments, with default physics and a controller. */
export async function worldOfSet(set, controller = DEFAULT_CONTROLLER) {
  return {
    set, environments: await environmentSet(set), controller, physics: undefined,
    precision: undefined,
    words: `World: ${set}, default physics, controller ${controller.split(',').join(' and ')}`,
  };
}

/**
 * Returns the world in which a campaign or an evaluation scored its designs: environments, physics
 * and controller. For a campaign, it is the newest controller.
 */
export async function worldOfJob(kind, job) {
  const physics = job.settings?.physics ?? job.physics;
  const named = job.settings?.environments ?? job.environments;
  const set = typeof named === 'string' && !isSuite(named) ? named : null;
  const environments =
    await environmentsAt(`v1/${kind}s/${encodeURIComponent(job.id)}/environments`);
  const file = job.result?.controller ?? job.controller;
  const tasks = taskWords(environments);
  return {
    set, environments, physics, precision: job.precision,
    controller: file?.sha256 ? `sha256:${file.sha256}` : DEFAULT_CONTROLLER,
    words: `World of ${kind} ${job.id}: ` +
      `${typeof named === 'string' ? named
        : countOf(environments.length, 'custom environment')}, ` +
      `${tasks && `task ${tasks}, `}` +
      `${physics.n_steps} steps of ${physics.dt_s} s, ` +
      `integrator ${physics.integrator}, ` +
      `${job.precision === 'float64' ? 'float64, ' : ''}` +
      `controller ${file?.name ?? file?.sha256?.slice(0, 12) ?? DEFAULT_CONTROLLER}`,
  };
}

/** Loads the environments of a campaign, which never change. */
export function environmentsOfCampaign({ id, group, settings: { environments } }) {
  return typeof environments === 'string' ? environmentSet(environments)
    : environmentsAt(`v1/campaigns/${encodeURIComponent(group?.id ?? id)}/environments`);
}

/** Simulates designs of a campaign in the first environment of its world. */
export async function rollOfCampaign(campaign, designs, signal) {
  return rollInWorld(await worldOfJob('campaign', campaign), designs, signal);
}

/** Simulates them in this world. The request is sent at once. */
export async function rollInWorld({ environments, controller, physics }, designs, signal) {
  const robots = await roll(designs.map(({ genotype }) => ({ voxels: genotype })), environments[0],
    { controller, physics, signal });
  return robots.map((robot, i) =>
    ({ ...robot, label: `#${designs[i].number} ${nameOf(robot.id)}` }));
}
