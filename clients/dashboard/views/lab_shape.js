/** The body that is built, drawn in 3-D at rest: a click on a face adds a voxel there. */

import { FACE_CORNERS, FACE_STEPS, WORKSPACE, cellsOf, hasVoxel } from '../lib/body.js';
import { announce, button, fill, h, say, svg } from '../lib/dom.js';
import { voxels } from '../lib/format.js';

/** A pointer that moved farther than this turns the view instead of clicking. */
const CLICK_PX = 5;
const PER_PX = 0.01;
const TURN = Math.PI / 4;
/** Classes of the sides, by their axis. */
const CLASSES = ['voxel-left', 'voxel-right', 'voxel-top'];
/** The side of a voxel that faces up. */
const UP = 5;
const OUTSIDE = `The workspace ends here: it has ${WORKSPACE.join(' × ')} voxels.`;

const isInside = (cell) => cell.every((v, axis) => v >= 0 && v < WORKSPACE[axis]);

export class Shape {
  /** @param {{paint: (cell: number[], on: boolean) => void, commit: () => void}} edit */
  constructor(edit) {
    this.edit = edit;
    this.genotype = '';
    /** @type {Set<string>} */
    this.loose = new Set();
    this.yaw = -0.5;
    this.pitch = 0.5;
    this.removes = false;
    this.faces = svg('g');
    this.ghost = svg('g', { class: 'ghost' });
    this.picture = svg('svg', { class: 'voxels shape', viewBox: '-4.5 -4.25 9 7.8', role: 'img' },
      // Loose voxels are hatched, which is visible without colors, too.
      svg('pattern', { id: 'hatch', width: 0.25, height: 0.25, patternUnits: 'userSpaceOnUse',
        patternTransform: 'rotate(45)' }, svg('path', { d: 'M0 0V1' })), this.faces, this.ghost);
    this.place = h('span.muted.place', { role: 'status' });
    const mode = (text, removes) => button(text, () => this.#setMode(removes), { title: removes
      ? 'A click removes the voxel, as Shift+click and right-click always do'
      : 'A click on a face adds a voxel there' });
    this.modes = [mode('Add', false), mode('Remove', true)];
    const turn = (text, name, yaw, pitch) => button(text, () => this.#turn(yaw, pitch),
      { class: 'icon', title: name, 'aria-label': name });
    this.element = h('div.stack.solid', {}, this.picture, h('div.row', {},
      h('div.pair', { role: 'group', 'aria-label': 'A click on a face' }, this.modes),
      turn('↺', 'Turn to the left', -TURN, 0), turn('↻', 'Turn to the right', TURN, 0),
      turn('⤒', 'Look from higher up', 0, TURN / 2), turn('⤓', 'Look from lower down', 0,
        -TURN / 2), this.place));
    this.#setMode(false);
    const listen = (type, listener) => this.picture.addEventListener(type, listener);
    listen('pointerdown', (event) => this.#down(event));
    listen('pointermove', (event) => this.#move(event));
    listen('pointerup', (event) => this.#up(event));
    listen('pointercancel', () => { this.held = null; });
    listen('pointerleave', () => this.#hover(null));
    listen('contextmenu', (event) => event.preventDefault());
  }

  #setMode(removes) {
    this.removes = removes;
    this.modes.forEach((one, i) => one.setAttribute('aria-pressed', String(removes === (i === 1))));
  }

  #turn(yaw, pitch) {
    this.yaw += yaw;
    this.pitch = Math.min(1.5, Math.max(-1.2, this.pitch + pitch));
    this.#hover(null);
    this.#draw();
  }

  /** Shows a body. @param {Set<string>} loose its loose voxels, as "x,y,z" */
  draw(genotype, loose) {
    this.genotype = genotype;
    this.loose = loose;
    this.picture.setAttribute('aria-label',
      `Body in 3-D, ${voxels(cellsOf(genotype).length)}. To edit it with the keyboard, use the ` +
      'layers below.');
    this.#draw();
  }

  /** Returns the direction from the body to the viewer. */
  #toViewer() {
    const level = Math.cos(this.pitch);
    return [Math.sin(this.yaw) * level, -Math.cos(this.yaw) * level, Math.sin(this.pitch)];
  }

