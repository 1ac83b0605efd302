/* reference.c: the rollout in plain float64 C, step by step as in docs/model.md. It is the
 * reference for every faster path, so it prefers readability to speed; all sums run in index
 * order. */
#include "rollout/reference.h"

#include "rollout/contact.h"
#include "rollout/damage.h"
#include "rollout/reference_measures.h"
#include "rollout/scene.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

static double sense(enum mo_sensor sensor, double distance_m)
{
  if (sensor == MO_SENSOR_INVERSE_SQUARE)
    return 1.0 / (distance_m * distance_m + 1e-4);
  return 1.0 / (sqrt(distance_m + 1e-8) + 1e-8);
}

/* Writes the light at each mass, minus the body's mean, to the inputs at the masses' lattice
 * places. */
static void sense_light(const struct mo_reference *r, double *input)
{
  const struct mo_body *body = r->body;
  double mean = 0;
  for (uint32_t i = 0; i < body->n_masses; i++) {
    const double *p = r->position_m + 3 * (size_t)i;
    const double d[3] = {p[0] - r->light_m[0], p[1] - r->light_m[1], p[2] - r->light_m[2]};
    const double light =
        sense(r->controller->sensor, sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]));
    input[body->mass_lattice[i]] = light;
    mean += light;
  }
  mean /= body->n_masses;
  for (uint32_t i = 0; i < body->n_masses; i++)
    input[body->mass_lattice[i]] -= mean;
}

void mo_reference_light(const struct mo_reference *r, uint32_t step, double light_m[3])
{
  if (r->tracks == NULL)
    memcpy(light_m, r->light_m, sizeof(r->light_m));
  else
    mo_course_light(&r->course, (step - r->begun) * r->physics->scheme.dt_s,
                    r->tracks + (step / r->control_steps - r->first_track), light_m);
}

/* Sets the track of an instant number k > 0 of `tracks`, at time t_s, from the positions. */
static void advance(struct mo_reference *r, uint32_t k, double t_s)
{
  double com_m[3];
  mo_scene_com(r->position_m, r->body->n_masses, com_m);
  r->tracks[k] = r->tracks[k - 1];
  mo_course_advance(&r->course, t_s, com_m, r->tracks + k);
}

/* Moves the light at the start of a control period. */
static void guide(struct mo_reference *r, uint32_t step)
{
  if (step > r->begun)
    advance(r, step / r->control_steps - r->first_track,
            (step - r->begun) * r->physics->scheme.dt_s);
  mo_reference_light(r, step, r->light_m);
}

/* Computes the activations of the body's springs at the start of step `step` (from 0). */
static void control(const struct mo_reference *r, uint32_t step)
{
  struct mo_controller_tape *tape = &r->tape->control;
  sense_light(r, tape->input);
  const double t = step * r->physics->scheme.dt_s;
  for (int k = 0; k < MO_CPG_INPUTS; k++)
    tape->input[r->controller->n_masses + (uint32_t)k] =
        sin(MO_CPG_RAD_PER_S * t + 2.0 * M_PI * k / MO_CPG_INPUTS);
  mo_controller_forward(r->controller, r->body->spring_lattice, r->body->n_springs, tape);
}

bool mo_reference_blends(const struct mo_reference *r, uint32_t step)
{
  return r->physics->scheme.integrator == MO_INTEGRATOR_SPLIT && step > 0 &&
         step % r->control_steps == 0;
}

/* Adds the work of the actuators at the start of a control period: the energy that each spring
 * gains when new outputs replace the previous ones, if it gains any. */
