/** The tray as a bar at the foot of every page, and what can be done with the robots in it. */

import { WORKSPACE, cellsOf, hasVoxel } from '../lib/body.js';
import { button, h, patch, say } from '../lib/dom.js';
import { countOf, voxels } from '../lib/format.js';
import { nameOf, shortOf } from '../lib/names.js';
import { picture } from '../lib/picture.js';
import { may } from '../lib/rights.js';
import { storing } from '../lib/api.js';
import { tray } from '../lib/tray.js';
import { announced, confirmDialog, saveText, showDialog } from './share.js';

const OPEN_KEY = 'morphod-tray-open';
/** On narrower pages the tray starts as one line. */
const WIDE = '(min-width: 641px)';
/** EvoGym's material of an actuator that acts horizontally. */
const ACTUATOR = 3;

const robots = () => tray.kept.map((one) => one.robot);

/**
 * Returns the bar. It is hidden while the tray is empty.
 * @param {import('../app.js').app} app
 * @param {function(): {pick?: function(string): void}|null} viewOf the current view, which may use
 *   a robot itself; otherwise a click on a robot opens it in the Lab
 */
export function trayBar(app, viewOf) {
  let isOpen = storing(() => sessionStorage.getItem(OPEN_KEY)) ??
    String(matchMedia(WIDE).matches);
  const title = button('', () => setOpen(isOpen !== 'true'), { class: 'fold' });
  const chips = h('ul.chips', { 'aria-label': 'Robots in the tray' });
  const watch = button('Watch', () => app.go('stage', staged('skin,trails,side')),
    { title: 'Side by side on the stage' });
  const race = button('Race', () => app.go('stage', staged('skin,trails')),
    { title: 'All on one terrain' });
  const compare = button('Compare', () => app.go('compare', { designs: robots().join(',') }),
    { title: 'Their bodies and scores in a table' });
  const breed = button('Breed', () => announced(async () => {
    const forms = await import('./forms.js'); // loaded here, not with the bar, which is on every
                                              // page
    await forms.breed(app, tray.kept.map(({ genotype }) => ({ voxels: genotype })));
  }), { title: 'Start a campaign from these robots' });
  const clear = button('Clear', async () => {
    const sure = tray.kept.length === 1 || await confirmDialog('Clear the tray?',
      `${countOf(tray.kept.length, 'robot')} will be removed from the tray. Stored designs and ` +
      'scores stay.', 'Clear the tray');
    if (sure) tray.clear();
  });
  const more = h('div.row', {}, compare, breed, button('Export', exportDialog), clear);
  const bar = h('aside', { id: 'tray', 'aria-label': 'Tray' },
    h('div.row.lead', {}, title, watch, race), chips, more);

  const staged = (show) => ({ designs: robots().join(','), show });

  function setOpen(open) {
    isOpen = String(open);
    storing(() => sessionStorage.setItem(OPEN_KEY, isOpen));
    update();
  }

  function chip({ robot, genotype, note }) {
    const name = nameOf(robot);
    const size = voxels(cellsOf(genotype).length);
    const edit = h('button.robot', {
      type: 'button', title: `${robot}: ${note || size}. Edit`, 'aria-label': `Edit ${name}`,
      onclick: () => {
        const view = viewOf();
        if (view?.pick) view.pick(genotype);
        else app.go('lab', { voxels: genotype });
      },
    }, picture(genotype), h('span', {}, name));
    const remove = button('×', () => {
      const next = item.nextElementSibling ?? item.previousElementSibling;
      tray.remove(robot);
      /** @type {HTMLElement} */ (next?.querySelector('.remove') ?? title).focus();
    }, { class: 'remove', title: 'Remove from the tray', 'aria-label': `Remove ${name}` });
    const item = h('li', {}, edit, remove);
    return item;
  }

  function update() {
    const n = tray.kept.length;
    bar.hidden = n === 0;
    say(title, `Tray: ${countOf(n, 'robot')}`);
    title.setAttribute('aria-expanded', isOpen);
    chips.hidden = more.hidden = isOpen !== 'true';
    race.disabled = compare.disabled = n < 2;
    breed.hidden = !may('submit');
    patch(chips, tray.kept, ({ robot }) => robot, chip);
  }

  tray.listeners.add(update);
  // The bar covers the end of the page, so elements that get the focus scroll to above the bar.
  new ResizeObserver(() => document.documentElement.style
    .setProperty('--tray', `${bar.hidden ? 0 : bar.offsetHeight}px`)).observe(bar);
  update();
  return Object.assign(bar, { update });
}

/** Returns the side view of a body as rows of EvoGym's materials, from the top. */
function sideView(genotype) {
  const [nx, ny, nz] = WORKSPACE;
  const isFilled = (x, z) =>
    Array.from({ length: ny }, (_, y) => hasVoxel(genotype, x, y, z)).some(Boolean);
  const rows = Array.from({ length: nz }, (_, up) =>
    Array.from({ length: nx }, (_, x) => (isFilled(x, nz - 1 - up) ? ACTUATOR : 0)));
  const used = rows.filter((row) => row.some(Boolean));
  const columns = Array.from({ length: nx }, (_, x) => x).filter((x) => used.some((row) => row[x]));
  return used.map((row) => row.slice(columns[0], columns.at(-1) + 1));
}

function exportDialog() {
  const list = (of) => `[\n${tray.kept.map((one) => JSON.stringify(of(one))).join(',\n')}\n]\n`;
  const json = () => list(({ robot, genotype, note }) => ({
    name: nameOf(robot), description: [robot, note].filter(Boolean).join(', '), voxels: genotype,
  }));
  const evogym = () => list(({ robot, genotype }) =>
    ({ name: `${nameOf(robot)} ${shortOf(robot)}`, robot, body: sideView(genotype) }));
  showDialog('Export the tray',
    h('div.row', {}, button('Genotypes (JSON)', () => saveText(json(), 'morphod-tray.json')),
      'for morphoctl eval, Python, or any program: 144 digits per robot'),
    h('div.row', {}, button('EvoGym (JSON)', () => saveText(evogym(), 'morphod-tray-evogym.json')),
      'side views as arrays of materials'),
    h('p.muted', {}, 'EvoGym has two dimensions: a cell is filled if any voxel behind it is, and ' +
      `every cell is material ${ACTUATOR}, a horizontal actuator.`));
}
