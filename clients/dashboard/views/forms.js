/**
 * Forms that start jobs. Names, bounds and defaults come from the contract that the daemon serves.
 */

import { getJson, post } from '../lib/api.js';
import { button, h, say } from '../lib/dom.js';
import { commandsOf } from '../lib/commands.js';
import { count, duration, shellWord } from '../lib/format.js';
import { may } from '../lib/rights.js';
import { SUITE, TASKS, taskPicture } from '../lib/tasks.js';
import { announced, copyDialog } from './share.js';

/**
 * The fields of each form in order: those shown first, and those under More. Everything else comes
 * from the contract.
 */
const FIRST = {
  evaluation: ['controller', 'label'],
  training: ['kind', 'preset', 'name', 'controller', 'label'],
  campaign: ['mode', 'preset', 'population', 'generations', 'label'],
};
const MORE = {
  evaluation: ['precision', 'priority', 'weight', 'device', 'experiment'],
  training: ['steps', 'batch', 'seed', 'weight', 'device', 'experiment'],
  campaign: ['controller', 'seed', 'replicates', 'selection', 'name', 'weight', 'device',
    'experiment'],
};
/** Names of fields for which the contract's name is unclear. */
const NAMES = { name: 'Name of the new controller', label: 'Label of the job' };
/** Studies need a client that makes the children, so there is no form for them. */
const LEFT_OUT = { mode: ['study'] };
/** The settings of the presets of a campaign, by mode: the contract has them in words. */
const PRESETS = {
  paper: { population: '8192', 'zero-shot': '100', 'few-shot': '7', simultaneous: '180' },
  workstation: { population: '512', 'zero-shot': '100', 'few-shot': '10', simultaneous: '180' },
  demo: { population: '64', 'zero-shot': '30', 'few-shot': '3', simultaneous: '30' },
};
/** The same for a training run: steps by kind, and batch size by preset. */
const LEARNING = {
  steps: { pretrain: '1400', finetune: '60' },
  batch: { workstation: '256', phototaxis: '8192', paper: '8192' },
};
/** The number of default environments, and of bodies that are simulated for an estimate. */
const [ENVIRONMENTS, MEASURED] = [10, 3];
const SCHEMAS = {
  evaluation: 'EvaluationRequest', training: 'TrainingRequest', campaign: 'CampaignRequest',
};

/** Returns a schema with its references followed, and its alternatives reduced to the plain one. */
export function resolve(contract, schema) {
  let result = { ...schema };
  for (let i = 0; i < 8 && result.$ref; i++) {
    const { $ref, ...own } = result;
    const target = $ref.split('/').slice(1).reduce((at, key) => at[key], contract);
    result = { ...target, ...own };
  }
  const alternatives = result.oneOf ?? result.anyOf;
  if (alternatives) {
    const plain = alternatives.map((one) => resolve(contract, one))
      .find((one) => one.enum || one.type === 'string' || one.const);
    if (plain) result = { ...plain, description: result.description, default: result.default };
  }
  return result;
}

/** Returns what an empty field stands for. */
function unsaid(kind, name, schema) {
  if (schema.default !== undefined) return String(schema.default);
  if (name === 'priority') return 'interactive up to 64 rollouts';
  return ['integer', 'number'].includes(schema.type) && kind !== 'evaluation'
    ? 'as the preset says' : '';
}

function inputFor(kind, name, schema, isRequired, controllers) {
  const described = { 'aria-describedby': `hint-${name}`, name };
  if (name === 'controller') {
    return h('select', described, h('option', { value: '' }, 'default'),
      controllers.map((one) => h('option', { value: one }, one)));
  }
  if (schema.enum) {
    const offered = schema.enum.filter((value) => !LEFT_OUT[name]?.includes(value));
    const isOpen = schema.default === undefined && !isRequired;
    return h('select', described, (isOpen ? ['', ...offered] : offered).map((value) =>
      h('option', { value, selected: value === (schema.default ?? '') },
        value || unsaid(kind, name, schema))));
  }
  const isNumber = schema.type === 'integer' || schema.type === 'number';
  return h('input', {
    ...described, type: isNumber ? 'number' : 'text', min: schema.minimum, max: schema.maximum,
    step: schema.type === 'integer' ? 1 : 'any', maxlength: schema.maxLength,
    placeholder: unsaid(kind, name, schema),
  });
}

function hintOf(schema) {
  const parts = [];
  if (schema.minimum !== undefined && schema.maximum !== undefined) {
    const [least, most] = [schema.minimum, schema.maximum].map((n) => n.toLocaleString('en-US'));
    parts.push(`${least} to ${most}`);
  }
  if (schema.description) parts.push(schema.description);
  return parts.join('. ');
}

