/** What views of jobs share: state, progress, and the buttons that change a job. */

import { LinkError, post, request } from '../lib/api.js';
import { announce, button, h, isInUse, patch, say, table } from '../lib/dom.js';
import { ago, count, countOf, duration, number } from '../lib/format.js';
import { may } from '../lib/rights.js';
import { announced, confirmDialog, formDialog } from './share.js';

/** Jobs besides the first on one page: as many as there are distinct colors. */
const COMPARED_MAX = 3;

/** Returns the address of a job's page. */
export function linkOf(job) {
  if (job.kind === 'campaign') return `#/campaigns/${job.id}`;
  if (job.kind === 'training') return `#/trainings/${job.id}`;
  return `#/designs?evaluation=${job.id}`;
}

/** Describes a job in a few words. */
export function titleOf(job) {
  return job.label ?? `${job.kind[0].toUpperCase()}${job.kind.slice(1)} ${job.id}`;
}

/** Returns who submitted a job, if known: ", by anna". */
export function submitter(job) {
  return job.submitted_by ? `, by ${job.submitted_by}` : '';
}

/** Returns which of several replicates a campaign is: ", replicate 1 of 3". */
export function replicateOf(job) {
  const group = job.group ?? job.campaign?.group;
  return group?.replicates > 1 ? `, replicate ${group.replicate + 1} of ${group.replicates}` : '';
}

const isStudy = (job) => (job.mode ?? job.campaign?.mode) === 'study';

/** Warnings in a few words, by their codes. */
const WARNED = {
  all_diverged: 'every robot diverged', diverged: 'robots diverged',
  no_measure: 'designs have no value of the measure',
  exhausted: 'no unseen body is left', light_near_start: 'a light is near the start',
  unstable_step: 'the time step is too large', every_step: 'the controller acts in every step',
};

/** Describes the state, and warnings that the result does not show. */
export function stateOf(job) {
  if (isStudy(job) && job.state === 'queued' && job.reason) return 'waits for its client';
  const warned = job.warnings.map(({ code }) => WARNED[code] ?? code);
  return job.state + (warned.length ? `, but ${warned.join(', ')}` : '');
}

/** Returns the text of a chart without values. It gives the reason if all robots diverged. */
export function emptyText(n, diverged, otherwise) {
  return n > 0 && diverged === n ? `No value: all ${countOf(n, 'robot')} diverged.` : otherwise;
}

/** What a campaign does within a generation, by its phase, and what is counted. */
const WITHIN = { learning: 'steps learned', scoring: 'designs scored' };

/**
 * Returns the progress of a job: {share, text, secondsLeft}. share: null if unknown, undefined if
 * the job has no planned end.
 */
