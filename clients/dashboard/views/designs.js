/** Designs: the leaderboard, the results of one evaluation, and one design. */

import { LinkError, getJson, withQuery } from '../lib/api.js';
import { genotypeOfId } from '../lib/body.js';
import { button, fill, h, say, select, table } from '../lib/dom.js';
import { coalesced } from '../lib/events.js';
import { pythonOf } from '../lib/commands.js';
import {
  ago, bytes, count, countOf, score, scoreBy, scoreOf, shellWord, voxels as inVoxels,
} from '../lib/format.js';
import { picture } from '../lib/picture.js';
import { environmentSet, isSuite, roll } from '../lib/rollouts.js';
import { meters } from '../lib/tasks.js';
import { Player } from '../stage/player.js';
import { breedButton } from './forms.js';
import { JobParts, shortProgress, titleOf } from './jobs.js';
import { ResultPanels } from './results.js';
import { announced, copyButton } from './share.js';

const PAGE = 48;
/** How many pages of 1,000 results are read from an evaluation that is too large to have a list. */
const PAGES_MAX = 10;
/** Orders of the leaderboard, as parameters of the list of designs. */
const ORDERS = {
  best: { sort: 'score' }, worst: { sort: 'score', order: 'descending' },
  oldest: { sort: 'id' }, newest: { sort: 'id', order: 'descending' },
};

export async function mount(main, [id], parameters, app) {
  if (id) return mountDesign(main, id, app);
  if (parameters.get('evaluation')) return mountEvaluation(main, parameters.get('evaluation'), app);
  return mountBoard(main, parameters, app);
}

/** Formats a result: its value in meters if its task has one, or else its score. */
const wordsOf = (design) => (design.unit === 'm' && !design.lower_bound && design.value !== null
  ? meters(design.value) : scoreOf(design));

/** Cards of designs that can be selected for the stage. The selection is kept with the history. */
class Wall {
  constructor(app) {
    this.app = app;
    /** Further parameters of the stage: the controller, or the world of the scores. */
    this.options = {};
    this.chosen = new Map(app.remembered().chosen); // {id, row} by genotype
    /** Called after each change of the selection. */
    this.changed = () => {};
    this.element = h('div.grid.small');
    this.watch = button('Watch selected', () => app.go('stage', {
      designs: [...this.chosen.keys()].join(','), ...this.options,
    }), { class: 'primary' });
    this.breed = breedButton(app, 'Breed these', () => this.#founders());
    this.#offer();
  }

  #offer() {
    const n = this.chosen.size;
    this.watch.disabled = this.breed.disabled = n === 0;
    this.watch.title = n ? `${countOf(n, 'design')} selected` : 'Select designs first';
  }

  card(design) {
    const { id, robot = id, genotype, voxels, row } = design;
    const shown = design.score === undefined ? '–' : wordsOf(design);
    const card = h('button.card', {
      type: 'button', 'aria-pressed': String(this.chosen.has(genotype)),
      'aria-label': `Design ${robot}, score ${shown}, ${inVoxels(voxels)}`,
      onclick: () => {
        const on = !this.chosen.delete(genotype);
        if (on) this.chosen.set(genotype, { id, row });
        card.setAttribute('aria-pressed', String(on));
        this.#offer();
        this.app.remember({ chosen: [...this.chosen] });
        this.changed();
      },
      ondblclick: () => this.app.go(`designs/${robot}`),
    }, picture(genotype), h('strong.number', {}, shown),
    design.isBest ? h('span.crown', {}, '♛ of the best') : null,
    h('span.muted', {}, inVoxels(voxels)));
    const link = { href: `#/designs/${robot}`, 'aria-label': `Design ${robot}` };
    return h('div.pick', {}, card, h('a', link, `${id.slice(0, 10)}…${robot.slice(36)}`));
  }

  /** The selected designs, each form once: a design may be here in several orientations. */
  #founders() {
    const byId = new Map([...this.chosen].reverse().map(([voxels, { id }]) => [id, { voxels }]));
    return [...byId.values()].reverse();
  }

  add(designs) {
    this.element.append(...designs.map((design) => this.card(design)));
  }
}

