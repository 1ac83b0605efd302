/**
 * Charts of growing curves: bands, lines and points on a canvas, with axes, a cursor that shows the
 * values, and a text for screen readers. A drag along x, or a key, zooms; the legend shows and
 * hides series. 100,000 points with a band are drawn at once: all points in one column of pixels
 * are drawn as their range.
 */

import { ChartGroup } from './chart_group.js';
import { button, h, paint, patch, say, swatch, toggle } from './dom.js';
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
 * @property {string} [of] hidden together with the series of this name
 */

const MARGIN = { left: 58, right: 12, top: 10, bottom: 26 };
const LINE_PX = 1.8;
/** Radius of an isolated value. */
const POINT_PX = 3;
/** A line with more points per pixel than this is drawn as the range of each column of pixels. */
const DENSE = 2;
/** A shorter drag is a click. */
const DRAG_PX = 8;

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
function lastAtMost(list, value) {
  let low = 0;
  let high = list.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (list[middle] <= value) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}

/** Returns the index of the value of an ascending list that is nearest to `value`. */
function nearest(list, value) {
  const i = Math.max(0, lastAtMost(list, value));
  return i + 1 < list.length && list[i + 1] - value < value - list[i] ? i + 1 : i;
}

export class Chart {
  /**
   * @param {{title: string, unit?: string, xName?: string, log?: boolean, height?: number,
   *          minimum?: number, maximum?: number, empty?: string, note?: string, isWhole?: boolean,
   *          xRange?: [number, number], xText?: function(number): string,
   *          yText?: function(number): string}} options isWhole: false if the axis has values
   *          between whole numbers; xRange: fixes the axis, regardless of the values; log: whether
   *          y is logarithmic by default
   */
  constructor(options) {
    this.options = { key: '', xName: 'generation', height: 220, empty: 'No values yet.',
      xText: (x) => number(x, 6), yText: number, ...options };
    const { note, xRange } = this.options;
    this.join(new ChartGroup());
    /** @type {Series[]} */
    this.series = [];
    this.range = null;
    /** @type {{from: number, to: number}|null} pixels of a drag */
    this.drag = null;
    this.canvas = h('canvas', { tabindex: 0, role: 'img',
      'aria-label': `${options.title}: no values yet`, 'aria-keyshortcuts': '+ - 0' });
    this.canvas.style.minHeight = `${this.options.height}px`;
    this.readout = h('div.readout');
    this.legend = h('div.legend');
    this.whole = button('Reset zoom', () => this.group.zoomTo(null), { class: 'small', hidden: true,
      title: 'Show all values (double-click the chart, or press 0)' });
    this.logToggle = xRange ? null : toggle('log', false,
      (on) => this.group.setLog(this.options.key, on),
      { class: 'small', 'aria-label': `Logarithmic axis: ${options.title}` });
    this.element = h('figure.panel.chart', {},
      h('figcaption', {}, h('h3', {}, options.title), note ? h('span.muted', {}, note) : null,
        this.legend, h('span.row', {}, this.whole, this.logToggle)), this.canvas, this.readout);
    /** Explains what is wrong with the link. */
    this.fault = h('p.error', { 'aria-live': 'polite', hidden: true });
    this.element.append(this.fault);
    this.#listen(!xRange);
    this.observer = new ResizeObserver(() => this.draw());
    this.observer.observe(this.canvas);
  }

  #listen(zooms) {
    const { canvas } = this;
    const on = (type, listener) => canvas.addEventListener(type, listener);
    on('pointerdown', (event) => {
      if (event.button !== 0 || !this.scale) return;
      this.#point(event.offsetX);
      if (!zooms) return;
      canvas.setPointerCapture(event.pointerId);
      this.drag = { from: event.offsetX, to: event.offsetX };
    });
    on('pointermove', (event) => {
      this.#point(event.offsetX);
      if (!this.drag) return;
      this.drag.to = event.offsetX;
      this.draw();
    });
    on('pointerup', () => this.#zoomToDrag());
    on('pointercancel', () => {
      this.drag = null;
      this.draw();
    });
    // Keep the cursor when a finger lifts.
    on('pointerleave', ({ pointerType }) => {
      if (pointerType !== 'touch') this.group.point(null, this);
    });
    on('dblclick', () => this.group.zoomTo(null));
    on('focus', () => {
      const main = this.#main();
      if (!main || !canvas.matches(':focus-visible')) return;
      this.group.point(this.group.cursor ?? main.x[main.x.length - 1], this);
    });
    on('blur', () => this.group.point(null, this));
    on('keydown', (event) => this.#key(event, zooms));
  }

  #isShown(s) {
    return !this.group.hidden.has(`${this.options.key}.${s.of ?? s.name}`);
  }

