/** The Lab: build a body on the left; it walks on the right, and is scored after every change. */

import { LinkError, getJson, patient, post } from '../lib/api.js';
import { WORKSPACE, genotypeOf, genotypeOfId, robotOf } from '../lib/body.js';
import { pythonOf } from '../lib/commands.js';
import { announce, button, h, say, toggle } from '../lib/dom.js';
import { countOf } from '../lib/format.js';
import { History, isBody } from '../lib/history.js';
import { tray } from '../lib/tray.js';
import { looseOf, mirror, readBody, shift, withVoxel } from '../lib/variation.js';
import { addToTray } from './add.js';
import { Cells } from './lab_cells.js';
import { Shape } from './lab_shape.js';
import { Walk } from './lab_walk.js';
import { announced, copyButton, formDialog } from './share.js';

const FIRST = [
  [1, 1, 0], [2, 1, 0], [3, 1, 0], [4, 1, 0], [1, 4, 0], [2, 4, 0], [3, 4, 0], [4, 4, 0],
  [2, 2, 0], [3, 2, 0], [2, 3, 0], [3, 3, 0], [2, 2, 1], [3, 3, 1], [2, 3, 1], [3, 2, 1],
];
/** The first random body of at least this size is used: smaller ones barely walk. */
const RANDOM_VOXELS_MIN = 6;
const NONE_LEFT = 'A body needs at least one voxel.';

