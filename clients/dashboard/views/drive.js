/** The button "Drive" of a stage: the user moves the light, and the robots follow it. */

import { announce, button, h, say } from '../lib/dom.js';
import { requested, rollWindow, windowOf } from '../lib/rollouts.js';
import { Drive } from '../stage/drive.js';
import { Live } from '../stage/live.js';
import { Steering, placeFor } from '../stage/steer.js';

/** The most robots at once: those of one request. */
const ROBOTS_MAX = 64;
/** How much of a drive is kept for films and recordings: this many seconds, or this many bytes. */
const KEEP_S = 60;
const KEEP_BYTES = 96e6;
/** Time advances at this interval even if pictures take longer. */
const TICK_MS = 40;
/** A wait that lasts longer is reported. */
const LATE_MS = 150;
/** Screen readers announce the position of the light once it has rested for this long. */
const QUIET_MS = 700;
/** The camera of a drive: high and far enough to see both the robot and its light. */
const [PITCH, DISTANCE_M] = [0.62, 3.4];

/** Returns for how many seconds the motion of these robots is kept. */
function keptS(robots, frameS) {
  const bytes = robots.reduce((sum, { body }) => sum + 13 * body.nMasses + body.nSprings, 0);
  return Math.max(2, Math.min(KEEP_S, Math.floor((KEEP_BYTES * frameS) / bytes)));
}

/** A drive on a stage, until it is left. */
export class Driving {
  /**
   * @param {import('../stage/player.js').Player} player
   * @param {function(): {environment: Object, number: number, controller?: string,
   *   physics?: Object, precision?: string, world?: string, set?: string, name: string}} source the
   *   world of the robots, and a name for files; number: of the environment within the world or the
   *   set; world, set: as in a link to the stage
   */
  constructor(player, source) {
    this.player = player;
    this.source = source;
    this.toggle = button('Drive', () => (player.live ? this.leave() : this.start()), {
      class: 'drive', 'aria-pressed': 'false', title: 'Move the light: the robots follow it',
    });
    this.status = h('span', { role: 'status' });
    this.spoken = h('span.visually-hidden', { 'aria-live': 'polite' });
    this.panel = h('div.driving', { hidden: true },
      h('span', {}, 'Drag the light, or click the ground.', h('span.keys', {},
        ' Keys: W A S D, or Shift and the arrow keys; Esc ends the drive.')), this.status,
      h('div.row', {}, button('Save', () => this.#save()), button('End', () => this.leave())),
      this.spoken);
    player.toggleRow.prepend(this.toggle);
    player.controls.before(this.panel);
  }

  get timeS() {
    return this.drive.timeS;
  }

  start() {
    const { player } = this;
    const { stage } = player;
    if (!stage?.robots.length) {
      announce('There is no robot on the stage yet.', { isRefusal: true });
      return;
    }
    if (stage.robots.length > ROBOTS_MAX) {
      announce(`At most ${ROBOTS_MAX} robots can be driven at once.`, { isRefusal: true });
      return;
    }
    const { camera: { yaw, pitch, distanceM, target }, follow, robots, timeS } = stage;
    this.before = { robots, timeS, follow, camera: { yaw, pitch, distanceM, target } };
    this.toggle.setAttribute('aria-pressed', 'true');
    this.panel.hidden = false;
    Object.assign(stage.camera, { pitch: PITCH, distanceM: Math.max(distanceM, DISTANCE_M) });
    stage.follow = true;
    this.steering = new Steering(stage, {
      world: () => this.live.world, move: (place) => this.#moveLight(place),
      leave: () => this.leave(),
    });
    this.timer = setInterval(() => this.#tickUnseen(), TICK_MS);
    // The position of the world's light is not rounded until it is moved.
    const { light } = robots[0].world;
    this.#begin(robots, this.source().environment.task ? placeFor(light) : light);
    player.canvas.focus();
  }

  /** Restarts with different robots that follow the same light. */
  restart(robots) {
    if (!robots.length || robots.length > ROBOTS_MAX) {
      this.leave();
      this.player.setRobots(robots);
      return;
    }
    this.before = { ...this.before, robots, timeS: 0 };
    this.drive.close();
    this.#begin(robots, this.live.world.light);
  }

  #begin(robots, light) {
    const { player } = this;
    this.world = this.source();
    const { physics } = this.world;
    const { frameS, perWindow, windowS } = windowOf(physics);
    this.live = new Live(player.stage, robots, { frameS, perWindow, light });
    this.keepS = keptS(robots, frameS);
    this.drive = new Drive({
      roll: (window) => this.#roll(window), sink: this.live, light, windowS, keepS: this.keepS,
      onfault: (error) => this.#fail(error),
    });
    this.drive.setPlaying(player.playing);
    this.drive.speed = player.speed;
    this.lateSince = null;
    this.fault = '';
    this.lost = new Set();
    /** Controller, physics and so on of each robot, as in the header of a scene. */
    this.inputs = [];
    this.#show();
  }

  /** Computes n windows of all robots, with one request per controller. */
  async #roll({ light, states, n, signal }) {
    const { environment, physics, precision, controller } = this.world;
    const world = { ...requested(environment), light_xy_m: light };
    delete world.task; // a task has its own light
    const { robots } = this.live;
    const groups = new Map();
    robots.forEach((robot, i) => {
      if (states && !states[i]) return; // the robot has diverged
      const name = robot.controller ?? controller;
      groups.set(name, [...groups.get(name) ?? [], i]);
    });
    if (!groups.size) throw new Error('Every robot has diverged.');
    const windows = Array.from({ length: n }, () => robots.map(() => null));
    const after = robots.map(() => null);
    await Promise.all([...groups].map(async ([name, members]) => {
      const designs = members.map((i) => ({ voxels: robots[i].genotype }));
      const { rows, inputs } = await rollWindow(designs, world, {
        controller: name, physics, precision, signal, n,
        states: states && members.map((i) => states[i]),
      });
      members.forEach((i, row) => {
        this.inputs[i] = inputs;
        windows.forEach((parts, k) => { parts[i] = rows[row].parts[k]; });
        after[i] = rows[row].state;
      });
    }));
    this.fault = '';
    return { windows, states: after };
  }

  #fail(error) {
    const isPassing = error.status === 0 || error.status === 429 || error.status >= 500;
    if (isPassing) {
      this.fault = error.message;
      return;
    }
    this.leave();
    announce(`The drive has ended: ${error.message}`, { isRefusal: true });
  }

