/** The stage as a page: any designs, or recordings, side by side or in a race. */

import { button, choice, fill, h } from '../lib/dom.js';
import {
  CHANNELS, recorded, recordingPath, requested, roll, worldOfJob, worldOfSet,
} from '../lib/rollouts.js';
import { LinkError, getJson, withQuery } from '../lib/api.js';
import { Player, SPEEDS } from '../stage/player.js';
import { commandsOf, pythonOf } from '../lib/commands.js';
import { genotypeOfId, robotOf } from '../lib/body.js';
import { countOf } from '../lib/format.js';
import { asJob, linkOf, titleOf } from '../lib/kinds.js';
import { nameOf } from '../lib/names.js';
import { POINTS_MAX, pointsIn, pointsText } from '../lib/tasks.js';
import { trayButton } from './add.js';
import { Driving } from './drive.js';
import { announced, copyDialog, exportDialog, filmCommand, filmOf, formDialog } from './share.js';
import { breedButton } from './start_buttons.js';

/** Maximum number of robots that walk at once. */
const ROBOTS_MAX = 256;
/** The link is updated after this pause, because browsers limit how often it may change. */
const KEEP_MS = 300;

export async function mount(main, path, parameters, app) {
  const source = await (parameters.get('evaluation') ? recordings(parameters)
    : rollouts(parameters));
  checkView(parameters, source);
  let environment = Number(parameters.get('environment') ?? 0);
  let known = false;
  let pending;
  // The daemon computes while the stage is set up.
  let walk = { stop: new AbortController(), more: () => {} };
  const begin = () => {
    walk.stop.abort();
    const mine = { stop: new AbortController(), more: (robots) => {} };
    walk = mine;
    return source.walk(environment, mine.stop.signal, (robots) => mine.more(robots));
  };
  const first = begin();
  const player = new Player(app, { onchange: () => keepView() });
  if (source.driven && player.stage) new Driving(player, () => source.driven(environment));

  function keepView() {
    if (!known) return; // the view in the link has not been applied yet
    clearTimeout(pending);
    pending = setTimeout(() => app.keep({
      ...source.link(), environment, ...(player.stage && !player.live ? player.view() : {}),
    }), KEEP_MS);
  }

  async function load(walking = begin()) {
    const { stop } = walk;
    const of = source.nRobots();
    let n = 0;
    player.setNote(source.founders().length ? 'Walking…' : '');
    const show = (robots) => {
      if (stop.signal.aborted) return;
      player.setComing(robots.length, of);
      player.setRobots(robots, { keepTime: known || n > 0, isMore: n > 0 });
      player.setNote(robots.length ? '' :
        'No design is stored yet. Build one in the Lab or start a campaign.');
      if (!known && player.stage) player.setView(parameters, n > 0);
      n = robots.length;
    };
    walk.more = show;
    try {
      const robots = await walking;
      show(robots);
      import('./certificate_badges.js').then((to) => to.markStage(player, robots, stop.signal));
      known = true;
      keepView();
    } catch (error) {
      if (!stop.signal.aborted) player.setNote(error.message);
    }
  }

  const breed = breedButton(app, 'Breed these', () => source.founders(),
    { disabled: source.founders().length === 0 });
  const places = Array.from({ length: source.n }, (_, i) => [String(i), `environment ${i}`]);
  const choose = choice('Environment', places, String(environment), (value) => {
    environment = Number(value);
    load();
  });
  const robots = source.choose ? button('Robots', () => source.choose(() => {
    breed.disabled = false;
    load();
  })) : null;
  const keep = trayButton(() => source.founders().map(bodyIn));
  const words = h('span.muted.world', {}, source.world);
  /** A path drawn here replaces the light of the world. */
  const ground = h('div.panel', { id: 'draw', popover: true, onbeforetoggle: async (event) => {
    if (event.newState !== 'open') return;
    const { pathPad } = await import('./draw_path.js');
    fill(ground, pathPad(app, pointsIn(source.link().path ?? '') ?? [], (points) =>
      announced(async () => {
        fill(words, await source.follow(points));
        load();
      }), true));
  } });
  player.toggleRow.append(choose, ...(robots ? [robots] : []), keep, breed,
    ...(source.follow ? [button('Draw a path', () => {}, { popovertarget: 'draw' }), ground] : []),
    button('Export', () => exportDialog(player, source.exported(environment))),
    button('Commands', () => copyDialog(source.commands(environment))),
    words);
  main.replaceChildren(h('h1.visually-hidden', {}, 'Stage'), player.element);
  load(first);
  return {
    unmount() {
      clearTimeout(pending);
      walk.stop.abort();
      player.destroy();
    },
  };
}

