/** Forms that start jobs. */

import { getJson, post } from '../lib/api.js';
import { button, h } from '../lib/dom.js';
import { commandsOf } from '../lib/commands.js';
import { CAMPAIGN_PRESETS, TRAINING_PRESETS, TRAINING_STEPS } from '../lib/defaults.js';
import { estimateFor } from '../lib/estimate.js';
import { shellWord } from '../lib/format.js';
import { KINDS } from '../lib/kinds.js';
import { isSuite } from '../lib/rollouts.js';
import { ANY_LIGHT, SUITE, TASKS } from '../lib/tasks.js';
import { DESIGNS_HINT, LearnedOn, designsIn } from './form_designs.js';
import { fieldsOf, hintOf } from './form_fields.js';
import { copyDialog } from './share.js';
import { TaskChoice } from './task_choice.js';

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
  campaign: ['controller', 'seed', 'replicates', 'selection', 'exclude_pretraining', 'name',
    'weight', 'device', 'experiment'],
};

/** Returns the names of the fields of a form. */
export const fieldNames = (kind) => [...FIRST[kind], ...MORE[kind]];

/** Members of a request, in addition to the fields, that arguments of morphoctl stand for. */
const ARGUMENTS = ['designs', 'initial', 'environments', 'tasks', 'population', 'kind', 'mode'];

/** Returns the arguments of morphoctl that send a request, whose options have the names of the
 * fields; null if it has no option for a member. */
function morphoctlOf(kind, request, learnedOn) {
  const known = [...fieldNames(kind), ...ARGUMENTS];
  if (Object.keys(request).some((name) => !known.includes(name)) || request.initial?.campaign ||
    typeof request.selection === 'object' ||
    typeof request.tasks?.[0] === 'object') return null;
  const words = {
    evaluation: () => ['eval'], training: () => ['train', 'start', request.kind],
    campaign: () => ['campaign', 'start', request.mode],
  }[kind]();
  for (const name of fieldNames(kind)) {
    if (request[name] === undefined || ['kind', 'mode'].includes(name)) continue;
    if (name !== 'exclude_pretraining') words.push(`--${name}`, String(request[name]));
    else if (!request[name]) words.push('--no-exclusions');
  }
  const { environments, tasks } = request;
  if (tasks) words.push('--tasks', tasks.join());
  if (isSuite(environments)) words.splice(0, 1, 'suite', 'run');
  else if (typeof environments === 'string') words.push('--environments', environments);
  else if (environments) words.push('--environments', '-');
  if (learnedOn) return [...words, ...learnedOn].map(shellWord).join(' ');
  const designs = request.designs ?? request.initial?.designs ?? [];
  return [...words, ...designs.map(({ id, voxels }) => id ?? voxels)].map(shellWord).join(' ');
}

/**
 * Opens the form of a kind of job.
 * @param {import('../app.js').app} app
 * @param {string} kind evaluation, training or campaign
 * @param {Object<string, any>} [fixed] sent unchanged, such as the designs of an evaluation
 * @param {Object<string, any>} [proposed] initial values of fields
 * @param {{words?: string, world?: any, population?: any}} [kept] of the job that it repeats: what
 *   is kept, in words; its environments as a task to choose; the population to learn on
 */
