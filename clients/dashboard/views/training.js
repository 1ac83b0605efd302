/** One training run: its curves, over those that it is compared with, and its settings. */

import { Curve } from '../lib/api.js';
import { Chart, column } from '../lib/chart.js';
import { h } from '../lib/dom.js';
import { percent } from '../lib/format.js';
import { taskWords, worldsOfTraining } from '../lib/tasks.js';
import { emptyText, submitter } from './jobs.js';
import { mountRun } from './run_page.js';
import { SettingsTab } from './settings.js';
import { SettingsDiff } from './settings_diff.js';
import { copyButton, saveLink } from './share.js';

const HUES = ['--blue', '--orange', '--green', '--pink'];

export function mount(main, path, parameters, app) {
  return mountRun(main, path, parameters, app,
    { kind: 'training', tabs: { '': TrainingCurves, settings: SettingsTab }, prepare });
}

async function prepare({ id, get, job }) {
  let worlds = ''; // the tasks of listed environments, in words
  if (job().settings.environments?.count) {
    // Validation uses all listed environments.
    const { environments } = await get(`v1/trainings/${id}/held-out`);
    worlds = taskWords(environments) || 'photo';
  }
  return {
    actions: [saveLink(`v1/trainings/${id}/steps?format=csv`, `training-${id}.csv`, 'Export',
      { class: 'button' }),
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
 * where all have a row.
 */
function curveOf({ members }, curves, name) {
  const lists =
    members.map((i) => new Map(curves[i].rows.map((row) => [row.step, row[name] ?? NaN])));
  const x = [...lists[0].keys()].filter((step) => lists.every((list) => list.has(step)));
  const values = x.map((step) => lists.map((list) => list.get(step)));
  return {
    x, y: values.map((all) => all.reduce((sum, one) => sum + one, 0) / all.length),
    low: values.map((all) => Math.min(...all)), high: values.map((all) => Math.max(...all)),
  };
}

class TrainingCurves {
  constructor(shared) {
    this.shared = shared;
    const { id, others, job, get, app } = shared;
    this.ids = [id, ...others];
    this.steps = this.ids.map((one) => new Curve(`v1/trainings/${one}/steps`));
    this.validations = this.ids.map((one) => new Curve(`v1/trainings/${one}/validations`));
    /** Trainings that differ only in their seeds are replicates: one band shows a group of them. */
    this.groups = this.ids.map((one, i) =>
      ({ name: others.length ? `training ${one}` : '', members: [i] }));
    this.found = null;
    this.charts = [
      new Chart({ title: 'Mean loss of the batch', xName: 'step', log: true, height: 280,
        empty: 'No step is complete yet.' }),
      new Chart({ title: 'Held-out score', xName: 'step', log: true, height: 280,
        empty: 'No validation yet.' }),
      new Chart({ title: 'Gradient norm', xName: 'step', log: true }),
      new Chart({ title: 'Share of clipped adjoints', xName: 'step', minimum: 0, yText: percent }),
    ];
    this.element = h('div.stack', {},
      others.length ? new SettingsDiff(app, job(), others, get).element : null,
      h('div.grid', {}, this.charts.map((chart) => chart.element)));
  }

  async #findReplicates() {
    const { ids, shared: { get } } = this;
    const items = await Promise.all(ids.map((one) => get(`v1/trainings/${one}`)));
    const keys = items.map(({ kind, parent, settings: { seed, ...rest } }) =>
      JSON.stringify([kind, parent, rest]));
    this.groups = [...new Set(keys)].flatMap((key) => {
      const members = keys.flatMap((one, i) => (one === key ? [i] : []));
      const seeds = new Set(members.map((i) => items[i].settings.seed));
      // Equal trainings with the same seed are not replicates.
      return members.length > 1 && seeds.size === members.length
        ? [{ members, name: `mean of ${members.length} replicates` }]
        : members.map((i) => ({ name: `training ${ids[i]}`, members: [i] }));
    });
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
    const each = (curves, name) => groups.flatMap((group, i) => {
      const { x, y, low, high } = curveOf(group, curves, name);
      const line = { name: group.name || name.replaceAll('_', ' '), color: HUES[i], x, y };
      return group.members.length < 2 ? [line]
        : [{ name: 'least to most', kind: 'band', x, y: x, low, high, color: HUES[i],
          opacity: 0.2 }, line];
    });
    loss.options.empty =
      emptyText(batch, steps[0].rows.at(-1)?.diverged, 'No step is complete yet.');
    loss.set(each(steps, 'mean_loss'));
    norm.set(each(steps, 'gradient_norm'));
    clipped.set(each(steps, 'clipped_share'));
    held.set(groups.flatMap((group, i) => {
      if (group.members.length > 1) return /** @type {any[]} */ (each(validations, 'mean_score')
        .filter(({ color }) => color === HUES[i]));
      const { rows } = validations[group.members[0]];
      const x = column(rows, (row) => row.step);
      const bound = (sign) => column(rows, (row) =>
        (row.mean_score === null ? null : row.mean_score + sign * (row.standard_error ?? 0)));
      return [
        { name: 'standard error', kind: 'band', silent: true, x, y: x, low: bound(-1),
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
