/** Forms that start jobs. Names, bounds and defaults come from the contract that the daemon serves. */

import { getJson, post } from '../lib/api.js';
import { button, fill, h } from '../lib/dom.js';
import { commandsOf } from '../lib/commands.js';
import { shellWord } from '../lib/format.js';
import { may } from '../lib/rights.js';
import { copyDialog } from './share.js';

/** What each form asks for, in the order shown; the contract knows all else. */
const FIELDS = {
  evaluation: ['controller', 'precision', 'priority', 'weight', 'device', 'label'],
  training: ['kind', 'preset', 'name', 'controller', 'steps', 'batch', 'seed', 'weight', 'device', 'label'],
  campaign: ['mode', 'preset', 'population', 'generations', 'seed', 'replicates', 'controller', 'selection', 'name',
    'weight', 'device', 'label'],
};
const SCHEMAS = { evaluation: 'EvaluationRequest', training: 'TrainingRequest', campaign: 'CampaignRequest' };

/** A schema with its references followed, and its alternatives reduced to the plain one. */
export function resolve(contract, schema) {
  let result = { ...schema };
  for (let i = 0; i < 8 && result.$ref; i++) {
    const { $ref, ...own } = result;
    const target = $ref.split('/').slice(1).reduce((at, key) => at[key], contract);
    result = { ...target, ...own };
  }
  const alternatives = result.oneOf ?? result.anyOf;
  if (alternatives) {
    const plain = alternatives.map((one) => resolve(contract, one)).find((one) => one.enum || one.type === 'string' || one.const);
    if (plain) result = { ...plain, description: result.description, default: result.default };
  }
  return result;
}

function inputFor(name, schema, isRequired) {
  const described = { 'aria-describedby': `hint-${name}`, name };
  if (schema.enum) {
    const choices = schema.default === undefined && !isRequired ? ['', ...schema.enum] : schema.enum;
    return h('select', described, choices.map((value) =>
      h('option', { value, selected: value === (schema.default ?? '') }, value === '' ? 'as the preset says' : value)));
  }
  const isNumber = schema.type === 'integer' || schema.type === 'number';
  return h('input', {
    ...described, list: name === 'controller' ? 'controllers' : null, type: isNumber ? 'number' : 'text', min: schema.minimum, max: schema.maximum,
    step: schema.type === 'integer' ? 1 : 'any', maxlength: schema.maxLength,
    placeholder: schema.default !== undefined ? String(schema.default) : isNumber ? 'as the preset says' : name === 'controller' ? 'default' : '',
  });
}

function hintOf(schema) {
  const parts = [];
  if (schema.minimum !== undefined && schema.maximum !== undefined) {
    parts.push(`${schema.minimum.toLocaleString('en-US')} to ${schema.maximum.toLocaleString('en-US')}`);
  }
  if (schema.description) parts.push(schema.description);
  return parts.join('. ');
}

/** The arguments of morphoctl that send a request; its options are named like the fields. */
function morphoctlOf(kind, request) {
  const words = {
    evaluation: () => ['eval'], training: () => ['train', 'start', request.kind],
    campaign: () => ['campaign', 'start', request.mode],
  }[kind]();
  for (const name of FIELDS[kind]) {
    if (request[name] === undefined || ['kind', 'mode'].includes(name)) continue;
    words.push(`--${name}`, String(request[name]));
  }
  const designs = request.designs ?? request.initial?.designs ?? [];
  return [...words, ...designs.map(({ id, voxels }) => id ?? voxels)].map(shellWord).join(' ');
}

/** The button that begins a job of a kind; null where the caller may not. */
export function startButton(app, kind, attributes = {}) {
  return may('submit') ? button(`New ${kind}`, () => startDialog(app, kind), attributes) : null;
}

/**
 * Opens the form of a kind of job.
 * @param {import('../app.js').app} app
 * @param {string} kind evaluation, training or campaign
 * @param {Object<string, any>} [fixed] sent as it is, like the designs of an evaluation
 * @param {Object<string, any>} [proposed] what the fields begin with
 */
