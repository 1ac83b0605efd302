/** Common parts of the pages of all kinds of runs: the head, the tabs, and the updates. */

import { LinkError, getJson } from '../lib/api.js';
import { announce, button, fill, h, say } from '../lib/dom.js';
import { coalesced } from '../lib/events.js';
import {
  KINDS, asJob, isOver, kindOf, linkOf, shortProgress, stateOf, titleOf,
} from '../lib/kinds.js';
import { noticeButton } from '../lib/notices.js';
import { may } from '../lib/rights.js';
import { JobParts, comparedIn } from './jobs.js';
import { announced } from './share.js';

/** A running job is polled, because not every phase has events. */
const POLL_MS = 2000;
const DASH_NAMES = ['dashed', 'dotted', 'dash and dot'];

/** Returns a chip for a job that is compared with this one, with a button to remove it. */
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

class RunHead {
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

/**
 * What the tabs and the head of a run's page share.
 * @typedef {{app: import('../app.js').app, id: string, get: function(string): Promise<any>,
 *   others: string[], parameters: URLSearchParams, signal: AbortSignal, job: () => any,
 *   refreshJob: () => Promise<void>, [own: string]: any}} Shared
 */

/**
 * Shows the page of a run.
 * @param {HTMLElement} main
 * @param {string[]} path the id, and the tab
 * @param {URLSearchParams} parameters
 * @param {import('../app.js').app} app
 * @param {{kind: string, tabs: Object<string, function(): Promise<any>>,
 *   prepare: function(Shared): Promise<any>}} page
 *   tabs: by the end of the address, functions that load classes with an element, refresh() and
 *   destroy(); prepare: returns the parts of the head, and about(job): the words beside the title
 */
export async function mountRun(main, [id, part = ''], parameters, app, { kind, tabs, prepare }) {
  const { name, path } = KINDS[kind];
  if (!Object.hasOwn(tabs, part)) throw new LinkError(`${name} ${id} has no part “${part}”.`);
  const stop = new AbortController();
  const get = (url) => getJson(url, { signal: stop.signal });
  const load = async () => asJob(kind, await get(`v1/${path}/${encodeURIComponent(id)}`));
  let job = await load();
  const others = comparedIn(parameters, id);
  /** @type {Shared} */
  const shared = { app, id, get, others, parameters, signal: stop.signal, job: () => job,
    refreshJob };
  const { about, ...parts } = await prepare(shared);
  const head = new RunHead(app, job, { changed: () => later(), others, ...parts });
  const place = h('div.stack');
  /** @type {any} */
  let tab = null;
  let wanted = part;

  async function refreshJob() {
    const was = job.state;
    job = await load();
    if (was !== job.state) announce(`${titleOf(job)}: ${stateOf(job)}`);
    head.update(job, about(job));
  }

  async function turnTo(other) {
    wanted = other;
    const Tab = await tabs[other]();
    if (wanted !== other) return;
    tab?.destroy();
    tab = new Tab(shared);
    head.turnTo(other);
    fill(place, tab.element);
    await tab.refresh();
  }

  // News is drawn together, at most twice per second.
  const later = coalesced(async () => {
    await refreshJob();
    await tab.refresh();
  }, stop.signal);
  main.replaceChildren(head.element, head.tabs, head.status, place);
  head.update(job, about(job));
  try {
    await turnTo(part);
  } catch (error) {
    stop.abort();
    tab?.destroy();
    throw error;
  }
  const timer = setInterval(() => {
    if (!document.hidden && job.state === 'running') refreshJob().catch(() => {});
  }, POLL_MS);
  return {
    /** Shows another tab of the same run; returns false if the address has another one. */
    turnTo([other, end = ''], query) {
      const isHere = other === id && Object.hasOwn(tabs, end) &&
        (query.get('compare') ?? '') === others.join(',');
      shared.parameters = query;
      if (isHere) turnTo(end).catch((error) => announce(error.message, { isRefusal: true }));
      return isHere;
    },
    update(event) {
      if (event.type === 'reset' || event.job === id || others.includes(event.job)) later();
    },
    unmount() {
      clearInterval(timer);
      stop.abort();
      tab.destroy();
    },
  };
}
