/** One evaluation: its results, and its settings. */

import { getJson, withQuery } from '../lib/api.js';
import { button, h, say } from '../lib/dom.js';
import { ago, bytes, count, countOf } from '../lib/format.js';
import { isSuite } from '../lib/rollouts.js';
import { ResultPanels } from './results.js';
import { mountRun } from './run_page.js';
import { SettingsTab } from './settings.js';
import { SettingsDiff } from './settings_diff.js';
import { copyButton } from './share.js';
import { Wall } from './wall.js';

/** Number of pages of 1,000 results that are read from an evaluation that is too large for a
 * list. */
const PAGES_MAX = 10;
const SHOWN_MAX = 500;

export function mount(main, path, parameters, app) {
  return mountRun(main, path, parameters, app,
    { kind: 'evaluation', prepare,
      tabs: { '': async () => Results, settings: async () => SettingsTab } });
}

async function prepare(shared) {
  const { id, app, job } = shared;
  const about = h('p.muted');
  const record = h('p.muted', { hidden: true });
  const wall = new Wall(app);
  wall.options = { world: `evaluation-${id}` };
  shared.wall = wall;
  shared.best = []; // rows, best first
  /** Shows the recordings of the selected designs, or of the best. */
  const recordings = button('Show recordings', () => {
    const rows = wall.chosen.size ? [...wall.chosen.values()].map(({ row }) => row)
      : shared.best.slice(0, 4);
    app.go('stage', { evaluation: id, rows: rows.join(',') });
  }, { hidden: true });
  return {
    actions: [recordings, wall.watch, wall.keep, wall.breed, copyButton(() => ({
      path: `v1/evaluations/${id}`, morphoctl: `job show ${id} --results`,
      python: `print(m.evaluation(${id}).${isLarge(job()) ? 'table' : 'frame'}())`,
    }))],
    lines: [about, record],
    about(one) {
      recordings.hidden = !one.record.includes('masses') || !one.recorded_bytes ||
        Boolean(one.recordings_removed_at) || !one.results;
      const { name, sha256 } = one.controller;
      say(about, `${countOf(one.n_designs, 'design')} under the controller ` +
        `${name ?? sha256.slice(0, 12)}, ${placesOf(one.environments)}`);
      record.hidden = !one.record.length;
      say(record, one.recordings_removed_at
        ? `Its recordings were removed ${ago(one.recordings_removed_at)}; its scores are kept.`
        : `Recorded: ${one.record.join(', ')}, ${bytes(one.recorded_bytes)}.`);
      return '';
    },
  };
}

/** Returns whether an evaluation has too many designs for a list of results. */
const isLarge = (job) => !job.results && job.state === 'succeeded';

/** The designs with their scores, and the tables of a suite, of measures and of tolerances. */
class Results {
  constructor(shared) {
    const { app, signal, wall, job, others, get } = shared;
    this.shared = shared;
    this.isDone = false;
    this.notes = h('section.panel.stack', { 'aria-label': 'Notes', hidden: true });
    this.panels = new ResultPanels(app, signal);
    wall.element.replaceChildren();
    wall.changed = () => this.panels.draw([...wall.chosen.values()].map(({ row }) => row));
    this.element = h('div.stack', {},
      others.length ? new SettingsDiff(app, job(), others, get).element : null,
      this.notes, this.panels.element,
      h('section.panel', { 'aria-label': 'Results' }, wall.element));
  }

  #note(text) {
    this.notes.append(h('p.muted', {}, text));
    this.notes.hidden = false;
  }

  async refresh() {
    const job = this.shared.job();
    if (this.isDone || (!job.results && !isLarge(job))) return;
    this.isDone = true;
    try {
      this.#show(job, await resultsOf(job, this.shared.signal));
    } catch (error) {
      this.isDone = false; // the next event retries
      throw error;
    }
  }

  #show(job, { rows, isCut = false }) {
    const { wall } = this.shared;
    const order = rows.filter((result) => !result.fault)
      .sort((x, y) => Number(x.lower_bound) - Number(y.lower_bound) ||
        (x.score ?? Infinity) - (y.score ?? Infinity))
      .slice(0, SHOWN_MAX);
    this.shared.best = order.map(({ row }) => row);
    const knowsBest = job.best !== null && !isCut;
    const last = knowsBest ? order[job.best - 1]?.score ?? Infinity : -Infinity;
    wall.add(order.map((one) => ({ ...one, isBest: isAmong(one, last) })));
    this.panels.show(job, order);
    wall.changed(); // the selection may be from an earlier visit
    if (job.best !== null) {
      this.#note(`The best ${count(job.best)} were requested; ${count(job.rollouts_cut)} ` +
        'rollouts of the others were not computed. A score after ≥ is a lower bound.');
    }
    if (job.n_skipped > 0) this.#note(`${countOf(job.n_skipped, 'design')} skipped.`);
    if (isCut) {
      this.#note(`The best ${order.length} of the first ${count(rows.length)} complete scores ` +
        `are shown, of ${count(job.n_designs)} designs.`);
    } else if (job.n_designs - job.n_skipped > order.length) {
      this.#note(`The best ${order.length} of ${count(job.n_designs)} designs are shown.`);
    }
    if (isLarge(job)) {
      this.#note(`All results: morphoctl export evaluations/${job.id}/results -o FILE.csv`);
    }
  }

  destroy() {
    this.panels.destroy();
  }
}

/** Returns the results with their positions; for a large evaluation, the first results with full
 * scores. */
async function resultsOf(job, signal) {
  if (job.results) return { rows: job.results.map((result, row) => ({ ...result, row })) };
  const rows = [];
  let cursor = '0';
  for (let n = 0; n < PAGES_MAX && cursor !== null; n++) {
    const asked = { whole: true, limit: 1000, cursor };
    const page = await getJson(withQuery(`v1/evaluations/${job.id}/results`, asked), { signal });
    rows.push(...page.items.map((result) => ({ ...result, row: result.number })));
    cursor = page.next_cursor;
  }
  return { rows, isCut: cursor !== null };
}

/** Returns whether a design is one of the requested best, which have full scores. */
const isAmong = ({ score: own, lower_bound: isBound }, last) =>
  !isBound && own !== null && own <= last;

/** Describes in words where designs are scored. */
const placesOf = (environments) => (typeof environments === 'string'
  ? `in ${isSuite(environments) ? 'all tasks' : 'the environments'} of ${environments}`
  : `in ${countOf(environments.count ?? environments.length, 'custom environment')}`);