export function progressOf(job) {
  if (job.kind === 'evaluation' && job.n_waiting > 0) {
    const stored = job.n_designs - job.n_waiting;
    return {
      share: stored / job.n_designs, secondsLeft: null,
      text: `${count(stored)} of ${count(job.n_designs)} designs stored`,
    };
  }
  if (job.kind === 'evaluation') {
    return {
      share: job.rollouts_done / job.rollouts_total,
      text: `${count(job.rollouts_done)} of ${count(job.rollouts_total)} rollouts`,
      secondsLeft: job.progress?.seconds_left,
    };
  }
  // A list of jobs has fewer members than the job itself.
  const progress = job.progress ?? { under_way: null, total: 0, ...job[job.kind] };
  const secondsLeft = progress.seconds_left;
  if (job.kind === 'training') {
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
  if (isStudy(job)) {
    const batches = countOf((progress.generation ?? -1) + 1, 'batch', 'batches');
    return { share: undefined, text: `${batches} received`, secondsLeft: null };
  }
  if (job.phase === 'preparing') {
    const { done, total } = progress;
    return {
      share: total ? done / total : null, secondsLeft,
      text: 'Leaving out the bodies of pretraining' +
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

/** Describes progress in a few words, for the title of a tab. */
export function shortProgress(job) {
  const moves = job.state === 'running' || (job.state === 'queued' && job.n_waiting > 0);
  return moves ? progressOf(job).text.split(/[;:]/)[0] : stateOf(job);
}

/** Returns a chip with the state, for a row that is rebuilt when it differs. */
export const stateChip = (job) => h(`span.state.${job.state}`, {}, stateOf(job));

/** A progress bar with its text, updated in place. */
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

/** Returns the same for a row that is rebuilt when it differs. */
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
        'It cannot be resumed. What it has computed so far stays.', 'Cancel the job');
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
    this.edit = mayChange ? button('Edit', () => editDialog(this.job, changed)) : null;
    this.row = h('div.row', {}, this.actions, this.edit, this.weightField, this.rate);
  }

  #isPaused() {
    return ['paused', 'failed'].includes(this.job.state);
  }

  async #act(name, done) {
    await announced(() => post(`v1/jobs/${this.job.id}/${name}`), `${titleOf(this.job)} ${done}`);
    this.changed();
  }

  /** The weight of a job compared with others: twice the weight gets twice the time. */
  async #weigh() {
    const weight = Number(this.weight.value);
    const isDone = await announced(() => post(`v1/jobs/${this.job.id}/weight`, { weight }),
      `Weight of ${titleOf(this.job)} is ${weight}`);
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
    const isOpen = ['queued', 'running', 'paused'].includes(state);
    const verb = this.#isPaused() ? 'Resume' : 'Pause';
    say(this.pause, verb);
    this.pause.setAttribute('aria-label', `${verb} ${title}`);
    this.cancel.setAttribute('aria-label', `Cancel ${title}`);
    this.edit.setAttribute('aria-label', `Edit ${title}`);
    this.pause.hidden = !isOpen && state !== 'failed';
    this.cancel.hidden = this.weightField.hidden = !isOpen;
    if (!isInUse(this.weight)) this.weight.value = weight;
  }
}

function rateOf(job) {
  const rate = job.progress?.rollouts_per_s ?? job.progress?.bodies_per_s;
  if (!rate) return '';
  return `${number(rate)} ${job.kind === 'training' ? 'bodies' : 'rollouts'} per second`;
}

/** Checkboxes that select jobs of a list, and the button that shows them on one page. */
export function comparing(app, path, text) {
  const chosen = new Set();
  const compare = button(text, () => {
    const [first, ...others] = chosen;
    app.go(`${path}/${first}`, { compare: others.join(',') });
  }, { disabled: true });
  const box = (job) => h('td', {}, h('input', {
    type: 'checkbox', checked: chosen.has(job.id),
    'aria-label': `Compare ${titleOf(job)}${replicateOf(job)}`,
    onchange: (event) => {
      if (event.target.checked) chosen.add(job.id);
      else chosen.delete(job.id);
      compare.disabled = chosen.size < 2;
    },
  }));
  return { compare, box, chosen };
}

/** Returns the jobs that a link compares with the first: at most three. */
export function comparedIn(parameters, id) {
  const ids = (parameters.get('compare') ?? '').split(',').filter(Boolean);
  const wrong = ids.find((one) => !/^\d+$/.test(one));
  if (wrong !== undefined) {
    throw new LinkError(`compare=${wrong}: the number of a job is expected.`);
  }
  if (ids.length > COMPARED_MAX) {
    throw new LinkError(`compare names ${ids.length} jobs; ${COMPARED_MAX} can be compared with ` +
      `${id} on one page.`);
  }
  return ids;
}

/** Asks for confirmation, says what will be lost, and deletes a job that has ended. */
async function remove(job) {
  const what = {
    evaluation: 'its results and recordings', training: 'its curve and checkpoints',
    campaign: 'its generations, population, phylogeny and checkpoints',
  }[job.kind];
  if (!await confirmDialog(`Delete ${titleOf(job)}?`,
    `${job.kind[0].toUpperCase()}${job.kind.slice(1)} ${job.id} and ${what} will be deleted ` +
    'permanently. Designs, scores and controllers stay.',
    'Delete the job')) return false;
  await request(`v1/jobs/${job.id}`, { method: 'DELETE' });
  announce(`${titleOf(job)} is deleted`);
  return true;
}

