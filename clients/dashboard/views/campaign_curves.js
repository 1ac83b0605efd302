/** The curves of a campaign, below its champions and their stage. */

import { Curve } from '../lib/api.js';
import { Chart, column } from '../lib/chart.js';
import {
  ChartGroup, axisIn, axisOptions, axisRow, sums, timeUnit,
} from '../lib/chart_group.js';
import { h } from '../lib/dom.js';
import { percent } from '../lib/format.js';
import { meters } from '../lib/tasks.js';
import { CampaignStage, Champions } from './champions.js';
import { emptyText } from './jobs.js';
import { TimeLapse } from './time_lapse.js';

/**
 * Choices of x. `rollouts` counts those computed for scores, without those cut short; `time` is
 * wall time without pauses.
 */
const AXES = ['generation', 'rollouts', 'time'];

/** Returns the charts of a campaign, by name. */
function chartsOf({ job, own, measure, shown }, group) {
  const { racing, selection, learning } = job().settings;
  const empty = 'No generation is complete yet.';
  /** @type {Object<string, Chart>} */
  const charts = {
    scores: new Chart({
      ...(own
        ? { title: own.unit ? `${own.name}, ${own.unit}` : own.name, yText: shown,
          note: `lower is better; ${job().study
            ? 'sent by the client' : 'the mean of a measure, negated for max'}` }
        : measure
        ? { title: `Meters ${measure.verb}`, note: 'higher is better; from the score',
          yText: meters }
        : { title: 'Score', note: 'lower is better', log: true }),
      height: 260, empty,
    }),
    diversity: new Chart({ title: 'Diversity and turnover', minimum: 0, height: 260, empty }),
    operators: new Chart({ title: 'Share of children that survive', minimum: 0, yText: percent }),
    size: new Chart({ title: 'Voxels and footprint', minimum: 0 }),
  };
  if (racing === 'lossless' && selection.kind === 'truncation' && !job().study) {
    charts.race = new Chart({ title: 'Share of children cut short', minimum: 0, yText: percent,
      note: 'they could not survive: their scores are lower bounds' });
  }
  if (learning !== null) {
    charts.learning = new Chart({ title: 'Loss while learning, in each generation' });
  }
  for (const [key, chart] of Object.entries(charts)) chart.join(group, key);
  return charts;
}

const secondsOf = ({ seconds }) => seconds;

export class CampaignCurves {
  constructor(shared) {
    this.shared = shared;
    const { id, others, get, job, app, parameters, comparing } = shared;
    const ids = [id, ...others];
    // A study with its own scores need not compute any rollouts.
    const axes = AXES.filter((axis) => axis !== 'rollouts' || !job().study?.own_score);
    this.axis = axisIn(parameters, axes);
    this.group = new ChartGroup(parameters, app.keep);
    const { group } = job();
    this.curves = ids.map((one) => new Curve(`v1/campaigns/${one}/generations`));
    this.replicates = group.replicates > 1
      ? new Curve(`v1/campaigns/${group.id}/replicates`) : null;
    const [{ Comparison }, { SettingsDiff }] = comparing ?? [{}, {}];
    this.compared = Comparison ? new Comparison(ids, get, this.group) : null;
    this.charts = chartsOf(shared, this.group);
    this.group.check();
    this.#placeCompared();
    this.stage = new CampaignStage(shared);
    this.champions = new Champions(shared, this.stage);
    this.lapse = new TimeLapse(shared, this.stage);
    const { race, learning, ...first } = this.charts;
    this.element = h('div.stack', {}, this.compared?.element,
      SettingsDiff ? new SettingsDiff(app, job(), others, get).element : null,
      h('div.grid', {}, h('div.stack', {}, this.stage.element, this.lapse.element,
        this.champions.element),
        h('div.stack.charts', {}, axisRow(axes, this.axis, (axis) => {
          this.axis = axis;
          app.keep({ x: axis === AXES[0] ? null : axis });
          this.group.zoomTo(null);
          this.#placeCompared();
          this.#show();
        }), Object.values(first).map(({ element }) => element))),
      h('div.grid', {}, [race, learning].map((chart) => chart?.element)));
    this.#show();
  }

