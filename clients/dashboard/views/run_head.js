/** The head of a run's page: its title, its state, its actions, and its tabs. */

import { button, fill, h, say } from '../lib/dom.js';
import { isOver, kindOf, linkOf, shortProgress, titleOf } from '../lib/kinds.js';
import { noticeButton } from '../lib/notices.js';
import { may } from '../lib/rights.js';
import { JobParts } from './jobs.js';
import { announced } from './share.js';

const DASH_NAMES = ['dashed', 'dotted', 'dash and dot'];

/** A job that is compared with this one, with a button to remove it. */
function comparedChip(job, others, other, i, isDashed) {
  const rest = others.filter((one) => one !== other).join(',');
  const to = (id) => linkOf({ ...job, id });
  return h('span.state', {},
    h('a', { href: to(other) }, `with ${kindOf(job).name.toLowerCase()} ${other}`),
    isDashed ? `(${DASH_NAMES[i]})` : null, h('a', {
      href: `${to(job.id)}${rest && `?compare=${rest}`}`,
      'aria-label': `Leave out ${kindOf(job).name.toLowerCase()} ${other}`,
    }, '×'));
}

export class RunHead {
  /**
   * @param {import('../app.js').app} app
   * @param {any} job
   * @param {{changed: function(): any, others?: string[], isDashed?: boolean, actions?: any[],
   *   aside?: any[], lines?: any[]}} parts others: the jobs that it is compared with; aside: beside
   *   the title; lines: of the state
   */
  constructor(app, job, { changed, others = [], isDashed = false, actions, aside, lines }) {
    this.app = app;
    this.parts = new JobParts(changed);
    this.job = job;
    this.title = h('h1');
    this.about = h('span.muted');
    this.tabs = h('nav.tabs', { 'aria-label': 'Parts of this run' });
    const again = may('submit') && kindOf(job).starts
      ? button('Start again with…', () => announced(async () =>
        (await import('./again.js')).startAgain(app, this.job))) : null;
    this.notice = noticeButton(job.id);
    const { chip, bar, trouble, remark, row } = this.parts;
    this.element = h('div.title', {}, this.title, this.about, chip, aside,
      others.map((other, i) => comparedChip(job, others, other, i, isDashed)),
      h('div.actions', {}, this.notice, again, actions));
    this.status = h('section.panel.stack', { 'aria-label': 'State' }, bar, trouble, lines, remark,
      row);
  }

  /** Marks a tab as the one that is shown. */
  turnTo(tab) {
    fill(this.tabs, kindOf(this.job).tabs.map(([key, name]) => h('a', {
      href: linkOf(this.job, key), 'aria-current': key === tab ? 'page' : undefined }, name)));
  }

  /** Shows a newer state of the job. */
  update(job, about = '') {
    this.job = job;
    this.parts.update(job);
    this.notice.hidden = isOver(job);
    say(this.title, titleOf(job));
    say(this.about, about);
    this.app.setTitle(`${titleOf(job)}, ${shortProgress(job)}`);
  }
}
