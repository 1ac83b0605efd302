/**
 * Panels of an evaluation in addition to its scores: the picture and the table of a suite,
 * measures with flags, and how each design reached its tolerance.
 */

import { request, shared, withQuery } from '../lib/api.js';
import { fill, h, table } from '../lib/dom.js';
import { count, countOf, number, score } from '../lib/format.js';
import { nameOf, shortOf } from '../lib/names.js';
import { inUnit, measureTitle } from '../lib/tasks.js';

/** Designs in a table, and polygons in a picture. */
const ROWS_MAX = 100;
const POLYGONS_MAX = 6;
/** Widths of the picture: with the legend beside the axes, or below them. */
const WIDE_PX = 760;
const NARROW_PX = 620;
const LEAST_PX = 320;
/** Padding on both sides of the picture. */
const PADDING_PX = 24;

const linkTo = ({ robot, row }) => h('th', { scope: 'row' },
  h('a', { href: `#/designs/${robot}`, title: robot }, `${row}: ${nameOf(robot)}`),
  h('div.muted', {}, shortOf(robot)));

/** Returns a panel with a table that may be wider than the page. */
function panel(title, about, names, rows) {
  return h('section.panel.stack', { 'aria-label': title },
    h('div.title', {}, h('h2', {}, title), h('span.muted', {}, about)),
    h('div.scroll', { tabindex: 0 }, table(names, h('tbody', {}, rows), (name, i) => i > 0,
      'table.number')));
}

const cell = (text, name = 'td.right.number') => h(name, {}, text);

/** Describes which designs a table shows: "the best 100 of 2,000". */
function shownOf(rows, all) {
  return rows.length < all ? `the best ${rows.length} of ${count(all)} designs`
    : countOf(rows.length, 'design');
}

/** Returns the table of a suite: the value of each design in each task, and the means. */
function suiteTable(job, rows) {
  const { tasks } = job.suite;
  const lines = rows.map((one) => h('tr', {}, linkTo(one),
    tasks.map(({ task }) => cell(inUnit(one.tasks[task].value, one.tasks[task].unit))),
    h('td.right', {}, one.tasks_mean.loss === null ? '–' : score(one.tasks_mean.loss) +
      (one.tasks_mean.left_out.length ? ` without ${one.tasks_mean.left_out.join(', ')}` : ''))));
  if (tasks[0].unit !== undefined) {
    lines.push(h('tr.total', {}, h('th', { scope: 'row' }, `mean of ${count(job.n_designs)}`),
      tasks.map((one) => cell([inUnit(one.mean_value, one.unit),
        one.left_out ? h('div.muted', {}, `${one.left_out} left out`) : null])), cell('')));
  }
  return panel(`Tasks of ${job.suite.name}`,
    `${shownOf(rows, job.n_designs)}; higher is better, standing still gives 0; photo, photo-auc ` +
    'and damage: share of the distance to the light',
    ['Design', ...tasks.map(({ task }) => task), 'Mean loss'], lines);
}

/** The picture of a suite, in the theme of the page and as wide as it can be read. */
class SuitePicture {
  constructor(app, job, signal) {
    this.app = app;
    this.path = `v1/evaluations/${encodeURIComponent(job.id)}/picture.svg`;
    this.signal = signal;
    this.designs = [];
    this.drawn = '';
    this.image = h('img', { alt: `Values in each task of ${job.suite.name}; the table below has ` +
      'the numbers' });
    this.element = h('section.panel.radar', { 'aria-label': 'Picture of the suite' }, this.image);
    this.refresh = shared(() => this.#refresh());
    this.redraw = () => this.draw();
    this.observer = new ResizeObserver(this.redraw);
    this.observer.observe(this.element);
    app.themeListeners.add(this.redraw);
  }

  /** Draws the first of these designs, by position. @param {number[]} [designs] */
  draw(designs = this.designs) {
    this.designs = designs.slice(0, POLYGONS_MAX);
    this.refresh().catch((error) => {
      if (!this.signal.aborted) fill(this.element, h('p.muted', {}, error.message));
    });
  }

  async #refresh() {
    for (;;) { // what is to be drawn may change in the meantime
      const room = this.element.clientWidth - PADDING_PX;
      const width = room >= WIDE_PX ? WIDE_PX : Math.max(LEAST_PX, Math.min(room, NARROW_PX - 1));
      const path = withQuery(this.path,
        { width, theme: this.app.theme, designs: this.designs.join(',') });
      if (room <= 0 || path === this.drawn) return;
      const picture = await (await request(path, { signal: this.signal })).blob();
      const before = this.image.src;
      this.image.src = URL.createObjectURL(picture);
      if (before) URL.revokeObjectURL(before);
      this.drawn = path;
    }
  }

