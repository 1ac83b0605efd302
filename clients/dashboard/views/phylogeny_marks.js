/**
 * The overlay of a phylogeny: generations, the selected design and its line of descent.
 */

import { ticks } from '../lib/chart.js';
import { fill, h, paint, swatch } from '../lib/dom.js';
import { count, number } from '../lib/format.js';
import { OPERATOR_HUES } from '../lib/lineage.js';

const FOOT_PX = 22;
const PULSE_MS = 1200;

export class PhylogenyMarks {
  /** @param {import('./phylogeny.js').PhylogenyCanvas} view */
  constructor(view) {
    this.view = view;
    this.selected = -1;
    this.canvas = h('canvas.over', { 'aria-hidden': 'true' });
    this.legend = h('div.legend');
    view.drawn = () => this.draw();
  }

  /** Briefly highlights the selected design. */
  pulse() {
    if (matchMedia('(prefers-reduced-motion: reduce)').matches) return;
    this.pulseStart = performance.now();
    const frame = () => {
      this.draw();
      if (performance.now() - this.pulseStart < PULSE_MS) requestAnimationFrame(frame);
    };
    frame();
  }

  /** Explains the colors. */
  showColors() {
    const { colorBy, scores, ends, columns } = this.view;
    const ramp = (from, to) => [h('span', {}, from), h('i.ramp'), h('span', {}, to)];
    const legends = {
      score: () => [
        ...ramp(`${columns.own_score?.name ?? 'score'} ${number(scores[1])}`,
          `${number(scores[0])}, the best`),
        columns.lower_bound.includes(1)
          ? h('span', {}, 'faint: lower bounds (children that could not survive)') : null],
      age: () => ramp('short life', 'long life'),
      descendants: () => ramp('no descendants', 'most, on a logarithmic scale'),
      operator: () => [...new Set(columns.operator)].sort().map((operator) =>
        h('span', {}, swatch(OPERATOR_HUES[Math.min(operator, OPERATOR_HUES.length - 1)]),
          columns.operators[operator])),
    };
    const other = () => ramp(`${colorBy.replace(/^measures\./, '')} ${number(ends[0])}`,
      number(ends[1]));
    fill(this.legend, (legends[colorBy] ?? other)(),
      h('span', {}, 'bright: ancestors of the living'), h('span', {}, 'across: generations'));
  }

  draw() {
    const { view } = this;
    const painting = view.columns ? paint(this.canvas) : null;
    if (!painting) return;
    const { context, width, height, color } = painting;
    const [from] = view.at(0, 0);
    const [to] = view.at(width, 0);
    context.fillStyle = color('--panel');
    context.globalAlpha = 0.85;
    context.fillRect(0, height - FOOT_PX, width, FOOT_PX);
    context.globalAlpha = 1;
    context.fillStyle = color('--muted');
    context.textAlign = 'center';
    for (const tick of ticks(Math.max(0, from), Math.min(view.last, to),
      Math.max(2, width / 110))) {
      if (!Number.isInteger(tick)) continue;
      const [x] = view.placeOf(tick, 0);
      context.globalAlpha = 0.25;
      context.fillRect(Math.round(x), 0, 1, height - FOOT_PX);
      context.globalAlpha = 1;
      context.fillText(count(tick), Math.min(width - 14, Math.max(14, x)), height - 7);
    }
    if (this.selected >= 0) this.#descent(context, color('--text'));
  }

  /** Draws the selected design and the lives of its first parents, each from its birth to its
   * child's. */
  #descent(context, color) {
    const { columns, layout: { y, parentRow } } = this.view;
    const place = (generation, row) => this.view.placeOf(generation, y[row]);
    context.strokeStyle = color;
    context.fillStyle = color;
    context.lineWidth = 1.6;
    context.lineJoin = 'round';
    context.beginPath();
    context.moveTo(...place(columns.born[this.selected], this.selected));
    for (let row = this.selected; parentRow[row] >= 0; row = parentRow[row]) {
      const parent = parentRow[row];
      context.lineTo(...place(columns.born[row] - 1, parent));
      context.lineTo(...place(columns.born[parent], parent));
    }
    context.stroke();
    context.beginPath();
    const at = place(columns.born[this.selected], this.selected);
    context.arc(...at, 5, 0, 7);
    context.fill();
    const share = (performance.now() - (this.pulseStart ?? -Infinity)) / PULSE_MS;
    if (share >= 1) return;
    context.globalAlpha = 1 - share;
    context.beginPath();
    context.arc(...at, 5 + 40 * share, 0, 7);
    context.stroke();
    context.globalAlpha = 1;
  }
}
