/** Editing a job: label, experiment, note, archive, deletion. */

import { request } from '../lib/api.js';
import { announce, button, h } from '../lib/dom.js';
import { countOf } from '../lib/format.js';
import { isOver, kindName, kindOf, titleOf } from '../lib/kinds.js';
import { may } from '../lib/rights.js';
import { announced, confirmDialog, formDialog } from './share.js';

/**
 * Asks for confirmation, and states what will be lost. Returns whether the user confirmed.
 * @param {any[]} jobs that have ended
 */
export function confirmDeletion(jobs) {
  const [job] = jobs;
  if (jobs.length === 1) {
    return confirmDialog(`Delete ${titleOf(job)}?`,
      `${kindOf(job).name} ${job.id} and ${kindOf(job).loses} will be permanently deleted. ` +
      'Designs, scores and controllers are kept.', 'Delete the job');
  }
  const kinds = [...new Map(jobs.map((one) => [kindName(one), kindOf(one)])).entries()];
  const lost = kinds.map(([name, kind]) => {
    const n = jobs.filter((one) => kindName(one) === name).length;
    return `${countOf(n, kind.name.toLowerCase(), kind.names.toLowerCase())} with ` +
      `${kind.loses.replace(/\b(its)\b/, n === 1 ? 'its' : 'their')}`;
  });
  return confirmDialog(`Delete ${jobs.length} runs?`,
    `These will be permanently deleted: ${lost.join('; ')}. ` +
      'Designs, scores and controllers are kept.',
    `Delete ${jobs.length} runs`);
}

export const deleteJob = (job) => request(`v1/jobs/${job.id}`, { method: 'DELETE' });

async function remove(job) {
  if (!await confirmDeletion([job])) return false;
  await deleteJob(job);
  announce(`${titleOf(job)} deleted`);
  return true;
}

/** Edits a job: label, experiment, note; archives or deletes it. */
export function editDialog(job, changed) {
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
  const named = Object.entries(fields).map(([name, field]) =>
    h('label.field.wide', {}, h('span', {}, name[0].toUpperCase() + name.slice(1)), field));
  const dialog = formDialog(titleOf(job), 'Save', save, named,
  h('label.row.wide', {}, archived, 'Archived: hidden from lists'),
  may('admin') && isOver(job) ? h('div.wide', {}, button('Delete', () => announced(async () => {
    if (!await remove(job)) return;
    dialog.close();
    changed();
  }), { class: 'danger' })) : null);
}
