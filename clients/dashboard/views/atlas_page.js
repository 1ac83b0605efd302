/**
 * The page of an atlas: a body that is drawn, how it walks, its rank among all others, and where a
 * change of one voxel leads. It works with any source that has the interface of lib/atlas_file.js,
 * so a static site can show it, too.
 */

import { cellsOf, robotOf } from '../lib/body.js';
import { announce, fill, h } from '../lib/dom.js';
import { count, countOf, number, score, voxels } from '../lib/format.js';
import { isBody } from '../lib/history.js';
import { nameOf, shortOf } from '../lib/names.js';
import { picture } from '../lib/picture.js';
import { TASKS, measureOf, meters, spelledOut, taskWords } from '../lib/tasks.js';
import { centered, placeLike } from '../lib/atlas_place.js';
import { AtlasDraw } from './atlas_draw.js';
import { AtlasMap } from './atlas_map.js';
import { AtlasOptima } from './atlas_optima.js';
import { AtlasSteps } from './atlas_steps.js';

const CHANGES = 8;

/** Returns a percentile that does not round up to "better than all". */
const shareOf = (percentile) => `${(Math.floor(percentile * 100) / 100)
  .toFixed(percentile >= 99 || percentile < 1 ? 2 : 1)} %`;

/** Returns what distinguishes tasks, without headings, which vary from world to world. */
const kindOfTask = ({ objective, guide }) => JSON.stringify([objective, guide.kind,
  guide.points_m]);

/** Returns the name of the task in the forms, or its objective in words, and what else its worlds
 * have. */
export function taskTitle(environments) {
  const [{ task, terrain, damage }] = environments;
  const words = taskWords(environments);
  if (words.includes(',')) return words;
  const kind = kindOfTask(task ?? spelledOut('photo'));
  const title = TASKS.find(({ name }) => kindOfTask(spelledOut(name)) === kind)?.title ?? words;
  return title + (terrain ? ` on a ${terrain.kind}` : '') + (damage ? ', damaged' : '');
}

export class AtlasPage {
  /**
   * @param {any} atlas AtlasFile or AtlasHttp
   * @param {any} about its description
   * @param {{app: any, walker: any, links?: function(string): any[], others?: any,
   *   pairs?: function(any): any, compare?: function(any): any}} parts walker:
   *   has element, show(genotype, id) and close(); links: what else can be done with a body;
   *   others: an element beside the title; pairs, compare: make the last sections
   */
  constructor(atlas, about, { app, walker, links = () => [], others = null, pairs = null,
    compare = null }) {
    this.atlas = atlas;
    this.about = about;
    this.app = app;
    this.walker = walker;
    this.links = links;
    this.id = '';
    this.measure = measureOf(about.environments);
    this.turn = 0;
    /** What the atlas has of the body. @type {any} */
    this.shown = null;
    this.draw = new AtlasDraw((loose) => this.#show(loose),
      () => atlas.at(Math.floor(Math.random() * about.bodies)));
    this.steps = new AtlasSteps(this);
    this.map = new AtlasMap(this);
    this.optima = new AtlasOptima(this);
    this.pairs = pairs?.(this);
    this.compare = compare?.(this);
    this.numbers = h('div.atlas-numbers', { role: 'status' });
    this.watch = h('section.panel.flush.watch', { 'aria-label': 'Where it stands' },
      this.numbers, walker.element);
    this.element = h('div.atlas', {}, this.#head(others), this.#sizes(),
      h('div.grid.lab', {}, this.draw.element, this.watch), this.steps.elements,
      this.map.element, this.pairs?.element, this.optima.element, this.compare?.element);
  }

  /** The body as drawn. */
  get body() {
    return this.draw.body;
  }