export async function startDialog(app, kind, fixed = {}, proposed = {}) {
  const contract = await app.contract();
  const { properties, required = [] } = contract.components.schemas[SCHEMAS[kind]];
  const fields = FIELDS[kind].filter((name) => !(name in fixed)).map((name) => {
    const schema = resolve(contract, properties[name]);
    const fault = h('span.fault', { role: 'alert' });
    const input = inputFor(name, schema, required.includes(name));
    if (required.includes(name)) input.required = true;
    if (name in proposed) input.value = proposed[name];
    return { name, schema, input, fault, element: h('label.field', { title: hintOf(schema) },
      h('span', {}, name.replaceAll('_', ' ')), input, h('span.visually-hidden', { id: `hint-${name}` }, hintOf(schema)),
      fault) };
  });
  const names = h('datalist', { id: 'controllers' });
  getJson('v1/controllers?limit=200').then(({ items }) => fill(names, items.filter(({ name }) => name)
    .map(({ name }) => h('option', { value: name }))), () => {}); // a name can be typed, too
  const designs = kind === 'evaluation' && !fixed.designs ? h('textarea', {
    rows: 4, required: true, placeholder: 'one design a line: an id of 36 digits, or 144 digits of voxels',
  }) : null;
  const message = h('p.error.wide', { role: 'alert' });
  /** What the field in focus means; screen readers have it with the field. */
  const hint = h('p.hint.wide.muted', { 'aria-hidden': 'true' });

  function body() {
    /** @type {any} */
    const result = { ...fixed };
    for (const { name, schema, input } of fields) {
      if (input.value === '') continue;
      result[name] = ['integer', 'number'].includes(schema.type) ? Number(input.value) : input.value;
    }
    if (designs) {
      result.designs = designs.value.split('\n').map((line) => line.trim()).filter(Boolean)
        .map((line) => (line.length === 144 ? { voxels: line } : { id: line }));
    }
    return result;
  }

  function commands() {
    const request = body();
    return commandsOf({ path: `v1/${kind}s`, body: request, morphoctl: morphoctlOf(kind, request) });
  }

  async function submit(event) {
    event.preventDefault();
    message.textContent = '';
    for (const field of fields) field.fault.textContent = '';
    try {
      const job = await post(`v1/${kind}s`, body());
      const id = job.id ?? job.items?.[0]?.id;
      dialog.close();
      app.go(kind === 'evaluation' ? 'designs' : `${kind}s/${id}`, kind === 'evaluation' ? { evaluation: id } : {});
    } catch (error) {
      message.textContent = error.message;
      for (const fault of error.faults ?? []) {
        const field = fields.find(({ name }) => fault.pointer?.split('/')[1] === name);
        if (field) field.fault.textContent = fault.detail;
        else message.textContent += ` ${fault.pointer}: ${fault.detail}`;
      }
    }
  }

  const dialog = h('dialog', { 'aria-label': `New ${kind}`, onclose: () => dialog.remove() },
    h('form', { onsubmit: submit, onfocusin: (event) => {
      const field = fields.find(({ input }) => input === event.target);
      hint.textContent = field ? hintOf(field.schema) : '';
    } }, h('h2.wide', {}, `New ${kind}`),
      fixed.initial ? h('p.wide', {}, founders(fixed.initial.designs.length)) : null, fields.map(({ element }) => element),
      designs ? h('label.field.wide', {}, h('span', {}, 'designs'), designs) : null, names, hint, message,
      h('div.row.wide', {}, h('button.primary', { type: 'submit' }, 'Start'),
        button('Cancel', () => dialog.close()), button('Copy as a command', () => copyDialog(commands())))));
  document.body.append(dialog);
  dialog.showModal();
}

const founders = (n) => `${n === 1 ? 'One design is the founder' : `${n} designs are the founders`}; random bodies fill ` +
  'up what the population leaves free.';

/**
 * The button that opens the form of a campaign whose first population are the given designs; hidden
 * where the caller may not start one. @param {() => object[]} designsOf {id} or {voxels} each
 */
export function breedButton(app, text, designsOf, attributes = {}) {
  return button(text, () => {
    const designs = designsOf();
    return startDialog(app, 'campaign', { initial: { designs } },
      { population: Math.max(32, designs.length), generations: 20 });
  }, { ...attributes, hidden: !may('submit') });
}
