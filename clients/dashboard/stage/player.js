/** A stage with its controls: play, scrub, slow motion, display options, and the followed robot. */

import { announce, button, choice, fill, h, say, toggle } from '../lib/dom.js';
import { percent } from '../lib/format.js';
import { resultOf } from '../lib/tasks.js';
import { driveCamera } from './camera.js';
import { isSoftware, stageCanvas } from './gl.js';
import { Stage } from './stage.js';
import { Standings } from './standings.js';
import { Tags } from './tags.js';

export const SPEEDS = [['2', '2 ×'], ['1', '1 ×'], ['0.5', '½ ×'], ['0.25', '¼ ×'], ['0.1', '⅒ ×']];
/** Frames that take longer than this cause a lower resolution, and then no shadow. */
const SLOW_FRAME_S = 0.028;
/**
 * The ground is drawn without robots only if none arrive within this time: without a GPU, drawing
 * it delays them.
 */
const PATIENCE_MS = 1000;
/** Two consecutive frames that take longer than this cause both at once. */
const VERY_SLOW_FRAME_S = 0.09;
const SCALE_MIN = 0.35;
/** A longer pause is not slow drawing: the page was hidden, or the computer slept. */
const ELAPSED_MAX_S = 2;
/** A still picture is drawn at full quality after this pause. */
const STILL_MS = 250;
/** A pointer this close to the center of a robot points at it. */
const HOVER_PX = 40;

