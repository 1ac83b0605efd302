/** The overview: is the service well, what does it do, how far is it, and what happened. */

import { getJson, shared, withQuery } from '../lib/api.js';
import { Chart } from '../lib/chart.js';
import { button, fill, h, table as tableOf, tile } from '../lib/dom.js';
import { ago, bytes, count, duration, number, percent, shellWord } from '../lib/format.js';
import { may } from '../lib/rights.js';
import { startButton } from './forms.js';
import { copyButton } from './share.js';
import { JobTable, actions, progressBar, stateChip, titleOf, trouble, weightField, linkOf } from './jobs.js';

const REFRESH_MS = 2000;

export async function mount(main, path, parameters, app) {
  const stop = new AbortController();
  const get = (url) => getJson(url, { signal: stop.signal });
  const tiles = h('section.tiles', { 'aria-label': 'The service' });
  const running = h('section.grid', { 'aria-label': 'Running jobs' });
  const events = h('tbody');
  const load = new Chart({
    title: 'Load of the last hour', xName: 'minutes ago', height: 150, minimum: 0, maximum: 1, isWhole: false,
    xText: (x) => number(-x), yText: percent, empty: 'The first samples come within seconds.',
  });
  let state = parameters.get('state') ?? '';
  const table = new JobTable(() => refresh());
  const states = ['', 'queued', 'running', 'paused', 'succeeded', 'failed', 'cancelled'];
  /** A choice without a visible name. */
  const choice = (label, choices, value, chosen) =>
    h('select', { 'aria-label': label, onchange: (event) => chosen(event.target.value) },
      choices.map(([key, text]) => h('option', { value: key, selected: key === value }, text)));
  const filter = choice('State of the jobs', states.map((name) => [name, name || 'all states']), state, (value) => {
    state = value;
    app.keep({ state });
    refresh();
  });
  let search = parameters.get('label') ?? '';
  let archived = parameters.get('archived') ?? '';
  const searched = h('input', { type: 'search', value: search, placeholder: 'label begins with', 'aria-label': 'Labels that begin with',
    oninput: (event) => {
      search = event.target.value;
      app.keep({ label: search });
      refresh();
    } });
  const archive = choice('Archived jobs', [['', 'not archived'], ['true', 'archived'], ['all', 'archived, too']], archived, (value) => {
    archived = value;
    app.keep({ archived });
    refresh();
  });
  /** What the list is filtered by, as the contract names it. */
  const filters = () => ({ state, label: search && `${search}*`, archived });
  let by = 'experiment';
  const usage = h('tbody');
  const usageBy = choice('Use by', ['experiment', 'label', 'submitted_by', 'kind'].map((name) => [name, name.replace('_', ' ')]), by, (value) => {
    by = value;
    showUsage();
  });
  const more = h('div.row');
  let wanted = 100;

  main.replaceChildren(
    h('div.title', {}, h('h1', {}, 'Overview'), h('div.actions', {},
      ['evaluation', 'training', 'campaign'].map((kind) =>
        startButton(app, kind, kind === 'campaign' ? { class: 'primary' } : {})),
      copyButton(() => ({
        path: withQuery('v1/jobs', filters()),
        morphoctl: `job list${Object.entries(filters()).map(([name, value]) => (value ? ` --${name} ${shellWord(value)}` : '')).join('')}`,
        python: `print(m.jobs(${Object.entries(filters()).filter(([, value]) => value).map(([name, value]) =>
          `${name}=${JSON.stringify(value)}`).join(', ')}))`,
      })))),
    tiles, running,
    h('div.grid', {}, load.element,
      h('section.panel', { 'aria-label': 'Newest events' }, h('h2', {}, 'Newest events'),
        h('div.scroll', {}, h('table', {}, events)))),
    h('section.panel.stack', {}, h('div.title', {}, h('h2', {}, 'Jobs'), h('div.actions', {}, searched, filter, archive)),
      table.element, more),
    h('section.panel.stack', { 'aria-label': 'Use' }, h('div.title', {}, h('h2', {}, 'Use of cores and devices'), h('div.actions', {}, usageBy)),
      h('div.scroll', {}, tableOf(['Name', 'Jobs', 'Core time', 'Device time'], usage, (name, i) => i > 0, 'table'))));

  async function showUsage() {
    const { items } = await get(withQuery('v1/usage', { by, limit: 20 }));
    fill(usage, items.length ? items.map((row) => h('tr', {}, h('td', {}, row.name ?? '–'), h('td.right', {}, count(row.jobs)),
      h('td.right', {}, duration(row.core_seconds)), h('td.right', {}, duration(row.device_seconds))))
      : h('tr', {}, h('td.empty', {}, 'No job yet.')));
  }

  function showEvents() {
    const rows = app.recent.slice(-6).reverse();
    fill(events, rows.length ? rows.map((event) => h('tr', {},
      h('td', {}, linkTo(event), h('div.muted', {}, event.type)), h('td', {}, detailOf(event)), h('td.right.muted', {}, ago(event.at))))
      : h('tr', {}, h('td.empty', {}, 'Nothing has happened yet.')));
  }

  function showTiles(health, threads, devices) {
    fill(tiles,
      tile('Service', health.status === 'ready' ? 'ready' : health.status, `version ${health.version}`),
      tile('Threads', `${threads.n_busy} of ${threads.n_threads}`, threads.n_busy ? 'computing' : 'idle'),
      tile('Rollouts', count(threads.rollouts_done), 'since the service started'),
      tile('Waiting', count(threads.queued_batch + threads.queued_interactive), 'blocks of rollouts'),
      devices.items.map((device) => tile(device.name, percent(device.load),
        device.error ?? `${bytes(device.free_bytes)} of ${bytes(device.memory_bytes)} free`)));
  }

  function showRunning(jobs) {
    fill(running, jobs.map((job) => h('article.panel.stack', {},
      h('div.title', {}, h('h2', {}, h('a', { href: linkOf(job) }, titleOf(job))), stateChip(job)),
      progressBar(job), trouble(job),
      h('div.row', {}, actions(job, () => refresh()), weightField(job, () => refresh()),
        rateOf(job) ? h('span.muted', {}, rateOf(job)) : null))));
    running.hidden = jobs.length === 0;
  }

  /** The job with its rate and time left, which the list does not tell. */
  async function whole(job) {
    const full = await get(`v1/${job.kind}s/${job.id}`);
    return { ...full, kind: job.kind };
  }

  async function showLoad() {
    const { items } = await get('v1/load?seconds=3600');
    const x = items.map((sample) => -sample.age_s / 60);
    load.set([{ name: 'busy threads', x, y: items.map((sample) => sample.busy_share), color: '--blue' }]);
  }

  async function showJobs() {
    const jobs = [];
    let cursor;
    do {
      const page = await get(withQuery('v1/jobs', { ...filters(), limit: Math.min(1000, wanted - jobs.length), cursor }));
      jobs.push(...page.items);
      cursor = page.next_cursor;
    } while (cursor !== null && jobs.length < wanted);
    table.set(jobs);
    if (!jobs.length) {
      fill(more, h('p.empty', {}, search || archived ? 'No job is like that.' : state ? `No job is ${state}.` : `No job yet.${may('submit') ? ' Start one above, or with morphoctl.' : ''}`));
    } else {
      fill(more, cursor === null ? null : button('Show more', () => {
        wanted += 1000;
        refresh();
      }), h('span.muted', {}, `${count(jobs.length)} ${jobs.length === 1 ? 'job' : 'jobs'} shown`));
    }
  }

  const refresh = shared(() => Promise.all([
    Promise.all([get('readyz').catch((error) => ({ status: error.message, version: '' })), get('v1/threads'),
      get('v1/devices')]).then((all) => showTiles(...all)),
    get('v1/jobs?state=running&limit=12').then((page) => Promise.all(page.items.map(whole))).then(showRunning),
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

function rateOf(job) {
  const rate = job.progress?.rollouts_per_s ?? job.progress?.bodies_per_s;
  if (!rate) return '';
  return job.kind === 'training' ? `${number(rate)} bodies a second` : `${number(rate)} rollouts a second`;
}

/** A link to the job of an event; its kind is in the event, or in the name of its type. */
function linkTo({ type, job, data }) {
  if (type.startsWith('fleet.')) return h('a', { href: '#/machines' }, data.name ?? 'machines');
  if (!job) return '';
  const kind = data.kind ?? type.split('.')[0];
  const known = ['evaluation', 'training', 'campaign'].includes(kind);
  return known ? h('a', { href: linkOf({ kind, id: job }) }, `${kind} ${job}`) : `job ${job}`;
}

function detailOf({ type, data }) {
  if (type === 'campaign.generation') return `generation ${data.generation}: best ${number(data.best)}`;
  if (type === 'training.validation') return `step ${data.step}: ${number(data.mean_score)}`;
  if (type === 'controller.stored') return data.name ?? '';
  if (type.startsWith('fleet.')) return data.why ?? data.class ?? data.host ?? '';
  return data.state ?? '';
}
