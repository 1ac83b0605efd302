/** Campaigns: the list, and one campaign with its curves, champions, population and phylogeny. */

import { Curve, getJson, post, withQuery } from '../lib/api.js';
import { Chart, column } from '../lib/chart.js';
import { announce, button, fill, h, patch, patchRow, say, table } from '../lib/dom.js';
import { coalesced } from '../lib/events.js';
import { ago, count, countOf, inOwnUnit, percent, score, voxels } from '../lib/format.js';
import { picture } from '../lib/picture.js';
import { may } from '../lib/rights.js';
import { environmentsOfCampaign, rollOfCampaign, worldOfJob } from '../lib/rollouts.js';
import { measureOf, meters, taskNameOf } from '../lib/tasks.js';
import { Player } from '../stage/player.js';
import { breedButton, startButton } from './forms.js';
import {
  JobParts, comparedIn, comparing, emptyText, progressBar, replicateOf, shortProgress, stateChip,
  stateOf, submitter, titleOf,
} from './jobs.js';
import { Comparison, DASHES, HUES } from './comparison.js';
import { Scatter } from './scatter.js';
import { copyButton, formDialog, saveLink, showDialog } from './share.js';

const CHAMPIONS = 8;
/** A running campaign is polled, because not every phase has events. */
const POLL_MS = 2000;
const DASH_NAMES = ['dashed', 'dotted', 'dash and dot'];

export async function mount(main, [id, part], parameters, app) {
  if (!id) return mountList(main, app);
  if (part === 'phylogeny') {
    return (await import('./phylogeny.js')).mount(main, id, parameters, app);
  }
  if (part === 'replicates') return (await import('./replicates.js')).mount(main, id, app);
  return mountOne(main, id, parameters, app);
}

