/** Shows how the body being built walks and scores: the stage of the Lab, and the words beside
 * it. */

import { bodyOf } from '../lib/body.js';
import { fill, h } from '../lib/dom.js';
import { count, score, voxels } from '../lib/format.js';
import { nameOf, shortOf } from '../lib/names.js';
import { roll, scoresOf, worldsOf } from '../lib/rollouts.js';
import { betterOf, resultOf, worldWords } from '../lib/tasks.js';
import { Player } from '../stage/player.js';
import { Driving } from './drive.js';

export class Walk {
  /** @param {import('../app.js').app} app */
  constructor(app) {
    this.app = app;
    this.result = h('p.result', { 'aria-live': 'polite' });
    this.player = new Player(app, { compact: true });
    /** The score in words, once it is known. */
    this.score = '';
    this.stop = new AbortController();
  }

  /** Loads the worlds of the page's task; before this, nothing can walk. */
  async prepare() {
    const { task } = this.app;
    const environments = await worldsOf(task);
    if (task !== this.app.task) return; // another task was chosen
    this.environments = environments;
    this.task = task;
    if (!this.player.stage || this.driving) return;
    this.driving = new Driving(this.player, () => ({
      environment: this.environments[0], number: 0, set: this.task.set, name: 'morphod-drawn',
    }));
  }

  /** Shows a body: it walks, then it is scored. @param {number} loose how many voxels are loose */
  async show(genotype, loose) {
    this.stop.abort();
    this.stop = new AbortController();
    const { signal } = this.stop;
    const { player, result, task, environments } = this;
    const started = performance.now();
    const body = bodyOf(genotype);
    const size = `${voxels(body.nVoxels)}, ${count(body.nSprings)} springs`;
    this.score = '';
    player.element.classList.toggle('stale', loose > 0);
    player.setNote(!loose ? '' : this.name
      ? `Still walking: ${this.name}, the last body in one piece`
      : 'No robot is walking: the body is not in one piece');
    if (loose) {
      player.hold(false); // an earlier request may have put it on hold
      result.textContent = `${size}; no score: ${loose === 1 ? 'one voxel is' :
        `${loose} voxels are`} loose`;
      return;
    }
    const design = { voxels: genotype };
    result.textContent = `${size}; scoring…`;
    player.hold(true);
    try {
      const [robot] = await roll([design], environments[0], { signal });
      if (signal.aborted) return;
      this.name = nameOf(robot.id);
      robot.label = this.name;
      player.setRobots([robot]);
      // The walk comes first, because ten rollouts would delay its first frame.
      await new Promise(requestAnimationFrame);
      if (signal.aborted) return;
      const shownMs = Math.round(performance.now() - started);
      const { mean, value, unit } = await scoresOf(design, task.set ?? task.environments,
        { signal });
      if (signal.aborted) return;
      const scoredMs = Math.round(performance.now() - started);
      this.score = `score ${resultOf({ loss: mean, value, unit })}`;
      fill(result, h('strong', {}, this.score), ' ', h('span.better', {}, betterOf(unit)),
        h('span', {}, `${task.title}, ${worldWords(task)}`,
          betterOf(unit).startsWith('↑') ? `; mean loss ${score(mean)}` : ''),
        h('span', {}, `${size}; `, h('span', { title: robot.robot }, this.name), ' ',
          h('code', {}, shortOf(robot.robot))),
        h('span.muted', {}, `walking after ${shownMs} ms, scored after ${scoredMs} ms`));
      performance.measure('morphod-click-to-motion', { start: started, duration: shownMs });
    } catch (error) {
      if (signal.aborted) return;
      player.hold(false);
      result.textContent = `${size}; ${error.message}`;
    }
  }

  close() {
    this.stop.abort();
    this.player.destroy();
  }
}
