/** The phylogeny of a campaign: every design from birth to death, in one draw call. */

import { getJson, request, withQuery } from '../lib/api.js';
import { button, fill, h, say, select } from '../lib/dom.js';
import { count, countOf, inOwnUnit, score, scoreBy, voxels } from '../lib/format.js';
import { OPERATOR_HUES, layout, nearest } from '../lib/lineage.js';
import { nameOf, shortOf } from '../lib/names.js';
import { picture } from '../lib/picture.js';
import { rollOfCampaign } from '../lib/rollouts.js';
import { decodeScene } from '../lib/scene.js';
import { onPointers } from '../stage/camera.js';
import { Program, dataTexture } from '../stage/gl.js';
import { Player } from '../stage/player.js';
import { trayButton } from './add.js';
import { PhylogenyMarks } from './phylogeny_marks.js';
import { copyButton } from './share.js';

const SHADERS = [
  `#version 300 es
precision highp float;
// One texel per design: born, end, y, y of the parent.
uniform highp sampler2D lives;
// Value for the color, or operator / 255; 1: ancestor of the living, 1/4: a lower bound.
uniform highp sampler2D looks;
uniform vec2 shift;
uniform vec2 zoom;
uniform bool byKind;
uniform vec3 low;
uniform vec3 high;
uniform vec3 kinds[8];
uniform float dim;
out vec4 color;
void main() {
  // Two lines: from the parent's life to the birth, and the life itself. One instance per design
  // would be simpler, but without a GPU a million instances take many times as long.
  ivec2 texel = ivec2((gl_VertexID >> 2) & 2047, gl_VertexID >> 13);
  vec4 life = texelFetch(lives, texel, 0);
  vec2 look = texelFetch(looks, texel, 0).xy;
  int corner = gl_VertexID & 3;
  bool joint = corner < 2;
  float x = corner == 3 ? life.y : life.x - (corner == 0 ? 1.0 : 0.0);
  float y = corner == 0 ? life.w : life.z;
  gl_Position = vec4((x + shift.x) * zoom.x, (y + shift.y) * zoom.y, 0.0, 1.0);
  vec3 hue = byKind ? kinds[min(int(look.x * 255.0 + 0.5), 7)] : mix(low, high, look.x);
  float faint = dim * (look.y > 0.1 ? 0.4 : 1.0);
  float weight = look.y > 0.5 ? (joint ? 0.6 : 0.95) : (joint ? faint * 0.3 : faint);
  color = vec4(hue, life.w < -0.5 && joint ? 0.0 : weight);
}`,
  `#version 300 es
precision highp float;
in vec4 color;
out vec4 result;
void main() { result = color; }`,
];

/** Designs per row of a texture: the shader uses the low bits as the column. */
const TEXELS = 2048;
const MANY = 100000;
const COLOR_BY = ['score', 'age', 'descendants', 'operator', 'voxels', 'footprint'];
const toRgb = (hex) => [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16) / 255);