async function mountBoard(main, parameters, app) {
  let controller = parameters.get('controller') ?? 'default';
  let order = parameters.get('order') ?? 'best';
  if (!Object.hasOwn(ORDERS, order)) {
    throw new LinkError(`order=${order}: one of ${Object.keys(ORDERS).join(', ')} is expected.`);
  }
  const controllers = (await getJson('v1/controllers?limit=200')).items.map(({ name }) => name)
    .filter(Boolean);
  if (!controllers.includes(controller)) {
    throw new LinkError(`controller=${controller}: no controller has this name.`);
  }
  const wall = new Wall(app);
  const foot = h('div.row');
  const panel = h('section.panel', { 'aria-label': 'Leaderboard' }, wall.element);
  let cursor;

  const asked = () =>
    ({ ...ORDERS[order], controller: ORDERS[order].sort === 'score' ? controller : null });
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
        : 'No design has a score with this controller yet. An evaluation or a campaign, started ' +
          'on the overview, gives scores.'));
  }

  async function again(limit = PAGE) {
    wall.options = controller === 'default' ? {} : { controller };
    cursor = undefined;
    wall.element.replaceChildren();
    app.keep({ controller, order });
    await more(limit);
  }

  main.replaceChildren(h('div.title', {}, h('h1', {}, 'Designs'),
    h('span.muted', {}, 'score: mean over the ten environments of paper-test; lower is better'),
    h('div.actions', {},
    select('Order', Object.keys(ORDERS).map((key) => [key, `${key} first`]), order, (value) => {
      order = value;
      announced(again);
    }), select('Controller', controllers, controller, (value) => {
      controller = value;
      announced(again);
    }), wall.watch, wall.breed, copyButton(() => ({
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

/** Returns the results with their positions; for a large evaluation, the first that are full
 * scores. */
async function resultsOf(job, signal) {
  if (job.results) return { rows: job.results.map((result, row) => ({ ...result, row })) };
  const rows = [];
  let cursor = '0';
  for (let n = 0; n < PAGES_MAX && cursor !== null; n++) {
    const asked = { whole: true, limit: 1000, cursor };
    const page = await getJson(withQuery(`v1/evaluations/${job.id}/results`, asked), { signal });
    rows.push(...page.items.map((result) => ({ ...result, row: result.number })));
    cursor = page.next_cursor;
  }
  return { rows, isCut: cursor !== null };
}

async function mountEvaluation(main, id, app) {
  const stop = new AbortController();
  const wall = new Wall(app);
  wall.options = { world: `evaluation-${id}` };
  const parts = new JobParts(() => refresh());
  const title = h('h1');
  const about = h('p.muted');
  const record = h('p.muted', { hidden: true });
  const notes = h('div.stack', { hidden: true });
  const panels = new ResultPanels(app, stop.signal);
  wall.changed = () => panels.draw([...wall.chosen.values()].map(({ row }) => row));
  let done = false, isLarge = false;
  let best = []; // rows, best first

  /** Shows the recordings of the selected designs, or of the best. */
  const recordings = button('Show recordings', () => {
    const rows = wall.chosen.size ? [...wall.chosen.values()].map(({ row }) => row)
      : best.slice(0, 4);
    app.go('stage', { evaluation: id, rows: rows.join(',') });
  }, { hidden: true });

  async function refresh() {
    const path = `v1/evaluations/${encodeURIComponent(id)}`;
    const job = { ...(await getJson(path, { signal: stop.signal })), kind: 'evaluation' };
    const isRecorded = job.record.includes('masses') && job.recorded_bytes > 0 &&
      !job.recordings_removed_at;
    recordings.hidden = !isRecorded || !job.results;
    parts.update(job);
    say(title, titleOf(job));
    app.setTitle(`${titleOf(job)}, ${shortProgress(job)}`);
    const { name, sha256 } = job.controller;
    say(about, `${countOf(job.n_designs, 'design')} under the controller ` +
      `${name ?? sha256.slice(0, 12)}, ${placesOf(job.environments)}`);
    record.hidden = !job.record.length;
    say(record, job.recordings_removed_at
      ? `Its recordings were removed ${ago(job.recordings_removed_at)}; its scores stay.`
      : `Recorded: ${job.record.join(', ')}, ${bytes(job.recorded_bytes)}.`);
    isLarge = !job.results && job.state === 'succeeded';
    if ((job.results || isLarge) && !done) {
      done = true;
      const { rows, isCut } = await resultsOf(job, stop.signal).catch((error) => {
        done = false; // the next event retries
        throw error;
      });
      const order = rows.filter((result) => !result.fault)
        .sort((x, y) => Number(x.lower_bound) - Number(y.lower_bound) ||
          (x.score ?? Infinity) - (y.score ?? Infinity))
        .slice(0, 500);
      best = order.map(({ row }) => row);
      const knowsBest = job.best !== null && !isCut;
      const last = knowsBest ? order[job.best - 1]?.score ?? Infinity : -Infinity;
      wall.add(order.map((one) => ({ ...one, isBest: isAmong(one, last) })));
      panels.show(job, order);
      wall.changed(); // the selection may be from an earlier visit
      if (job.best !== null) {
        note(`The best ${count(job.best)} were requested; ${count(job.rollouts_cut)} rollouts of ` +
          'the others were not computed. A score after ≥ is a lower bound.');
      }
      if (job.n_skipped > 0) note(`${countOf(job.n_skipped, 'design')} skipped.`);
      if (isCut) {
        note(`The best ${order.length} of the first ${count(rows.length)} whole scores are ` +
          `shown, of ${count(job.n_designs)} designs.`);
      } else if (job.n_designs - job.n_skipped > order.length) {
        note(`The best ${order.length} of ${count(job.n_designs)} designs are shown.`);
      }
      if (isLarge) note(`All results: morphoctl export evaluations/${id}/results -o FILE.csv`);
    }
  }

  function note(text) {
    notes.append(h('p.muted', {}, text));
    notes.hidden = false;
  }

  main.replaceChildren(h('div.title', {}, title, parts.chip, h('div.actions', {}, recordings,
    wall.watch, wall.breed, copyButton(() => ({
      path: `v1/evaluations/${id}`, morphoctl: `job show ${id} --results`,
      python: `print(m.evaluation(${id}).${isLarge ? 'table' : 'frame'}())`,
    })))), h('section.panel.stack', { 'aria-label': 'State' }, parts.bar, parts.trouble, about,
    record, notes, parts.remark, parts.row),
  panels.element, h('section.panel', { 'aria-label': 'Results' }, wall.element));
  await refresh();
  const later = coalesced(refresh, stop.signal);
  return {
    update(event) {
      if (event.type === 'reset' || event.job === id) later();
    },
    unmount() {
      stop.abort();
      panels.destroy();
    },
  };
}

/** Returns whether a design is one of the requested best, which have full scores. */
const isAmong = ({ score: own, lower_bound: isBound }, last) =>
  !isBound && own !== null && own <= last;

/** Describes in words where designs are scored. */
const placesOf = (environments) => (typeof environments === 'string'
  ? `in ${isSuite(environments) ? 'all tasks' : 'the environments'} of ${environments}`
  : `in ${countOf(environments.count ?? environments.length, 'custom environment')}`);

async function mountDesign(main, id, app) {
  const stop = new AbortController();
  const design = await getJson(`v1/designs/${encodeURIComponent(id)}`);
  const name = design.id + (/@[0-7]$/.exec(id)?.[0] ?? ''); // from the link: a robot, or an id
  const player = new Player(app, { height: 420 });
  const scored = design.orientations.flatMap((orientation) =>
    orientation.scores.map((one) => ({ ...one, robot: orientation.robot })));
  main.replaceChildren(
    h('div.title', {}, h('h1', {}, 'Design'), h('code', {}, name), h('div.actions', {},
      h('a.button', { href: `#/editor?design=${name}` }, 'Edit'),
      h('a.button', { href: `#/stage?designs=${name}` }, 'Stage'),
      breedButton(app, 'Breed', () => [{ id: name }]),
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
  app.setTitle(`Design ${design.id.slice(0, 10)}`);
  const environments = await environmentSet('paper-test');
  roll([{ id: name }], environments[0], { signal: stop.signal })
    .then((robots) =>
      player.setRobots(robots.map((robot) => ({ ...robot, label: robot.robot.slice(36) }))))
    .catch((error) => { if (!stop.signal.aborted) player.setNote(error.message); });
  return {
    unmount() {
      stop.abort();
      player.destroy();
    },
  };
}