  /** Returns the shown series. */
  #shown() {
    return this.series.filter((s) => this.#isShown(s));
  }

  /** Returns the series whose values the cursor moves along. @returns {any} */
  #main() {
    return this.#shown().find((s) => !s.silent && s.x.length);
  }

  /** Shares the zoom and the cursor with the charts of a group. @param {string} key its name in a
   * link */
  join(group, key = '') {
    this.group?.charts.delete(this);
    this.group = group;
    this.options.key = key;
    group.charts.add(this);
    return this;
  }

  /** Sets what to draw. @param {Series[]} series */
  set(series) {
    this.series = series;
    this.update();
  }

  /** Shows the state of the group. */
  update() {
    const { group, options: { key, log = false, xName } } = this;
    const known = this.series.filter((s) => !s.silent);
    const [, , least] = this.#extent(-Infinity, Infinity);
    this.isLog = (group.scales.get(key) ?? log) && !(least <= 0);
    if (this.logToggle) {
      this.logToggle.disabled = least <= 0;
      this.logToggle.title = least <= 0 ? 'A logarithmic axis needs values above 0'
        : 'Logarithmic axis';
      this.logToggle.setAttribute('aria-pressed', String(this.isLog));
    }
    this.range = this.#range();
    this.readout.dataset.axis = this.range ? xName : '';
    this.whole.hidden = !group.zoom;
    patch(this.legend, known, (s) => `${known.length > 1} ${s.name}`, (s) => {
      const sample = swatch(s.color,
        s.kind === 'band' ? '' : `.line${s.dash?.length ? '.dashed' : ''}`);
      sample.style.opacity = String(s.opacity ?? 1);
      const one = known.length > 1 ? toggle('', true, (on) => group.show(`${key}.${s.name}`, on),
        { title: 'Show or hide' }) : h('span');
      one.append(sample, s.name);
      return one;
    }, (element, s) => {
      if (known.length > 1) element.setAttribute('aria-pressed', String(this.#isShown(s)));
    });
    this.canvas.setAttribute('aria-label', this.#summary());
    this.#checkHidden();
    this.showCursor(false);
  }

  /** Reports which hidden series the chart does not have. */
  #checkHidden() {
    const names = [...new Set(this.series.map((s) => s.of ?? s.name))];
    const unknown = names.length
      ? this.group.hiddenIn(this.options.key).filter((name) => !names.includes(name)) : [];
    const { key } = this.options;
    const wrong = unknown.map((name) => [key, name].filter(Boolean).join('.')).join('|');
    this.fault.hidden = !wrong;
    say(this.fault, wrong && `hide=${wrong}: no series has this name; the series are ${
      names.join(', ')}.`);
  }

  destroy() {
    this.group.charts.delete(this);
    this.observer.disconnect();
  }

  /** Explains why there is no value. */
  #nothing() {
    const { empty } = this.options;
    if (!this.series.some((s) => s.x.length)) return empty;
    if (!this.#main()) return 'All series are hidden.';
    return this.group.zoom ? 'No value in this range.' : empty;
  }

  #summary() {
    const { xName, xText } = this.options;
    const title = this.options.title + (this.group.zoom
      ? `, ${xName} ${this.group.zoom.map(xText).join(' to ')}` : '');
    const shown = this.#shown().filter((s) => !s.silent && s.kind !== 'band' && s.x.length);
    const parts = shown.map((s) => {
      const last = s.x.length - 1;
      return `${s.name} from ${number(s.y[0])} at ${xName} ${number(s.x[0])} ` +
        `to ${number(s.y[last])} at ${xName} ${number(s.x[last])}`;
    });
    return this.range && parts.length ? `${title}: ${parts.join('; ')}`
      : `${title}: ${this.#nothing()}`;
  }

  /** Returns the range of x and y of the shown values from one x to another. */
  #extent(from, to) {
    let [x0, x1, y0, y1] = [Infinity, -Infinity, Infinity, -Infinity];
    for (const s of this.#shown()) {
      if (!s.x.length) continue;
      x0 = Math.min(x0, s.x[0]);
      x1 = Math.max(x1, s.x[s.x.length - 1]);
      for (const list of s.kind === 'band' ? [s.low, s.high] : [s.y]) {
        for (let i = Math.max(0, lastAtMost(s.x, from)); i < s.x.length && s.x[i] <= to; i++) {
          const value = list[i];
          if (!Number.isFinite(value) || s.x[i] < from) continue;
          if (value < y0) y0 = value;
          if (value > y1) y1 = value;
        }
      }
    }
    return [x0, x1, y0, y1];
  }

  #range() {
    const { zoom } = this.group;
    let [x0, x1, y0, y1] = this.#extent(...(zoom ?? [-Infinity, Infinity]));
    if (!Number.isFinite(x0) || !Number.isFinite(y0)) return null;
    if (this.options.xRange ?? zoom) [x0, x1] = this.options.xRange ?? zoom;
    else if (x1 === x0) x1 = x0 + 1;
    if (this.isLog) {
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
      context.fillText(this.#nothing(), MARGIN.left, height / 2);
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
    for (const s of this.#shown()) {
      context.globalAlpha = s.opacity ?? 1;
      if (s.kind === 'band') this.#band(context, s, scale, color(s.color));
      else if (s.kind === 'points') this.#points(context, s, scale, color(s.color));
      else this.#line(context, s, scale, color(s.color));
    }
    context.globalAlpha = 1;
    context.restore();
    if (this.group.cursor !== null) this.#drawCursor(context, scale, height, color);
    if (!this.drag) return;
    const { from, to } = this.drag;
    context.globalAlpha = 0.2;
    context.fillStyle = color('--text');
    context.fillRect(from, MARGIN.top, to - from, height - MARGIN.top - MARGIN.bottom);
    context.globalAlpha = 1;
  }

  /** Returns the first and the last value of a series to draw: those in view and their
   * neighbors. */
  #inView({ x }, { x0, x1 }) {
    return [Math.max(0, lastAtMost(x, x0)), Math.min(x.length - 1, lastAtMost(x, x1) + 1)];
  }

  #scale({ x0, x1, y0, y1 }, width, height) {
    const [left, right] = [MARGIN.left, width - MARGIN.right];
    const [top, bottom] = [MARGIN.top, height - MARGIN.bottom];
    const toY = this.isLog ? Math.log : (y) => y;
    const [low, high] = [toY(y0), toY(y1)];
    return {
      x0, x1, y0, y1,
      x: (x) => left + ((x - x0) / (x1 - x0)) * (right - left),
      y: (y) => bottom - ((toY(y) - low) / (high - low)) * (bottom - top),
      back: (px) => x0 + ((px - left) / (right - left)) * (x1 - x0),
    };
  }

  #axes(context, scale, width, height, color) {
    const { isWhole = true, xText, yText } = this.options;
    context.strokeStyle = color('--grid');
    context.fillStyle = color('--muted');
    context.lineWidth = 1;
    context.textAlign = 'right';
    context.textBaseline = 'middle';
    for (const tick of this.isLog ? logTicks(scale.y0, scale.y1) : ticks(scale.y0, scale.y1, 4)) {
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
    const [first, last] = this.#inView(s, scale);
    if (last - first > DENSE * context.canvas.width) {
      // Drawing a line up and down in every column would take most of the time.
      context.fillStyle = color;
      this.#envelope(context, s, s.y, s.y, scale);
      context.fill();
    } else {
      let open = false;
      for (let i = first; i <= last; i++) {
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
    this.#envelope(context, s, s.low, s.high, scale);
    context.fill();
  }

  /**
   * Adds the area between two curves to the path. Each column of pixels has its lowest and highest
   * value, so that no peak is lost; where a value is missing there is a gap.
   */
  #envelope(context, { x }, low, high, scale) {
    /** @type {number[][]} x, low, high of each column in a row */
    const parts = [];
    let part = null;
    let column = NaN;
    const ratio = devicePixelRatio;
    const [first, last] = this.#inView({ x }, scale);
    for (let i = first; i <= last; i++) {
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
    const { cursor } = this.group;
    if (cursor < scale.x0 || cursor > scale.x1) return;
    const x = Math.round(scale.x(cursor)) + 0.5;
    context.strokeStyle = color('--muted');
    context.setLineDash([3, 3]);
    context.beginPath();
    context.moveTo(x, MARGIN.top);
    context.lineTo(x, height - MARGIN.bottom);
    context.stroke();
    context.setLineDash([]);
  }

  #point(px) {
    const main = this.#main();
    if (!this.scale || !main) return;
    const { x0, x1, back } = this.scale;
    const x = main.x[nearest(main.x, Math.min(x1, Math.max(x0, back(px))))];
    if (x >= x0 && x <= x1) this.group.point(x, this);
  }

  #zoomToDrag() {
    if (!this.drag || !this.scale) return;
    const { from, to } = this.drag;
    this.drag = null;
    const { x0, x1, back } = this.scale;
    const ends = [from, to].sort((a, b) => a - b).map((px) => Math.min(x1, Math.max(x0, back(px))));
    if (Math.abs(to - from) >= DRAG_PX && ends[1] > ends[0]) this.#zoomTo(ends);
    else this.draw();
  }

  /** Zooms to a range of x; where x is whole, it has at least two values. */
  #zoomTo(ends) {
    const [from, to] = ends;
    const { isWhole = true } = this.options;
    const [first, last] = isWhole ? [Math.floor(from + 0.25), Math.ceil(to - 0.25)] : [from, to];
    this.group.zoomTo([first, Math.max(last, isWhole ? first + 1 : last)]);
  }

  #key(event, zooms) {
    const main = this.#main();
    const { group, range } = this;
    if (!main || event.ctrlKey || event.metaKey || event.altKey) return;
    const last = main.x.length - 1;
    const from = group.cursor === null ? last : nearest(main.x, group.cursor);
    const to = {
      ArrowLeft: from - 1, ArrowRight: from + 1, Home: 0, End: last,
      PageUp: from - 10, PageDown: from + 10,
    }[event.key];
    const factor = { '+': 0.5, '=': 0.5, '-': 2 }[event.key];
    if (to !== undefined) {
      const x = main.x[Math.min(last, Math.max(0, to))];
      // The view moves with the cursor.
      const off = Math.min(0, x - (group.zoom?.[0] ?? x)) + Math.max(0, x - (group.zoom?.[1] ?? x));
      if (off) group.zoomTo(group.zoom.map((end) => end + off));
      group.point(x, this);
    } else if (event.key === 'Escape') {
      group.point(null, this);
    } else if (zooms && event.key === '0') {
      group.zoomTo(null);
    } else if (zooms && factor && range) {
      const [x0, x1] = this.#extent(-Infinity, Infinity);
      const at = group.cursor ?? (range.x0 + range.x1) / 2;
      const ends = [Math.max(x0, at - (at - range.x0) * factor),
        Math.min(x1, at + (range.x1 - at) * factor)];
      if (ends[0] <= x0 && ends[1] >= x1) group.zoomTo(null);
      else if (ends[1] > ends[0]) this.#zoomTo(ends);
    } else {
      return;
    }
    event.preventDefault();
  }

  /** Shows the values at the cursor of the group. isOwn: this chart has the pointer or focus. */
  showCursor(isOwn) {
    const { xName, xText, yText } = this.options;
    const { cursor } = this.group;
    const main = this.#main();
    const text = (value) => (Number.isFinite(value) ? yText(value) : '–');
    this.readout.setAttribute('aria-live', isOwn ? 'polite' : 'off');
    if (cursor === null || !main) {
      say(this.readout, '');
    } else {
      const x = main.x[nearest(main.x, cursor)];
      const values = this.#shown().filter((s) => !s.silent).map((s) => {
        if (!(s.x[0] <= x && x <= s.x[s.x.length - 1])) return null;
        const i = nearest(s.x, x);
        const value = s.kind === 'band' ? `${text(s.low[i])} to ${text(s.high[i])}` : text(s.y[i]);
        return `${s.name} ${value}${s.x[i] === x ? '' : ` at ${xText(s.x[i])}`}`;
      });
      say(this.readout, `${xName} ${xText(x)}: ${values.filter(Boolean).join(' · ')}`);
    }
    this.draw();
  }
}
