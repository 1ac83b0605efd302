/** Campaigns: the list, and one campaign with its curves, champions, population and phylogeny. */

import { Curve, getJson, post, withQuery } from '../lib/api.js';
import { Chart, column } from '../lib/chart.js';
import { announce, button, fill, h, table } from '../lib/dom.js';
import { coalesced } from '../lib/events.js';
import { ago, count, number, percent, score, voxels } from '../lib/format.js';
import { picture } from '../lib/picture.js';
import { may } from '../lib/rights.js';
import { rollOfCampaign } from '../lib/rollouts.js';
import { Player } from '../stage/player.js';
import { breedButton, startButton } from './forms.js';
import { actions, comparing, editButton, progressBar, remark, stateChip, submitter, titleOf, trouble, weightField } from './jobs.js';
import { Comparison } from './comparison.js';
import { Scatter } from './scatter.js';
import { actDialog, copyButton, saveLink, showDialog } from './share.js';

const CHAMPIONS = 8;
const HUES = ['--blue', '--green', '--pink', '--grey'];
const DASHES = [[], [6, 4], [2, 3], [9, 3, 2, 3]];

export async function mount(main, [id, part], parameters, app) {
  if (!id) return mountList(main, app);
  if (part === 'phylogeny') return (await import('./phylogeny.js')).mount(main, id, parameters, app);
  return mountOne(main, id, parameters, app);
}

