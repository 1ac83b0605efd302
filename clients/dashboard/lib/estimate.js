/** How long a request takes here: measured with a few rollouts. */

import { post } from './api.js';
import { count, duration } from './format.js';

/** The number of default environments, and of bodies that are simulated for an estimate. */
const [ENVIRONMENTS, MEASURED] = [10, 3];

/** Measures the seconds that a thread needs for a rollout, with a few random bodies. */
export async function measureRollout() {
  const { items } = await post('v1/bodies/random', { count: MEASURED });
  const begin = performance.now();
  for (const { genotype } of items) { // one thread computes a body in all its environments
    await post('v1/rollouts',
      { designs: [{ voxels: genotype }], environments: 'paper-test', record: [] });
  }
  return (performance.now() - begin) / 1000 / (MEASURED * ENVIRONMENTS);
}

/**
 * Describes how many rollouts a request needs, and how long they take. Training runs and campaigns
 * that learn have no estimate, because they mostly compute gradients.
 * @param {number} designs to be scored in default environments and physics; 0 if unknown
 * @param {number|null} seconds that a thread needs for a rollout; null if unknown
 * @param {number} threads
 * @param {number} [environments] that each design is scored in
 */
export function estimateOf(designs, seconds, threads, environments = ENVIRONMENTS) {
  if (!designs) return '';
  const n = designs * environments;
  return `Up to ${count(n)} rollouts` + (seconds === null ? '.'
    : `: about ${duration(n * seconds / threads)} on this machine, if it does nothing else.`);
}
