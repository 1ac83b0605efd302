/** The overview: the health of the service, its work, its progress, and recent events. */

import { LinkError, getJson, shared, withQuery } from '../lib/api.js';
import { Chart } from '../lib/chart.js';
import { button, fill, h, patch, patchRow, say, table as tableOf, tile } from '../lib/dom.js';
import {
  ago, bytes, count, countOf, duration, number, percent, score, shellWord,
} from '../lib/format.js';
import { linkOf, titleOf } from '../lib/kinds.js';
import { may } from '../lib/rights.js';
import { environmentsOfCampaign } from '../lib/rollouts.js';
import { measureOf, meters, taskNameOf, worldsOfTraining } from '../lib/tasks.js';
import { startButton } from './forms.js';
import { copyButton } from './share.js';
import { JobTable } from './job_table.js';
import { JobParts } from './jobs.js';

const REFRESH_MS = 2000;
const LOAD_S = 3600;
const STATES = ['', 'queued', 'running', 'paused', 'succeeded', 'failed', 'cancelled'];
const ARCHIVES = [['', 'not archived'], ['true', 'archived'], ['all', 'including archived']];

export async function mount(main, path, parameters, app) {
  const stop = new AbortController();
  const get = (url) => getJson(url, { signal: stop.signal });
  const tiles = h('section.tiles', { 'aria-label': 'The service' });
  const running = h('section.grid', { 'aria-label': 'Running jobs' });
  const events = h('tbody');
  const load = new Chart({
    title: 'Load of the last hour', xName: 'minutes ago', height: 150, minimum: 0, maximum: 1,
    isWhole: false, xRange: [-LOAD_S / 60, 0], xText: (x) => number(-x), yText: percent,
    empty: 'The first samples come within seconds.',
  });
  let state = choiceIn(parameters, 'state', STATES);
  const table = new JobTable(() => refresh());
  /** Returns a selection without a visible name. */
  const choice = (label, choices, value, chosen) =>
    h('select', { 'aria-label': label, onchange: (event) => chosen(event.target.value) },
      choices.map(([key, text]) => h('option', { value: key, selected: key === value }, text)));
  const offered = STATES.map((name) => [name, name || 'all states']);
  const filter = choice('State of the jobs', offered, state, (value) => {
    state = value;
    app.keep({ state });
    refresh();
  });
  let search = parameters.get('label') ?? '';
  let archived = choiceIn(parameters, 'archived', ARCHIVES.map(([key]) => key));
  const searched = h('input', {
    type: 'search', value: search, placeholder: 'label begins with',
    'aria-label': 'Labels that begin with',
    oninput: (event) => {
      search = event.target.value;
      app.keep({ label: search });
      refresh();
    } });
  const archive = choice('Archived jobs', ARCHIVES, archived, (value) => {
    archived = value;
    app.keep({ archived });
    refresh();
  });
  /** The filters of the list, with the names in the contract. */
  const filters = () => ({ state, label: search && `${search}*`, archived });
  const given = () => Object.entries(filters()).filter(([, value]) => value);
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
  const shown = h('span.muted');
  const showMore = button('Show more', () => {
    wanted += 1000;
    refresh();
  });
  const more = h('div.row', {}, none, showMore, shown);
  let wanted = 100;

  main.replaceChildren(
    h('div.title', {}, h('h1', {}, 'Service'), h('div.actions', {},
      ['evaluation', 'training', 'campaign'].map((kind) =>
        startButton(app, kind, kind === 'campaign' ? { class: 'primary' } : {})),
      copyButton(() => ({
        path: withQuery('v1/jobs', filters()),
        morphoctl: ['job list',
          ...given().map(([name, value]) => `--${name} ${shellWord(value)}`)].join(' '),
        python: `print(m.jobs(${
          given().map(([name, value]) => `${name}=${JSON.stringify(value)}`).join(', ')}))`,
      })))),
    tiles, running,
    h('div.grid', {}, load.element,
      h('section.panel', { 'aria-label': 'Newest events' }, h('h2', {}, 'Newest events'),
        h('div.scroll', {}, h('table', {}, events)))),
    h('section.panel.stack', {},
      h('div.title', {}, h('h2', {}, 'Jobs'), h('div.actions', {}, searched, filter, archive)),
      table.element, more),
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
      : [{ key: 'none', cells: [h('td.empty', {}, 'Nothing has happened yet.')] }]);
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
    const full = await get(`v1/${job.kind}s/${job.id}`);
    return { ...full, kind: job.kind, about: await aboutOf(job.kind, full) };
  }

  /** Describes what a job does: its task, and a campaign's best score in the unit of the task. */
  async function aboutOf(kind, job) {
    if (kind === 'training') return worldsOfTraining(job);
    if (kind === 'evaluation') {
      return job.suite ? `all tasks of ${job.suite.name}` : '';
    }
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
    const jobs = [];
    let cursor;
    do {
      const limit = Math.min(1000, wanted - jobs.length);
      const page = await get(withQuery('v1/jobs', { ...filters(), limit, cursor }));
      jobs.push(...page.items);
      cursor = page.next_cursor;
    } while (cursor !== null && jobs.length < wanted);
    table.set(jobs);
    jobs.forEach((job) => titles.set(job.id, titleOf(job)));
    none.hidden = jobs.length > 0;
    shown.hidden = !none.hidden;
    showMore.hidden = cursor === null;
    const start = may('submit') ? ' Start one above, or with morphoctl.' : '';
    say(none, search || archived ? 'No jobs match.' : state ? `No jobs are ${state}.`
      : `No jobs yet.${start}`);
    say(shown, `${countOf(jobs.length, 'job')} shown`);
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
      table.destroy();
      load.destroy();
    },
  };
}

/** A choice that the link contains. @param {string[]} choices */
function choiceIn(parameters, name, choices) {
  const value = parameters.get(name) ?? '';
  if (choices.includes(value)) return value;
  const names = choices.filter(Boolean).join(', ');
  throw new LinkError(`${name}=${value}: one of ${names} is expected.`);
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
  const known = ['evaluation', 'training', 'campaign'].includes(kind);
  const name = titles.get(job) ?? `${kind} ${job}`;
  return known ? h('a', { href: linkOf({ kind, id: job }) }, name) : `job ${job}`;
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
