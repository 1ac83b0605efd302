/** Controllers: their files and origin, and a comparison of two of them. */

import { getJson } from '../lib/api.js';
import { h, patch, patchRow, table } from '../lib/dom.js';
import { coalesced } from '../lib/events.js';
import { ago, bytes, count, number } from '../lib/format.js';
import { may } from '../lib/rights.js';
import { comparison } from './controller_comparison.js';
import { copyButton, saveLink } from './share.js';
import { startButton } from './start_buttons.js';

export async function mount(main, path, parameters, app) {
  const stop = new AbortController();
  const files = h('tbody');

  function fileCells(one, trainings) {
    const path = `v1/controllers/${encodeURIComponent(one.name)}/file`;
    return [
      h('td.main', {}, saveLink(path, `${one.name}.safetensors`, one.name)),
      h('td', {}, h('code', {}, one.sha256.slice(0, 12)),
        h('span.muted', {}, ` ${bytes(one.bytes)}`)),
      h('td', { 'data-name': 'Parameters' }, count(one.parameters)),
      h('td', { 'data-name': 'Sensor' }, one.sensor),
      h('td', { 'data-name': 'Outputs' }, periodOf(one)), ...lineageOf(one, trainings),
      h('td', {}, ago(one.stored_at)),
    ];
  }

  /** Updates the list; the comparison below it stays. */
  async function refresh() {
    const [trainings, controllers] = await Promise.all(['trainings', 'controllers'].map((name) =>
      getJson(`v1/${name}?limit=1000`, { signal: stop.signal })));
    const named = controllers.items.filter(({ name }) => name);
    patch(files, named, ({ name }) => name, () => h('tr'), (one, controller) =>
      patchRow(one, fileCells(controller, trainings.items)));
    return named;
  }

  const named = await refresh();
  const compared = named.length && may('submit') ? comparison(app, named, stop.signal) : null;
  const copy = copyButton(() => ({
    path: 'v1/controllers', morphoctl: 'controller list', python: 'print(m.controllers())',
  }));
  main.replaceChildren(h('div.title', {}, h('h1', {}, 'Controllers'),
    h('span.muted', {}, 'a training run makes one by backpropagation through the simulation'),
    h('div.actions', {}, copy, startButton(app, 'training', { class: 'primary' }))),
  h('section.panel.scroll', { 'aria-label': 'Files' }, table(
    ['Name', 'File', 'Parameters', 'Sensor', 'Outputs', 'Made by', 'From', 'Stored'], files)),
  ...(compared ? [compared.element] : []));
  const later = coalesced(refresh, stop.signal);
  return {
    update({ type }) {
      if (type === 'reset' || /^(job|training|controller)\./.test(type)) later();
    },
    unmount() {
      stop.abort();
      compared?.destroy();
    },
  };
}

/** Describes how often a controller computes its outputs. */
function periodOf({ control_period_s: period }) {
  return period ? `every ${number(1000 * period)} ms` : 'every step';
}

/** Returns the origin of a controller: the training run that made it, and what that run started
 * from. */
function lineageOf(controller, trainings) {
  const training = trainings.find((one) => one.controller?.sha256 === controller.sha256);
  if (!training) return [h('td.muted', { 'data-name': 'Made by' }, 'no training run here'),
    h('td', { 'data-name': 'From' }, '–')];
  return [h('td', { 'data-name': 'Made by' },
    h('a', { href: `#/trainings/${training.id}` }, training.label ?? `Training ${training.id}`)),
    h('td', { 'data-name': 'From' },
      training.parent?.name ?? (training.parent
      ? h('code', {}, training.parent.sha256.slice(0, 12)) : 'random weights'))];
}
