/** Rows of the table of runs: one for each job, or one for all replicates of a request. */

import { button, h } from '../lib/dom.js';
import { ago, countOf, duration, score } from '../lib/format.js';
import { bestOf, knownFacts } from '../lib/facts.js';
import {
  groupOf, isOpen, kindName, kindOf, linkOf, progressOf, replicateOf, secondsOf, seedOf, stateOf,
  titleOf,
} from '../lib/kinds.js';
import { progressBar, stateChip, submitter } from './jobs.js';

/**
 * A row: a job, or replicates as one row. members: the replicates of that row; isMember: a
 * replicate shown below it.
 * @typedef {{key: string, job: any, members?: any[], isMember?: boolean}} Row
 */

/** Returns the jobs of a row. @param {Row} row */
export const jobsOf = (row) => row.members ?? [row.job];

/** Returns the best of several jobs' best scores. */
function bestOfAll(jobs) {
  const known = jobs.map(bestOf).filter(Boolean);
  return known.length ? known.reduce((a, b) => (b.score < a.score ? b : a)) : null;
}

const least = (values) => values.filter((one) => one !== null && one !== undefined)
  .reduce((a, b) => (a === null || b < a ? b : a), null);

/**
 * The columns that rows can be sorted by: the name, and a value that is compared. Values of null
 * come last in either order. Scores of different names are not mixed.
 * @type {Object<string, {name: string, isRight?: boolean, needsFacts?: boolean,
 *   value: function(Row): any}>}
 */
export const COLUMNS = {
  run: { name: 'Run', value: ({ job }) => titleOf(job).toLowerCase() },
  kind: { name: 'Kind', value: ({ job }) => kindOf(job).name },
  experiment: { name: 'Experiment', value: ({ job }) => job.experiment },
  task: { name: 'Task', needsFacts: true, value: ({ job }) => knownFacts(job)?.task ?? null },
  state: { name: 'State', value: ({ job }) => stateOf(job) },
  best: { name: 'Best score', isRight: true, needsFacts: true,
    value: (row) => {
      const best = bestOfAll(jobsOf(row));
      return best && [best.own?.name ?? '', best.score];
    } },
  started: { name: 'Started', value: (row) => least(jobsOf(row).map((job) => job.started_at)) },
  duration: { name: 'Duration', isRight: true,
    value: (row) => jobsOf(row).map(secondsOf).reduce((a, b) => (b > (a ?? -1) ? b : a), null) },
};

function compare(a, b) {
  if (Array.isArray(a)) return compare(a[0], b[0]) || compare(a[1], b[1]);
  return a < b ? -1 : a > b ? 1 : 0;
}

/**
 * Returns the rows of jobs: replicates of a request are one row, with its members below it if it is
 * open.
 * @param {any[]} jobs newest first
 * @param {Set<string>} opened the groups that are open
 * @param {string} sort a column, or '' for the order of the jobs
 * @returns {Row[]}
 */
export function rowsOf(jobs, opened, sort, isDescending) {
  const groups = new Map();
  for (const job of jobs) {
    const group = groupOf(job);
    const key = group?.replicates > 1 ? `group ${group.id}` : job.id;
    groups.set(key, [...(groups.get(key) ?? []), job]);
  }
  /** @type {Row[]} */
  const rows = [...groups].map(([key, members]) => {
    members.sort((a, b) => (groupOf(a)?.replicate ?? 0) - (groupOf(b)?.replicate ?? 0));
    return members.length > 1 ? { key, job: members[0], members }
      : { key: members[0].id, job: members[0] };
  });
  if (sort) {
    const valued = rows.map((row) => ({ row, value: COLUMNS[sort].value(row) }));
    valued.sort(({ value: a }, { value: b }) => {
      if (a === null || b === null) return Number(a === null) - Number(b === null);
      return (isDescending ? -1 : 1) * compare(a, b);
    });
    rows.splice(0, rows.length, ...valued.map(({ row }) => row));
  }
  return rows.flatMap((row) => (row.members && opened.has(groupOf(row.job).id)
    ? [row, ...row.members.map((job) => ({ key: job.id, job, isMember: true }))] : [row]));
}