  #moveLight(place) {
    this.live.world.light = place;
    this.drive.setLight(place);
    this.player.redraw();
    clearTimeout(this.quiet);
    this.quiet = setTimeout(() => say(this.spoken,
      `Light at x ${place[0].toFixed(1)}, y ${place[1].toFixed(1)} meters`), QUIET_MS);
  }

  /** Called for each picture. */
  tick() {
    const now = performance.now();
    this.steering.tick((now - (this.beforeMs ?? now)) / 1000);
    this.beforeMs = now;
    this.drive.tick();
    this.live.show(this.drive.timeS);
    this.#report(now);
  }

  /** Keeps real time while a picture takes long; while the page is not visible, time stands
   * still. */
  #tickUnseen() {
    if (document.hidden || !this.player.isSeen) this.drive.skip();
    else this.drive.tick();
  }

  /** Reports the length of the drive, and any problem. */
  #report(now) {
    const { isLate, timeS, windows, first } = this.drive;
    this.lateSince = isLate ? this.lateSince ?? now : null;
    const states = windows.at(-1)?.states ?? [];
    states.forEach((state, i) => { if (!state) this.lost.add(i); });
    const texts = [
      this.fault,
      this.lateSince !== null && now - this.lateSince > LATE_MS && !this.fault
        ? 'Waiting for the service.' : '',
      this.drive.hasBegun ? '' : 'Starting…',
      this.player.playing ? '' : 'Paused: press Play.',
      this.lost.size ? `Diverged, and stopped: ${[...this.lost]
        .map((i) => this.live.robots[i].label ?? i + 1).join(', ')}.` : '',
      first > 0 ? `Only the last ${this.keepS} s are kept.` : '',
    ];
    say(this.status, texts.filter(Boolean).join(' '));
  }

  setPlaying(on) {
    this.drive?.setPlaying(on);
  }

  setSpeed(speed) {
    this.drive.speed = speed;
  }

  async #save() {
    const { player, drive, live } = this;
    player.setPlaying(false);
    if (drive.timeS < live.frameS) {
      announce('There is nothing to save yet: press Play and move the light.');
      return;
    }
    const { saveDialog } = await import('./drive_save.js');
    if (player.live === this) saveDialog(this);
  }

  /** Shows recordings for a while. @param {import('../stage/stage.js').Robot[]} robots */
  suspend(robots) {
    clearInterval(this.timer);
    this.live.isSuspended = true;
    this.player.setLive(null);
    this.player.setRobots(robots);
  }

  /** Continues driving, paused, after `suspend`. */
  resume() {
    if (!this.player.canvas.isConnected) {
      this.close(); // the page was left
      return;
    }
    this.live.isSuspended = false;
    this.#show();
    this.timer = setInterval(() => this.#tickUnseen(), TICK_MS);
  }

  #show() {
    this.player.setRobots(this.live.robots, { live: true });
    this.live.robots = this.player.stage.robots;
    this.player.setPlaying(this.player.playing);
    this.player.setLive(this);
  }

  /** Goes back to the ordinary world. */
  leave() {
    const { player, before } = this;
    if (player.live !== this) return;
    this.close();
    player.setLive(null);
    this.toggle.setAttribute('aria-pressed', 'false');
    this.panel.hidden = true;
    Object.assign(player.stage.camera, before.camera);
    player.stage.follow = before.follow;
    player.setRobots(before.robots, { keepTime: true });
    player.stage.timeS = before.timeS;
    player.redraw();
    if (this.panel.contains(document.activeElement)) this.toggle.focus();
  }

  /** Stops requests, keys and timers. */
  close() {
    this.drive.close();
    this.steering.close();
    clearInterval(this.timer);
    clearTimeout(this.quiet);
  }
}
