/** The champions of a campaign, and a stage on which its designs walk. */

import { button, fill, h, patch } from '../lib/dom.js';
import { voxels } from '../lib/format.js';
import { nameOf, shortOf } from '../lib/names.js';
import { picture } from '../lib/picture.js';
import { rollInWorld, rollOfCampaign, worldOfJob } from '../lib/rollouts.js';
import { Player } from '../stage/player.js';
import { trayButton } from './add.js';
import { breedButton } from './start_buttons.js';

const badges = () => import('./certificate_badges.js');
const WALKING_MAX = 64;
/** This many of the champions walk first. */
const FIRST = 4;
const PATIENCE_MS = 300;

/** Returns designs, the best one first. */
function bestFirst(items) {
  const best = items.reduce((a, b) => ((a.score ?? Infinity) <= (b.score ?? Infinity) ? a : b));
  return [best, ...items.filter((one) => one !== best)];
}

const listChampions = ({ id, get }) => get(`v1/campaigns/${id}/champions`);

/**
 * Requests the champions of a campaign, and then the rollouts of the first, which the service
 * computes while the page is built. Returns both for the page's Champions; null if there are none.
 */
export async function startChampions(shared) {
  if (shared.job().progress.generation === null) return null;
  const [list, world] = await Promise.all([listChampions(shared),
    worldOfJob('campaign', shared.job())]);
  const robots = rollInWorld(world, bestFirst(list.items).slice(0, FIRST), shared.signal);
  robots.catch(() => {}); // the stage reports it
  return { list, robots };
}

/** A stage for designs of a campaign, in the world of their scores. */
export class CampaignStage {
  constructor({ app, job, signal }, height = 420) {
    this.job = job;
    this.signal = signal;
    this.player = new Player(app, { compact: true, height });
    /** Called before other designs walk. */
    this.taken = () => {};
    this.element = h('section.panel.flush', { 'aria-label': 'Stage' }, this.player.element);
  }

  get isEmpty() {
    return !this.isTaken && !this.player.stage?.robots.length;
  }

  /** Leaves the stage to other views: designs that were requested for it no longer walk. */
  take() {
    this.turn = (this.turn ?? 0) + 1;
    this.isTaken = true;
    this.player.setNote('');
  }

  /** Shows designs walking. robots: their rollouts, if these have been requested. */
  async walk(designs, robots = null) {
    const shown = designs.slice(0, WALKING_MAX);
    if (!shown.length) return;
    this.taken();
    this.take();
    this.isTaken = false;
    const { turn } = this;
    this.player.setNote('Walking…');
    try {
      const walking = await (robots ?? rollOfCampaign(this.job(), shown, this.signal));
      if (turn !== this.turn) return; // something else was chosen
      this.player.setRobots(walking);
      this.player.setNote('');
      badges().then((to) => to.markStage(this.player, walking, this.signal)).catch(() => {});
    } catch (error) {
      if (!this.signal.aborted && turn === this.turn) this.player.setNote(error.message);
    }
  }

  destroy() {
    this.player.destroy();
  }
}

/** Cards of the best and the most distinct designs. Each walks when it is pressed. */
export class Champions {
  constructor(shared, stage) {
    const { app, id, job, shown, signal } = shared;
    this.shared = shared;
    this.job = job;
    this.shown = shown;
    this.signal = signal;
    this.stage = stage;
    this.cards = h('div.grid.small');
    this.nothing = h('p.empty', {}, 'Champions appear after the first generation.');
    this.chosen = new Map(); // designs by number
    const genotypes = () => [...this.chosen.values()].map(({ genotype }) => genotype);
    this.watch = button('Watch selected', () => app.go('stage', {
      designs: genotypes().join(','), world: `campaign-${id}`,
    }), { disabled: true, title: 'On the stage, in the world of this campaign' });
    this.breed = breedButton(app, 'Breed these', () =>
      genotypes().map((voxels) => ({ voxels })), { disabled: true });
    this.keep = trayButton(() => [...this.chosen.values()].map((design) =>
      ({ genotype: design.genotype, note: `score ${this.shown(design.score)}` })),
    { disabled: true });
    this.element = h('section.panel.stack', {}, h('div.title', {}, h('h2', {}, 'Champions'),
      h('span.muted', {}, 'the best, then the most distinct of the good ones; select one to see ' +
        'it walk'), h('div.actions', {}, this.watch, this.keep, this.breed)), this.cards,
    this.nothing);
  }

  async refresh() {
    this.nothing.hidden = this.job().progress.generation !== null;
    if (!this.nothing.hidden) return;
    const { shared, shared: { first } } = this;
    shared.first = null; // it is shown once
    try {
      await this.#show(first?.list ?? await listChampions(shared), first?.robots);
    } catch (error) {
      if (!this.signal.aborted) fill(this.nothing, error.message).hidden = false;
    }
  }

  async #show({ items, re_evaluated: again = null }, robots) {
    // A selected design stays even when it is no longer a champion.
    const shown = bestFirst(items);
    const [best] = shown;
    for (const design of this.chosen.values()) {
      if (!shown.some((one) => one.number === design.number)) shown.push(design);
    }
    patch(this.cards, shown, (design) => design.number, (design) => this.#card(design),
      (element, design) => {
        element.querySelector('.crown').hidden = design.number !== best.number;
      });
    if (this.stage.isEmpty) {
      // What else there is to show waits for the first robots, but not for long.
      await Promise.race([this.stage.walk(shown.slice(0, FIRST), robots),
        new Promise((resolve) => setTimeout(resolve, PATIENCE_MS))]);
    }
    badges().then((to) => to.markCards(this.cards, shown, this.shown, again)).catch(() => {});
  }

  /** Returns the card of a champion: it walks here, or is selected for the stage or as a
   * founder. */
  #card(design) {
    const { number, genotype, operator } = design;
    const card = h('button.card', {
      type: 'button', title: design.robot, onclick: () => this.stage.walk([design]),
    }, picture(genotype, `Champion ${number}`), h('strong.number', {}, this.shown(design.score)),
    h('span.crown', { hidden: true }, '♛ best'),
    h('span', {}, nameOf(design.robot)),
    h('span.muted', {}, `#${number}, ${shortOf(design.robot)}`),
    h('span.muted', {}, `${voxels(design.voxels)}, ${operator}`));
    const label = `Choose #${number}, ${nameOf(design.robot)}`;
    const box = h('input', { type: 'checkbox', 'aria-label': label, onchange: () => {
      if (box.checked) this.chosen.set(number, design);
      else this.chosen.delete(number);
      this.watch.disabled = this.keep.disabled = this.breed.disabled = this.chosen.size === 0;
    } });
    return h('div.pick', {}, card, h('label.row', {}, box, 'choose'));
  }
}
