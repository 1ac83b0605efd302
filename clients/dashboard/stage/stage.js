/**
 * The stage: robots that walk on their terrain toward their light, drawn with WebGL 2.
 *
 * The daemon's recordings go to the graphics processor unchanged, and each frame on the screen sets
 * only one number, the time. Therefore, scrubbing and slow motion cost almost no CPU time.
 */

import { Camera } from './camera.js';
import {
  Program, dataTexture, isSoftware, shadowTarget, stageContext, vertexArray,
} from './gl.js';
import { frameLanes, lampOf, lanesIn, lanesOf } from './lanes.js';
import {
  groundOf, heightAt, lookAt, multiply, normalize, orthographic, project, translated, unproject,
} from './math.js';
import { centerOfMass, release, upload } from './robot.js';
import {
  CONTACT_SHADERS, DEPTH_SHADERS, LAMP_SHADERS, SKIN_SHADERS, SPRING_SHADERS, TERRAIN_SHADERS,
  TRAIL_SHADERS,
} from './shaders.js';

/** Cells of the ground's mesh along each side, normally and in small views. */
const GRID = 160;
const COARSE_GRID = 56;
const TINY_GRID = 28;
/** Cells of the ground of a lane: along and across. */
const LANE_GRID = [120, 10];
/** Views shorter than this, in CSS pixels, are small: the camera moves closer. */
const SMALL_PX = 260;
const TINY_PX = 130;
/** Shorter views have no shadow; the map of shadows has this many texels along each side. */
const [SHADOW_PX, SHADOW_SIZE] = [60, 1024];
/** While robots move, each picture draws only this many of the views, in turn; fewer without a
 * GPU. */
const VIEWS_AT_ONCE = 64;
const VIEWS_IN_SOFTWARE = 12;

/** Colors of robots in the order of the legend: color-blind people can distinguish them. */
export const COLORS = ['#f0a030', '#4a9be8', '#57c08a', '#d070c0', '#e8e060', '#9a8cff', '#70d0e0',
  '#e07060'];

/** Opacity of ghosts, and of their parts behind other things. */
const [GHOST_ALPHA, FAINT_ALPHA] = [0.45, 0.15];

const THEMES = {
  dark: {
    background: [0.078, 0.09, 0.106], ground: [0.33, 0.375, 0.37], line: [0.1, 0.13, 0.14],
    glow: [1.0, 0.83, 0.42], rest: [0.82, 0.85, 0.9], swollen: [0.98, 0.62, 0.28],
    shrunk: [0.16, 0.47, 0.86],
  },
  light: {
    background: [0.925, 0.94, 0.96], ground: [0.61, 0.66, 0.62], line: [0.3, 0.34, 0.33],
    glow: [1.0, 0.88, 0.5], rest: [0.9, 0.92, 0.95], swollen: [0.94, 0.5, 0.12],
    shrunk: [0.13, 0.4, 0.8],
  },
};

function clear(gl, [r, g, b]) {
  gl.clearColor(r, g, b, 1);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
}

const NO_SHIFT = [0, 0, 0];
const NO_LANE = [0, 0, 0, 0];
const DEFAULT_WORLD = { light: [2.5, 4.5], heights: new Float32Array(64).fill(0.05) };

const toRgb = (hex) => [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16) / 255);

const MIDDLE_M = 2.5;

/** Returns the direction from the middle of the map to the light, as a rotation of the camera. */
const towardsLight = ({ light }) => Math.atan2(light[0] - MIDDLE_M, light[1] - MIDDLE_M);

/** Returns the direction of the sun: behind a viewer who looks toward the light, so that the
 * visible sides are lit. */
function sunOf(world) {
  const turn = towardsLight({ light: world.sunFrom ?? world.light }) + 0.75;
  return normalize([-0.7 * Math.sin(turn), -0.7 * Math.cos(turn), 1]);
}

