/** Dots with whiskers in the cells of a table: all rows share one scale, and one grid. */

import { ticks } from '../lib/chart.js';
import { h, svg } from '../lib/dom.js';
import { number } from '../lib/format.js';

/**
 * The scale of a column.
 * @typedef {{low: number, high: number, ticks: number[], at: function(number): number}} Scale
 *   at: the position of a value, from 0 to 100; values outside the scale are at its end
 */

/** @returns {Scale} */
export const scaleOf = (low, high) => ({
  low, high, ticks: ticks(low, high, 3),
  at: (value) => Math.max(0, Math.min(100, (100 * (value - low)) / (high - low))),
});

/**
 * Returns a scale with all values and most whiskers. Those that are much longer than others end at
 * its edge.
 * @param {{score: number|null, interval: number[]|null}[]} points
 */
export function scaleOfScores(points) {
  const known = points.filter(({ score }) => score !== null);
  const scores = known.map(({ score }) => score);
  const ends = known.flatMap(({ interval }) => interval ?? []);
  const [low, high] = known.length ? [Math.min(...scores), Math.max(...scores)] : [0, 1];
  const halves = known.map(({ interval }) => (interval ? (interval[1] - interval[0]) / 2 : 0))
    .sort((a, b) => a - b);
  const usual = halves[halves.length >> 1] ?? 0;
  const room = Math.max((high - low) / 2, 1.1 * usual) || Math.abs(high) / 4 || 1;
  const edge = 0.04 * (high - low) || room / 4;
  return scaleOf(Math.max(low - room, Math.min(low, ...ends)) - edge,
    Math.min(high + room, Math.max(high, ...ends)) + edge);
}

/** Returns the head of such a column: its name, and the values of its grid. */
export function headOf(scale, name = '') {
  const marks = scale.ticks.map((tick) => {
    const mark = h('span', {}, number(tick));
    mark.style.left = `${scale.at(tick)}%`;
    return mark;
  });
  return h('th.plot', { scope: 'col' }, name, h('div.ticks', { 'aria-hidden': 'true' }, marks));
}

/**
 * Returns a cell with a value and its interval.
 * @param {Scale} scale
 * @param {{score: number|null, interval: number[]|null}} point
 * @param {{base?: number|null, from?: number}} [how] base: a line at this value; from: where a bar
 *   to the value begins
 */
export function plot(scale, { score, interval }, how = {}) {
  const { base = null, from } = how;
  const x = (value) => scale.at(value).toFixed(2);
  const path = (name, d) => svg('path', { class: name, d, 'vector-effect': 'non-scaling-stroke' });
  const isIn = (value) => value >= scale.low && value <= scale.high;
  return h('td.plot', {}, svg('svg', { viewBox: '0 0 100 10', preserveAspectRatio: 'none',
    'aria-hidden': 'true' },
  scale.ticks.map((tick) => path('tick', `M${x(tick)} -1V11`)),
  base === null ? null : path('base', `M${x(base)} -1V11`),
  score !== null && from !== undefined ? path('bar', `M${x(from)} 5H${x(score)}`) : null,
  score !== null && interval ? path('whisker', `M${x(interval[0])} 5H${x(interval[1])}` +
    interval.filter(isIn).map((end) => `M${x(end)} 2.8V7.2`).join('')) : null,
  score === null ? null : path('dot', `M${x(score)} 5h0.001`)));
}
