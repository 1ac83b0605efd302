/** Designs: the leaderboard, and one design. */

import { LinkError, getJson, withQuery } from '../lib/api.js';
import { genotypeOfId } from '../lib/body.js';
import { button, fill, h, select, table } from '../lib/dom.js';
import { pythonOf } from '../lib/commands.js';
import { ago, countOf, scoreBy, scoreOf, shellWord, voxels as inVoxels } from '../lib/format.js';
import { nameOf, shortOf } from '../lib/names.js';
import { picture } from '../lib/picture.js';
import { environmentSet, roll } from '../lib/rollouts.js';
import { TASKS } from '../lib/tasks.js';
import { Player } from '../stage/player.js';
import { trayButton } from './add.js';
import { announced, copyButton } from './share.js';
import { breedButton } from './start_buttons.js';
import { Wall } from './wall.js';

const PAGE = 48;
/** Orders of the leaderboard, as parameters of the list of designs. */
const ORDERS = {
  best: { sort: 'score' }, worst: { sort: 'score', order: 'descending' },
  oldest: { sort: 'id' }, newest: { sort: 'id', order: 'descending' },
};

export async function mount(main, [id], parameters, app) {
  if (id) return mountDesign(main, id, app);
  return mountBoard(main, parameters, app);
}

async function mountBoard(main, parameters, app) {
  let controller = parameters.get('controller') ?? 'default';
  let order = parameters.get('order') ?? 'best';
  if (!Object.hasOwn(ORDERS, order)) {
    throw new LinkError(`order=${order}; expected one of ${Object.keys(ORDERS).join(', ')}.`);
  }
  const controllers = (await getJson('v1/controllers?limit=200')).items.map(({ name }) => name)
    .filter(Boolean);
  if (!controllers.includes(controller)) {
    throw new LinkError(`controller=${controller}: no controller has this name.`);
  }
  // Only scores in a named set are ranked.
  const task = app.task.set ? app.task : TASKS[0];
  const set = task === TASKS[0] ? null : task.set;
  const wall = new Wall(app);
  const foot = h('div.row');
  const panel = h('section.panel', { 'aria-label': 'Leaderboard' }, wall.element);
  let cursor;

  const asked = () => ({ ...ORDERS[order],
    ...(ORDERS[order].sort === 'score' ? { controller, environments: set } : {}) });
  const given = () => Object.entries(asked()).filter(([, value]) => value);

  async function more(limit = PAGE) {
    const page = await getJson(withQuery('v1/designs', { ...asked(), cursor, limit }));
    cursor = page.next_cursor;
    wall.add(page.items.map((design) =>
      ({ ...design, genotype: design.scored_genotype ?? design.genotype })));
    const shown = wall.element.childElementCount;
    panel.hidden = shown === 0;
    app.remember({ shown });
    fill(foot, cursor === null ? null : button('Show more', () => announced(more)),
      h('span.muted', {}, shown ? `${countOf(shown, 'design')} shown`
        : set ? `No design has a score in ${set} with this controller yet. To get scores, ` +
          'run an evaluation in this set.'
        : 'No design has a score with this controller yet. Evaluations and campaigns compute ' +
          'scores; start one on the page Runs.'));
  }

  async function again(limit = PAGE) {
    wall.options = { ...(controller !== 'default' && { controller }), ...(set && { set }) };
    cursor = undefined;
    wall.element.replaceChildren();
    app.keep({ controller, order });
    await more(limit);
  }

  main.replaceChildren(h('div.title', {}, h('h1', {}, 'Designs'),
    h('span.muted', {}, task === app.task ? '' : `${app.task.title} has no fixed set of ` +
      'worlds, so designs cannot be ranked by it. Shown instead: ', `${task.title}: score, the ` +
      `mean loss over the ten worlds of ${task.set}; lower is better`),
    h('div.actions', {},
    select('Order', Object.keys(ORDERS).map((key) => [key, `${key} first`]), order, (value) => {
      order = value;
      announced(again);
    }), select('Controller', controllers, controller, (value) => {
      controller = value;
      announced(again);
    }), wall.watch, wall.keep, wall.breed, copyButton(() => ({
      path: withQuery('v1/designs', { ...asked(), limit: PAGE }),
      morphoctl: ['design list',
        ...given().flatMap(([key, value]) => [`--${key}`, shellWord(value)])].join(' '),
      python: `print(m.designs(${
        given().map(([key, value]) => `${key}=${pythonOf(value)}`).join(', ')}))`,
    })))), panel, foot);
  // After a return to the page, show as many as before.
  await again(Math.min(1000, app.remembered().shown || PAGE));
  return {};
}