/** Rejects a link with an invalid view. @param {URLSearchParams} parameters */
function checkView(parameters, { n, nRobots: count }) {
  const nRobots = count();
  const check = (name, isRight, expected) => {
    const value = parameters.get(name);
    if (value !== null && !isRight(value)) {
      throw new LinkError(`${name}=${value.slice(0, 60)}; expected ${expected}.`);
    }
  };
  const isBelow = (end) => (value) => /^\d+$/.test(value) && Number(value) < end;
  const isAmong = (names) => (value) => value.split(',').every((one) => names.includes(one));
  check('environment', isBelow(n), `a number from 0 to ${n - 1}`);
  if (nRobots) check('follow', isBelow(nRobots), `the number of a robot, from 0 to ${nRobots - 1}`);
  check('time', (value) => value !== '' && Number(value) >= 0, 'a number of seconds');
  const speeds = SPEEDS.map(([value]) => value);
  check('speed', isAmong(speeds), `one of ${speeds.join(', ')}`);
  const names = ['skin', 'springs', 'contacts', 'trails', 'actuation', 'side', 'ghosts'];
  check('show', isAmong(['', ...names]), `a list of ${names.join(', ')}`);
  const number = String.raw`-?\d+(\.\d+)?`;
  check('view', (value) => new RegExp(`^${number}(_${number}){5}$`).test(value),
    'a camera as six numbers');
}

/** Loads the world in a link: that of a job, or a set of environments; and the path of the light,
 * if any. */
async function worldIn(parameters, path = parameters.get('path')) {
  const world = await placesIn(parameters);
  if (!path) return world;
  const points = pointsIn(path);
  if (!points) {
    throw new LinkError(`path=${path.slice(0, 60)}; expected 1 to ${POINTS_MAX} waypoints, ` +
      'as x_y,x_y.');
  }
  const task = { guide: { kind: 'path', points_m: points }, objective: 'follow' };
  return {
    ...world, set: null, words: `${world.words}, with a custom path`,
    environments: world.environments.map((environment) => {
      const { light_xy_m, sha256, ...ground } = environment;
      return { ...ground, task };
    }),
  };
}

/** Loads the world that a link names. */
async function placesIn(parameters) {
  const name = parameters.get('world');
  if (!name) {
    return worldOfSet(parameters.get('set') ?? 'paper-test',
      parameters.get('controller') ?? 'default');
  }
  const [, kind, id] = /^(campaign|evaluation)-(\d+)$/.exec(name) ?? [];
  if (!kind) {
    throw new LinkError(`world=${name.slice(0, 60)}; expected campaign-N or evaluation-N.`);
  }
  return worldOfJob(kind, await getJson(`v1/${kind}s/${id}`));
}

/** Loads the designs that the daemon simulates for the stage: those in the link, or the best. */
async function rollouts(parameters) {
  let ids = designsOf(parameters.get('designs') ?? '');
  const [world, best] = await Promise.all([worldIn(parameters),
    ids.length ? null : getJson(withQuery('v1/designs', { sort: 'score', limit: 4 }))]);
  if (best) ids = best.items.map((design) => design.robot);
  const { physics, precision } = world;
  /** The same robots with each controller. */
  const controllers = parameters.get('controller')?.split(',') ?? [world.controller];

  async function walk(environment, signal, onmore) {
    const robots = [];
    for (const controller of controllers) {
      const more = await roll(ids.map(designOf), world.environments[environment],
        { controller, physics, precision, signal, onmore: (some) => {
          onmore([...robots, ...named(some, controller)]);
        } });
      robots.push(...named(more, controller));
      if (robots.length < ids.length * controllers.length) onmore([...robots]);
    }
    return robots;
  }

  function named(some, controller) {
    // An id without an orientation becomes a robot, which stays the same in other environments.
    some.forEach(({ robot }, i) => { if (ids[i].length === 36) ids[i] = robot; });
    some.forEach((robot, i) => {
      robot.label = controllers.length > 1 ? controller : labelOf(ids, i);
      if (controllers.length > 1) robot.controller = controller;
    });
    return some;
  }

  function choose(changed) {
    const text = h('textarea', { rows: 8, 'aria-label': 'Designs' });
    text.value = ids.join('\n');
    formDialog('Robots on the stage', 'Watch them walk', () => {
      const lines = text.value.split(/[\s,]+/).filter(Boolean).join(',').toLowerCase();
      if (!lines) throw new Error('Name a design.');
      ids = designsOf(lines);
      changed();
    }, h('p.wide', {}, 'One design per line: a robot (ID@K), an id of 36 digits, or 144 ' +
      `voxel digits; at most ${ROBOTS_MAX}.`), h('div.stack.wide', {}, text));
  }

  const how = (environment, controller, output) => ({ world, environment, controller, output });
  return {
    n: world.environments.length, nRobots: () => ids.length * controllers.length, walk, choose,
    world: world.words,
    link: () => ({
      designs: ids.join(','), world: parameters.get('world'), set: parameters.get('set'),
      controller: parameters.get('controller'), path: parameters.get('path'),
    }),
    founders: () => ids.map(designOf),
    async follow(points) {
      const path = pointsText(points);
      Object.assign(world, await worldIn(parameters, path));
      parameters.set('path', path);
      return world.words;
    },
    driven: (environment) => ({
      environment: world.environments[environment], number: environment, controller: controllers[0],
      physics, precision, world: parameters.get('world'), set: parameters.get('set'),
      name: 'morphod',
    }),
    exported: (environment) => {
      const one = ids.length === 1 ? ids[0].replace(/0+$/, '').slice(0, 12) : 'race';
      const name = `morphod-${one}`;
      return { name, film: filmCommand(ids, how(environment, controllers[0], `${name}.mp4`)) };
    },
    commands: (environment) => controllers.flatMap((controller) =>
      sameCommands(ids, how(environment, controller, 'race.mp4'))),
  };
}

