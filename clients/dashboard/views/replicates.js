/** A group of replicates: campaigns of one request that differ only in their seeds. */

import { Curve, getJson } from '../lib/api.js';
import { Chart, column } from '../lib/chart.js';
import { ChartGroup, axisRow } from '../lib/chart_group.js';
import { h, patch, patchRow, say, table } from '../lib/dom.js';
import { coalesced } from '../lib/events.js';
import { inOwnUnit, score } from '../lib/format.js';
import { shortProgress, titleOf } from '../lib/kinds.js';
import { progressBar, stateChip } from './jobs.js';
import { copyButton } from './share.js';

/** The statistics of the curves, each with its title and color. */
const SPREADS = [
  ['best_score', 'Best score', '--orange'], ['mean_score', 'Mean score', '--blue'],
  ['diversity', 'Diversity', '--pink'],
];

/** Returns the series of a spread: the range over the replicates, and their mean. */
function seriesOf(rows, name, color) {
  const x = column(rows, (row) => row.generation);
  const at = (which) => column(rows, (row) => row[name][which]);
  return [
    { name: 'min to max', kind: /** @type {'band'} */ ('band'), x, y: x, color, opacity: 0.25,
      low: at('least'), high: at('most') },
    { name: 'mean of the replicates', x, y: at('mean'), color },
  ];
}

export async function mount(main, id, parameters, app) {
  const stop = new AbortController();
  const get = (url) => getJson(url, { signal: stop.signal });
  const campaign = { ...await get(`v1/campaigns/${id}`), kind: 'campaign' };
  const { group } = campaign;
  const curve = new Curve(`v1/campaigns/${group.id}/replicates`);
  const together = new ChartGroup(parameters, app.keep);
  const charts = SPREADS.map(([name, title, color]) => ({
    name, color, chart: new Chart({ title, note: name === 'diversity' ? '' : 'lower is better',
      log: name !== 'diversity', empty: 'No generation is complete in all replicates yet.' })
      .join(together, name),
  }));
  together.check();
  const body = h('tbody');
  const about = h('span.muted');
  const note = h('p.muted');

  main.replaceChildren(
    h('div.title', {}, h('h1', {}, titleOf(campaign)), about, h('div.actions', {},
      copyButton(() => ({
        path: `v1/campaigns/${group.id}/replicates`,
        morphoctl: `campaign export ${group.id} --replicates -`,
        python: `print(m.campaigns(group="${group.id}").curves())`,
      })))),
    axisRow([], '', null), h('div.grid', {}, charts.map(({ chart }) => chart.element)),
    h('section.panel.stack', { 'aria-label': 'Replicates' }, note, h('div.scroll', {}, table(
      ['Replicate', 'Seed', 'State', 'Progress', 'Best score'], body,
      (name) => /Seed|Best/.test(name)))));

  function showRows(members) {
    const bests = members.map((one) => one.newest?.score.quantiles.p0).filter(Number.isFinite);
    const deleted = group.replicates - members.length;
    say(about, (members.length > 1
      ? `${members.length} replicates that differ only in their seeds` : 'a single run') +
      (deleted > 0 ? `; ${deleted} deleted` : ''));
    app.setTitle(`${titleOf(campaign)}, replicates, ${shortProgress(members.at(-1))}`);
    const early = members.filter(({ state }) => state === 'cancelled' || state === 'failed');
    say(note, 'The curves end at the newest generation that all have reached.' + (early.length
      ? ` Left out, because they ended early: ${early.map((one) => one.id).join(', ')}.` : ''));
    patch(body, members, (one) => one.id, () => h('tr'), (row, one) => {
      const best = one.newest?.score.quantiles.p0;
      patchRow(row, [
        h('td.main', {}, h('a', { href: `#/campaigns/${one.id}` },
          `replicate ${one.group.replicate + 1} of ${one.group.replicates}`),
          h('div.muted', {}, `campaign ${one.id}`)),
        h('td.right', { 'data-name': 'Seed' }, one.settings.seed),
        h('td', {}, stateChip(one)),
        h('td.wide', {}, progressBar(one)),
        h('td.right', { 'data-name': 'Best score' }, Number.isFinite(best)
          ? one.own_score ? inOwnUnit(one.own_score, best) : score(best) : '–',
          bests.length > 1 && best === Math.min(...bests) ? ' ♛' : ''),
      ]);
    });
  }

  async function refresh() {
    const [page] = await Promise.all([
      get(`v1/campaigns?group=${group.id}&limit=100&archived=all`), curve.refresh(stop.signal)]);
    showRows(page.items.map((one) => ({ ...one, kind: 'campaign' }))
      .sort((a, b) => a.group.replicate - b.group.replicate));
    charts.forEach(({ name, color, chart }) => chart.set(seriesOf(curve.rows, name, color)));
  }

  await refresh();
  const later = coalesced(refresh, stop.signal);
  return {
    update({ type }) {
      if (type === 'reset' || type.startsWith('job.') || type === 'campaign.generation') later();
    },
    unmount() {
      stop.abort();
      charts.forEach(({ chart }) => chart.destroy());
    },
  };
}
