/** Compares two controllers on the same held-out bodies. */

import { getJson, patient, post } from '../lib/api.js';
import { button, fill, h, select } from '../lib/dom.js';
import { percent, signed } from '../lib/format.js';
import { environmentSet, roll } from '../lib/rollouts.js';
import { CONFIDENCE, compareCrossed } from '../lib/statistics.js';
import { Player } from '../stage/player.js';
import { copyButton } from './share.js';

/**
 * Compares two controllers on the same held-out bodies: the difference with its interval, and both
 * side by side.
 * @param {import('../app.js').app} app
 * @param {any[]} controllers those with a name
 * @param {AbortSignal} signal ends its requests
 * @returns {{element: HTMLElement, destroy: () => void}}
 */
export function comparison(app, controllers, signal) {
  // The newest file of a training run, compared with the default: two names of one file are the
  // same.
  const names = controllers.map(({ name }) => name);
  const first = controllers.find(({ name }) => name === 'default') ?? controllers[0];
  const other = [...controllers].sort((x, y) => y.stored_at.localeCompare(x.stored_at))
    .find(({ sha256 }) => sha256 !== first.sha256);
  let [a, b, size] = [first.name, other?.name ?? '', '64'];
  const result = h('p', { 'aria-live': 'polite' });
  const player = new Player(app, { compact: true, height: 380 });
  const stage = h('div.panel.flush', { hidden: true }, player.element);

  async function compare() {
    const [one, two] = [a, b].map((name) => controllers.find((known) => known.name === name));
    if (!two || one.sha256 === two.sha256) {
      result.textContent = 'Both are the same controller: choose two different ones.';
      return;
    }
    go.disabled = true;
    result.textContent = 'Scoring both on the held-out bodies…';
    try {
      const path = `v1/held-out?seed=1&designs=${size}&environments=16`;
      const { designs, environments } = await getJson(path, { signal });
      const evaluate = async (controller) => {
        let evaluation = await patient(() => post('v1/evaluations', {
          designs, environments, controller, label: `comparison of ${a} and ${b}`,
        }, { signal }));
        while (!['succeeded', 'failed', 'cancelled'].includes(evaluation.state)) {
          const path = `v1/evaluations/${evaluation.id}`;
          evaluation = await getJson(path, { signal, headers: { Prefer: 'wait=10' } });
        }
        if (!evaluation.results) {
          throw new Error(`The evaluation of ${controller} has ${evaluation.state}.`);
        }
        return evaluation;
      };
      const [first, second] = await Promise.all([evaluate(a), evaluate(b)]);
      const losses = [first, second].map(({ results }) => results.map((one) => one.losses.map(
        (loss) => loss ?? NaN)));
      const { n, difference, low, high, improved } = compareCrossed(losses[0], losses[1]);
      const better = high < 0 ? `${b} is better on such bodies`
        : low > 0 ? `${b} is worse on such bodies`
        : 'this does not show which is better: ' +
          'more bodies and environments would make the interval narrower';
      const left = designs.length - n;
      result.textContent = n < 2
        ? 'Too few bodies have a score with both controllers to say which is better.'
        : `${b} minus ${a}: ${signed(difference)}, ${percent(CONFIDENCE)} interval ` +
          `${signed(low)} to ${signed(high)} (for other bodies and environments; Student t, ` +
          `${n} held-out bodies in ${environments.length} environments, ` +
          `${improved} of them improved` +
          `${left ? `; ${left} that diverged left out` : ''}). Lower is better: ${better}.`;
      const [design] = designs;
      const [environment] = await environmentSet('paper-test');
      const robots = [];
      for (const controller of [a, b]) {
        const [robot] = await roll([design], environment, { controller, signal });
        robots.push({ ...robot, label: controller });
      }
      stage.hidden = false;
      const shown = designs[0].voxels ?? designs[0].id ?? '';
      fill(link, h('a',
        { href: `#/stage?designs=${shown}&controller=${a},${b}&show=skin,trails,side` },
        'both on the stage, in any environment'));
      player.setRobots(robots);
      player.setSide(true);
    } catch (error) {
      if (signal.aborted) return;
      result.textContent = error.message;
    }
    go.disabled = false;
  }

  const go = button('Compare', compare);
  const link = h('p');
  const element = h('section.panel.stack', {}, h('div.title', {},
    h('h2', {}, 'Compare two controllers'),
    h('span.muted', {}, 'on bodies and environments never used for training'), h('div.actions', {},
      select('First', names, a, (value) => { a = value; }),
      select('Second', other ? names : [['', 'choose one'], ...names], b,
        (value) => { b = value; }),
      select('Bodies', ['16', '64', '256'], size, (value) => { size = value; }), go,
      copyButton(() => ({
        path: `v1/held-out?seed=1&designs=${size}&environments=16`,
        morphoctl: `train compare ${a} ${b} --designs ${size}`,
        python: `held_out = m.request("GET", "/v1/held-out", seed=1, designs=${size}, ` +
          `environments=16)\nfor controller in ("${a}", "${b}"):\n` +
          '    print(m.request("POST", "/v1/evaluations", ' +
          '{**held_out, "controller": controller})["id"])',
      })))), result, link, stage);
  return { element, destroy: () => player.destroy() };
}