/** Returns the arguments of morphoctl that send a request; its options have the names of the
 * fields. */
function morphoctlOf(kind, request, learnedOn) {
  const words = {
    evaluation: () => ['eval'], training: () => ['train', 'start', request.kind],
    campaign: () => ['campaign', 'start', request.mode],
  }[kind]();
  for (const name of [...FIRST[kind], ...MORE[kind]]) {
    if (request[name] === undefined || ['kind', 'mode'].includes(name)) continue;
    words.push(`--${name}`, String(request[name]));
  }
  const isSuite = typeof request.environments === 'string';
  if (isSuite && kind === 'evaluation') words.splice(0, 1, 'suite', 'run');
  else if (request.environments) words.push('--environments', '-');
  if (learnedOn) return [...words, ...learnedOn].map(shellWord).join(' ');
  const designs = request.designs ?? request.initial?.designs ?? [];
  return [...words, ...designs.map(({ id, voxels }) => id ?? voxels)].map(shellWord).join(' ');
}

/** Returns the button that starts a kind of job, or null if the caller may not. */
export function startButton(app, kind, attributes = {}) {
  return may('submit')
    ? button(`New ${kind}`, () => announced(() => startDialog(app, kind)), attributes) : null;
}

/** Reads designs from a text, one per line. */
const designsIn = (text) => text.split('\n').map((line) => line.trim()).filter(Boolean)
  .map((line) => (line.length === 144 ? { voxels: line } : { id: line }));
const DESIGNS_HINT = 'one design per line: a robot (ID@K), an id of 36 digits, or 144 digits of ' +
  'voxels';

/** The designs of a finetuning: fields, their part of the request, and morphoctl's arguments. */
class LearnedOn {
  constructor() {
    const number = (name, value, max) => h('input', { type: 'number', name, min: 1, max, value });
    this.random = number('random', 64, 10000);
    this.designs = h('textarea', { rows: 3, name: 'designs', placeholder: DESIGNS_HINT });
    this.job = number('job', '', null);
    this.best = number('best', '', 10000);
    this.best.placeholder = 'all';
    const field = (name, input, kind = '') =>
      h(`label.field${kind}`, {}, h('span', {}, name), input);
    this.parts = {
      random: [field('Random bodies', this.random)],
      designs: [field('Designs', this.designs, '.wide')],
      population: [field('Number of the campaign or evaluation', this.job),
        field('Only the best', this.best)],
    };
    this.choice = h('select', { name: 'learn-on', onchange: () => this.show(true) },
      [['random', 'random bodies'], ['designs', 'these designs'],
        ['population', 'a population']].map(([value, text]) => h('option', { value }, text)));
    this.head = field('Bodies to learn on', this.choice);
    this.elements = [this.head, ...Object.values(this.parts).flat()];
    this.show(false);
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
  }

  async request() {
    if (!this.isAsked) return {};
    if (this.choice.value === 'designs') return { designs: designsIn(this.designs.value) };
    if (this.choice.value === 'random') {
      const { items } = await post('v1/bodies/random', { count: Number(this.random.value) });
      return { designs: items.map(({ genotype }) => ({ voxels: genotype })) };
    }
    const { kind } = await getJson(`v1/jobs/${Number(this.job.value)}`);
    if (!['campaign', 'evaluation'].includes(kind)) {
      throw new Error(`Job ${this.job.value} is of kind ${kind}, which has no population.`);
    }
    const best = this.best.value ? { best: Number(this.best.value) } : {};
    return { population: { [kind]: String(Number(this.job.value)), ...best } };
  }

  /** Returns the same as arguments, or null if the request has no such fields. */
  words() {
    if (!this.isAsked) return null;
    if (this.choice.value === 'random') return ['--random', this.random.value];
    if (this.choice.value === 'designs') {
      return designsIn(this.designs.value).map(({ id, voxels }) => id ?? voxels);
    }
    const best = this.best.value ? ['--best', this.best.value] : [];
    return ['--population', this.job.value, ...best];
  }
}

/** The choice of a task, by a picture and a sentence. */
class TaskChoice {
  constructor(tasks, onChange) {
    this.chosen = tasks[0];
    this.element = h('fieldset.tasks.wide', {}, h('legend', {}, 'Task'), tasks.map((task) =>
      h('label.task', {}, h('input', {
        type: 'radio', name: 'task', value: task.name, checked: task === this.chosen,
        onchange: () => {
          this.chosen = task;
          onChange();
        },
      }), taskPicture(task), h('strong', {}, task.title), h('span.muted', {}, task.about))));
  }

  get environments() {
    return this.chosen.environments;
  }

  /** How many environments these are; undefined: the default set. */
  get count() {
    return this.chosen.count ?? this.chosen.environments?.length;
  }
}

