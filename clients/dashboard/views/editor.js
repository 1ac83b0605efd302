/** The editor: a body, voxel by voxel, that walks and is scored after every click. */

import { LinkError, getJson, patient, post, storing } from '../lib/api.js';
import {
  WORKSPACE, bodyOf, genotypeOf, genotypeOfId, hasVoxel, robotOf,
} from '../lib/body.js';
import { announce, button, fill, h, toggle } from '../lib/dom.js';
import { count, score, voxels } from '../lib/format.js';
import { nameOf, shortOf } from '../lib/names.js';
import { environmentSet, roll, scoresOf } from '../lib/rollouts.js';
import { tray } from '../lib/tray.js';
import { flip, isConnected, mirror, readBody, shift } from '../lib/variation.js';
import { Player } from '../stage/player.js';
import { addToTray } from './add.js';
import { Driving } from './drive.js';
import { announced, copyButton, formDialog } from './share.js';

const FIRST = [
  [1, 1, 0], [2, 1, 0], [3, 1, 0], [4, 1, 0], [1, 4, 0], [2, 4, 0], [3, 4, 0], [4, 4, 0],
  [2, 2, 0], [3, 2, 0], [2, 3, 0], [3, 3, 0], [2, 2, 1], [3, 3, 1], [2, 3, 1], [3, 2, 1],
];

/** Storage key of the undo steps and the body, while the tab is open. */
const STATE_KEY = 'morphod-editor';
const PAST_MAX = 100;
/** The first random body of at least this size is used: smaller ones barely walk. */
const RANDOM_VOXELS_MIN = 6;
const isBody = (text) => /^[01]{144}$/.test(text) && text.includes('1');

/**
 * The state of the editor when it was left.
 * @returns {{past: string[], body: ?string}}
 */
function stateBefore() {
  const text = storing(() => sessionStorage.getItem(STATE_KEY));
  return text ? JSON.parse(text) : { past: [], body: null };
}

