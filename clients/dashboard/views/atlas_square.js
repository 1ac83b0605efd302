/** A map of two numbers of bodies, as a square: how many bodies have which pair. With `pick`, a
 * drag, a click or the arrow keys select a range of both. */

import { h, paint } from '../lib/dom.js';
import { ticks } from '../lib/chart.js';

const LEFT_PX = 56;
const BOTTOM_PX = 40;
const MARGIN_PX = 10;
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

export class AtlasSquare {
  /**
   * @param {any} app
   * @param {(range: number[][]) => void} [pick] gets [[first, end], [first, end]] of the values
   */
  constructor(app, pick = undefined) {
    this.app = app;
    this.pick = pick;
    /** Edges of the bins, counts [i of a][i of b], and what the axes show. @type {any} */
    this.map = null;
    /** The pair of the body that is shown. @type {any} */
    this.at = null;
    /** Two corners, in bins: [a, b] each. @type {any} */
    this.picked = null;
    this.canvas = h('canvas.square', pick ? { hidden: true, tabindex: 0, role: 'application',
      'aria-roledescription': 'density map' } : { hidden: true, role: 'img' });
    this.resize = new ResizeObserver(() => this.draw());
    this.resize.observe(this.canvas);
    this.onTheme = () => this.draw();
    app.themeListeners.add(this.onTheme);
    if (!pick) return;
    const listen = (type, listener) => this.canvas.addEventListener(type, listener);
    listen('pointerdown', (event) => {
      if (event.button !== 0 || !this.map) return;
      this.canvas.setPointerCapture(event.pointerId);
      this.isHeld = true;
      this.#select([this.#bins(event), this.#bins(event)]);
    });
    listen('pointermove', (event) => {
      if (this.isHeld) this.#select([this.picked[0], this.#bins(event)]);
    });
    for (const type of ['pointerup', 'pointercancel']) listen(type, () => { this.isHeld = false; });
    listen('keydown', (event) => this.#key(event));
  }

  /** Shows a map; null: none. @param {any} map {a, b, counts, names: [of a, of b]} */
  show(map, label = '') {
    this.map = map;
    this.picked = this.at = null;
    this.canvas.hidden = !map;
    this.canvas.setAttribute('aria-label', label);
    this.draw();
  }

  /** Marks a pair; null: none. */
  mark(pair) {
    this.at = pair;
    this.draw();
  }

  get #frame() {
    return { right: this.canvas.clientWidth - MARGIN_PX,
      bottom: this.canvas.clientHeight - BOTTOM_PX };
  }

  /** Returns the bins of a place. */
  #bins({ clientX, clientY }) {
    const { right, bottom } = this.#frame;
    const { left, top } = this.canvas.getBoundingClientRect();
    const { a, b } = this.map;
    const bin = (share, edges) =>
      Math.min(edges.length - 2, Math.max(0, Math.floor(share * (edges.length - 1))));
    return [bin((clientX - left - LEFT_PX) / (right - LEFT_PX), a),
      bin((bottom - clientY + top) / (bottom - MARGIN_PX), b)];
  }

  #key(event) {
    const step = ARROWS[event.key];
    if (!step || !this.map) return;
    event.preventDefault();
    const { a, b, counts } = this.map;
    const first = counts.findIndex((row) => row.some(Boolean));
    const last = this.picked?.[1] ?? [first, counts[first]?.findIndex(Boolean) ?? 0];
    const ends = [a.length - 2, b.length - 2];
    const next = last.map((bin, i) => Math.min(ends[i], Math.max(0,
      bin + (this.picked ? step[i] : 0))));
    this.#select([event.shiftKey && this.picked ? this.picked[0] : next, next]);
  }

  #select(corners) {
    if (JSON.stringify(corners) === JSON.stringify(this.picked)) return;
    this.picked = corners;
    this.draw();
    const { a, b } = this.map;
    this.pick?.([a, b].map((edges, i) => {
      const [from, to] = [corners[0][i], corners[1][i]].sort((p, q) => p - q);
      return [edges[from], edges[to + 1]];
    }));
  }

  draw() {
    const painted = this.map && paint(this.canvas);
    if (!painted) return;
    const { context, width, height, color } = painted;
    const { a, b, counts, names } = this.map;
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
    const shown = (v) => String(Number(v.toPrecision(2)));
    for (const v of ticks(a[0], a.at(-1), 5)) context.fillText(shown(v), x(v), bottom + 15);
    context.fillText(names[0], (LEFT_PX + right) / 2, height - 6);
    context.textAlign = 'right';
    for (const v of ticks(b[0], b.at(-1), 5)) context.fillText(shown(v), LEFT_PX - 5, y(v) + 4);
    context.save();
    context.translate(13, (MARGIN_PX + bottom) / 2);
    context.rotate(-Math.PI / 2);
    context.textAlign = 'center';
    context.fillText(names[1], 0, 0);
    context.restore();
    context.lineWidth = 2;
    if (this.picked) {
      const [[left, low], [end, high]] = [0, 1].map((k) => [0, 1].map((i) =>
        (k ? Math.max : Math.min)(this.picked[0][i], this.picked[1][i]) + k));
      context.strokeStyle = color('--text');
      context.strokeRect(x(a[left]) - 1, y(b[high]) - 1, x(a[end]) - x(a[left]) + 2,
        y(b[low]) - y(b[high]) + 2);
    }
    if (!this.at || this.at.includes(null)) return;
    context.beginPath();
    context.arc(x(this.at[0]), y(this.at[1]), 7, 0, 2 * Math.PI);
    context.fillStyle = color('--mark');
    context.fill();
    context.strokeStyle = color('--panel');
    context.stroke();
  }

  destroy() {
    this.resize.disconnect();
    this.app.themeListeners.delete(this.onTheme);
  }
}
