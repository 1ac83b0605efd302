/** Atlases of the service: a list, or the page of one. */

import { getJson } from '../lib/api.js';
import { choice, fill, h, table } from '../lib/dom.js';
import { bytes, count, score } from '../lib/format.js';
import { roll } from '../lib/rollouts.js';
import { AtlasHttp } from '../lib/atlas_http.js';
import { AtlasCompare } from './atlas_compare.js';
import { AtlasPage, startOf, taskTitle } from './atlas_page.js';
import { AtlasWalk } from './atlas_walk.js';
import { trayButton } from './add.js';

/** The page has a sheet of its own, so that other pages do not load it. */
function loadStyle() {
  const { href } = new URL('../atlas.css', import.meta.url);
  const known = document.querySelector(`link[href="${href}"]`);
  if (known) return Promise.resolve();
  return new Promise((resolve) => {
    document.head.append(h('link', { rel: 'stylesheet', href, onload: resolve,
      onerror: resolve }));
  });
}

export async function mount(main, [name], parameters, app) {
  const [{ items, unreadable }] = await Promise.all([getJson('v1/atlases'), loadStyle()]);
  if (!name) {
    showList(main, items, unreadable);
    return {};
  }
  const atlas = new AtlasHttp(name);
  const about = await atlas.about();
  const [environment] = about.environments;
  const walker = new AtlasWalk(app, async (genotype, id, signal) => {
    const [robot] = await roll([{ voxels: genotype }], environment,
      { controller: `sha256:${about.controller}`, signal });
    return { robot, words: `As drawn, in the first of ${about.environments.length} environments, ` +
      `under the controller of the atlas, with default physics: loss ${score(robot.loss)}` };
  });
  const page = new AtlasPage(atlas, about, {
    app, walker,
    links: (genotype) => [trayButton(() => [{ genotype }]),
      h('a.button', { href: `#/lab?voxels=${genotype}` }, 'Open in the Lab')],
    others: items.length > 1 ? choice('Atlas', items.map((one) => one.name), name,
      (other) => app.go(`atlas/${other}`, { voxels: page.body })) : null,
    compare: items.length > 1 ? (of) => new AtlasCompare(of, items.map((one) => one.name)
      .filter((other) => other !== name)) : null,
  });
  fill(main, page.element);
  app.setTitle(`Atlas ${name}`);
  page.show(startOf(parameters, about), { isNew: false });
  return { pick: (genotype) => page.change(genotype), unmount: () => page.destroy() };
}

function showList(main, items, unreadable) {
  const rows = items.map((one) => h('tr', {}, h('td.main', {},
    h('a', { href: `#/atlas/${encodeURIComponent(one.name)}` }, one.name)),
  [taskTitle(one.environments), count(one.bodies), `≤ ${one.voxels_max}`, one.orientations,
    score(one.best.score), bytes(one.bytes)].map((text, i) => h(i ? 'td.right' : 'td', {}, text))));
  fill(main, h('h1', {}, 'Atlases'), h('p.sentence', {}, 'An atlas has the score of every body ' +
    'of at most ten voxels: draw one, and see where it stands.'),
  items.length ? table(['Name', 'Task', 'Bodies', 'Voxels', 'Orientations', 'Best score', 'Size'],
    h('tbody', {}, rows), (_, i) => i > 1) : h('p.empty', {}, 'There is no atlas yet. ',
    h('code', {}, 'morphoctl atlas build --voxels 8 --task walk'), ' makes one.'),
  unreadable.map((one) => h('p.error', {}, `${one.name} cannot be read: ${one.reason}`)));
}
