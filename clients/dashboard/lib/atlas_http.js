/** An atlas of the service: the interface of lib/atlas_file.js over the routes of /v1/atlases. */

import { getJson, patient, withQuery } from './api.js';

/** @type {any} */
const NONE = {};

export class AtlasHttp {
  /** @param {string} name */
  constructor(name) {
    this.name = name;
    this.path = `v1/atlases/${encodeURIComponent(name)}`;
  }

  #get(what, parameters = {}, signal = undefined) {
    return patient(() => getJson(withQuery(`${this.path}${what}`, parameters), { signal }));
  }

  about() {
    return this.#get('');
  }

  body(design, { changes = 8, signal } = NONE) {
    return this.#get('/body', { design, changes, steps: 'add,remove,move' }, signal);
  }

  at(position, { signal } = NONE) {
    return this.#get('/body', { position, changes: 0 }, signal);
  }

  ascent(design, { signal } = NONE) {
    return this.#get('/ascent', { design }, signal);
  }

  best({ signal, ...query } = NONE) {
    return this.#get('/best', { limit: 100, ...query }, signal);
  }

  map(measure, { bins = 64, signal } = NONE) {
    return this.#get('/map', { measure, bins }, signal);
  }

  histogram({ bins = 64, lo, hi, measure, signal } = NONE) {
    return this.#get('/histogram', { bins, lo, hi, measure }, signal);
  }

  optima({ limit = 24, signal } = NONE) {
    return this.#get('/optima', { limit }, signal);
  }

  compare(other, { bins = 64, signal } = NONE) {
    return this.#get('/compare', { with: other, bins }, signal);
  }
}
