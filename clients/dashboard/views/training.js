/** One training run: its curves, with those of the runs that it is compared with, and its
 * settings. */

import { Curve } from '../lib/api.js';
import { Chart, column } from '../lib/chart.js';
import {
  ChartGroup, axisIn, axisOptions, axisRow, sums, timeUnit,
} from '../lib/chart_group.js';
import { h } from '../lib/dom.js';
import { percent } from '../lib/format.js';
import { taskWords, worldsOfTraining } from '../lib/tasks.js';
import { emptyText, submitter } from './jobs.js';
import { mountRun } from './run_page.js';
import { SettingsTab } from './settings.js';
import { SettingsDiff } from './settings_diff.js';
import { copyButton, saveLink } from './share.js';

/** Choices of x: `robots` is the steps times the batch; `time` is wall time. */
const AXES = ['step', 'robots', 'time'];
const HUES = ['--blue', '--orange', '--green', '--pink'];

export function mount(main, path, parameters, app) {
  return mountRun(main, path, parameters, app,
    { kind: 'training', prepare,
      tabs: { '': async () => TrainingCurves, settings: async () => SettingsTab } });
}

async function prepare({ id, get, job }) {
  let worlds = ''; // the tasks of listed environments, in words
  if (job().settings.environments?.count) {
    // Validation uses all listed environments.
    const { environments } = await get(`v1/trainings/${id}/held-out`);
    worlds = taskWords(environments) || 'photo';
  }
  return {
    actions: [saveLink(`v1/trainings/${id}/${job().settings.each ? 'each' : 'steps'}?format=csv`,
      `training-${id}.csv`, 'Export', { class: 'button' }),
    copyButton(() => ({
      path: `v1/trainings/${id}`, morphoctl: `train show ${id}\ntrain watch ${id}`,
      python: `training = m.training(${id})\nprint(training.steps())\n` +
        'print(training.validations())',
    }))],
    about: (one) => `${one.trainingKind}${one.name ? ` → ${one.name}` : ''}; trains on ` +
      worldsOfTraining(one) + (worlds ? `: ${worlds}` : '') + submitter(one),
  };
}

/**
 * Returns the curve of a group: its rows, or the mean, minimum and maximum of its replicates
 * where all have a row. along: returns x of a step of a member.
 */
function curveOf({ members }, curves, along, take) {
  const lists =
    members.map((i) => new Map(curves[i].rows.map((row) => [row.step, take(row) ?? NaN])));
  const steps = [...lists[0].keys()].filter((step) => lists.every((list) => list.has(step)) &&
    members.every((i) => Number.isFinite(along(i, step))));
  const values = steps.map((step) => lists.map((list) => list.get(step)));
  return {
    x: steps.map((step) => members.reduce((sum, i) => sum + along(i, step), 0) / members.length),
    y: values.map((all) => all.reduce((sum, one) => sum + one, 0) / all.length),
    low: values.map((all) => Math.min(...all)), high: values.map((all) => Math.max(...all)),
  };
}

class TrainingCurves {
  constructor(shared) {
    this.shared = shared;
    const { id, others, job, get, app, parameters } = shared;
    this.ids = [id, ...others];
    this.steps = this.ids.map((one) => new Curve(`v1/trainings/${one}/steps`));
    this.validations = this.ids.map((one) => new Curve(`v1/trainings/${one}/validations`));
    /** Training runs that differ only in their seeds are replicates: one band shows a group of
     * them. */
    this.groups = this.ids.map((one, i) =>
      ({ name: others.length ? `training ${one}` : '', of: '', members: [i] }));
    this.found = null;
    this.batches = [job().settings.batch];
    this.axis = axisIn(parameters, AXES);
    const group = new ChartGroup(parameters, app.keep);
    this.charts = [
      new Chart({ title: 'Mean loss of the batch', xName: 'step', log: true, height: 280,
        empty: 'No step is complete yet.' }),
      new Chart({ title: 'Held-out score', xName: 'step', log: true, height: 280,
        empty: 'No validation yet.' }),
      new Chart({ title: 'Gradient norm', xName: 'step', log: true }),
      new Chart({ title: 'Share of clipped adjoints', xName: 'step', minimum: 0, yText: percent }),
    ].map((chart, i) => chart.join(group, ['loss', 'held-out', 'gradient', 'clipped'][i]));
    group.check();
    this.element = h('div.stack', {},
      others.length ? new SettingsDiff(app, job(), others, get).element : null,
      axisRow(AXES, this.axis, (axis) => {
        this.axis = axis;
        app.keep({ x: axis === AXES[0] ? null : axis });
        group.zoomTo(null);
        this.#show();
      }),
      h('div.grid', {}, this.charts.map((chart) => chart.element)));
  }

