/** What views of jobs share: their state, progress, and the buttons that change them. */

import { post, request } from '../lib/api.js';
import { announce, button, fill, h, table } from '../lib/dom.js';
import { ago, count, countOf, duration } from '../lib/format.js';
import { may } from '../lib/rights.js';
import { announced, confirmDialog, showDialog } from './share.js';

/** The page of a job. */
export function linkOf(job) {
  if (job.kind === 'campaign') return `#/campaigns/${job.id}`;
  if (job.kind === 'training') return `#/trainings/${job.id}`;
  return `#/designs?evaluation=${job.id}`;
}

/** What a job is, in a few words. */
export function titleOf(job) {
  return job.label ?? `${job.kind[0].toUpperCase()}${job.kind.slice(1)} ${job.id}`;
}

/** Who submitted a job, where that is known: ", by anna". */
export function submitter(job) {
  return job.submitted_by ? `, by ${job.submitted_by}` : '';
}

export function stateChip(job) {
  return h(`span.state.${job.state}`, {}, job.state);
}

/** How far a job is: {share, text, secondsLeft}. */
export function progressOf(job) {
  if (job.kind === 'evaluation') {
    return {
      share: job.rollouts_done / job.rollouts_total,
      text: `${count(job.rollouts_done)} of ${count(job.rollouts_total)} rollouts`,
      secondsLeft: job.progress?.seconds_left,
    };
  }
  // A list of jobs tells less than the job itself.
  const progress = job.progress ?? { under_way: null, total: 0, ...job[job.kind] };
  if (job.kind === 'training') {
    return {
      share: progress.step / progress.steps,
      text: `step ${count(progress.step)} of ${count(progress.steps)}`,
      secondsLeft: progress.seconds_left,
    };
  }
  if ((job.mode ?? job.campaign?.mode) === 'study') {
    return { share: 1, text: `${countOf((progress.generation ?? -1) + 1, 'batch', 'batches')} told`, secondsLeft: null };
  }
  const within = progress.total > 0 ? progress.done / progress.total : 0;
  const generation = progress.generation ?? 0;
  return {
    share: Math.min(1, (generation + (progress.under_way === null ? 0 : within)) / Math.max(1, progress.generations)),
    text: `generation ${count(generation)} of ${count(progress.generations)}`,
    secondsLeft: progress.seconds_left,
  };
}

export function progressBar(job) {
  const { share, text, secondsLeft } = progressOf(job);
  const left = job.state === 'running' && secondsLeft ? `, ${duration(secondsLeft)} left` : '';
  return h('div', {}, h('progress', { value: share, max: 1, 'aria-label': `${titleOf(job)}: ${text}` }),
    h('div.muted.number', {}, text + left));
}

/** Why a job failed or waits, if it does. */
export function trouble(job) {
  if (job.error) return h('p.error', { role: 'alert' }, `${job.error.detail ?? job.error.code ?? job.error}`);
  if (job.reason) return h('p.muted', {}, job.reason);
  return null;
}

/** Pause, resume and cancel, as the state and the caller's right allow. `changed` is called after each. */
export function actions(job, changed) {
  const act = (name, done) => async () => {
    await announced(() => post(`v1/jobs/${job.id}/${name}`), `${titleOf(job)} ${done}`);
    changed();
  };
  if (!may('submit')) return [];
  const label = (verb) => ({ 'aria-label': `${verb} ${titleOf(job)}` });
  const list = [];
  if (['queued', 'running'].includes(job.state)) list.push(button('Pause', act('pause', 'paused'), label('Pause')));
  if (['paused', 'failed'].includes(job.state)) list.push(button('Resume', act('resume', 'resumed'), label('Resume')));
  if (['queued', 'running', 'paused'].includes(job.state)) {
    list.push(button('Cancel', async () => {
      const sure = await confirmDialog(`Cancel ${titleOf(job)}?`,
        'It cannot be resumed. What it has computed so far stays.', 'Cancel the job');
      if (sure) await act('cancel', 'cancelled')();
    }, { class: 'danger', ...label('Cancel') }));
  }
  return list;
}

/** Boxes that choose jobs of a list, and the button that shows the chosen on one page. */
export function comparing(app, path, text) {
  const chosen = new Set();
  const compare = button(text, () => {
    const [first, ...others] = chosen;
    app.go(`${path}/${first}`, { compare: others.join(',') });
  }, { disabled: true });
  const box = (job) => h('td', {}, h('input', { type: 'checkbox', checked: chosen.has(job.id), 'aria-label': `Compare ${titleOf(job)}`,
    onchange: (event) => {
      if (event.target.checked) chosen.add(job.id);
      else chosen.delete(job.id);
      compare.disabled = chosen.size < 2;
    } }));
  return { compare, box };
}

/** What somebody said of a job, and to what it belongs. Text, never markup. */
export function remark(job) {
  const parts = [job.experiment && `in ${job.experiment}`, job.note, job.archived_at && 'archived'].filter(Boolean);
  return parts.length ? h('p.muted', { style: 'white-space: pre-wrap' }, parts.join(' – ')) : null;
}

