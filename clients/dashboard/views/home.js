/** Home: the best robot of the store walks, with what its score means, and three ways to
 * continue. */

import { getJson, withQuery } from '../lib/api.js';
import { cellsOf, genotypeOfId } from '../lib/body.js';
import { button, fill, h, patch, say } from '../lib/dom.js';
import { coalesced, isNews } from '../lib/events.js';
import { countOf, score, voxels } from '../lib/format.js';
import { nameOf, shortOf } from '../lib/names.js';
import { may } from '../lib/rights.js';
import { roll, scoresOf, worldsOf } from '../lib/rollouts.js';
import { TASKS, betterOf, pointsText, resultOf, wayOf, worldWords } from '../lib/tasks.js';
import { Player } from '../stage/player.js';

/** Index of the world of the task in which the robot walks here, if there are that many. */
const SHOWN = 3;
/** Number of the best robots on the stage. */
const STAGED = 4;
const COUNTS = ['no', 'one', 'two', 'three', 'four'];
const POLL_MS = 5000;
/** Events within this time are handled together. */
const PAUSE_MS = 1000;
/** Number of running jobs that are named. */
const NAMED = 3;

/**
 * Robots for a store without scores: the best of the zero-shot campaigns in docs/reproduction,
 * under the shipped controller. The page computes their walk and their score.
 */
const SHIPPED = [
  '00e4402ef444a4aeacaacc60ecaee0000000@7', '008c60042e600ce4a20c2cac44ea80000000@6',
  '000240caeec06bafa0c5ecf2facce6744480@2', '0000808c64c0e8ce62a6ea002aca0004c600@5',
];

const SENTENCE = 'morphod evolves robots made of soft voxels, trains the neural network that ' +
  'moves them, and scores how close each one gets to a light.';

