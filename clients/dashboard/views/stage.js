/** The stage as a page of its own: any designs, side by side or in a race. */

import { announce, button, h, select } from '../lib/dom.js';
import { environmentSet, roll } from '../lib/rollouts.js';
import { getJson, withQuery } from '../lib/api.js';
import { Player } from '../stage/player.js';
import { commandsOf, pythonOf } from '../lib/commands.js';
import { breedButton } from './forms.js';
import { copyDialog, exportDialog, filmCommand, showDialog } from './share.js';

/** At most so many robots walk at once. */
const ROBOTS_MAX = 256;
/** The link follows the view after this pause: browsers limit how often it may change. */
const KEEP_MS = 300;

export async function mount(main, path, parameters, app) {
  let ids = designsOf(parameters.get('designs') ?? '');
  let environment = Number(parameters.get('environment') ?? 0);
  const controller = parameters.get('controller') ?? 'default';
  /** The same robots under each of them. */
  const controllers = controller.split(',');
  const set = parameters.get('set') ?? 'paper-test';
  const stop = new AbortController();
  let known = false;
  let pending;

  const [environments, best] = await Promise.all([environmentSet(set),
    ids.length ? null : getJson(withQuery('v1/designs', { sort: 'score', limit: 4 }))]);
  if (!Number.isInteger(environment) || !environments[environment]) environment = 0;
  if (best) ids = best.items.map((design) => design.id);
  async function walk() {
    const robots = [];
    for (const one of controllers) {
      const more = await roll(ids.map(designOf), [environments[environment]], { controller: one, signal: stop.signal });
      more.forEach((robot, i) => { robot.label = controllers.length > 1 ? one : labelOf(ids[i], i); });
      robots.push(...more);
    }
    return robots;
  }
  // The daemon computes while the stage is made.
  const first = walk();
  const player = new Player(app, { onchange: () => keepView() });

  function keepView() {
    if (!known) return; // the link's own view is still to come
    clearTimeout(pending);
    pending = setTimeout(() => app.keep({
      designs: ids.join(','), environment, controller: controller === 'default' ? null : controller,
      ...(player.stage ? player.view() : {}),
    }), KEEP_MS);
  }

  async function load(walking = walk()) {
    player.setNote(ids.length ? 'Walking…' : '');
    try {
      const robots = await walking;
      player.setRobots(robots, { keepTime: known });
      player.setNote(robots.length ? '' :
        'No design is stored yet. Draw one in the editor, or start a campaign on the overview.');
      if (!known && player.stage) player.setView(parameters);
      known = true;
      keepView();
    } catch (error) {
      if (!stop.signal.aborted) player.setNote(error.message);
    }
  }

  function chooseRobots() {
    const text = h('textarea', { rows: 8, 'aria-label': 'Designs' });
    text.value = ids.join('\n');
    const fault = h('p.error', { role: 'alert' });
    const dialog = showDialog('Robots on the stage',
      h('p', {}, `One design a line: an id of 36 digits, or 144 digits of voxels; at most ${ROBOTS_MAX}.`), text, fault,
      button('Let them walk', () => {
        const lines = text.value.split(/[\s,]+/).filter(Boolean);
        const wrong = lines.find((line) => !isDesign(line.toLowerCase()));
        if (wrong || !lines.length) {
          fault.textContent = wrong ? `${wrong.slice(0, 40)} is neither an id nor 144 digits.` : 'Name a design.';
          return;
        }
        ids = lines.slice(0, ROBOTS_MAX).map((line) => line.toLowerCase());
        dialog.close();
        breed.disabled = false;
        load();
      }, { class: 'primary' }));
  }

  const breed = breedButton(app, 'Breed these', () => ids.map(designOf), { disabled: ids.length === 0 });
  const choose = select('Environment', environments.map((_, i) => [String(i), `environment ${i}`]),
    String(environment), (value) => {
      environment = Number(value);
      announce(`environment ${value}`);
      load();
    });
  choose.firstChild.className = 'visually-hidden';
  player.controls.append(choose, button('Robots', chooseRobots),
    breed,
    button('Export', () => exportDialog(player, { ids, environment, set, controller: controllers[0] })),
    button('Copy', () => copyDialog(controllers.flatMap((one) => sameCommands(ids, { environments, environment, set, controller: one })))));
  main.replaceChildren(h('h1.visually-hidden', {}, 'Stage'), player.element);
  load(first);
  return {
    unmount() {
      clearTimeout(pending);
      stop.abort();
      player.destroy();
    },
  };
}

const isDesign = (text) => /^([0-9a-f]{36}|[01]{144})$/.test(text);
const designsOf = (text) => text.split(',').filter(isDesign).slice(0, ROBOTS_MAX);

/** A design in a link: an id of 36 digits, or a genotype of 144 digits, which tells its direction. */
const designOf = (text) => (text.length === 144 ? { voxels: text } : { id: text });
const labelOf = (text, i) => (text.length === 144 ? `drawn ${i + 1}` : `${text.replace(/0+$/, '').slice(0, 8)}…`);

/** How a shell or a program rolls out the same. */
function sameCommands(ids, { environments, environment, set, controller }) {
  const { light_xy_m, terrain_heights_m } = environments[environment];
  const [, ...film] = filmCommand(ids, { environment, set, controller, output: 'race.mp4' }).split(' ');
  return commandsOf({
    path: 'v1/rollouts', output: 'race.scene', headers: ['Accept: application/vnd.morphod.scene'],
    body: {
      designs: ids.map(designOf), controller, record: ['masses', 'actuation', 'contacts'],
      environments: [{ light_xy_m, terrain_heights_m }],
    },
    morphoctl: film.join(' '),
    python: `m.show(${pythonOf(ids)}, ${pythonOf(set)}, environment=${environment}, controller=${pythonOf(controller)}).save("race.html")`,
  });
}
