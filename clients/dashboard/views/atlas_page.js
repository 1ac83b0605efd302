/**
 * The page of an atlas: a body that is drawn, how it walks, where it stands among all others, and
 * where a change of one voxel leads. It works with any source that has the interface of
 * lib/atlas_file.js, so a static site can show it, too.
 */

import { cellsOf, genotypeOfId, robotOf } from '../lib/body.js';
import { announce, button, fill, h, patch, say } from '../lib/dom.js';
import { count, countOf, score, voxels } from '../lib/format.js';
import { isBody } from '../lib/history.js';
import { nameOf, shortOf } from '../lib/names.js';
import { picture } from '../lib/picture.js';
import { TASKS, measureOf, meters, spelledOut, taskWords } from '../lib/tasks.js';
import { looseOf, readBody, withVoxel } from '../lib/variation.js';
import { centered, placeLike } from '../lib/atlas_place.js';
import { AtlasMap } from './atlas_map.js';
import { AtlasOptima } from './atlas_optima.js';
import { Cells } from './lab_cells.js';
import { Shape } from './lab_shape.js';

const STEPS = { add: 'added', remove: 'removed', move: 'moved' };
const UNDO_MAX = 100;
const CHANGES = 8;
/** Narrower pages show the layers when they are asked for. */
const WIDE_PX = 900;

/** Returns a percentile that does not round up to "better than all". */
const shareOf = (percentile) => `${(Math.floor(percentile * 100) / 100)
  .toFixed(percentile >= 99 || percentile < 1 ? 2 : 1)} %`;

/** Returns the name of the task in the forms, or its objective in words. */
export function taskTitle(environments) {
  const [{ task }] = environments;
  const words = taskWords(environments);
  if (words.includes(',')) return words;
  const of = task ?? spelledOut('photo');
  return TASKS.find(({ name }) => {
    const known = spelledOut(name);
    return known.objective === of.objective && known.guide.kind === of.guide.kind;
  })?.title ?? words;
}

export class AtlasPage {
  /**
   * @param {any} atlas AtlasFile or AtlasHttp
   * @param {any} about its description
   * @param {{app: any, walker: any, links?: function(string): any[], others?: any,
   *   compare?: function(any): any}} parts walker:
   *   has element, show(genotype, id) and close(); links: what else can be done with a body;
   *   others: goes beside the title; compare: makes the last section
   */
  constructor(atlas, about, { app, walker, links = () => [], others = null, compare = null }) {
    this.atlas = atlas;
    this.about = about;
    this.app = app;
    this.walker = walker;
    this.links = links;
    /** The drawing, during a stroke ahead of the body. */
    this.genotype = '';
    this.body = '';
    this.id = '';
    this.measure = measureOf(about.environments);
    this.past = [];
    this.future = [];
    this.turn = 0;
    const edit = { paint: (...how) => this.#paint(...how), commit: () => this.#commit() };
    this.cells = new Cells(edit);
    this.shape = new Shape(edit);
    this.map = new AtlasMap(this);
    this.optima = new AtlasOptima(this);
    this.compare = compare?.(this);
    /** What the atlas has of the body. @type {any} */
    this.shown = null;
    this.numbers = h('div.atlas-numbers', { role: 'status' });
    this.changes = h('div.strip');
    this.way = h('div.strip');
    this.wayWords = h('span.muted');
    this.changesWords = h('span.muted');
    this.undo = button('Undo', () => this.#step(this.past, this.future), { title: 'Ctrl+Z' });
    this.redo = button('Redo', () => this.#step(this.future, this.past),
      { title: 'Ctrl+Shift+Z or Ctrl+Y' });
    this.loose = h('div.row.warning', { hidden: true });
    this.onKey = (event) => this.#key(event);
    document.addEventListener('keydown', this.onKey);
    this.watch = h('section.panel.flush.watch', { 'aria-label': 'Where it stands' },
      this.numbers, walker.element);
    this.element = h('div.atlas', {}, this.#head(others), this.#sizes(),
      h('div.grid.lab', {}, this.#editor(), this.watch),
      this.#section('One voxel from here', this.changesWords, this.changes),
      this.#section('The way up', this.wayWords, this.way),
      this.map.element, this.optima.element, this.compare?.element);
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
      h('p.sentence', {}, `All ${count(about.bodies)} robots of at most ${about.voxels_max} ` +
        `voxels, each scored at `, h('em', {}, taskTitle(about.environments)),
      ': draw one, and see where it stands.'),
      h('p.muted', {}, `The score is the ${means}, the mean of ${countOf(n, 'environment')}` +
        `${isImages ? ' and of the body in all its orientations' : ''}: ↓ lower is better` +
        `${measure ? `, and ${measure.verb} meters follow from it` : ''}. A body's value holds ` +
        'under this one controller, ', h('code', { title: about.controller },
        about.controller.slice(0, 8)), ': under another, bodies rank differently.'));
  }

  #section(title, words, ...children) {
    return h('section.panel.stack', { 'aria-label': title },
      h('div.row', {}, h('h2', {}, title), words), children);
  }

  /** The best body of each size: the shortest way to a good one. */
  #sizes() {
    const cards = this.about.sizes.map((size) => this.card(size.best, {
      title: voxels(size.voxels),
      label: `The best of ${countOf(size.bodies, 'body', 'bodies')} of ${voxels(size.voxels)}`,
    }));
    return this.#section('The best body of each size', null, h('div.strip.sizes', {}, cards));
  }

