/**
 * The daemon's events. One stream serves all pages of a browser: a lock selects the page that keeps
 * the stream, and that page passes the events on. Hidden pages do not stream, unless the user waits
 * for an event; later they continue after the last event they saw, so none is lost.
 */

import { ApiError, getJson, request, withQuery } from './api.js';

const CHANNEL = 'morphod-events';

/** Returns whether an event is more than a step of a job's progress. */
export const isNews = ({ type }) => type !== 'reset' && !type.endsWith('progress');

/**
 * Runs work soon after a request, and again if another request arrived in the meantime. Runs never
 * overlap, and the last run starts after the last request. After a failure, the next event retries.
 * @param {() => Promise<any>} work
 * @param {AbortSignal} signal ends it
 */
export function coalesced(work, signal, pauseMs = 500) {
  let busy = false;
  let again = false;
  return async function later() {
    again = true;
    if (busy) return;
    busy = true;
    while (again && !signal.aborted) {
      await new Promise((resolve) => setTimeout(resolve, pauseMs));
      again = false;
      if (!signal.aborted) await work().catch(() => {});
    }
    busy = false;
  };
}

export class Events {
  constructor() {
    /** Number of the newest event seen. */
    this.last = null;
    this.listeners = new Set();
    /** Whether a hidden page streams, too. */
    this.isKept = () => false;
    this.stopper = null;
    this.channel = 'BroadcastChannel' in window ? new BroadcastChannel(CHANNEL + location.pathname)
      : null;
    this.channel?.addEventListener('message', ({ data }) => this.#take(data));
    document.addEventListener('visibilitychange', () => this.#change());
  }

  /** Calls `listener` with every event: {id, type, job, at, data}; type "reset": reload. */
  listen(listener) {
    this.listeners.add(listener);
  }

  /** Starts or stops streaming, depending on isKept. */
  wake() {
    this.#change();
  }

  /** Records the number of the newest event, so that later reads miss no events, and returns it.
   * `wake` starts to stream. */
  async start() {
    const page = await getJson('v1/events?format=json&after=0&limit=1');
    this.last = Number(page.newest);
    return this.last;
  }

  /** Returns the notable ones of the `n` events up to a number, oldest first. */
  async upTo(last, n = 300) {
    const query = { format: 'json', after: Math.max(0, last - n), limit: n };
    const page = await getJson(withQuery('v1/events', query));
    return page.items.filter((event) => Number(event.id) <= last && isNews(event));
  }

  #change() {
    if (document.hidden && !this.isKept()) {
      this.stopper?.abort();
      this.stopper = null;
    } else if (!this.stopper && this.last !== null) {
      this.stopper = new AbortController();
      this.#run(this.stopper.signal);
    }
  }

  async #run(signal) {
    // First, once, read the events that occurred while this page was hidden or waited for the lock.
    const work = () => this.#stream(signal);
    if (navigator.locks) {
      this.#catchUp(signal);
      await navigator.locks.request(CHANNEL + location.pathname, { signal }, work).catch(() => {});
    } else {
      await work();
    }
  }

  async #catchUp(signal) {
    try {
      for (;;) {
        const page = await getJson(
          withQuery('v1/events', { format: 'json', after: this.last, limit: 1000 }), { signal });
        page.items.forEach((event) => this.#take(event));
        if (page.next_cursor === null || !page.items.length) return;
      }
    } catch {
      // The stream or the next visit will deliver them.
    }
  }

  async #stream(signal) {
    let waitS = 0.5;
    while (!signal.aborted) {
      try {
        const response = await request(withQuery('v1/events', { after: this.last }), {
          signal, headers: { Accept: 'text/event-stream' },
        });
        waitS = 0.5;
        await this.#read(response.body.pipeThrough(new TextDecoderStream()).getReader());
      } catch (error) {
        if (signal.aborted) return;
        if (error instanceof ApiError && error.retryAfterS) waitS = error.retryAfterS;
      }
      if (signal.aborted) return;
      await new Promise((resolve) => setTimeout(resolve, waitS * 1000));
      waitS = Math.min(waitS * 2, 10);
    }
  }

  async #read(reader) {
    let text = '';
    for (;;) {
      const { value, done } = await reader.read();
      if (done) return;
      text += value;
      const blocks = text.split('\n\n');
      text = blocks.pop();
      for (const block of blocks) {
        const data = block.split('\n').filter((line) => line.startsWith('data:'))
          .map((line) => line.slice(5)).join('\n');
        const type = /^event: ?(.*)$/m.exec(block)?.[1];
        if (type === 'reset') this.#pass({ type: 'reset' });
        else if (data) this.#pass(JSON.parse(data));
      }
    }
  }

  #pass(event) {
    this.channel?.postMessage(event);
    this.#take(event);
  }

  #take(event) {
    if (event.type !== 'reset') {
      const id = Number(event.id);
      if (this.last !== null && id <= this.last) return;
      this.last = id;
    }
    for (const listener of this.listeners) listener(event);
  }
}