/** Measures the seconds that a thread needs for a rollout, with a few random bodies. */
async function measureRollout() {
  const { items } = await post('v1/bodies/random', { count: MEASURED });
  const begin = performance.now();
  for (const { genotype } of items) { // one thread computes a body in all its environments
    await post('v1/rollouts',
      { designs: [{ voxels: genotype }], environments: 'paper-test', record: [] });
  }
  return (performance.now() - begin) / 1000 / (MEASURED * ENVIRONMENTS);
}

/**
 * Describes how many rollouts a request needs, and how long they take. Training runs and campaigns
 * that learn have no estimate, because they mostly compute gradients.
 * @param {number} designs to be scored in default environments and physics; 0 if unknown
 * @param {number|null} seconds that a thread needs for a rollout; null if unknown
 * @param {number} threads
 * @param {number} [environments] that each design is scored in
 */
export function estimateOf(designs, seconds, threads, environments = ENVIRONMENTS) {
  if (!designs) return '';
  const n = designs * environments;
  return `Up to ${count(n)} rollouts` + (seconds === null ? '.'
    : `: about ${duration(n * seconds / threads)} on this machine, if it does nothing else.`);
}

/** The fields of a form, from the contract, each with the service's errors. */
function fieldsOf(kind, names, contract, controllers, proposed) {
  const { properties, required = [] } = contract.components.schemas[SCHEMAS[kind]];
  return names.map((name) => {
    const schema = resolve(contract, properties[name]);
    const fault = h('span.fault', { role: 'alert' });
    const input = inputFor(kind, name, schema, required.includes(name), controllers);
    if (required.includes(name)) input.required = true;
    if (name in proposed) input.value = proposed[name];
    const plain = name.replaceAll('_', ' ');
    const title = NAMES[name] ?? plain[0].toUpperCase() + plain.slice(1);
    return { name, schema, input, fault, element: h('label.field', { title: hintOf(schema) },
      h('span', {}, title), input,
      h('span.visually-hidden', { id: `hint-${name}` }, hintOf(schema)), fault) };
  });
}

/**
 * Opens the form of a kind of job.
 * @param {import('../app.js').app} app
 * @param {string} kind evaluation, training or campaign
 * @param {Object<string, any>} [fixed] sent unchanged, such as the designs of an evaluation
 * @param {Object<string, any>} [proposed] initial values of fields
 */