async function mountDesign(main, id, app) {
  const stop = new AbortController();
  const design = await getJson(`v1/designs/${encodeURIComponent(id)}`);
  const name = design.id + (/@[0-7]$/.exec(id)?.[0] ?? ''); // from the link: a robot, or an id
  const player = new Player(app, { height: 420 });
  /** Returns the design as a robot for the tray, in the orientation of the link, or else the best
   * one. */
  const kept = () => {
    const robot = name.includes('@') ? name : design.orientations[0]?.robot ?? `${name}@0`;
    return { robot, genotype: genotypeOfId(robot) };
  };
  const scored = design.orientations.flatMap((orientation) =>
    orientation.scores.map((one) => ({ ...one, robot: orientation.robot })));
  main.replaceChildren(
    h('div.title', {}, h('h1', {}, nameOf(name)), h('code', {}, name), h('div.actions', {},
      h('a.button', { href: `#/lab?design=${name}` }, 'Edit'),
      h('a.button', { href: `#/stage?designs=${name}` }, 'Stage'),
      trayButton(() => [kept()]), breedButton(app, 'Breed', () => [{ id: name }]),
      copyButton(() => ({ path: `v1/designs/${design.id}`, morphoctl: `design show ${name}` })))),
    h('div.grid', {}, h('section.panel.row.portrait', {}, picture(genotypeOfId(name), 'The design'),
      h('div.stack', {}, h('strong', {}, inVoxels(design.voxels)),
        h('div', {}, `${design.masses} masses`),
        h('div', {}, `${design.springs} springs`),
        h('div.muted', {}, `first seen ${ago(design.first_seen_at)}`))),
    h('section.panel.flush', { 'aria-label': 'Stage' }, player.element)),
    h('p.muted', {}, 'It walks in environment 0 of paper-test, under the controller default.'),
    h('section.panel.stack', {}, h('h2', {}, 'Scores'), scored.length ? h('div.scroll', {}, table(
      ['Score', 'Orientation', 'Controller', 'Environments', 'Computed', 'Class', 'Origin'],
      h('tbody', {}, scored.map((one) => h('tr', {},
        h('td', { 'data-name': 'Score' }, scoreOf(one)),
        h('td', { 'data-name': 'Orientation' },
          h('a', { href: `#/designs/${one.robot}` }, one.robot.slice(36))),
        h('td', { 'data-name': 'Controller' }, h('code', {}, one.controller.slice(0, 12))),
        h('td', {}, Array.isArray(one.environments)
          ? countOf(one.environments.length, 'environment') : String(one.environments)),
        h('td', {}, ago(one.computed_at)), h('td', {}, one.fingerprint),
        h('td', {}, one.origin))))))
      : h('p.empty', {}, 'No score is stored for this design.')),
    h('section.panel.stack', {}, h('h2', {}, 'Campaigns'), design.campaigns.length
      ? h('ul', {}, design.campaigns.map((one) => h('li', {},
        h('a', { href: `#/campaigns/${one.campaign}` }, `campaign ${one.campaign}`),
        `: number ${one.number}, ${one.operator}, born in generation ${one.born}, ` +
        scoreBy(one.own_score, one))))
      : h('p.empty', {}, 'It was not born in a campaign.')));
  app.setTitle(`${nameOf(name)}, ${shortOf(name)}`);
  const environments = await environmentSet('paper-test');
  roll([{ id: name }], environments[0], { signal: stop.signal })
    .then((robots) =>
      player.setRobots(robots.map((robot) => ({ ...robot, label: nameOf(robot.robot) }))))
    .catch((error) => { if (!stop.signal.aborted) player.setNote(error.message); });
  return {
    unmount() {
      stop.abort();
      player.destroy();
    },
  };
}
