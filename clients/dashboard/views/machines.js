/** Machines: which machines compute what, since when and how fast, and which ones were lost. */

import { getJson, post, shared } from '../lib/api.js';
import { button, h, patch, patchRow, say, table, tile } from '../lib/dom.js';
import { coalesced } from '../lib/events.js';
import { ago, count, countOf, duration, number } from '../lib/format.js';
import { may } from '../lib/rights.js';
import { announced, copyButton } from './share.js';

const REFRESH_MS = 2000;
/** The colors of states, as for jobs. */
const COLORS = { active: 'running', draining: 'paused', refused: 'failed', left: 'succeeded',
  lost: 'failed' };

export async function mount(main, path, parameters, app) {
  const stop = new AbortController();
  const get = (url) => getJson(url, { signal: stop.signal });
  const tiles = h('section.tiles', { 'aria-label': 'All machines' });
  const machines = h('tbody');
  const ended = h('tbody');
  const note = h('p.muted');
  const heads = ['Machine', 'State', 'Computes with', 'Rollouts per second', 'Done', 'Now', 'Lost',
    'Since', ''];
  const endedPanel = h('section.panel.stack', { 'aria-label': 'Past workers' },
    h('h2', {}, 'Past workers'),
    listOf(['Machine', 'State', 'Done', 'Lost', 'Worked for', 'Ended'], ended));

  main.replaceChildren(
    h('div.title', {}, h('h1', {}, 'Machines'), h('div.actions', {}, copyButton(() => ({
      path: 'v1/fleet', morphoctl: 'fleet', python: 'print(m.fleet().sessions)',
    })))),
    tiles, note,
    h('section.panel.stack', { 'aria-label': 'At work' }, h('h2', {}, 'At work'),
      listOf(heads, machines)), endedPanel);

  function listOf(names, body) {
    return h('div.scroll', {}, table(names, body, (name) => /second|Done|Lost|Now/.test(name)));
  }

  const nameOf = (session) => h('td.main', {}, session.name, h('div.muted', {},
    [session.host === session.name ? '' : session.host,
      session.version + (session.older ? ' (older)' : '')].filter(Boolean).join(', ')));
  const stateOf = (session) => h('td', {},
    h(`span.state.${COLORS[session.state]}`, {}, session.state),
    session.why && session.state !== 'left' ? h('div.muted', {}, session.why) : null);
  const powerOf = (threads, devices) => [threads ? countOf(threads, 'thread') : '',
    devices ? countOf(devices, 'GPU') : '']
    .filter(Boolean).join(', ');
  const numberCell = (name, text) => h('td.right', { 'data-name': name }, text);

  /** Returns the row of this machine, which computes along with the others. */
  function ownRow(threads, devices, fleet) {
    const only = fleet.compute === 'fleet';
    return h('tr', {},
      h('td.main', {}, 'this machine',
        h('div.muted', {}, only ? 'what workers cannot compute' : 'the service itself')),
      h('td', {}, threads.n_busy ? h('span.state.running', {}, 'computing')
        : h('span.state', {}, 'idle')),
      h('td', {}, powerOf(threads.n_threads, devices.items.length)),
      numberCell('Rollouts per second', '–'), numberCell('Done', count(threads.rollouts_done)),
      numberCell('Now', countOf(threads.n_busy, 'block')), numberCell('Lost', '–'),
      h('td'), h('td'));
  }

  function row(session) {
    return h('tr', {}, nameOf(session), stateOf(session),
      h('td', {}, powerOf(session.n_threads, session.n_devices)),
      numberCell('Rollouts per second', number(session.rollouts_per_s)),
      numberCell('Done', count(session.rollouts_done)),
      numberCell('Now',
        session.leases ? `${countOf(session.leases, 'lease')}, ${count(session.rollouts_out)}`
        : 'idle'),
      numberCell('Lost', count(session.leases_lost)),
      h('td', { title: session.joined_at }, ago(session.joined_at)), h('td', {}, changes(session)));
  }

  function endedRow(session) {
    const seconds = (Date.parse(session.ended_at) - Date.parse(session.joined_at)) / 1000;
    return h('tr', {}, nameOf(session), stateOf(session),
      numberCell('Done', count(session.rollouts_done)),
      numberCell('Lost', count(session.leases_lost)), h('td', {}, duration(seconds)),
      h('td', {}, ago(session.ended_at)));
  }

  /** Performs an action on a worker, and shows why the service refused it. */
  async function act(send, done) {
    await announced(send, done);
    refresh();
  }

  function changes(session) {
    if (!may('admin') || session.state !== 'active') return null;
    const at = `v1/fleet/sessions/${session.id}`;
    return h('div.row', {}, button('Drain',
      () => act(() => post(`${at}/drain`), `${session.name} gets no more work`),
      { 'aria-label': `Drain ${session.name}`, title: 'It finishes its work, then leaves' }));
  }

  function show(fleet, threads, devices) {
    const open = fleet.sessions.filter((session) => !session.ended_at)
      .sort((a, b) => a.state.localeCompare(b.state) || a.name.localeCompare(b.name));
    const gone = fleet.sessions.filter((session) => session.ended_at);
    const again = `${countOf(fleet.leases_again, 'lease')} reissued`;
    const all = [
      ['Workers', count(fleet.n_sessions),
        powerOf(fleet.n_threads, fleet.n_devices) || 'on other machines'],
      ['Rollouts per second', number(fleet.rollouts_per_s),
        `${count(fleet.rollouts_out)} in flight`],
      ['Computed elsewhere', count(fleet.rollouts_done), 'rollouts since the start'],
      ['Lost', count(fleet.lost), `of ${countOf(fleet.joined, 'session')}; ${again}`],
      ['Compared', count(fleet.audits), fleet.audits_failed
        ? `${count(fleet.audits_failed)} with different bits`
        : fleet.audits ? 'leases, all with the same bits' : 'leases computed by two workers'],
    ];
    patch(tiles, all, ([name]) => name, (one) => tile(...one), (element, values) =>
      values.forEach((text, i) => say(element.children[i], text)));
    const older = fleet.n_older
      ? `${countOf(fleet.n_older, 'worker')} of an older version than ${fleet.version}, with the ` +
        'same bits; morphoctl fleet drain --older lets them be upgraded. '
      : '';
    const classes = Object.values(fleet.classes).filter(Boolean)
      .map((one) => `${one.scores}: ${countOf(one.sessions, 'worker')}`);
    note.textContent = fleet.listening ? older + classes.join('; ')
      : 'Only this machine runs rollouts. Set fleet_listen to let workers on other machines join ' +
        '(morphod worker).';
    const list = (body, items, key, make) => patch(body, items, key, () => h('tr'),
      (element, item) => patchRow(element, [...make(item).cells]));
    list(machines, [{ id: 'own' }, ...open], ({ id }) => id, (session) =>
      (session.id === 'own' ? ownRow(threads, devices, fleet) : row(session)));
    list(ended, gone.slice(0, 50), ({ id }) => id, endedRow);
    endedPanel.hidden = gone.length === 0;
  }

  const refresh = shared(() => Promise.all([get('v1/fleet'), get('v1/threads'), get('v1/devices')])
    .then((all) => show(...all)));
  const later = coalesced(refresh, stop.signal);
  await refresh();
  const timer = setInterval(() => {
    if (!document.hidden) refresh().catch(() => {});
  }, REFRESH_MS);
  return {
    update(event) {
      if (event.type === 'reset' || event.type.startsWith('fleet.')) later();
    },
    unmount() {
      clearInterval(timer);
      stop.abort();
    },
  };
}
