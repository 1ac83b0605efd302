/** Trainings and controllers: curves over each other, validations, lineage, and two controllers compared. */

import { Curve, getJson, patient, post } from '../lib/api.js';
import { Chart } from '../lib/chart.js';
import { button, fill, h, select } from '../lib/dom.js';
import { ago, bytes, count, number, score } from '../lib/format.js';
import { environmentSet, roll } from '../lib/rollouts.js';
import { Player } from '../stage/player.js';
import { startDialog } from './forms.js';
import { actions, progressBar, stateChip, titleOf, trouble, weightField } from './jobs.js';
import { copyButton, saveLink } from './share.js';

const HUES = ['--blue', '--orange', '--green', '--pink'];

export async function mount(main, [id], parameters, app) {
  return id ? mountOne(main, id, parameters, app) : mountList(main, app);
}

async function mountList(main, app) {
  const chosen = new Set();
  const list = h('div');
  const files = h('section.panel.stack');
  const compare = button('Compare curves', () => {
    const [first, ...others] = chosen;
    app.go(`trainings/${first}`, { compare: others.join(',') });
  }, { disabled: true });

  function row(item) {
    const job = { ...item, trainingKind: item.kind, kind: 'training' };
    return h('tr', {},
      h('td', {}, h('input', { type: 'checkbox', checked: chosen.has(job.id), 'aria-label': `Compare ${titleOf(job)}`,
        onchange: (event) => {
          if (event.target.checked) chosen.add(job.id);
          else chosen.delete(job.id);
          compare.disabled = chosen.size < 2;
        } })),
      h('td', {}, h('a', { href: `#/trainings/${job.id}` }, titleOf(job)), h('div.muted', {}, `${job.trainingKind}, ${job.name ?? 'unnamed'}`)),
      h('td', {}, stateChip(job)), h('td', {}, progressBar(job)),
      h('td.right', {}, number(job.progress.mean_loss)),
      h('td.right', {}, job.validation ? score(job.validation.mean_score) : '–'), h('td', {}, ago(job.created_at)));
  }

  /** Fills the two lists again; the comparison below them stays. */
  async function refresh() {
    const [trainings, controllers] = await Promise.all([
      getJson('v1/trainings?limit=200'), getJson('v1/controllers?limit=200')]);
    const named = controllers.items.filter(({ name }) => name);
    fill(list, trainings.items.length ? h('section.panel.scroll', {}, h('table', {}, h('thead', {}, h('tr', {},
      ['', 'Training', 'State', 'Progress', 'Loss', 'Held-out score', 'Created'].map((name) =>
        h(/Loss|score/.test(name) ? 'th.right' : 'th', { scope: 'col' }, name)))), h('tbody', {}, trainings.items.map(row))))
      : h('p.empty', {}, 'No training yet. A training teaches a controller by backpropagation through the simulation.'));
    fill(files, h('h2', {}, 'Controllers'), h('div.scroll', {}, h('table', {},
      h('thead', {}, h('tr', {}, ['Name', 'File', 'Parameters', 'Sensor', 'Parent', 'Stored'].map((name) => h('th', { scope: 'col' }, name)))),
      h('tbody', {}, named.map((one) => h('tr', {},
        h('td', {}, saveLink(`v1/controllers/${encodeURIComponent(one.name)}/file`, `${one.name}.safetensors`, one.name)),
        h('td', {}, h('code', {}, one.sha256.slice(0, 12)), h('span.muted', {}, ` ${bytes(one.bytes)}`)),
        h('td', {}, count(one.parameters)), h('td', {}, one.sensor), h('td', {}, String(one.metadata?.parent ?? '–').slice(0, 12)),
        h('td', {}, ago(one.stored_at))))))));
    return named.map(({ name }) => name);
  }

  const names = await refresh();
  main.replaceChildren(
    h('div.title', {}, h('h1', {}, 'Trainings'), h('div.actions', {}, compare,
      copyButton(() => ({ path: 'v1/trainings', morphoctl: 'train list\ncontroller list', python: 'print(m.request("GET", "/v1/trainings"))\nprint(m.controllers())' })),
      button('New training', () => startDialog(app, 'training'), { class: 'primary' }))),
    list, files, comparison(app, names));
  return {
    update(event) {
      if (event.type === 'reset' || event.type.startsWith('training.') || event.type.startsWith('controller.')) {
        refresh().catch(() => {});
      }
    },
  };
}

