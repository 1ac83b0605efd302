/** Runs: one table of the jobs of all kinds. */

import { LinkError, getJson, withQuery } from '../lib/api.js';
import { commandsOf } from '../lib/commands.js';
import { button, choice, h, patchRow, say } from '../lib/dom.js';
import { coalesced, isNews } from '../lib/events.js';
import { factsOf, knownFacts } from '../lib/facts.js';
import { countOf, shellWord } from '../lib/format.js';
import { KINDS, groupOf, isMoving, linkOf } from '../lib/kinds.js';
import { may } from '../lib/rights.js';
import { LazyRows } from '../lib/rows.js';
import { RunList } from '../lib/run_list.js';
import { RunActions } from './run_actions.js';
import { COLUMNS, cellsOf, jobsOf, rowsOf } from './run_rows.js';
import { commandSections, showDialog } from './share.js';
import { startButton } from './start_buttons.js';

const STATES = ['queued', 'running', 'paused', 'succeeded', 'failed', 'cancelled'];
const ARCHIVES = [['', 'not archived'], ['true', 'archived'], ['all', 'including archived']];
/** Number of rows shown at first, and added by each "Show more". */
const [FIRST, MORE] = [100, 1000];
const POLL_MS = 2000;

/** Reads what the link requests. */
function readLink(parameters) {
  const of = (name, choices) => {
    const value = parameters.get(name) ?? '';
    if (!value || choices.includes(value)) return value;
    throw new LinkError(`${name}=${value}; expected one of ${choices.join(', ')}.`);
  };
  return {
    search: parameters.get('search') ?? '', kind: of('kind', Object.keys(KINDS)),
    state: of('state', STATES), experiment: parameters.get('experiment') ?? '',
    archived: of('archived', ['true', 'all']), sort: of('sort', Object.keys(COLUMNS)),
    order: of('order', ['ascending', 'descending']),
  };
}

