/** The local optima of an atlas with the largest basins, in their order. */

import { button, fill, h, say } from '../lib/dom.js';
import { count, countOf, percent, voxels } from '../lib/format.js';

const SHOWN = 18;

export class AtlasOptima {
  /** @param {any} page of an atlas */
  constructor(page) {
    this.page = page;
    this.words = h('span.muted', { role: 'status' }, 'A body is a local optimum if adding or ' +
      'removing a voxel does not improve it. Its basin is all bodies from which the way up ends ' +
      'there.');
    this.list = h('div.strip.wraps');
    this.load = button('Find them', () => this.#load());
    this.element = h('section.panel.stack', { 'aria-label': 'Local optima' },
      h('div.row', {}, h('h2', {}, 'Where searches end'), this.load), this.words, this.list);
  }

  async #load() {
    const { page } = this;
    this.load.disabled = true;
    say(this.words, 'Following the way up from every body…');
    try {
      const { items, optima } = await page.atlas.optima({ limit: SHOWN });
      const { bodies, best } = page.about;
      say(this.words, `${countOf(optima, 'local optimum', 'local optima')} for ` +
        `${count(bodies)} bodies: a search that takes only improving one-voxel steps ends at ` +
        `one of them. The ${items.length} with the largest basins, each with its share ` +
        'of the bodies:');
      fill(this.list, items.map((one) => page.card(one, {
        label: `Basin of ${countOf(one.basin, 'body', 'bodies')}`, title: voxels(one.voxels),
        words: [meter(one.basin / items[0].basin), h('span.muted', {},
          `${percent(one.basin / bodies)} · ${count(one.basin)}`),
        one.id === best.id ? h('span.crown', {}, '♛ best of all') : null],
      })));
      this.load.remove();
    } catch (error) {
      say(this.words, error.message);
      this.load.disabled = false;
    }
  }
}

/** Returns a bar that is this long, from 0 to 1. */
const meter = (share) => h('progress', { value: share, max: 1, 'aria-hidden': 'true' });