/** Asks, naming what is lost, and deletes a job that has ended. */
async function remove(job) {
  const what = {
    evaluation: 'its results and recordings', training: 'its curve and checkpoints',
    campaign: 'its generations, population and phylogeny, and checkpoints',
  }[job.kind];
  if (!await confirmDialog(`Delete ${titleOf(job)}?`,
    `${job.kind[0].toUpperCase()}${job.kind.slice(1)} ${job.id} and ${what} are lost for good. Designs, scores and controllers stay.`,
    'Delete the job')) return false;
  await request(`v1/jobs/${job.id}`, { method: 'DELETE' });
  announce(`${titleOf(job)} is deleted`);
  return true;
}

/** A button that opens what can be said of a job: label, experiment, note; the archive; deletion. */
export function editButton(job, changed) {
  if (!may('submit')) return null;
  return button('Edit', () => {
    const text = (tag, name, most) => h(tag, { name, maxlength: most, value: job[name] ?? '', ...(tag === 'textarea' ? { rows: 4 } : {}) });
    const fields = { label: text('input', 'label', 200), experiment: text('input', 'experiment', 100), note: text('textarea', 'note', 1000) };
    const archived = h('input', { type: 'checkbox', checked: job.archived_at !== null });
    const fault = h('p.error', { role: 'alert' });
    const attempt = (act) => async () => {
      try {
        if (await act() === false) return;
        dialog.close();
        changed();
      } catch (error) {
        fault.textContent = error.message;
      }
    };
    const save = attempt(() => request(`v1/jobs/${job.id}`, { method: 'PATCH', body: {
      ...Object.fromEntries(Object.entries(fields).map(([name, field]) => [name, field.value || null])), archived: archived.checked,
    } }));
    const dialog = showDialog(titleOf(job),
      ...Object.entries(fields).map(([name, field]) => h('label.field', {}, h('span', {}, name[0].toUpperCase() + name.slice(1)), field)),
      h('label.row', {}, archived, 'Archived: hidden from lists'), fault,
      h('div.row', {}, button('Save', save, { class: 'primary' }),
        may('admin') && ['succeeded', 'failed', 'cancelled'].includes(job.state)
          ? button('Delete', attempt(() => remove(job)), { class: 'danger' }) : null));
  }, { 'aria-label': `Edit ${titleOf(job)}` });
}

/** The weight of a job among others: twice the weight gets twice the time. */
export function weightField(job, changed) {
  if (!may('submit') || !['queued', 'running', 'paused'].includes(job.state)) return null;
  return h('label.field.inline', {}, h('span', {}, 'Weight'), h('input', {
    type: 'number', min: 0.001, max: 1000, step: 'any', value: job.weight, size: 6,
    onchange: async ({ target: { value } }) => {
      await announced(() => post(`v1/jobs/${job.id}/weight`, { weight: Number(value) }), `Weight of ${titleOf(job)} is ${value}`);
      changed();
    },
  }));
}

/**
 * A table of jobs whose rows are drawn only where they are seen, so that a thousand scroll like ten.
 */
export class JobTable {
  constructor(changed) {
    this.changed = changed;
    this.body = h('tbody');
    this.element = h('div.scroll', {}, table(['Job', 'State', 'Progress', 'Created', ''], this.body, undefined, 'table.cards.jobs'));
    this.rows = new Map();
    // An observer of intersections would tell of a row after the frame in which it appears.
    this.onScroll = () => this.#drawSeen();
    addEventListener('scroll', this.onScroll, { passive: true });
    addEventListener('resize', this.onScroll);
  }

  /** Replaces the jobs; rows whose job is unchanged stay. */
  set(jobs) {
    const before = this.rows;
    this.rows = new Map();
    const elements = jobs.map((job) => {
      const key = JSON.stringify(job);
      const old = before.get(job.id);
      if (old?.key === key) {
        this.rows.set(job.id, old);
        return old.element;
      }
      const element = old?.element ?? h('tr');
      element.style.height = '58px';
      this.rows.set(job.id, { key, element, job, drawn: false });
      element.jobId = job.id;
      if (old) this.#draw(element);
      return element;
    });
    this.body.replaceChildren(...elements);
    this.#drawSeen();
  }

  /** Draws the rows that are seen, and those a few pictures of the screen above and below. */
  #drawSeen() {
    const rows = [...this.body.children];
    const at = (y) => {
      let [low, high] = [0, rows.length];
      while (low < high) {
        const middle = (low + high) >> 1;
        if (rows[middle].getBoundingClientRect().bottom < y) low = middle + 1;
        else high = middle;
      }
      return low;
    };
    rows.slice(at(-2 * innerHeight), at(3 * innerHeight) + 1).forEach((row) => this.#draw(row));
  }

  #draw(element) {
    const row = this.rows.get(element.jobId);
    if (!row || row.drawn) return;
    row.drawn = true;
    const { job } = row;
    fill(element,
      h('td.main', {}, h('a', { href: linkOf(job) }, titleOf(job)), h('div.muted', {}, `${job.kind} ${job.id}${submitter(job)}${
        job.core_seconds >= 1 ? `, ${duration(job.core_seconds)} of cores` : ''}${job.note ? `: ${job.note.slice(0, 60)}` : ''}`)),
      h('td', {}, stateChip(job)), h('td.wide', {}, progressBar(job), trouble(job)),
      h('td.muted', {}, ago(job.created_at)), h('td', {}, h('div.row', {}, actions(job, this.changed), editButton(job, this.changed))));
  }

  destroy() {
    removeEventListener('scroll', this.onScroll);
    removeEventListener('resize', this.onScroll);
  }
}
