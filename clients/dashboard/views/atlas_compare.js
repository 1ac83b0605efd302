/** Two atlases compared: how many bodies have which pair of scores. */

import { announce, choice, fill, h, paint, say } from '../lib/dom.js';
import { count, score } from '../lib/format.js';
import { ticks } from '../lib/chart.js';
import { AtlasHttp } from '../lib/atlas_http.js';

const BINS = 64;
const LEFT_PX = 56;
const BOTTOM_PX = 40;
const MARGIN_PX = 10;
const NONE = 'Compare with…';

/** Explains what Kendall's τ means. */
function tauWords(tau) {
  if (tau === null) return 'One of them does not rank bodies at all.';
  const share = Math.round(50 * (1 + tau));
  return `Kendall's τ ${tau.toFixed(3)}: of two bodies, both atlases prefer the same one in ` +
    `${share} of 100 cases.`;
}

/** Returns what an atlas has of a body of another one, or null. */
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
    this.canvas = h('canvas.square', { role: 'img', hidden: true });
    this.words = h('p.muted', { role: 'status' }, 'Another task, or another controller: do the ' +
      'same bodies win?');
    this.bests = h('div.strip.wraps');
    this.element = h('section.panel.stack', { 'aria-label': 'Compare' }, h('div.row', {},
      h('h2', {}, 'Two atlases'), choice('Compare with', [['', NONE], ...names], '',
        (name) => this.#show(name))), this.words,
    h('div.row.compare', {}, this.canvas, this.bests));
    this.resize = new ResizeObserver(() => this.#draw());
    this.resize.observe(this.canvas);
    this.onTheme = () => this.#draw();
    page.app.themeListeners.add(this.onTheme);
  }

  async #show(name) {
    const turn = ++this.turn;
    this.canvas.hidden = !name;
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
      const lost = found.outside ? ` ${count(found.outside)} of them diverged in one.` : '';
      say(this.words, `${count(found.bodies)} bodies are in both.${lost} ` +
        tauWords(found.kendall_tau));
      fill(this.bests, [[page.about.best, ours, page.atlas.name, name],
        [about.best, theirs, name, page.atlas.name]].map(([best, there, here, away]) =>
        page.card(best, { title: `best of ${here}`, words: h('span.muted', {}, there
          ? `${score(there.score)}, rank ${count(there.rank)}, in ${away}`
          : `not in ${away}`) })));
      this.canvas.setAttribute('aria-label', `Scores in ${page.atlas.name} and in ${name}. ` +
        this.words.textContent);
      this.mark(page.shown);
    } catch (error) {
      if (turn !== this.turn) return;
      this.canvas.hidden = true;
      say(this.words, error.message);
    }
  }

  /** Marks the body that is shown in both. */
  async mark(body) {
    if (!this.found) return;
    const turn = ++this.turn;
    this.at = null;
    try {
      const there = body && await this.other.inOther(body);
      if (turn !== this.turn) return;
      this.at = there && [body.score, there.score];
    } catch (error) {
      if (turn !== this.turn) return;
      announce(error.message, { isRefusal: true });
    }
    this.#draw();
  }

  #draw() {
    const painted = this.found && paint(this.canvas);
    if (!painted) return;
    const { context, width, height, color } = painted;
    const { edges_a: a, edges_b: b, counts } = this.found;
    const [right, bottom] = [width - MARGIN_PX, height - BOTTOM_PX];
    const x = (v) => LEFT_PX + (v - a[0]) / (a.at(-1) - a[0] || 1) * (right - LEFT_PX);
    const y = (v) => bottom - (v - b[0]) / (b.at(-1) - b[0] || 1) * (bottom - MARGIN_PX);
    const most = Math.log1p(Math.max(...counts.flat()));
    context.fillStyle = color('--blue');
    counts.forEach((row, i) => row.forEach((n, j) => {
      if (!n) return;
      context.globalAlpha = 0.15 + 0.85 * Math.log1p(n) / most;
      context.fillRect(x(a[i]), y(b[j + 1]), x(a[i + 1]) - x(a[i]), y(b[j]) - y(b[j + 1]));
    }));
    context.globalAlpha = 1;
    context.strokeStyle = color('--line');
    context.strokeRect(LEFT_PX, MARGIN_PX, right - LEFT_PX, bottom - MARGIN_PX);
    context.fillStyle = color('--muted');
    context.textAlign = 'center';
    for (const v of ticks(a[0], a.at(-1), 5)) context.fillText(v.toPrecision(2), x(v), bottom + 15);
    context.fillText(`◂ better in ${this.page.atlas.name}`, (LEFT_PX + right) / 2, height - 6);
    context.textAlign = 'right';
    for (const v of ticks(b[0], b.at(-1), 5)) {
      context.fillText(v.toPrecision(2), LEFT_PX - 5, y(v) + 4);
    }
    context.save();
    context.translate(13, (MARGIN_PX + bottom) / 2);
    context.rotate(-Math.PI / 2);
    context.textAlign = 'center';
    context.fillText(`◂ better in ${this.other.name}`, 0, 0);
    context.restore();
    if (!this.at || this.at.includes(null)) return;
    context.beginPath();
    context.arc(x(this.at[0]), y(this.at[1]), 7, 0, 2 * Math.PI);
    context.fillStyle = color('--mark');
    context.fill();
    context.lineWidth = 2;
    context.strokeStyle = color('--panel');
    context.stroke();
  }

  destroy() {
    this.turn++;
    this.resize.disconnect();
    this.page.app.themeListeners.delete(this.onTheme);
  }
}