static void work(struct mo_reference *r, uint32_t step)
{
  const struct mo_body *body = r->body;
  const struct mo_constants constants = mo_scene_constants(r->environment, r->physics);
  for (uint32_t s = 0; s < body->n_springs; s++) {
    if (mo_damage_lasts(r->cut, r->cut_step, step, s))
      continue;
    const double *a = r->position_m + 3 * (size_t)body->spring_a[s],
                 *b = r->position_m + 3 * (size_t)body->spring_b[s], rest = body->spring_rest_m[s];
    const double d[3] = {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
    const double length = sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
    const double before = length - rest * (1 + constants.actuation * r->tape->previous[s]),
                 after = length - rest * (1 + constants.actuation * r->output[s]);
    r->work_j += 0.5 * constants.stiffness_n_per_m * fmax(after * after - before * before, 0);
  }
}

/* Sets the activations with which the springs pull. */
static void activate(struct mo_reference *r, uint32_t step)
{
  const bool blends = mo_reference_blends(r, step);
  for (uint32_t s = 0; s < r->body->n_springs; s++) {
    const double output = r->tape->control.output[s];
    r->tape->activation[s] = blends ? 0.5 * (r->output[s] + output) : output;
    r->tape->previous[s] = r->output[s];
    r->output[s] = output;
  }
}

/* Computes the impulses of all springs over one step. */
static void pull_springs(struct mo_reference *r, uint32_t step)
{
  const struct mo_body *body = r->body;
  const struct mo_scheme *scheme = &r->physics->scheme;
  const struct mo_constants constants = mo_scene_constants(r->environment, r->physics);
  memset(r->impulse_n_s, 0, (size_t)body->n_masses * 3 * sizeof(double));
  for (uint32_t s = 0; s < body->n_springs; s++) {
    if (mo_damage_lasts(r->cut, r->cut_step, step, s))
      continue;
    const size_t a = 3 * (size_t)body->spring_a[s], b = 3 * (size_t)body->spring_b[s];
    double d[3];
    for (int axis = 0; axis < 3; axis++)
      d[axis] = r->position_m[a + axis] - r->position_m[b + axis];
    const double length = sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
    double rest = body->spring_rest_m[s];
    if (r->controller != NULL)
      rest *= 1.0 + constants.actuation * r->tape->activation[s];
    const double pull =
        scheme->dt_s * constants.stiffness_n_per_m * (length - rest) / (length + 1e-8);
    for (int axis = 0; axis < 3; axis++) {
      r->impulse_n_s[a + axis] -= pull * d[axis];
      r->impulse_n_s[b + axis] += pull * d[axis];
    }
  }
}

struct mo_kick mo_reference_kick(const struct mo_reference *r, const struct mo_constants *constants,
                                 uint32_t step)
{
  const struct mo_scheme *scheme = &r->physics->scheme;
  const double decay = exp(-constants->drag_per_s * scheme->dt_s);
  return step == 0 ? mo_kick_first(scheme, constants, decay) : mo_kick_of(scheme, constants, decay);
}

static void move_masses(struct mo_reference *r, uint32_t step)
{
  const struct mo_scheme *scheme = &r->physics->scheme;
  const struct mo_constants constants = mo_scene_constants(r->environment, r->physics);
  const struct mo_kick kick = mo_reference_kick(r, &constants, step);
  for (uint32_t i = 0; i < r->body->n_masses; i++) {
    double *v = r->velocity_m_per_s + 3 * (size_t)i, *a = r->tape->acceleration + 3 * (size_t)i;
    for (int axis = 0; axis < 3; axis++) {
      const double impulse = r->impulse_n_s[3 * (size_t)i + axis];
      v[axis] = kick.keep * v[axis] + kick.push * impulse / constants.mass_kg;
      a[axis] = impulse / (constants.mass_kg * scheme->dt_s);
    }
    v[2] -= kick.fall;
    a[2] -= constants.gravity_m_per_s2;
    memcpy(r->tape->velocity_m_per_s + 3 * (size_t)i, v, 3 * sizeof(double));
    r->contacts[i] = scheme->integrator == MO_INTEGRATOR_SPLIT
                         ? mo_contact_split(scheme, &constants, r->environment, r->highest_m, a,
                                            r->position_m + 3 * (size_t)i, v)
                         : mo_contact_move(scheme, &constants, r->environment, r->highest_m,
                                           r->position_m + 3 * (size_t)i, v);
  }
}

/* Checks that everything is finite and nothing is faster than MO_DIVERGED_SPEED_M_PER_S. */
static bool is_sane(const struct mo_reference *r)
{
  for (uint32_t i = 0; i < r->body->n_masses; i++) {
    const double *p = r->position_m + 3 * (size_t)i, *v = r->velocity_m_per_s + 3 * (size_t)i;
    if (!(v[0] * v[0] + v[1] * v[1] + v[2] * v[2] <=
          MO_DIVERGED_SPEED_M_PER_S * MO_DIVERGED_SPEED_M_PER_S) ||
        !isfinite(p[0] + p[1] + p[2]))
      return false;
  }
  return true;
}

bool mo_reference_step(struct mo_reference *r, uint32_t step)
{
  const size_t bytes = (size_t)r->body->n_masses * 3 * sizeof(double);
  memcpy(r->tape->position_m, r->position_m, bytes);
  if (r->tracks != NULL && step % r->control_steps == 0)
    guide(r, step);
  if (r->controller != NULL && step % r->control_steps == 0)
    control(r, step);
  if (r->controller != NULL)
    activate(r, step);
  if (r->works && r->controller != NULL && step > 0 && step % r->control_steps == 0)
    work(r, step);
  pull_springs(r, step);
  move_masses(r, step);
  if (is_sane(r))
    return true;
  memcpy(r->position_m, r->tape->position_m, bytes);
  return false;
}

/* Sets the positions and everything else that a state contains. */
static void take(struct mo_reference *r, const struct mo_state *from)
{
  const size_t n = 3 * (size_t)r->body->n_masses;
  memcpy(r->position_m, from->position_m, n * sizeof(double));
  memcpy(r->velocity_m_per_s, from->velocity_m_per_s, n * sizeof(double));
  memcpy(r->output, from->output, r->body->n_springs * sizeof(double));
  if (r->controller != NULL)
    memcpy(r->own.control.output, from->output, r->body->n_springs * sizeof(double));
  memcpy(r->contacts, from->contacts, r->body->n_masses);
  for (uint32_t s = 0; s < r->body->n_springs; s++)
    if (from->cut[s] != 0)
      r->cut[s] = 2;
}

/* Begins or continues the tally and the task, from the positions. */
static void begin(struct mo_reference *r, const struct mo_state *from)
{
  const uint32_t first = r->window.first_step;
  double com_m[3];
  mo_scene_com(r->position_m, r->body->n_masses, com_m);
  r->begun = mo_window_begin(&r->window, from, r->environment, com_m, r->com_start_m);
  r->first_track = first / r->control_steps;
  if (r->begun < first && first % r->control_steps == 0)
    r->first_track--; /* the state is before the instant at the start of the window */
  if (from != NULL && r->begun < first)
    r->work_j = from->tally.work_j;
  if (r->tracks != NULL)
    mo_window_course(&r->window, from, r->begun, r->environment, &r->physics->scheme,
                     r->com_start_m, &r->course, r->tracks);
}

int mo_reference_init(struct mo_reference *reference, const struct mo_body *body,
                      const struct mo_controller *controller,
                      const struct mo_environment *environment, const struct mo_physics *physics)
{
  return mo_reference_init_from(reference, body, controller, environment, physics, NULL);
}

int mo_reference_init_from(struct mo_reference *reference, const struct mo_body *body,
                           const struct mo_controller *controller,
                           const struct mo_environment *environment,
                           const struct mo_physics *physics, const struct mo_state *from)
{
  const struct mo_window window = mo_window_of(&physics->scheme, from);
  const uint32_t control_steps = window.control_steps;
  if (control_steps == 0 ||
      (controller != NULL && !mo_workspace_equal(controller->workspace, body->workspace)))
    return MO_ERR_INVALID;
  const size_t n = 3 * (size_t)body->n_masses,
               tape =
                   controller != NULL ? mo_controller_tape_doubles(controller, body->n_springs) : 0,
               bytes =
                   ((size_t)body->n_masses + body->n_springs + sizeof(double) - 1) / sizeof(double),
               periods = (physics->scheme.n_steps + (size_t)control_steps - 1) / control_steps;
  const bool plain = mo_task_is_plain(&environment->task);
  struct mo_track *tracks = plain ? NULL : calloc(periods + 2, sizeof(*tracks));
  double *memory = calloc(6 * n + tape + bytes + 3 * (size_t)body->n_springs, sizeof(double));
  if (memory == NULL || (!plain && tracks == NULL)) {
    free(memory);
    free(tracks);
    return MO_ERR_NO_MEMORY;
  }
  *reference = (struct mo_reference){.body = body,
                                     .controller = controller,
                                     .environment = environment,
                                     .physics = physics,
                                     .control_steps = control_steps,
                                     .window = window,
                                     .tracks = tracks,
                                     .works = mo_task_needs_work(&environment->task),
                                     .highest_m = mo_terrain_highest(environment),
                                     .position_m = memory,
                                     .velocity_m_per_s = memory + n,
                                     .impulse_n_s = memory + 2 * n,
                                     .output = memory + 6 * n,
                                     .tape = &reference->own};
  memory += 3 * n;
  reference->own = (struct mo_step_tape){.position_m = memory,
                                         .velocity_m_per_s = memory + n,
                                         .acceleration = memory + 2 * n,
                                         .activation = memory + 3 * n + body->n_springs,
                                         .previous = memory + 3 * n + 2 * (size_t)body->n_springs};
  memory += 3 * n + 3 * (size_t)body->n_springs;
  reference->contacts = (uint8_t *)(memory + tape);
  reference->cut = reference->contacts + body->n_masses;
  reference->cut_step = mo_damage_step(environment, &physics->scheme);
  mo_damage_mark(environment, body, reference->cut);
  if (controller != NULL)
    reference->own.control = mo_controller_tape_place(controller, body->n_springs, memory);
  mo_scene_light(environment, reference->light_m);
  if (from != NULL)
    take(reference, from);
  else
    mo_scene_start(body, environment, physics, reference->position_m);
  begin(reference, from);
  return MO_OK;
}

/* Returns the index of the track at the end of a window. */
static uint32_t last_track(const struct mo_reference *r)
{
  const uint32_t end = r->window.end_step, p = r->control_steps;
  return end / p + (end % p != 0) - r->first_track;
}

void mo_reference_save(const struct mo_reference *r, struct mo_state *to)
{
  const size_t n = 3 * (size_t)r->body->n_masses;
  mo_window_identify(r->environment, r->physics, to);
  to->precision = MO_FLOAT64;
  to->step = r->window.end_step;
  memcpy(to->position_m, r->position_m, n * sizeof(double));
  memset(to->position_rest_m, 0, n * sizeof(double));
  memcpy(to->velocity_m_per_s, r->velocity_m_per_s, n * sizeof(double));
  memset(to->output, 0, r->body->n_springs * sizeof(double));
  if (r->controller != NULL)
    memcpy(to->output, r->output, r->body->n_springs * sizeof(double));
  memcpy(to->contacts, r->contacts, r->body->n_masses);
  memset(to->inverted, 0, r->body->n_voxels);
  for (uint32_t s = 0; s < r->body->n_springs; s++)
    to->cut[s] = mo_damage_lasts(r->cut, r->cut_step, r->window.end_step - 1, s);
  const struct mo_constants constants = mo_scene_constants(r->environment, r->physics);
  const double scale = 2 * constants.stiffness_n_per_m * constants.actuation;
  to->tally = (struct mo_state_tally){
      .begun_step = r->begun, .pull_m2 = scale > 0 ? r->work_j / scale : 0, .work_j = r->work_j};
  memcpy(to->tally.com_start_m, r->com_start_m, sizeof(to->tally.com_start_m));
  if (r->tracks != NULL)
    mo_window_save_track(r->tracks + (last_track(r) - 1), &to->tally);
}

void mo_reference_done(struct mo_reference *reference)
{
  free(reference->position_m);
  free(reference->tracks);
  *reference = (struct mo_reference){0};
}

void mo_reference_run(struct mo_reference *r, void (*visit)(void *context, uint32_t step),
                      void *context, struct mo_outcome *outcome)
{
  const uint32_t first = r->window.first_step;
  *outcome = (struct mo_outcome){0};
  memcpy(outcome->com_start_m, r->com_start_m, sizeof(outcome->com_start_m));
  visit(context, first);
  for (uint32_t step = first; step < r->window.end_step; step++) {
    if (outcome->diverged_step == 0 && !mo_reference_step(r, step))
      outcome->diverged_step = (int32_t)(step - first) + 1;
    visit(context, step + 1);
  }
  mo_scene_com(r->position_m, r->body->n_masses, outcome->com_end_m);
  if (r->tracks != NULL)
    advance(r, last_track(r), r->course.end_s);
}

void mo_reference_finish(const struct mo_reference *r, const double *measures,
                         struct mo_outcome *outcome)
{
  const struct mo_observed observed = {.work_j = r->work_j, .measures = measures};
  if (r->tracks == NULL)
    mo_scene_finish(outcome, r->environment);
  else
    mo_course_finish(&r->course, r->tracks + last_track(r), &observed, outcome);
}

struct recorder {
  struct mo_reference reference;
  const struct mo_recording *recording; /* NULL: none */
  struct mo_reference_measures measures;
  const struct mo_outcome *outcome;
};

static void record(const struct recorder *recorder, uint32_t step)
{
  const struct mo_reference *r = &recorder->reference;
  const struct mo_recording *recording = recorder->recording;
  const uint32_t local = step - r->window.first_step;
  if (recording == NULL || recording->stride == 0 || local % recording->stride != 0)
    return;
  const size_t frame = local / recording->stride, n = (size_t)r->body->n_masses * 3;
  if (recording->com_m != NULL)
    mo_scene_com(r->position_m, r->body->n_masses, recording->com_m + 3 * frame);
  if (recording->mass_m != NULL)
    for (size_t k = 0; k < n; k++)
      recording->mass_m[frame * n + k] = (float)r->position_m[k];
  const bool moves = step > 0 && recorder->outcome->diverged_step == 0;
  const uint32_t n_masses = r->body->n_masses, n_springs = r->body->n_springs;
  if (recording->actuation != NULL)
    for (uint32_t s = 0; s < n_springs; s++)
      recording->actuation[frame * n_springs + s] =
          moves && r->controller != NULL ? mo_scene_actuation(r->tape->control.output[s]) : 0;
  if (recording->contacts != NULL)
    for (uint32_t m = 0; m < n_masses; m++)
      recording->contacts[frame * n_masses + m] = moves && r->contacts[m];
}

static void look(void *context, uint32_t step)
{
  struct recorder *recorder = context;
  record(recorder, step);
  if (step > recorder->reference.window.first_step && recorder->outcome->diverged_step == 0)
    mo_reference_observe(&recorder->measures, &recorder->reference, step - 1);
}

int mo_rollout_reference_window(const struct mo_body *body, const struct mo_controller *controller,
                                const struct mo_environment *environment,
                                const struct mo_physics *physics, const struct mo_states *states,
                                const struct mo_recording *recording,
                                const struct mo_measuring *measuring, struct mo_outcome *outcome)
{
  const struct mo_state *from = states != NULL ? states->from : NULL;
  struct mo_state *to = states != NULL ? states->to : NULL;
  struct recorder recorder = {.recording = recording, .outcome = outcome};
  struct mo_reference_measures *measures = &recorder.measures;
  const unsigned needs = mo_observations_for(&environment->task, measuring);
  int r = from != NULL
              ? mo_window_check(from, body, environment, physics, from->precision, needs, NULL)
              : MO_OK;
  if (r == MO_OK)
    r = mo_reference_init_from(&recorder.reference, body, controller, environment, physics, from);
  if (r < 0)
    return r;
  r = mo_reference_measures_init(measures, &recorder.reference, from, measuring);
  if (r == MO_OK) {
    mo_reference_run(&recorder.reference, look, &recorder, outcome);
    if (to != NULL) {
      mo_reference_save(&recorder.reference, to);
      mo_reference_measures_save(measures, needs, to);
      to->step = outcome->diverged_step == 0 ? to->step : 0;
    }
    const double *observed = mo_reference_measures_finish(measures, &recorder.reference, outcome);
    mo_reference_finish(&recorder.reference, observed, outcome);
  }
  mo_reference_measures_done(measures);
  mo_reference_done(&recorder.reference);
  return r;
}

int mo_rollout_reference(const struct mo_body *body, const struct mo_controller *controller,
                         const struct mo_environment *environment, const struct mo_physics *physics,
                         const struct mo_recording *recording, const struct mo_measuring *measuring,
                         struct mo_outcome *outcome)
{
  return mo_rollout_reference_window(body, controller, environment, physics, NULL, recording,
                                     measuring, outcome);
}
