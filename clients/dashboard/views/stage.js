/** The stage as a page of its own: any designs, or recordings, side by side or in a race. */

import { announce, button, h, select } from '../lib/dom.js';
import { CHANNELS, environmentSet, recorded, recordingPath, requested, roll } from '../lib/rollouts.js';
import { getJson, withQuery } from '../lib/api.js';
import { Player } from '../stage/player.js';
import { commandsOf, pythonOf } from '../lib/commands.js';
import { breedButton } from './forms.js';
import { titleOf } from './jobs.js';
import { actDialog, copyDialog, exportDialog, filmCommand } from './share.js';

/** At most so many robots walk at once. */
const ROBOTS_MAX = 256;
/** The link follows the view after this pause: browsers limit how often it may change. */
const KEEP_MS = 300;

export async function mount(main, path, parameters, app) {
  const source = parameters.get('evaluation') ? await recordings(parameters) : await rollouts(parameters);
  let environment = Number(parameters.get('environment') ?? 0);
  if (!Number.isInteger(environment) || environment < 0 || environment >= source.n) environment = 0;
  const stop = new AbortController();
  let known = false;
  let pending;
  // The daemon computes while the stage is made.
  const first = source.walk(environment, stop.signal);
  const player = new Player(app, { onchange: () => keepView() });

  function keepView() {
    if (!known) return; // the link's own view is still to come
    clearTimeout(pending);
    pending = setTimeout(() => app.keep({
      ...source.link(), environment, ...(player.stage ? player.view() : {}),
    }), KEEP_MS);
  }

  async function load(walking = source.walk(environment, stop.signal)) {
    player.setNote(source.founders().length ? 'Walking…' : '');
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

  const breed = breedButton(app, 'Breed these', () => source.founders(), { disabled: source.founders().length === 0 });
  const choose = select('Environment', Array.from({ length: source.n }, (_, i) => [String(i), `environment ${i}`]),
    String(environment), (value) => {
      environment = Number(value);
      announce(`environment ${value}`);
      load();
    });
  choose.firstChild.className = 'visually-hidden';
  player.toggleRow.append(choose, source.choose ? button('Robots', () => source.choose(() => {
    breed.disabled = false;
    load();
  })) : h('a.button', { href: source.href, title: 'What is shown was recorded by this evaluation' }, source.title), breed,
  button('Export', () => exportDialog(player, source.exported(environment))),
  button('Copy', () => copyDialog(source.commands(environment))));
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

/** Designs that the daemon rolls out for the stage: those of the link, or the best. */
async function rollouts(parameters) {
  const controller = parameters.get('controller') ?? 'default';
  /** The same robots under each of them. */
  const controllers = controller.split(',');
  const set = parameters.get('set') ?? 'paper-test';
  let ids = designsOf(parameters.get('designs') ?? '');
  const [environments, best] = await Promise.all([environmentSet(set),
    ids.length ? null : getJson(withQuery('v1/designs', { sort: 'score', limit: 4 }))]);
  if (best) ids = best.items.map((design) => design.id);

  async function walk(environment, signal) {
    const robots = [];
    for (const one of controllers) {
      const more = await roll(ids.map(designOf), environments[environment], { controller: one, signal });
      more.forEach((robot, i) => { robot.label = controllers.length > 1 ? one : labelOf(ids, i); });
      robots.push(...more);
    }
    return robots;
  }

  function choose(changed) {
    const text = h('textarea', { rows: 8, 'aria-label': 'Designs' });
    text.value = ids.join('\n');
    actDialog('Robots on the stage', 'Let them walk', () => {
      const lines = text.value.split(/[\s,]+/).filter(Boolean);
      const wrong = lines.find((line) => !isDesign(line.toLowerCase()));
      if (wrong || !lines.length) throw new Error(wrong ? `${wrong.slice(0, 40)} is neither an id nor 144 digits.` : 'Name a design.');
      ids = lines.slice(0, ROBOTS_MAX).map((line) => line.toLowerCase());
      changed();
    }, h('p', {}, `One design a line: an id of 36 digits, or 144 digits of voxels; at most ${ROBOTS_MAX}.`), text);
  }

  return {
    n: environments.length, walk, choose,
    link: () => ({ designs: ids.join(','), controller: controller === 'default' ? null : controller }),
    founders: () => ids.map(designOf),
    exported: (environment) => {
      const name = `morphod-${ids.length === 1 ? ids[0].replace(/0+$/, '').slice(0, 12) : 'race'}`;
      return { name, film: filmCommand(ids, { environment, set, controller: controllers[0], output: `${name}.mp4` }) };
    },
    commands: (environment) => controllers.flatMap((one) =>
      sameCommands(ids, { environments, environment, set, controller: one })),
  };
}

/** What an evaluation recorded of some of its designs. */
async function recordings(parameters) {
  const id = parameters.get('evaluation');
  const path = `v1/evaluations/${encodeURIComponent(id)}`;
  const [job, { items }] = await Promise.all([getJson(path), getJson(`${path}/environments`)]);
  if (!job.results) throw new Error('The evaluation has not ended; what it recorded can be shown then.');
  const asked = (parameters.get('rows') ?? '0').split(',').map(Number);
  const rows = asked.filter((row) => job.results[row]?.id).slice(0, ROBOTS_MAX);
  if (!rows.length) throw new Error('The evaluation has no such design.');
  const ids = rows.map((row) => job.results[row].id);
  return {
    n: items.length,
    title: titleOf({ ...job, kind: 'evaluation' }),
    href: `#/designs?evaluation=${encodeURIComponent(id)}`,
    async walk(environment, signal) {
      const robots = await recorded(id, rows, environment, signal);
      robots.forEach((robot, i) => { robot.label = labelOf(ids, i); });
      return robots;
    },
    link: () => ({ evaluation: id, rows: rows.join(',') }),
    founders: () => rows.map((row) => ({ voxels: job.results[row].genotype })),
    exported: () => ({ name: `morphod-evaluation-${id}` }),
    commands: (environment) => commandsOf({
      path: recordingPath(id, rows[0], environment), output: `evaluation-${id}-${rows[0]}.scene`,
      morphoctl: `job show ${id} --results`, python: `m.evaluation(${id}).show(${rows[0]}, ${environment}).save("robot.html")`,
    }),
  };
}

const isDesign = (text) => /^([0-9a-f]{36}|[01]{144})$/.test(text);
const designsOf = (text) => text.split(',').filter(isDesign).slice(0, ROBOTS_MAX);

/** A design in a link: an id of 36 digits, or a genotype of 144 digits, which tells its direction. */
const designOf = (text) => (text.length === 144 ? { voxels: text } : { id: text });
const shortOf = (id) => `${id.replace(/0+$/, '').slice(0, 8)}…`;

/** The name of a robot: the first digits of its id, with its place where another begins alike. */
function labelOf(ids, i) {
  if (ids[i].length === 144) return `drawn ${i + 1}`;
  const isAlone = ids.every((id, j) => i === j || shortOf(id) !== shortOf(ids[i]));
  return isAlone ? shortOf(ids[i]) : `${i + 1}: ${shortOf(ids[i])}`;
}

/** How a shell or a program rolls out the same. */
function sameCommands(ids, { environments, environment, set, controller }) {
  const [, ...film] = filmCommand(ids, { environment, set, controller, output: 'race.mp4' }).split(' ');
  return commandsOf({
    path: 'v1/rollouts', output: 'race.scene', headers: ['Accept: application/vnd.morphod.scene'],
    body: {
      designs: ids.map(designOf), controller, record: CHANNELS, environments: [requested(environments[environment])],
    },
    morphoctl: film.join(' '),
    python: `m.show(${pythonOf(ids)}, ${pythonOf(set)}, environment=${environment}, controller=${pythonOf(controller)}).save("race.html")`,
  });
}
