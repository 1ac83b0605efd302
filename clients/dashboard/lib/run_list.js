/** The jobs that a filter finds, loaded page by page. */

import { getJson, withQuery } from './api.js';
import { factsOf, knownFacts } from './facts.js';
import { KINDS, isMoving } from './kinds.js';

/** Loaded for an order other than the service's, or for a filter that the service does not have. */
const LOADED_MAX = 5000;
const PAGE_MAX = 1000;

/** The query of a list: see readLink of views/runs.js.
 * @typedef {{search: string, kind: string, state: string, experiment: string, archived: string,
 *   sort: string, order: string}} Asked */

export class RunList {
  /** @param {AbortSignal} signal ends everything */
  constructor(signal) {
    /** Aborts the requests of the newest call of load, and those that its jobs need. */
    this.turn = new AbortController();
    signal.addEventListener('abort', () => this.turn.abort());
    this.signal = signal;
    /** The jobs, newest first. */
    this.items = [];
    /** Whether there are more. */
    this.isCut = false;
    /** Jobs that were read; more than the items if the page filters them. */
    this.scanned = 0;
  }

  /** Returns the filters of the service's list, by its names. @param {Asked} asked */
  static filters({ search, kind, state, experiment, archived }) {
    return { search, kind: KINDS[kind]?.kind, state, experiment, archived };
  }

  /**
   * Loads jobs until there are enough; as many as possible if the page sorts them itself. Returns
   * false if another call began in the meantime, or the page was left.
   * @param {Asked} asked
   * @param {number} wanted
   * @param {boolean} needsFacts whether the order is by facts of the jobs
   * @param {function(number): void} reading called before the facts are read
   */
  async load(asked, wanted, needsFacts, reading) {
    this.turn.abort();
    this.turn = new AbortController();
    if (this.signal.aborted) return false;
    const { signal } = this.turn;
    try {
      return await this.#load(asked, wanted, needsFacts, reading, signal);
    } catch (error) {
      if (signal.aborted) return false;
      throw error;
    }
  }

  async #load(asked, wanted, needsFacts, reading, signal) {
    const { only } = KINDS[asked.kind] ?? {};
    const most = Math.max(LOADED_MAX, wanted);
    const target = asked.sort ? most : wanted;
    const found = [];
    let cursor;
    let n = 0;
    do {
      const limit = only ? PAGE_MAX : Math.min(PAGE_MAX, target - found.length);
      const page = await getJson(
        withQuery('v1/jobs', { ...RunList.filters(asked), limit, cursor }), { signal });
      found.push(...(only ? page.items.filter(only) : page.items));
      n += page.items.length;
      cursor = page.next_cursor;
    } while (cursor !== null && found.length < target && n < most);
    if (needsFacts && found.some((job) => !knownFacts(job))) {
      reading(found.length);
      await Promise.allSettled(found.map((job) => factsOf(job, signal)));
    }
    if (signal.aborted) return false;
    [this.items, this.isCut, this.scanned] = [found, cursor !== null, n];
    return true;
  }

  /** Updates the jobs whose progress changes. */
  async poll() {
    const states = new Set(this.items.filter(isMoving).map(({ state }) => state));
    const pages = await Promise.all([...states].map((state) =>
      getJson(withQuery('v1/jobs', { state, archived: 'all', limit: 1000 }),
        { signal: this.signal })));
    const byId = new Map(pages.flatMap(({ items }) => items).map((job) => [job.id, job]));
    this.items = this.items.map((job) => byId.get(job.id) ?? job);
  }
}
