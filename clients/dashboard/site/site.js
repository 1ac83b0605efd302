/** The page of an atlas without a service: tools/atlas-site puts it next to an atlas file. */

import { announce, button, fill, h } from '../lib/dom.js';
import { countOf, score } from '../lib/format.js';
import { decodeScene, robotsOf } from '../lib/scene.js';
import { AtlasFile } from '../lib/atlas_file.js';
import { AtlasPage, startOf } from '../views/atlas_page.js';
import { AtlasPairs } from '../views/atlas_pairs.js';
import { AtlasWalk } from '../views/atlas_walk.js';

const main = document.getElementById('main');
const app = {
  theme: 'dark',
  themeListeners: new Set(),
  /** Keeps the body in the link. */
  keep: ({ voxels }) => history.replaceState(null, '', `#voxels=${voxels}`),
  setTitle: () => {},
};

function setTheme(theme) {
  app.theme = theme;
  document.documentElement.dataset.theme = theme;
  for (const listener of app.themeListeners) listener(theme);
}

async function load(path, as) {
  const response = await fetch(path);
  if (!response.ok) throw new Error(`${path} is missing (status ${response.status}).`);
  return response[as]();
}

async function show() {
  const site = await load('site.json', 'json');
  const atlas = new AtlasFile(await load(site.file, 'arrayBuffer'), site.name);
  const about = await atlas.about();
  const recorded = new Map(site.recordings.map((one) => [one.id, one.file]));
  const walker = new AtlasWalk(app, async (genotype, id) => {
    const file = recorded.get(id);
    if (!file) {
      return { robot: null, words: recorded.size
        ? `This page has no service to compute a walk. It has recordings of ${recorded.size} ` +
          'bodies, including the best of each size.'
        : 'This page has no recordings, and no service to compute a walk.' };
    }
    const [robot] = robotsOf(decodeScene(await load(file, 'arrayBuffer')));
    return { robot, words: 'Recorded in the first of ' +
      `${countOf(about.environments.length, 'environment')}, ` +
      `in its canonical orientation, with the controller and physics of the atlas, ` +
      `${about.physics.slice(0, 8)}: loss ${score(robot.loss)}` };
  });
  const theme = button('', () => setTheme(app.theme === 'dark' ? 'light' : 'dark'));
  const nameTheme = () => {
    theme.textContent = app.theme === 'dark' ? 'Light theme' : 'Dark theme';
  };
  app.themeListeners.add(nameTheme);
  nameTheme();
  const page = new AtlasPage(atlas, about, { app, walker, others: theme,
    pairs: about.measures.length ? (of) => new AtlasPairs(of) : null });
  fill(main, page.element);
  const start = () => page.change(
    startOf(new URLSearchParams(location.hash.slice(1)), about));
  start();
  addEventListener('hashchange', start);
}

setTheme(matchMedia('(prefers-color-scheme: light)').matches ? 'light' : 'dark');
document.querySelector('#toast button').addEventListener('click', () => announce(''));
show().catch((error) => fill(main, h('h1', {}, 'This atlas cannot be shown'),
  h('p.error', { role: 'alert' }, error.message)));