  destroy() {
    this.observer.disconnect();
    this.app.themeListeners.delete(this.redraw);
    if (this.image.src) URL.revokeObjectURL(this.image.src);
  }
}

/** Returns the table of measures: a column for each, and the flags. */
function measuresTable(job, rows) {
  const flagged = rows.filter(({ flags }) => flags?.length).length;
  return panel('Measures',
    `means over the environments; ${shownOf(rows, job.n_designs)}` +
    (flagged ? `, ${flagged} flagged` : ', none flagged'),
    ['Design', ...job.measures.map(measureTitle), 'Flags'], rows.map((one) => h('tr', {},
      linkTo(one), job.measures.map((name) => cell(number(one.measures?.[name]))),
      h('td', {}, one.flags?.length ? h('span.flag', {}, one.flags.join(', ')) : '–'))));
}

/** Describes a rung, the settings that a score was computed with: "2 ms, float32". */
const settingOf = ({ dt_s: dt, precision }) =>
  (dt === null ? '–' : `${number(1000 * dt)} ms, ${precision}`);

/** Returns the table of tolerances: the rung where each design ended, and the result of each
 * rung. */
function tolerancesTable(job, rows) {
  const reached = rows.filter(({ tolerance }) => tolerance?.reached).length;
  return panel(`Tolerance ${number(job.tolerance)}`,
    `${reached} of the ${rows.length} designs shown are within tolerance`,
    ['Design', 'Score', 'Reached', 'Estimated error', 'Chosen rung', 'Rungs: score ± error'],
    rows.map((one) => {
      const { tolerance } = one;
      return h('tr', {}, linkTo(one), cell(score(one.score)),
        cell(tolerance.reached ? 'yes' : tolerance.bifurcates ? 'no: bifurcates' : 'no'),
        cell(number(tolerance.estimated_error)), cell(settingOf(tolerance)),
        cell(tolerance.rungs.map((rung) => h('div', {},
          `${settingOf(rung)}: ${score(rung.score)} ± ${number(rung.estimated_error)}`))));
    }));
}

/** All of these for one evaluation. The element stays empty if it has none of them. */
export class ResultPanels {
  constructor(app, signal) {
    this.app = app;
    this.signal = signal;
    this.picture = null;
    this.best = [];
    this.element = h('div.stack', { hidden: true });
  }

  /** Shows the results. @param {Object[]} results best first, with their positions as `row` */
  show(job, results) {
    const rows = results.filter(({ robot }) => robot !== null).slice(0, ROWS_MAX);
    if (!rows.length) return;
    this.picture?.destroy();
    if (job.suite) this.picture = new SuitePicture(this.app, job, this.signal);
    fill(this.element, this.picture?.element, job.suite ? suiteTable(job, rows) : null,
      job.tolerance ? tolerancesTable(job, rows) : null,
      job.measures ? measuresTable(job, rows) : null);
    this.element.hidden = !this.element.childElementCount;
    this.best = rows.map(({ row }) => row);
  }

  /** Draws these designs in the picture, by position; the best ones if there are none. */
  draw(chosen) {
    this.picture?.draw(chosen.length ? chosen : this.best);
  }

  destroy() {
    this.picture?.destroy();
  }
}