async function mountList(main, app) {
  const stop = new AbortController();
  const list = h('div');
  const { compare, box } = comparing(app, 'campaigns', 'Compare');

  const row = (job) => h('tr', {},
    box(job),
    h('td.main', {}, h('a', { href: `#/campaigns/${job.id}` }, titleOf(job)), h('div.muted', {}, job.mode)),
    h('td', {}, stateChip(job)), h('td.right', { 'data-name': 'Population' }, count(job.settings.population)),
    h('td.wide', {}, progressBar(job)),
    h('td.right', { 'data-name': 'Best score' }, job.newest ? score(job.newest.score.quantiles.p0) : '–'),
    h('td', {}, ago(job.created_at)));

  async function refresh() {
    const { items } = await getJson('v1/campaigns?limit=200', { signal: stop.signal });
    fill(list, items.length ? h('section.panel.scroll', {}, table(
      ['', 'Campaign', 'State', 'Population', 'Progress', 'Best score', 'Created'],
      h('tbody', {}, items.map((job) => row({ ...job, kind: 'campaign' }))), (name) => /Population|Best/.test(name)))
      : h('p.empty', {}, 'No campaign yet. A campaign evolves a population of designs over generations' +
        `${may('submit') ? '; the button above starts one' : ''}.`));
  }

  await refresh();
  main.replaceChildren(
    h('div.title', {}, h('h1', {}, 'Campaigns'), h('div.actions', {}, compare,
      copyButton(() => ({ path: 'v1/campaigns', morphoctl: 'campaign list', python: 'print(m.campaigns())' })),
      startButton(app, 'campaign', { class: 'primary' }))), list);
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
  const others = (parameters.get('compare') ?? '').split(',').filter(Boolean).slice(0, 3);
  const ids = [id, ...others];
  const curves = ids.map((one) => new Curve(`v1/campaigns/${one}/generations`));
  const isGroup = campaign.group.replicates > 1;
  const replicates = isGroup ? new Curve(`v1/campaigns/${campaign.group.id}/replicates`) : null;
  const compared = others.length ? new Comparison(ids, get) : null;
  const learns = campaign.settings.learning !== null;

  const head = h('div.title');
  const status = h('section.panel.stack', { 'aria-label': 'State' });
  const charts = {
    scores: new Chart({ title: 'Score', note: 'lower is better', log: true, height: 260, empty: 'No generation has ended yet.' }),
    diversity: new Chart({ title: 'Diversity and turnover', minimum: 0, height: 260, empty: 'No generation has ended yet.' }),
    operators: new Chart({ title: 'Share of children that survive', minimum: 0, yText: percent }),
    size: new Chart({ title: 'Voxels and footprint', minimum: 0 }),
  };
  const { racing, selection } = campaign.settings;
  if (racing === 'lossless' && selection.kind === 'truncation' && !campaign.study) {
    charts.race = new Chart({ title: 'Share of children cut short', note: 'they could not survive: their scores are lower bounds', minimum: 0, yText: percent });
  }
  if (learns) charts.learning = new Chart({ title: 'Loss while learning, in each generation' });
  const champions = h('div.grid.small');
  const chosen = new Map(); // genotypes by number
  const walkChosen = button('Let the chosen walk', () => app.go('stage', { designs: [...chosen.values()].join(',') }), { disabled: true });
  const breed = breedButton(app, 'Breed these', () => [...chosen.values()].map((voxels) => ({ voxels })), { disabled: true });
  const player = new Player(app, { compact: true, height: 420 });
  const scatter = new Scatter((numbers) => walk(numbers));
  const announceState = h('div.visually-hidden', { 'aria-live': 'polite' });

  main.replaceChildren(head, status, ...(compared ? [compared.element] : []), h('div.grid', {}, Object.values(charts).map((chart) => chart.element)),
    h('section.panel.stack', {}, h('div.title', {}, h('h2', {}, 'Champions'),
      h('span.muted', {}, 'the most distinct of the best; touch one to see it walk'), h('div.actions', {}, walkChosen, breed)), champions),
    h('section.panel.flush', { 'aria-label': 'Stage' }, player.element), scatter.element, announceState);

  function showHead() {
    fill(head, h('h1', {}, titleOf(campaign)),
      h('span.muted', {}, `${campaign.mode}, ${count(campaign.settings.population)} designs, ${count(campaign.progress.designs)} born${submitter(campaign)}`), stateChip(campaign),
      others.map((other, i) => h('a.state', { href: `#/campaigns/${other}` }, `with campaign ${other} (${['dashed', 'dotted', 'dash and dot'][i]})`)),
      h('div.actions', {}, h('a.button', { href: `#/campaigns/${id}/phylogeny` }, 'Phylogeny'),
        button('Export', () => exports()),
        may('submit') && !campaign.study ? button('Extend', () => extend()) : null,
        copyButton(() => requestOf(campaign.id))));
    fill(status, h('div', {}, progressBar(campaign)), trouble(campaign), remark(campaign),
      h('div.row', {}, actions(campaign, refreshJob), editButton(campaign, refreshJob), weightField(campaign, refreshJob),
        campaign.progress.rollouts_per_s ? h('span.muted', {}, `${number(campaign.progress.rollouts_per_s)} rollouts a second`) : null));
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
    actDialog('Extend the campaign', 'Extend', async () => {
      await post(`v1/campaigns/${id}/extend`, { generations: Number(input.value) });
      announce(`Extended by ${input.value} generations`);
      refreshJob();
    }, h('p', {}, 'It goes on from its last generation.'), h('label.field', {}, h('span', {}, 'Further generations'), input));
  }

  function showCharts() {
    const rows = curves[0].rows;
    const x = column(rows, (row) => row.generation);
    const quantile = (name) => column(rows, (row) => row.score.quantiles[name]);
    /** @type {import('../lib/chart.js').Series[]} */
    const scores = [
      { name: '5 to 95 %', kind: 'band', x, low: quantile('p5'), high: quantile('p95'), y: x, color: '--blue-softer' },
      { name: '25 to 75 %', kind: 'band', x, low: quantile('p25'), high: quantile('p75'), y: x, color: '--blue-soft' },
      { name: 'median', x, y: quantile('p50'), color: '--blue' },
      { name: 'best', x, y: quantile('p0'), color: '--orange' },
    ];
    if (replicates?.rows.length) {
      const r = replicates.rows;
      const rx = column(r, (row) => row.generation);
      scores.unshift({ name: `mean of ${campaign.group.replicates} replicates, least to most`, kind: 'band', x: rx, y: rx,
        low: column(r, (row) => row.mean_score.least), high: column(r, (row) => row.mean_score.most), color: '--blue-softer' });
    }
    others.forEach((other, i) => {
      const { rows: r } = curves[i + 1];
      const ox = column(r, (row) => row.generation);
      scores.push({ name: `25 to 75 % of ${other}`, kind: 'band', x: ox, y: ox, color: HUES[i + 1], opacity: 0.18,
        low: column(r, (row) => row.score.quantiles.p25), high: column(r, (row) => row.score.quantiles.p75) },
      { name: `median of ${other}`, x: ox, y: column(r, (row) => row.score.quantiles.p50), color: HUES[i + 1], dash: DASHES[i + 1] });
    });
    charts.scores.set(scores);
    charts.diversity.set([
      { name: 'diversity', x, y: column(rows, (row) => row.diversity), color: '--blue' },
      { name: 'turnover', x, y: column(rows, (row) => row.turnover), color: '--pink', dash: [5, 4] },
    ]);
    const share = (name) => column(rows, ({ operators }) =>
      (operators[name].born ? operators[name].survived / operators[name].born : null));
    charts.operators.set([
      { name: 'mutation', x, y: share('mutation'), color: '--orange' },
      { name: 'crossover', x, y: share('crossover'), color: '--blue', dash: [5, 4] },
    ]);
    charts.size.set([
      { name: 'voxels, least to most', kind: 'band', x, y: x, low: column(rows, (row) => row.voxels.least),
        high: column(rows, (row) => row.voxels.most), color: '--blue-softer' },
      { name: 'mean voxels', x, y: column(rows, (row) => row.voxels.mean), color: '--blue' },
      { name: 'mean footprint', x, y: column(rows, (row) => row.footprint.mean), color: '--orange', dash: [5, 4] },
    ]);
    charts.race?.set([{ name: 'cut short', x, color: '--grey',
      y: column(rows, (row) => (row.generation && row.born ? row.children_cut / row.born : null)) }]);
    charts.learning?.set([
      { name: 'first step', x, y: column(rows, (row) => row.learning.first_loss), color: '--grey', dash: [5, 4] },
      { name: 'last step', x, y: column(rows, (row) => row.learning.last_loss), color: '--blue' },
    ]);
  }

  let population = [];
  async function showChampions() {
    const generation = campaign.progress.generation;
    if (generation === null) {
      fill(champions, h('p.empty', {}, 'The first champions come with the first generation.'));
      return;
    }
    const { items } = await get(`v1/campaigns/${id}/champions?count=${CHAMPIONS}`);
    fill(champions, items.map((design) => h('div.pick', {}, h('button.card', {
      type: 'button', title: `Design ${design.id}`,
      onclick: () => walk([design.number], items),
    }, picture(design.genotype, `Champion ${design.number}`), h('strong.number', {}, score(design.score)),
    h('span.muted', {}, `#${design.number}, ${voxels(design.voxels)}`), h('span.muted', {}, design.operator)), pick(design))));
    population = [];
    let cursor;
    do {
      const page = await get(withQuery(`v1/campaigns/${id}/population`, { limit: 1000, cursor }));
      population.push(...page.items);
      cursor = page.next_cursor;
    } while (cursor !== null && population.length < 10000);
    scatter.set(population);
    if (!player.stage?.robots.length) await walk(items.slice(0, 4).map((design) => design.number), items);
  }

  /** Chooses a champion for the stage, or as a founder of another campaign. */
  function pick({ number: which, genotype }) {
    return h('label.row', {}, h('input', { type: 'checkbox', checked: chosen.has(which), onchange: (event) => {
      if (event.target.checked) chosen.set(which, genotype);
      else chosen.delete(which);
      walkChosen.disabled = breed.disabled = chosen.size === 0;
    }, 'aria-label': `Choose #${which}` }), 'choose');
  }

  /** Lets designs walk, by their numbers. */
  async function walk(numbers, known = population) {
    const designs = numbers.map((one) => known.find((design) => design.number === one)).filter(Boolean).slice(0, 64);
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
    if (was !== campaign.state) announceState.textContent = `The campaign is ${campaign.state}`;
    showHead();
  }

  async function refreshCurves() {
    const fresh = await Promise.all([...curves, ...(replicates ? [replicates] : [])].map((curve) => curve.refresh(stop.signal)));
    if (fresh.some(Boolean)) {
      showCharts();
      await compared?.refresh();
    }
    return fresh[0];
  }

  showHead();
  showCharts();
  await refreshCurves();
  showChampions().catch((error) => { if (!stop.signal.aborted) fill(champions, h('p.error', {}, error.message)); });

  // New generations are drawn together, at most twice a second.
  const later = coalesced(async () => {
    await refreshJob();
    if (await refreshCurves()) await showChampions();
  }, stop.signal);
  return {
    update(event) {
      if (event.type === 'reset' || event.job === id || others.includes(event.job)) later();
    },
    unmount() {
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
