/** Where steps of one voxel lead from a body: its best changes, and the path to a local optimum. */

import { h, patch, say } from '../lib/dom.js';
import { countOf, voxels } from '../lib/format.js';
import { placeLike } from '../lib/atlas_place.js';

const STEPS = { add: 'added', remove: 'removed', move: 'moved' };

const isLower = (one, other) => (one.score ?? Infinity) < (other.score ?? Infinity);

/** Returns how much better or worse a body is than the one that is shown. */
function difference(one, body) {
  if (one.score === null || body.score === null) return null;
  const by = body.score - one.score;
  return h(`span.${by > 0 ? 'gain' : 'muted'}`, {},
    by === 0 ? 'the same' : `${Math.abs(by).toFixed(4)} ${by > 0 ? 'better' : 'worse'}`);
}

export class AtlasSteps {
  /** @param {any} page of an atlas */
  constructor(page) {
    this.page = page;
    this.changes = h('div.strip');
    this.way = h('div.strip');
    this.changesWords = h('span.muted');
    this.wayWords = h('span.muted');
    this.elements = [page.section('One voxel from here', this.changesWords, this.changes),
      page.section('The way up', this.wayWords, this.way)];
  }

  /** Shows nothing, because the body is not in the atlas. */
  clear() {
    for (const list of [this.changes, this.way]) patch(list, [], () => 0, () => null);
    for (const words of [this.changesWords, this.wayWords]) say(words, '');
  }

  /** Bodies larger than those of the atlas may be better. */
  #bound({ voxels: n }) {
    const { voxels_max: most } = this.page.about;
    return n === most ? ` (bodies of ${most + 1} voxels are not in this atlas)` : '';
  }

  /** Shows cards. Each keeps its place, so that the focus stays where it is. */
  #fill(list, cards) {
    patch(list, cards.map((card, i) => ({ ...card, i })), ({ i }) => i,
      ({ one }) => this.page.card(one), (card, { one, isApart, isStep, ...how }) => {
        this.page.fillCard(card, one, how);
        card.classList.toggle('apart', Boolean(isApart));
        card.classList.toggle('step', Boolean(isStep));
      });
  }

  /** @param {any} body with its best changes @param {string} genotype as it is drawn */
  showChanges(body, genotype) {
    const all = body.best_changes;
    const better = all.filter((one) => isLower(one, body)).length;
    say(this.changesWords, all.length === 0 ? 'No bodies are one voxel away'
      : better === 0 ? `Nothing is better: adding, removing or moving a voxel does not improve it${
        this.#bound(body)}`
        : `The best ${all.length}: ${better === all.length ? 'all better'
          : countOf(better, 'better one')}. Click one to go there.`);
    this.#fill(this.changes, all.map((one) => ({ one, title: STEPS[one.step], like: genotype,
      label: `One voxel ${STEPS[one.step]}`, words: difference(one, body) })));
  }

  /** @param {any} body @param {string} genotype as it is drawn @param {any} way its ascent */
  showWay(body, genotype, way) {
    const { best } = this.page.about;
    const top = way.optimum;
    const steps = way.bodies_on_path - 1;
    say(this.wayWords, steps === 0 ? 'This body is a local optimum: adding or removing a voxel ' +
      `does not improve it${this.#bound(body)}`
      : `${countOf(steps, 'step')} of steepest ascent, by adding and removing voxels, to a local ` +
      'optimum' +
      `${top.id === best.id ? ': the best of all' : ''}`);
    // Each body is turned like the previous one, so that the eye can follow the change.
    let like = genotype;
    const shown = way.items.map((one, i) => {
      const from = like;
      if (i) like = placeLike(from, one.id).genotype;
      return { one, like: from, isStep: i > 0, words: i ? difference(one, body) : null,
        title: i === 0 ? 'here' : i === steps ? 'optimum' : `step ${i}` };
    });
    const ends = [[body.best_of_size, `best of ${voxels(body.voxels)}`], [best, 'best of all']]
      .filter(([one], i) => ![top.id, body.id].includes(one.id) &&
        (i || one.id !== best.id))
      .map(([one, title], i) => ({ one, title, isApart: i === 0, words: difference(one, body) }));
    this.#fill(this.way, [...shown, ...ends]);
  }
}
