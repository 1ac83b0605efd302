/**
 * The settings that a request leaves to the service, by kind, mode and preset. The contract
 * describes the settings of a preset only in words; a test compares those here with what the
 * service uses.
 */

/** The presets of campaigns: population, and generations by mode. */
export const CAMPAIGN_PRESETS = {
  paper: { population: 8192, 'zero-shot': 100, 'few-shot': 7, simultaneous: 180 },
  workstation: { population: 512, 'zero-shot': 100, 'few-shot': 10, simultaneous: 180 },
  demo: { population: 64, 'zero-shot': 30, 'few-shot': 3, simultaneous: 30 },
};
/** The presets of training runs: robots of a step. */
export const TRAINING_PRESETS = { workstation: 256, phototaxis: 8192, paper: 8192, robust: 8192 };
/** What the preset robust varies. */
const ROBUST = {
  ...Object.fromEntries(['stiffness', 'mass', 'drag', 'gravity', 'actuation']
    .map((name) => [name, [1, 1]])),
  friction: [0.4, 1],
};
export const TRAINING_STEPS = { pretrain: 1400, finetune: 60 };
export const VALIDATION = { every_steps: 50, designs: 64, environments: 8 };
/** The steps on parents, and those on children, of a campaign's generation. */
export const CAMPAIGN_STEPS = { 'few-shot': 30, simultaneous: 1 };

/** @param {boolean} isPaper @returns {number} the control period of random weights, in seconds */
export const randomPeriodS = (isPaper) => (isPaper ? 0 : 0.016);
const PHYSICS = {
  dt_s: 0.002, n_steps: 2000, stiffness_n_per_m: 15000, mass_kg: 1, drag_per_s: 15,
  gravity_m_per_s2: 9.8, actuation: 0.2, friction: 0.9, friction_cap: 0.95, drop_height_m: 0,
  impact: 'exact', integrator: 'split',
};

/** @param {boolean} isPaper @param {number} periodS of the controller */
export const physicsOf = (isPaper, periodS) => ({
  ...PHYSICS, control_period_s: periodS,
  ...(isPaper ? { dt_s: 0.004, n_steps: 1000, integrator: 'paper' } : {}),
});

const schedule = (kind, peak, floor, decay, cycleSteps, growth, warmup = 0) => ({
  kind, peak, floor, decay, cycle_steps: cycleSteps, cycle_growth: growth, warmup_steps: warmup,
});
const SCHEDULES = {
  'paper-pretrain': schedule('restarts', 1e-3, 1e-5, 0.7, 10, 2),
  'paper-finetune': schedule('restarts', 3.5e-4, 3.5e-5, 1, 100, 1),
  'paper-simultaneous': schedule('restarts', 1e-3, 1e-5, 0.65, 10, 2),
  'one-cosine': schedule('cosine', 2e-3, 1e-5, 1, 1, 1, 10),
  'finetune-cosine': schedule('cosine', 3e-4, 1e-6, 1, 100, 1),
  phototaxis: schedule('restarts', 2e-3, 1e-5, 0.75, 61, 22, 5),
};
const learningOf = (name) => ({
  schedule: SCHEDULES[name], adam: { beta1: 0.9, beta2: 0.999, epsilon: 1e-8 },
  gradient_norm_limit: 1, adjoint_bound: 2, adjoint_rule: 'clip', restart_weight: 3, vary: null,
});

/** The settings of each selection. */
const SELECTIONS = {
  truncation: {}, tournament: { size: 4 }, novelty: { weight: 0.5 },
  'age-layered': { layers: 4, age_gap: 5 },
};

/** Returns the settings of an evaluation; null where a request gives no value. */
export const usualEvaluation = (job, preset, periodS) => ({
  environments: 'paper-test', precision: 'float32', record: [], verify: false, best: null,
  measures: null, tolerance: null, displaced_starts: null, record_stride: 10,
  physics: physicsOf(false, periodS),
});

export function usualTraining(job, preset, periodS) {
  const isFinetune = job.trainingKind === 'finetune';
  const isPaper = preset === 'paper';
  const isShipped = preset === 'phototaxis' || preset === 'robust';
  const name = isShipped ? 'phototaxis'
    : isFinetune ? (isPaper ? 'paper-finetune' : 'finetune-cosine')
    : isPaper ? 'paper-pretrain' : 'one-cosine';
  const usual = learningOf(name);
  const sensor = job.parent ? null : 'inverse_sqrt';
  const settings = {
    steps: TRAINING_STEPS[job.trainingKind], batch: TRAINING_PRESETS[preset], seed: 1, sensor,
    environments: null, tasks: null, ...usual,
    physics: physicsOf(isPaper, job.parent ? periodS : randomPeriodS(isPaper)),
    validation: VALIDATION,
    checkpoint: { every_steps: 0, every_s: 60, keep: 3 },
  };
  if (isPaper) settings.adjoint_bound = 0;
  if (preset === 'robust') settings.vary = ROBUST;
  if (isShipped) {
    Object.assign(settings, { adjoint_bound: 8, adjoint_rule: 'restart' });
    settings.adam = { ...usual.adam, beta1: 0.8 };
  }
  return settings;
}

/**
 * Returns where robots learn by default: in the campaign's environments if one of them has
 * something that random ones lack. Undefined if that is not known.
 * @param {string|{count: number}} named
 * @param {any[]} [places] the environments, if they are loaded
 */
function usualWorlds(named, places) {
  if (named === 'paper-test') return 'random';
  const isOther = ({ task, damage, factors, drop_m: drop, terrain }) => task || damage ||
    factors || drop || (terrain && !['rough', 'flat'].includes(terrain.kind));
  return places?.length ? (places.some(isOther) ? 'environments' : 'random') : undefined;
}

/** @param {any[]} [places] the campaign's environments */
export function usualCampaign(job, preset, periodS, places) {
  const { mode } = job;
  const isPaper = preset === 'paper';
  const { population, ...generations } = CAMPAIGN_PRESETS[preset];
  const { workspace, selection, population: own, learning } = job.settings;
  const steps = CAMPAIGN_STEPS[mode] ?? 30;
  return {
    population, generations: generations[mode] ?? job.settings.generations, seed: 1,
    environments: 'paper-test', initial: 'random', workspace: [6, 6, 4],
    mutation: { share: 0.25, rate: 1 / workspace.reduce((a, b) => a * b, 1), growth: 1.025 },
    selection: { kind: 'truncation', ...SELECTIONS[selection.kind] },
    racing: job.settings.select_by ? 'off' : 'lossless', exclude_pretraining: mode !== 'study',
    collapse_share: 0.5, measures: [], select_by: null, aggregate: { kind: 'mean' },
    re_evaluate: null,
    physics: physicsOf(isPaper, job.controller ? periodS : randomPeriodS(isPaper)),
    learning: learning && {
      parent_steps: steps, child_steps: steps, batch: own,
      ...learningOf(mode === 'simultaneous' ? 'paper-simultaneous' : 'paper-finetune'),
      sensor: job.controller ? null : 'inverse_sqrt', checkpoint_every_s: 60,
      worlds: usualWorlds(job.settings.environments, places),
    },
  };
}
