/** Trainings and controllers: curves over each other, validations, lineage, and two controllers compared. */

import { Curve, getJson, patient, post } from '../lib/api.js';
import { Chart, column } from '../lib/chart.js';
import { button, fill, h, select, table } from '../lib/dom.js';
import { coalesced } from '../lib/events.js';
import { ago, bytes, count, number, percent, score, signed } from '../lib/format.js';
import { may } from '../lib/rights.js';
import { environmentSet, roll } from '../lib/rollouts.js';
import { CONFIDENCE, compareCrossed } from '../lib/statistics.js';
import { Player } from '../stage/player.js';
import { startButton } from './forms.js';
import { actions, comparing, editButton, progressBar, remark, stateChip, titleOf, trouble, weightField } from './jobs.js';
import { copyButton, saveLink } from './share.js';

const HUES = ['--blue', '--orange', '--green', '--pink'];

export async function mount(main, [id], parameters, app) {
  return id ? mountOne(main, id, parameters, app) : mountList(main, app);
}

async function mountList(main, app) {
  const list = h('div');
  const files = h('section.panel.stack');
  const { compare, box } = comparing(app, 'trainings', 'Compare curves');

  function row(item) {
    const job = { ...item, trainingKind: item.kind, kind: 'training' };
    return h('tr', {},
      box(job),
      h('td.main', {}, h('a', { href: `#/trainings/${job.id}` }, titleOf(job)), h('div.muted', {}, `${job.trainingKind}, ${job.name ?? 'unnamed'}`)),
      h('td', {}, stateChip(job)), h('td.wide', {}, progressBar(job)),
      h('td.right', { 'data-name': 'Loss' }, number(job.progress.mean_loss)),
      h('td.right', { 'data-name': 'Held-out' }, job.validation ? score(job.validation.mean_score) : '–'), h('td', {}, ago(job.created_at)));
  }

  /** Fills the two lists again; the comparison below them stays. */
  async function refresh() {
    const [trainings, controllers] = await Promise.all([
      getJson('v1/trainings?limit=200'), getJson('v1/controllers?limit=200')]);
    const named = controllers.items.filter(({ name }) => name);
    fill(list, trainings.items.length ? h('section.panel.scroll', {}, table(
      ['', 'Training', 'State', 'Progress', 'Loss', 'Held-out score', 'Created'], h('tbody', {}, trainings.items.map(row)),
      (name) => /Loss|score/.test(name)))
      : h('p.empty', {}, 'No training yet. A training teaches a controller by backpropagation through the simulation.'));
    fill(files, h('h2', {}, 'Controllers'), h('div.scroll', {}, table(['Name', 'File', 'Parameters', 'Sensor', 'Made by', 'From', 'Stored'],
      h('tbody', {}, named.map((one) => h('tr', {},
        h('td.main', {}, saveLink(`v1/controllers/${encodeURIComponent(one.name)}/file`, `${one.name}.safetensors`, one.name)),
        h('td', {}, h('code', {}, one.sha256.slice(0, 12)), h('span.muted', {}, ` ${bytes(one.bytes)}`)),
        h('td', { 'data-name': 'Parameters' }, count(one.parameters)), h('td', { 'data-name': 'Sensor' }, one.sensor), lineageOf(one, trainings.items),
        h('td', {}, ago(one.stored_at))))))));
    return named;
  }

  const named = await refresh();
  main.replaceChildren(
    h('div.title', {}, h('h1', {}, 'Trainings'), h('div.actions', {}, compare,
      copyButton(() => ({ path: 'v1/trainings', morphoctl: 'train list\ncontroller list', python: 'print(m.request("GET", "/v1/trainings"))\nprint(m.controllers())' })),
      startButton(app, 'training', { class: 'primary' }))),
    list, files, named.length && may('submit') ? comparison(app, named) : null);
  return {
    update(event) {
      if (event.type === 'reset' || event.type.startsWith('training.') || event.type.startsWith('controller.')) {
        refresh().catch(() => {});
      }
    },
  };
}

