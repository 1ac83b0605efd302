/**
 * Charts of growing curves: bands, lines and points on a canvas, with axes, a cursor that shows the
 * values, and a text for screen readers. 100,000 points with a band are drawn at once: all points
 * in one column of pixels are drawn as their range.
 */

import { h, paint, swatch } from './dom.js';
import { number } from './format.js';

/**
 * @typedef {Object} Series
 * @property {string} name
 * @property {'line'|'band'|'points'} [kind] default: line
 * @property {ArrayLike<number>} x ascending
 * @property {ArrayLike<number>} y NaN if there is no value
 * @property {ArrayLike<number>} [low] for a band
 * @property {ArrayLike<number>} [high] for a band
 * @property {string} color name of a custom property of CSS, or a color
 * @property {number[]} [dash]
 * @property {number} [opacity]
 * @property {boolean} [silent] not in the legend, not under the cursor
 */

const MARGIN = { left: 58, right: 12, top: 10, bottom: 26 };
const LINE_PX = 1.8;
/** Radius of an isolated value. */
const POINT_PX = 3;
/** A line with more points per pixel than this is drawn as the range of each column of pixels. */
const DENSE = 2;

/** Returns round steps of an axis: about `n` of them between two values. */
export function ticks(from, to, n) {
  const span = to - from;
  if (!(span > 0)) return [from];
  const raw = span / n;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= raw);
  const all = [];
  for (let i = Math.ceil(from / step - 1e-9); i * step <= to + step * 1e-9; i++) {
    all.push(i * step + 0); // not -0
  }
  return all;
}

function logTicks(from, to) {
  const all = [];
  for (let e = Math.floor(Math.log10(from)); e <= Math.ceil(Math.log10(to)); e++) {
    for (const m of to / from > 200 ? [1] : [1, 2, 5]) {
      const tick = m * 10 ** e;
      if (tick >= from * 0.999 && tick <= to * 1.001) all.push(tick);
    }
  }
  return all.length >= 2 ? all : ticks(from, to, 4);
}

/** Returns rows as a list of numbers, with NaN where there is no value. */
export const column = (rows, take) => Float64Array.from(rows, (row) => take(row) ?? NaN);

/** Returns the index of the last value of an ascending list that is at most `value`, or -1. */
export function lastAtMost(list, value) {
  let low = 0;
  let high = list.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (list[middle] <= value) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}