/** Creates a mesh of `cells` × `rows` cells over the square from -1 to 1. */
function groundMesh(gl, cells, rows = cells) {
  const corners = new Float32Array((cells + 1) * (rows + 1) * 2);
  const triangles = new Uint32Array(cells * rows * 6);
  for (let y = 0, at = 0, t = 0; y <= rows; y++) {
    for (let x = 0; x <= cells; x++, at += 2) {
      corners[at] = (2 * x) / cells - 1;
      corners[at + 1] = (2 * y) / rows - 1;
      if (x === cells || y === rows) continue;
      const i = y * (cells + 1) + x;
      triangles.set([i, i + 1, i + cells + 2, i, i + cells + 2, i + cells + 1], t);
      t += 6;
    }
  }
  const mesh = vertexArray(gl, corners, [{ at: 0, size: 2, type: gl.FLOAT, stride: 8 }]);
  gl.bindVertexArray(mesh.array);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, triangles, gl.STATIC_DRAW);
  return { array: mesh.array, n: triangles.length };
}

/**
 * @typedef {Object} Robot
 * @property {ReturnType<import('../lib/body.js').bodyOf>} body
 * @property {Float32Array} track (frames, masses, 3) in meters
 * @property {number} frames
 * @property {number} frameS seconds per frame
 * @property {Float32Array|number[]} [lights] (frames, 3) of a light that a task moves
 * @property {{light: number[], points?: number[][], heights: Float32Array|number[],
 *   spacing?: number, columns?: number, key?: string, sunFrom?: number[], task?: any}} world light
 *   (x, y) in meters, at the start if it moves; waypoints of a path; a task other than `photo`;
 *   the terrain: 64 heights of a grid, or, with their spacing in meters, of a profile, or of a grid
 *   with these columns; sunFrom: where the sun is, instead of the light
 * @property {Int8Array} [actuation] (frames, springs), tanh · 127
 * @property {Uint8Array} [contacts] (frames, masses), 1 if a mass touches the ground
 * @property {string} [color] as in the legend
 * @property {string} [label]
 * @property {number|null} [loss] null if it diverged
 * @property {number|null} [value] in the unit of the task
 * @property {string} [unit] of the value; undefined: the task is `photo`
 * @property {string} [genotype]
 * @property {string} [id]
 * @property {string} [robot] ID@K
 * @property {boolean} [driven] it follows a light that the user moves, so it has no score
 * @property {string} [controller] if robots have several
 * @property {Float32Array} [centers] internal: the centers of mass
 * @property {any} [gpu] internal data of the stage
 */

export class Stage {
  /** @param {HTMLCanvasElement} canvas */
  constructor(canvas, { theme = 'dark', shadows = true } = {}) {
    const gl = stageContext(canvas, !isSoftware());
    if (!gl) throw new Error('This browser does not support WebGL 2, which the stage needs.');
    this.canvas = canvas;
    this.gl = gl;
    this.theme = theme;
    this.camera = new Camera();
    /** @type {Robot[]} */
    this.robots = [];
    this.show = { skin: true, springs: false, actuation: false, trails: true, contacts: false };
    this.sideBySide = false;
    /** Whether the robots of a race share one ground; all but one of them are translucent. */
    this.ghosts = false;
    /** The robot under the pointer. @type {?Robot} */
    this.hovered = null;
    /** The leader of the race. @type {?Robot} */
    this.leader = null;
    /** Whether the camera frames all lanes of a race, until the user turns it. */
    this.isFramed = false;
    /** Share of the width that is covered at the right. */
    this.covered = 0;
    this.follow = true;
    /** Index of the robot that the camera follows if all robots share one view. */
    this.followed = 0;
    this.scale = 1;
    this.shadows = shadows;
    this.timeS = 0;
    /** The views that were drawn last, their robots, and the index of the last view. */
    this.drawn = null;
    this.drawnOf = null;
    this.turn = 0;
    /** Number of views once all robots have arrived; their places are reserved. */
    this.expected = 0;
    /** @type {?{key: string, sun: number[]}} */
    this.sunAt = null;
    this.terrains = new Map();
    this.#build();
    canvas.addEventListener('webglcontextlost', (event) => event.preventDefault());
    canvas.addEventListener('webglcontextrestored', () => {
      this.fence = null;
      this.terrains.clear();
      this.#build();
      // The robots must stay the same objects, because their recordings grow while they are driven.
      for (const robot of this.robots) robot.gpu = { ...upload(gl, robot), tint: robot.gpu.tint };
    });
  }

