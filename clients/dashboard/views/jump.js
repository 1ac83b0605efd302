/** Ctrl and K: jumps to a page, a run, or a robot. Question mark: the keys of the dashboard. */

import { getJson } from '../lib/api.js';
import { fill, h, table } from '../lib/dom.js';
import { linkOf, titleOf } from '../lib/kinds.js';
import { nameOf } from '../lib/names.js';
import { tray } from '../lib/tray.js';
import { showDialog } from './share.js';

/** Numbers of the newest runs and of the best designs that can be found, and of results that are
 * listed. */
const RUNS = 200;
const DESIGNS = 200;
const SHOWN = 12;

/** @type {[string, [string, string][]][]} */
const KEYS = [
  ['Everywhere', [['Ctrl K or ⌘ K', 'jump to a page, run or robot'], ['?', 'show this list']]],
  ['Charts', [['← →', 'move the cursor'], ['+ −', 'zoom'], ['0', 'show all']]],
  ['Stage, when it has the focus', [['space', 'play or pause'],
    [', .', 'one frame back or forward'], ['← → ↑ ↓', 'turn the view'], ['+ −', 'zoom'],
    ['f', 'follow a robot'], ['s', 'show springs']]],
  ['Driving, when the stage has the focus', [['W A S D, or Shift and ← → ↑ ↓', 'move the light'],
    ['Esc', 'end the drive']]],
  ['Lab', [['Ctrl Z', 'undo'], ['Ctrl Shift Z or Ctrl Y', 'redo']]],
  ['Lab, in a layer', [['← → ↑ ↓', 'move'], ['page up, page down', 'change the layer'],
    ['space', 'set or remove a voxel']]],
  ['Phylogeny', [['← →', 'previous or next design'], ['↑ ↓', 'ten designs back or forward']]],
];

/** Shows the keys. */
export function showKeys() {
  showDialog('Keyboard shortcuts', ...KEYS.map(([where, keys]) => h('section.stack', {},
    h('h3', {}, where),
    table(['Key', 'What it does'], h('tbody', {}, keys.map(([key, what]) =>
      h('tr', {}, h('th', { scope: 'row' }, h('kbd', {}, key)), h('td', {}, what)))), undefined,
    'table'))));
}

const robotItem = (robot, from) =>
  ({ name: nameOf(robot), about: `${from}, ${robot}`, href: `#/designs/${robot}` });

/** Loads everything that can be jumped to, as far as it can be loaded. */
async function find() {
  const list = (path) => getJson(path).then(({ items }) => items, () => []);
  const [jobs, designs] = await Promise.all([list(`v1/jobs?limit=${RUNS}`),
    list(`v1/designs?sort=score&limit=${DESIGNS}`)]);
  const known = new Set(tray.kept.map(({ robot }) => robot));
  return [
    ...jobs.map((job) => ({
      name: titleOf(job), about: `${job.kind} ${job.id}, ${job.state}`, href: linkOf(job),
    })),
    ...tray.kept.map(({ robot, genotype }) => ({
      name: nameOf(robot), about: `in the tray, ${robot}`, href: `#/lab?voxels=${genotype}`,
    })),
    ...designs.filter(({ robot }) => !known.has(robot)).map(({ robot }) =>
      robotItem(robot, 'design')),
  ];
}

/**
 * Opens the search. @param {{name: string, href: string}[]} pages
 */
export function jump(pages) {
  let all = pages.map((page) => ({ ...page, about: 'page' }));
  let shown = [];
  let at = 0;
  const list = h('ul', { id: 'jump-list', role: 'listbox', 'aria-label': 'Found' });
  const input = h('input', {
    type: 'search', role: 'combobox', 'aria-label': 'Jump to', 'aria-controls': 'jump-list',
    'aria-expanded': 'true', 'aria-autocomplete': 'list', autocomplete: 'off',
    placeholder: 'a page, a run, a robot, or an id', oninput: () => search(),
    onkeydown: (event) => {
      const step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
      if (step) {
        event.preventDefault();
        mark(Math.min(shown.length - 1, Math.max(0, at + step)));
      } else if (event.key === 'Enter') {
        event.preventDefault();
        go(shown[at]);
      }
    },
  });
  const dialog = h('dialog.jump', { 'aria-label': 'Jump to', onclose: () => dialog.remove() },
    h('div.stack', {}, input, list));

  function go(item) {
    if (!item) return;
    dialog.close();
    location.hash = item.href;
  }

  function mark(i) {
    at = i;
    [...list.children].forEach((element, k) => {
      element.setAttribute('aria-selected', String(k === at));
      if (k === at) element.scrollIntoView({ block: 'nearest' });
    });
    if (list.children[at]) input.setAttribute('aria-activedescendant', list.children[at].id);
    else input.removeAttribute('aria-activedescendant');
  }

  /** Searches: all words must occur; a name that begins with the text comes first. */
  function search() {
    const text = input.value.trim().toLowerCase();
    const words = text.split(/\s+/);
    const found = all.filter(({ name, about }) =>
      words.every((word) => `${name} ${about}`.toLowerCase().includes(word)));
    const isFirst = ({ name }) => name.toLowerCase().startsWith(text);
    shown = [...found.filter(isFirst), ...found.filter((one) => !isFirst(one))].slice(0, SHOWN);
    // Any design can be named by its id, not only those that were listed.
    if (/^[0-9a-f]{36}(@[0-7])?$/.test(text) && !shown.length) shown = [robotItem(text, 'design')];
    fill(list, shown.map((item, i) => h('li', {
      id: `jump-${i}`, role: 'option', onclick: () => go(item),
    }, h('span', {}, item.name), h('span.muted', {}, item.about))),
    shown.length ? null : h('li.empty', { role: 'option', 'aria-disabled': 'true' },
      'No matches.'));
    mark(0);
  }

  document.body.append(dialog);
  dialog.showModal();
  search();
  find().then((items) => {
    if (!dialog.isConnected) return;
    all = [...all, ...items];
    search();
  });
}
