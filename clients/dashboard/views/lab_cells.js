/** The layers of the body being built, as grids of cells: pointers paint; keys move the focus and
 * set cells. */

import { WORKSPACE, hasVoxel } from '../lib/body.js';
import { h } from '../lib/dom.js';

/** A fast pointer reports points that are far apart; the line between them is sampled at this
 * distance. */
const STEP_PX = 6;
const KEYS = {
  ArrowLeft: [-1, 0, 0], ArrowRight: [1, 0, 0], ArrowUp: [0, 1, 0], ArrowDown: [0, -1, 0],
  PageUp: [0, 0, 1], PageDown: [0, 0, -1],
};
const range = (n) => Array.from({ length: n }, (_, i) => i);

export class Cells {
  /**
   * @param {{paint: (cell: number[], on: boolean) => void, commit: () => void}} edit
   *   paint: sets or clears a voxel; commit: ends a stroke, which is one step to undo
   */
  constructor(edit) {
    this.edit = edit;
    /** By "x,y,z". @type {Map<string, HTMLElement>} */
    this.byCell = new Map();
    this.element = h('div.layers', { role: 'group', 'aria-label': 'Body, layer by layer' },
      range(WORKSPACE[2]).map((z) => this.#layer(z)));
    const listen = (type, listener) => this.element.addEventListener(type, listener);
    listen('pointerdown', (event) => this.#begin(event));
    listen('pointermove', (event) => this.#move(event));
    for (const type of ['pointerup', 'pointercancel']) listen(type, (event) => this.#end(event));
    listen('contextmenu', (event) => { if (event.target.dataset.cell) event.preventDefault(); });
    listen('click', (event) => this.#click(event));
    listen('keydown', (event) => this.#key(event));
    listen('focusin', (event) => this.#mark(event.target));
    this.#mark(this.byCell.get('2,2,0'));
  }

  #layer(z) {
    const rows = range(WORKSPACE[1]).reverse().map((y) => h('div', { role: 'row' },
      range(WORKSPACE[0]).map((x) => {
        const cell = `${x},${y},${z}`;
        const made = h('button', {
          type: 'button', role: 'gridcell', 'data-cell': cell, tabindex: -1,
        });
        this.byCell.set(cell, made);
        return made;
      })));
    return h('fieldset.layer', {},
      h('legend', {}, z === 0 ? 'layer 0: ground' : `layer ${z}`),
      h('div.cells', { role: 'grid', 'aria-label': `Layer ${z}` }, rows));
  }

  /** Shows a body. @param {Set<string>} loose its loose voxels, as "x,y,z" */
  draw(genotype, loose) {
    for (const [name, element] of this.byCell) {
      const [x, y, z] = name.split(',').map(Number);
      const on = hasVoxel(genotype, x, y, z);
      const state = on ? (loose.has(name) ? 'loose voxel' : 'voxel') : 'empty';
      const below = hasVoxel(genotype, x, y, z - 1);
      element.classList.toggle('hint', !on && below);
      element.classList.toggle('loose', loose.has(name));
      if (element.dataset.state === state) continue;
      element.dataset.state = state;
      element.setAttribute('aria-selected', String(on));
      element.setAttribute('aria-label', `x ${x}, y ${y}, layer ${z}: ${state}`);
    }
  }

  /** Marks the cell with the focus, so that Tab returns to it. */
  #mark(element) {
    if (!element.dataset.cell) return;
    if (this.marked) this.marked.tabIndex = -1;
    element.tabIndex = 0;
    this.marked = element;
  }

  /** Begins a stroke. The first cell decides whether the stroke sets or clears; the right button
   * always clears. */
  #begin(event) {
    const { target, button, pointerId, clientX, clientY } = event;
    if (!target.dataset.cell || this.stroke || (button !== 0 && button !== 2)) return;
    const on = button === 0 && target.getAttribute('aria-selected') === 'false';
    this.stroke = { pointerId, on, at: [clientX, clientY] };
    this.isPointers = true;
    target.setPointerCapture(pointerId);
    this.#paint(target);
  }

  #paint(element) {
    const cell = element?.dataset?.cell;
    if (cell && this.byCell.get(cell) === element) {
      this.edit.paint(cell.split(',').map(Number), this.stroke.on);
    }
  }

  #move({ pointerId, clientX, clientY }) {
    const { stroke } = this;
    if (stroke?.pointerId !== pointerId) return;
    const [x, y] = stroke.at;
    const n = Math.ceil(Math.hypot(clientX - x, clientY - y) / STEP_PX);
    for (let i = 1; i <= n; i++) {
      this.#paint(document.elementFromPoint(x + (clientX - x) * i / n,
        y + (clientY - y) * i / n));
    }
    stroke.at = [clientX, clientY];
  }

  #end({ pointerId }) {
    if (this.stroke?.pointerId !== pointerId) return;
    this.stroke = null;
    this.edit.commit();
  }

  /** Handles clicks from keys and screen readers; the click that follows a stroke is part of the
   * stroke. */
  #click({ target, detail }) {
    const isStroke = this.isPointers && detail > 0;
    this.isPointers = false;
    if (isStroke || !target.dataset.cell) return;
    this.edit.paint(target.dataset.cell.split(',').map(Number),
      target.getAttribute('aria-selected') === 'false');
    this.edit.commit();
  }

  #key(event) {
    const step = KEYS[event.key];
    const cell = event.target.dataset.cell?.split(',').map(Number);
    if (!cell || !step) return;
    event.preventDefault();
    const to = cell.map((v, axis) => Math.min(WORKSPACE[axis] - 1, Math.max(0, v + step[axis])));
    this.byCell.get(to.join(',')).focus();
  }
}