/** @param {Row} row @param {Node|null} expander */
function describe({ job, members, isMember }, expander) {
  const { replicates } = groupOf(job) ?? { replicates: 1 };
  const id = `${kindName(job)} ${job.id}`;
  if (members) {
    return [members.length < replicates ? `${members.length} of ${replicates} replicates`
      : countOf(members.length, 'replicate'), expander];
  }
  if (isMember) return [`${id}, seed ${seedOf(job)}`];
  const note = job.note ? `: ${job.note.slice(0, 60)}` : '';
  return [`${id}${replicateOf(job)}${submitter(job)}${job.archived_at ? ', archived' : ''}${note}`];
}

/** @param {Row} row */
function stateCell({ job, members }) {
  if (!members) {
    return [stateChip(job), isOpen(job) && progressOf(job).share !== undefined
      ? progressBar(job) : null];
  }
  const states = [...new Set(members.map(stateOf))].map((state) =>
    members.filter((one) => stateOf(one) === state));
  const shareOf = (job) => progressOf(job).share ?? 1;
  const slowest = members.filter(isOpen)
    .reduce((a, b) => (!a || shareOf(b) < shareOf(a) ? b : a), null);
  return [h('div.row', {}, states.map((same) =>
    h(`span.state.${same[0].state}`, {}, `${same.length} ${stateOf(same[0])}`))),
  slowest ? [progressBar(slowest), h('div.muted', {}, 'slowest replicate')] : null];
}

function bestCell(row) {
  const best = bestOfAll(jobsOf(row));
  if (!best) return ['–'];
  const direction = best.isUp ? 'higher' : 'lower';
  return [best.text, h('span.muted', { role: 'img', 'aria-label': `, ${direction} is better`,
    title: `${kindOf(row.job).scored}: ${direction} is better` }, best.isUp ? ' ↑' : ' ↓'),
  best.isUp ? h('div.muted', {}, `loss ${score(best.score)}`) : null];
}

/**
 * Returns the cells of a row; the first has the box that selects it.
 * @param {Row} row
 * @param {{isOpen: boolean, toggle: function(): void, choose: function(boolean): void}} [actions]
 *   they may only use the key of the row
 */
export function cellsOf(row, actions) {
  const { isOpen: isShown, toggle, choose } = actions ?? {};
  const { job, members, isMember } = row;
  const title = members ? `${titleOf(job)}, ${countOf(members.length, 'replicate')}`
    : `${titleOf(job)}${replicateOf(job)}`;
  const expander = members ? button(isShown ? 'Hide' : 'Show', toggle, {
    class: 'small', 'aria-expanded': String(isShown), 'data-group': groupOf(job).id,
    'aria-label': `${isShown ? 'Hide' : 'Show'} the replicates of ${titleOf(job)}`,
  }) : null;
  const seconds = COLUMNS.duration.value(row);
  const started = COLUMNS.started.value(row);
  return [
    h('td', {}, h('input', { type: 'checkbox', 'aria-label': `Select ${title}`,
      onchange: (event) => choose(event.target.checked) })),
    h(`td.main${isMember ? '.member' : ''}`, {},
      h('a', { href: linkOf(job, members ? 'replicates' : '') },
        isMember ? replicateOf(job).slice(2) : titleOf(job)),
      h('div.row.muted', {}, describe(row, expander))),
    h('td', {}, kindOf(job).name),
    h('td', {}, job.experiment ?? ''),
    h('td', {}, knownFacts(job)?.task ?? ''),
    h('td.wide', {}, stateCell(row)),
    h('td.right', { 'data-name': 'Best' }, bestCell(row)),
    h('td.muted', { title: started ? new Date(started).toLocaleString() : 'not started yet' },
      started ? ago(started) : '–'),
    h('td.right.muted', { 'data-name': 'for' }, duration(seconds)),
  ];
}
