/** Compares two atlases: how many bodies have which pair of scores. */

import { announce, choice, fill, h, say } from '../lib/dom.js';
import { count, countOf, score } from '../lib/format.js';
import { AtlasHttp } from '../lib/atlas_http.js';
import { AtlasSquare } from './atlas_square.js';

const BINS = 64;
const NONE = 'Compare with…';

/** Explains what Kendall's τ means. */
function tauWords(tau) {
  if (tau === null) return 'One atlas ranks all bodies equally.';
  const share = Math.round(50 * (1 + tau));
  return `Kendall's τ ${tau.toFixed(3)}: the atlases agree on the better of two bodies in ` +
    `${share} of 100 cases.`;
}

/** Returns the body of another atlas as this atlas describes it, or null. */
const bodyIn = async (atlas, about, { genotype, voxels }) => (voxels > about.voxels_max ? null
  : atlas.body(genotype, { changes: 0 }));

export class AtlasCompare {
  /**
   * @param {any} page of an atlas
   * @param {string[]} names of the other atlases
   */
  constructor(page, names) {
    this.page = page;
    this.turn = 0;
    /** The comparison, and the other atlas. @type {any} */
    this.found = null;
    /** @type {any} */
    this.other = null;
    this.square = new AtlasSquare(page.app);
    this.words = h('p.muted', { role: 'status' }, 'Another task, or another controller: do the ' +
      'same bodies win?');
    this.bests = h('div.strip.wraps');
    this.element = h('section.panel.stack', { 'aria-label': 'Compare' }, h('div.row', {},
      h('h2', {}, 'Two atlases'), choice('Compare with', [['', NONE], ...names], '',
        (name) => this.#show(name))), this.words,
    h('div.row.compare', {}, this.square.canvas, this.bests));
  }

  async #show(name) {
    const turn = ++this.turn;
    this.square.show(null);
    fill(this.bests);
    this.found = null;
    if (!name) return;
    say(this.words, 'Comparing…');
    const { page } = this;
    try {
      const other = new AtlasHttp(name);
      const [found, about] = await Promise.all([page.atlas.compare(name, { bins: BINS }),
        other.about()]);
      const inOther = (one) => bodyIn(other, about, one);
      const [ours, theirs] = await Promise.all([inOther(page.about.best),
        bodyIn(page.atlas, page.about, about.best)]);
      if (turn !== this.turn) return;
      this.found = found;
      this.other = { name, inOther };
      const lost = found.outside ? ` ${count(found.outside)} of them diverged in one atlas.` : '';
      say(this.words, `${countOf(found.bodies, 'body is', 'bodies are')} in both.${lost} ` +
        tauWords(found.kendall_tau));
      fill(this.bests, [[page.about.best, ours, page.atlas.name, name],
        [about.best, theirs, name, page.atlas.name]].map(([best, there, here, away]) =>
        page.card(best, { title: `best of ${here}`, words: h('span.muted', {}, there
          ? `${score(there.score)}, rank ${count(there.rank)}, in ${away}`
          : `not in ${away}`) })));
      this.square.show({ a: found.edges_a, b: found.edges_b, counts: found.counts,
        names: [`◂ better in ${page.atlas.name}`, `◂ better in ${name}`] },
      `Scores in ${page.atlas.name} and in ${name}. ${this.words.textContent}`);
      this.mark(page.shown);
    } catch (error) {
      if (turn !== this.turn) return;
      say(this.words, error.message);
    }
  }

  /** Marks the body that is shown in both. */
  async mark(body) {
    if (!this.found) return;
    const turn = ++this.turn;
    this.square.mark(null);
    try {
      const there = body && await this.other.inOther(body);
      if (turn !== this.turn) return;
      this.square.mark(there && [body.score, there.score]);
    } catch (error) {
      if (turn !== this.turn) return;
      announce(error.message, { isRefusal: true });
    }
  }

  destroy() {
    this.turn++;
    this.square.destroy();
  }
}