  /** Returns a side of a voxel as a path. */
  #path([x, y, z], side) {
    const [sin, cos] = [Math.sin(this.yaw), Math.cos(this.yaw)];
    const [up, level] = [Math.cos(this.pitch), Math.sin(this.pitch)];
    const corners = FACE_CORNERS[side].map((c) => {
      const [u, v, w] = [x + (c >> 2) - 3, y + ((c >> 1) & 1) - 3, z + (c & 1) - 1.5];
      return [u * cos + v * sin, (u * sin - v * cos) * level - w * up].map((n) => n.toFixed(3))
        .join(' ');
    });
    return `M${corners.join('L')}Z`;
  }

  #draw() {
    const viewer = this.#toViewer();
    const depth = (cell) => cell.reduce((sum, v, axis) => sum + v * viewer[axis], 0);
    const face = (cell, side, name) => svg('path', { class: name, d: this.#path(cell, side),
      'data-face': `${cell},${side}`, 'vector-effect': 'non-scaling-stroke' });
    const floor = Array.from({ length: WORKSPACE[0] * WORKSPACE[1] }, (_, i) =>
      face([i % WORKSPACE[0], Math.floor(i / WORKSPACE[0]), -1], UP, 'floor'));
    // Painter's algorithm: back to front. From below, the floor would hide the body.
    const cells = cellsOf(this.genotype).sort((a, b) => depth(a) - depth(b));
    fill(this.faces, viewer[2] > 0 ? floor : null, cells.map((cell) => FACE_STEPS.map(
      (step, side) => {
        const [x, y, z] = cell.map((v, axis) => v + step[axis]);
        if (depth(step) <= 0 || hasVoxel(this.genotype, x, y, z)) return null;
        const isLoose = this.loose.has(String(cell));
        return [face(cell, side, CLASSES[side >> 1]),
          isLoose ? face(cell, side, 'loose') : null];
      })));
  }

  /** Returns what a click on an element does: {cell, on}; null: nothing. */
  #actAt(element, { shiftKey, button: pressed }) {
    const face = element?.dataset?.face?.split(',').map(Number);
    if (!face) return null;
    const side = face.pop();
    const removes = this.removes || shiftKey || pressed === 2;
    if (removes) return face[2] < 0 ? null : { cell: face, on: false };
    return { cell: face.map((v, axis) => v + FACE_STEPS[side][axis]), on: true };
  }

  /** Shows the place where a click would act. */
  #hover(act) {
    say(this.place, !act ? '' : isInside(act.cell)
      ? `${act.on ? 'add' : 'remove'} x ${act.cell[0]}, y ${act.cell[1]}, layer ${act.cell[2]}`
      : 'the workspace ends here');
    const viewer = this.#toViewer();
    const sides = act && isInside(act.cell) ? FACE_STEPS.keys() : [];
    fill(this.ghost, [...sides].filter((side) =>
      FACE_STEPS[side].some((v, axis) => v * viewer[axis] > 0)).map((side) => svg('path', {
      class: act.on ? 'adds' : 'removes', d: this.#path(act.cell, side),
      'vector-effect': 'non-scaling-stroke',
    })));
  }

  #down({ pointerId, clientX, clientY, button: pressed }) {
    if (this.held) return;
    this.held = { pointerId, pressed, at: [clientX, clientY], moved: 0 };
    this.picture.setPointerCapture(pointerId);
  }

  #move(event) {
    const { pointerId, clientX, clientY, pointerType, target } = event;
    const { held } = this;
    if (!held) {
      if (pointerType !== 'touch') this.#hover(this.#actAt(target, event));
      return;
    }
    if (held.pointerId !== pointerId) return;
    const [dx, dy] = [clientX - held.at[0], clientY - held.at[1]];
    held.moved += Math.hypot(dx, dy);
    held.at = [clientX, clientY];
    if (held.moved > CLICK_PX) this.#turn(-dx * PER_PX, dy * PER_PX);
  }

  #up(event) {
    const { held } = this;
    if (held?.pointerId !== event.pointerId) return;
    this.held = null;
    if (held.moved > CLICK_PX) return;
    const act = this.#actAt(document.elementFromPoint(event.clientX, event.clientY),
      { shiftKey: event.shiftKey, button: held.pressed });
    if (!act) return;
    if (!isInside(act.cell)) {
      announce(OUTSIDE);
      return;
    }
    this.edit.paint(act.cell, act.on);
    this.edit.commit();
    this.#hover(null);
  }
}
