/**
 * Trainings and controllers: overlaid curves, validations, lineage, and a comparison of two
 * controllers.
 */

import { Curve, getJson, patient, post } from '../lib/api.js';
import { Chart, column } from '../lib/chart.js';
import { button, fill, h, patch, patchRow, say, select, table } from '../lib/dom.js';
import { coalesced } from '../lib/events.js';
import { ago, bytes, count, number, percent, score, signed } from '../lib/format.js';
import { may } from '../lib/rights.js';
import { environmentSet, roll } from '../lib/rollouts.js';
import { CONFIDENCE, compareCrossed } from '../lib/statistics.js';
import { taskWords, worldsOfTraining } from '../lib/tasks.js';
import { Player } from '../stage/player.js';
import { startButton } from './forms.js';
import {
  JobParts, comparedIn, comparing, emptyText, progressBar, shortProgress, stateChip, titleOf,
} from './jobs.js';
import { copyButton, saveLink } from './share.js';

const HUES = ['--blue', '--orange', '--green', '--pink'];
/** A running training is polled, because not every phase has events. */
const POLL_MS = 2000;

export async function mount(main, [id], parameters, app) {
  return id ? mountOne(main, id, parameters, app) : mountList(main, app);
}

async function mountList(main, app) {
  const stop = new AbortController();
  const body = h('tbody');
  const panel = h('section.panel.scroll', {}, table(
    ['', 'Training', 'State', 'Progress', 'Loss', 'Held-out score', 'Created'], body,
    (name) => /Loss|score/.test(name)));
  const none = h('p.empty', {}, 'No training yet. A training teaches a controller by ' +
    'backpropagation through the simulation.');
  const files = h('tbody');
  const { compare, box } = comparing(app, 'trainings', 'Compare curves');

  function cellsOf(job) {
    const held = job.validation ? score(job.validation.mean_score) : '–';
    return [
      box(job),
      h('td.main', {}, h('a', { href: `#/trainings/${job.id}` }, titleOf(job)),
        h('div.muted', {}, `${job.trainingKind}, ${job.name ?? 'unnamed'}`)),
      h('td', {}, stateChip(job)), h('td.wide', {}, progressBar(job)),
      h('td.right', { 'data-name': 'Loss' }, number(job.progress.mean_loss)),
      h('td.right', { 'data-name': 'Held-out' }, held), h('td', {}, ago(job.created_at)),
    ];
  }

  function fileCells(one, trainings) {
    const path = `v1/controllers/${encodeURIComponent(one.name)}/file`;
    return [
      h('td.main', {}, saveLink(path, `${one.name}.safetensors`, one.name)),
      h('td', {}, h('code', {}, one.sha256.slice(0, 12)),
        h('span.muted', {}, ` ${bytes(one.bytes)}`)),
      h('td', { 'data-name': 'Parameters' }, count(one.parameters)),
      h('td', { 'data-name': 'Sensor' }, one.sensor),
      h('td', { 'data-name': 'Outputs' }, periodOf(one)), ...lineageOf(one, trainings),
      h('td', {}, ago(one.stored_at)),
    ];
  }

  /** Updates the two lists; the comparison below them stays. */
  async function refresh() {
    const [trainings, controllers] = await Promise.all(['trainings', 'controllers'].map((name) =>
      getJson(`v1/${name}?limit=200`, { signal: stop.signal })));
    const jobs = trainings.items.map(asJob);
    const named = controllers.items.filter(({ name }) => name);
    none.hidden = jobs.length > 0;
    panel.hidden = !none.hidden;
    const row = () => h('tr');
    patch(body, jobs, ({ id }) => id, row, (one, job) => patchRow(one, cellsOf(job)));
    patch(files, named, ({ name }) => name, row, (one, controller) =>
      patchRow(one, fileCells(controller, trainings.items)));
    return named;
  }

  const named = await refresh();
  const copy = copyButton(() => ({
    path: 'v1/trainings', morphoctl: 'train list\ncontroller list',
    python: 'print(m.request("GET", "/v1/trainings"))\nprint(m.controllers())',
  }));
  fill(main, h('div.title', {}, h('h1', {}, 'Trainings'),
    h('div.actions', {}, compare, copy, startButton(app, 'training', { class: 'primary' }))),
  panel, none, h('section.panel.stack', {}, h('h2', {}, 'Controllers'), h('div.scroll', {}, table(
    ['Name', 'File', 'Parameters', 'Sensor', 'Outputs', 'Made by', 'From', 'Stored'], files))),
  named.length && may('submit') ? comparison(app, named) : null);
  const later = coalesced(refresh, stop.signal);
  return {
    update({ type }) {
      if (type === 'reset' || /^(job|training|controller)\./.test(type)) later();
    },
    unmount: () => stop.abort(),
  };
}

/** A training with the members that all jobs have: its kind is that of the job; trainingKind is its
 * own. */
