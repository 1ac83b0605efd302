/** An atlas of the service: the interface of lib/atlas_file.js over the routes of /v1/atlases. */

import { getJson, patient, withQuery } from './api.js';

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

  body(design, { changes = 8, signal } = {}) {
    return this.#get('/body', { design, changes }, signal);
  }

  ascent(design, { signal } = {}) {
    return this.#get('/ascent', { design, steps: 'add,remove' }, signal);
  }

  best({ voxels, limit = 20, offset = 0, signal } = {}) {
    return this.#get('/best', { voxels: voxels || undefined, limit, offset }, signal);
  }

  histogram({ bins = 64, lo, hi, signal } = {}) {
    return this.#get('/histogram', { bins, lo, hi }, signal);
  }

  optima({ limit = 24, signal } = {}) {
    return this.#get('/optima', { limit }, signal);
  }
}