export async function startDialog(app, kind, fixed = {}, proposed = {}, kept = {}) {
  const [contract, { items }, estimate] = await Promise.all([app.contract(),
    getJson('v1/controllers?limit=1000'), estimateFor(kind)]);
  const controllers = items.map(({ name }) => name).filter(Boolean);
  const [first, others] = [FIRST[kind], MORE[kind]].map((names) =>
    fieldsOf(kind, names.filter((name) => !(name in fixed)), contract, controllers, proposed));
  const fields = [...first, ...others];
  const inputOf = (name) => fields.find((field) => field.name === name)?.input;
  const designs = kind === 'evaluation' && !fixed.designs && !fixed.random
    ? h('textarea', { rows: 4, required: true, placeholder: DESIGNS_HINT }) : null;
  const learnedOn = kind === 'training' ? new LearnedOn() : null;
  if (kept.population) learnedOn.propose(kept.population);
  const message = h('p.error.wide', { role: 'alert' });
  const more = h('details.wide', {}, h('summary', {}, 'More'),
    h('div.fields', {}, others.map(({ element }) => element)));
  const drawn = app.task.points && app.task.name !== kept.world?.name ? [app.task] : [];
  const offered = [...(kept.world ? [kept.world] : []),
    ...(kind === 'training' ? [ANY_LIGHT, ...TASKS.slice(1)] : TASKS), ...drawn,
    ...(kind === 'evaluation' ? [SUITE] : [])];
  const tasks = fixed.environments || fixed.tasks ? null
    : new TaskChoice(offered, adapt, offered[0], kind);
  /** Explains the field in focus; screen readers read it with the field. */
  const hint = h('p.hint.wide.muted', { 'aria-hidden': 'true' });

  /** Returns the request without what a finetuning run trains on; isWhole: with the numbers that
   * empty fields stand for. */
  function body(isWhole = false) {
    /** @type {any} */
    const result = { ...fixed };
    for (const { name, schema, input } of fields) {
      const isNumber = ['integer', 'number'].includes(schema.type);
      const value = input.value || (isWhole && isNumber ? input.placeholder : '');
      if (schema.type === 'boolean') result[name] = value === 'true';
      else if (value !== '') result[name] = isNumber ? Number(value) : value;
    }
    if (designs) result.designs = designsIn(designs.value);
    return { ...result, ...tasks?.request };
  }

  /** Sends the request; shows errors at their fields, or below all fields. */
  async function attempt(work) {
    message.textContent = '';
    for (const field of fields) field.fault.textContent = '';
    try {
      await work({ ...body(), ...await learnedOn?.request() });
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
    const { path } = KINDS[kind];
    const job = await post(`v1/${path}`, request);
    dialog.close();
    app.go(`${path}/${job.id ?? job.items?.[0]?.id}`);
  }

  const copy = (request) => copyDialog(commandsOf({
    path: `v1/${KINDS[kind].path}`, body: request,
    morphoctl: morphoctlOf(kind, request, learnedOn?.words()),
    input: Array.isArray(request.environments) ? JSON.stringify(request.environments) : undefined,
  }));

  /** Shows what empty fields stand for with the current choices. */
  function adapt() {
    if (kind === 'training') {
      const isFinetune = inputOf('kind').value === 'finetune';
      learnedOn.show(isFinetune);
      inputOf('controller').options[0].text = isFinetune ? 'default' : 'random weights';
      inputOf('steps').placeholder = TRAINING_STEPS[inputOf('kind').value];
      inputOf('batch').placeholder = TRAINING_PRESETS[inputOf('preset').value];
    }
    if (kind === 'campaign') {
      const [mode, preset] = [inputOf('mode').value, inputOf('preset').value];
      inputOf('controller').options[0].text =
        mode === 'simultaneous' ? 'random weights' : 'default';
      const usual = CAMPAIGN_PRESETS[preset] ?? {};
      inputOf('population').placeholder = usual.population ?? 'from the preset';
      inputOf('generations').placeholder = usual[mode] ?? 'from the preset';
    }
    estimate.show({ ...body(true), ...learnedOn?.known() }, items, {
      environments: tasks?.count ?? fixed.environments?.length, isUnknown: learnedOn?.isUnknown });
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
        hint.textContent = field ? hintOf(field.schema, field.name) : '';
      },
    }, h('h2.wide', {}, `New ${kind}`),
    fixed.initial?.designs ? h('p.wide', {}, founders(fixed.initial.designs.length)) : null,
    kept.words ? h('p.wide.kept', {}, kept.words) : null,
    tasks?.element, first.map(({ element }) => element), learnedOn?.elements,
    designs ? h('label.field.wide', {}, h('span', {}, 'Designs'), designs) : null, more,
    estimate.element, hint, message, h('div.row.ends.wide', {},
      button('Copy as a command', () => attempt(copy)), button('Cancel', () => dialog.close()),
      h('button.primary', { type: 'submit' }, 'Start'))));
  adapt();
  document.body.append(dialog);
  dialog.showModal();
}

const founders = (n) =>
  `${n === 1 ? 'One design is the founder' : `${n} designs are the founders`}; ` +
  'random bodies fill up the rest of the population.';

/**
 * Opens the form of a campaign with the given designs as founders.
 * @param {import('../app.js').app} app
 * @param {object[]} designs {id} or {voxels} each
 */
export const breed = (app, designs) => startDialog(app, 'campaign', { initial: { designs } },
  { population: Math.max(32, designs.length), generations: 20, exclude_pretraining: false });