const asJob = (item) => ({ ...item, trainingKind: item.kind, kind: 'training' });

/** How often a controller computes its outputs. */
function periodOf({ control_period_s: period }) {
  return period ? `every ${number(1000 * period)} ms` : 'every step';
}

/** Returns where a controller comes from: the training that made it, and what that started from. */
function lineageOf(controller, trainings) {
  const training = trainings.find((one) => one.controller?.sha256 === controller.sha256);
  if (!training) return [h('td.muted', { 'data-name': 'Made by' }, 'no training here'),
    h('td', { 'data-name': 'From' }, '–')];
  return [h('td', { 'data-name': 'Made by' },
    h('a', { href: `#/trainings/${training.id}` }, training.label ?? `Training ${training.id}`)),
    h('td', { 'data-name': 'From' },
      training.parent?.name ?? (training.parent
      ? h('code', {}, training.parent.sha256.slice(0, 12)) : 'random weights'))];
}

/**
 * Compares two controllers on the same held-out bodies: the difference with its interval, and both
 * side by side.
 */
function comparison(app, controllers) {
  // The newest file of a training, compared with the default: two names of one file are the same.
  const names = controllers.map(({ name }) => name);
  const first = controllers.find(({ name }) => name === 'default') ?? controllers[0];
  const other = [...controllers].sort((x, y) => y.stored_at.localeCompare(x.stored_at))
    .find(({ sha256 }) => sha256 !== first.sha256);
  let [a, b, size] = [first.name, other?.name ?? '', '64'];
  const result = h('p', { 'aria-live': 'polite' });
  const player = new Player(app, { compact: true, height: 380 });
  const stage = h('div.panel.flush', { hidden: true }, player.element);

  async function compare() {
    const [one, two] = [a, b].map((name) => controllers.find((known) => known.name === name));
    if (!two || one.sha256 === two.sha256) {
      result.textContent = 'Both are the same controller: choose two different ones.';
      return;
    }
    go.disabled = true;
    result.textContent = 'Scoring both on the held-out bodies…';
    try {
      const path = `v1/held-out?seed=1&designs=${size}&environments=16`;
      const { designs, environments } = await getJson(path);
      const evaluate = async (controller) => {
        let evaluation = await patient(() => post('v1/evaluations', {
          designs, environments, controller, label: `comparison of ${a} and ${b}`,
        }));
        while (!['succeeded', 'failed', 'cancelled'].includes(evaluation.state)) {
          const path = `v1/evaluations/${evaluation.id}`;
          evaluation = await getJson(path, { headers: { Prefer: 'wait=10' } });
        }
        if (!evaluation.results) {
          throw new Error(`The evaluation of ${controller} has ${evaluation.state}.`);
        }
        return evaluation;
      };
      const [first, second] = await Promise.all([evaluate(a), evaluate(b)]);
      const losses = [first, second].map(({ results }) => results.map((one) => one.losses.map(
        (loss) => loss ?? NaN)));
      const { n, difference, low, high, improved } = compareCrossed(losses[0], losses[1]);
      const better = high < 0 ? `${b} is better on such bodies`
        : low > 0 ? `${b} is worse on such bodies`
        : 'this does not show which is better: ' +
          'more bodies and environments would make the interval narrower';
      const left = designs.length - n;
      result.textContent = n < 2
        ? 'Too few bodies have a score with both controllers to say which is better.'
        : `${b} minus ${a}: ${signed(difference)}, ${percent(CONFIDENCE)} interval ` +
          `${signed(low)} to ${signed(high)} (for other bodies and environments; Student t, ` +
          `${n} held-out bodies in ${environments.length} environments, ` +
          `${improved} of them improved` +
          `${left ? `; ${left} that diverged left out` : ''}). Lower is better: ${better}.`;
      const [design] = designs;
      const [environment] = await environmentSet('paper-test');
      const robots = [];
      for (const controller of [a, b]) {
        const [robot] = await roll([design], environment, { controller });
        robots.push({ ...robot, label: controller });
      }
      stage.hidden = false;
      const shown = designs[0].voxels ?? designs[0].id ?? '';
      fill(link, h('a',
        { href: `#/stage?designs=${shown}&controller=${a},${b}&show=skin,trails,side` },
        'both on the stage, in any environment'));
      player.setRobots(robots);
      player.setSide(true);
    } catch (error) {
      result.textContent = error.message;
    }
    go.disabled = false;
  }

  const go = button('Compare', compare);
  const link = h('p');
  return h('section.panel.stack', {}, h('div.title', {}, h('h2', {}, 'Compare two controllers'),
    h('span.muted', {}, 'on bodies and environments that no training draws'), h('div.actions', {},
      select('First', names, a, (value) => { a = value; }),
      select('Second', other ? names : [['', 'choose one'], ...names], b,
        (value) => { b = value; }),
      select('Bodies', ['16', '64', '256'], size, (value) => { size = value; }), go,
      copyButton(() => ({
        path: `v1/held-out?seed=1&designs=${size}&environments=16`,
        morphoctl: `train compare ${a} ${b} --designs ${size}`,
        python: `held_out = m.request("GET", "/v1/held-out", seed=1, designs=${size}, ` +
          `environments=16)\nfor controller in ("${a}", "${b}"):\n` +
          '    print(m.request("POST", "/v1/evaluations", ' +
          '{**held_out, "controller": controller})["id"])',
      })))), result, link, stage);
}