/** Edits a job: label, experiment, note; archives or deletes it. */
function editDialog(job, changed) {
  const text = (tag, name, most) => h(tag, {
    name, maxlength: most, value: job[name] ?? '', ...(tag === 'textarea' ? { rows: 4 } : {}),
  });
  const fields = {
    label: text('input', 'label', 200), experiment: text('input', 'experiment', 100),
    note: text('textarea', 'note', 1000),
  };
  const archived = h('input', { type: 'checkbox', checked: job.archived_at !== null });
  const save = async () => {
    const body = { archived: archived.checked };
    for (const [name, field] of Object.entries(fields)) body[name] = field.value || null;
    await request(`v1/jobs/${job.id}`, { method: 'PATCH', body });
    changed();
  };
  const isOver = ['succeeded', 'failed', 'cancelled'].includes(job.state);
  const named = Object.entries(fields).map(([name, field]) =>
    h('label.field.wide', {}, h('span', {}, name[0].toUpperCase() + name.slice(1)), field));
  const dialog = formDialog(titleOf(job), 'Save', save, named,
  h('label.row.wide', {}, archived, 'Archived: hidden from lists'),
  may('admin') && isOver ? h('div.wide', {}, button('Delete', () => announced(async () => {
    if (!await remove(job)) return;
    dialog.close();
    changed();
  }), { class: 'danger' })) : null);
}

/**
 * A table of jobs that draws only visible rows, so that a thousand scroll like ten.
 */
export class JobTable {
  constructor(changed) {
    this.changed = changed;
    this.body = h('tbody');
    this.element = h('div.scroll', {}, table(['Job', 'State', 'Progress', 'Created', ''], this.body,
      undefined, 'table.cards.jobs'));
    this.rows = new Map();
    // An observer of intersections would report a row after the frame in which it appears.
    this.onScroll = () => this.#drawSeen();
    addEventListener('scroll', this.onScroll, { passive: true });
    addEventListener('resize', this.onScroll);
  }

  /** Sets the jobs; rows of jobs that were already shown stay. */
  set(jobs) {
    const before = this.rows;
    this.rows = new Map();
    patch(this.body, jobs, ({ id }) => id, ({ id }) => Object.assign(h('tr'), { jobId: id }),
      (row, job) => {
        const parts = before.get(job.id)?.parts;
        this.rows.set(job.id, { job, parts });
        if (parts) this.#draw(row);
      });
    this.#drawSeen();
  }

  /** Draws the visible rows, and those within a few screens above and below. */
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
    for (const row of rows.slice(at(-2 * innerHeight), at(3 * innerHeight) + 1)) {
      if (!this.rows.get(row.jobId)?.parts) this.#draw(row);
    }
  }

  #draw(element) {
    const row = this.rows.get(element.jobId);
    if (!row) return;
    const { job } = row;
    if (!row.parts) {
      row.parts = new JobParts(this.changed);
      const { chip, bar, trouble, actions, edit } = row.parts;
      row.parts.link = h('a');
      row.parts.about = h('div.muted');
      row.parts.age = h('td.muted');
      element.append(h('td.main', {}, row.parts.link, row.parts.about), h('td', {}, chip),
        h('td.wide', {}, bar, trouble), row.parts.age,
        h('td', {}, h('div.row', {}, actions, edit)));
    }
    const { link, about, age } = row.parts.update(job);
    link.href = linkOf(job);
    say(link, titleOf(job));
    const note = job.note ? `: ${job.note.slice(0, 60)}` : '';
    const cores = job.core_seconds >= 1 ? `, ${duration(job.core_seconds)} of cores` : '';
    say(about, `${job.kind} ${job.id}${replicateOf(job)}${submitter(job)}${cores}${note}`);
    say(age, ago(job.created_at));
  }

  destroy() {
    removeEventListener('scroll', this.onScroll);
    removeEventListener('resize', this.onScroll);
  }
}
