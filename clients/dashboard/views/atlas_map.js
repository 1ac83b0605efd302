/** The density map of an atlas: how many bodies of each size have which score, or which value of a
 * measure. A drag, a click or the arrow keys select a range of one size, and show its bodies. */

import { choice, fill, h, paint, patch, say } from '../lib/dom.js';
import { count, countOf, number, score, voxels } from '../lib/format.js';
import { ticks } from '../lib/chart.js';

const BINS = 72;
/** Number of bins in a request, which have equal widths; the edges of the map's bins are rounded to
 * these. */
const FINE = 14 * BINS;
const RIGHT_PX = 12;
const TOP_PX = 8;
const AXIS_PX = 34;
/** Narrower maps show sizes only as numbers. */
const NARROW_PX = 500;
const ROW_PX = 34;
const SHOWN = 24;
/** The axis is logarithmic if scores differ by more than this factor. */
const LOG_FROM = 6;
const LOG_TICKS = [1, 1.5, 2, 3, 5, 7];

const isWide = (lo, hi) => lo > 0 && hi / lo > LOG_FROM;

/** Returns the score below which finer bins are needed, because outliers make equal bins wider than
 * the first one of a logarithmic axis; 0: they are not needed. */
function cutOf(lo, hi) {
  const first = lo * ((hi / lo) ** (1 / BINS) - 1);
  return isWide(lo, hi) && (hi - lo) / FINE > first ? lo + FINE * first : 0;
}

/** Returns which edge between the first and the last is nearest to a value. */
function nearest(edges, place) {
  const i = edges.findIndex((edge) => edge >= place);
  return i > 0 && place - edges[i - 1] < edges[i] - place ? i - 1 : Math.max(0, i);
}

export class AtlasMap {
  /** @param {any} page of an atlas */
  constructor(page) {
    this.page = page;
    const { sizes, measures = [] } = page.about;
    /** What the axis shows; '': the score. */
    this.measure = '';
    this.rows = sizes.length;
    this.canvas = h('canvas', {
      tabindex: 0, role: 'application', 'aria-roledescription': 'density map',
    });
    this.canvas.style.height = `${TOP_PX + ROW_PX * this.rows + AXIS_PX}px`;
    this.words = h('p.muted', { role: 'status' });
    this.list = h('div.strip.wraps');
    this.title = h('h2');
    this.element = h('section.panel.stack', { 'aria-label': 'Map' }, h('div.row', {}, this.title,
      measures.length ? choice('Axis', ['score', ...measures], 'score', (name) =>
        this.#load(name === 'score' ? '' : name)) : null, h('span.muted.legend', {}, h('span', {},
        h('i.swatch.here'), 'your body'), h('span', {}, h('i.swatch.top'), 'best of its size'))),
    this.canvas, this.words, this.list);
    this.turn = 0;
    this.loads = 0;
    /** Where the axis begins, in pixels. */
    this.left = 0;
    this.resize = new ResizeObserver(() => this.#draw());
    this.resize.observe(this.canvas);
    this.onTheme = () => this.#draw();
    page.app.themeListeners.add(this.onTheme);
    const listen = (type, listener) => this.canvas.addEventListener(type, listener);
    listen('pointerdown', (event) => this.#down(event));
    listen('pointermove', (event) => this.#move(event));
    for (const type of ['pointerup', 'pointercancel']) listen(type, () => { this.isHeld = false; });
    listen('keydown', (event) => this.#key(event));
    this.#name('');
    this.#load('');
  }

  /** Shows the scores, or a measure. */
  async #load(measure) {
    const { atlas } = this.page;
    const turn = ++this.loads;
    const histogram = (range) => atlas.histogram({ bins: FINE, measure: measure || undefined,
      ...range });
    try {
      const all = await histogram({});
      const cut = cutOf(all.edges[0], all.edges.at(-1));
      const parts = cut ? await Promise.all([histogram({ hi: cut }), histogram({ lo: cut })]) : [];
      if (turn !== this.loads) return;
      this.turn++; // replies that are still to come belong to another axis
      this.selected = this.last = this.anchor = undefined;
      fill(this.list);
      this.#name(measure, measure ? all.outside.reduce((sum, n) => sum + n, 0) : 0);
      if (!cut) return this.#bin(all);
      const [low, high] = parts;
      this.#bin({ edges: [...low.edges, ...high.edges.slice(1)],
        counts: low.counts.map((row, i) => [...row, ...high.counts[i]]) });
    } catch (error) {
      if (turn === this.loads) say(this.words, error.message);
    }
  }