  /** Shows the comparison with its axis: replicates have only generations in common. */
  #placeCompared() {
    const group = this.axis === AXES[0] ? this.group : new ChartGroup();
    this.compared?.chart.join(group, 'compared').update();
  }

  async refresh() {
    // The first robots come before the curves, which wait for them, but not for long.
    const isFirst = this.stage.isEmpty;
    if (isFirst) await this.champions.refresh();
    const fresh = await Promise.all([...this.curves, ...(this.replicates ? [this.replicates] : [])]
      .map((curve) => curve.refresh(this.shared.signal)));
    if (fresh.some(Boolean)) {
      this.#show();
      await this.compared?.refresh();
    }
    if (fresh[0] && !isFirst) this.champions.refresh(); // without waiting for them
  }

  #show() {
    const { charts, curves, replicates } = this;
    const { measure, others } = this.shared;
    const campaign = this.shared.job();
    const { rows } = curves[0];
    this.lapse.set(rows);
    const time = timeUnit(Math.max(...curves.map((curve) =>
      sums(curve.rows, secondsOf).at(-1) ?? 0)));
    const options = axisOptions(this.axis, AXES[0], time);
    Object.values(charts).forEach((chart) => Object.assign(chart.options, options));
    /** @type {(rows: any[]) => Float64Array} */
    const along = {
      generation: (list) => column(list, (row) => row.generation),
      rollouts: (list) => sums(list, (row) => row.rollouts),
      time: (list) => sums(list, (row) => secondsOf(row) / time.unitS),
    }[this.axis];
    const x = along(rows);
    const inUnit = measure?.valueOf ?? ((loss) => loss);
    const quantile = (name) => column(rows, (row) => inUnit(row.score.quantiles[name]));
    /** A lower loss is a higher value. */
    const between = (a, b) => (measure ? { low: quantile(b), high: quantile(a) }
      : { low: quantile(a), high: quantile(b) });
    /** @type {import('../lib/chart.js').Series[]} */
    const scores = [
      { name: '5 to 95 %', kind: 'band', x, ...between('p5', 'p95'), y: x,
        color: '--blue-softer' },
      { name: '25 to 75 %', kind: 'band', x, ...between('p25', 'p75'), y: x,
        color: '--blue-soft' },
      { name: 'median', x, y: quantile('p50'), color: '--blue' },
      { name: 'best', x, y: quantile('p0'), color: '--orange' },
    ];
    // Statistics over replicates are by generation, regardless of what it cost each replicate.
    if (replicates?.rows.length && this.axis === 'generation') {
      const r = replicates.rows;
      const rx = column(r, (row) => row.generation);
      scores.unshift({
        name: `mean of ${campaign.group.replicates} replicates, min to max`, kind: 'band',
        x: rx, y: rx, color: others.length ? '--gray' : '--green', opacity: 0.3,
        low: column(r, ({ mean_score: of }) => inUnit(measure ? of.most : of.least)),
        high: column(r, ({ mean_score: of }) => inUnit(measure ? of.least : of.most)),
      });
    }
    others.forEach((other, i) => {
      const [{ DASHES, HUES }] = this.shared.comparing;
      const { rows: r } = curves[i + 1];
      const ox = along(r);
      scores.push({ name: `25 to 75 % of ${other}`, kind: 'band', x: ox, y: ox, color: HUES[i + 1],
        opacity: 0.18,
        low: column(r, (row) => row.score.quantiles.p25),
        high: column(r, (row) => row.score.quantiles.p75) },
      { name: `median of ${other}`, x: ox, y: column(r, (row) => row.score.quantiles.p50),
        color: HUES[i + 1], dash: DASHES[i + 1] });
    });
    const newest = rows.at(-1);
    charts.scores.options.empty = emptyText(newest?.population, newest?.score.diverged,
      'No generation is complete yet.');
    charts.scores.set(scores);
    charts.diversity.set([
      { name: 'diversity', x, y: column(rows, (row) => row.diversity), color: '--blue' },
      { name: 'turnover', x, y: column(rows, (row) => row.turnover), color: '--pink',
        dash: [5, 4] },
    ]);
    const share = (name) => column(rows, ({ operators }) =>
      (operators[name].born ? operators[name].survived / operators[name].born : null));
    charts.operators.set([
      { name: 'mutation', x, y: share('mutation'), color: '--orange' },
      { name: 'crossover', x, y: share('crossover'), color: '--blue', dash: [5, 4] },
    ]);
    charts.size.set([
      { name: 'voxels, min to max', kind: 'band', x, y: x,
        low: column(rows, (row) => row.voxels.least),
        high: column(rows, (row) => row.voxels.most), color: '--blue-softer' },
      { name: 'mean voxels', x, y: column(rows, (row) => row.voxels.mean), color: '--blue' },
      { name: 'mean footprint', x, y: column(rows, (row) => row.footprint.mean), color: '--orange',
        dash: [5, 4] },
    ]);
    charts.race?.set([{ name: 'cut short', x, color: '--gray',
      y: column(rows,
        (row) => (row.generation && row.born ? row.children_cut / row.born : null)) }]);
    charts.learning?.set([
      { name: 'first step', x, y: column(rows, (row) => row.learning.first_loss), color: '--gray',
        dash: [5, 4] },
      { name: 'last step', x, y: column(rows, (row) => row.learning.last_loss), color: '--blue' },
    ]);
  }

  destroy() {
    Object.values(this.charts).forEach((chart) => chart.destroy());
    this.compared?.destroy();
    this.lapse?.stop();
    this.stage.destroy();
  }
}
