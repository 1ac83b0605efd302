/** What can be done with the selected runs: compare, pause, resume, archive, restore, delete. */

import { post, request } from '../lib/api.js';
import { announce, button, h, say } from '../lib/dom.js';
import { countOf } from '../lib/format.js';
import { groupOf, isOver, kindOf, titleOf } from '../lib/kinds.js';
import { may } from '../lib/rights.js';
import { confirmDeletion, deleteJob } from './job_edit.js';
import { COMPARED_MAX } from './jobs.js';

/** Returns the jobs to compare, oldest first: replicates that are all selected count as the first
 * of them. */
function sidesOf(selected) {
  const jobs = [...selected].sort((a, b) => Number(a.id) - Number(b.id));
  const keyOf = (job) => {
    const group = groupOf(job);
    const all = group && jobs.filter((one) => groupOf(one)?.id === group.id).length;
    return group && all === group.replicates ? `group ${group.id}` : job.id;
  };
  const sides = jobs.filter((job, i) =>
    jobs.findIndex((one) => keyOf(one) === keyOf(job)) === i);
  return sides.length === 1 ? jobs : sides;
}

/** Returns why jobs cannot be compared, or ''. */
function whyNotCompared(sides) {
  if (new Set(sides.map((job) => kindOf(job).path)).size > 1 ||
    sides.some((job) => !kindOf(job).tabs[0])) {
    return 'Only runs of the same kind can be compared';
  }
  return sides.length < 2 || sides.length > COMPARED_MAX + 1
    ? `Select 2 to ${COMPARED_MAX + 1} runs of the same kind` : '';
}

export class RunActions {
  /** @param {import('../app.js').app} app @param {function(): void} changed @param {function():
   * void} clear */
  constructor(app, changed, clear) {
    this.changed = changed;
    this.jobs = [];
    this.said = h('span.number', { 'aria-live': 'polite' });
    this.compare = button('Compare', () => {
      const [first, ...others] = sidesOf(this.jobs);
      app.go(`${kindOf(first).path}/${first.id}`,
        { compare: others.map(({ id }) => id).join(',') });
    });
    const on = (id, name) => post(`v1/jobs/${id}/${name}`);
    const archive = (id, archived) =>
      request(`v1/jobs/${id}`, { method: 'PATCH', body: { archived } });
    this.clear = button('Clear', clear);
    /** Which of the selected jobs each action applies to. */
    this.actions = may('submit') ? [
      this.#action('Pause', 'paused', ({ state }) => ['queued', 'running'].includes(state),
        ({ id }) => on(id, 'pause')),
      this.#action('Resume', 'resumed', ({ state }) => ['paused', 'failed'].includes(state),
        ({ id }) => on(id, 'resume')),
      this.#action('Archive', 'archived', (job) => !job.archived_at,
        ({ id }) => archive(id, true)),
      this.#action('Restore', 'restored', (job) => Boolean(job.archived_at),
        ({ id }) => archive(id, false)),
    ] : [];
    if (may('admin')) {
      this.actions.push(this.#action('Delete', 'deleted', isOver, deleteJob, confirmDeletion));
    }
    this.element = h('div.row', { role: 'group', 'aria-label': 'Selected runs' }, this.said,
      this.compare, this.actions.map((one) => one.element), this.clear);
    this.set([]);
  }

  #action(name, done, isFor, work, confirm = null) {
    const element = button(name, async () => {
      const jobs = this.jobs.filter(isFor);
      if (confirm && !await confirm(jobs)) return;
      await this.#all(jobs, done, work);
    }, name === 'Delete' ? { class: 'danger' } : {});
    return { element, isFor, name };
  }

  /** Applies an action to each job, and reports what was done and what was refused. */
  async #all(jobs, done, work) {
    const refused = [];
    for (const job of jobs) {
      try {
        await work(job);
      } catch (error) {
        refused.push(`${titleOf(job)}: ${error.message}`);
      }
    }
    const n = jobs.length - refused.length;
    const one = jobs.length === 1 && n === 1 ? `${titleOf(jobs[0])} ${done}` : '';
    announce(refused.length
      ? `${n} ${done}, ${refused.length} refused. ${refused.slice(0, 2).join(' ')}`
      : one || `${countOf(n, 'run')} ${done}`, { isRefusal: refused.length > 0 });
    this.changed();
  }

  /** Offers the actions for the selected jobs. */
  set(jobs) {
    this.jobs = jobs;
    say(this.said, `${jobs.length} selected`);
    this.clear.disabled = jobs.length === 0;
    this.element.classList.toggle('none', jobs.length === 0);
    const why = whyNotCompared(sidesOf(jobs));
    this.compare.disabled = Boolean(why);
    this.compare.title = why;
    for (const { element, isFor, name } of this.actions) {
      const n = jobs.filter(isFor).length;
      element.disabled = n === 0;
      element.title = n === 0 || n === jobs.length ? ''
        : `Applies to ${n} of the ${jobs.length} selected` +
          (name === 'Delete' ? '; runs that have not ended cannot be deleted' : '');
    }
  }
}
