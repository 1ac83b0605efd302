/** Cards of designs that can be selected for the stage, or as founders. */

import { button, h } from '../lib/dom.js';
import { countOf, scoreOf, voxels as inVoxels } from '../lib/format.js';
import { nameOf, shortOf } from '../lib/names.js';
import { picture } from '../lib/picture.js';
import { meters } from '../lib/tasks.js';
import { trayButton } from './add.js';
import { breedButton } from './start_buttons.js';

/** Formats a result: its value in meters if its task has one, or else its score. */
const wordsOf = (design) => (design.unit === 'm' && !design.lower_bound && design.value !== null
  ? meters(design.value) : scoreOf(design));

/** Cards of designs that can be selected for the stage. The selection is kept with the history. */
export class Wall {
  constructor(app) {
    this.app = app;
    /** Further parameters of the stage: the controller, or the world of the scores. */
    this.options = {};
    this.chosen = new Map(app.remembered().chosen); // {id, row, note} by genotype
    /** Called after each change of the selection. */
    this.changed = () => {};
    this.element = h('div.grid.small');
    this.watch = button('Watch selected', () => app.go('stage', {
      designs: [...this.chosen.keys()].join(','), ...this.options,
    }), { class: 'primary' });
    this.breed = breedButton(app, 'Breed these', () => this.#founders());
    this.keep = trayButton(() => [...this.chosen].map(([genotype, { note }]) =>
      ({ genotype, note })));
    this.#offer();
  }

  #offer() {
    const n = this.chosen.size;
    this.watch.disabled = this.breed.disabled = this.keep.disabled = n === 0;
    this.watch.title = n ? `${countOf(n, 'design')} selected` : 'Select designs first';
  }

  card(design) {
    const { id, robot = id, genotype, voxels, row } = design;
    const shown = design.score === undefined ? '–' : wordsOf(design);
    const card = h('button.card', {
      type: 'button', 'aria-pressed': String(this.chosen.has(genotype)),
      'aria-label': `${nameOf(id)}, ${robot}, score ${shown}, ${inVoxels(voxels)}`,
      onclick: () => {
        const on = !this.chosen.delete(genotype);
        if (on) this.chosen.set(genotype, { id, row, note: `score ${shown}` });
        card.setAttribute('aria-pressed', String(on));
        this.#offer();
        this.app.remember({ chosen: [...this.chosen] });
        this.changed();
      },
      ondblclick: () => this.app.go(`designs/${robot}`),
    }, picture(genotype), h('strong.number', {}, shown),
    design.isBest ? h('span.crown', {}, '♛ of the best') : null,
    h('span.muted', {}, inVoxels(voxels)));
    const link = { href: `#/designs/${robot}`, title: robot };
    return h('div.pick', {}, card, h('a', link, nameOf(id),
      h('div.muted', {}, shortOf(robot))));
  }

  /** Returns the selected designs, each form once, because a design may appear in several
   * orientations. */
  #founders() {
    const byId = new Map([...this.chosen].reverse().map(([voxels, { id }]) => [id, { voxels }]));
    return [...byId.values()].reverse();
  }

  add(designs) {
    this.element.append(...designs.map((design) => this.card(design)));
    import('./certificate_badges.js').then((to) => to.markCards(this.element, designs));
  }
}
