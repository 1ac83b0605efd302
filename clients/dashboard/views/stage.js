/** The stage as a page of its own: any designs, side by side or in a race. */

import { announce, button, h, select } from '../lib/dom.js';
import { environmentSet, roll } from '../lib/rollouts.js';
import { getJson, withQuery } from '../lib/api.js';
import { Player } from '../stage/player.js';
import { shellWord } from '../lib/format.js';
import { copyDialog, exportDialog, filmCommand } from './share.js';

/** At most so many robots walk at once. */
const ROBOTS_MAX = 256;

export async function mount(main, path, parameters, app) {
  let ids = (parameters.get('designs') ?? '').split(',').filter(isDesign).slice(0, ROBOTS_MAX);
  let environment = Number(parameters.get('environment') ?? 0);
  let controller = parameters.get('controller') ?? 'default';
  const set = parameters.get('set') ?? 'paper-test';
  const stop = new AbortController();

  const [environments, best] = await Promise.all([environmentSet(set),
    ids.length ? null : getJson(withQuery('v1/designs', { sort: 'score', limit: 4 }))]);
  if (!Number.isInteger(environment) || !environments[environment]) environment = 0;
  if (best) ids = best.items.map((design) => design.id);
  const walk = () => roll(ids.map(designOf), [environments[environment]], { controller, signal: stop.signal });
  // The daemon computes while the stage is made.
  const first = walk();
  const player = new Player(app, { onchange: () => keepView() });

  function keepView() {
    app.keep({
      designs: ids.join(','), environment, controller: controller === 'default' ? null : controller,
      view: player.stage?.follow ? null : player.stage?.camera.toText(), show: player.shown().join(','),
    });
  }

  async function load(walking = walk()) {
    player.setNote(ids.length ? 'Walking…' : '');
    try {
      const robots = await walking;
      robots.forEach((robot, i) => { robot.label = labelOf(ids[i]); });
      player.setRobots(robots);
      player.setNote(robots.length ? '' :
        'No design is stored yet. Draw one in the editor, or start a campaign on the overview.');
      keepView();
    } catch (error) {
      if (!stop.signal.aborted) player.setNote(error.message);
    }
  }

  const choose = select('Environment', environments.map((_, i) => [String(i), `environment ${i}`]),
    String(environment), (value) => {
      environment = Number(value);
      announce(`environment ${value}`);
      load();
    });
  choose.firstChild.className = 'visually-hidden';
  player.controls.append(choose,
    button('Export', () => exportDialog(player, { ids, environment, set, controller })),
    button('Copy', () => copyDialog([
      ['curl', curlOf(ids, environments[environment], controller)],
      ['morphoctl', filmCommand(ids, { environment, set, controller, output: 'race.mp4' })],
    ])));
  main.replaceChildren(h('h1.visually-hidden', {}, 'Stage'), player.element);
  const shown = parameters.get('show');
  if (shown !== null && player.stage) player.setShown(shown.split(','));
  const view = parameters.get('view');
  if (view && player.stage?.camera.fromText(view)) player.followToggle.click();
  load(first);
  return {
    unmount() {
      stop.abort();
      player.destroy();
    },
  };
}

const isDesign = (text) => /^([0-9a-f]{36}|[01]{144})$/.test(text);

/** A design in a link: an id of 36 digits, or a genotype of 144 digits, which tells its direction. */
const designOf = (text) => (text.length === 144 ? { voxels: text } : { id: text });
const labelOf = (text) => (text.length === 144 ? 'drawn' : `${text.replace(/0+$/, '').slice(0, 8)}…`);

function curlOf(ids, environment, controller) {
  const body = {
    designs: ids.map(designOf), controller, record: ['masses', 'actuation', 'contacts'],
    environments: [{ light_xy_m: environment.light_xy_m, terrain_heights_m: environment.terrain_heights_m }],
  };
  return `curl -s ${new URL('v1/rollouts', document.baseURI)} -H 'Content-Type: application/json' \\\n` +
    `  -H 'Accept: application/vnd.morphod.scene' -d ${shellWord(JSON.stringify(body))} -o race.scene`;
}