async function mountList(main, app) {
  const stop = new AbortController();
  const body = h('tbody');
  const panel = h('section.panel.scroll', {}, table(
    ['', 'Campaign', 'Task', 'State', 'Population', 'Progress', 'Best score', 'Created'], body,
    (name) => /Population|Best/.test(name)));
  const start = may('submit') ? '; the button above starts one' : '';
  const none = h('p.empty', {}, 'No campaign yet. A campaign evolves a population of designs ' +
    `over generations${start}.`);
  const { compare, box } = comparing(app, 'campaigns', 'Compare');
  const opened = new Set(); // groups with visible replicates
  let items = [];
  const tasks = new Map(); // of the groups: the name of the task, and how to show its scores

  /** Formats the best score, in the unit of the task if that is meters. */
  function bestOf(job, best) {
    if (best === Infinity) return '–';
    const own = job.own_score ?? null;
    if (own) return inOwnUnit(own, best);
    const measure = tasks.get(job.group.id)?.measure;
    return measure ? [meters(measure.valueOf(best)), h('div.muted', {}, `loss ${score(best)}`)]
      : score(best);
  }

  /** Loads the environments of the groups that are new in the list. */
  async function findTasks() {
    await Promise.all(items.filter(({ group }) => !tasks.has(group.id)).map(async (job) => {
      tasks.set(job.group.id, null); // once
      const environments = await environmentsOfCampaign(job).catch(() => null);
      if (environments) {
        tasks.set(job.group.id, { measure: measureOf(environments),
          name: taskNameOf(job.settings.environments, environments) });
      }
    }));
  }

  /** Returns a row of cells for a campaign, or for the replicates of one request. */
  function cellsOf({ job, members, isMember }) {
    const all = members ?? [job];
    const bests = all.map((one) => one.newest?.score.quantiles.p0 ?? Infinity);
    const best = Math.min(...bests);
    const states = [...new Set(all.map(stateOf))].map((state) => all.filter((one) =>
      stateOf(one) === state));
    const slowest = all.reduce((a, b) => ((a.progress.generation ?? -1) <=
      (b.progress.generation ?? -1) ? a : b));
    const isSpread = all.some((one) => one.progress.generation !== slowest.progress.generation);
    const link = h('a', { href: `#/campaigns/${all[0].id}${members ? '/replicates' : ''}` },
      isMember ? replicateOf(job).slice(2) : titleOf(all[0]));
    const about = members ? `${job.mode}, ${countOf(members.length, 'replicate')}`
      : isMember ? `campaign ${job.id}, seed ${job.settings.seed}` : job.mode;
    return [
      members && opened.has(job.group.id) ? h('td') : box(all[0]),
      h(`td.main${isMember ? '.member' : ''}`, {}, link, h('div.row.muted', {}, about,
        members ? expander(job.group.id, titleOf(job)) : null)),
      h('td', { 'data-name': 'Task' }, tasks.get(job.group.id)?.name ?? ''),
      h('td', {}, states.map((same) => (members
        ? h(`span.state.${same[0].state}`, {}, `${same.length} ${stateOf(same[0])}`)
        : stateChip(same[0])))),
      h('td.right', { 'data-name': 'Population' }, count(job.settings.population)),
      h('td.wide', {}, progressBar(slowest),
        isSpread ? h('div.muted', {}, 'the slowest one') : null),
      h('td.right', { 'data-name': 'Best score' }, bestOf(job, best)),
      h('td', {}, ago(job.created_at)),
    ];
  }

  function expander(group, title) {
    const isOpen = opened.has(group);
    return button(isOpen ? 'Hide them' : 'Show them', () => {
      if (!opened.delete(group)) opened.add(group);
      show();
      body.querySelector(`[data-group="${group}"]`)?.focus();
    }, {
      class: 'small', 'aria-expanded': String(isOpen), 'data-group': group,
      'aria-label': `${isOpen ? 'Hide' : 'Show'} the replicates of ${title}`,
    });
  }

  function show() {
    const groups = new Map();
    for (const job of items) {
      groups.set(job.group.id, [job, ...(groups.get(job.group.id) ?? [])]);
    }
    const rows = [...groups].flatMap(([id, members]) => {
      members.sort((a, b) => a.group.replicate - b.group.replicate);
      const single = members.map((job) => ({ key: job.id, job, isMember: members.length > 1 }));
      if (members.length === 1) return single;
      return [{ key: `group ${id}`, job: members[0], members }, ...(opened.has(id) ? single : [])];
    });
    none.hidden = items.length > 0;
    panel.hidden = !none.hidden;
    patch(body, rows, ({ key }) => key, () => h('tr'), (row, one) => patchRow(row, cellsOf(one)));
  }

  async function refresh() {
    const page = await getJson('v1/campaigns?limit=200', { signal: stop.signal });
    items = page.items.map((job) => ({ ...job, kind: 'campaign' }));
    await findTasks();
    show();
  }

  await refresh();
  const copy = copyButton(() => ({
    path: 'v1/campaigns', morphoctl: 'campaign list', python: 'print(m.campaigns())',
  }));
  main.replaceChildren(h('div.title', {}, h('h1', {}, 'Campaigns'), h('div.actions', {}, compare,
    copy, startButton(app, 'campaign', { class: 'primary' }))), panel, none);
  const later = coalesced(refresh, stop.signal);
  return {
    update({ type }) {
      if (type === 'reset' || type.startsWith('job.') || type === 'campaign.generation') later();
    },
    unmount: () => stop.abort(),
  };
}

