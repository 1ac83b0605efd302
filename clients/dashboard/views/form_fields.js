/** Fields of forms. Names, bounds and defaults come from the contract that the daemon serves. */

import { h } from '../lib/dom.js';

/** Names of fields for which the contract's name is unclear. */
const NAMES = {
  name: 'Name of the new controller', label: 'Label of the job',
  exclude_pretraining: 'Leave out pretraining bodies',
};
/** Studies need a client that makes the children, so there is no form for them. */
const LEFT_OUT = { mode: ['study'] };
/** Descriptions that replace those of the contract, which are about requests. */
const HINTS = { controller: 'The controller that the robots start with.' };
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

/** Describes what an empty field stands for. */
function unsaid(kind, name, schema) {
  if (schema.default !== undefined) return String(schema.default);
  if (name === 'priority') return 'interactive up to 64 rollouts';
  return ['integer', 'number'].includes(schema.type) && kind !== 'evaluation'
    ? 'from the preset' : '';
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

/** Returns the bounds and the description of a field. */
export function hintOf(schema, name = '') {
  if (HINTS[name]) return HINTS[name];
  const parts = [];
  if (schema.minimum !== undefined && schema.maximum !== undefined) {
    const [least, most] = [schema.minimum, schema.maximum].map((n) => n.toLocaleString('en-US'));
    parts.push(`${least} to ${most}`);
  }
  if (schema.description) parts.push(schema.description);
  return parts.join('. ');
}

/** The fields of a form, from the contract, each with the service's errors. */
export function fieldsOf(kind, names, contract, controllers, proposed) {
  const { properties, required = [] } = contract.components.schemas[SCHEMAS[kind]];
  return names.map((name) => {
    const schema = resolve(contract, properties[name]);
    if (schema.type === 'boolean') {
      Object.assign(schema, { enum: ['true', 'false'], default: `${schema.default}` });
    }
    const fault = h('span.fault', { role: 'alert' });
    const input = inputFor(kind, name, schema, required.includes(name), controllers);
    if (required.includes(name)) input.required = true;
    if (name in proposed) propose(input, proposed[name]);
    const plain = name.replaceAll('_', ' ');
    const title = NAMES[name] ?? plain[0].toUpperCase() + plain.slice(1);
    return { name, schema, input, fault, element: h('label.field', { title: hintOf(schema, name) },
      h('span', {}, title), input,
      h('span.visually-hidden', { id: `hint-${name}` }, hintOf(schema, name)), fault) };
  });
}

/** Sets a value; a list of choices that lacks it gets it as a further choice. */
function propose(input, value) {
  if (input.tagName === 'SELECT' && ![...input.options].some((one) => one.value === `${value}`)) {
    input.append(h('option', { value }, value));
  }
  input.value = value;
}