/** Loads the recordings of some designs of an evaluation. */
async function recordings(parameters) {
  const id = parameters.get('evaluation');
  const path = `v1/evaluations/${encodeURIComponent(id)}`;
  const [job, { items }] = await Promise.all([getJson(path), getJson(`${path}/environments`)]);
  if (!job.results) {
    throw new LinkError('The evaluation has not ended; its recordings can be shown after that.');
  }
  const rows = (parameters.get('rows') ?? '0').split(',').map(Number);
  const wrong = rows.find((row) => !job.results[row]?.id);
  if (wrong !== undefined) {
    throw new LinkError(`rows=${parameters.get('rows')}: the evaluation has no design ${wrong}.`);
  }
  checkCount(rows.length);
  const ids = rows.map((row) => job.results[row].robot);
  return {
    n: items.length, nRobots: () => rows.length,
    world: ['Recorded by ', h('a', { href: linkOf(asJob('evaluation', job)) },
      titleOf(asJob('evaluation', job)))],
    async walk(environment, signal, onmore) {
      const named = (robots) => robots.map((robot, i) => ({ ...robot, label: labelOf(ids, i) }));
      return named(await recorded(id, rows, environment, signal,
        (robots) => onmore(named(robots))));
    },
    link: () => ({ evaluation: id, rows: rows.join(',') }),
    founders: () => rows.map((row) => ({ voxels: job.results[row].genotype })),
    exported: () => ({ name: `morphod-evaluation-${id}` }),
    commands: (environment) => commandsOf({
      path: recordingPath(id, rows[0], environment), output: `evaluation-${id}-${rows[0]}.scene`,
      morphoctl: `job show ${id} --results`,
      python: `m.evaluation(${id}).show(${rows[0]}, ${environment}).save("robot.html")`,
    }),
  };
}

const isDesign = (text) => /^([0-9a-f]{36}(@[0-7])?|[01]{144})$/.test(text);

function checkCount(n) {
  if (n > ROBOTS_MAX) {
    throw new LinkError(`There are ${countOf(n, 'robot')}; at most ${ROBOTS_MAX} walk at once.`);
  }
}

/** Reads a list of designs; rejects anything else. */
function designsOf(text) {
  const all = text.split(',').filter(Boolean);
  const wrong = all.find((one) => !isDesign(one));
  if (wrong) {
    throw new LinkError(`${wrong.slice(0, 40)} is not a design; expected a robot (ID@K), ` +
      'an id of 36 hexadecimal digits, or 144 voxel digits.');
  }
  checkCount(all.length);
  return all;
}

/** Returns a design in a link: a robot (ID@K), an id, or a genotype of 144 digits. */
const designOf = (text) => (text.length === 144 ? { voxels: text } : { id: text });
const spokenOf = (text) => nameOf(text.length === 144 ? robotOf(text) : text);

/** Returns the name of a robot, with its position if another has the same. */
function labelOf(ids, i) {
  const name = spokenOf(ids[i]);
  const isAlone = ids.every((id, j) => i === j || spokenOf(id) !== name);
  return isAlone ? name : `${i + 1}: ${name}`;
}

/** Returns the body of a design in a request, for the tray. */
function bodyIn({ id, voxels }) {
  const robot = id?.length === 36 ? `${id}@0` : id ?? robotOf(voxels);
  return { robot, genotype: voxels ?? genotypeOfId(robot) };
}

/** Returns commands that run the same simulation from a shell or a program. */
function sameCommands(ids, how) {
  const { world: { set, environments, physics, precision }, environment, controller } = how;
  const { words, input } = filmOf(ids, how);
  const one = requested(environments[environment]);
  const places = set ? `${pythonOf(set)}, environment=${environment}` : pythonOf([one]);
  const rest = physics ? `, physics=${pythonOf(physics)}` : '';
  const given = `${pythonOf(ids)}, ${places}, controller=${pythonOf(controller)}${rest}`;
  const isDouble = precision === 'float64';
  return commandsOf({
    path: 'v1/rollouts', output: 'race.scene', headers: ['Accept: application/vnd.morphod.scene'],
    body: {
      designs: ids.map(designOf), controller, record: CHANNELS, environments: [one],
      ...(physics ? { physics } : {}), ...(isDouble ? { precision } : {}),
    },
    // Films and separate pages are made in float32.
    morphoctl: isDouble ? null : words, input,
    python: isDouble ? `scene = m.rollouts(${pythonOf(ids)}, environments=${pythonOf([one])}, ` +
      `controller=${pythonOf(controller)}${rest}, precision="float64")`
      : `m.show(${given}).save("race.html")`,
  });
}
