/** The tab Population of a campaign: its designs as points, and those in a brush walk. */

import { listOf } from '../lib/api.js';
import { ticks } from '../lib/chart.js';
import { announce, button, fill, h, paint, select, swatch } from '../lib/dom.js';
import { countOf, number } from '../lib/format.js';
import { CampaignStage } from './champions.js';

const DESIGNS_MAX = 10000;

/** Traits of a design, in addition to the measures of a study: names by key. */
const TRAITS = { score: 'score', voxels: 'voxels', footprint: 'footprint', springs: 'springs',
  born: 'generation of birth' };
const valueOf = (design, key) =>
  (key in TRAITS ? design[key] : design.measures?.[key.slice('measures.'.length)]) ?? null;
const OPERATOR_COLORS = { mutation: '--orange', crossover: '--blue', random: '--gray',
  listed: '--green', inherited: '--gray' };
const colorOf = (operator) => OPERATOR_COLORS[operator] ?? '--pink'; // a study's custom measure
const MARGIN = { left: 56, right: 14, top: 28, bottom: 46 };

class Scatter {
  /**
   * @param {function(number[]): void} chosen called with the numbers of the designs in the brush
   * @param {string} [score] the name of the score
   */
  constructor(chosen, score = 'score') {
    this.chosen = chosen;
    this.score = score;
    this.designs = [];
    this.axes = ['voxels', 'score'];
    this.brush = null;
    this.canvas = h('canvas',
      { tabindex: 0, role: 'img', 'aria-label': 'Population: no designs yet' });
    this.canvas.style.minHeight = '340px';
    this.walk = button('Watch here', () => this.#choose(), { disabled: true });
    this.legend = h('div.legend');
    this.traits = { ...TRAITS, score };
    this.selects = h('span.row');
    this.element = h('section.panel.chart', {}, h('div.title', {}, h('h2', {}, 'Population'),
      h('span.muted', {}, 'drag over points to choose designs'), h('div.actions', {},
        this.selects, this.walk)), this.legend, this.canvas);
    this.#offer();
    this.canvas.addEventListener('pointerdown', (event) => {
      this.canvas.setPointerCapture(event.pointerId);
      this.brush = { x0: event.offsetX, y0: event.offsetY, x1: event.offsetX, y1: event.offsetY };
    });
    this.canvas.addEventListener('pointermove', (event) => {
      if (!this.brush || !event.buttons) return;
      Object.assign(this.brush, { x1: event.offsetX, y1: event.offsetY });
      this.draw();
    });
    this.canvas.addEventListener('pointerup', () => this.#brushed());
    this.canvas.addEventListener('keydown', (event) => {
      if (event.key !== 'Enter') return;
      // Without a pointer, selects the eight best.
      this.selected = [...this.designs]
        .sort((a, b) => (a.score ?? 1e9) - (b.score ?? 1e9)).slice(0, 8);
      this.draw();
      this.#choose();
    });
    this.selected = [];
    this.observer = new ResizeObserver(() => this.draw());
    this.observer.observe(this.canvas);
  }

  /** Offers the traits, and the measures of a study. */
  #offer(measures = []) {
    this.traits = { ...TRAITS, score: this.score,
      ...Object.fromEntries(measures.map((name) => [`measures.${name}`, name])) };
    const traits = Object.entries(this.traits);
    fill(this.selects, select('Across', traits, this.axes[0], (key) => this.#axis(0, key)),
      select('Up', traits, this.axes[1], (key) => this.#axis(1, key)));
  }

  set(designs) {
    this.designs = designs;
    const measures = [...new Set(designs.flatMap((design) => Object.keys(design.measures ?? {})))]
      .sort();
    const n = Object.keys(TRAITS).length + measures.length;
    if (Object.keys(this.traits).length !== n) this.#offer(measures);
    fill(this.legend, [...new Set(designs.map((design) => design.operator))].sort()
      .map((operator) => h('span', {}, swatch(colorOf(operator)), operator)));
    const numbers = new Set(designs.map((design) => design.number));
    this.selected = this.selected.filter((design) => numbers.has(design.number));
    this.canvas.setAttribute('aria-label',
      `Population of ${designs.length} designs: ${this.traits[this.axes[1]]} ` +
      `over ${this.traits[this.axes[0]]}. Enter shows the eight best walking.`);
    this.draw();
  }

  destroy() {
    this.observer.disconnect();
  }

  #axis(which, key) {
    this.axes[which] = key;
    this.set(this.designs);
  }

  #place() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    return this.axes.map((key, axis) => {
      const of = (design) => valueOf(design, key);
      const values = this.designs.map(of).filter((v) => v !== null);
      let [low, high] = [Infinity, -Infinity];
      for (const value of values) {
        low = Math.min(low, value);
        high = Math.max(high, value);
      }
      if (!values.length) [low, high] = [0, 1];
      const room = (high - low || 1) * 0.05;
      [low, high] = [low - room, high + room];
      const [from, to] = axis === 0 ? [MARGIN.left, width - MARGIN.right]
        : [height - MARGIN.bottom, MARGIN.top];
      return { low, high, of, at: (value) => from + ((value - low) / (high - low)) * (to - from) };
    });
  }

