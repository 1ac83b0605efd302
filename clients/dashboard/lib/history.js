/** Undo history of the body in the Lab, kept until the tab is closed. */

import { storing } from './api.js';

const STATE_KEY = 'morphod-lab';
const STEPS_MAX = 100;

export const isBody = (text) => /^[01]{144}$/.test(text) && text.includes('1');

/** Returns the stored {past, body, future}, without invalid bodies. */
function stored() {
  const text = storing(() => sessionStorage.getItem(STATE_KEY));
  try {
    const { past, body, future } = JSON.parse(text);
    return { past: past.filter(isBody), body: isBody(body) ? body : null,
      future: future.filter(isBody) };
  } catch {
    return { past: [], body: null, future: [] };
  }
}

export class History {
  constructor() {
    const { past, body, future } = stored();
    this.past = past;
    /** The current body; null before the first. @type {string|null} */
    this.body = body;
    this.future = future;
  }

  /** Adds a body after the current one; what was undone is dropped. */
  push(body) {
    if (body === this.body) return;
    if (this.body) this.past.push(this.body);
    this.future = [];
    this.#set(body);
  }

  /** Goes back one step; returns whether there was one. */
  undo() {
    return this.#go(this.past, this.future);
  }

  redo() {
    return this.#go(this.future, this.past);
  }

  #go(from, to) {
    const body = from.pop();
    if (!body) return false;
    to.push(this.body);
    this.#set(body);
    return true;
  }

  #set(body) {
    this.body = body;
    this.past.splice(0, this.past.length - STEPS_MAX);
    const { past, future } = this;
    storing(() => sessionStorage.setItem(STATE_KEY, JSON.stringify({ past, body, future })));
  }
}