export class Chart {
  /**
   * @param {{title: string, unit?: string, xName?: string, log?: boolean, height?: number,
   *          minimum?: number, maximum?: number, empty?: string, note?: string, isWhole?: boolean,
   *          xRange?: [number, number], xText?: function(number): string,
   *          yText?: function(number): string}} options isWhole: false if the axis has values
   *          between whole numbers; xRange: fixes the axis, whatever the values
   */
  constructor(options) {
    this.options = { xName: 'generation', height: 220, empty: 'No values yet.',
      xText: (x) => number(x, 6), yText: number, ...options };
    const { note } = this.options;
    /** @type {Series[]} */
    this.series = [];
    this.range = null;
    this.cursor = -1;
    this.canvas = h('canvas', {
      tabindex: 0, role: 'img', 'aria-label': `${options.title}: no values yet`,
    });
    this.canvas.style.minHeight = `${this.options.height}px`;
    this.readout = h('div.readout', { 'aria-live': 'polite' });
    this.legend = h('div.legend');
    this.element = h('figure.panel.chart', {},
      h('figcaption', {}, h('h3', {}, options.title), note ? h('span.muted', {}, note) : null,
        this.legend), this.canvas, this.readout);
    this.canvas.addEventListener('pointermove', (event) => this.#point(event.offsetX));
    this.canvas.addEventListener('pointerleave', () => this.#moveCursor(-1));
    this.canvas.addEventListener('keydown', (event) => this.#key(event));
    this.observer = new ResizeObserver(() => this.draw());
    this.observer.observe(this.canvas);
  }

  /** Sets what to draw. @param {Series[]} series */
  set(series) {
    this.series = series;
    this.range = this.#range();
    this.readout.dataset.axis = this.range ? this.options.xName : '';
    this.legend.replaceChildren(...series.filter((s) => !s.silent).map((s) => {
      const sample = swatch(s.color,
        s.kind === 'band' ? '' : `.line${s.dash?.length ? '.dashed' : ''}`);
      sample.style.opacity = String(s.opacity ?? 1);
      return h('span', {}, sample, s.name);
    }));
    this.canvas.setAttribute('aria-label', this.#summary());
    this.draw();
  }

  destroy() {
    this.observer.disconnect();
  }

  #summary() {
    const { title, xName } = this.options;
    const shown = this.series.filter((s) => !s.silent && s.kind !== 'band' && s.x.length);
    const parts = shown.map((s) => {
      const last = s.x.length - 1;
      return `${s.name} from ${number(s.y[0])} at ${xName} ${number(s.x[0])} ` +
        `to ${number(s.y[last])} at ${xName} ${number(s.x[last])}`;
    });
    return this.range && parts.length ? `${title}: ${parts.join('; ')}`
      : `${title}: ${this.options.empty}`;
  }

  #range() {
    let [x0, x1, y0, y1] = [Infinity, -Infinity, Infinity, -Infinity];
    const least = this.options.log ? 0 : -Infinity;
    for (const s of this.series) {
      const n = s.x.length;
      if (!n) continue;
      x0 = Math.min(x0, s.x[0]);
      x1 = Math.max(x1, s.x[n - 1]);
      for (const list of s.kind === 'band' ? [s.low, s.high] : [s.y]) {
        for (let i = 0; i < n; i++) {
          const value = list[i];
          if (!Number.isFinite(value) || value <= least) continue;
          if (value < y0) y0 = value;
          if (value > y1) y1 = value;
        }
      }
    }
    if (!Number.isFinite(x0) || !Number.isFinite(y0)) return null;
    if (this.options.xRange) [x0, x1] = this.options.xRange;
    else if (x1 === x0) x1 = x0 + 1;
    if (this.options.log) {
      if (y1 / y0 < 1.2) [y0, y1] = [y0 / 1.2, y1 * 1.2];
      return { x0, x1, y0: y0 * 0.94, y1: y1 * 1.06 };
    }
    y0 = Math.min(y0, this.options.minimum ?? y0);
    y1 = Math.max(y1, this.options.maximum ?? y1);
    const room = (y1 - y0 || Math.abs(y1) || 1) * 0.05;
    return { x0, x1, y0: y0 === 0 ? 0 : y0 - room, y1: y1 + room };
  }

  /** Draws the chart at the current size of its canvas. */
  draw() {
    const painting = paint(this.canvas);
    if (!painting) return;
    const { context, width, height, color } = painting;
    const { range } = this;
    if (!range) {
      context.fillStyle = color('--muted');
      context.fillText(this.options.empty, MARGIN.left, height / 2);
      this.scale = null;
      return;
    }
    const scale = this.#scale(range, width, height);
    this.scale = scale;
    this.#axes(context, scale, width, height, color);
    context.save();
    context.beginPath();
    // A single value at the edge is drawn as a whole point.
    context.rect(MARGIN.left - POINT_PX, 0, width - MARGIN.left - MARGIN.right + 2 * POINT_PX + 1,
      height - MARGIN.bottom + POINT_PX);
    context.clip();
    for (const s of this.series) {
      context.globalAlpha = s.opacity ?? 1;
      if (s.kind === 'band') this.#band(context, s, scale, color(s.color));
      else if (s.kind === 'points') this.#points(context, s, scale, color(s.color));
      else this.#line(context, s, scale, color(s.color));
    }
    context.globalAlpha = 1;
    context.restore();
    if (this.cursor >= 0) this.#drawCursor(context, scale, height, color);
  }

  #scale({ x0, x1, y0, y1 }, width, height) {
    const [left, right] = [MARGIN.left, width - MARGIN.right];
    const [top, bottom] = [MARGIN.top, height - MARGIN.bottom];
    const toY = this.options.log ? Math.log : (y) => y;
    const [low, high] = [toY(y0), toY(y1)];
    return {
      x0, x1, y0, y1,
      x: (x) => left + ((x - x0) / (x1 - x0)) * (right - left),
      y: (y) => bottom - ((toY(y) - low) / (high - low)) * (bottom - top),
      back: (px) => x0 + ((px - left) / (right - left)) * (x1 - x0),
    };
  }

  #axes(context, scale, width, height, color) {
    const { log, isWhole = true, xText, yText } = this.options;
    context.strokeStyle = color('--grid');
    context.fillStyle = color('--muted');
    context.lineWidth = 1;
    context.textAlign = 'right';
    context.textBaseline = 'middle';
    for (const tick of log ? logTicks(scale.y0, scale.y1) : ticks(scale.y0, scale.y1, 4)) {
      const y = Math.round(scale.y(tick)) + 0.5;
      context.beginPath();
      context.moveTo(MARGIN.left, y);
      context.lineTo(width - MARGIN.right, y);
      context.stroke();
      context.fillText(yText(tick), MARGIN.left - 8, y);
    }
    context.textBaseline = 'top';
    const steps = ticks(scale.x0, scale.x1, Math.max(2, Math.floor(width / 110)))
      .filter((tick) => !isWhole || Number.isInteger(tick));
    for (const tick of steps) {
      const x = scale.x(tick);
      context.textAlign = x > width - 30 ? 'right' : 'center';
      context.fillText(xText(tick), x, height - MARGIN.bottom + 8);
    }
  }