async function mountOne(main, id, parameters, app) {
  const stop = new AbortController();
  const get = (url) => getJson(url, { signal: stop.signal });
  let campaign = await get(`v1/campaigns/${id}`);
  campaign.kind = 'campaign';
  const others = comparedIn(parameters, id);
  const ids = [id, ...others];
  const curves = ids.map((one) => new Curve(`v1/campaigns/${one}/generations`));
  const isGroup = campaign.group.replicates > 1;
  const replicates = isGroup ? new Curve(`v1/campaigns/${campaign.group.id}/replicates`) : null;
  const compared = others.length ? new Comparison(ids, get) : null;
  const learns = campaign.settings.learning !== null;
  const own = campaign.own_score ?? null; // not the mean of the losses
  const measure = others.length || own ? null
    : measureOf((await worldOfJob('campaign', campaign)).environments);
  const shown = (loss) => (own ? inOwnUnit(own, loss)
    : measure ? meters(measure.valueOf(loss)) : score(loss));

  const head = h('div.title');
  const parts = new JobParts(() => refreshJob());
  const status = h('section.panel.stack', { 'aria-label': 'State' }, parts.bar, parts.trouble,
    parts.remark, parts.row);
  const charts = {
    scores: new Chart({
      ...(own
        ? { title: own.unit ? `${own.name}, ${own.unit}` : own.name, yText: shown,
          note: `lower is better; ${campaign.study
            ? 'sent by the client' : 'the mean of a measure, negated for max'}` }
        : measure
        ? { title: `Meters ${measure.verb}`, note: 'higher is better; from the mean loss',
          yText: meters }
        : { title: 'Score', note: 'lower is better', log: true }),
      height: 260, empty: 'No generation is complete yet.',
    }),
    diversity: new Chart({ title: 'Diversity and turnover', minimum: 0, height: 260,
      empty: 'No generation is complete yet.' }),
    operators: new Chart({ title: 'Share of children that survive', minimum: 0, yText: percent }),
    size: new Chart({ title: 'Voxels and footprint', minimum: 0 }),
  };
  const { racing, selection } = campaign.settings;
  if (racing === 'lossless' && selection.kind === 'truncation' && !campaign.study) {
    charts.race = new Chart({ title: 'Share of children cut short', minimum: 0, yText: percent,
      note: 'they could not survive: their scores are lower bounds' });
  }
  if (learns) charts.learning = new Chart({ title: 'Loss while learning, in each generation' });
  const champions = h('div.grid.small');
  const nothing = h('p.empty', {}, 'The first champions come with the first generation.');
  const chosen = new Map(); // designs by number
  const genotypes = () => [...chosen.values()].map(({ genotype }) => genotype);
  const watch = button('Watch selected', () => app.go('stage', {
    designs: genotypes().join(','), world: `campaign-${id}`,
  }), { disabled: true, title: 'On the stage, in the world of this campaign' });
  const breed = breedButton(app, 'Breed these', () =>
    genotypes().map((voxels) => ({ voxels })), { disabled: true });
  const player = new Player(app, { compact: true, height: 420 });
  const scatter = new Scatter((numbers) => walk(numbers), own?.name);

  main.replaceChildren(head, status, ...(compared ? [compared.element] : []),
    h('div.grid', {}, Object.values(charts).map((chart) => chart.element)),
    h('section.panel.stack', {}, h('div.title', {}, h('h2', {}, 'Champions'), h('span.muted', {},
      'the best, then the most distinct of the good ones; select one to see it walk'),
    h('div.actions', {}, watch, breed)), champions, nothing),
    h('section.panel.flush', { 'aria-label': 'Stage' }, player.element), scatter.element);

  const title = h('h1');
  const about = h('span.muted');
  const siblings = h('span.row');
  fill(head, title, about, parts.chip, siblings, others.map(comparedChip),
    h('div.actions', {}, h('a.button', { href: `#/campaigns/${id}/phylogeny` }, 'Phylogeny'),
      button('Export', () => exports()),
      may('submit') && !campaign.study ? button('Extend', () => extend()) : null,
      copyButton(() => requestOf(campaign.id))));

  /** A campaign that is compared with this one, with a button to remove it. */
  function comparedChip(other, i) {
    const rest = others.filter((one) => one !== other).join(',');
    return h('span.state', {}, h('a', { href: `#/campaigns/${other}` }, `with campaign ${other}`),
      `(${DASH_NAMES[i]})`, h('a', { href: `#/campaigns/${id}${rest && `?compare=${rest}`}`,
        'aria-label': `Leave out campaign ${other}` }, '×'));
  }

  /** Shows links to the group and to the other replicates. */
  async function showSiblings() {
    const { items } = await get(`v1/campaigns?group=${campaign.group.id}&limit=100&archived=all`);
    fill(siblings, h('a', { href: `#/campaigns/${id}/replicates` }, 'all replicates'),
      items.filter((one) => one.id !== id).reverse().map((one) =>
        h('a', { href: `#/campaigns/${one.id}` }, `replicate ${one.group.replicate + 1}`)));
  }

  function showHead() {
    parts.update(campaign);
    say(title, titleOf(campaign));
    say(about, `${campaign.mode}, ${count(campaign.settings.population)} designs, ` +
      `${count(campaign.progress.designs)} born${replicateOf(campaign)}${submitter(campaign)}` +
      (own ? `; ranked by ${own.name}` : '') +
      (campaign.study?.own_score ? ', which its client computes' : ''));
    app.setTitle(`${titleOf(campaign)}, ${shortProgress(campaign)}`);
  }

  function exports() {
    const link = (path, text) => h('li', {},
      saveLink(`v1/campaigns/${id}/${path}`, `campaign-${id}-${path.split('?')[0]}`, text));
    showDialog('Export', h('ul', {}, link('generations?format=csv', 'Generations as CSV'),
      link('phylogeny?format=csv', 'Phylogeny in the ALife standard (CSV)'),
      link('phylogeny?format=newick', 'Phylogeny in Newick'),
      learns ? link('learning?format=csv', 'Learning as CSV') : null));
  }

  function extend() {
    const input = h('input', { type: 'number', min: 1, max: 100000, value: 10, required: true });
    formDialog('Extend the campaign', 'Extend', async () => {
      await post(`v1/campaigns/${id}/extend`, { generations: Number(input.value) });
      announce(`Extended by ${countOf(Number(input.value), 'generation')}`);
      refreshJob();
    }, h('p.wide', {}, 'It continues from its last generation.'),
    h('label.field', {}, h('span', {}, 'Further generations'), input));
  }

  function showCharts() {
    const rows = curves[0].rows;
    const x = column(rows, (row) => row.generation);
    const inUnit = measure?.valueOf ?? ((loss) => loss);
    const quantile = (name) => column(rows, (row) => inUnit(row.score.quantiles[name]));
    /** A lower loss is a higher value. */
    const between = (a, b) => (measure ? { low: quantile(b), high: quantile(a) }
      : { low: quantile(a), high: quantile(b) });
    /** @type {import('../lib/chart.js').Series[]} */
    const scores = [
      { name: '5 to 95 %', kind: 'band', x, ...between('p5', 'p95'), y: x,
        color: '--blue-softer' },
      { name: '25 to 75 %', kind: 'band', x, ...between('p25', 'p75'), y: x,
        color: '--blue-soft' },
      { name: 'median', x, y: quantile('p50'), color: '--blue' },
      { name: 'best', x, y: quantile('p0'), color: '--orange' },
    ];
    if (replicates?.rows.length) {
      const r = replicates.rows;
      const rx = column(r, (row) => row.generation);
      scores.unshift({
        name: `mean of ${campaign.group.replicates} replicates, least to most`, kind: 'band',
        x: rx, y: rx, color: others.length ? '--gray' : '--green', opacity: 0.3,
        low: column(r, ({ mean_score: of }) => inUnit(measure ? of.most : of.least)),
        high: column(r, ({ mean_score: of }) => inUnit(measure ? of.least : of.most)),
      });
    }
    others.forEach((other, i) => {
      const { rows: r } = curves[i + 1];
      const ox = column(r, (row) => row.generation);
      scores.push({ name: `25 to 75 % of ${other}`, kind: 'band', x: ox, y: ox, color: HUES[i + 1],
        opacity: 0.18,
        low: column(r, (row) => row.score.quantiles.p25),
        high: column(r, (row) => row.score.quantiles.p75) },
      { name: `median of ${other}`, x: ox, y: column(r, (row) => row.score.quantiles.p50),
        color: HUES[i + 1], dash: DASHES[i + 1] });
    });
    const newest = rows.at(-1);
    charts.scores.options.empty = emptyText(newest?.population, newest?.score.diverged,
      'No generation is complete yet.');
    charts.scores.set(scores);
    charts.diversity.set([
      { name: 'diversity', x, y: column(rows, (row) => row.diversity), color: '--blue' },
      { name: 'turnover', x, y: column(rows, (row) => row.turnover), color: '--pink',
        dash: [5, 4] },
    ]);
    const share = (name) => column(rows, ({ operators }) =>
      (operators[name].born ? operators[name].survived / operators[name].born : null));
    charts.operators.set([
      { name: 'mutation', x, y: share('mutation'), color: '--orange' },
      { name: 'crossover', x, y: share('crossover'), color: '--blue', dash: [5, 4] },
    ]);
    charts.size.set([
      { name: 'voxels, least to most', kind: 'band', x, y: x,
        low: column(rows, (row) => row.voxels.least),
        high: column(rows, (row) => row.voxels.most), color: '--blue-softer' },
      { name: 'mean voxels', x, y: column(rows, (row) => row.voxels.mean), color: '--blue' },
      { name: 'mean footprint', x, y: column(rows, (row) => row.footprint.mean), color: '--orange',
        dash: [5, 4] },
    ]);
    charts.race?.set([{ name: 'cut short', x, color: '--gray',
      y: column(rows,
        (row) => (row.generation && row.born ? row.children_cut / row.born : null)) }]);
    charts.learning?.set([
      { name: 'first step', x, y: column(rows, (row) => row.learning.first_loss), color: '--gray',
        dash: [5, 4] },
      { name: 'last step', x, y: column(rows, (row) => row.learning.last_loss), color: '--blue' },
    ]);
  }

  let population = [];
  let bestNumber = -1;
  async function showChampions() {
    nothing.hidden = campaign.progress.generation !== null;
    if (!nothing.hidden) return;
    const { items } = await get(`v1/campaigns/${id}/champions?count=${CHAMPIONS}`);
    const best = items.reduce((a, b) => ((a.score ?? Infinity) <= (b.score ?? Infinity) ? a : b));
    // The best come first; a selected design stays even when it is no longer a champion.
    const shown = [best, ...items.filter((one) => one !== best)];
    for (const design of chosen.values()) {
      if (!shown.some((one) => one.number === design.number)) shown.push(design);
    }
    bestNumber = best.number;
    patch(champions, shown, (design) => design.number, champion, (element, design) => {
      element.querySelector('.crown').hidden = design.number !== bestNumber;
    });
    population = [];
    let cursor;
    do {
      const page = await get(withQuery(`v1/campaigns/${id}/population`, { limit: 1000, cursor }));
      population.push(...page.items);
      cursor = page.next_cursor;
    } while (cursor !== null && population.length < 10000);
    scatter.set(population);
    if (!player.stage?.robots.length) {
      await walk(shown.slice(0, 4).map(({ number }) => number), shown);
    }
  }

  /** Returns the card of a champion: it walks here, or is selected for the stage or as a
   * founder. */
  function champion(design) {
    const { number, genotype, operator } = design;
    const card = h('button.card', {
      type: 'button', title: `Design ${design.robot}`, onclick: () => walk([number], [design]),
    }, picture(genotype, `Champion ${number}`), h('strong.number', {}, shown(design.score)),
    h('span.crown', { hidden: true }, '♛ best'),
    h('span.muted', {}, `#${number}, ${voxels(design.voxels)}`), h('span.muted', {}, operator));
    const box = h('input', { type: 'checkbox', 'aria-label': `Choose #${number}`, onchange() {
      if (box.checked) chosen.set(number, design);
      else chosen.delete(number);
      watch.disabled = breed.disabled = chosen.size === 0;
    } });
    return h('div.pick', {}, card, h('label.row', {}, box, 'choose'));
  }

  /** Shows designs walking, by their numbers. */
  async function walk(numbers, known = population) {
    const designs = numbers.map((one) => known.find((design) => design.number === one))
      .filter(Boolean).slice(0, 64);
    if (!designs.length) return;
    player.setNote('Walking…');
    try {
      player.setRobots(await rollOfCampaign(campaign, designs, stop.signal));
      player.setNote('');
    } catch (error) {
      if (!stop.signal.aborted) player.setNote(error.message);
    }
  }

  async function refreshJob() {
    const was = campaign.state;
    campaign = { ...await get(`v1/campaigns/${id}`), kind: 'campaign' };
    if (was !== campaign.state) announce(`${titleOf(campaign)}: ${stateOf(campaign)}`);
    showHead();
  }

  async function refreshCurves() {
    const fresh = await Promise.all([...curves, ...(replicates ? [replicates] : [])]
      .map((curve) => curve.refresh(stop.signal)));
    if (fresh.some(Boolean)) {
      showCharts();
      await compared?.refresh();
    }
    return fresh[0];
  }

  showHead();
  if (isGroup) showSiblings().catch(() => {}); // they are only links
  showCharts();
  await refreshCurves();
  showChampions().catch((error) => { if (!stop.signal.aborted) fill(nothing, error.message); });

  // New generations are drawn together, at most twice per second.
  const later = coalesced(async () => {
    await refreshJob();
    if (await refreshCurves()) await showChampions();
  }, stop.signal);
  const timer = setInterval(() => {
    if (!document.hidden && campaign.state === 'running') refreshJob().catch(() => {});
  }, POLL_MS);
  return {
    update(event) {
      if (event.type === 'reset' || event.job === id || others.includes(event.job)) later();
    },
    unmount() {
      clearInterval(timer);
      stop.abort();
      Object.values(charts).forEach((chart) => chart.destroy());
      compared?.destroy();
      scatter.destroy();
      player.destroy();
    },
  };
}

const requestOf = (id) => ({
  path: `v1/campaigns/${id}`, morphoctl: `campaign show ${id}\ncampaign watch ${id}`,
  python: `campaign = m.get_campaign(${id})\nprint(campaign.curve())\nprint(campaign.champions())`,
});
