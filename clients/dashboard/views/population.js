/** The population of a campaign: any two traits of its designs, and those in a brush walking. */

import { listOf } from '../lib/api.js';
import { h } from '../lib/dom.js';
import { CampaignStage } from './champions.js';
import { Scatter } from './scatter.js';

const DESIGNS_MAX = 10000;

export class PopulationTab {
  constructor(shared) {
    this.shared = shared;
    this.population = [];
    this.stage = new CampaignStage(shared);
    this.scatter = new Scatter((numbers) => this.stage.walk(numbers.map((number) =>
      this.population.find((one) => one.number === number)).filter(Boolean)), shared.own?.name);
    this.element = h('div.grid', {}, this.scatter.element, this.stage.element);
  }

  async refresh() {
    const { id, get, job } = this.shared;
    if (job().progress.generation === null) return;
    const population = await listOf(get, `v1/campaigns/${id}/population`, {}, DESIGNS_MAX);
    this.population = population;
    this.scatter.set(population);
    if (this.stage.isEmpty) {
      const best = [...population].sort((a, b) => (a.score ?? Infinity) - (b.score ?? Infinity));
      await this.stage.walk(best.slice(0, 4));
    }
  }

  destroy() {
    this.stage.destroy();
    this.scatter.destroy();
  }
}