  #editor() {
    return h('section.panel.stack', { 'aria-label': 'Draw a body', ondragover: (event) =>
      event.preventDefault(), ondrop: (event) => this.#drop(event) },
    h('div.row', {}, h('h2', {}, 'Draw a body'), this.undo, this.redo,
      button('Random', () => this.#random(), { title: 'Any body of the atlas' }),
      button('Import', () => this.#import(), { title: 'An id, cells or voxels; you can also ' +
        'drop such a text here' })),
    this.shape.element, h('details', { open: innerWidth >= WIDE_PX }, h('summary', {}, 'Layer by layer'),
      this.cells.element), this.loose);
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

  // ---- the body that is drawn ----

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

  #commit() {
    if (this.genotype !== this.body) this.show(this.genotype);
  }

  #step(from, to) {
    const body = from.pop();
    if (!body) return;
    to.push(this.body);
    this.body = body;
    this.show(body, { isNew: false });
  }

  #key(event) {
    const { key, target, ctrlKey, metaKey, shiftKey, altKey } = event;
    const list = { z: shiftKey ? this.redo : this.undo, y: this.redo }[key.toLowerCase()];
    if (!list || !(ctrlKey || metaKey) || altKey) return;
    if (target.closest?.('input:not([type=range]), textarea, dialog')) return;
    event.preventDefault();
    list.click();
  }

  /** Any body, each with the same probability: most have many voxels. */
  async #random() {
    const at = Math.floor(Math.random() * this.about.bodies);
    const { genotype } = await this.atlas.at(at);
    this.change(centered(genotype));
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
      'An id or a robot (ID@K), 144 digits of voxels, or a list of cells as [[x,y,z], …].'),
    h('div.stack.wide', {}, text));
  }

  /** Replaces the body in one step. */
  change(genotype) {
    if (genotype !== this.body) this.show(genotype);
  }

  /** Shows a body. */
  async show(genotype, { isNew = true } = {}) {
    const started = performance.now();
    if (isNew && this.body) {
      this.past.push(this.body);
      this.past.splice(0, this.past.length - UNDO_MAX);
      this.future = [];
    }
    this.genotype = genotype;
    this.body = genotype;
    this.app.keep({ voxels: genotype });
    const turn = ++this.turn;
    const loose = this.#draw();
    this.loose.hidden = !loose;
    fill(this.loose, h('span', {}, loose ? `${countOf(loose, 'loose voxel')}: connect or remove ` +
      `${loose === 1 ? 'it' : 'them'}. The numbers are those of the body before.` : ''));
    this.watch.classList.toggle('stale', loose > 0);
    if (loose) return;
    this.id = robotOf(genotype).slice(0, 36);
    this.#mark();
    this.walker.show(genotype, this.id, started);
    const isInside = cellsOf(genotype).length <= this.about.voxels_max;
    try {
      if (!isInside) throw new Error(`This atlas ends at ${this.about.voxels_max} voxels; the ` +
        `body has ${cellsOf(genotype).length}. Remove some.`);
      const coming = this.atlas.ascent(genotype);
      coming.catch(() => {}); // then the body fails, too
      const body = await this.atlas.body(genotype, { changes: CHANGES });
      if (turn !== this.turn) return;
      this.#say(body);
      // Cards far below change what is out of sight.
      if (isNew && this.past.length && this.numbers.getBoundingClientRect().bottom < 0) {
        announce(`${nameOf(body.id)}: score ${score(body.score)}, better than ` +
          `${shareOf(body.percentile)}`);
      }
      performance.measure('morphod-atlas-click-to-numbers', { start: started });
      this.#sayChanges(body);
      this.#markBody(body);
      const way = await coming;
      if (turn !== this.turn) return;
      this.#sayWay(body, way);
    } catch (error) {
      if (turn !== this.turn) return;
      fill(this.numbers, h('p.error', {}, error.message));
      for (const list of [this.changes, this.way]) patch(list, [], () => 0, () => null);
      for (const words of [this.changesWords, this.wayWords]) say(words, '');
      this.#markBody(null);
    }
  }

  /** Marks the body in the pictures of all bodies; null: it is not among them. */
  #markBody(body) {
    this.shown = body;
    this.map.mark(body);
    this.compare?.mark(body);
  }

  /** Marks the cards of the body that is shown. */
  #mark() {
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
    h('div.row', {}, h('span.muted', { title: body.id }, `${name} `,
      h('code', {}, shortOf(body.id))), this.links(this.genotype)));
  }

  /** Larger bodies than those of the atlas may be better. */
  #bound({ voxels: n }) {
    const { voxels_max: most } = this.about;
    return n === most ? ` (bodies of ${most + 1} voxels are not in this atlas)` : '';
  }

  #sayChanges(body) {
    const better = body.best_changes.filter((one) => isLower(one, body)).length;
    say(this.changesWords, body.best_changes.length === 0 ? 'No body is one voxel away'
      : better === 0 ? `Nothing is better: any voxel added, removed or moved makes it worse${
        this.#bound(body)}`
        : `The best ${body.best_changes.length}: ${better === body.best_changes.length
          ? 'all better' : countOf(better, 'better one')}. Click one to go there.`);
    const { genotype } = this;
    patch(this.changes, body.best_changes.map((one, i) => ({ one, i })), ({ i }) => i,
      ({ one }) => this.card(one), (card, { one }) => this.fillCard(card, one, {
        title: STEPS[one.step], label: `One voxel ${STEPS[one.step]}`, like: genotype, words: difference(one, body),
      }));
  }

  #sayWay(body, way) {
    const top = way.optimum;
    const steps = way.bodies_on_path - 1;
    const bestOfAll = this.about.best;
    say(this.wayWords, steps === 0 ? 'This body is a local optimum: adding or removing a voxel ' +
      `makes it worse${this.#bound(body)}` : `${countOf(steps, 'step')} of steepest ascent, by adding and removing ` +
      `voxels, to a local optimum${top.id === bestOfAll.id ? ': the best of all' : ''}`);
    // Each is turned like the one before, so that the eye follows the change.
    let like = this.genotype;
    const shown = way.items.map((one, i) => {
      const from = like;
      if (i) like = placeLike(from, one.id).genotype;
      return { one, like: from, title: i === 0 ? 'here' : i === steps ? 'optimum' : `step ${i}` };
    });
    /** @type {any[]} */
    const ends = [];
    if (![top.id, body.id].includes(body.best_of_size.id)) {
      ends.push({ one: body.best_of_size, title: `best of ${voxels(body.voxels)}` });
    }
    if (![top.id, body.id].includes(bestOfAll.id)) ends.push({ one: bestOfAll, title: 'best of all' });
    ends.forEach((end, i) => { end.isApart = i === 0; });
    patch(this.way, [...shown, ...ends].map((all, i) => ({ ...all, i })), ({ i }) => i,
      ({ one }) => this.card(one), (card, { one, like: from, title, isApart }) => {
        this.fillCard(card, one, { title, like: from, words: one.id === body.id ? null
          : difference(one, body) });
        card.classList.toggle('apart', Boolean(isApart));
        card.classList.toggle('step', Boolean(from) && title !== 'here');
      });
  }

  destroy() {
    this.turn++;
    document.removeEventListener('keydown', this.onKey);
    this.map.destroy();
    this.compare?.destroy();
    this.walker.close();
  }
}

const isLower = (one, other) => (one.score ?? Infinity) < (other.score ?? Infinity);

/** Returns how much better or worse a body is than the one that is shown. */
function difference(one, body) {
  if (one.score === null || body.score === null) return null;
  const by = body.score - one.score;
  return h(`span.${by > 0 ? 'gain' : 'muted'}`, {},
    by === 0 ? 'the same' : `${Math.abs(by).toFixed(4)} ${by > 0 ? 'better' : 'worse'}`);
}

/** The body in the link; without one, a body from which there is somewhere to go. */
export function startOf(parameters, about) {
  const text = parameters.get('voxels');
  if (text && isBody(text)) return text;
  const size = about.sizes[Math.min(3, about.sizes.length - 1)];
  return centered(size.best.genotype);
}
