/** Moving the light on the stage: by dragging it, by a click on the ground, or with keys. */

import { h } from '../lib/dom.js';
import { heightAt } from './math.js';

/** The light can be grabbed within this many pixels; fingers need more than pointers. */
const REACH_PX = 30;
const TOUCH_REACH_PX = 46;
/** With more views, the rings around the light would hide the robots. */
const RINGS_MAX = 16;
/** Height of the middle of the lamp above the ground. */
const LAMP_M = 0.1;
/** The range of the map, which the light does not leave. */
const MAP_M = [0, 5];
/** The service does not accept a light closer than this to the place where robots start. */
const START_M = [2.5, 2.5];
const APART_M = 0.1;
/** Steps and speed of the keys. */
const STEP_M = 0.08;
const SPEED_M_PER_S = 1.3;
/** By place on the keyboard, so that other layouts have the same four keys. */
const LETTERS = { KeyW: [0, 1], KeyS: [0, -1], KeyA: [-1, 0], KeyD: [1, 0] };
const ARROWS = { ArrowUp: [0, 1], ArrowDown: [0, -1], ArrowLeft: [-1, 0], ArrowRight: [1, 0] };

/**
 * Returns the point nearest to (x, y) where a light may stand, rounded to a millimeter.
 * @param {number[]} place
 */
export function placeFor(place) {
  const at = place.map((value) => Math.min(MAP_M[1], Math.max(MAP_M[0], value)));
  const [dx, dy] = at.map((value, axis) => value - START_M[axis]);
  const distance = Math.hypot(dx, dy);
  const apart = APART_M + 0.002; // still far enough apart when rounded
  if (distance < apart) {
    const turn = distance > 0 ? Math.atan2(dy, dx) : 0;
    at[0] = START_M[0] + apart * Math.cos(turn);
    at[1] = START_M[1] + apart * Math.sin(turn);
  }
  return at.map((value) => Math.round(value * 1000) / 1000);
}

export class Steering {
  /**
   * @param {import('./stage.js').Stage} stage
   * @param {{world: function(): any, move: function(number[]): void, leave: function(): void}} how
   *   world: has the light, which `move` changes; leave: called when Esc was pressed
   */
  constructor(stage, { world, move, leave }) {
    this.stage = stage;
    this.world = world;
    this.move = (place) => move(placeFor(place));
    this.leave = leave;
    /** Rings around the light, one for each view: they show what to drag, and where it is if it is
     * out of sight. */
    this.rings = h('div.rings', { 'aria-hidden': 'true' });
    stage.canvas.after(this.rings);
    /** Directions of the keys that are down. */
    this.down = new Map();
    /** Where the pointer holds the light, in CSS pixels. */
    this.held = null;
    this.listeners = { keydown: (event) => this.#press(event), keyup: (event) => this.#let(event),
      blur: () => this.down.clear(), pointermove: (event) => this.#hover(event) };
    for (const [name, listener] of Object.entries(this.listeners)) {
      stage.canvas.addEventListener(name, listener, { capture: true });
    }
  }

  close() {
    for (const [name, listener] of Object.entries(this.listeners)) {
      this.stage.canvas.removeEventListener(name, listener, { capture: true });
    }
    this.stage.canvas.classList.remove('on-light');
    this.rings.remove();
  }

  /** After each picture, moves the rings to the light. */
  place() {
    const places = this.stage.placesOf(this.#lamp());
    const shown = places.length > RINGS_MAX ? [] : places;
    while (this.rings.childElementCount > shown.length) this.rings.lastChild.remove();
    while (this.rings.childElementCount < shown.length) this.rings.append(h('i'));
    const top = this.stage.canvas.offsetTop;
    shown.forEach(({ x, y, isOut }, i) => {
      const ring = /** @type {HTMLElement} */ (this.rings.children[i]);
      ring.style.transform = `translate(${x.toFixed(1)}px, ${(y + top).toFixed(1)}px)`;
      ring.classList.toggle('out', isOut);
    });
  }

  #lamp() {
    const world = this.world();
    const [x, y] = world.light;
    return [x, y, heightAt(world, x, y) + LAMP_M];
  }

  /** Returns where the light is seen if the pointer is on it. */
  #under(x, y, event) {
    const reach = event.pointerType === 'touch' ? TOUCH_REACH_PX : REACH_PX;
    return this.stage.placesOf(this.#lamp())
      .find((place) => Math.hypot(place.x - x, place.y - y) <= reach);
  }

  #hover(event) {
    this.stage.canvas.classList.toggle('on-light',
      Boolean(this.held ?? this.#under(event.offsetX, event.offsetY, event)));
  }

  /** Handles a pointer of onPointers: grabs the light, if the pointer is on it. */
  grab(x, y, event) {
    if (event.button > 0 || event.shiftKey) return null;
    const place = this.#under(x, y, event);
    if (!place) return null;
    // If the lamp is not grabbed in its middle, it must not jump to the pointer, unless it was out
    // of sight.
    const off = place.isOut ? [0, 0] : [place.x - x, place.y - y];
    this.held = { at: [x + off[0], y + off[1]], height: this.#lamp()[2] };
    return {
      move: (px, py) => {
        this.held.at = [px + off[0], py + off[1]];
        this.#drag();
      },
      end: () => { this.held = null; },
    };
  }

  /** Moves the light to a place on the ground that was clicked. */
  click(x, y) {
    const place = this.stage.pointAt(x, y, this.#lamp()[2] - LAMP_M);
    if (place) this.move(place);
  }

  #drag() {
    const { at: [x, y], height } = this.held;
    const place = this.stage.pointAt(x, y, height);
    if (place) this.move(place);
  }

  /** Called for each picture: keys that are down move the light, and a held light stays under the
   * pointer although the camera follows the robot. */
  tick(elapsedS) {
    if (this.held) this.#drag();
    for (const direction of this.down.values()) {
      this.#step(direction, SPEED_M_PER_S * Math.min(elapsedS, 0.25));
    }
  }

  /** Moves the light as seen from the camera. */
  #step([right, away], lengthM) {
    const { yaw } = this.stage.camera;
    const [s, c] = [Math.sin(yaw), Math.cos(yaw)];
    const [x, y] = this.world().light;
    this.move([x + lengthM * (right * c + away * s), y + lengthM * (away * c - right * s)]);
  }

  #press(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const direction = event.shiftKey ? ARROWS[event.key] : LETTERS[event.code];
    if (!direction && event.key !== 'Escape') return;
    event.preventDefault();
    event.stopImmediatePropagation(); // the same keys do other things while no robot is driven
    if (!direction) {
      this.leave();
    } else if (!this.down.has(event.code)) {
      this.down.set(event.code, direction);
      this.#step(direction, STEP_M);
    }
  }

  #let(event) {
    this.down.delete(event.code);
  }
}