  async #findReplicates() {
    const { ids, shared: { get } } = this;
    const items = await Promise.all(ids.map((one) => get(`v1/trainings/${one}`)));
    this.batches = items.map(({ settings }) => settings.batch);
    const keys = items.map(({ kind, parent, settings: { seed, ...rest } }) =>
      JSON.stringify([kind, parent, rest]));
    this.groups = [...new Set(keys)].flatMap((key) => {
      const members = keys.flatMap((one, i) => (one === key ? [i] : []));
      const seeds = new Set(members.map((i) => items[i].settings.seed));
      // Equal runs with the same seed are not replicates.
      return members.length > 1 && seeds.size === members.length
        ? [{ members, name: `mean of ${members.length} replicates`, of: '' }]
        : members.map((i) => ({ name: `training ${ids[i]}`, of: '', members: [i] }));
    });
    const bands = this.groups.filter(({ members }) => members.length > 1);
    if (bands.length > 1) {
      for (const band of bands) {
        band.of = ` of ${band.members.map((i) => ids[i]).join(' and ')}`;
        band.name = `mean${band.of}`;
      }
    }
  }

  async refresh() {
    if (this.ids.length > 1) await (this.found ??= this.#findReplicates());
    await Promise.all([...this.steps, ...this.validations].map((curve) =>
      curve.refresh(this.shared.signal)));
    this.#show();
  }

  #show() {
    const { groups, steps, validations, charts: [loss, held, norm, clipped] } = this;
    const { batch } = this.shared.job().settings;
    const times = steps.map(({ rows }) => sums(rows, (row) => row.seconds));
    const time = timeUnit(Math.max(...times.map((list) => list.at(-1) ?? 0)));
    const options = axisOptions(this.axis, AXES[0], time);
    this.charts.forEach((chart) => Object.assign(chart.options, options));
    /** @type {(i: number, step: number) => number} */
    const along = {
      step: (i, step) => step,
      robots: (i, step) => step * this.batches[i],
      // A validation may arrive before the row of its step, which has the time: NaN until then.
      time: (i, step) => (step ? (times[i][step - 1] ?? NaN) / time.unitS : 0),
    }[this.axis];
    const each = (curves, name, take = (row) => row[name]) => groups.flatMap((group, i) => {
      const { x, y, low, high } = curveOf(group, curves, along, take);
      const line = { name: group.name || name.replaceAll('_', ' '), color: HUES[i], x, y };
      return group.members.length < 2 ? [line]
        : [{ name: `min to max${group.of}`, kind: 'band', x, y: x, low, high, color: HUES[i],
          opacity: 0.2 }, line];
    });
    loss.options.empty =
      emptyText(batch, steps[0].rows.at(-1)?.diverged, 'No step is complete yet.');
    loss.set(each(steps, 'mean_loss'));
    // A step that was skipped has no gradient.
    norm.set(each(steps, 'gradient_norm', (row) => (row.skipped ? null : row.gradient_norm)));
    clipped.set(each(steps, 'clipped_share'));
    held.set(groups.flatMap((group, i) => {
      if (group.members.length > 1) return /** @type {any[]} */ (each(validations, 'mean_score')
        .filter(({ color }) => color === HUES[i]));
      const [member] = group.members;
      const rows = validations[member].rows.filter(({ step }) =>
        Number.isFinite(along(member, step)));
      const x = column(rows, (row) => along(member, row.step));
      const bound = (sign) => column(rows, (row) =>
        (row.mean_score === null ? null : row.mean_score + sign * (row.standard_error ?? 0)));
      return [
        { name: 'standard error', kind: 'band', silent: true, x, y: x,
          of: group.name || 'held-out score', low: bound(-1),
          high: bound(1), color: HUES[i], opacity: 0.2 },
        { name: group.name || 'held-out score', x, y: column(rows, (row) => row.mean_score),
          color: HUES[i] },
      ];
    }));
  }

  destroy() {
    this.charts.forEach((chart) => chart.destroy());
  }
}