export class Player {
  /**
   * @param {import('../app.js').app} app
   * @param {{compact?: boolean, height?: number, onchange?: function(): void}} [options]
   *   compact: fewer controls, for a stage beside other content
   */
  constructor(app, options = {}) {
    const { compact = false, height, onchange = () => {} } = options;
    this.app = app;
    this.onchange = onchange;
    this.canvas = stageCanvas();
    this.canvas.tabIndex = 0;
    this.canvas.setAttribute('role', 'img');
    this.canvas.setAttribute('aria-label', 'Stage: no robots yet');
    if (height) this.canvas.style.height = `${height}px`;
    this.note = h('div.note', { 'aria-live': 'polite' });
    this.standings = new Standings({
      follow: (i) => this.#followRobot(i), film: () => this.#film(),
      point: (robot) => this.#point(robot),
    });
    this.names = this.standings.element;
    this.coming = h('div.coming', { hidden: true });
    this.playing = !matchMedia('(prefers-reduced-motion: reduce)').matches;
    this.speed = 1;
    this.slider = h('input', {
      type: 'range', min: 0, max: 1, step: 'any', value: 0, 'aria-label': 'Time',
      oninput: () => {
        this.setPlaying(false);
        this.stage.timeS = Number(this.slider.value);
        this.#show();
        this.onchange();
      },
    });
    this.clock = h('span.clock', {}, '0.00 s');
    this.drawing = h('span.muted.drawing', {
      hidden: true, title: 'Drawing is slow, so the resolution is lower while robots move',
    }, isSoftware() ? 'software drawing' : 'lower resolution');
    this.playButton = button('', () => {
      const waits = this.#waits();
      this.isEarly = waits;
      this.setPlaying(waits || !this.playing);
      this.onchange();
    });
    this.toggleRow = h('div.row');
    this.timeRow = h('div.time', {}, this.playButton, this.slider, this.drawing, this.clock);
    this.controls = h(`div.controls${compact ? '.compact' : ''}`, {}, this.timeRow, this.toggleRow);
    this.tags = new Tags();
    this.element = h('div.stage', {}, this.canvas, this.tags.element, this.names, this.coming,
      this.note,      this.controls);
    try {
      this.stage = new Stage(this.canvas, { shadows: !isSoftware() });
      this.stage.theme = app.theme;
    } catch (error) {
      fill(this.element, h('p.empty', { role: 'alert' }, error.message));
      this.stage = null;
      return;
    }
    if (isSoftware()) {
      this.stage.scale = 0.5;
      this.drawing.hidden = false;
    }
    // For tests, and for users of the console.
    Object.assign(this.element, { player: this });
    this.#addToggles(compact);
    driveCamera(this.canvas, this.stage.camera, (how) => {
      this.aimed = true;
      this.stage.isFramed = false;
      if (how === 'moved') this.#setFollow(false);
      this.#wake();
      this.onchange();
    }, {
      grab: (x, y, event) => this.live?.steering.grab(x, y, event),
      click: (x, y) => this.live?.steering.click(x, y),
    });
    this.canvas.addEventListener('keydown', (event) => this.#key(event));
    this.canvas.addEventListener('pointermove', (event) => this.#hover(event));
    this.canvas.addEventListener('pointerleave', () => this.#point(null));
    this.canvas.addEventListener('webglcontextrestored', () => this.#wake());
    this.onTheme = (theme) => {
      this.stage.theme = theme;
      this.#wake();
    };
    app.themeListeners.add(this.onTheme);
    this.resize = new ResizeObserver(() => {
      if (this.stage.lanes() !== this.standings.lanes) this.#list();
      this.#cover();
      this.#wake();
    });
    this.resize.observe(this.canvas);
    // A hidden canvas is not throttled: without a GPU, frames would queue up for minutes.
    this.isSeen = true;
    this.sight = new IntersectionObserver((entries) => {
      this.isSeen = entries.at(-1).isIntersecting;
      if (this.isSeen) this.#wake();
    });
    this.sight.observe(this.canvas);
    this.createdMs = performance.now();
    setTimeout(() => this.#wake(), PATIENCE_MS);
    this.setPlaying(this.playing);
  }

  #addToggles(compact) {
    const { stage } = this;
    const flag = (text, name) => toggle(text, stage.show[name], (on) => {
      stage.show[name] = on;
      // Actuation colors the springs.
      if (name === 'actuation' && on && !stage.show.springs) this.springsToggle.click();
      this.#wake();
      this.onchange();
    });
    this.followToggle = toggle('Follow', true, (on) => {
      stage.follow = on;
      stage.isFramed &&= !on;
      this.#wake();
      this.onchange();
    });
    this.sideToggle = button('Side by side', () => this.setSide(true),
      { 'aria-pressed': 'false', title: 'One view per robot' });
    this.raceToggle = button('Race', () => this.setSide(false, false), {
      'aria-pressed': 'true', title: 'One lane per robot, side by side, with the same ground ' +
        'and the same light. A light that leads the way is drawn close to its robot.',
    });
    this.ghostsToggle = button('Ghosts', () => this.setSide(false, true), {
      'aria-pressed': 'false', title: 'All robots start at the same place on the same ground. ' +
        'One is solid: the robot you point at, or the one the camera follows, or the leader. ' +
        'The others are transparent.',
    });
    this.springsToggle = flag('Springs', 'springs');
    this.actuationToggle = flag('Actuation', 'actuation');
    this.toggles = { skin: flag('Skin', 'skin'), springs: this.springsToggle,
      contacts: flag('Contacts', 'contacts'),
      trails: flag('Trails', 'trails'), actuation: this.actuationToggle };
    this.speedSelect = choice('Speed', SPEEDS, '1', (value) => {
      this.speed = Number(value);
      this.live?.setSpeed(this.speed);
      this.onchange();
    });
    this.timeRow.append(this.speedSelect);
    this.toggleRow.append(h('div.pair', {
      role: 'group', 'aria-label': 'Arrangement', hidden: true,
    }, this.sideToggle, this.raceToggle, this.ghostsToggle), this.followToggle, this.toggles.skin,
    this.springsToggle);
    if (!compact) this.toggleRow.append(this.actuationToggle, this.toggles.contacts);
    this.toggleRow.append(this.toggles.trails);
  }

  /** Sets what is shown, as in a link: {skin, springs, …, side, ghosts}. */
  setShown(names) {
    this.arranged = true;
    this.setSide(names.includes('side'), names.includes('ghosts'));
    for (const [name, element] of Object.entries(this.toggles)) {
      const on = names.includes(name);
      if ((element.getAttribute('aria-pressed') === 'true') !== on) element.click();
    }
  }

  shown() {
    return Object.entries({ ...this.toggles, side: this.sideToggle, ghosts: this.ghostsToggle })
      .filter(([, element]) => element.getAttribute('aria-pressed') === 'true')
      .map(([name]) => name);
  }

  /** Shows a view for each robot, or all of them in one: in lanes, or as ghosts on one ground. */
  setSide(on, ghosts = this.stage.ghosts) {
    Object.assign(this.stage, { sideBySide: on, ghosts });
    this.sideToggle.setAttribute('aria-pressed', String(on));
    this.raceToggle.setAttribute('aria-pressed', String(!on && !ghosts));
    this.ghostsToggle.setAttribute('aria-pressed', String(!on && ghosts));
    this.#arrange();
    this.#list();
    this.#wake();
    this.onchange();
  }

  /** Points the camera: in a race, it frames all lanes; otherwise, it goes back to where it was. */
  #arrange() {
    const { stage, stage: { camera } } = this;
    const lanes = stage.lanes();
    const isRace = Boolean(lanes);
    if (isRace === Boolean(this.apart) && lanes?.lens === this.lens) return;
    this.lens = lanes?.lens;
    if (isRace && this.apart) {
      camera.lens = lanes.lens;
    } else if (isRace) {
      const { target, yaw, pitch, distanceM, lens } = camera;
      this.apart = { target, yaw, pitch, distanceM, lens };
      camera.lens = lanes.lens;
    } else {
      Object.assign(camera, this.apart);
      this.apart = null;
    }
    this.#setFollow(!isRace);
    stage.isFramed = isRace;
  }

  /**
   * Returns the view for a link: camera, followed robot, time (if paused), speed and display
   * options.
   */
  view() {
    const { stage } = this;
    return {
      view: stage.isFramed ? null : stage.camera.toText(),
      follow: stage.follow ? stage.followed : null,
      time: this.playing ? null : Math.min(stage.timeS, stage.durationS()).toFixed(2),
      speed: this.speed === 1 ? null : this.speed, show: this.shown().join(','),
    };
  }

  /**
   * Applies the view of a link, once robots have loaded.
   * @param {URLSearchParams} parameters
   * @param {boolean} isMore it was applied before, to fewer robots: only the one to follow is left
   */
  setView(parameters, isMore = false) {
    const { stage } = this;
    if (isMore) {
      const at = parameters.get('follow');
      if (at !== null && stage.follow && Number(at) !== stage.followed && stage.robots[at]) {
        this.#followRobot(Number(at));
      }
      return;
    }
    const [show, view, follow, time, speed] = ['show', 'view', 'follow', 'time', 'speed']
      .map((name) => parameters.get(name));
    if (show !== null) this.setShown(show.split(','));
    if (view && stage.camera.fromText(view)) {
      this.aimed = true;
      stage.isFramed = false;
      this.#setFollow(follow !== null);
    }
    if (follow !== null && stage.robots[Number(follow)]) this.#followRobot(Number(follow));
    if (SPEEDS.some(([value]) => value === speed)) {
      this.speed = Number(speed);
      this.speedSelect.value = speed;
    }
    if (time !== null && Number.isFinite(Number(time))) {
      this.setPlaying(false);
      stage.timeS = Math.min(stage.durationS(), Math.max(0, Number(time)));
      this.#show();
    }
  }

  /** Marks the robot that is pointed at; among ghosts, it is opaque. */
  #point(robot) {
    if (this.stage.hovered === robot) return;
    this.stage.hovered = robot;
    if (this.stage.ghosts) this.#wake();
  }

  #hover({ offsetX, offsetY, buttons }) {
    const { stage } = this;
    if (!stage.drawn || !stage.solid() || buttons) return;
    let [nearest, pointed] = [HOVER_PX, null];
    for (const robot of stage.robots) {
      const place = stage.placeOf(robot);
      const [{ x, y }] = place ? stage.placesOf(place) : [{ x: Infinity, y: 0 }];
      const away = Math.hypot(x - offsetX, y - offsetY);
      if (away < nearest) [nearest, pointed] = [away, robot];
    }
    this.#point(pointed);
  }

  #setFollow(on) {
    if (this.stage.follow !== on) this.followToggle.click();
  }

