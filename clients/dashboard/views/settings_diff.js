/** How the settings of compared runs differ. */

import { fill, h, table } from '../lib/dom.js';
import { asJob, kindOf, pathOf, replicateOf, titleOf } from '../lib/kinds.js';
import { inWords, rowsOfSettings } from '../lib/settings.js';
import { placeOf, placesOf } from './settings.js';

/** Returns the settings by name, with those that are not in the request's settings. */
async function settingsOf(job, get) {
  const kind = kindOf(job);
  const rows = new Map(rowsOfSettings(kind.settings(job)).map(({ path, group, title, text }) =>
    [path.join('.'), { title: group === 'Settings' ? title : `${group}: ${title}`, text }]));
  const file = kind.kind === 'training' ? job.parent : job.controller;
  const add = (title, text) => rows.set(title, { title, text: text ?? 'none' });
  add('Kind', job.mode ?? job.trainingKind ?? kind.name.toLowerCase());
  add('Preset', job.preset);
  add('Controller', file ? `${file.name ?? ''} (${file.sha256.slice(0, 12)})` : 'random weights');
  add('Device', job.device);
  const worlds = kind.worlds(job);
  if (worlds && typeof worlds !== 'string') { // equal numbers may stand for different environments
    const places = await placesOf(job, get);
    rows.get('environments').text = `${inWords('environments', worlds)} ` +
      `(${places.map((one) => one.sha256.slice(0, 6) || placeOf(one)).join('; ')})`;
  }
  return rows;
}

export class SettingsDiff {
  /** @param {any} app @param {any} job @param {string[]} others @param {function(string):
   * Promise<any>} get */
  constructor(app, job, others, get) {
    this.element = h('section.panel.stack', { 'aria-label': 'Settings that differ' },
      h('h2', {}, 'Settings that differ'), h('p.muted', { role: 'status' }, 'Loading…'));
    this.#show(job, others, get).catch((error) =>
      fill(this.element, h('h2', {}, 'Settings that differ'), h('p.muted', {}, error.message)));
  }

  async #show(job, others, get) {
    const jobs = [job, ...await Promise.all(others.map(async (id) =>
      asJob(job.kind, await get(pathOf({ ...job, id })))))];
    const all = await Promise.all(jobs.map((one) => settingsOf(one, get)));
    const names = [...new Set(all.flatMap((rows) => [...rows.keys()]))];
    const differing = names.filter((name) =>
      new Set(all.map((rows) => rows.get(name)?.text ?? '–')).size > 1);
    const titles = jobs.map((one) => `${titleOf(one)}${one.label ? ` (${one.id})` : ''}` +
      replicateOf(one));
    fill(this.element, h('h2', {}, 'Settings that differ'), differing.length
      ? h('div.scroll', {}, table(['Setting', ...titles], h('tbody', {}, differing.map((name) =>
        h('tr', {}, h('th', { scope: 'row' }, all.find((rows) => rows.has(name)).get(name).title),
          all.map((rows) => h('td', {}, rows.get(name)?.text ?? '–'))))), undefined, 'table'))
      : h('p.muted', {}, 'All settings are the same.'));
  }
}