  #line(context, s, scale, color) {
    context.strokeStyle = color;
    context.lineWidth = LINE_PX;
    context.lineJoin = 'round';
    context.beginPath();
    if (s.x.length > DENSE * context.canvas.width) {
      // Going up and down in every column would take most of the drawing time.
      context.fillStyle = color;
      this.#envelope(context, s.x, s.y, s.y, scale);
      context.fill();
    } else {
      let open = false;
      for (let i = 0; i < s.x.length; i++) {
        const isValue = Number.isFinite(s.y[i]);
        if (isValue && open) context.lineTo(scale.x(s.x[i]), scale.y(s.y[i]));
        else if (isValue) context.moveTo(scale.x(s.x[i]), scale.y(s.y[i]));
        open = isValue;
      }
      context.setLineDash(s.dash ?? []);
    }
    context.stroke();
    context.setLineDash([]);
    if (s.x.length === 1) {
      context.fillStyle = color;
      context.beginPath();
      context.arc(scale.x(s.x[0]), scale.y(s.y[0]), POINT_PX, 0, 7);
      context.fill();
    }
  }

  #band(context, s, scale, color) {
    context.fillStyle = color;
    context.beginPath();
    this.#envelope(context, s.x, s.low, s.high, scale);
    context.fill();
  }

  /**
   * Adds the area between two curves to the path. Each column of pixels has its lowest and highest
   * value, so that no peak is lost; where a value is missing there is a gap.
   */
  #envelope(context, x, low, high, scale) {
    /** @type {number[][]} x, low, high of each column in a row */
    const parts = [];
    let part = null;
    let column = NaN;
    const ratio = devicePixelRatio;
    for (let i = 0; i < x.length; i++) {
      if (!Number.isFinite(low[i]) || !Number.isFinite(high[i])) {
        part = null;
        continue;
      }
      if (!part) {
        parts.push(part = []);
        column = NaN;
      }
      const at = scale.x(x[i]);
      const here = Math.floor(at * ratio);
      if (here !== column) {
        part.push(at, low[i], high[i]);
        column = here;
      } else {
        const end = part.length;
        if (low[i] < part[end - 2]) part[end - 2] = low[i];
        if (high[i] > part[end - 1]) part[end - 1] = high[i];
      }
    }
    for (const one of parts) {
      for (let i = 0; i < one.length; i += 3) {
        if (i) context.lineTo(one[i], scale.y(one[i + 2]));
        else context.moveTo(one[i], scale.y(one[i + 2]));
      }
      for (let i = one.length - 3; i >= 0; i -= 3) context.lineTo(one[i], scale.y(one[i + 1]));
      context.closePath();
    }
  }

  #points(context, s, scale, color) {
    context.fillStyle = color;
    const size = s.x.length > 2000 ? 2 : 4;
    for (let i = 0; i < s.x.length; i++) {
      context.fillRect(scale.x(s.x[i]) - size / 2, scale.y(s.y[i]) - size / 2, size, size);
    }
  }

  #drawCursor(context, scale, height, color) {
    const main = this.series.find((s) => !s.silent && s.x.length);
    if (!main || this.cursor >= main.x.length) return;
    const x = Math.round(scale.x(main.x[this.cursor])) + 0.5;
    context.strokeStyle = color('--muted');
    context.setLineDash([3, 3]);
    context.beginPath();
    context.moveTo(x, MARGIN.top);
    context.lineTo(x, height - MARGIN.bottom);
    context.stroke();
    context.setLineDash([]);
  }

  #point(px) {
    if (!this.scale) return;
    const main = this.series.find((s) => !s.silent && s.x.length);
    if (!main) return;
    const value = this.scale.back(px);
    let i = Math.max(0, lastAtMost(main.x, value));
    if (i + 1 < main.x.length && main.x[i + 1] - value < value - main.x[i]) i++;
    this.#moveCursor(i);
  }

  #key(event) {
    const main = this.series.find((s) => !s.silent && s.x.length);
    if (!main) return;
    const last = main.x.length - 1;
    const from = this.cursor < 0 ? last : this.cursor;
    const to = {
      ArrowLeft: from - 1, ArrowRight: from + 1, Home: 0, End: last,
      PageUp: from - 10, PageDown: from + 10, Escape: -1,
    }[event.key];
    if (to === undefined) return;
    event.preventDefault();
    this.#moveCursor(event.key === 'Escape' ? -1 : Math.min(last, Math.max(0, to)));
  }

  #moveCursor(i) {
    if (i === this.cursor) return;
    this.cursor = i;
    const main = this.series.find((s) => !s.silent && s.x.length);
    if (i < 0 || !main) {
      this.readout.textContent = '';
    } else {
      const x = main.x[i];
      const values = this.series.filter((s) => !s.silent).map((s) => {
        const at = lastAtMost(s.x, x);
        if (at < 0 || s.x[at] !== x) return null;
        const text = s.kind === 'band' ? `${number(s.low[at])} to ${number(s.high[at])}`
          : number(s.y[at]);
        return `${s.name} ${text}`;
      });
      this.readout.textContent =
        `${this.options.xName} ${this.options.xText(x)}: ${values.filter(Boolean).join(' · ')}`;
    }
    this.draw();
  }
}
