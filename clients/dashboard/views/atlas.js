/** Atlases of the service: a list with those that are being built, or the page of one. */

import { getJson, withQuery } from '../lib/api.js';
import { choice, fill, h, patch, say, table } from '../lib/dom.js';
import { bytes, count, countOf, score } from '../lib/format.js';
import { isOpen, pathOf } from '../lib/kinds.js';
import { roll } from '../lib/rollouts.js';
import { loadSheet } from '../lib/sheet.js';
import { AtlasHttp } from '../lib/atlas_http.js';
import { AtlasCompare } from './atlas_compare.js';
import { AtlasPage, startOf, taskTitle } from './atlas_page.js';
import { AtlasPairs } from './atlas_pairs.js';
import { AtlasWalk } from './atlas_walk.js';
import { trayButton } from './add.js';
import { JobParts } from './jobs.js';

const POLL_MS = 2000;
const OPEN = ['queued', 'running', 'paused'];

export async function mount(main, [name], parameters, app) {
  const [{ items, unreadable }, jobs] = await Promise.all([getJson('v1/atlases'), builds(),
    loadSheet('atlas.css')]);
  const isBuilt = items.some((one) => one.name === name);
  if (!name || (!isBuilt && jobs.some((job) => job.atlas.name === name))) {
    return showList(main, { name, items, unreadable, jobs }, app);
  }
  const atlas = new AtlasHttp(name);
  const about = await atlas.about();
  const [environment] = about.environments;
  // A service that got the file from elsewhere may not know its physics.
  const known = await getJson(`v1/physics/${about.physics}`).catch((error) => {
    if (error.status !== 404) throw error;
    return {};
  });
  const walker = new AtlasWalk(app, async (genotype, id, signal) => {
    const { physics, precision } = known;
    const [robot] = await roll([{ voxels: genotype }], environment,
      { controller: `sha256:${about.controller}`, physics, precision, signal });
    return { robot, words: 'As drawn, in the first of ' +
      `${countOf(about.environments.length, 'environment')}, ` +
      `with the controller ${physics ? 'and physics of the atlas' : 'of the atlas, but with ' +
        'default physics, because this service does not know those of the atlas'}` +
      `: loss ${score(robot.loss)}` };
  });
  const page = new AtlasPage(atlas, about, {
    app, walker,
    links: (genotype) => [trayButton(() => [{ genotype }]),
      h('a.button', { href: `#/lab?voxels=${genotype}` }, 'Open in the Lab')],
    others: items.length > 1 ? choice('Atlas', items.map((one) => one.name), name,
      (other) => app.go(`atlas/${other}`, { voxels: page.body })) : null,
    pairs: about.measures.length ? (of) => new AtlasPairs(of) : null,
    compare: items.length > 1 ? (of) => new AtlasCompare(of, items.map((one) => one.name)
      .filter((other) => other !== name)) : null,
  });
  fill(main, page.element);
  page.change(startOf(parameters, about));
  return { pick: (genotype) => page.change(genotype), unmount: () => page.destroy() };
}

/** Returns the jobs that build atlases and have not ended. */
async function builds() {
  const pages = await Promise.all(OPEN.map((state) =>
    getJson(withQuery('v1/jobs', { kind: 'atlas', state, archived: 'all' }))));
  const ids = new Map(pages.flatMap(({ items }) => items).map((job) => [job.id, pathOf(job)]));
  return (await Promise.all([...ids.values()].map((path) => getJson(path)))).filter(isOpen);
}

/** Shows all atlases, and the builds in progress, or that of one atlas. */
function showList(main, { name, items, unreadable, jobs: open }, app) {
  const running = h('div.grid');
  const list = h('div.stack');
  const title = name ? `Atlas ${name}` : 'Atlases';
  fill(main, h('h1', {}, title), name ? null : h('p.sentence', {}, 'An atlas has the score of ' +
    'every body of at most ten voxels: draw one, and see where it stands.'), running, list);
  app.setTitle(title);
  let timer;
  let isClosed = false;
  let asked = 0;
  let shown = 0; // late replies do not replace newer ones
  const showBuilds = (jobs) => patch(running, jobs.filter((job) => !name ||
    job.atlas.name === name), ({ id }) => id, () => buildCard(refresh),
  (card, job) => card.show(job));
  const showAll = (atlases, faulty) => fill(list, tableOf(atlases), faulty.map((one) =>
    h('p.error', {}, `${one.name} cannot be used: ${one.reason}`)));

  async function refresh() {
    clearTimeout(timer);
    const turn = ++asked;
    try {
      const [all, jobs] = await Promise.all([getJson('v1/atlases'), builds()]);
      if (isClosed || turn < shown) return;
      shown = turn;
      clearTimeout(timer);
      if (name && all.items.some((one) => one.name === name)) {
        dispatchEvent(new HashChangeEvent('hashchange')); // this address has a page now
        return;
      }
      showBuilds(jobs);
      if (!name) showAll(all.items, all.unreadable);
      if (jobs.length) timer = setTimeout(refresh, POLL_MS);
    } catch {
      if (isClosed || turn < asked) return;
      timer = setTimeout(refresh, POLL_MS); // the banner says that the service is down
    }
  }

  showBuilds(open);
  if (!name) showAll(items, unreadable);
  if (open.length) timer = setTimeout(refresh, POLL_MS);
  return {
    update({ type }) {
      if (type === 'reset' || type.startsWith('atlas') || type.startsWith('job')) refresh();
    },
    unmount() {
      isClosed = true;
      clearTimeout(timer);
    },
  };
}

function buildCard(changed) {
  const parts = new JobParts(changed);
  const title = h('h2');
  const card = h('article.panel.stack', {}, h('div.title', {}, title, parts.chip), parts.bar,
    parts.trouble, h('div.row', {}, parts.actions));
  return Object.assign(card, { show(job) {
    say(title, `Building ${job.atlas.name}`);
    parts.update(job);
  } });
}

function tableOf(items) {
  if (!items.length) {
    return h('p.empty', {}, 'There is no atlas yet. ',
      h('code', {}, 'morphoctl atlas build --voxels 6 --task walk'), ' builds one.');
  }
  const rows = items.map((one) => h('tr', {}, h('td.main', {},
    h('a', { href: `#/atlas/${encodeURIComponent(one.name)}` }, one.name)),
  [taskTitle(one.environments), count(one.bodies), `≤ ${one.voxels_max}`, one.orientations,
    score(one.best.score), bytes(one.bytes)].map((text, i) => h(i ? 'td.right' : 'td', {}, text))));
  return table(['Name', 'Task', 'Bodies', 'Voxels', 'Orientations', 'Best score', 'Size'],
    h('tbody', {}, rows), (_, i) => i > 1);
}