export async function startDialog(app, kind, fixed = {}, proposed = {}) {
  const [contract, { items }, threads] = await Promise.all([app.contract(),
    getJson('v1/controllers?limit=1000'), getJson('v1/threads').catch(() => null)]);
  let rolloutSeconds = null;
  const controllers = items.map(({ name }) => name).filter(Boolean);
  const [first, others] = [FIRST[kind], MORE[kind]].map((names) =>
    fieldsOf(kind, names.filter((name) => !(name in fixed)), contract, controllers, proposed));
  const fields = [...first, ...others];
  const inputOf = (name) => fields.find((field) => field.name === name)?.input;
  const designs = kind === 'evaluation' && !fixed.designs
    ? h('textarea', { rows: 4, required: true, placeholder: DESIGNS_HINT }) : null;
  const learnedOn = kind === 'training' ? new LearnedOn() : null;
  const message = h('p.error.wide', { role: 'alert' });
  const more = h('details.wide', {}, h('summary', {}, 'More'),
    h('div.fields', {}, others.map(({ element }) => element)));
  const estimate = h('p.wide.muted', { 'aria-live': 'polite' });
  const offered = kind === 'evaluation' ? [...TASKS, SUITE] : TASKS;
  const tasks = kind === 'training' || fixed.environments ? null : new TaskChoice(offered, adapt);
  /** Explains the field in focus; screen readers read it with the field. */
  const hint = h('p.hint.wide.muted', { 'aria-hidden': 'true' });

  async function body() {
    /** @type {any} */
    const result = { ...fixed, ...await learnedOn?.request() };
    for (const { name, schema, input } of fields) {
      if (input.value === '') continue;
      const isNumber = ['integer', 'number'].includes(schema.type);
      result[name] = isNumber ? Number(input.value) : input.value;
    }
    if (designs) result.designs = designsIn(designs.value);
    if (tasks?.environments) result.environments = tasks.environments;
    return result;
  }

  /** Sends the request; shows errors at their fields, or below all fields. */
  async function attempt(work) {
    message.textContent = '';
    for (const field of fields) field.fault.textContent = '';
    try {
      await work(await body());
    } catch (error) {
      const rest = (error.faults ?? []).filter((fault) => {
        const name = fault.pointer?.split('/')[1];
        const field = fields.find((one) => one.name === name);
        if (field) field.fault.textContent = fault.detail;
        if (others.includes(field)) more.open = true;
        return !field;
      });
      message.textContent = rest.length
        ? rest.map(({ pointer, detail }) => `${pointer}: ${detail}`).join(' ')
        : error.faults?.length ? '' : error.message;
    }
  }

  async function start(request) {
    const job = await post(`v1/${kind}s`, request);
    const id = job.id ?? job.items?.[0]?.id;
    dialog.close();
    app.go(kind === 'evaluation' ? 'designs' : `${kind}s/${id}`,
      kind === 'evaluation' ? { evaluation: id } : {});
  }

  const copy = (request) => copyDialog(commandsOf({
    path: `v1/${kind}s`, body: request,
    morphoctl: morphoctlOf(kind, request, learnedOn?.words()),
    input: Array.isArray(request.environments) ? JSON.stringify(request.environments) : undefined,
  }));

  /** Shows what empty fields stand for with the current choices. */
  function adapt() {
    if (kind === 'training') {
      const isFinetune = inputOf('kind').value === 'finetune';
      learnedOn.show(isFinetune);
      inputOf('controller').options[0].text = isFinetune ? 'default' : 'random weights';
      inputOf('steps').placeholder = LEARNING.steps[inputOf('kind').value];
      inputOf('batch').placeholder = LEARNING.batch[inputOf('preset').value];
    }
    if (kind === 'campaign') {
      const [mode, preset] = [inputOf('mode').value, inputOf('preset').value];
      inputOf('controller').options[0].text =
        mode === 'simultaneous' ? 'random weights' : 'default';
      inputOf('population').placeholder = PRESETS[preset]?.population ?? 'as the preset says';
      inputOf('generations').placeholder = PRESETS[preset]?.[mode] ?? 'as the preset says';
    }
    say(estimate, estimateOf(designsScored(), isUsual() ? rolloutSeconds : null,
      threads?.n_threads, tasks?.count));
  }

  /** Returns whether the rollouts are like those that were measured. */
  function isUsual() {
    const usual = { controller: ['', 'default'], device: ['', 'auto', 'cpu'],
      precision: ['', 'float32'] };
    return threads !== null && Object.entries(usual).every(([name, values]) =>
      values.includes(inputOf(name)?.value ?? ''));
  }

  /** Returns how many designs the request scores; 0 if scoring does not take most of the time. */
  function designsScored() {
    const valueOf = (name) => Number(inputOf(name).value || inputOf(name).placeholder);
    if (kind === 'evaluation') return fixed.designs?.length ?? designsIn(designs.value).length;
    if (kind !== 'campaign' || inputOf('mode').value !== 'zero-shot') return 0;
    return valueOf('population') * (valueOf('generations') + 1) * valueOf('replicates') || 0;
  }

  const dialog = h('dialog', { 'aria-label': `New ${kind}`, onclose: () => dialog.remove() },
    h('form', {
      onsubmit: (event) => {
        event.preventDefault();
        attempt(start);
      },
      oninput: adapt,
      onchange: adapt,
      onfocusin: (event) => {
        const field = fields.find(({ input }) => input === event.target);
        hint.textContent = field ? hintOf(field.schema) : '';
      },
    }, h('h2.wide', {}, `New ${kind}`),
    fixed.initial ? h('p.wide', {}, founders(fixed.initial.designs.length)) : null,
    tasks?.element, first.map(({ element }) => element), learnedOn?.elements,
    designs ? h('label.field.wide', {}, h('span', {}, 'Designs'), designs) : null, more, estimate,
    hint, message, h('div.row.ends.wide', {}, button('Copy as a command', () => attempt(copy)),
      button('Cancel', () => dialog.close()),
      h('button.primary', { type: 'submit' }, 'Start'))));
  adapt();
  document.body.append(dialog);
  dialog.showModal();
  if (kind !== 'training') {
    measureRollout().then((seconds) => {
      rolloutSeconds = seconds;
      adapt();
    }).catch(() => {}); // the number of rollouts is still shown
  }
}

const founders = (n) =>
  `${n === 1 ? 'One design is the founder' : `${n} designs are the founders`}; ` +
  'random bodies fill up the rest of the population.';

/**
 * Returns the button that opens the form of a campaign with the given designs as founders; hidden
 * if the caller may not start one. @param {() => object[]} designsOf {id} or {voxels} each
 */
export function breedButton(app, text, designsOf, attributes = {}) {
  return button(text, () => {
    const designs = designsOf();
    return announced(() => startDialog(app, 'campaign', { initial: { designs } },
      { population: Math.max(32, designs.length), generations: 20 }));
  }, { ...attributes, hidden: !may('submit') });
}
