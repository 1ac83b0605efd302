/** Common parts of views of jobs: state, progress, and the buttons that change a job. */

import { LinkError, post } from '../lib/api.js';
import { button, h, isInUse, say } from '../lib/dom.js';
import { countOf, duration, number } from '../lib/format.js';
import { isOpen, kindOf, partOf, progressOf, stateOf, titleOf } from '../lib/kinds.js';
import { may } from '../lib/rights.js';
import { announced, confirmDialog } from './share.js';

/** Jobs that can be compared with the first on one page: one for each of the other colors. */
export const COMPARED_MAX = 3;

/** Returns who submitted a job, if known: ", by anna". */
export function submitter(job) {
  return job.submitted_by ? `, by ${job.submitted_by}` : '';
}

/** Returns the text of a chart without values. It gives the reason if all robots diverged. */
export function emptyText(n, diverged, otherwise) {
  return n > 0 && diverged === n ? `No value: all ${countOf(n, 'robot')} diverged.` : otherwise;
}

/** Returns a chip with the state, for a row that is rebuilt when it differs. */
export const stateChip = (job) => h(`span.state.${job.state}`, {}, stateOf(job));

/** Creates a progress bar with its text, updated in place. */
function progressMeter() {
  const bar = h('progress', { max: 1 });
  const said = h('div.muted.number');
  return {
    element: h('div', {}, bar, said),
    update(job) {
      const { share, text, secondsLeft } = progressOf(job);
      bar.hidden = share === undefined;
      if (share === null) bar.removeAttribute('value');
      else bar.value = share ?? 0;
      bar.setAttribute('aria-label', `${titleOf(job)}: ${text}`);
      const isTimed = job.state === 'running' && secondsLeft;
      say(said, text + (isTimed ? `, ${duration(secondsLeft)} left` : ''));
    },
  };
}

/** Returns a progress bar for a row that is rebuilt when it differs. */
export function progressBar(job) {
  const { element, update } = progressMeter();
  update(job);
  return element;
}

/**
 * The parts of a job that pages show, and the buttons that its state and the caller's right allow.
 * Each part is created once and updated in place, so typed text, pressed buttons and the focus
 * stay.
 */
export class JobParts {
  /** @param {function(): any} changed called after each change that a user made */
  constructor(changed) {
    this.changed = changed;
    this.job = null;
    this.chip = h('span.state');
    this.progress = progressMeter();
    this.bar = this.progress.element;
    this.trouble = h('p');
    this.remark = h('p.remark.muted');
    this.rate = h('span.muted');
    this.pause = button('', () => (this.#isPaused() ? this.#act('resume', 'resumed')
      : this.#act('pause', 'paused')));
    this.cancel = button('Cancel', async () => {
      const sure = await confirmDialog(`Cancel ${titleOf(this.job)}?`,
        'It cannot be resumed. Its results so far are kept.', 'Cancel the job');
      if (sure) await this.#act('cancel', 'cancelled');
    }, { class: 'danger' });
    this.weight = h('input', {
      type: 'number', min: 0.001, max: 1000, step: 'any', size: 6, onchange: () => this.#weigh(),
    });
    // Null if the caller may not change anything: the page then omits the buttons.
    const mayChange = may('submit');
    this.weightField = mayChange
      ? h('label.field.inline', {}, h('span', {}, 'Weight'), this.weight) : null;
    this.actions = mayChange ? [this.pause, this.cancel] : null;
    this.edit = mayChange ? button('Edit', () => announced(async () =>
      (await import('./job_edit.js')).editDialog(this.job, changed))) : null;
    this.row = h('div.row', {}, this.actions, this.edit, this.weightField, this.rate);
  }

  #isPaused() {
    return ['paused', 'failed'].includes(this.job.state);
  }

  async #act(name, done) {
    await announced(() => post(`v1/jobs/${this.job.id}/${name}`), `${titleOf(this.job)} ${done}`);
    this.changed();
  }

  /** Sets the weight of the job relative to others: a job with twice the weight gets twice the
   * time. */
  async #weigh() {
    const weight = Number(this.weight.value);
    const isDone = await announced(() => post(`v1/jobs/${this.job.id}/weight`, { weight }),
      `Weight of ${titleOf(this.job)} set to ${weight}`);
    if (isDone) this.changed();
    else this.weight.value = this.job.weight;
  }

  /** @returns {this} */
  update(job) {
    this.job = job;
    const title = titleOf(job);
    this.chip.className = `state ${job.state}`;
    say(this.chip, stateOf(job));
    this.progress.update(job);
    const { error, warnings } = job;
    say(this.trouble, error ? `${error.detail ?? error.code ?? error}`
      : [...warnings.map(({ detail }) => detail), job.reason].filter(Boolean).join('; '));
    this.trouble.className = error || warnings.length ? 'error' : 'muted';
    this.trouble.hidden = !this.trouble.textContent;
    say(this.remark, [job.experiment && `in ${job.experiment}`, job.note,
      job.archived_at && 'archived'].filter(Boolean).join(' – '));
    this.remark.hidden = !this.remark.textContent;
    say(this.rate, rateOf(job));
    this.#offer(title);
    return this;
  }

  #offer(title) {
    if (!this.actions) return;
    const { state, weight } = this.job;
    const isRunnable = isOpen(this.job);
    const verb = this.#isPaused() ? 'Resume' : 'Pause';
    say(this.pause, verb);
    this.pause.setAttribute('aria-label', `${verb} ${title}`);
    this.cancel.setAttribute('aria-label', `Cancel ${title}`);
    this.edit.setAttribute('aria-label', `Edit ${title}`);
    this.pause.hidden = !isRunnable && state !== 'failed';
    this.cancel.hidden = this.weightField.hidden = !isRunnable;
    if (!isInUse(this.weight)) this.weight.value = weight;
  }
}

function rateOf(job) {
  const { progress } = partOf(job);
  const rate = progress?.rollouts_per_s ?? progress?.bodies_per_s;
  if (!rate) return '';
  return `${number(rate)} ${kindOf(job).rate} per second`;
}

/** Returns the jobs that a link compares with the first: at most three. */
export function comparedIn(parameters, id) {
  const ids = (parameters.get('compare') ?? '').split(',').filter(Boolean);
  const wrong = ids.find((one) => !/^\d+$/.test(one));
  if (wrong !== undefined) {
    throw new LinkError(`compare=${wrong}; expected a job number.`);
  }
  if (ids.length > COMPARED_MAX) {
    throw new LinkError(`compare names ${ids.length} jobs; at most ${COMPARED_MAX} can be ` +
      `compared with ${id} on one page.`);
  }
  const twice = ids.find((one, i) => one === id || ids.indexOf(one) !== i);
  if (twice !== undefined) {
    throw new LinkError(`compare=${twice}: this job is on the page already.`);
  }
  return ids;
}