export async function mount(main, path, parameters, app) {
  const stop = new AbortController();
  const { signal } = stop;
  const get = (url) => getJson(url, { signal });
  const { task } = app;
  const isPhoto = task === TASKS[0];
  /** Lists the best robots in this task, or else those that reach the light: {items, isOwn}. */
  async function listBest(limit) {
    const list = async (environments) =>
      (await get(withQuery('v1/designs', { sort: 'score', limit, environments }))).items;
    const own = task.set ? await list(isPhoto ? null : task.set) : [];
    if (own.length || isPhoto) return { items: own, isOwn: true };
    return { items: await list(null), isOwn: false };
  }
  const about = h('section.about', { 'aria-label': 'The robot' });
  const notes = h('div.muted');
  const better = button('', () => showBest(), { hidden: true });
  const staged = h('a.door', { href: '#/stage' });
  const panel = h('section.panel.flush', { 'aria-label': 'Stage' });
  const health = h('p.health', { role: 'group', 'aria-label': 'The service' });
  main.replaceChildren(h('h1.sentence', {}, SENTENCE), h('div.home', {},
    panel, h('div.stack', {}, about, better, h('nav.doors', { 'aria-label': 'Start' },
      h('a.door', { href: '#/lab' }, h('strong', {}, 'Build one'),
        h('span', {}, 'Draw a body. It walks and is scored after every click.')),
      evolveDoor(app), staged), notes)), health);

  const [best, environments] = await Promise.all([listBest(STAGED), worldsOf(task)]);
  const place = Math.min(SHOWN, environments.length - 1);
  let shown; // the robot on the stage
  /** @type {Player} */
  let player;

  /** Describes the robot, its score, and its result in the world shown, once these are known. */
  function describe(robot, { isShipped = false, isOwn }, scored, here) {
    const n = cellsOf(genotypeOfId(robot)).length;
    const origin = isShipped
      ? 'No design in this store has a score yet. This robot ships with morphod; it comes from ' +
        'the reproduction of the paper.'
      : isOwn ? `The best score in this store${isPhoto ? '' : ' in this task'}, with the default ` +
        'controller.'
      : 'This store has no scores to rank for this task, so this is its best robot at reaching ' +
        'the light, scored here in this task.';
    const link = isShipped ? `#/lab?voxels=${genotypeOfId(robot)}` : `#/designs/${robot}`;
    const [figure, rest] = !scored ? [] : isPhoto ? wayOf(scored.mean)
      : [resultOf({ ...scored, loss: scored.mean }), `: ${task.title}`];
    fill(about, h('h2', {}, h('a', { href: link, title: robot }, nameOf(robot))),
      h('p.muted', {}, h('code', {}, shortOf(robot)), `, ${voxels(n)}`),
      h('p.muted', {}, origin),
      h('p.way', {}, scored ? [h('strong', {}, figure), rest] : 'Scoring…'),
      !scored ? null : h('p.muted', {}, isPhoto
        ? `Score ${score(scored.mean)}: the distance to the ` +
          'light after 4 s, divided by the distance at the start, averaged over ten ' +
          'environments. 0 means that it reached the light, 1 that it got no closer; lower is ' +
          'better.'
        : `Score: ${worldWords(task)}; ${betterOf(scored.unit)}.`));
    fill(notes, here === undefined ? null : h('p', {}, 'In the environment shown: ', isPhoto
        ? wayOf(here.loss).join('').replace(/\.?$/, '.') : `${resultOf(here)}.`));
  }

  async function show(robots, origin, scored) {
    const [robot] = robots;
    shown = robot;
    better.hidden = true;
    describe(robot, origin, scored);
    staged.href = `#/stage?designs=${robots.join(',')}` +
      `&environment=${task.set ? place : SHOWN}` +
      (isPhoto || !task.set ? '' : `&set=${task.set}`) +
      (task.points ? `&path=${pointsText(task.points)}` : '');
    fill(staged, h('strong', {}, 'Watch the best'), h('span', {},
      robots.length === 1 ? 'On a full-page stage.'
        : `The ${COUNTS[robots.length]} best, side by side or racing, on a full-page stage.`,
      task.set || task.points ? null
        : ' There they reach for a light: this task has no fixed set of worlds.'));
    const design = { id: robot };
    const computed = roll([design], environments[place], { signal });
    computed.catch(() => {}); // awaited below
    player ??= addPlayer(); // the service computes while the stage is set up
    const [walking] = await computed;
    if (shown !== robot) return;
    player.setRobots([{ ...walking, label: nameOf(robot) }]);
    player.names.hidden = true; // the page says more about it
    describe(robot, origin, scored, walking);
    if (scored) return;
    await new Promise(requestAnimationFrame); // wait, because ten rollouts would delay its first
                                              // frame
    const all = await scoresOf(design, task.set ?? environments, { signal });
    if (shown === robot) describe(robot, origin, all, walking);
  }

  function addPlayer() {
    const made = new Player(app, { compact: true });
    made.toggleRow.hidden = true;
    panel.append(made.element);
    return made;
  }

  const said = (work) => work.catch((error) => {
    if (!signal.aborted) player?.setNote(error.message);
  });

  function showAll({ items, isOwn }) {
    if (!items.length) return said(show(SHIPPED, { isShipped: true }));
    // In other tasks, the values are not stored with the scores.
    return said(show(items.map((one) => one.robot), { isOwn },
      isPhoto ? { mean: items[0].score } : undefined));
  }

  const showBest = () => said(listBest(STAGED).then(showAll));

  const jobs = h('span.jobs');
  const state = h('span.state');
  const words = h('span.muted');
  fill(health, state, words, jobs, h('a', { href: '#/overview' }, 'Service'),
    h('span.muted.keys', {}, 'Ctrl+K (⌘K on a Mac) jumps to a page, run or robot; ? lists the ' +
      'keyboard shortcuts.'));

  async function showHealth() {
    const [ready, threads, page] = await Promise.all([
      get('readyz').catch((error) => ({ status: error.message, notice: null })),
      get('v1/threads'), get('v1/jobs?state=running&limit=100'),
    ]);
    say(state, ready.status);
    state.className = `state ${ready.status === 'ready' ? 'succeeded' : 'failed'}`;
    const n = page.items.length;
    say(words, `${ready.notice ? `${ready.notice}; ` : ''}` +
      `${threads.n_busy} of ${countOf(threads.n_threads, 'thread')} busy; ` +
      `${n === 0 ? 'no jobs are running' : `${countOf(n, 'job')} running:`}`);
    if (n === 0 && !jobs.childElementCount) return;
    const { linkOf, shortProgress, titleOf } = await import('../lib/kinds.js');
    patch(jobs, page.items.slice(0, NAMED), (job) => job.id, (job) => h('span', {},
      h('a', { href: linkOf(job) }), h('span.muted')), (element, job) => {
      say(element.firstChild, titleOf(job));
      say(element.lastChild, `, ${shortProgress(job)}`);
    });
  }

  /** Offers a robot that has become the best; the robot that walks stays until the user accepts. */
  async function offerBetter() {
    const { items: [first] } = await listBest(1);
    better.hidden = !first || first.robot === shown;
    if (first) {
      say(better, `A new best: ${nameOf(first.robot)}${isPhoto ? `, score ${score(first.score)}`
        : ''}. Show it`);
    }
  }

  const refresh = coalesced(() => showHealth(), signal, PAUSE_MS);
  const look = coalesced(() => offerBetter(), signal, PAUSE_MS);
  showAll(best).then(showHealth).catch(() => {}); // a failure is retried
  const timer = setInterval(() => { if (!document.hidden) refresh(); }, POLL_MS);
  return {
    update({ type }) {
      // The timer suffices for progress, which comes several times per second.
      if (type === 'reset' || (type.startsWith('job.') && isNews({ type }))) refresh();
      if (['reset', 'job.finished', 'campaign.generation'].includes(type)) look();
    },
    unmount() {
      clearInterval(timer);
      stop.abort();
      player?.destroy();
    },
  };
}

/** Returns the way to start evolution: the form of a small campaign, or, for users who may only
 * look, the campaigns. */
function evolveDoor(app) {
  const inside = (text) => [h('strong', {}, 'Evolve'), h('span', {}, text)];
  if (!may('submit')) {
    return h('a.door', { href: '#/campaigns' },
      inside('See the campaigns of this service, generation by generation.'));
  }
  return h('button.door', { type: 'button', onclick: async () => {
    const [{ startDialog }, { announced }] =
      await Promise.all([import('./forms.js'), import('./share.js')]);
    announced(() => startDialog(app, 'campaign', {}, { preset: 'demo' }));
  } }, inside('Start a campaign: bodies are scored, and the best of them have children.'));
}