export async function mount(main, path, parameters, app) {
  const player = new Player(app, { compact: true });
  const { past, body: last } = stateBefore();
  let genotype;
  let environments;
  try {
    [genotype, environments] = await Promise.all([startBody(parameters, last),
      environmentSet('paper-test')]);
  } catch (error) {
    player.destroy();
    throw error;
  }
  let mirrored = false;
  let isClosed = false;
  let stop = new AbortController();

  const layers = h('div.layers', { role: 'group', 'aria-label': 'Body, layer by layer' });
  const result = h('p.result', { 'aria-live': 'polite' });
  if (player.stage) {
    new Driving(player, () => ({ environment: environments[0], number: 0, set: 'paper-test',
      name: 'morphod-drawn' }));
  }

  /** Saves the undo steps and the body for a return to the editor. */
  function store() {
    past.splice(0, past.length - PAST_MAX);
    const text = JSON.stringify({ past, body: genotype });
    storing(() => sessionStorage.setItem(STATE_KEY, text));
  }

  function change(next, { undo = false } = {}) {
    if (!next || !next.includes('1')) {
      announce('A body needs a voxel.');
      return;
    }
    if (!undo) past.push(genotype);
    genotype = next;
    app.keep({ voxels: genotype });
    store();
    drawLayers();
    walk();
  }

  /**
   * Shows a body that the service makes as it does for campaigns, unless the user changes the body
   * first.
   */
  const make = (operator, request, whyNone = '') => announced(async () => {
    const before = genotype;
    const { items } = await patient(() => post(`v1/bodies/${operator}`, request));
    if (isClosed || genotype !== before) return;
    const made = items.find(({ voxels }) => voxels >= RANDOM_VOXELS_MIN) ?? items[0];
    if (made.genotype) change(made.genotype);
    else announce(whyNone);
  });
  const newSeed = () => Math.floor(Math.random() * Number.MAX_SAFE_INTEGER);
  const grow = () => make('random', { seed: newSeed(), count: 32 });
  const mutate = () => make('mutate', {
    designs: [{ voxels: genotype }], seed: newSeed(), repair: 'largest',
  });

  function cross() {
    const other = tray.kept[Math.floor(Math.random() * tray.kept.length)];
    return make('cross', {
      designs: [genotype, other.genotype].map((voxels) => ({ voxels })), pairs: [[0, 1]],
      repair: 'largest',
    }, 'The two bodies are equal, so no voxel is left.');
  }

  function undo() {
    if (past.length) change(past.pop(), { undo: true });
    else announce('There is nothing to undo.');
  }

  function click(cell) {
    let next = flip(genotype, cell);
    if (mirrored) {
      const image = [WORKSPACE[0] - 1 - cell[0], cell[1], cell[2]];
      if (hasVoxel(next, ...image) !== hasVoxel(next, ...cell)) next = flip(next, image);
    }
    change(next);
  }

  function drawLayers() {
    const focused = /** @type {HTMLElement} */ (document.activeElement)?.dataset.cell;
    fill(layers, Array.from({ length: WORKSPACE[2] }, (_, z) => layer(z)));
    if (focused) layers.querySelector(`[data-cell="${focused}"]`)?.focus();
  }

  function layer(z) {
    const rows = Array.from({ length: WORKSPACE[1] }, (_, up) => {
      const y = WORKSPACE[1] - 1 - up;
      return h('div', { role: 'row' }, Array.from({ length: WORKSPACE[0] }, (_, x) => {
        const on = hasVoxel(genotype, x, y, z);
        const hint = !on && hasVoxel(genotype, x, y, z - 1) ? '.hint' : '';
        return h(`button${hint}`, {
          type: 'button', role: 'gridcell', 'aria-selected': String(on),
          'data-cell': `${x},${y},${z}`,
          tabindex: x === 2 && y === 2 && z === 0 ? 0 : -1,
          'aria-label': `x ${x}, y ${y}, layer ${z}: ${on ? 'voxel' : 'empty'}`,
          onclick: () => click([x, y, z]),
        });
      }));
    });
    return h('fieldset.layer', {},
      h('legend', {}, z === 0 ? 'layer 0, on the ground' : `layer ${z}`),
      h('div.cells', { role: 'grid', 'aria-label': `Layer ${z}` }, rows));
  }

  layers.addEventListener('keydown', (event) => {
    if (event.key === 'z' && (event.ctrlKey || event.metaKey)) {
      event.preventDefault();
      undo();
      return;
    }
    const cell = event.target.dataset?.cell?.split(',').map(Number);
    if (!cell) return;
    const step = {
      ArrowLeft: [-1, 0, 0], ArrowRight: [1, 0, 0], ArrowUp: [0, 1, 0], ArrowDown: [0, -1, 0],
      PageUp: [0, 0, 1], PageDown: [0, 0, -1],
    }[event.key];
    if (!step) return;
    event.preventDefault();
    const to = cell.map((v, axis) => Math.min(WORKSPACE[axis] - 1, Math.max(0, v + step[axis])));
    layers.querySelector(`[data-cell="${to}"]`).focus();
  });

  async function walk() {
    stop.abort();
    stop = new AbortController();
    const { signal } = stop;
    const started = performance.now();
    const body = bodyOf(genotype);
    const size = `${voxels(body.nVoxels)}, ${count(body.nSprings)} springs`;
    if (!isConnected(genotype)) {
      result.textContent = `${size}; not connected: every voxel must share a face with another`;
      return;
    }
    const design = { voxels: genotype };
    result.textContent = `${size}; scoring…`;
    player.hold(true);
    try {
      const [robot] = await roll([design], environments[0], { signal });
      if (signal.aborted) return;
      robot.label = nameOf(robot.id);
      player.setRobots([robot]);
      // It walks first, because ten rollouts would delay its first frame.
      await new Promise(requestAnimationFrame);
      if (signal.aborted) return;
      const shownMs = Math.round(performance.now() - started);
      const { mean } = await scoresOf(design, 'paper-test', { signal });
      if (signal.aborted) return;
      const scoredMs = Math.round(performance.now() - started);
      fill(result, h('strong', {}, `score ${score(mean)}`), ` over ten environments, ${size}; `,
        h('span', { title: robot.robot }, nameOf(robot.id)), ' ',
        h('code', {}, shortOf(robot.robot)), ' ',
        h('span.muted', {}, `walking after ${shownMs} ms, scored after ${scoredMs} ms`));
      performance.measure('morphod-click-to-motion', { start: started, duration: shownMs });
    } catch (error) {
      if (signal.aborted) return;
      player.hold(false);
      result.textContent = `${size}; ${error.message}`;
    }
  }

  function keep() {
    if (!isConnected(genotype)) {
      announce('Every voxel must share a face with another before the body can be kept.');
      return;
    }
    addToTray([{ genotype, robot: robotOf(genotype),
      note: /^score \S+/.exec(result.textContent)?.[0] }]);
  }

  /** A body of the tray is needed to cross with. */
  const offer = () => { crossing.disabled = tray.kept.length === 0; };

  function importBody() {
    const text = h('textarea', { rows: 6, 'aria-label': 'Body' });
    formDialog('Import a body', 'Import', () => {
      const body = readBody(text.value);
      change(body.genotype ?? genotypeOfId(body.id));
      if (body.lost) announce(body.lost);
    }, h('p.wide', {}, 'A robot (ID@K), an id, 144 digits of voxels, a list of cells as ' +
      '[[x,y,z], …], or an array of EvoGym (it becomes two voxels deep).'),
      h('div.stack.wide', {}, text));
  }

  const move = (name, step) => button(name, () => {
    const next = shift(genotype, step);
    if (next) change(next);
    else announce('The body is at the edge of the workspace.');
  }, { class: 'icon', 'aria-label': `Shift: ${name}`, title: `Shift: ${name}` });
  const crossing = button('Cross', cross, { title: 'Cross with a body of the tray' });

  main.replaceChildren(
    h('div.title', {}, h('h1', {}, 'Editor'),
      h('span.muted.keys', {}, 'layers from the ground up; arrow keys move, page keys change ' +
        'the layer, space sets a voxel, Ctrl and Z undo'),
      h('div.actions', {}, button('Import', importBody), copyButton(() => ({
        path: 'v1/evaluations', body: { designs: [{ voxels: genotype }] },
        headers: ['Prefer: wait=30'],
        morphoctl: `eval ${genotype}`, python: `print(m.evaluate(["${genotype}"]).frame())`,
      })))),
    h('div.grid.editor', {}, h('section.panel.stack', {}, layers,
      h('div.row', {}, toggle('Mirror x', false, (on) => {
        mirrored = on;
        if (on) change(mirror(genotype, 0));
      }), button('Random', grow), button('Mutate', mutate), crossing,
      button('Undo', undo)),
      h('div.row', {},
        h('span.pad', { role: 'group', 'aria-label': 'Shift' }, h('span.muted', {}, 'Shift'),
          move('←', [-1, 0, 0]), move('→', [1, 0, 0]), move('↑', [0, 1, 0]),
          move('↓', [0, -1, 0]), move('up', [0, 0, 1]), move('down', [0, 0, -1])),
        button('Keep', keep, { title: 'Add to the tray' })), result),
    h('section.panel.flush', { 'aria-label': 'Stage' }, player.element)));
  drawLayers();
  offer();
  tray.listeners.add(offer);
  walk();
  return {
    pick: (body) => change(body),
    update({ type }) {
      if (type === 'reset') walk(); // the service was unavailable, so there is no score
    },
    unmount() {
      isClosed = true;
      tray.listeners.delete(offer);
      stop.abort();
      player.destroy();
    },
  };
}

/** The body in the link, or the last one here, or a small walker. */
async function startBody(parameters, last) {
  const voxels = parameters.get('voxels');
  if (voxels !== null) {
    if (isBody(voxels)) return voxels;
    throw new LinkError('voxels must be 144 digits, each 0 or 1, with at least one 1.');
  }
  const id = parameters.get('design');
  if (id) {
    const path = `v1/designs/${encodeURIComponent(id)}`;
    if (id.includes('@')) return (await getJson(`${path}/body`)).genotype;
    const design = await getJson(path);
    return design.orientations[0]?.genotype ?? design.genotype;
  }
  return last ?? genotypeOf(FIRST);
}