  /** Writes what the axis shows, and how many bodies are not on it. */
  #name(measure, without = 0) {
    this.measure = measure;
    const what = `odies by ${measure || 'score'} and size`;
    say(this.title, `All b${what}`);
    this.canvas.setAttribute('aria-label', `B${what}. Up and down choose a size, left and right ` +
      'a range; Shift extends it. The bodies are listed below.');
    say(this.words, 'Click or drag to list the bodies there.' +
      `${without ? ` ${countOf(without, 'body has', 'bodies have')} no value.` : ''}`);
  }

  /** Returns the value of a body on the axis; null: it has none. */
  #of(body) {
    return this.measure ? body.measures[this.measure] : body.score;
  }

  /** Counts again in the bins of the map. They begin where fine bins do, so that each contains
   * exactly the bodies that a click on it lists. */
  #bin({ edges, counts }) {
    const [lo, hi] = [edges[0], edges.at(-1)];
    this.isLog = isWide(lo, hi);
    const scale = this.isLog ? Math.log : (v) => v;
    const [from, to] = [scale(lo), scale(hi)];
    this.share = (value) => (scale(value) - from) / (to - from || 1);
    const begins = Array.from({ length: BINS + 1 }, (_, i) => nearest(edges, this.isLog
      ? lo * (hi / lo) ** (i / BINS) : lo + (hi - lo) * i / BINS));
    begins[BINS] = edges.length - 1;
    this.edges = begins.map((i) => edges[i]);
    this.edges[BINS] = hi + Math.abs(hi) * 1e-6 + 1e-9; // so that the highest score is in the last
                                                        // bin
    this.counts = counts.map((fine) => Array.from({ length: BINS }, (_, i) =>
      fine.slice(begins[i], begins[i + 1]).reduce((sum, n) => sum + n, 0)));
    this.#draw();
  }

  /** Marks the body that is shown; null: none. */
  mark(body) {
    this.body = body;
    this.#draw();
  }

  #x(value, width) {
    return this.left + this.share(value) * (width - this.left - RIGHT_PX);
  }

  /** Returns the y of a row; the smallest bodies are in the lowest row. */
  #y(row) {
    return TOP_PX + (this.rows - 1 - row) * ROW_PX;
  }

  #draw() {
    const painted = this.counts && paint(this.canvas);
    if (!painted) return;
    const { context, width, color } = painted;
    const isNarrow = width < NARROW_PX;
    this.left = isNarrow ? 26 : 74;
    const binWidth = (width - this.left - RIGHT_PX) / BINS;
    const bottom = TOP_PX + this.rows * ROW_PX;
    context.textBaseline = 'middle';
    for (let row = 0; row < this.rows; row++) {
      const y = this.#y(row);
      context.fillStyle = color('--text');
      context.textAlign = 'right';
      context.fillText(isNarrow ? String(row + 1) : voxels(row + 1), this.left - 10,
        y + ROW_PX / 2);
      context.fillStyle = color('--grid');
      context.fillRect(this.left, y + ROW_PX - 1, width - this.left - RIGHT_PX, 1);
      const most = Math.max(...this.counts[row]);
      context.fillStyle = color('--blue');
      this.counts[row].forEach((n, i) => {
        if (!n) return;
        // A logarithm, so that a single body is still visible beside thousands.
        const share = Math.log1p(n) / Math.log1p(most);
        context.globalAlpha = 0.18 + 0.82 * share;
        const height = Math.max(4, (ROW_PX - 5) * share);
        context.fillRect(this.left + i * binWidth, y + ROW_PX - 1 - height,
          Math.max(1, binWidth - 0.5), height);
      });
      context.globalAlpha = 1;
    }
    this.#drawAxis(context, width, bottom, color);
    this.#drawMarks(context, width, color);
    const { selected } = this;
    if (!selected) return;
    context.strokeStyle = color('--text');
    context.lineWidth = 2;
    context.strokeRect(this.left + selected.from * binWidth - 1, this.#y(selected.row) + 1,
      (selected.to - selected.from + 1) * binWidth + 2, ROW_PX - 3);
  }

  #drawAxis(context, width, bottom, color) {
    const [lo, hi] = [this.edges[0], this.edges[BINS]];
    const all = this.isLog ? Array.from({ length: 12 }, (_, i) => i - 8).flatMap((e) =>
      LOG_TICKS.map((m) => m * 10 ** e)).filter((v) => v >= lo && v <= hi) : ticks(lo, hi, 6);
    context.fillStyle = color('--muted');
    context.textAlign = 'center';
    let last = -Infinity;
    for (const value of all) {
      const x = this.#x(value, width);
      if (x - last < 44) continue;
      last = x;
      context.fillRect(x, bottom, 1, 5);
      context.fillText(String(Number(value.toPrecision(3))), x, bottom + 13);
    }
    context.textAlign = 'left';
    if (!this.measure) context.fillText('◂ better', this.left, bottom + 27);
    context.textAlign = 'right';
    context.fillText(`${this.measure || 'score'}${this.isLog ? ', logarithmic' : ''}`,
      width - RIGHT_PX, bottom + 27);
  }

  #drawMarks(context, width, color) {
    const dot = (value, row, fillStyle, radius) => {
      if (value === null) return;
      context.beginPath();
      context.arc(this.#x(value, width), this.#y(row) + ROW_PX / 2, radius, 0, 2 * Math.PI);
      context.fillStyle = fillStyle;
      context.fill();
      context.lineWidth = 2;
      context.strokeStyle = color('--panel');
      context.stroke();
    };
    this.page.about.sizes.forEach(({ best }, row) => dot(this.#of(best), row, color('--green'),
      4.5));
    if (this.body) dot(this.#of(this.body), this.body.voxels - 1, color('--mark'), 7);
  }

  // ---- selecting ----

  #at({ offsetX, offsetY }) {
    const width = this.canvas.clientWidth - this.left - RIGHT_PX;
    const bin = Math.floor((offsetX - this.left) / width * BINS);
    const row = this.rows - 1 - Math.floor((offsetY - TOP_PX) / ROW_PX);
    return { bin: Math.min(BINS - 1, Math.max(0, bin)),
      row: Math.min(this.rows - 1, Math.max(0, row)) };
  }

  #down(event) {
    if (event.button !== 0 || !this.counts) return;
    const { bin, row } = this.#at(event);
    this.isHeld = true;
    this.canvas.setPointerCapture(event.pointerId);
    this.anchor = this.#nearest(row, bin);
    this.select(row, this.anchor, this.anchor);
  }

  #move(event) {
    if (!this.isHeld) return;
    const { bin } = this.#at(event);
    this.select(this.selected.row, this.anchor, bin);
  }

  /** Returns the bin that a click selects: the nearest one with bodies, because a single bin is
   * narrow. */
  #nearest(row, bin) {
    const counts = this.counts[row];
    for (let away = 0; away <= 3; away++) {
      for (const at of [bin - away, bin + away]) if (counts[at]) return at;
    }
    return bin;
  }

  #key(event) {
    const step = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [1, 0], ArrowDown: [-1, 0] }[
      event.key];
    if (!step || !this.counts) return;
    event.preventDefault();
    const row = this.selected?.row ?? (this.body?.voxels ?? 1) - 1;
    let bin = this.last ?? this.counts[row].findIndex(Boolean);
    const next = Math.min(this.rows - 1, Math.max(0, row + step[0]));
    if (step[1] && this.selected) {
      // With Shift, move by one bin; without it, to the next bin that has bodies.
      let to = bin + step[1];
      while (!event.shiftKey && to >= 0 && to < BINS && !this.counts[row][to]) to += step[1];
      if (to >= 0 && to < BINS) bin = to;
    } else if (!event.shiftKey) {
      bin = this.#nearest(next, bin);
      if (!this.counts[next][bin]) bin = this.counts[next].findIndex(Boolean);
    }
    this.anchor = event.shiftKey ? this.anchor ?? bin : bin;
    this.select(next, this.anchor, bin);
  }

  /** Selects the bins from one to another of a row, and shows their bodies. */
  async select(row, anchor, last) {
    const [from, to] = [Math.min(anchor, last), Math.max(anchor, last)];
    const { selected: before } = this;
    this.last = last;
    if (before?.row === row && before.from === from && before.to === to) return;
    this.selected = { row, from, to };
    this.#draw();
    const turn = ++this.turn;
    const [lo, hi] = [this.edges[from], this.edges[to + 1]];
    try {
      const { measure } = this;
      const { items, bodies } = await this.page.atlas.best({ voxels: row + 1, lo, hi,
        measure: measure || undefined, limit: SHOWN });
      if (turn !== this.turn) return;
      const shown = measure ? (value) => number(value, 4) : score;
      say(this.words, `${countOf(bodies, 'body', 'bodies')} of ${voxels(row + 1)} with ` +
        `${measure || 'scores'} from ${shown(lo)} to ${shown(hi)}${bodies > SHOWN
          ? `: the ${measure ? 'highest' : 'best'} ${count(SHOWN)}` : ''}`);
      patch(this.list, items.map((one, i) => ({ one, i })), ({ i }) => i,
        ({ one }) => this.page.card(one), (card, { one }) => this.page.fillCard(card, one));
    } catch (error) {
      if (turn === this.turn) fill(this.words, h('span.error', {}, error.message));
    }
  }

  destroy() {
    this.turn++;
    this.loads++;
    this.resize.disconnect();
    this.page.app.themeListeners.delete(this.onTheme);
  }
}