  #key(event) {
    const act = {
      ' ': () => this.playButton.click(),
      ',': () => this.live || this.#stepBy(-1),
      '.': () => this.live || this.#stepBy(1),
      f: () => this.followToggle.click(),
      s: () => this.springsToggle.click(),
    }[event.key];
    if (!act || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    act();
  }

  #stepBy(frames) {
    this.setPlaying(false);
    const frameS = this.stage.robots[0]?.frameS ?? 0.04;
    const time = Math.round(this.stage.timeS / frameS + frames) * frameS;
    this.stage.timeS = Math.min(this.stage.durationS(), Math.max(0, time));
    this.#show();
    this.onchange();
  }

  /**
   * Shows motion that is computed while it plays, instead of recordings; null returns to
   * recordings.
   * @param {any} live has steering, tick(), timeS, restart(robots), setPlaying(on), setSpeed(speed)
   *   and close()
   */
  setLive(live) {
    this.live = live;
    this.slider.hidden = Boolean(live);
    this.#wake();
  }

  /**
   * @param {import('./stage.js').Robot[]} robots
   * @param {{keepTime?: boolean, live?: boolean, isMore?: boolean}} options live: they are those of
   *   setLive; isMore: the first of them are already on the stage
   */
  setRobots(robots, options = {}) {
    const { keepTime = false, live = false, isMore = false } = options;
    if (!this.stage) return;
    if (this.live && !live) {
      this.held = false;
      this.live.restart(robots);
      return;
    }
    this.stage.setRobots(robots, isMore);
    // Until the user turns the camera, the robots walk away from it, toward their light.
    if (robots.length && !this.aimed) this.stage.aim();
    this.held = false;
    const duration = this.stage.durationS();
    this.slider.max = String(duration || 1);
    if (!keepTime || this.stage.timeS > duration) this.stage.timeS = 0;
    this.sideToggle.parentElement.hidden = robots.length < 2;
    const apart = robots.length > 1;
    if (!this.arranged && this.stage.sideBySide !== apart) this.setSide(apart);
    this.arranged ||= robots.length > 1;
    this.#arrange();
    this.actuationToggle.disabled = !robots.some((robot) => robot.actuation);
    this.#list();
    const text = robots.length === 0 ? 'no robots yet'
      : `${robots.length === 1 ? 'one robot' : `${robots.length} robots`}, ` +
        `${duration.toFixed(1)} s: ` +
        robots.slice(0, 8).map((robot) => `${robot.label ?? ''} ${resultOf(robot)}`).join(', ');
    this.canvas.setAttribute('aria-label', `Stage: ${text}`);
    this.#wake();
    // Without a GPU, the next frame may have to wait until the rest of the page has been drawn.
    if (!this.first && robots.length && this.canvas.isConnected) this.#show();
  }

  /** Shows the names of the robots: in a list and, side by side or in a race, at the robots. */
  #list() {
    this.tags.name(this.stage);
    this.standings.set(this.stage);
    this.#showPlay();
    this.#cover();
  }

  /** Measures the list, because lanes are not drawn behind it. */
  #cover() {
    const { names, canvas } = this;
    const isOver = !names.hidden && getComputedStyle(names).position === 'absolute';
    this.stage.covered = isOver ? Math.min(0.4, (names.offsetWidth + 16) / canvas.clientWidth) : 0;
  }

  /** Saves a film; a film of a race includes the order. */
  async #film() {
    const { race } = this.standings;
    const [{ filmOf }, { save }] = await Promise.all(
      [import('../export/film.js'), import('../views/share.js')]);
    try {
      save(await filmOf(this, (share) => this.setNote(`Film: ${percent(share)}`), race),
        'morphod-race.webm');
    } catch (error) {
      announce(error.message, { isRefusal: true });
    }
    this.setNote('');
  }

  /** Shows how many robots have arrived while others are still being computed. */
  setComing(n, of) {
    if (!this.stage) return;
    this.isComing = n < of;
    this.stage.expected = of;
    if (!this.isComing) this.isEarly = false;
    this.coming.hidden = !this.isComing;
    say(this.coming, `${n} of ${of} robots`);
  }

  /** Returns whether a race is waiting for its robots. */
  #waits() {
    return Boolean(this.isComing && !this.isEarly && this.stage?.lanes());
  }

  #showPlay() {
    this.playButton.textContent = this.#waits() ? 'Start now' : this.playing ? 'Pause' : 'Play';
  }

  #followRobot(i) {
    this.stage.followed = i;
    this.#setFollow(true);
    this.standings.update(false);
    this.#wake();
    this.onchange();
  }

  /**
   * Stops drawing until new robots arrive or it is released: if frames take long, drawing the old
   * robots would delay the new ones.
   */
  hold(on) {
    this.held = on && this.meanFrameS > SLOW_FRAME_S;
    if (!on) this.#wake();
  }

  setPlaying(on) {
    this.playing = on;
    this.live?.setPlaying(on);
    this.#showPlay();
    this.#wake();
  }

  setNote(text) {
    this.note.textContent = text; // a live region: screen readers read it
  }

  /** Draws once, if it is not drawing anyway. */
  redraw() {
    this.#wake();
  }

  #wake() {
    this.wanted = true;
    if (this.running) return;
    this.running = true;
    this.before = undefined;
    requestAnimationFrame((now) => this.#frame(now));
  }

  #frame(now) {
    if (!this.stage || !this.canvas.isConnected || this.held || !this.isSeen) {
      this.running = false;
      return;
    }
    if (this.stage.isBusy()) {
      requestAnimationFrame((next) => this.#frame(next));
      return;
    }
    const duration = this.stage.durationS();
    const moving = this.playing && duration > 0 && !this.#waits();
    const elapsed = (now - this.before) / 1000; // NaN for the first picture
    if (moving && elapsed < ELAPSED_MAX_S) this.#adapt(elapsed);
    if (this.live) {
      this.live.tick();
    } else if (moving && elapsed >= 0) {
      // If pictures are slow, frames are skipped, to keep real time.
      this.stage.timeS = this.standings.after(this.stage.timeS,
        Math.min(elapsed, ELAPSED_MAX_S) * this.speed);
      // At the end, the last frame stays for a second.
      if (this.stage.timeS > duration + this.speed) this.stage.timeS = 0;
    }
    this.before = now;
    this.wanted = false;
    this.#show(moving);
    if (moving || this.wanted) requestAnimationFrame((next) => this.#frame(next));
    else this.running = false;
    clearTimeout(this.stillTimer);
    if (!moving) this.stillTimer = setTimeout(() => this.#drawStill(), STILL_MS);
  }

  /** Draws a still picture at full quality, however slow the previous frames were. */
  #drawStill() {
    const { scale, shadows } = this.stage;
    const isFull = scale === 1 && shadows;
    if (!this.playing && !this.held && !isFull && this.canvas.isConnected) {
      this.inFull(() => this.stage.draw());
    }
  }

  /** Does work, such as saving a picture, at full resolution and with the shadow. */
  async inFull(work) {
    const { stage } = this;
    const { scale, shadows } = stage;
    Object.assign(stage, { scale: 1, shadows: true });
    try {
      return await work();
    } finally {
      Object.assign(stage, { scale, shadows });
    }
  }

  /**
   * Lowers the resolution, then omits the shadow, if frames take long: without a GPU, or with a
   * small one. Two very slow frames in a row are enough.
   */
  #adapt(elapsed) {
    const { stage } = this;
    this.meanFrameS = 0.9 * (this.meanFrameS ?? 0.016) + 0.1 * elapsed;
    this.framesSince = (this.framesSince ?? 0) + 1;
    this.slowFrames = elapsed > VERY_SLOW_FRAME_S ? (this.slowFrames ?? 0) + 1 : 0;
    if (this.slowFrames >= 2) {
      this.slowFrames = 0;
      if (stage.scale > 0.5) stage.scale = 0.5;
      else if (stage.shadows) stage.shadows = false;
      else stage.scale = SCALE_MIN;
    } else if (this.framesSince >= 12 && this.meanFrameS >= SLOW_FRAME_S) {
      this.framesSince = 0;
      if (stage.scale > 0.5) stage.scale = Math.max(0.5, stage.scale * 0.75);
      else stage.shadows = false;
    }
    const isLower = stage.scale < 1 || !stage.shadows;
    this.drawing.hidden = !isLower;
  }

  #show(isMoving = false) {
    this.stage.timeS = Math.max(0, this.stage.timeS);
    const time = this.live ? this.live.timeS : Math.min(this.stage.timeS, this.stage.durationS());
    const early = performance.now() < this.createdMs + PATIENCE_MS;
    this.standings.update(isMoving);
    this.stage.draw({ empty: early && !this.stage.robots.length, isPart: isMoving });
    this.tags.place(this.stage, this.standings.order);
    this.live?.steering.place();
    this.slider.value = String(time);
    this.slider.setAttribute('aria-valuetext', `${time.toFixed(2)} seconds`);
    this.clock.textContent = `${time.toFixed(2)} s`;
    if (!this.first && this.stage.robots.length) {
      this.first = true;
      performance.mark('morphod-first-picture');
    }
  }

  destroy() {
    this.live?.close();
    this.app.themeListeners.delete(this.onTheme);
    clearTimeout(this.stillTimer);
    this.resize?.disconnect();
    this.sight?.disconnect();
    this.stage?.setRobots([]);
    this.stage?.gl.getExtension('WEBGL_lose_context')?.loseContext();
  }
}
