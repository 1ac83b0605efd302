/** The body of the page of an atlas: it is drawn as in the Lab, dropped, imported, or chosen at
 * random. */

import { genotypeOfId } from '../lib/body.js';
import { announce, button, fill, h } from '../lib/dom.js';
import { countOf } from '../lib/format.js';
import { centered } from '../lib/atlas_place.js';
import { looseOf, readBody, withVoxel } from '../lib/variation.js';
import { Cells } from './lab_cells.js';
import { Shape } from './lab_shape.js';

const UNDO_MAX = 100;
/** Narrower pages show the layers on request. */
const WIDE_PX = 900;

export class AtlasDraw {
  /**
   * @param {(loose: number) => void} changed called for each new body, with how many of its voxels
   *   are loose
   * @param {() => Promise<{genotype: string}>} random returns any body of the atlas
   */
  constructor(changed, random) {
    this.changed = changed;
    this.past = [];
    this.future = [];
    /** The body, and the drawing, which is ahead of the body during a stroke. */
    this.body = '';
    this.genotype = '';
    const edit = {
      paint: (...how) => this.#paint(...how), commit: () => this.change(this.genotype),
    };
    this.cells = new Cells(edit);
    this.shape = new Shape(edit);
    this.undo = button('Undo', () => this.#step(this.past, this.future), { title: 'Ctrl+Z' });
    this.redo = button('Redo', () => this.#step(this.future, this.past),
      { title: 'Ctrl+Shift+Z or Ctrl+Y' });
    this.loose = h('div.row.warning', { role: 'status', hidden: true });
    this.onKey = (event) => this.#key(event);
    document.addEventListener('keydown', this.onKey);
    this.element = h('section.panel.stack', { 'aria-label': 'Draw a body',
      ondragover: (event) => event.preventDefault(), ondrop: (event) => this.#drop(event) },
    h('div.row', {}, h('h2', {}, 'Draw a body'), this.undo, this.redo,
      button('Random', () => random().then(({ genotype }) => this.change(centered(genotype)))
        .catch((error) => announce(error.message, { isRefusal: true })),
      { title: 'Any body of the atlas' }),
      button('Import', () => this.#import(), { title: 'An id, cells or voxels; you can ' +
        'also drop one here' })),
    this.shape.element, h('details', { open: innerWidth >= WIDE_PX },
      h('summary', {}, 'Layer by layer'), this.cells.element), this.loose);
  }

  /** Replaces the body in one step. */
  change(genotype) {
    if (genotype === this.body) return;
    if (this.body) this.past.push(this.body);
    this.past.splice(0, this.past.length - UNDO_MAX);
    this.future = [];
    this.#show(genotype);
  }

  #show(genotype) {
    this.genotype = genotype;
    this.body = genotype;
    const loose = this.#draw();
    this.loose.hidden = !loose;
    fill(this.loose, h('span', {}, loose ? `${countOf(loose, 'loose voxel')}: connect or remove ` +
      `${loose === 1 ? 'it' : 'them'}. The numbers are for the previous body.` : ''));
    this.changed(loose);
  }

  /** Draws the body as it is; returns how many voxels are loose. */
  #draw() {
    const loose = looseOf(this.genotype);
    for (const drawing of [this.cells, this.shape]) {
      drawing.draw(this.genotype, new Set(loose.map(String)));
    }
    for (const [one, list] of [[this.undo, this.past], [this.redo, this.future]]) {
      one.setAttribute('aria-disabled', String(!list.length));
    }
    return loose.length;
  }

  #paint(cell, on) {
    const next = withVoxel(this.genotype, cell, on);
    if (!next.includes('1')) {
      announce('A body needs at least one voxel.');
    } else if (next !== this.genotype) {
      this.genotype = next;
      this.#draw();
    }
  }

  #step(from, to) {
    const body = from.pop();
    if (!body) return;
    to.push(this.body);
    this.#show(body);
  }

  #key(event) {
    const { key, target, ctrlKey, metaKey, shiftKey, altKey } = event;
    const list = { z: shiftKey ? this.redo : this.undo, y: this.redo }[key.toLowerCase()];
    if (!list || !(ctrlKey || metaKey) || altKey) return;
    if (target.closest?.('input:not([type=range]), textarea, dialog')) return; // it undoes text
    event.preventDefault();
    list.click();
  }

  #read(text) {
    const body = readBody(text);
    this.change(body.genotype ?? centered(genotypeOfId(body.id)));
    if (body.lost) announce(body.lost);
  }

  #drop(event) {
    event.preventDefault();
    const [file] = event.dataTransfer.files;
    Promise.resolve(file ? file.text() : event.dataTransfer.getData('text/plain'))
      .then((text) => this.#read(text))
      .catch((error) => announce(error.message, { isRefusal: true }));
  }

  async #import() {
    const { formDialog } = await import('./share.js');
    const text = h('textarea', { rows: 6, 'aria-label': 'Body' });
    formDialog('Import a body', 'Import', () => this.#read(text.value), h('p.wide', {},
      'An id or a robot (ID@K), 144 voxel digits, or a list of cells as [[x,y,z], …].'),
    h('div.stack.wide', {}, text));
  }

  destroy() {
    document.removeEventListener('keydown', this.onKey);
  }
}