async function mountOne(main, id, parameters, app) {
  const stop = new AbortController();
  const get = (url) => getJson(url, { signal: stop.signal });
  const others = comparedIn(parameters, id);
  const ids = [id, ...others];
  const steps = ids.map((one) => new Curve(`v1/trainings/${one}/steps`));
  const validations = ids.map((one) => new Curve(`v1/trainings/${one}/validations`));
  const title = h('div.title');
  const parts = new JobParts(() => showHead());
  const head = h('section.panel.stack', { 'aria-label': 'State' }, parts.bar, parts.trouble,
    parts.remark, parts.row);
  const heading = h('h1');
  const about = h('span.muted');
  const loss = new Chart({ title: 'Mean loss of the batch', xName: 'step', log: true, height: 280,
    empty: 'No step is complete yet.' });
  const held = new Chart({ title: 'Held-out score', xName: 'step', log: true, height: 280,
    empty: 'No validation yet.' });
  const norm = new Chart({ title: 'Gradient norm', xName: 'step', log: true });
  const clipped = new Chart({ title: 'Share of clipped adjoints', xName: 'step', minimum: 0,
    yText: percent });
  const charts = [loss, held, norm, clipped];
  const csv = `v1/trainings/${id}/steps?format=csv`;
  fill(title, heading, about, others.map((other) =>
    h('a.state', { href: `#/trainings/${other}` }, `with training ${other}`)), parts.chip,
  h('div.actions', {}, saveLink(csv, `training-${id}.csv`, 'Export', { class: 'button' }),
    copyButton(() => ({
      path: `v1/trainings/${id}`, morphoctl: `train show ${id}\ntrain watch ${id}`,
      python: `training = m.training(${id})\nprint(training.steps())\n` +
        'print(training.validations())',
    }))));
  main.replaceChildren(title, head, h('div.grid', {}, charts.map((chart) => chart.element)));

  let isRunning = false;
  let batch = 0;
  let worlds = null; // the tasks of listed environments, in words
  async function showHead() {
    const job = asJob(await get(`v1/trainings/${id}`));
    if (worlds === null) {
      worlds = ''; // once
      // Validation uses all listed environments.
      if (job.settings.environments?.count) {
        const { environments } = await get(`v1/trainings/${id}/held-out`);
        worlds = taskWords(environments) || 'photo';
      }
    }
    parts.update(job);
    say(heading, titleOf(job));
    say(about, `${job.trainingKind}${job.name ? ` → ${job.name}` : ''}; trains on ` +
      worldsOfTraining(job) + (worlds ? `: ${worlds}` : ''));
    app.setTitle(`${titleOf(job)}, ${shortProgress(job)}`);
    isRunning = job.state === 'running';
    batch = job.settings.batch;
  }

  /** Trainings that differ only in their seeds are replicates: one band shows a group of them. */
  let groups =
    ids.map((one, i) => ({ name: ids.length > 1 ? `training ${one}` : '', members: [i] }));

  async function findReplicates() {
    if (ids.length < 2) return;
    const items = await Promise.all(ids.map((one) => get(`v1/trainings/${one}`)));
    const keys = items.map(({ kind, parent, settings: { seed, ...rest } }) =>
      JSON.stringify([kind, parent, rest]));
    groups = [...new Set(keys)].flatMap((key) => {
      const members = keys.flatMap((one, i) => (one === key ? [i] : []));
      const seeds = new Set(members.map((i) => items[i].settings.seed));
      // Equal trainings with the same seed are not replicates.
      return members.length > 1 && seeds.size === members.length
        ? [{ members, name: `mean of ${members.length} replicates` }]
        : members.map((i) => ({ name: `training ${ids[i]}`, members: [i] }));
    });
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

  function showCharts() {
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

  async function refresh() {
    await Promise.all([showHead(),
      ...[...steps, ...validations].map((curve) => curve.refresh(stop.signal))]);
    showCharts();
  }

  await findReplicates();
  await refresh();
  const later = coalesced(refresh, stop.signal);
  const timer = setInterval(() => {
    if (!document.hidden && isRunning) showHead().catch(() => {});
  }, POLL_MS);
  return {
    update(event) {
      if (event.type === 'reset' || event.job === id || others.includes(event.job)) later();
    },
    unmount() {
      clearInterval(timer);
      stop.abort();
      charts.forEach((chart) => chart.destroy());
    },
  };
}
