/** The overview: the health of the service, its work, its progress, and recent events. */

import { getJson, shared, withQuery } from '../lib/api.js';
import { Chart } from '../lib/chart.js';
import { choice, h, patch, patchRow, say, table as tableOf, tile } from '../lib/dom.js';
import { factsOf, knownFacts } from '../lib/facts.js';
import { ago, bytes, count, duration, number, percent, score } from '../lib/format.js';
import { kindOf, linkOf, pathOf, titleOf } from '../lib/kinds.js';
import { may } from '../lib/rights.js';
import { environmentsOfCampaign } from '../lib/rollouts.js';
import { measureOf, meters, taskNameOf, worldsOfTraining } from '../lib/tasks.js';
import { copyButton } from './share.js';
import { JobParts } from './jobs.js';
import { COLUMNS, cellsOf } from './run_rows.js';
import { startButton } from './start_buttons.js';

const REFRESH_MS = 2000;
const LOAD_S = 3600;
/** Rows of the table, and jobs whose titles events use. */
const [NEWEST, TITLES] = [10, 100];

export async function mount(main, path, parameters, app) {
  const stop = new AbortController();
  const get = (url) => getJson(url, { signal: stop.signal });
  const tiles = h('section.tiles', { 'aria-label': 'The service' });
  const running = h('section.grid', { 'aria-label': 'Running jobs' });
  const events = h('tbody');
  const load = new Chart({
    title: 'Load over the last hour', xName: 'minutes ago', height: 150, minimum: 0, maximum: 1,
    isWhole: false, xRange: [-LOAD_S / 60, 0], xText: (x) => number(-x), yText: percent,
    empty: 'The first samples appear within seconds.',
  });
  const jobRows = h('tbody');
  const titles = new Map(); // of the listed jobs, by id
  let by = 'experiment';
  const usage = h('tbody');
  const groupings = ['experiment', 'label', 'submitted_by', 'kind']
    .map((name) => [name, name.replace('_', ' ')]);
  const usageBy = choice('Usage by', groupings, by, (value) => {
    by = value;
    showUsage();
  });
  const none = h('p.empty');

  main.replaceChildren(
    h('div.title', {}, h('h1', {}, 'Service'), h('div.actions', {},
      ['evaluation', 'training', 'campaign'].map((kind) =>
        startButton(app, kind, kind === 'campaign' ? { class: 'primary' } : {})),
      copyButton(() => ({
        path: 'v1/jobs', morphoctl: 'job list', python: 'print(m.jobs())',
      })))),
    tiles, running,
    h('div.grid', {}, load.element,
      h('section.panel', { 'aria-label': 'Newest events' }, h('h2', {}, 'Newest events'),
        h('div.scroll', {}, h('table', {}, events)))),
    h('section.panel.stack', {},
      h('div.title', {}, h('h2', {}, 'Newest runs'), h('a', { href: '#/runs' }, 'all runs')),
      h('div.scroll', {}, tableOf(Object.values(COLUMNS).map(({ name }) => name), jobRows,
        (name, i) => Object.values(COLUMNS)[i].isRight, 'table.cards.jobs.runs')), none),
    h('section.panel.stack', { 'aria-label': 'Usage' },
      h('div.title', {}, h('h2', {}, 'Usage'), h('div.actions', {}, usageBy)),
      h('div.scroll', {}, tableOf(['Name', 'Jobs', 'Core time', 'Device time'], usage,
        (name, i) => i > 0, 'table'))));

  async function showUsage() {
    const { items } = await get(withQuery('v1/usage', { by, limit: 20 }));
    const rows = items.length ? items.map((row) => ({ key: row.name ?? '', cells: [
      h('td', {}, row.name ?? '–'), h('td.right', {}, count(row.jobs)),
      h('td.right', {}, duration(row.core_seconds)),
      h('td.right', {}, duration(row.device_seconds))] }))
      : [{ key: 'none', cells: [h('td.empty', { colspan: 4 }, 'No jobs yet.')] }];
    showRows(usage, rows);
  }

  function showEvents() {
    const news = app.recent.slice(-6).reverse();
    showRows(events, news.length ? news.map((event) => ({ key: event.id, cells: [
      h('td', {}, linkTo(event, titles), h('div.muted', {}, nameOf(event))),
      h('td', {}, detailOf(event)),
      h('td.right.muted', {}, ago(event.at))] }))
      : app.knowsRecent
      ? [{ key: 'none', cells: [h('td.empty', {}, 'Nothing has happened yet.')] }] : []);
  }

  function showTiles(health, threads, devices) {
    const waiting = threads.queued_batch + threads.queued_interactive;
    const all = [
      ['Service', health.status, health.notice ?? `version ${health.version}`],
      ['Threads', `${threads.n_busy} of ${threads.n_threads}`,
        threads.n_busy ? 'computing' : 'idle'],
      ['Rollouts', count(threads.rollouts_done), 'since the service started'],
      ['Queue', count(waiting), `${waiting === 1 ? 'block' : 'blocks'} of rollouts to compute`],
      ...devices.items.map((device) => [device.name, percent(device.load),
        device.error ?? `${bytes(device.free_bytes)} of ${bytes(device.memory_bytes)} free`]),
    ];
    patch(tiles, all, ([name]) => name, (one) => tile(...one), (element, values) =>
      values.forEach((text, i) => say(element.children[i], String(text))));
  }

  function showRunning(jobs) {
    patch(running, jobs, ({ id }) => id, runningCard, (card, job) => card.show(job));
    running.hidden = jobs.length === 0;
  }

  function runningCard() {
    const parts = new JobParts(() => refresh());
    const { chip, bar, trouble, actions, weightField, rate } = parts;
    const link = h('a');
    const about = h('p.muted');
    const card = h('article.panel.stack', {}, h('div.title', {}, h('h2', {}, link), chip), about,
      bar, trouble, h('div.row', {}, actions, weightField, rate));
    return Object.assign(card, { show(job) {
      parts.update(job);
      say(about, job.about);
      about.hidden = !job.about;
      link.href = linkOf(job);
      say(link, titleOf(job));
    } });
  }

  /** Loads the job with its phase, rate and time left, which the list omits. */
  async function whole(job) {
    const full = await get(pathOf(job));
    return { ...full, kind: job.kind, about: await aboutOf(job.kind, full) };
  }

  /** Describes what a job does: its task, and a campaign's best score in the unit of the task. */
  async function aboutOf(kind, job) {
    if (kind === 'training') return worldsOfTraining(job);
    if (!job.settings) return job.suite ? `all tasks of ${job.suite.name}` : '';
    const environments = await environmentsOfCampaign(job);
    const name = taskNameOf(job.settings.environments, environments);
    const best = job.newest?.score.quantiles.p0 ?? null;
    if (best === null || job.own_score) return name;
    const measure = measureOf(environments);
    return `${name}: best ${measure ? meters(measure.valueOf(best)) : score(best)}`;
  }

  async function showLoad() {
    const { items } = await get(`v1/load?seconds=${LOAD_S}`);
    const x = items.map((sample) => -sample.age_s / 60);
    const y = items.map((sample) => sample.busy_share);
    load.set([{ name: 'busy threads', x, y, color: '--blue' }]);
  }

  async function showJobs() {
    const { items } = await get(`v1/jobs?limit=${TITLES}`);
    items.forEach((job) => titles.set(job.id, titleOf(job)));
    const newest = items.slice(0, NEWEST);
    const draw = () => showRows(jobRows, newest.map((job) =>
      ({ key: job.id, cells: cellsOf({ key: job.id, job }).slice(1) })));
    draw();
    Promise.all(newest.map((job) => knownFacts(job) || factsOf(job, stop.signal)))
      .then(draw, () => {}); // the next refresh retries
    none.hidden = items.length > 0;
    say(none, `No jobs yet.${may('submit') ? ' Start one above, or with morphoctl.' : ''}`);
  }

  const refresh = shared(() => Promise.all([
    Promise.all([get('readyz').catch((error) => ({ status: error.message, version: '' })),
      get('v1/threads'), get('v1/devices')]).then((all) => showTiles(...all)),
    get('v1/jobs?state=running&limit=12').then((page) => Promise.all(page.items.map(whole)))
      .then(showRunning),
    showJobs(), showLoad(), showUsage(),
  ]));

  await refresh();
  showEvents();
  const timer = setInterval(() => {
    if (!document.hidden) refresh().catch(() => {});
  }, REFRESH_MS);
  return {
    update(event) {
      showEvents();
      if (event.type === 'reset' || event.type.startsWith('job.')) refresh().catch(() => {});
    },
    unmount() {
      clearInterval(timer);
      stop.abort();
      load.destroy();
    },
  };
}

