/** What the pages of all kinds of runs share: the head, the tabs, and staying up to date. */

import { LinkError, getJson } from '../lib/api.js';
import { announce, fill, h } from '../lib/dom.js';
import { coalesced } from '../lib/events.js';
import { KINDS, asJob, stateOf, titleOf } from '../lib/kinds.js';
import { comparedIn } from './jobs.js';
import { RunHead } from './run_head.js';

/** A running job is polled, because not every phase has events. */
const POLL_MS = 2000;

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
 * @param {{kind: string, tabs: Object<string, any>, prepare: function(Shared): Promise<any>}} page
 *   tabs: classes with an element, refresh() and destroy(), by the end of the address; prepare:
 *   returns the parts of the head, and about(job): what is said beside the title
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

  async function refreshJob() {
    const was = job.state;
    job = await load();
    if (was !== job.state) announce(`${titleOf(job)}: ${stateOf(job)}`);
    head.update(job, about(job));
  }

  async function turnTo(other) {
    tab?.destroy();
    tab = new tabs[other](shared);
    head.turnTo(other);
    fill(place, tab.element);
    await tab.refresh();
  }

  // What is new is drawn together, at most twice per second.
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
