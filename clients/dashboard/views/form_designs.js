/** Fields for designs: those of an evaluation, and those that a finetuning run trains on. */

import { getJson, post } from '../lib/api.js';
import { h } from '../lib/dom.js';

/** Reads designs from a text, one per line. */
export const designsIn = (text) => text.split('\n').map((line) => line.trim()).filter(Boolean)
  .map((line) => (line.length === 144 ? { voxels: line } : { id: line }));
export const DESIGNS_HINT = 'one design per line: a robot (ID@K), an id of 36 digits, or 144 ' +
  'voxel digits';

/** The designs of a finetuning run: fields, their part of the request, and morphoctl's
 * arguments. */
export class LearnedOn {
  constructor() {
    const number = (name, value, max) => h('input', { type: 'number', name, min: 1, max, value });
    this.random = number('random', 64, 10000);
    this.designs = h('textarea', { rows: 3, name: 'designs', placeholder: DESIGNS_HINT });
    this.job = number('job', '', null);
    this.best = number('best', '', 10000);
    this.best.placeholder = 'all';
    this.atlas = h('input', { name: 'atlas' });
    this.count = number('count', 500, 10000);
    this.seed = number('atlas-seed', 1, null);
    this.seed.min = '0';
    this.sha256 = h('input', { name: 'atlas-sha256', placeholder: 'any file' });
    const field = (name, input, kind = '') =>
      h(`label.field${kind}`, {}, h('span', {}, name), input);
    this.parts = {
      random: [field('Random bodies', this.random)],
      designs: [field('Designs', this.designs, '.wide')],
      population: [field('Number of the campaign or evaluation', this.job),
        field('Only the best', this.best)],
      atlas: [field('Atlas', this.atlas), field('Bodies from its whole ranking', this.count),
        field('Seed of the draw', this.seed), field('Only if its file has the hash', this.sha256)],
    };
    this.choice = h('select', { name: 'learn-on', onchange: () => this.show(true) },
      [['random', 'random bodies'], ['designs', 'these designs'],
        ['population', 'a population'], ['atlas', 'bodies from an atlas']].map(([value, text]) =>
        h('option', { value }, text)));
    this.head = field('Bodies to train on', this.choice);
    this.elements = [this.head, ...Object.values(this.parts).flat()];
    this.show(false);
  }

  /** Chooses the population of a job, or bodies of an atlas. @param {any} population */
  propose({ job, best, atlas, count, seed, sha256 }) {
    this.choice.value = atlas ? 'atlas' : 'population';
    if (atlas) {
      Object.assign(this.atlas, { value: atlas });
      Object.assign(this.count, { value: count });
      Object.assign(this.seed, { value: seed });
      Object.assign(this.sha256, { value: sha256 });
      return;
    }
    this.job.value = job;
    this.best.value = best ?? '';
  }

  /** Shows the fields of the current choice; hidden fields are not sent. */
  show(isAsked) {
    this.isAsked = isAsked;
    this.head.hidden = !isAsked;
    for (const [name, parts] of Object.entries(this.parts)) {
      for (const part of parts) part.hidden = !isAsked || name !== this.choice.value;
    }
    const is = (name) => isAsked && this.choice.value === name;
    this.random.required = is('random');
    this.designs.required = is('designs');
    this.job.required = is('population');
    for (const input of [this.atlas, this.count, this.seed]) input.required = is('atlas');
  }

  /** Whether the bodies are not known before the request is sent. */
  get isUnknown() {
    return this.isAsked && ['population', 'atlas'].includes(this.choice.value);
  }

  /** Returns the part of the request that is known without asking the service. */
  known() {
    return this.isAsked && this.choice.value === 'designs'
      ? { designs: designsIn(this.designs.value) } : {};
  }

  async request() {
    if (!this.isAsked) return {};
    if (this.choice.value === 'designs') return { designs: designsIn(this.designs.value) };
    if (this.choice.value === 'random') {
      const { items } = await post('v1/bodies/random', { count: Number(this.random.value) });
      return { designs: items.map(({ genotype }) => ({ voxels: genotype })) };
    }
    if (this.choice.value === 'atlas') {
      const atlas = this.atlas.value;
      const sha256 = this.sha256.value.trim();
      return { population: { atlas, count: Number(this.count.value), seed: Number(this.seed.value),
        ...(sha256 ? { sha256 } : {}) } };
    }
    const { kind } = await getJson(`v1/jobs/${Number(this.job.value)}`);
    if (!['campaign', 'evaluation'].includes(kind)) {
      throw new Error(`Job ${this.job.value} is of kind ${kind}, which has no population.`);
    }
    const best = this.best.value ? { best: Number(this.best.value) } : {};
    return { population: { [kind]: String(Number(this.job.value)), ...best } };
  }

  /** Returns the same part as arguments of morphoctl, or null if the request has no such fields. */
  words() {
    if (!this.isAsked) return null;
    if (this.choice.value === 'random') return ['--random', this.random.value];
    if (this.choice.value === 'designs') {
      return designsIn(this.designs.value).map(({ id, voxels }) => id ?? voxels);
    }
    if (this.choice.value === 'atlas') {
      return ['--atlas', this.atlas.value, '--count', this.count.value, '--atlas-seed',
        this.seed.value];
    }
    const best = this.best.value ? ['--best', this.best.value] : [];
    return ['--population', this.job.value, ...best];
  }
}