export async function mount(main, [id], parameters, app) {
  const stop = new AbortController();
  const get = (url) => getJson(url, { signal: stop.signal });
  if (id) { // #/runs/12: the page of a job of any kind
    location.replace(linkOf(await get(`v1/jobs/${encodeURIComponent(id)}`)));
    return {};
  }
  const asked = readLink(parameters);
  const { items: usage } = await get('v1/usage?by=experiment&limit=1000');
  const list = new RunList(stop.signal);
  let wanted = FIRST;
  let refusal = ''; // why the newest list is not shown
  const opened = new Set(); // groups with visible replicates
  const chosen = new Set(app.remembered().runs); // ids

  const filters = () => RunList.filters(asked);
  const given = () => Object.entries(filters()).filter(([, value]) => value);

  // ---- the head ----

  const change = (name) => (value) => {
    asked[name] = value;
    app.keep({ [name]: value });
    wanted = FIRST;
    return reload();
  };
  const filter = (label, name, choices) => choice(label, choices, asked[name], change(name));
  const experiments = [...new Set([...usage.map(({ name }) => name), asked.experiment])]
    .filter(Boolean).sort();
  let typing;
  const searched = h('input', {
    type: 'search', value: asked.search, placeholder: 'label contains', maxlength: 200,
    'aria-label': 'Labels that contain', oninput: () => {
      clearTimeout(typing);
      typing = setTimeout(() => change('search')(searched.value), 200);
    } });
  const order = h('select', { 'aria-label': 'Order', class: 'narrow', onchange: () => {
    const [sort, direction] = order.value.split(' ');
    sortBy(sort, direction);
  } }, h('option', { value: '' }, 'newest first'),
  Object.entries(COLUMNS).flatMap(([key, { name }]) => ['ascending', 'descending'].map((way) =>
    h('option', { value: `${key} ${way}` }, `${name}, ${way}`))));
  const actions = new RunActions(app, () => reload(), () => {
    chosen.clear();
    showChosen();
  });

  // ---- the table ----

  const body = h('tbody');
  const all = h('input', { type: 'checkbox', 'aria-label': 'Select all shown',
    onchange: () => {
      for (const one of list.items) {
        if (all.checked) chosen.add(one.id);
        else chosen.delete(one.id);
      }
      showChosen();
    } });
  const heads = Object.entries(COLUMNS).map(([key, { name, isRight }]) =>
    h(isRight ? 'th.right' : 'th', { scope: 'col', 'data-sort': key },
      button(name, () => {
        const isSame = asked.sort === key;
        if (isSame && asked.order === 'descending') sortBy('', '');
        else sortBy(key, isSame ? 'descending' : 'ascending');
      }, { class: 'sort' })));
  const panel = h('div.scroll', {}, h('table.cards.jobs.runs', {},
    h('thead', {}, h('tr', {}, h('th', { scope: 'col' }, all), heads)), body));
  const rows = new LazyRows(body, ({ key }) => key, (element, row) => draw(element, row));
  const none = h('p.empty');
  const shown = h('span.muted', { role: 'status' });
  const more = button('Show more', () => {
    wanted = Math.max(wanted, list.scanned) + MORE; // sorting reads more than was requested
    reload();
  });
  const rowOf = (key) => rows.items.get(key);

  function draw(element, row) {
    patchRow(element, cellsOf(row, {
      isOpen: Boolean(row.members) && opened.has(groupOf(row.job).id),
      toggle: () => toggle(groupOf(rowOf(row.key).job).id),
      choose: (isChosen) => {
        for (const one of jobsOf(rowOf(row.key))) {
          if (isChosen) chosen.add(one.id);
          else chosen.delete(one.id);
        }
        showChosen();
      },
    }));
    mark(element);
    const unknown = jobsOf(row).filter((job) => !knownFacts(job));
    if (unknown.length && !row.isAsked) {
      row.isAsked = true;
      const { signal } = list.turn;
      Promise.all(unknown.map((job) => factsOf(job, signal))).then(() => {
        if (!stop.signal.aborted && rowOf(row.key) === row) rows.redraw(row.key);
      }, () => {}); // the next refresh retries
    }
  }

  /** Checks the box of a row whose jobs are selected. */
  function mark(element) {
    const jobs = jobsOf(rowOf(element.rowKey));
    const box = element.querySelector('input[type=checkbox]');
    const n = jobs.filter((job) => chosen.has(job.id)).length;
    box.checked = n === jobs.length;
    box.indeterminate = n > 0 && n < jobs.length;
  }

  function toggle(group) {
    if (!opened.delete(group)) opened.add(group);
    show();
    body.querySelector(`[data-group="${group}"]`)?.focus();
  }

  function showChosen() {
    const { items } = list;
    for (const id of chosen) if (!items.some((one) => one.id === id)) chosen.delete(id);
    const jobs = items.filter((one) => chosen.has(one.id));
    all.checked = jobs.length > 0 && jobs.length === items.length;
    all.indeterminate = jobs.length > 0 && !all.checked;
    for (const element of body.children) if (element.isDrawn) mark(element);
    actions.set(jobs);
    app.remember({ runs: [...chosen] });
  }

  function sortBy(sort, direction) {
    Object.assign(asked, { sort, order: direction });
    app.keep({ sort, order: direction });
    reload();
  }

  function show() {
    const { items, isCut, scanned } = list;
    rows.set(rowsOf(items, opened, asked.sort, asked.order === 'descending'));
    for (const head of heads) {
      if (head.dataset.sort === asked.sort) head.setAttribute('aria-sort', asked.order);
      else head.removeAttribute('aria-sort');
    }
    order.value = asked.sort ? `${asked.sort} ${asked.order}` : '';
    const isFiltered = given().length > 0 || asked.kind;
    panel.hidden = items.length === 0;
    none.hidden = !panel.hidden || Boolean(refusal);
    say(none, isFiltered ? 'No jobs match.'
      : `No jobs yet.${may('submit') ? ' Start one above, or with morphoctl.' : ''}`);
    more.hidden = !isCut;
    say(shown, refusal || (!items.length ? '' : !isCut ? countOf(items.length, 'run')
      : asked.sort || KINDS[asked.kind]?.only
        ? `Only the newest ${countOf(scanned, 'matching job')} ` +
          `${asked.sort ? 'were read and sorted' : 'were read'}. Add filters to narrow the list.`
        : `the newest ${countOf(items.length, 'run')}`));
    shown.classList.toggle('error', Boolean(refusal));
    showChosen();
  }

  /** @param {() => void} [listed] called once only facts of the jobs are missing */
  async function refresh(listed) {
    const { name, needsFacts = false } = COLUMNS[asked.sort] ?? {};
    const isDone = await list.load(asked, wanted, needsFacts, (n) => {
      refusal = '';
      shown.classList.remove('error');
      say(shown, `Reading ${n} runs to sort them by ${name.toLowerCase()}…`);
      listed?.();
    });
    if (!isDone) return;
    refusal = '';
    show();
  }

  /** Refreshes the rows, or explains why the old ones are still shown. */
  async function reload() {
    try {
      await refresh();
    } catch (error) {
      refusal = `The list could not be refreshed and may be out of date: ${error.message}`;
      show();
    }
  }

  /** Shows commands that list the same jobs. */
  function showCommands() {
    const { kind } = asked;
    const of = given().map(([name, value]) => `${name}=${JSON.stringify(value)}`).join(', ');
    const isStudies = Boolean(KINDS[kind]?.only);
    // morphoctl cannot list only the evaluations or only the studies.
    const listOf = { '': 'job list', training: 'train list', campaign: 'campaign list' }[kind];
    showDialog('The same from a shell or a program', isStudies
      ? h('p', {}, 'Studies are campaigns with the mode “study”; the service lists all campaigns.')
      : null,
    ...commandSections(commandsOf({
      path: withQuery('v1/jobs', filters()),
      morphoctl: listOf ? [listOf, ...given().filter(([name]) => name !== 'kind')
        .map(([name, value]) => `--${name} ${shellWord(value)}`)].join(' ') : null,
      python: asked.search ? undefined // jobs() does not have a search
        : isStudies ? `jobs = m.jobs(${of})\nprint(jobs[jobs["campaign_mode"] == "study"])`
        : `print(m.jobs(${of}))`,
    })));
  }

  main.replaceChildren(h('div.title', {}, h('h1', {}, 'Runs'), h('div.actions', {},
    ['evaluation', 'training', 'campaign'].map((kind) =>
      startButton(app, kind, kind === (asked.kind || 'campaign') ? { class: 'primary' } : {})),
    button('Commands', showCommands, { title: 'The same with curl, morphoctl or Python' }))),
  h('section.panel.stack', { 'aria-label': 'Runs' },
    h('div.row.filters', {}, searched,
      filter('Kind', 'kind', [['', 'all kinds'], ...Object.entries(KINDS).map(([key, { names }]) =>
        [key, names.toLowerCase()])]),
      filter('State', 'state', [['', 'all states'], ...STATES]),
      filter('Experiment', 'experiment', [['', 'all experiments'], ...experiments]),
      filter('Archived', 'archived', ARCHIVES), order),
    actions.element, panel, none, h('div.row', {}, more, shown)));
  // The user may leave the page while facts are being read, which can take long.
  await new Promise((resolve, reject) => {
    const done = () => resolve(undefined);
    refresh(done).then(done, reject);
  });
  const later = coalesced(reload, stop.signal, 1000);
  const timer = setInterval(() => {
    if (!document.hidden && list.items.some(isMoving)) {
      list.poll().then(show, () => {});
    }
  }, POLL_MS);
  return {
    update({ type }) {
      // The timer refreshes progress.
      if (type === 'reset' || (/^job\./.test(type) && isNews({ type }))) later();
    },
    unmount() {
      clearInterval(timer);
      clearTimeout(typing);
      stop.abort();
      rows.destroy();
    },
  };
}
