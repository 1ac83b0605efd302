/** The stage of an atlas: the body walks if a rollout of it is available, and otherwise stands
 * still. */

import { bodyOf } from '../lib/body.js';
import { h, say } from '../lib/dom.js';
import { nameOf } from '../lib/names.js';
import { Player } from '../stage/player.js';

/** Position of the middle of the workspace, and the side of a voxel, in meters. */
const MIDDLE_M = 2.5;
const VOXEL_M = 0.1;

/** Returns a body that stands on flat ground. */
function still(genotype) {
  const body = bodyOf(genotype);
  const { masses } = body;
  const low = [0, 1, 2].map((axis) => Math.min(...masses.filter((_, i) => i % 3 === axis)));
  const high = [0, 1].map((axis) => Math.max(...masses.filter((_, i) => i % 3 === axis)));
  const track = Float32Array.from(masses, (v, i) => (i % 3 === 2 ? VOXEL_M * (v - low[2])
    : MIDDLE_M + VOXEL_M * (v - (low[i % 3] + high[i % 3]) / 2)));
  return { genotype, body, track, frames: 1, frameS: 1, value: null, unit: 'm',
    world: { light: [MIDDLE_M, 4.5], heights: new Float32Array(64), key: 'still' } };
}

export class AtlasWalk {
  /**
   * @param {any} app
   * @param {(genotype: string, id: string, signal: AbortSignal) => Promise<{robot: any, words:
   *   string}>} rollOf returns a robot of the stage, or null, and the words about it
   */
  constructor(app, rollOf) {
    this.rollOf = rollOf;
    this.player = new Player(app, { compact: true });
    this.words = h('p.walk-words', { role: 'status' });
    this.element = h('div.walks', {}, this.player.element, this.words);
    this.stop = new AbortController();
  }

  async show(genotype, id, started) {
    this.stop.abort();
    this.stop = new AbortController();
    const { signal } = this.stop;
    let found;
    this.player.hold(true);
    try {
      found = await this.rollOf(genotype, id, signal);
    } catch (error) {
      found = { robot: null, words: `It does not walk: ${error.message}` };
    }
    if (signal.aborted) return;
    const { robot, words } = found;
    this.player.setRobots([{ ...robot ?? still(genotype), label: nameOf(id) }]);
    this.element.classList.toggle('still', !robot);
    this.player.setNote(robot ? '' : 'It stands still');
    say(this.words, words);
    await new Promise(requestAnimationFrame); // let the page draw first
    if (robot) performance.measure('morphod-atlas-click-to-motion', { start: started });
  }

  close() {
    this.stop.abort();
    this.player.destroy();
  }
}
