/** The scores of an atlas and one of its measures: how many bodies have which pair, and which
 * bodies they are. */

import { choice, fill, h, patch, say } from '../lib/dom.js';
import { count, countOf, number, score } from '../lib/format.js';
import { AtlasSquare } from './atlas_square.js';

const BINS = 64;
const SHOWN = 24;
const NONE = 'Choose a measure…';

export class AtlasPairs {
  /** @param {any} page of an atlas with measures */
  constructor(page) {
    this.page = page;
    this.turn = 0;
    this.measure = '';
    this.square = new AtlasSquare(page.app, (range) => this.#list(range));
    this.words = h('p.muted', { role: 'status' }, 'Do good bodies have high values, or low ones?');
    this.list = h('div.strip.wraps');
    this.element = h('section.panel.stack', { 'aria-label': 'Score and measure' }, h('div.row', {},
      h('h2', {}, 'Score and measure'), choice('Measure', [['', NONE], ...page.about.measures], '',
        (name) => this.#show(name))), this.words,
    h('div.row.compare', {}, this.square.canvas, this.list));
  }

  async #show(name) {
    const turn = ++this.turn;
    this.measure = name;
    this.square.show(null);
    fill(this.list);
    if (!name) return;
    say(this.words, 'Counting…');
    try {
      const map = await this.page.atlas.map(name, { bins: BINS });
      if (turn !== this.turn) return;
      const tau = map.kendall_tau === null ? '' : ` Kendall's τ ${map.kendall_tau.toFixed(3)}: ` +
        `of two bodies, the one with the lower ${name} has the better score in ` +
        `${Math.round(50 * (1 + map.kendall_tau))} of 100 cases.`;
      const without = map.without_value
        ? ` ${countOf(map.without_value, 'body has', 'bodies have')} no value.` : '';
      say(this.words, `${countOf(map.bodies, 'body', 'bodies')}.${without}${tau} Click a place, ` +
        'or drag over several, to see the bodies there.');
      this.square.show({ a: map.edges_score, b: map.edges_measure, counts: map.counts,
        names: ['◂ better score', name] }, `Bodies by score and ${name}. Arrow keys choose a ` +
        'place, and with Shift a range. The bodies are listed below.');
      this.mark(this.page.shown);
    } catch (error) {
      if (turn === this.turn) say(this.words, error.message);
    }
  }

  /** Marks the body that is shown; null: none. */
  mark(body) {
    if (this.measure) this.square.mark(body && [body.score, body.measures[this.measure]]);
  }

  /** Lists the bodies of a range. @param {number[][]} range */
  async #list(range) {
    const [[scoreLo, scoreHi], [lo, hi]] = range;
    const turn = ++this.turn;
    const { measure } = this;
    try {
      const { items, bodies } = await this.page.atlas.best({ measure, lo, hi, score_lo: scoreLo,
        score_hi: scoreHi, limit: SHOWN });
      if (turn !== this.turn) return;
      say(this.words, `${countOf(bodies, 'body', 'bodies')} with scores from ${score(scoreLo)} ` +
        `to ${score(scoreHi)} and ${measure} from ${number(lo, 4)} to ${number(hi, 4)}${bodies >
        SHOWN ? `: the ${count(SHOWN)} with the highest ${measure}` : ''}`);
      const words = (one) => h('span.muted', {}, number(one.measures[measure], 4));
      patch(this.list, items.map((one, i) => ({ one, i })), ({ i }) => i,
        ({ one }) => this.page.card(one, { words: words(one) }),
        (card, { one }) => this.page.fillCard(card, one, { words: words(one) }));
    } catch (error) {
      if (turn === this.turn) say(this.words, error.message);
    }
  }

  destroy() {
    this.turn++;
    this.square.destroy();
  }
}
