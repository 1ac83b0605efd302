/** One certificate: how well the order and the scores of its designs hold, level by level. */

import { button, fill, h, patch, patchRow, say, table } from '../lib/dom.js';
import { count, countOf, number, score } from '../lib/format.js';
import { isOver } from '../lib/kinds.js';
import { physicsOf } from '../lib/defaults.js';
import { rowsOfSettings } from '../lib/settings.js';
import { loadSheet } from '../lib/sheet.js';
import { headOf, plot, scaleOf } from './certificate_chart.js';
import { CertifiedDesigns, levelHead } from './certificate_designs.js';
import { axisTitle } from './certificate_words.js';
import { mountRun } from './run_page.js';
import { copyButton, saveLink } from './share.js';

export async function mount(main, path, parameters, app) {
  await loadSheet('certificate.css');
  return mountRun(main, path, parameters, app,
    { kind: 'certificate', tabs: { '': async () => Report }, prepare });
}

async function prepare({ id }) {
  return {
    actions: [saveLink(`v1/certificates/${id}/report.csv`, `certificate-${id}.csv`, 'CSV',
      { class: 'button' }), button('Print', () => print()), copyButton(() => ({
      path: `v1/certificates/${id}/report`, morphoctl: `certificate ${id}`,
      python: `print(m.request("GET", "/v1/certificates/${id}/report")["verdict"])`,
    }))],
    about: ({ certificate: { trials, trials_done: done } }) => (done === trials ? ''
      : `${count(done)} of ${countOf(trials, 'level')}`),
  };
}

/** Formats tau. */
const two = (value) => value.toFixed(2).replace('-', '−');

const interval = (ends) => h('span.muted.interval', {},
  ends ? ` ${ends.map(two).join(' to ')}` : '');

/** The report of the complete trials. */
class Report {
  constructor({ app, id, get, job, parameters }) {
    this.id = id;
    this.get = get;
    this.job = job;
    this.done = 0;
    this.verdict = h('p.sentence', { role: 'status' });
    this.rows = h('tbody');
    this.table = table(['Level', '', 'τ', 'Mean score', 'Regret'], this.rows, (_, i) => i > 1,
      'table.levels');
    this.top = h('span.muted');
    this.asked = h('dl.settings');
    this.designs = new CertifiedDesigns(app, parameters.get('open') ?? '');
    this.report = h('div.stack', { hidden: true }, h('div.certified-grid', {},
      h('section.panel.stack', { 'aria-label': 'Levels' }, h('div.row', {}, h('h2', {}, 'Levels'),
        this.top), h('div.scroll', {}, this.table)),
      h('section.panel', { 'aria-label': 'The request' }, h('h2', {}, 'The request'),
        this.asked)), this.designs.element);
    this.element = h('div.stack.certificate', {}, this.verdict, this.report);
  }

  async refresh() {
    const { certificate, state } = this.job();
    if (!certificate.trials_done) {
      say(this.verdict, isOver({ state }) ? 'It ended before the first level was complete.'
        : 'The first numbers appear when all designs are scored at the base.');
      return;
    }
    if (this.done === certificate.trials_done) return;
    const report = await this.get(`v1/certificates/${this.id}/report`);
    this.done = report.levels.length;
    if (!report.complete) this.element.classList.add('early');
    this.report.hidden = false;
    say(this.verdict, report.verdict);
    this.#showLevels(report, certificate.trials);
    this.#showAsked(report);
    this.designs.show(report);
  }

  #showLevels({ levels, top }, n) {
    const low = Math.min(0, ...levels.flatMap((one) => one.tau_interval ?? one.tau ?? []));
    const scale = scaleOf(Math.max(-1, Math.floor(low * 10) / 10), 1);
    say(this.top, 'τ: Kendall\'s rank correlation with the base, 1 if the order is the same. ' +
      `Regret: what choosing the base's best ${top === 1 ? 'one' : top} costs`);
    this.table.tHead.rows[0].cells[1].replaceWith(headOf(scale, 'τ, 95 % interval'));
    // Levels that are still to come already have rows, so that the content below does not move.
    const rows = Array.from({ length: n }, (_, i) => levels[i] ?? null);
    patch(this.rows, rows.map((level, i) => ({ level, i })), ({ i }) => i, () => h('tr'),
      (row, { level, i }) => {
        row.className = level && levels[i - 1]?.axis !== level.axis ? 'first' : '';
        patchRow(row, level ? [levelHead(level, i, levels),
          plot(scale, { score: level.tau, interval: level.tau_interval }, { from: 0 }),
          h('td.right', {}, level.tau === null ? '–' : two(level.tau),
            interval(level.tau_interval)),
          h('td.right', {}, level.mean_score === null ? '–' : score(level.mean_score),
            level.diverged_designs ? h('span.flag', {}, ` ${level.diverged_designs} diverged`)
              : null),
          h('td.right', {}, level.regret === null ? '–' : score(level.regret))]
          : [h('th.muted', { scope: 'row' }, '…'), h('td'), h('td'), h('td'), h('td')]);
      });
  }

  #showAsked({ physics, left_out: leftOut, axis_notes: notes, levels }) {
    const { certificate: asked, created_at: at, population, notes: faults } = this.job();
    const { controller, environments } = asked;
    const [kind, other] = Object.entries(population ?? {})[0] ?? [];
    const from = (name) => (asked.from_population.includes(name) ? ` of the ${kind}` : '');
    const usual = physicsOf(false, physics.control_period_s);
    const own = rowsOfSettings(physics, usual).filter((row) =>
      row.differs || ['n_steps', 'dt_s', 'control_period_s'].includes(row.name));
    const facts = [
      ['Certificate', `${this.id} of ${new Date(at).toLocaleString()}`],
      ['Designs', [count(asked.designs), kind ? [', the best of ', h('a', {
        href: `#/${kind}s/${other}` }, `${kind} ${other}`)] : '']],
      ['Controller', `${controller.name ?? controller.sha256.slice(0, 12)}${from('controller')}`],
      ['Environments', (typeof environments === 'string' ? environments
        : countOf(environments.count, 'listed environment')) + from('environments')],
      [`Physics${from('physics')}`, own.map(({ title, text }) =>
        `${title.toLowerCase()} ${text}`).join(', ')],
      ['Seed', asked.seed],
      ['Constants drawn', asked.axes.includes('worlds') ? Object.entries(asked.ranges)
        .map(([name, ends]) => `${name} × ${ends.map((end) => number(end)).join(' to ')}`)
        .join(', ') : 'none'],
      ['Rollouts', count(asked.rollouts)],
      ['Computed by', [...new Set(levels.map(({ fingerprint }) => fingerprint))].join(', ')],
    ];
    const remarks = [
      ...faults.map(({ place, robot, fault, repaired }) => [`Design ${place}`, fault
        ? `Skipped. ${fault.detail}` : repaired ? 'Repaired' : `Given by an id: ${robot}`]),
      ...leftOut.map(({ axis, reason }) => [axisTitle(axis), `Left out. ${reason}`]),
      ...notes.map(({ axis, note }) => [axisTitle(axis), note]),
    ];
    fill(this.asked, [...facts, ...remarks].map(([name, text]) =>
      [h('dt', {}, name), h('dd', {}, text)]));
  }

  destroy() {}
}
