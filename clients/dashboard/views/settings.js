/** The tab Settings of a run: what the service used, and what differs from the preset. */

import { fill, h } from '../lib/dom.js';
import { duration } from '../lib/format.js';
import { kindOf, secondsOf } from '../lib/kinds.js';
import { environmentSet, environmentsAt, isSuite } from '../lib/rollouts.js';
import { settingsOf } from '../lib/settings.js';
import { taskWords } from '../lib/tasks.js';

/** Returns the control period of the controller that a job starts with; null if it is not known. */
export async function periodOf(job, get) {
  const file = job.parent ?? job.controller;
  if (!file) return null;
  const { items } = await get('v1/controllers?limit=1000');
  return items.find(({ sha256 }) => sha256 === file.sha256)?.control_period_s ?? null;
}

const time = (text) => (text ? new Date(text).toLocaleString() : null);

/** Returns the facts that are not settings of the request: names and texts. */
function facts(job) {
  const file = kindOf(job).kind === 'training' ? job.parent : job.controller;
  return [
    ['Mode', job.mode ?? job.trainingKind ?? kindOf(job).name.toLowerCase()],
    ['Preset', job.preset],
    ['Controller', file ? `${file.name ?? 'by its hash'} (${file.sha256.slice(0, 12)})`
      : 'random weights'],
    ['Device', job.device], ['Priority', job.priority], ['Weight', String(job.weight)],
    ['Experiment', job.experiment], ['Submitted by', job.submitted_by],
    ['Created', time(job.created_at)], ['Start', time(job.started_at)],
    ['End', time(job.finished_at)], ['Duration', secondsOf(job) && duration(secondsOf(job))],
    ['Core time', duration(job.core_seconds)],
    ['Device time', job.device_seconds ? duration(job.device_seconds) : null],
  ].filter(([, text]) => text);
}

const panel = (title, rows) => h('section.panel', { 'aria-label': title }, h('h2', {}, title),
  h('dl.settings', {}, rows));

/**
 * Returns the name and the value of a setting; in bold if it differs from the preset's.
 * @param {{title: string, text: string, differs?: boolean, usual?: string|null}} row
 */
function pair({ title, text, differs, usual }) {
  return [h('dt', {}, title), h('dd', {}, differs ? h('strong', {}, text) : text,
    differs ? h('span.muted', {}, ` (default ${usual})`) : null)];
}

/** Describes an environment: its task, where its light is, and its ground. */
export function placeOf(environment) {
  const { task, light_xy_m: light, terrain, terrain_heights_m: heights, damage, factors,
    drop_m: drop, sha256 } = environment;
  const flat = heights?.every((one) => one === 0);
  const meters = light?.map((one) => Number(one.toFixed(3))).join(', ');
  return [taskWords([{ task }]) || 'photo', light ? `light at (${meters}) m` : '',
    terrain ? `terrain ${terrain.kind}` : heights ? (flat ? 'flat' : 'rough ground') : '',
    damage ? 'damage' : '', Object.entries(factors ?? {}).map((one) => one.join(' × ')).join(', '),
    drop ? `drop ${drop} m` : '', sha256.slice(0, 12)].filter(Boolean).join(' · ');
}

/** Loads the environments of a job; [] if they cannot be listed. */
export async function placesOf(job, get) {
  const kind = kindOf(job);
  const named = kind.worlds(job);
  if (named === null || isSuite(named)) return [];
  if (typeof named === 'string') return environmentSet(named);
  const path = kind.environments(job);
  if (path) return environmentsAt(path);
  const { environments } = await get(`v1/trainings/${job.id}/held-out`);
  return environments.map((one) => ({ ...one, sha256: '' }));
}

export class SettingsTab {
  constructor({ job, get }) {
    this.job = job;
    this.get = get;
    this.element = h('div.stack', {}, h('p.muted', { role: 'status' }, 'Loading…'));
    this.shown = '';
  }

  async refresh() {
    const job = this.job();
    // The members that can change; for example, a campaign can be extended.
    const key = JSON.stringify([job.state, job.weight, job.experiment, kindOf(job).settings(job)]);
    if (key === this.shown) return;
    this.shown = key;
    const [period, listed] = await Promise.all([periodOf(job, this.get).catch(() => null),
      placesOf(job, this.get).catch(() => undefined)]); // without them, no default depends on them
    const { preset, rows } = settingsOf(job, period, listed);
    const groups = [...new Set(rows.map(({ group }) => group))];
    const n = rows.filter(({ differs }) => differs).length;
    const of = preset ? `the preset ${preset}` : 'the defaults';
    const guessed = preset && !job.preset ? ', the closest one' : '';
    const places = h('section.panel', { 'aria-label': 'Environments', hidden: true });
    fill(this.element, h('p.muted', {}, n
      ? `${n === 1 ? 'One setting differs' : `${n} settings differ`} from ${of}${guessed}: in bold.`
      : `No setting differs from ${of}${guessed}.`),
    h('div.columns', {},
      panel('This run', facts(job).map(([title, text]) => pair({ title, text }))),
      groups.map((group) => panel(group, rows.filter((row) => row.group === group).map(pair))),
      places));
    const all = listed ?? [];
    places.hidden = !all.length;
    fill(places, h('h2', {}, 'Environments'), h('ol', { start: 0 }, all.map((one) =>
      h('li', {}, placeOf(one)))));
  }

  destroy() {}
}