  #head(others) {
    const { about, measure } = this;
    const isImages = about.orientations === 'images';
    const n = about.environments.length;
    const means = taskTitle(about.environments) === TASKS[0].title
      ? 'distance to the light at the end, 1 at the start' : measure ? 'loss, 1 if it stands still'
        : 'loss';
    return h('div.stack.atlas-head', {},
      h('div.title', {}, h('h1', {}, `Atlas ${about.name}`),
        others ? h('div.actions', {}, others) : null),
      h('p.sentence', {}, `All ${count(about.bodies)} robots of at most ` +
        `${voxels(about.voxels_max)}, each scored at `, h('em', {}, taskTitle(about.environments)),
      ': draw one, and see where it stands.'),
      h('p.muted', {}, `The score is the ${means}, the mean of ${countOf(n, 'environment')}` +
        `${isImages ? ' and of the body in all its orientations' : ''}: ↓ lower is better` +
        `${measure ? `, and meters ${measure.verb} are derived from it` : ''}. Scores hold for ` +
        'this one controller, ', h('code', { title: about.controller },
        about.controller.slice(0, 8)), ': with another, bodies rank differently.'));
  }

  section(title, words, ...children) {
    return h('section.panel.stack', { 'aria-label': title },
      h('div.row', {}, h('h2', {}, title), words), children);
  }

  /** Shows the best body of each size: the shortest way to a good one. */
  #sizes() {
    const cards = this.about.sizes.map((size) => this.card(size.best, {
      title: voxels(size.voxels),
      label: `The best of ${countOf(size.bodies, 'body', 'bodies')} of ${voxels(size.voxels)}`,
    }));
    return this.section('The best body of each size', null, h('div.strip.sizes', {}, cards));
  }

  /** Formats a score, with the meters of tasks that have them. */
  scoreWords(value) {
    return value === null || !this.measure ? score(value)
      : `${score(value)} (${meters(this.measure.valueOf(value))})`;
  }

  /**
   * Returns a small robot that becomes the body when it is clicked.
   * @param {any} body
   * @param {{title?: string, label?: string, words?: any, like?: string}} [how]
   */
  card(body, how = {}) {
    const card = h('button.card', { type: 'button' });
    this.fillCard(card, body, how);
    card.addEventListener('click', () => this.change(card.shown));
    return card;
  }

  /** @param {any} [how] */
  fillCard(card, body, how = {}) {
    const { title = '', label = title, words = null, like } = how;
    const { genotype, added } = like ? placeLike(like, body.id)
      : { genotype: body.genotype, added: undefined };
    card.shown = like ? genotype : centered(genotype);
    card.setAttribute('aria-label', `${label}${label && ': '}${nameOf(body.id)}, score ` +
      `${score(body.score)}, ${voxels(body.voxels)}`);
    card.title = nameOf(body.id);
    card.setAttribute('aria-pressed', String(body.id === this.id));
    card.dataset.id = body.id;
    fill(card, title ? h('span.muted', {}, title) : null, picture(genotype, '', added),
      h('strong.number', {}, score(body.score)), words);
  }

  /** Replaces the body in one step. */
  change(genotype) {
    this.draw.change(genotype);
  }

  /** Shows the body that is drawn, unless some of its voxels are loose. */
  async #show(loose) {
    const started = performance.now();
    const genotype = this.body;
    this.app.keep({ voxels: genotype });
    const turn = ++this.turn;
    this.watch.classList.toggle('stale', loose > 0);
    if (loose) return;
    this.id = robotOf(genotype).slice(0, 36);
    this.#markCards();
    this.walker.show(genotype, this.id, started);
    const { voxels_max: most } = this.about;
    const n = cellsOf(genotype).length;
    try {
      if (n > most) {
        throw new Error(`This atlas ends at ${voxels(most)}; the body has ${n}. Remove some.`);
      }
      const coming = this.atlas.ascent(genotype);
      coming.catch(() => {}); // the request for the body then fails, too
      const body = await this.atlas.body(genotype, { changes: CHANGES });
      if (turn !== this.turn) return;
      this.#say(body);
      performance.measure('morphod-atlas-click-to-numbers', { start: started });
      // Cards far below the numbers change something that is out of sight.
      if (this.shown && this.numbers.getBoundingClientRect().bottom < 0) {
        announce(`${nameOf(body.id)}: score ${score(body.score)}, better than ` +
          `${shareOf(body.percentile)}`);
      }
      this.steps.showChanges(body, genotype);
      this.#mark(body);
      const way = await coming;
      if (turn === this.turn) this.steps.showWay(body, genotype, way);
    } catch (error) {
      if (turn !== this.turn) return;
      fill(this.numbers, h('p.error', {}, error.message));
      this.steps.clear();
      this.#mark(null);
    }
  }

  /** Marks the body in the pictures of all bodies; null: it is not among them. */
  #mark(body) {
    this.shown = body;
    this.map.mark(body);
    this.pairs?.mark(body);
    this.compare?.mark(body);
  }

  /** Marks the cards of the body that is shown. */
  #markCards() {
    this.element.querySelectorAll('.card').forEach((card) =>
      card.setAttribute('aria-pressed', String(card.dataset.id === this.id)));
  }

  #say(body) {
    const { of_size: own } = body;
    const name = nameOf(body.id);
    fill(this.numbers, h('p.better-than', {}, body.rank === 1 ? h('strong', {}, 'The best')
      : ['Better than ', h('strong', {}, shareOf(body.percentile))],
    ` of all ${count(this.about.bodies)} bodies`),
    h('dl', {}, h('div', {}, h('dt', {}, 'score ↓'), h('dd', {}, this.scoreWords(body.score))),
      h('div', {}, h('dt', {}, 'rank'), h('dd', {}, count(body.rank))),
      h('div', {}, h('dt', {}, `among ${count(own.bodies)} of ${voxels(body.voxels)}`),
        h('dd', {}, own.rank === 1 ? '1: the best' : `${count(own.rank)}, better than ` +
          shareOf(own.percentile)))),
    body.measures ? h('dl', {}, Object.entries(body.measures).map(([measure, value]) => h('div', {},
      h('dt', {}, measure), h('dd', {}, value === null ? 'no value' : [number(value, 4),
        h('span.muted', {}, `, above ${shareOf(own.measures[measure])} of its size`)])))) : null,
    h('div.row', {}, h('span.muted', { title: body.id }, `${name} `,
      h('code', {}, shortOf(body.id))), this.links(this.body)));
  }

  destroy() {
    this.turn++;
    this.draw.destroy();
    this.map.destroy();
    this.pairs?.destroy();
    this.compare?.destroy();
    this.walker.close();
  }
}

/** Returns the body in the link; without one, a body from which there is somewhere to go. */
export function startOf(parameters, about) {
  const text = parameters.get('voxels');
  if (text && isBody(text)) return text;
  const size = about.sizes[Math.min(3, about.sizes.length - 1)];
  return centered(size.best.genotype);
}
