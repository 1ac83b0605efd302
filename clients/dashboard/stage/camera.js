/** A camera that circles around a point. It follows a robot, or the user turns, moves and zooms
 * it. */

import { lookAt, multiply, orthographic, perspective } from './math.js';

const NEAR_M = 0.02;
const LENS_NEAR_M = 0.3;
const FAR_M = 100;
/** Tangent of half of the angle of view. */
const RISE = Math.tan((19 * Math.PI) / 180);

export class Camera {
  constructor() {
    /** The point that the camera looks at, in meters. */
    this.target = [2.5, 2.5, 0.3];
    /** Rotation about the vertical axis, in radians; 0 looks along +y. */
    this.yaw = 0.6;
    /** Angle of the view above the horizon, in radians. */
    this.pitch = 0.4;
    this.distanceM = 2.2;
    /** Focal length: a longer lens shows the same scene from farther away, with less
     * perspective. */
    this.lens = 1;
    /** Scale of a view without perspective, in pixels per meter; 0 means perspective. */
    this.pixelsPerM = 0;
  }

  eye() {
    const away = this.distanceM * this.lens;
    const level = Math.cos(this.pitch) * away;
    return [
      this.target[0] - Math.sin(this.yaw) * level,
      this.target[1] - Math.cos(this.yaw) * level,
      this.target[2] + Math.sin(this.pitch) * away,
    ];
  }

  /** Returns the matrix from the world to a view of this size in pixels. */
  matrix(width, height) {
    const eye = this.eye();
    // Straight down, "up" on the screen is the direction of the yaw.
    const up = this.pitch > 1.5 ? [Math.sin(this.yaw), Math.cos(this.yaw), 0] : [0, 0, 1];
    const view = lookAt(eye, this.target, up);
    if (this.pixelsPerM > 0) {
      const scale = 2 * this.pixelsPerM;
      return multiply(orthographic(width / scale, height / scale, -FAR_M, FAR_M), view);
    }
    const near = this.lens > 1 ? LENS_NEAR_M : NEAR_M;
    const angle = 2 * Math.atan(RISE / this.lens);
    return multiply(perspective(angle, width / height, near, FAR_M), view);
  }

  turn(yaw, pitch) {
    this.yaw += yaw;
    this.pitch = Math.min(1.56, Math.max(0.02, this.pitch + pitch));
  }

  zoom(factor) {
    this.distanceM = Math.min(30, Math.max(0.35, this.distanceM * factor));
  }

  /** Moves the target across the ground, as seen from the camera, in meters. */
  move(right, forward) {
    const [s, c] = [Math.sin(this.yaw), Math.cos(this.yaw)];
    this.target[0] += right * c + forward * s;
    this.target[1] += -right * s + forward * c;
  }

  /** Writes the view as a short text for a link; the next function reads it. */
  toText() {
    const { target, yaw, pitch, distanceM } = this;
    return [...target, yaw, pitch, distanceM].map((x) => x.toFixed(3)).join('_');
  }

  fromText(text) {
    const numbers = text.split('_').map(Number);
    if (numbers.length !== 6 || numbers.some((x) => !Number.isFinite(x))) return false;
    this.target = numbers.slice(0, 3);
    this.yaw = numbers[3];
    this.pitch = 0;
    this.turn(0, numbers[4]);
    this.distanceM = 1;
    this.zoom(numbers[5]);
    return true;
  }
}

/**
 * Reports pointers on a canvas: drag(dx, dy, event) for one, pinch(factor, x, y) for two, and
 * click(x, y) for one that barely moved. If grab(x, y, event) returns an object, the pointer has
 * grabbed something: the object's move(x, y) and end() get this pointer instead.
 */
export function onPointers(canvas, { drag, pinch, click = (x, y) => {}, grab = undefined }) {
  const pointers = new Map();
  const held = new Map();
  let [moved, spread] = [0, 0];
  canvas.addEventListener('pointerdown', (event) => {
    canvas.setPointerCapture(event.pointerId);
    const hold = grab?.(event.offsetX, event.offsetY, event);
    if (hold) {
      held.set(event.pointerId, hold);
      return;
    }
    pointers.set(event.pointerId, [event.offsetX, event.offsetY]);
    [moved, spread] = [0, 0];
  });
  const letGo = (event) => {
    held.get(event.pointerId)?.end();
    return held.delete(event.pointerId);
  };
  canvas.addEventListener('pointermove', (event) => {
    held.get(event.pointerId)?.move(event.offsetX, event.offsetY);
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const [dx, dy] = [event.offsetX - before[0], event.offsetY - before[1]];
    pointers.set(event.pointerId, [event.offsetX, event.offsetY]);
    moved += Math.abs(dx) + Math.abs(dy);
    if (pointers.size !== 2) {
      drag(dx, dy, event);
      return;
    }
    const [a, b] = [...pointers.values()];
    const now = Math.hypot(a[0] - b[0], a[1] - b[1]);
    if (spread && now) pinch(spread / now, (a[0] + b[0]) / 2, (a[1] + b[1]) / 2);
    spread = now;
  });
  canvas.addEventListener('pointerup', (event) => {
    if (letGo(event)) return;
    pointers.delete(event.pointerId);
    if (moved < 5) click(event.offsetX, event.offsetY);
  });
  canvas.addEventListener('pointercancel', (event) => {
    letGo(event);
    pointers.delete(event.pointerId);
  });
}

/**
 * Lets pointers, wheel and keys drive a camera. `changed` is called after each change. others: grab
 * and click, as for onPointers.
 */
export function driveCamera(canvas, camera, changed, others = {}) {
  onPointers(canvas, {
    ...others,
    drag(dx, dy, event) {
      const moves = event.shiftKey || event.buttons === 4 || event.buttons === 2;
      const perPixel = camera.distanceM / canvas.clientHeight;
      if (moves) camera.move(-dx * perPixel, dy * perPixel);
      else camera.turn(dx * 0.006, dy * 0.005);
      changed(moves ? 'moved' : 'turned');
    },
    pinch(factor) {
      camera.zoom(factor);
      changed('turned');
    },
  });
  canvas.addEventListener('contextmenu', (event) => event.preventDefault());
  canvas.addEventListener('wheel', (event) => {
    event.preventDefault();
    camera.zoom(Math.exp(Math.sign(event.deltaY) * Math.min(Math.abs(event.deltaY), 120) * 0.0014));
    changed('turned');
  }, { passive: false });
  canvas.addEventListener('keydown', (event) => {
    const step = event.shiftKey ? 0.02 : 0.12;
    const keys = {
      ArrowLeft: () => camera.turn(-step, 0),
      ArrowRight: () => camera.turn(step, 0),
      ArrowUp: () => camera.turn(0, step / 2),
      ArrowDown: () => camera.turn(0, -step / 2),
      '+': () => camera.zoom(0.9),
      '=': () => camera.zoom(0.9),
      '-': () => camera.zoom(1.1),
    };
    const act = keys[event.key];
    if (!act || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    act();
    changed('turned');
  });
}
