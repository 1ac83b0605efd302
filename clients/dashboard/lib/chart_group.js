/** State that the charts of a page share: the range of x, the cursor, and what the link records. */

import { LinkError } from './api.js';
import { h, select } from './dom.js';
import { number } from './format.js';

const listIn = (parameters, name, mark) => (parameters.get(name) ?? '').split(mark).filter(Boolean);

export class ChartGroup {
  /**
   * @param {URLSearchParams} [parameters] of the link: zoom=FROM..TO, log and linear=CHART,…,
   *   hide=CHART.SERIES|…
   * @param {function(Object<string, string|null>): void} [keep] keeps them in the link
   */
  constructor(parameters = new URLSearchParams(), keep = () => {}) {
    this.keep = keep;
    /** @type {Set<import('./chart.js').Chart>} */
    this.charts = new Set();
    /** @type {number|null} */
    this.cursor = null;
    /** @type {number[]|null} the range of x; null: all */
    this.zoom = null;
    const zoom = parameters.get('zoom');
    if (zoom !== null) {
      this.zoom = zoom.split('..').map(Number);
      const [from, to] = this.zoom;
      if (this.zoom.length !== 2 || !/^[^.].*[^.]$/.test(zoom) || !(to - from < Infinity) ||
        from >= to) {
        throw new LinkError(`zoom=${zoom} is invalid; use a range such as 10..40.`);
      }
    }
    /** Whether y is logarithmic, by the keys of the charts whose usual scale was changed. */
    this.scales = new Map([...listIn(parameters, 'log', ',').map((key) => [key, true]),
      ...listIn(parameters, 'linear', ',').map((key) => [key, false])]);
    this.hidden = new Set(listIn(parameters, 'hide', '|'));
  }

  /** Rejects a link that names a chart that is not on the page. */
  check() {
    const keys = [...this.charts].map(({ options: { key } }) => key);
    const wrong = [...this.scales.keys(), ...[...this.hidden].map((one) => one.split('.')[0])]
      .find((key) => !keys.includes(key));
    if (wrong === undefined) return;
    throw new LinkError(`No chart is named ${wrong}; the charts are ${keys.join(', ')}.`);
  }

  /** Shows a range of x in all charts; null: all of it. */
  zoomTo(range) {
    const rounded = range?.map((x) => Number(x.toPrecision(6))) ?? null;
    if (rounded && !(rounded[1] > rounded[0])) return; // a link could not express it
    this.zoom = rounded;
    this.#changed();
  }

  setLog(key, isLog) {
    this.scales.set(key, isLog);
    this.#changed();
  }

  /** Returns the names of the hidden series of a chart. */
  hiddenIn(key) {
    return [...this.hidden].filter((one) => one.split('.')[0] === key)
      .map((one) => one.slice(key.length + 1));
  }

  /** Shows or hides a series. @param {string} name CHART.SERIES */
  show(name, isShown) {
    if (isShown) this.hidden.delete(name);
    else this.hidden.add(name);
    this.#changed();
  }

  #changed() {
    const keys = (isLog) => [...this.scales].filter(([, one]) => one === isLog)
      .map(([key]) => key).join(',');
    this.keep({ zoom: this.zoom && this.zoom.join('..'), log: keys(true), linear: keys(false),
      hide: [...this.hidden].join('|') });
    this.charts.forEach((chart) => chart.update());
  }

  /** Moves the cursor of all charts to x; null: away. @param {any} from the chart in use */
  point(x, from) {
    if (x === this.cursor) return;
    this.cursor = x;
    this.charts.forEach((chart) => chart.showCursor(chart === from));
  }
}

/** Returns the cumulative sums of the rows. */
export function sums(rows, take) {
  let sum = 0;
  return Float64Array.from(rows, (row) => { sum += take(row) ?? 0; return sum; });
}

/** Returns the options of charts for an axis. whole: the axis that has only whole numbers. */
export const axisOptions = (axis, whole, time) => ({
  xName: axis === 'time' ? time.name : axis, isWhole: axis === whole,
  xText: (x) => number(x, axis === 'time' ? 4 : 6),
});

/** Returns the unit of an axis that ends after some seconds: its name, and its seconds. */
export function timeUnit(seconds) {
  if (seconds < 120) return { name: 'seconds', unitS: 1 };
  return seconds < 7200 ? { name: 'minutes', unitS: 60 } : { name: 'hours', unitS: 3600 };
}

/** Returns the row above the charts of a page: the choice of what x is, and how to zoom. */
export function axisRow(axes, axis, chosen) {
  const choice = axes.length > 1 ? select('Horizontal axis', axes, axis, chosen) : null;
  choice?.classList.add('inline');
  return h('div.row', {}, choice,
    h('span.muted', {}, 'Drag along a chart to zoom; double-click to see all.'));
}

/** Returns the choice of a link among the quantities that x may be. @param {string[]} axes */
export function axisIn(parameters, axes) {
  const axis = parameters.get('x') ?? axes[0];
  if (axes.includes(axis)) return axis;
  throw new LinkError(`x=${axis} is invalid; use one of ${axes.join(', ')}.`);
}
