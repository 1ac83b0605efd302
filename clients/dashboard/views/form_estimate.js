/** The line of a form that says what the request will take. */

import { getJson } from '../lib/api.js';
import { randomPeriodS } from '../lib/defaults.js';
import { h, say } from '../lib/dom.js';
import { estimateOf, measured, planOf } from '../lib/estimate.js';

/** Rollouts from which `auto` computes an evaluation on a device. */
const DEVICE_ROLLOUTS = 1000;

export class Estimate {
  /** @param {string} kind @param {number|undefined} threads @param {number} devices working */
  constructor(kind, threads, devices) {
    this.kind = kind;
    this.threads = threads;
    this.devices = devices;
    this.key = '';
    /** @type {import('../lib/estimate.js').Plan|null} */
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
    this.plan = planOf(this.kind, request, { isUnknown: false, ...of, periodS });
    if (this.plan) this.plan.device = this.deviceOf(request, this.plan);
    this.write();
    const { physics, precision, device } = this.plan ?? {};
    const key = JSON.stringify([physics, precision, device]);
    if (!this.plan || key === this.key) return;
    this.key = key;
    measured(this.plan, named ?? 'default').then((rates) => {
      this.rates = rates;
      if (key === this.key) this.write();
    }).catch(() => {}); // the number of rollouts is still shown
  }

  deviceOf({ device = 'auto' }, { precision, scoring }) {
    const suits = this.kind !== 'evaluation' ||
      (precision === 'float32' && scoring.rollouts >= DEVICE_ROLLOUTS);
    return device === 'cuda' || (device === 'auto' && this.devices > 0 && suits) ? 'cuda' : 'cpu';
  }

  write() {
    const n = this.plan?.device === 'cpu' ? this.threads : this.devices;
    say(this.element, estimateOf(this.plan, this.threads ? this.rates : null, n || 1));
  }
}