/** Shows rows by their keys; cells that differ are replaced. */
function showRows(body, rows) {
  patch(body, rows, ({ key }) => key, () => h('tr'), (row, { cells }) => patchRow(row, cells));
}

/** Describes the kind of an event. */
const nameOf = ({ type }) => type.replace('.', ': ').replaceAll('_', ' ');

/** Returns a link to the job of an event: its kind is in the event, or in the name of its type. */
function linkTo({ type, job, data }, titles) {
  if (type.startsWith('fleet.')) return h('a', { href: '#/machines' }, data.name ?? 'machines');
  if (!job) return '';
  const kind = data.kind ?? type.split('.')[0];
  const name = titles.get(job) ?? `${kind} ${job}`;
  return kindOf({ kind }) ? h('a', { href: linkOf({ kind, id: job }) }, name) : `job ${job}`;
}

function detailOf({ type, data }) {
  if (type === 'campaign.generation') {
    return `generation ${data.generation}: best ${number(data.best)}`;
  }
  if (type === 'training.validation') return `step ${data.step}: ${number(data.mean_score)}`;
  if (type === 'controller.stored') return data.name ?? '';
  if (type === 'job.warning') return data.detail;
  if (type.startsWith('fleet.')) return data.why ?? data.class ?? data.host ?? '';
  return data.state ?? '';
}