  draw() {
    const painting = paint(this.canvas);
    if (!painting) return;
    const { context, width, height, color } = painting;
    const [x, y] = this.#place();
    context.strokeStyle = color('--grid');
    context.fillStyle = color('--muted');
    for (const tick of ticks(y.low, y.high, 5)) {
      context.beginPath();
      context.moveTo(MARGIN.left, y.at(tick));
      context.lineTo(width - MARGIN.right, y.at(tick));
      context.stroke();
      context.textAlign = 'right';
      context.fillText(number(tick), MARGIN.left - 8, y.at(tick) + 4);
    }
    context.textAlign = 'center';
    for (const tick of ticks(x.low, x.high, 8)) {
      context.fillText(number(tick), x.at(tick), height - MARGIN.bottom + 18);
    }
    const [across, up] = this.axes.map((key) => this.traits[key]);
    context.fillText(across, (MARGIN.left + width - MARGIN.right) / 2, height - 6);
    context.textAlign = 'left';
    context.fillText(up, 8, 14);
    const chosen = new Set(this.selected);
    for (const design of this.designs) {
      if (x.of(design) === null || y.of(design) === null) continue;
      context.fillStyle = color(colorOf(design.operator));
      context.globalAlpha = chosen.size && !chosen.has(design) ? 0.3 : 0.8;
      context.beginPath();
      context.arc(x.at(x.of(design)), y.at(y.of(design)), chosen.has(design) ? 5 : 3.2, 0, 7);
      context.fill();
    }
    context.globalAlpha = 1;
    if (this.brush) {
      const { x0, y0, x1, y1 } = this.brush;
      context.strokeStyle = color('--accent');
      context.strokeRect(x0, y0, x1 - x0, y1 - y0);
    }
  }

  #brushed() {
    if (!this.brush) return;
    const { x0, y0, x1, y1 } = this.brush;
    this.brush = null;
    const [x, y] = this.#place();
    // A click selects points near it.
    const room = Math.hypot(x1 - x0, y1 - y0) < 5 ? 7 : 0;
    const between = (v, a, b) => v >= Math.min(a, b) - room && v <= Math.max(a, b) + room;
    this.selected = this.designs.filter((design) => x.of(design) !== null &&
      y.of(design) !== null &&
      between(x.at(x.of(design)), x0, x1) && between(y.at(y.of(design)), y0, y1));
    this.draw();
    announce(`${countOf(this.selected.length, 'design')} chosen`);
    if (this.selected.length) this.#choose();
  }

  #choose() {
    this.walk.disabled = this.selected.length === 0;
    if (this.selected.length) this.chosen(this.selected.map((design) => design.number));
  }
}

/** The population: any two traits of its designs, and those in a brush walking. */
export class PopulationTab {
  constructor(shared) {
    this.shared = shared;
    this.population = [];
    this.stage = new CampaignStage(shared);
    this.scatter = new Scatter((numbers) => this.stage.walk(numbers.map((number) =>
      this.population.find((one) => one.number === number)).filter(Boolean)), shared.own?.name);
    this.element = h('div.grid', {}, this.scatter.element, this.stage.element);
  }

  async refresh() {
    const { id, get, job } = this.shared;
    if (job().progress.generation === null) return;
    const population = await listOf(get, `v1/campaigns/${id}/population`, {}, DESIGNS_MAX);
    this.population = population;
    this.scatter.set(population);
    if (this.stage.isEmpty) {
      const best = [...population].sort((a, b) => (a.score ?? Infinity) - (b.score ?? Infinity));
      await this.stage.walk(best.slice(0, 4));
    }
  }

  destroy() {
    this.stage.destroy();
    this.scatter.destroy();
  }
}
