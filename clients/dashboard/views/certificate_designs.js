/** The designs of a certificate, best first. Each opens to its scores at all levels. */

import { genotypeOfId } from '../lib/body.js';
import { button, h, patch, patchRow, table } from '../lib/dom.js';
import { score, signed } from '../lib/format.js';
import { nameOf, shortOf } from '../lib/names.js';
import { picture } from '../lib/picture.js';
import { headOf, plot, scaleOfScores } from './certificate_chart.js';
import { axisTitle, badgesOf, levelWords } from './certificate_words.js';

const NAMES = ['Rank', 'Design', '', 'Score', 'Verdict', ''];

/** Formats half the width of an interval: " ± 0.0012". */
const plusMinus = (interval) => h('span.muted', {},
  interval ? ` ± ${score((interval[1] - interval[0]) / 2)}` : '');

/** Returns the name of a level; a repeated name of the axis is dimmed. */
export function levelHead(level, i, levels) {
  const isSame = levels[i - 1]?.axis === level.axis;
  return h('th', { scope: 'row' }, h(isSame ? 'span.muted' : 'span', {}, axisTitle(level.axis)),
    ' ', h('span.level', {}, levelWords(level, levels[0])));
}

/** Returns a row of a table of levels. A line separates axes. */
const levelRow = (level, i, levels, cells) =>
  h(levels[i - 1]?.axis === level.axis ? 'tr' : 'tr.first', {}, levelHead(level, i, levels), cells);

export class CertifiedDesigns {
  /** @param {import('../app.js').app} app @param {string} open positions of the open designs */
  constructor(app, open) {
    this.app = app;
    this.open = new Set(open.split(',').filter(Boolean));
    this.report = null;
    this.body = h('tbody');
    this.table = table(NAMES, this.body, (_, i) => !i, 'table.certified');
    this.element = h('section.panel.stack', { 'aria-label': 'Designs' },
      h('div.row', {}, h('h2', {}, 'Designs'), h('span.muted', {},
        'Scores are mean losses with 95 % intervals: ↓ lower is better. ', h('span.hint', {},
          'Select a design to see its scores at all levels.'))), h('div.scroll', {}, this.table));
  }

  show(report) {
    this.report = report;
    const { designs } = report;
    this.scale = scaleOfScores(designs);
    this.table.tHead.rows[0].cells[2].replaceWith(headOf(this.scale));
    const order = designs.map((_, i) => String(i))
      .sort((a, b) => designs[a].rank - designs[b].rank || a - b);
    const rows = order.flatMap((i) => [{ key: i, i },
      ...(this.open.has(i) ? [{ key: `levels ${i}`, i }] : [])]);
    patch(this.body, rows, ({ key }) => key, ({ key, i }) => (key === i
      ? h('tr.design', { onclick: (event) => this.#click(event, i) }) : h('tr.detail')),
    (row, { key, i }) => patchRow(row, key === i ? this.#cells(designs[i], i)
      : [h('td', { colspan: NAMES.length }, this.#levels(designs[i]))]));
  }

  #click({ target }, i) {
    if (target.closest('a, button') || String(getSelection())) return;
    this.#toggle(i);
  }

  #toggle(i) {
    if (!this.open.delete(i)) this.open.add(i);
    this.app.keep({ open: [...this.open].join(',') });
    this.show(this.report);
    this.body.querySelector(`[data-design="${i}"]`)?.focus({ preventScroll: true });
  }

  #cells(design, i) {
    const { design: robot, flags, peak_strain: strain, inverted_voxels: inverted } = design;
    const isOpen = this.open.has(i);
    return [h('td.right.rank', {}, design.rank), h('td.robot', {},
      h('div', {}, picture(genotypeOfId(robot), ''), h('span', {}, h('a', {
        href: `#/designs/${robot}`, title: robot }, nameOf(robot)),
      h('div.muted', {}, shortOf(robot))))),
    plot(this.scale, design), h('td.number', {}, score(design.score), plusMinus(design.interval)),
    h('td.verdict', {}, h('div.badges', {}, badgesOf(design, this.report).map(([text, kind]) =>
      h(`span.badge.${kind}`, {}, text)), flags.map((flag) => h('span.badge.flag', {
      title: `peak strain ${strain}, ${inverted} inverted voxels` }, flag))), design.verdict),
    h('td', {}, button(isOpen ? 'Hide' : 'Levels', () => this.#toggle(i), { class: 'small',
      'aria-expanded': String(isOpen), 'data-design': i,
      'aria-label': `${isOpen ? 'Hide' : 'Show'} the levels of ${nameOf(robot)}` }))];
  }

  /** Returns the scores of a design at all levels. */
  #levels(design) {
    const { levels } = this.report;
    const scale = scaleOfScores(design.levels);
    const rows = design.levels.map((one, i) => levelRow(levels[i], i, levels, [
      plot(scale, one, { base: design.score }),
      h('td.number', {}, one.diverged ? h('span.flag', {},
        `${one.diverged} of ${levels[i].environments} diverged`)
        : [score(one.score), plusMinus(one.interval)]),
      h('td.number.change', {}, one.change === null ? ''
        : [signed(one.change), plusMinus(one.change_interval)]),
      h('td.right', {}, one.rank)]));
    const shown = table(['Level', '', 'Score', 'Change from the base', 'Rank'],
      h('tbody', {}, rows), (_, i) => i > 3, 'table.levels');
    shown.tHead.rows[0].cells[1].replaceWith(headOf(scale));
    return shown;
  }
}
