/**
 * Robots on the stage whose recording grows while it plays. Each has room for a few seconds: when
 * that is used up, the oldest quarter makes room.
 */

import { uploadFrames } from './robot.js';

/** Frames that a robot has room for. A drive computes at most 2.4 s ahead, about 60 frames. */
const ROWS = 256;

export class Live {
  /**
   * @param {import('./stage.js').Stage} stage
   * @param {import('./stage.js').Robot[]} robots they start where these do
   * @param {{frameS: number, perWindow: number, light: number[]}} how seconds per frame, and frames
   *   per window
   */
  constructor(stage, robots, { frameS, perWindow, light }) {
    this.stage = stage;
    this.frameS = frameS;
    this.perWindow = perWindow;
    /** Whether the stage shows something else, so that these robots have no data on the GPU. */
    this.isSuspended = false;
    /** Number of the first frame that the robots have. */
    this.first = 0;
    // The sun does not move when the light moves.
    /** @type {import('./stage.js').Robot['world']} */
    this.world = { ...robots[0].world, light, points: undefined,
      sunFrom: robots[0].world.sunFrom ?? robots[0].world.light };
    /** The masses of each robot at the start. */
    this.starts = robots.map(({ track, body }) => track.slice(0, 3 * body.nMasses));
    /** The stage replaces these with its own. @type {import('./stage.js').Robot[]} */
    this.robots = robots.map((before) => {
      const { body: { nMasses, nSprings }, track, actuation, contacts } = before;
      /** @type {import('./stage.js').Robot} */
      const robot = {
        ...before, world: this.world, frameS, frames: 1, driven: true, lights: undefined,
        centers: undefined,
        gpu: undefined, track: new Float32Array(ROWS * nMasses * 3),
        actuation: actuation && new Int8Array(ROWS * nSprings),
        contacts: contacts && new Uint8Array(ROWS * nMasses),
      };
      robot.track.set(track.subarray(0, 3 * nMasses));
      return robot;
    });
  }

  /** Sets the time that the stage shows, in seconds from the start. */
  show(timeS) {
    this.stage.timeS = timeS - this.first * this.frameS;
  }

  /** Removes this window and all later ones. */
  cutAt(window) {
    const frames = window * this.perWindow + 1 - this.first;
    for (const robot of this.robots) robot.frames = Math.min(robot.frames, frames);
  }

  /** @param {import('./drive.js').Window} window */
  append({ parts }) {
    const { stage: { gl }, robots, perWindow } = this;
    const from = robots[0].frames;
    const gone = from + perWindow > ROWS ? ROWS / 4 : 0;
    robots.forEach((robot, i) => {
      const { nMasses, nSprings } = robot.body;
      const put = (all, part, perFrame) => {
        if (!all) return;
        if (gone) all.copyWithin(0, gone * perFrame, from * perFrame);
        const at = (from - gone) * perFrame;
        if (part) all.set(part, at);
        else repeat(all, at, perFrame, perWindow);
      };
      put(robot.track, parts[i]?.track, 3 * nMasses);
      put(robot.actuation, parts[i]?.actuation, nSprings);
      put(robot.contacts, parts[i]?.contacts, nMasses);
      robot.frames = from - gone + perWindow;
      if (this.isSuspended) robot.centers = undefined; // measured again when it is shown
      else uploadFrames(gl, robot, gone ? 0 : from, robot.frames);
    });
    this.first += gone;
    if (!this.isSuspended) this.stage.timeS -= gone * this.frameS;
  }
}

/** Fills all frames starting at a place with the frame before it. */
export function repeat(all, at, perFrame, frames) {
  for (let i = 0; i < frames; i++) {
    all.copyWithin(at + i * perFrame, at - perFrame, at);
  }
}