/** Two controllers on the same held-out bodies: the difference with its interval, and both side by side. */
function comparison(app, names) {
  let [a, b] = [names[0], names[1] ?? names[0]];
  const result = h('p', { 'aria-live': 'polite' });
  const player = new Player(app, { compact: true, height: 380 });
  const stage = h('div.panel.flush', { hidden: true }, player.element);

  async function compare() {
    result.textContent = 'Scoring both on the held-out bodies…';
    try {
      const { designs, environments } = await getJson('v1/held-out?seed=1&designs=16&environments=8');
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
      const differences = first.results.map((one, i) => second.results[i].score - one.score).filter(Number.isFinite);
      const mean = differences.reduce((sum, d) => sum + d, 0) / differences.length;
      const variance = differences.reduce((sum, d) => sum + (d - mean) ** 2, 0) / Math.max(1, differences.length - 1);
      const half = 1.96 * Math.sqrt(variance / differences.length);
      const better = mean + half < 0 ? `${b} is better` : mean - half > 0 ? `${a} is better` : 'no clear difference';
      result.textContent = `${b} minus ${a}: ${number(mean)} (95 % interval ${number(mean - half)} to ${number(mean + half)}, ` +
        `${differences.length} held-out bodies in ${environments.length} environments): ${better}.`;
      const [design] = designs;
      const [environment] = await environmentSet('paper-test');
      const robots = [];
      for (const controller of [a, b]) {
        const [robot] = await roll([design], [environment], { controller });
        robots.push({ ...robot, label: controller });
      }
      stage.hidden = false;
      player.setRobots(robots);
      player.setSide(true);
    } catch (error) {
      result.textContent = error.message;
    }
  }

  return h('section.panel.stack', {}, h('div.title', {}, h('h2', {}, 'Compare two controllers'), h('div.actions', {},
    select('First', names, a, (value) => { a = value; }), select('Second', names, b, (value) => { b = value; }),
    button('Compare', compare))), result, stage);
}

async function mountOne(main, id, parameters, app) {
  const stop = new AbortController();
  const get = (url) => getJson(url, { signal: stop.signal });
  const others = (parameters.get('compare') ?? '').split(',').filter(Boolean).slice(0, 3);
  const ids = [id, ...others];
  const steps = ids.map((one) => new Curve(`v1/trainings/${one}/steps`));
  const validations = ids.map((one) => new Curve(`v1/trainings/${one}/validations`));
  const head = h('section.panel.stack');
  const loss = new Chart({ title: 'Mean loss of the batch', xName: 'step', log: true, height: 280, empty: 'No step has ended yet.' });
  const held = new Chart({ title: 'Held-out score, with its standard error', xName: 'step', log: true, height: 280, empty: 'No validation yet.' });
  const norm = new Chart({ title: 'Gradient norm', xName: 'step', log: true });
  const clipped = new Chart({ title: 'Share of clipped adjoints', xName: 'step', minimum: 0 });
  const charts = [loss, held, norm, clipped];
  main.replaceChildren(head, h('div.grid', {}, charts.map((chart) => chart.element)));

  async function showHead() {
    const item = await get(`v1/trainings/${id}`);
    const job = { ...item, trainingKind: item.kind, kind: 'training' };
    fill(head, h('div.title', {}, h('h1', {}, titleOf(job)), h('span.muted', {}, `${job.trainingKind}, into ${job.name ?? 'no name'}`),
      stateChip(job), h('div.actions', {},
        saveLink(`v1/trainings/${id}/steps?format=csv`, `training-${id}.csv`, 'Export', { class: 'button' }),
        copyButton(() => ({
          path: `v1/trainings/${id}`, morphoctl: `train show ${id}\ntrain watch ${id}`,
          python: `training = m.training(${id})\nprint(training.steps())\nprint(training.validations())`,
        })))),
    progressBar(job), trouble(job), h('div.row', {}, actions(job, showHead), weightField(job, showHead),
      job.progress.bodies_per_s ? h('span.muted', {}, `${number(job.progress.bodies_per_s)} bodies a second`) : null));
  }

  const column = (rows, take) => Float64Array.from(rows, (row) => take(row) ?? NaN);
  function showCharts() {
    const each = (curves, name) => curves.map((curve, i) => ({
      name: ids.length > 1 ? `training ${ids[i]}` : name.replaceAll('_', ' '), color: HUES[i],
      x: column(curve.rows, (row) => row.step), y: column(curve.rows, (row) => row[name]),
    }));
    loss.set(each(steps, 'mean_loss'));
    norm.set(each(steps, 'gradient_norm'));
    clipped.set(each(steps, 'clipped_share'));
    held.set(validations.flatMap((curve, i) => {
      const x = column(curve.rows, (row) => row.step);
      const bound = (sign) => column(curve.rows, (row) => (row.mean_score === null ? null : row.mean_score + sign * (row.standard_error ?? 0)));
      return [
        { name: 'standard error', kind: 'band', silent: true, x, y: x, low: bound(-1), high: bound(1), color: HUES[i], opacity: 0.2 },
        { name: ids.length > 1 ? `training ${ids[i]}` : 'held-out score', x, y: column(curve.rows, (row) => row.mean_score), color: HUES[i] },
      ];
    }));
  }

  async function refresh() {
    await Promise.all([showHead(), ...[...steps, ...validations].map((curve) => curve.refresh(stop.signal))]);
    showCharts();
  }

  await refresh();
  let pending = null;
  return {
    update(event) {
      if (event.type !== 'reset' && event.job !== id && !others.includes(event.job)) return;
      pending ??= setTimeout(() => {
        pending = null;
        refresh().catch(() => {});
      }, 500);
    },
    unmount() {
      clearTimeout(pending);
      stop.abort();
      charts.forEach((chart) => chart.destroy());
    },
  };
}
