/** One campaign: its head, and its tabs. */

import { post } from '../lib/api.js';
import { announce, button, fill, h } from '../lib/dom.js';
import { count, countOf, inOwnUnit, score } from '../lib/format.js';
import { ownScoreOf, replicateOf } from '../lib/kinds.js';
import { may } from '../lib/rights.js';
import { worldOfJob } from '../lib/rollouts.js';
import { measureOf, meters } from '../lib/tasks.js';
import { CampaignCurves } from './campaign_curves.js';
import { startChampions } from './champions.js';
import { submitter } from './jobs.js';
import { mountRun } from './run_page.js';
import { announced, copyButton, formDialog, saveLink, showDialog } from './share.js';

/** The tabs that are shown here; the phylogeny has a page. Only the first loads with the page. */
const tabs = {
  '': async () => CampaignCurves,
  population: async () => (await import('./scatter.js')).PopulationTab,
  settings: async () => (await import('./settings.js')).SettingsTab,
};

export async function mount(main, path, parameters, app) {
  const [id, part] = path;
  if (part === 'phylogeny') {
    return (await import('./phylogeny.js')).mount(main, id, parameters, app);
  }
  if (part === 'replicates') {
    return (await import('./replicates.js')).mount(main, id, parameters, app);
  }
  return mountRun(main, path, parameters, app, { kind: 'campaign', tabs,
    prepare: (shared) => prepare(shared, part) });
}

async function prepare(shared, part) {
  const { id, others, get, job } = shared;
  const campaign = job();
  const own = ownScoreOf(campaign); // not the mean of the losses
  const [world, comparing, first] = await Promise.all([
    others.length || own ? null : worldOfJob('campaign', campaign),
    others.length ? Promise.all([import('./comparison.js'), import('./settings_diff.js')]) : null,
    part ? null : startChampions(shared).catch(() => null), // the page tries again
  ]);
  const measure = world && measureOf(world.environments);
  Object.assign(shared, { own, measure, comparing, first, shown: (loss) => (own
    ? inOwnUnit(own, loss) : measure ? meters(measure.valueOf(loss)) : score(loss)) });
  const siblings = h('span.row');
  if (campaign.group.replicates > 1) showSiblings(siblings, campaign, get).catch(() => {});
  return {
    isDashed: true, aside: [siblings],
    actions: [button('Export', () => exports(campaign)),
      may('submit') && !campaign.study ? button('Extend', () => extend(shared)) : null,
      may('submit') ? button('Certify the best 20', () => announced(() => certify(shared))) : null,
      copyButton(() => ({
        path: `v1/campaigns/${id}`, morphoctl: `campaign show ${id}\ncampaign watch ${id}`,
        python: `campaign = m.get_campaign(${id})\nprint(campaign.curve())\n` +
          'print(campaign.champions())',
      }))],
    about: (one) => `${one.mode}, ${count(one.settings.population)} designs, ` +
      `${count(one.progress.designs)} born${replicateOf(one)}${submitter(one)}` +
      (own ? `; ranked by ${own.name}` : '') +
      (one.study?.own_score ? ', computed by its client' : ''),
  };
}

/** Shows links to the group and to the other replicates. */
async function showSiblings(place, { id, group }, get) {
  const { items } = await get(`v1/campaigns?group=${group.id}&limit=100&archived=all`);
  fill(place, h('a', { href: `#/campaigns/${id}/replicates` }, 'all replicates'),
    items.filter((one) => one.id !== id).reverse().map((one) =>
      h('a', { href: `#/campaigns/${one.id}` }, `replicate ${one.group.replicate + 1}`)));
}

function exports({ id, settings }) {
  const link = (path, text) => h('li', {},
    saveLink(`v1/campaigns/${id}/${path}`, `campaign-${id}-${path.split('?')[0]}`, text));
  showDialog('Export', h('ul', {}, link('generations?format=csv', 'Generations as CSV'),
    link('phylogeny?format=csv', 'Phylogeny in the ALife standard (CSV)'),
    link('phylogeny?format=newick', 'Phylogeny in Newick'),
    settings.learning ? link('learning?format=csv', 'Learning as CSV') : null));
}

async function certify({ app, id: campaign }) {
  const { id } = await post('v1/certificates', { population: { campaign } });
  app.go(`certificates/${id}`);
}

function extend({ id, refreshJob }) {
  const input = h('input', { type: 'number', min: 1, max: 100000, value: 10, required: true });
  formDialog('Extend the campaign', 'Extend', async () => {
    await post(`v1/campaigns/${id}/extend`, { generations: Number(input.value) });
    announce(`Extended by ${countOf(Number(input.value), 'generation')}`);
    refreshJob();
  }, h('p.wide', {}, 'It continues from its last generation.'),
  h('label.field', {}, h('span', {}, 'Further generations'), input));
}