  #build() {
    const { gl } = this;
    this.programs = {
      terrain: new Program(gl, TERRAIN_SHADERS).prepare(),
      skin: new Program(gl, SKIN_SHADERS).prepare(),
      depth: new Program(gl, DEPTH_SHADERS),
      springs: new Program(gl, SPRING_SHADERS),
      trail: new Program(gl, TRAIL_SHADERS).prepare(),
      contacts: new Program(gl, CONTACT_SHADERS),
      lamp: new Program(gl, LAMP_SHADERS).prepare(),
    };
    if (this.shadows) this.programs.depth.prepare();
    gl.cullFace(gl.FRONT); // the corners of faces are in this order
    /** Meshes of the ground that were needed so far, by their cells. */
    this.meshes = new Map();
    this.empty = gl.createVertexArray();
    gl.bindVertexArray(null);
    this.shadow = shadowTarget(gl, this.shadows ? SHADOW_SIZE : 1);
    this.noActuation = dataTexture(gl, gl.R8I, 1, 1, gl.RED_INTEGER, gl.BYTE, new Int8Array(1));
    this.noContacts = dataTexture(gl, gl.R8UI, 1, 1, gl.RED_INTEGER, gl.UNSIGNED_BYTE,
      new Uint8Array(1));
    gl.flush(); // starts the compiler
  }

  /** Waits for the programs that compile, before there is anything to draw. */
  #await() {
    for (const program of Object.values(this.programs)) program.await();
  }

  /**
   * Replaces the robots on the stage.
   * @param {Robot[]} robots
   * @param {boolean} isMore the first of them are already on the stage
   */
  setRobots(robots, isMore = false) {
    const { gl } = this;
    this.#await();
    const kept = isMore ? this.robots : [];
    for (const { gpu } of isMore ? [] : this.robots) {
      if (gpu) release(gl, gpu);
    }
    for (const texture of this.terrains.values()) gl.deleteTexture(texture);
    this.terrains.clear();
    this.robots = robots.map((robot, i) => ({
      ...robot,
      color: robot.color ?? COLORS[i % COLORS.length],
      gpu: kept[i]?.gpu ?? upload(gl, robot),
      centers: kept[i]?.centers,
    }));
    for (const robot of this.robots) robot.gpu.tint = toRgb(robot.color);
    const views = this.views();
    if (isMore && views.length > 1 && this.drawn?.[0].width === views[0].width) {
      // The other robots stay where they are drawn.
      [this.drawnOf, this.turn] = [this.robots, this.drawn.length - 1];
      this.drawn = [...this.drawn, ...views.slice(this.drawn.length)];
    }
    this.followed = Math.min(this.followed, Math.max(0, robots.length - 1));
  }

  /** Returns the lanes, if this is a race; robots that are driven share one light, so they have
   * none. */
  lanes() {
    const { robots } = this;
    if (this.sideBySide || robots.length < 2 || robots.some((robot) => robot.driven)) return null;
    const max = lanesIn(this.canvas.clientWidth);
    const { laned, ghosts } = this;
    if (laned?.of !== robots || laned.max !== max || laned.ghosts !== ghosts) {
      this.laned = { of: robots, max, ghosts, ...lanesOf(robots, max, ghosts) };
    }
    return this.laned;
  }

  /** Returns the opaque robot among ghosts: the robot that is pointed at or followed, or the
   * leader. Returns null if there are no ghosts. */
  solid() {
    if (!this.ghosts || this.sideBySide || this.robots.length < 2) return null;
    const drawn = this.lanes()?.robots ?? this.robots;
    return [this.hovered, this.follow ? this.robots[this.followed] : null, this.leader]
      .find((robot) => drawn.includes(robot)) ?? drawn[0];
  }

  /** Returns where a robot's center of mass is drawn now, or null if the robot is not drawn. */
  placeOf(robot) {
    const lanes = this.lanes();
    const shift = lanes ? lanes.shifts.get(robot) : NO_SHIFT;
    return shift &&
      centerOfMass(robot, this.frameOf(robot)).map((value, axis) => value + shift[axis]);
  }

  /** Returns the length of the longest recording, in seconds. */
  durationS() {
    return Math.max(0, ...this.robots.map((robot) => (robot.frames - 1) * robot.frameS));
  }

  #sun(world) {
    const key = String(world.sunFrom ?? world.light);
    if (this.sunAt?.key !== key) this.sunAt = { key, sun: sunOf(world) };
    return this.sunAt.sun;
  }

  #heights(world) {
    const key = world.key ?? world;
    if (!this.terrains.has(key)) {
      const { gl } = this;
      const { columns, rows } = groundOf(world);
      this.terrains.set(key, dataTexture(gl, gl.R32F, columns, rows, gl.RED, gl.FLOAT,
        Float32Array.from(world.heights)));
    }
    return this.terrains.get(key);
  }

  #ground(cells, rows) {
    if (!this.meshes.has(cells)) this.meshes.set(cells, groundMesh(this.gl, cells, rows));
    return this.meshes.get(cells);
  }

  frameOf(robot) {
    return Math.min(this.timeS / robot.frameS, robot.frames - 1);
  }

  /** Returns the views of the stage: one for all robots, or one for each. */
  views() {
    const { width, height } = this.canvas;
    const n = this.sideBySide ? this.robots.length : 1;
    if (n <= 1) {
      return [{ robots: this.lanes()?.robots ?? this.robots, x: 0, y: 0, width, height }];
    }
    const places = Math.max(n, this.expected);
    let columns = 1;
    // The split with views closest to the ratio 4 : 3.
    let best = Infinity;
    for (let c = 1; c <= places; c++) {
      const shape = width / c / (height / Math.ceil(places / c));
      const off = Math.abs(Math.log(shape / 1.35)) +
        0.35 * (Math.ceil(places / c) * c - places);
      if (off < best) [best, columns] = [off, c];
    }
    const rows = Math.ceil(places / columns);
    const [w, hgt] = [Math.floor(width / columns), Math.floor(height / rows)];
    return this.robots.map((robot, i) => ({
      robots: [robot],
      x: (i % columns) * w,
      y: height - (Math.floor(i / columns) + 1) * hgt,
      width: w - (i % columns < columns - 1 ? 1 : 0),
      height: hgt - 1,
    }));
  }

  /** Draws the current time, or only the background. isPart: some of very many views. */
  draw({ empty = false, isPart = false } = {}) {
    const { gl, canvas } = this;
    const width = Math.max(1, Math.round(canvas.clientWidth * devicePixelRatio * this.scale));
    const height = Math.max(1, Math.round(canvas.clientHeight * devicePixelRatio * this.scale));
    const isResized = canvas.width !== width || canvas.height !== height;
    if (isResized) Object.assign(canvas, { width, height });
    const look = THEMES[this.theme];
    const most = isSoftware() ? VIEWS_IN_SOFTWARE : VIEWS_AT_ONCE;
    if (isPart && !isResized && this.sideBySide && this.robots.length > most &&
      this.drawnOf === this.robots && this.drawn.length === this.robots.length) {
      for (let i = 0; i < most; i++) {
        this.turn = (this.turn + 1) % this.drawn.length;
        this.#drawView(this.drawn[this.turn], look);
      }
      this.#finish();
      return;
    }
    gl.disable(gl.SCISSOR_TEST);
    gl.viewport(0, 0, width, height);
    clear(gl, this.sideBySide ? look.line : look.background);
    if (empty) {
      this.#await();
      return;
    }
    this.drawn = this.views();
    [this.drawnOf, this.turn] = [this.robots, 0];
    for (const view of this.drawn) this.#drawView(view, look);
    this.#finish();
  }

  #finish() {
    const { gl } = this;
    gl.bindVertexArray(null);
    gl.deleteSync(this.fence ?? null);
    this.fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
  }

  /** Returns whether the graphics processor is still drawing the previous picture. */
  isBusy() {
    return Boolean(this.fence) &&
      this.gl.getSyncParameter(this.fence, this.gl.SYNC_STATUS) === this.gl.UNSIGNALED;
  }

  /** Turns the camera so that the light of the followed robot is ahead, a little to the left. */
  aim() {
    this.camera.yaw = towardsLight(this.robots[this.followed].world) + 0.35;
  }

  #drawView(view, look) {
    const { gl, camera } = this;
    const lanes = this.lanes();
    const lead = lanes ? this.robots[this.followed]
      : view.robots[Math.min(this.followed, view.robots.length - 1)];
    if (lanes && this.isFramed) {
      frameLanes(lanes, camera, view.width, view.height, this.covered);
    } else if (this.follow && lead) {
      const center = this.placeOf(lead);
      if (center) camera.target = [center[0], center[1], Math.max(center[2] - 0.05, 0)];
    }
    const { distanceM } = camera;
    const shown = (view.height / this.canvas.height) * this.canvas.clientHeight;
    if (!lanes) camera.distanceM *= Math.min(1, 0.45 + 0.55 * (shown / SMALL_PX));
    const matrix = camera.matrix(view.width, view.height);
    view.matrix = matrix;
    const eye = camera.eye();
    camera.distanceM = distanceM;
    const solid = this.solid();
    const isLaned = Boolean(lanes?.lane);
    const ground = isLaned ? this.#ground(...LANE_GRID)
      : this.#ground(shown < (this.shadows ? TINY_PX : SMALL_PX) ? TINY_GRID
        : shown < SMALL_PX || !this.shadows ? COARSE_GRID : GRID);
    const sun = this.#sun(lead?.world ?? DEFAULT_WORLD);
    const isShaded = this.shadows && shown >= SHADOW_PX;
    const sunMatrix = this.#drawShadows(view, sun, lanes, solid, isShaded);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(view.x, view.y, view.width, view.height);
    gl.viewport(view.x, view.y, view.width, view.height);
    clear(gl, look.background);
    gl.enable(gl.DEPTH_TEST);
    const common = {
      ...look, sun, shadowMap: this.shadow.texture, shadowStrength: isShaded ? 0.62 : 0,
      // In a race, colors distinguish the robots.
      owned: view.robots.length > 1 ? 0.65 : 0, alpha: 1,
      lane: lanes?.lane ?? NO_LANE, course: lanes?.course ?? NO_LANE,
      goal: lanes?.goal ?? 0, marks: lanes?.marks ?? 0,
    };
    /** Uniforms of a robot and its ground: a lane is the world, shifted. */
    const own = (robot, shift) => {
      const world = robot?.world ?? DEFAULT_WORLD;
      return {
        ...common, matrix: translated(matrix, shift), sunMatrix: translated(sunMatrix, shift),
        eye: eye.map((value, axis) => value - shift[axis]), heights: this.#heights(world),
        ...groundOf(world),
        lightAt: this.#lightOf(robot, world), tint: robot?.gpu.tint ?? NO_SHIFT,
      };
    };
    const shared = isLaned ? null : own(solid ?? lead, NO_SHIFT);
    const places = view.robots.map((robot) => shared ?? own(robot, lanes.shifts.get(robot)));
    for (const place of shared ? [shared] : places) {
      this.programs.terrain.use().set(place);
      gl.bindVertexArray(ground.array);
      gl.drawElements(gl.TRIANGLES, ground.n, gl.UNSIGNED_INT, 0);
    }
    view.robots.forEach((robot, i) => {
      if (!solid || robot === solid) this.#drawRobot(robot, places[i]);
    });
    if (solid) this.#drawGhosts(view.robots.filter((robot) => robot !== solid), shared);
    this.#drawBlended(view, places, shared);
    gl.disable(gl.SCISSOR_TEST);
  }

  /** Returns the view under a point on the page, as drawn last, and the point in it, from -1 to
   * 1. */
  #viewAt(x, y) {
    const { width, height, clientWidth } = this.canvas;
    const scale = width / clientWidth;
    const [px, py] = [x * scale, height - y * scale];
    const view = this.drawn?.find((one) => px >= one.x && px <= one.x + one.width &&
      py >= one.y && py <= one.y + one.height);
    return view && { view, at: [2 * (px - view.x) / view.width - 1,
      2 * (py - view.y) / view.height - 1] };
  }

  /** Returns the point (x, y) at this height that is seen at a point on the page, or null. */
  pointAt(x, y, height) {
    const seen = this.#viewAt(x, y);
    if (!seen) return null;
    const [px, py] = seen.at;
    const [near, far] = [-1, 1].map((depth) => unproject(seen.view.matrix, [px, py, depth]));
    const along = (height - near[2]) / (far[2] - near[2]);
    if (!(along > 0 && along < 1)) return null;
    return [0, 1].map((axis) => near[axis] + along * (far[axis] - near[axis]));
  }

  /**
   * Returns where a point of the world is seen in each view, as drawn last, in CSS pixels. A point
   * that is out of sight is at the edge of the view, on its side.
   */
  placesOf(point) {
    const { width, height, clientWidth } = this.canvas;
    const perPixel = clientWidth / width;
    const clamped = (value) => Math.min(1, Math.max(-1, value));
    return (this.drawn ?? []).map((view) => {
      const [px, py, depth] = project(view.matrix, point);
      const isBehind = depth > 1;
      const size = Math.max(Math.abs(px), Math.abs(py));
      const isOut = isBehind || size > 1;
      const [x, y] = isOut ? [px, py].map((value) =>
        clamped((isBehind ? -value : value) / (isBehind ? size : 1))) : [px, py];
      return { isOut, x: (view.x + ((x + 1) / 2) * view.width) * perPixel,
        y: (height - view.y - ((y + 1) / 2) * view.height) * perPixel };
    });
  }

  /** Returns where the light of a robot is drawn now. */
  #lightOf(robot, world) {
    return robot ? lampOf(robot, this.frameOf(robot), Boolean(this.lanes()?.lane))
      : [...world.light, heightAt(world, world.light[0], world.light[1]) + 0.06];
  }

  #drawShadows(view, sun, lanes, solid, isShaded) {
    const { gl } = this;
    const robots = solid ? [solid] : view.robots; // ghosts have no shadow
    const centers = robots.map((robot) => this.placeOf(robot));
    const middle = [0, 1, 2].map((axis) => {
      const values = centers.map((center) => center[axis]);
      return values.length ? (Math.min(...values) + Math.max(...values)) / 2 : 0;
    });
    const reach = 0.75 + Math.max(0,
      ...centers.map((c) => Math.hypot(c[0] - middle[0], c[1] - middle[1])));
    const from = middle.map((x, axis) => x + sun[axis] * 6);
    const sunMatrix = multiply(orthographic(reach, reach, 0.1, 12),
      lookAt(from, middle, [0, 0, 1]));
    if (!isShaded) return sunMatrix;
    if (this.shadow.size < SHADOW_SIZE) this.shadow = shadowTarget(gl, SHADOW_SIZE);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.shadow.frame);
    gl.disable(gl.SCISSOR_TEST);
    gl.viewport(0, 0, this.shadow.size, this.shadow.size);
    gl.enable(gl.DEPTH_TEST);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    this.programs.depth.use();
    for (const robot of robots) {
      this.programs.depth.set({ matrix: translated(sunMatrix, lanes?.shifts.get(robot) ?? NO_SHIFT),
        track: robot.gpu.track, frame: this.frameOf(robot) });
      gl.bindVertexArray(robot.gpu.skin.array);
      gl.drawArrays(gl.TRIANGLES, 0, 6 * robot.body.nFaces);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return sunMatrix;
  }

  /** Draws translucent robots, which do not hide each other: only what is behind other things is
   * fainter. */
  #drawGhosts(robots, shared) {
    const { gl } = this;
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.depthMask(false);
    for (const [test, alpha] of [[gl.GREATER, FAINT_ALPHA], [gl.LESS, GHOST_ALPHA]]) {
      gl.depthFunc(test);
      for (const robot of robots) this.#drawRobot(robot, { ...shared, alpha });
    }
    gl.depthMask(true);
    gl.disable(gl.BLEND);
  }

  #drawRobot(robot, common) {
    const { gl, show } = this;
    const own = { track: robot.gpu.track, frame: this.frameOf(robot), tint: robot.gpu.tint };
    if (show.skin) {
      this.programs.skin.use().set(common).set(own);
      gl.bindVertexArray(robot.gpu.skin.array);
      if (common.alpha < 1) gl.enable(gl.CULL_FACE); // the sides away from the eye
      gl.drawArrays(gl.TRIANGLES, 0, 6 * robot.body.nFaces);
      gl.disable(gl.CULL_FACE);
    }
    if (show.springs) {
      this.programs.springs.use().set(common).set({
        ...own,
        actuation: robot.gpu.actuation ?? this.noActuation,
        showActuation: show.actuation && robot.gpu.actuation !== null,
      });
      gl.bindVertexArray(robot.gpu.springs.array);
      gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, robot.body.nSprings);
    }
  }

  #drawBlended(view, places, shared) {
    const { gl, show } = this;
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.depthMask(false);
    view.robots.forEach((robot, i) => {
      const own = { track: robot.gpu.track, frame: this.frameOf(robot), tint: robot.gpu.tint };
      if (show.trails) {
        this.programs.trail.use().set(places[i]).set({ ...own, width: 0.016 });
        gl.bindVertexArray(robot.gpu.trail.array);
        gl.drawArrays(gl.TRIANGLE_STRIP, 0, robot.gpu.trail.n);
      }
      if (show.contacts) {
        this.programs.contacts.use().set(places[i]).set({
          ...own, contacts: robot.gpu.contacts ?? this.noContacts,
          hasContacts: robot.gpu.contacts !== null,
        });
        gl.bindVertexArray(this.empty);
        gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, robot.body.nMasses);
      }
    });
    // If the camera is farther away than 3.4 m, lamps are drawn smaller, except in lanes.
    const far = shared ? 1 : Math.min(1, 3.4 / this.camera.distanceM);
    const lamp = (place, at, size) => {
      this.programs.lamp.use().set(place)
        .set({ lightAt: at, size: [far * size * (view.height / view.width), far * size] });
      gl.bindVertexArray(this.empty);
      gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    };
    const world = view.robots[0]?.world;
    for (const place of shared ? [shared] : places) {
      for (const [x, y] of world?.points ?? []) {
        lamp(place, [x, y, heightAt(world, x, y) + 0.03], 0.2);
      }
      lamp(place, place.lightAt, 0.26);
    }
    gl.depthMask(true);
    gl.disable(gl.BLEND);
  }
}