/** Where a controller comes from: the training that made it, and what that began with. */
function lineageOf(controller, trainings) {
  const training = trainings.find((one) => one.controller?.sha256 === controller.sha256);
  if (!training) return [h('td.muted', { 'data-name': 'Made by' }, 'no training here'), h('td', { 'data-name': 'From' }, '–')];
  return [h('td', { 'data-name': 'Made by' }, h('a', { href: `#/trainings/${training.id}` }, training.label ?? `Training ${training.id}`)),
    h('td', { 'data-name': 'From' }, training.parent?.name ?? (training.parent ? h('code', {}, training.parent.sha256.slice(0, 12)) : 'random weights'))];
}

/** Two controllers on the same held-out bodies: the difference with its interval, and both side by side. */
function comparison(app, controllers) {
  // Two names of one file are no comparison.
  const other = controllers.find((one) => one.sha256 !== controllers[0].sha256) ?? controllers[0];
  const names = controllers.map(({ name }) => name);
  let [a, b, size] = [names[0], other.name, '64'];
  const result = h('p', { 'aria-live': 'polite' });
  const player = new Player(app, { compact: true, height: 380 });
  const stage = h('div.panel.flush', { hidden: true }, player.element);

  async function compare() {
    go.disabled = true;
    result.textContent = 'Scoring both on the held-out bodies…';
    try {
      const { designs, environments } = await getJson(`v1/held-out?seed=1&designs=${size}&environments=16`);
      const evaluate = async (controller) => {
        let evaluation = await patient(() => post('v1/evaluations', {
          designs, environments, controller, label: `comparison of ${a} and ${b}`,
        }));
        while (!['succeeded', 'failed', 'cancelled'].includes(evaluation.state)) {
          const path = `v1/evaluations/${evaluation.id}`;
          evaluation = await getJson(path, { headers: { Prefer: 'wait=10' } });
        }
        if (!evaluation.results) throw new Error(`The evaluation of ${controller} has ${evaluation.state}.`);
        return evaluation;
      };
      const [first, second] = await Promise.all([evaluate(a), evaluate(b)]);
      const losses = [first, second].map(({ results }) => results.map((one) => one.losses.map(
        (loss) => loss ?? NaN)));
      const { n, difference, low, high, improved } = compareCrossed(losses[0], losses[1]);
      const better = high < 0 ? `${b} is better on such bodies` : low > 0 ? `${b} is worse on such bodies`
        : 'which is better is not shown: more bodies and environments make the interval narrower';
      const left = designs.length - n;
      result.textContent = n < 2 ? 'Too few bodies have a score with both controllers to say which is better.'
        : `${b} minus ${a}: ${signed(difference)}, ${percent(CONFIDENCE)} interval ${signed(low)} to ${signed(high)} ` +
          `(for other bodies and environments; Student t, ${n} held-out bodies in ${environments.length} environments, ` +
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
      fill(link, h('a', { href: `#/stage?designs=${designs[0].voxels ?? designs[0].id ?? ''}&controller=${a},${b}&show=skin,trails,side` },
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
      select('First', names, a, (value) => { a = value; }), select('Second', names, b, (value) => { b = value; }),
      select('Bodies', ['16', '64', '256'], size, (value) => { size = value; }), go, copyButton(() => ({
        path: `v1/held-out?seed=1&designs=${size}&environments=16`, morphoctl: `train compare ${a} ${b} --designs ${size}`,
        python: `held_out = m.request("GET", "/v1/held-out", seed=1, designs=${size}, environments=16)\n` +
          `for controller in ("${a}", "${b}"):\n` +
          '    print(m.request("POST", "/v1/evaluations", {**held_out, "controller": controller})["id"])',
      })))), result, link, stage);
}

async function mountOne(main, id, parameters, app) {
  const stop = new AbortController();
  const get = (url) => getJson(url, { signal: stop.signal });
  const others = (parameters.get('compare') ?? '').split(',').filter(Boolean).slice(0, 3);
  const ids = [id, ...others];
  const steps = ids.map((one) => new Curve(`v1/trainings/${one}/steps`));
  const validations = ids.map((one) => new Curve(`v1/trainings/${one}/validations`));
  const title = h('div.title');
  const head = h('section.panel.stack', { 'aria-label': 'State' });
  const loss = new Chart({ title: 'Mean loss of the batch', xName: 'step', log: true, height: 280, empty: 'No step has ended yet.' });
  const held = new Chart({ title: 'Held-out score', xName: 'step', log: true, height: 280, empty: 'No validation yet.' });
  const norm = new Chart({ title: 'Gradient norm', xName: 'step', log: true });
  const clipped = new Chart({ title: 'Share of clipped adjoints', xName: 'step', minimum: 0, yText: percent });
  const charts = [loss, held, norm, clipped];
  main.replaceChildren(title, head, h('div.grid', {}, charts.map((chart) => chart.element)));

  async function showHead() {
    const item = await get(`v1/trainings/${id}`);
    const job = { ...item, trainingKind: item.kind, kind: 'training' };
    fill(title, h('h1', {}, titleOf(job)), h('span.muted', {}, `${job.trainingKind}, into ${job.name ?? 'no name'}`),
      others.map((other) => h('a.state', { href: `#/trainings/${other}` }, `with training ${other}`)),
      stateChip(job), h('div.actions', {},
        saveLink(`v1/trainings/${id}/steps?format=csv`, `training-${id}.csv`, 'Export', { class: 'button' }),
        copyButton(() => ({
          path: `v1/trainings/${id}`, morphoctl: `train show ${id}\ntrain watch ${id}`,
          python: `training = m.training(${id})\nprint(training.steps())\nprint(training.validations())`,
        }))));
    fill(head, progressBar(job), trouble(job), remark(job), h('div.row', {}, actions(job, showHead), editButton(job, showHead), weightField(job, showHead),
      job.progress.bodies_per_s ? h('span.muted', {}, `${number(job.progress.bodies_per_s)} bodies a second`) : null));
  }

  /** Trainings that differ in their seeds alone are replicates: a band of them is one curve. */
  let groups = ids.map((one, i) => ({ name: ids.length > 1 ? `training ${one}` : '', members: [i] }));

  async function findReplicates() {
    if (ids.length < 2) return;
    const items = await Promise.all(ids.map((one) => get(`v1/trainings/${one}`)));
    const keys = items.map(({ kind, parent, settings: { seed, ...rest } }) => JSON.stringify([kind, parent, rest]));
    groups = [...new Set(keys)].flatMap((key) => {
      const members = keys.flatMap((one, i) => (one === key ? [i] : []));
      const seeds = new Set(members.map((i) => items[i].settings.seed));
      // Equal trainings of one seed are no replicates.
      return members.length > 1 && seeds.size === members.length ? [{ members, name: `mean of ${members.length} replicates` }]
        : members.map((i) => ({ name: `training ${ids[i]}`, members: [i] }));
    });
  }

  /** The curve of a group: its rows, or the mean, least and most over its replicates where all have a row. */
  function curveOf({ members }, curves, name) {
    const lists = members.map((i) => new Map(curves[i].rows.map((row) => [row.step, row[name] ?? NaN])));
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
        : [{ name: 'least to most', kind: 'band', x, y: x, low, high, color: HUES[i], opacity: 0.2 }, line];
    });
    loss.set(each(steps, 'mean_loss'));
    norm.set(each(steps, 'gradient_norm'));
    clipped.set(each(steps, 'clipped_share'));
    held.set(groups.flatMap((group, i) => {
      if (group.members.length > 1) return /** @type {any[]} */ (each(validations, 'mean_score').filter(({ color }) => color === HUES[i]));
      const { rows } = validations[group.members[0]];
      const x = column(rows, (row) => row.step);
      const bound = (sign) => column(rows, (row) => (row.mean_score === null ? null : row.mean_score + sign * (row.standard_error ?? 0)));
      return [
        { name: 'standard error', kind: 'band', silent: true, x, y: x, low: bound(-1), high: bound(1), color: HUES[i], opacity: 0.2 },
        { name: group.name || 'held-out score', x, y: column(rows, (row) => row.mean_score), color: HUES[i] },
      ];
    }));
  }

  async function refresh() {
    await Promise.all([showHead(), ...[...steps, ...validations].map((curve) => curve.refresh(stop.signal))]);
    showCharts();
  }

  await findReplicates();
  await refresh();
  const later = coalesced(refresh, stop.signal);
  return {
    update(event) {
      if (event.type === 'reset' || event.job === id || others.includes(event.job)) later();
    },
    unmount() {
      stop.abort();
      charts.forEach((chart) => chart.destroy());
    },
  };
}