/** A canvas with the lives of designs; it does not depend on the rest of the page. */
export class PhylogenyCanvas {
  /**
   * @param {number} n approximate number of designs: lines that are closer than pixels need no
   * smooth edges
   */
  constructor(canvas, n = 0) {
    const gl = canvas.getContext('webgl2',
      { antialias: n < MANY, alpha: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error('The phylogeny needs WebGL 2, which this browser does not support.');
    this.canvas = canvas;
    this.gl = gl;
    this.colorBy = 'score';
    this.columns = null;
    /** Waits for the graphics processor after each draw, so that the drawing time can be
     * measured. */
    this.measure = false;
    this.program = new Program(gl, SHADERS);
    this.textures = [];
    this.times = {};
    /** Best and worst score on the color scale. */
    this.scores = [0, 2];
    /** Smallest and largest value of another column that determines the colors. */
    this.ends = [0, 1];
    this.drawn = () => {};
    this.reset();
  }

  reset() {
    this.center = [0.5, 0.51];
    this.span = [1.01, 1.06];
  }

  /** @param {import('../lib/lineage.js').Columns} columns */
  set(columns) {
    const started = performance.now();
    this.columns = columns;
    this.layout = layout(columns);
    this.times.layoutMs = performance.now() - started;
    this.last = 1;
    const { born, died } = columns;
    const { alive } = this.layout;
    for (let i = 0; i < born.length; i++) {
      if (born[i] > this.last) this.last = born[i];
      if (died[i] !== alive && died[i] > this.last) this.last = died[i];
    }
    this.#fillTextures();
    this.times.readyMs = performance.now() - started;
  }

  setColor(by) {
    this.colorBy = by;
    if (this.columns) this.#fillTextures();
  }

  #fillTextures() {
    const { columns, layout: { y, parentRow, lineage, order, size, alive }, gl } = this;
    const { born, died, operator, score: scores, lower_bound: isBound } = columns;
    const n = order.length;
    const rows = Math.max(1, Math.ceil(n / TEXELS));
    const lives = new Float32Array(rows * TEXELS * 4);
    const looks = new Uint8Array(rows * TEXELS * 2);
    // Scores are ranked on a logarithmic scale, because they are dense near the best. The scale
    // ignores lower bounds.
    let [best, worst] = [Infinity, 0];
    for (let i = 0; i < n; i++) {
      if (isBound[i]) continue;
      if (scores[i] > 0 && scores[i] < best) best = scores[i];
      if (scores[i] > worst && scores[i] <= 2) worst = scores[i];
    }
    const span = Math.log(worst / best) || 1;
    let rank = (value) => (value > 0
      ? 1 - Math.min(1, Math.max(0, Math.log(value / best) / span)) : 0);
    if (columns.own_score) { // any numbers, on a linear scale
      [best, worst] = [Infinity, -Infinity];
      for (const value of scores) [best, worst] = [Math.min(best, value), Math.max(worst, value)];
      rank = (value) => (worst > best ? (worst - value) / (worst - best) : 1);
    }
    this.scores = [best, worst];
    // Any other column, on a linear scale from its smallest to its largest value.
    const measure = columns[this.colorBy] && !['score', 'operator'].includes(this.colorBy)
      ? columns[this.colorBy] : null;
    let [least, most] = [Infinity, -Infinity];
    for (let i = 0; measure && i < n; i++) {
      if (measure[i] < least) least = measure[i];
      if (measure[i] > most) most = measure[i];
    }
    this.ends = [least, most];
    for (let k = 0, at = 0; k < n; k++, at += 4) {
      const i = order[k];
      const end = died[i] === alive ? this.last + 0.6 : Math.max(died[i], born[i] + 0.4);
      lives[at] = born[i];
      lives[at + 1] = end;
      lives[at + 2] = y[i];
      lives[at + 3] = parentRow[i] < 0 ? -1 : y[parentRow[i]];
      let value = 0;
      if (this.colorBy === 'operator') value = operator[i] / 255;
      else if (this.colorBy === 'descendants') value = Math.log(size[i]) / Math.log(Math.max(2, n));
      else if (this.colorBy === 'age') value = Math.min(1,
        (end - born[i]) / Math.max(2, this.last * 0.5));
      else if (measure) value = most > least && measure[i] >= least
        ? (measure[i] - least) / (most - least) : 0;
      else value = rank(scores[i]);
      looks[2 * k] = Math.round(value * 255);
      looks[2 * k + 1] = lineage[i] ? 255 : isBound[i] && this.colorBy === 'score' ? 64 : 0;
    }
    this.textures.forEach((texture) => gl.deleteTexture(texture));
    this.textures = [dataTexture(gl, gl.RGBA32F, TEXELS, rows, gl.RGBA, gl.FLOAT, lives),
      dataTexture(gl, gl.RG8, TEXELS, rows, gl.RG, gl.UNSIGNED_BYTE, looks)];
  }

  /** Returns generation and y of a point on the canvas. */
  at(px, py) {
    const { clientWidth: w, clientHeight: hgt } = this.canvas;
    return [
      (this.center[0] + (px / w - 0.5) * this.span[0]) * (this.last + 1) - 0.5,
      this.center[1] + (py / hgt - 0.5) * this.span[1],
    ];
  }

  /** Returns the point on the canvas for a generation and a y. */
  placeOf(generation, y) {
    const { clientWidth: w, clientHeight: hgt } = this.canvas;
    return [
      (((generation + 0.5) / (this.last + 1) - this.center[0]) / this.span[0] + 0.5) * w,
      ((y - this.center[1]) / this.span[1] + 0.5) * hgt,
    ];
  }

  /** Moves the view to a row if it lies outside. */
  reveal(row) {
    const { clientWidth: w, clientHeight: hgt } = this.canvas;
    const [born, y] = [this.columns.born[row], this.layout.y[row]];
    const [px, py] = this.placeOf(born, y);
    if (px > 0 && px < w && py > 0 && py < hgt) return;
    this.center = [(born + 0.5) / (this.last + 1), y];
    this.draw();
  }

  /** Returns the row at a point, or -1 if none is near. */
  pick(px, py) {
    const [x, y] = this.at(px, py);
    const { clientWidth: w, clientHeight: hgt } = this.canvas;
    return nearest(this.columns, this.layout, x, y, w / this.span[0] / (this.last + 1),
      hgt / this.span[1], 12);
  }

  zoom(factor, px, py) {
    const { clientWidth: w, clientHeight: hgt } = this.canvas;
    const [fx, fy] = [px / w - 0.5, py / hgt - 0.5];
    for (const [axis, f] of [[0, fx], [1, fy]]) {
      const span = Math.min(1.1, Math.max(axis ? 2e-5 : 0.02, this.span[axis] * factor));
      this.center[axis] += f * (this.span[axis] - span);
      this.span[axis] = span;
    }
  }

  draw() {
    if (!this.columns) return;
    const started = performance.now();
    const { gl, canvas } = this;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight]
      .map((v) => Math.max(1, Math.round(v * devicePixelRatio)));
    if (canvas.width !== width || canvas.height !== height) {
      Object.assign(canvas, { width, height });
    }
    const style = getComputedStyle(canvas);
    const color = (name) => toRgb(style.getPropertyValue(name).trim().padEnd(7, '0'));
    gl.viewport(0, 0, width, height);
    const [r, g, b] = color('--panel');
    gl.clearColor(r, g, b, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    const generations = this.last + 1;
    this.program.use().set({
      shift: [0.5 - this.center[0] * generations, -this.center[1]],
      zoom: [2 / (this.span[0] * generations), -2 / this.span[1]],
      byKind: this.colorBy === 'operator', low: color('--blue'), high: color('--orange'),
      lives: this.textures[0], looks: this.textures[1],
      dim: this.columns.number.length > MANY ? 0.35 : 0.6,
    });
    const kinds = this.program.places.get('kinds[0]');
    if (kinds) gl.uniform3fv(kinds.at, OPERATOR_HUES.flatMap(color));
    gl.drawArrays(gl.LINES, 0, 4 * this.layout.order.length);
    if (this.measure) gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    this.times.drawMs = performance.now() - started;
    this.drawn();
  }

  destroy() {
    this.gl.getExtension('WEBGL_lose_context')?.loseContext();
  }
}

/** Loads a phylogeny as columns: the ancestors of the living, or all designs. (bench/dashboard.py
 * uses it, too.) */
export async function loadColumns(id, keep, signal) {
  const path = withQuery(`v1/campaigns/${id}/phylogeny`, { format: 'columns', keep });
  const response = await request(path, { signal });
  const { header, array } = decodeScene(await response.arrayBuffer());
  const columns = Object.fromEntries(Object.entries(header.columns)
    .map(([name, where]) => [name, array(where)]));
  // If all designs are loaded, the position is the number.
  columns.operators = header.operators;
  columns.own_score = header.own_score ?? null;
  columns.lower_bound = Uint8Array.from(columns.score,
    (value) => (value < 0 && !columns.own_score ? 1 : 0));
  if (!columns.own_score) columns.score = columns.score.map(Math.abs);
  columns.number ??= new Uint32Array(columns.born.length).map((_, i) => i);
  return columns;
}

export async function mount(main, id, parameters, app) {
  const stop = new AbortController();
  const campaign = await getJson(`v1/campaigns/${encodeURIComponent(id)}`);
  const canvas = h('canvas.lives', {
    tabindex: 0, role: 'img', 'aria-label': 'Phylogeny: loading',
  });
  const view = new PhylogenyCanvas(canvas, campaign.progress.designs);
  const marks = new PhylogenyMarks(view);
  const note = h('p.muted', { 'aria-live': 'polite' }, 'Loading the ancestors of the living…');
  const player = new Player(app, { compact: true, height: 360 });
  const title = campaign.label ?? `Campaign ${id}`;
  app.setTitle(`Phylogeny of ${title}`);
  const missing = h('p.error', { role: 'status' });
  const fresh = button('', () => showNew(), { hidden: true });
  let shownTo = campaign.progress.generation ?? -1;
  let newest = shownTo;
  const detail = h('div.stack', { 'aria-live': 'polite' });
  const ancestry = h('div.grid.small');
  const own = campaign.own_score ?? null; // not the mean of the losses
  const colors = [...COLOR_BY.map((by) => (own && by === 'score' ? [by, own.name] : by)),
    ...(campaign.study?.measures ?? campaign.settings.measures ?? [])
      .map((name) => [`measures.${name}`, name])];
  const search = h('input',
    { type: 'search', placeholder: 'number or id', 'aria-label': 'Find a design' });
  main.replaceChildren(
    h('div.title', {}, h('h1', {}, 'Phylogeny'), h('a', { href: `#/campaigns/${id}` }, title),
      note, fresh,
      missing,
      h('div.actions', {}, copyButton(() => ({
        path: `v1/campaigns/${id}/phylogeny?format=csv`, output: `phylogeny-${id}.csv`,
        morphoctl: `campaign export ${id} --phylogeny phylogeny-${id}.csv`,
        python: `print(m.get_campaign(${id}).phylogeny().frame())`,
      })), select('Color', colors, 'score', (by) => {
        view.setColor(by);
        view.draw();
        marks.showColors();
      }),
        h('form.row',
          { onsubmit: (event) => { event.preventDefault(); find(search.value.trim()); } }, search,
          h('button', { type: 'submit' }, 'Find')),
        button('Fit', () => { view.reset(); view.draw(); }))),
    h('section.panel.flush', {}, h('div.overlaid', {}, canvas, marks.canvas), marks.legend),
    h('div.grid', {}, h('section.panel.stack', {}, detail, h('h3', {}, 'Ancestry'), ancestry),
      h('section.panel.flush.beside', { 'aria-label': 'Stage' }, player.element)));
  fill(detail, h('p.empty', {},
    'Select a design: its robot walks, and its line of descent is shown. ' +
    'Drag to move, wheel or pinch to zoom. Arrow keys go from design to design.'));
  const redraw = () => view.draw();
  app.themeListeners.add(redraw);
  const observer = new ResizeObserver(redraw);
  observer.observe(canvas);
  let selected = -1;

  function show(columns, text) {
    view.set(columns);
    marks.selected = -1;
    view.draw();
    marks.showColors();
    note.textContent = text;
    canvas.setAttribute('aria-label', `Phylogeny of ${text}`);
  }

  async function loadAll() {
    const all = await loadColumns(id, 'all', stop.signal);
    show(all, `${countOf(all.number.length, 'design')}, ${count(view.layout.nLineage)} of them ` +
      'ancestors of the living');
    shownTo = all.born.at(-1) ?? -1;
    offerNew();
  }

  /** Offers new generations: they are drawn on request, because the whole picture changes. */
  function offerNew() {
    fresh.hidden = newest <= shownTo;
    say(fresh, `Show ${countOf(newest - shownTo, 'new generation')}`);
  }

  async function showNew() {
    const number = selected < 0 ? null : view.columns.number[selected];
    try {
      await loadAll();
      if (number !== null) selected = marks.selected = view.columns.number.indexOf(number);
      marks.draw();
    } catch (error) {
      if (!stop.signal.aborted) note.textContent = error.message;
    }
  }

  async function load() {
    const lineages = await loadColumns(id, 'lineages', stop.signal);
    show(lineages,
      `${countOf(lineages.number.length, 'ancestor')} of the living; loading the rest…`);
    await loadAll();
  }

  async function choose(row) {
    if (row < 0) return;
    selected = marks.selected = row;
    marks.draw();
    const number = view.columns.number[row];
    app.keep({ design: number });
    const design = await getJson(`v1/campaigns/${id}/designs/${number}?limit=1`,
      { signal: stop.signal });
    fill(detail,
      h('div.row', {}, h('div.card', {}, picture(design.genotype, `Design ${number}`)),
      h('div.stack', {},
      h('h2', { title: design.robot }, `#${number} ${nameOf(design.robot)}`),
      h('code', {}, shortOf(design.robot)),
      h('div', {}, `${scoreBy(own, design)}, ${voxels(design.voxels)}, ${design.operator}`),
      h('div.muted', {}, `born in generation ${design.born}, ` +
        `${design.died === null ? 'alive' : `died in ${design.died}`}`),
      design.lower_bound
        ? h('div.muted', {},
        'A lower bound: it could not survive, so the rest of its score was not computed.') : null,
      h('a', { href: `#/designs/${design.robot}` }, 'all its scores'),
      h('a', { href: `#/lab?voxels=${design.genotype}` }, 'edit'),
      h('div', {}, trayButton(() =>
        [{ genotype: design.genotype, note: scoreBy(own, design) }])))));
    const [robots, ancestors] = await Promise.all([rollOfCampaign(campaign, [design], stop.signal),
      getJson(`v1/campaigns/${id}/designs/${number}/ancestors?limit=24`, { signal: stop.signal })]);
    if (selected !== row) return;
    player.setRobots(robots);
    fill(ancestry,
      ancestors.items.map((one) => h('button.card',
      { type: 'button', onclick: () => find(String(one.number)) },
      picture(one.genotype, `Ancestor ${one.number}`),
      h('strong.number', {}, own ? inOwnUnit(own, one.score) : score(one.score)),
      h('span', { title: one.robot }, nameOf(one.robot)),
      h('span.muted', {}, `#${one.number}, ${shortOf(one.robot)}`))),
    ancestors.items.length ? null
      : h('p.empty', {}, 'It has no ancestors: it was in the initial population.'));
  }

  const chosen = (row) => choose(row)
    .catch((error) => { if (!stop.signal.aborted) note.textContent = error.message; });

  async function find(text) {
    let number = Number(text);
    if (/^[0-9a-f]{36}(@[0-7])?$/i.test(text)) {
      const design = await getJson(`v1/designs/${text.toLowerCase()}`).catch(() => null);
      number = design?.campaigns.find((one) => one.campaign === id)?.number ?? NaN;
    }
    const row = view.columns?.number.indexOf(number) ?? -1;
    say(missing, row < 0 ? `There is no design ${text} in this campaign.` : '');
    if (row < 0) return;
    view.reveal(row);
    chosen(row);
    marks.pulse();
  }

  drive(canvas, view, chosen);
  canvas.addEventListener('keydown', (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1, ArrowDown: 10, ArrowUp: -10 }[event.key];
    if (!step || !view.columns) return;
    event.preventDefault();
    chosen(Math.min(view.columns.number.length - 1, Math.max(0, selected + step)));
  });
  load().then(() => {
    const wanted = parameters.get('design');
    if (wanted) find(wanted);
  }).catch((error) => { if (!stop.signal.aborted) note.textContent = error.message; });
  return {
    update({ type, job, data }) {
      if (type === 'campaign.generation' && job === id) {
        newest = data.generation;
        offerNew();
      } else if (type === 'reset') {
        getJson(`v1/campaigns/${encodeURIComponent(id)}`, { signal: stop.signal }).then((now) => {
          newest = now.progress.generation ?? -1;
          offerNew();
        }, () => {});
      }
    },
    unmount() {
      stop.abort();
      app.themeListeners.delete(redraw);
      observer.disconnect();
      view.destroy();
      player.destroy();
    },
  };
}

/** Handles input: dragging moves, wheel and pinch zoom, and a click selects. */
function drive(canvas, view, choose) {
  const redraw = () => requestAnimationFrame(() => view.draw());
  onPointers(canvas, {
    drag(dx, dy) {
      view.center[0] -= (dx / canvas.clientWidth) * view.span[0];
      view.center[1] -= (dy / canvas.clientHeight) * view.span[1];
      redraw();
    },
    pinch(factor, x, y) {
      view.zoom(factor, x, y);
      redraw();
    },
    click(x, y) {
      if (view.columns) choose(view.pick(x, y));
    },
  });
  canvas.addEventListener('wheel', (event) => {
    event.preventDefault();
    view.zoom(Math.exp(event.deltaY * 0.0015), event.offsetX, event.offsetY);
    redraw();
  }, { passive: false });
}
