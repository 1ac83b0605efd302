/** Compares campaigns: their scores at the newest generation that all of them have, with an
 * interval. */

import { Chart } from '../lib/chart.js';
import { fill, h, table } from '../lib/dom.js';
import { countOf, score, signed } from '../lib/format.js';
import { replicateOf, titleOf } from '../lib/kinds.js';
import { CONFIDENCE, compareMeans } from '../lib/statistics.js';
import { Curve } from '../lib/api.js';

/** The colors of this campaign and of those compared with it, in every chart. */
export const HUES = ['--blue', '--green', '--pink', '--gray'];
export const DASHES = [[], [6, 4], [2, 3], [9, 3, 2, 3]];

/**
 * Returns the setting whose difference makes the scores of two sides incomparable, as in morphoctl
 * campaign compare; '' if they can be compared.
 */
function differenceOf(one, other) {
  const [own, otherOwn] = [one, other].map(({ campaign }) =>
    Object.values(campaign.own_score ?? campaign.settings.aggregate).join(' ').trim());
  if (own !== otherOwn) return `their scores (${own}; ${otherOwn})`;
  const [a, b] = [one, other].map(({ campaign }) => campaign.settings.physics);
  const setting = Object.keys({ ...a, ...b }).find((name) => a[name] !== b[name]);
  if (setting) return `physics.${setting} (${a[setting]}, ${b[setting]})`;
  return one.worlds.join() === other.worlds.join() ? '' : 'their environments';
}

/** The replicates of a campaign form one side: their mean is compared, and their spread gives the
 * interval. */
export class Comparison {
  /**
   * @param {string[]} ids @param {function(string): Promise<any>} get
   * @param {import('../lib/chart_group.js').ChartGroup} group
   */
  constructor(ids, get, group) {
    this.ids = ids;
    this.get = get;
    /**
     * @type {{id: string, campaign: Object, group: string, members: string[], early: string[],
     *         curves: Curve[]}[]|null}
     */
    this.sides = null;
    this.chart = new Chart({ title: 'Best score, mean and range over replicates', log: true,
      empty: 'No generation is complete yet.' }).join(group, 'compared');
    this.body = h('tbody');
    this.note = h('p.muted');
    this.element = h('section.grid', { 'aria-label': 'Comparison' }, this.chart.element,
      h('section.panel.stack', {}, h('h2', {}, 'Comparison'), this.note, h('div.scroll', {}, table(
        ['Campaign', 'Runs', 'Best score', 'Difference', `${100 * CONFIDENCE} % interval`],
        this.body, (name, i) => i > 0, 'table'))));
  }

  /** Loads the campaigns of a side, with their curves. */
  async #load() {
    const sides = await Promise.all(this.ids.map(async (id) => {
      const campaign = await this.get(`v1/campaigns/${id}`);
      const group = `v1/campaigns?group=${campaign.group.id}&limit=100&archived=all`;
      const { items } = await this.get(group);
      const worlds = await this.get(`v1/campaigns/${id}/environments`);
      // Replicates that ended early are only listed, unless all did.
      const early = items.filter(({ state }) => state === 'cancelled' || state === 'failed')
        .map((one) => one.id);
      const counted = items.map((one) => one.id).filter((one) => !early.includes(one));
      return {
        id, campaign: { ...campaign, kind: 'campaign' }, group: campaign.group.id,
        members: counted.length ? counted : early, early: counted.length ? early : [], curves: [],
        worlds: worlds.items.map(({ sha256 }) => sha256),
      };
    }));
    for (const side of sides) {
      // Two replicates of one group are compared as separate campaigns.
      if (sides.some((other) => other !== side && other.group === side.group)) {
        [side.members, side.early] = [[side.id], []];
      }
      side.curves = side.members.map((id) => new Curve(`v1/campaigns/${id}/generations`));
    }
    return sides;
  }

  async refresh() {
    this.sides ??= await this.#load();
    // A study's own scores may be negative.
    this.chart.options.log = !this.sides.some(({ campaign }) => campaign.own_score);
    await Promise.all(this.sides.flatMap(({ curves }) => curves.map((curve) => curve.refresh())));
    const best = ({ rows }) => rows.map((row) => row.score.quantiles.p0 ?? NaN);
    const last =
      Math.min(...this.sides.flatMap(({ curves }) => curves.map((curve) => curve.rows.length))) - 1;
    if (last < 0) return;
    this.chart.set(this.sides.flatMap(({ id, curves }, i) => {
      const all = curves.map(best);
      const n = Math.min(...all.map((one) => one.length));
      const x = Array.from({ length: n }, (_, generation) => generation);
      const at = (take) => x.map((generation) => take(all.map((one) => one[generation])));
      return [
        ...(all.length > 1
          ? [{ name: `min to max of ${id}`, kind: /** @type {'band'} */ ('band'), silent: true,
            of: `campaign ${id}`, x, y: x, color: HUES[i], opacity: 0.2,
            low: at((values) => Math.min(...values)), high: at((values) => Math.max(...values)) }]
          : []),
        { name: `campaign ${id}`, x, color: HUES[i], dash: DASHES[i],
          y: at((values) => values.reduce((sum, one) => sum + one, 0) / values.length) },
      ];
    }));
    this.#showTable(last, this.sides.map(({ curves }) => curves.map((curve) => best(curve)[last])));
  }

  #showTable(generation, values) {
    const early = this.sides.flatMap((side) => side.early);
    const differing = this.sides.map((side) => {
      const difference = differenceOf(this.sides[0], side);
      return difference && ` Campaigns ${this.ids[0]} and ${side.id} differ in ${difference}: ` +
        'their scores cannot be compared.';
    });
    this.note.textContent =
      `At generation ${generation}, the newest that all have reached; lower is better.${
        early.length ? ` Left out, because they ended early: ${early.join(', ')}.` : ''}${
        differing.join('')}`;
    fill(this.body, this.sides.map((side, i) => {
      const { id, campaign } = side;
      const compares = i > 0 && !differenceOf(this.sides[0], side);
      const { difference, low, high } = compareMeans(values[0], values[i]);
      const mean = values[i].reduce((sum, one) => sum + one, 0) / values[i].length;
      const n = Math.min(values[0].length, values[i].length);
      const interval = Number.isFinite(low) ? `${signed(low)} to ${signed(high)}`
        : `${countOf(n, 'run')}: no interval`;
      const single = values[i].length === 1 ? replicateOf(campaign) : '';
      return h('tr', {}, h('td', {}, h('a', { href: `#/campaigns/${id}` }, titleOf(campaign)),
        h('div.muted', {}, `campaign ${id}${single}`)),
      h('td.right', {}, values[i].length),
      h('td.right', {}, score(Number.isFinite(mean) ? mean : null)),
      h('td.right', {}, compares && Number.isFinite(difference) ? signed(difference) : '–'),
      h('td.right', {}, compares ? interval : '–'));
    }));
  }

  destroy() {
    this.chart.destroy();
  }
}