export async function mount(main, path, parameters, app) {
  const walk = new Walk(app);
  const steps = new History();
  try {
    const [first] = await Promise.all([startBody(parameters, steps.body), walk.prepare()]);
    steps.push(first);
  } catch (error) {
    walk.close();
    throw error;
  }
  /** What is shown; during a stroke it is ahead of the history. */
  let genotype = steps.body;
  let mirrored = false;
  let isClosed = false;

  const edit = { paint, commit };
  const cells = new Cells(edit);
  const shape = new Shape(edit);
  const looseText = h('span');
  const looseRow = h('div.row.warning', { role: 'status' }, looseText,
    button('Remove loose voxels', () =>
      change(looseOf(genotype).reduce((body, cell) => withVoxel(body, cell, false), genotype))));

  /** Draws the body as it is; returns how many voxels are loose. */
  function draw() {
    const loose = looseOf(genotype);
    for (const drawing of [cells, shape]) drawing.draw(genotype, new Set(loose.map(String)));
    say(looseText, loose.length ? `${countOf(loose.length, 'loose voxel')}: connect or remove ` +
      `${loose.length === 1 ? 'it' : 'them'}` : '');
    looseRow.hidden = !loose.length;
    for (const [one, list] of [[undo, steps.past], [redo, steps.future]]) {
      one.setAttribute('aria-disabled', String(!list.length));
    }
    return loose.length;
  }

  /** Shows the current body of the history. */
  function show() {
    genotype = steps.body;
    app.keep({ voxels: genotype });
    walk.show(genotype, draw());
  }

  function paint(cell, on) {
    const [x, y, z] = cell;
    let next = withVoxel(genotype, cell, on);
    if (mirrored) next = withVoxel(next, [WORKSPACE[0] - 1 - x, y, z], on);
    if (!next.includes('1')) {
      announce(NONE_LEFT);
    } else if (next !== genotype) {
      genotype = next;
      draw();
    }
  }

  function commit() {
    if (genotype === steps.body) return;
    steps.push(genotype);
    show();
  }

  /** Replaces the body in one step. */
  function change(next) {
    if (!next?.includes('1')) {
      announce(NONE_LEFT);
      return;
    }
    commit();
    genotype = next;
    commit();
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
    }, 'The two bodies are identical, so crossing them leaves no voxels.');
  }

  function go(way) {
    commit();
    if (steps[way]()) show();
    else announce(`There is nothing to ${way}.`);
  }
  const undo = button('Undo', () => go('undo'), { title: 'Ctrl+Z' });
  const redo = button('Redo', () => go('redo'), { title: 'Ctrl+Shift+Z or Ctrl+Y' });

  function onKey(event) {
    const { key, target, ctrlKey, metaKey, shiftKey, altKey } = event;
    const way = { z: shiftKey ? 'redo' : 'undo', y: 'redo' }[key.toLowerCase()];
    if (!way || !(ctrlKey || metaKey) || altKey) return;
    if (target.closest?.('input:not([type=range]), textarea, dialog')) return; // there, the keys
                                                                               // undo text
    event.preventDefault();
    go(way);
  }

  function keep() {
    if (looseOf(genotype).length) {
      announce('The body must be in one piece before it can be kept.');
      return;
    }
    addToTray([{ genotype, robot: robotOf(genotype), note: walk.score }]);
  }

  /** Offers crossing if the tray has a body to cross with. */
  const offer = () => { crossing.disabled = tray.kept.length === 0; };

  function importBody() {
    const text = h('textarea', { rows: 6, 'aria-label': 'Body' });
    formDialog('Import a body', 'Import', () => {
      const body = readBody(text.value);
      change(body.genotype ?? genotypeOfId(body.id));
      if (body.lost) announce(body.lost);
    }, h('p.wide', {}, 'A robot (ID@K), an id, 144 voxel digits, a list of cells as ' +
      '[[x,y,z], …], or an EvoGym array (it becomes two voxels deep).'),
      h('div.stack.wide', {}, text));
  }

  /** Returns the same evaluation as commands for a shell or a program. */
  function commands() {
    const { set, environments } = app.task;
    const words = set === 'paper-test' ? '' : ` --environments ${set ?? '-'}`;
    return {
      path: 'v1/evaluations', headers: ['Prefer: wait=30'],
      body: { designs: [{ voxels: genotype }],
        ...(words && { environments: set ?? environments }) },
      morphoctl: `eval ${genotype}${words}`, input: set ? '' : JSON.stringify(environments),
      python: `print(m.evaluate(["${genotype}"]${words && `, ${pythonOf(set ?? environments)}`})` +
        '.frame())',
    };
  }

  const move = (name, step) => button(name, () => {
    const next = shift(genotype, step);
    if (next) change(next);
    else announce('The body is at the edge of the workspace.');
  }, { class: 'icon', 'aria-label': `Shift: ${name}`, title: `Shift: ${name}` });
  const crossing = button('Cross', cross, { title: 'Cross with a body from the tray' });

  main.replaceChildren(
    h('div.title', {}, h('h1', {}, 'Lab'),
      h('span.muted.keys', {}, 'build on the left, watch on the right: click a face to add a ' +
        'voxel, Shift+click to remove it, or drag over the layers to paint'),
      h('div.actions', {}, button('Import', importBody), copyButton(commands))),
    h('div.grid.lab', {}, h('section.panel.stack', { 'aria-label': 'Build' },
      h('div.row', {}, undo, redo, toggle('Mirror x', false, (on) => {
        mirrored = on;
        if (on) change(mirror(genotype, 0));
      }), button('Random', grow), button('Mutate', mutate), crossing,
      button('Keep', keep, { title: 'Add to the tray' })),
      shape.element, cells.element,
      h('span.pad', { role: 'group', 'aria-label': 'Shift' }, h('span.muted', {}, 'Shift'),
        move('←', [-1, 0, 0]), move('→', [1, 0, 0]), move('↑', [0, 1, 0]),
        move('↓', [0, -1, 0]), move('up', [0, 0, 1]), move('down', [0, 0, -1])),
      looseRow), // last, so that the cells do not move under the pointer when this row appears
    h('section.panel.flush.watch', { 'aria-label': 'Stage' }, walk.player.element, walk.result)));
  offer();
  tray.listeners.add(offer);
  document.addEventListener('keydown', onKey);
  walk.show(genotype, draw());
  const again = () => announced(async () => {
    await walk.prepare();
    if (!isClosed) walk.show(genotype, looseOf(genotype).length);
  });
  return {
    pick: change,
    turnTask: again,
    update({ type }) {
      if (type === 'reset') again(); // the service was unavailable, so there is no score
    },
    unmount() {
      isClosed = true;
      tray.listeners.delete(offer);
      document.removeEventListener('keydown', onKey);
      walk.close();
    },
  };
}

/** Returns the body in the link, or the last one here, or a small walker. */
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
