/** Robots side by side in a table: bodies, and scores in each environment of paper-test. */

import { LinkError } from '../lib/api.js';
import { bodyOf, genotypeOfId } from '../lib/body.js';
import { fill, h, table } from '../lib/dom.js';
import { count, countOf, score } from '../lib/format.js';
import { nameOf, shortOf } from '../lib/names.js';
import { picture } from '../lib/picture.js';
import { scoresOf } from '../lib/rollouts.js';
import { TRAY_MAX } from '../lib/tray.js';
import { trayButton } from './add.js';
import { copyButton } from './share.js';

const SET = 'paper-test';
const ENVIRONMENTS = 10;

export async function mount(main, path, parameters, app) {
  const robots = robotsIn(parameters);
  const stop = new AbortController();
  const rows = robots.map((robot) => {
    const genotype = genotypeOfId(robot);
    const body = bodyOf(genotype);
    return { robot, genotype, body, mean: null, losses: null, error: null };
  });
  const status = h('p.muted', { role: 'status' });
  const body = h('tbody');
  const names = ['Robot', 'Score', 'Voxels', 'Masses', 'Springs',
    ...Array.from({ length: ENVIRONMENTS }, (_, i) => `Env. ${i}`)];
  const designs = robots.join(',');
  main.replaceChildren(h('div.title', {}, h('h1', {}, 'Compare robots'), h('div.actions', {},
    h('a.button', { href: `#/stage?designs=${designs}&show=skin,trails,side` }, 'Watch'),
    h('a.button', { href: `#/stage?designs=${designs}&show=skin,trails` }, 'Race'),
    trayButton(() => rows.map(({ robot, genotype, mean }) =>
      ({ robot, genotype, note: mean === null ? '' : `score ${score(mean)}` }))),
    copyButton(() => ({
      path: 'v1/evaluations', body: { designs: robots.map((id) => ({ id })) },
      headers: ['Prefer: wait=30'], morphoctl: `eval ${robots.join(' ')}`,
      python: `print(m.evaluate(${JSON.stringify(robots)}).frame())`,
    })))),
  h('p.muted', {}, 'Scores with the default controller, in each environment of paper-test and on ' +
    'average: the distance to the light after 4 s, divided by the distance at the start. Lower ' +
    'is better; the best of each column is bold.'), status,
  h('section.panel', { 'aria-label': 'Robots' }, h('div.scroll', { tabindex: 0 },
    table(names, body, (name, i) => i > 0, 'table.number.compared'))));

  function draw() {
    const known = rows.filter(({ losses }) => losses);
    const least = (of) => Math.min(...known.map((row) => of(row) ?? Infinity));
    const best = least(({ mean }) => mean);
    const bestIn = Array.from({ length: ENVIRONMENTS }, (_, i) => least(({ losses }) => losses[i]));
    const cell = (value, end) => h('td.right.number', {}, known.length > 1 && value === end
      ? h('strong', {}, score(value)) : score(value));
    const order = [...rows].sort((a, b) => Number(!a.losses) - Number(!b.losses) ||
      (a.mean ?? Infinity) - (b.mean ?? Infinity));
    fill(body, order.map((row) => h('tr', {},
      h('th', { scope: 'row' }, h('div.robot', {}, picture(row.genotype), h('div', {},
        h('a', { href: `#/lab?design=${row.robot}`, title: `Edit ${row.robot}` },
          nameOf(row.robot)), h('div.muted', {}, shortOf(row.robot))))),
      row.losses ? cell(row.mean, best) : h('td.right.muted', {}, row.error ?? '…'),
      [row.body.nVoxels, row.body.nMasses, row.body.nSprings]
        .map((n) => h('td.right', {}, count(n))),
      bestIn.map((end, i) => (row.losses ? cell(row.losses[i], end) : h('td'))))));
  }

  async function compute() {
    for (const [i, row] of rows.entries()) {
      status.textContent = `Scoring ${i + 1} of ${countOf(rows.length, 'robot')}…`;
      try {
        Object.assign(row, await scoresOf({ id: row.robot }, SET, { signal: stop.signal }));
      } catch (error) {
        if (stop.signal.aborted) return;
        row.error = error.message;
      }
      draw();
    }
    status.textContent = '';
  }

  app.setTitle(`Compare ${countOf(robots.length, 'robot')}`);
  draw();
  compute();
  return { unmount: () => stop.abort() };
}

/** Returns the robots in a link. @param {URLSearchParams} parameters */
function robotsIn(parameters) {
  const robots = (parameters.get('designs') ?? '').split(',').filter(Boolean);
  const wrong = robots.find((one) => !/^[0-9a-f]{36}@[0-7]$/.test(one));
  if (wrong) throw new LinkError(`${wrong.slice(0, 40)} is not a robot; expected ID@K.`);
  if (!robots.length) {
    throw new LinkError('The link names no robots; expected designs=ID@K,….');
  }
  if (robots.length > TRAY_MAX) {
    throw new LinkError(`There are ${robots.length} robots; at most ${TRAY_MAX} can be compared.`);
  }
  return [...new Set(robots)];
}
