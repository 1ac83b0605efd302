/** The table of jobs of the overview. */

import { h, say, table } from '../lib/dom.js';
import { ago, duration } from '../lib/format.js';
import { kindName, linkOf, replicateOf, titleOf } from '../lib/kinds.js';
import { LazyRows } from '../lib/rows.js';
import { JobParts, submitter } from './jobs.js';

export class JobTable {
  constructor(changed) {
    const body = h('tbody');
    this.changed = changed;
    this.element = h('div.scroll', {}, table(['Job', 'State', 'Progress', 'Created', ''], body,
      undefined, 'table.cards.jobs'));
    this.rows = new LazyRows(body, ({ id }) => id, (row, job) => this.#draw(row, job));
  }

  /** Sets the jobs; rows of jobs that were already shown stay. */
  set(jobs) {
    this.rows.set(jobs);
  }

  #draw(row, job) {
    if (!row.parts) {
      row.parts = new JobParts(this.changed);
      const { chip, bar, trouble, actions, edit } = row.parts;
      row.parts.link = h('a');
      row.parts.about = h('div.muted');
      row.parts.age = h('td.muted');
      row.append(h('td.main', {}, row.parts.link, row.parts.about), h('td', {}, chip),
        h('td.wide', {}, bar, trouble), row.parts.age,
        h('td', {}, h('div.row', {}, actions, edit)));
    }
    const { link, about, age } = row.parts.update(job);
    link.href = linkOf(job);
    say(link, titleOf(job));
    const note = job.note ? `: ${job.note.slice(0, 60)}` : '';
    const cores = job.core_seconds >= 1 ? `, ${duration(job.core_seconds)} of cores` : '';
    say(about,
      `${kindName(job)} ${job.id}${replicateOf(job)}${submitter(job)}${cores}${note}`);
    say(age, ago(job.created_at));
  }

  destroy() {
    this.rows.destroy();
  }
}
