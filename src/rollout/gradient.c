/* gradient.c: backpropagation through a whole reference rollout in bounded memory.
 *
 * The forward pass stores only the state at the start of every segment of about sqrt(n_steps)
 * steps, in whole control periods. The backward pass goes from the last segment to the first: it
 * runs the segment again on a tape, then traverses the tape in reverse, and computes the
 * parameters' gradient once per segment. A robot's gradient is summed in a separate buffer and
 * added to the result only if all of it is finite. */
#include "rollout/adjoint.h"
#include "rollout/scene.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

struct gradient {
  struct mo_reference reference;
  const struct mo_gradient_options *options;
  const struct mo_gradient_probe *probe;
  uint32_t segment;           /* steps per segment, in whole control periods; the last one may be
                                 shorter */
  size_t n_state;             /* doubles of a stored state: positions, velocities, outputs */
  double *memory;             /* of all arrays of doubles */
  double *states;             /* (segments + 1, n_state) at the start of each, and at the end */
  struct mo_step_tape *steps; /* (segment) */
  struct mo_controller_tape
      *control; /* (segment / control steps) copies of the tapes' network parts, in order of time */
  struct mo_adjoint adjoint;
  double *d_parameters; /* (n_parameters) of this robot */
  struct mo_goal goal;  /* if the task is not plain, only its scale is used */
  struct mo_gradient_counts counts;
};

static uint32_t segments(const struct gradient *g)
{
  const uint32_t n = g->reference.physics->scheme.n_steps;
  return n / g->segment + (n % g->segment != 0);
}

static void release(struct gradient *g)
{
  mo_reference_done(&g->reference);
  free(g->memory);
  free(g->steps);
  free(g->control);
}

/* Allocates everything except the reference. After a failure, release() frees what was
 * allocated. */
static int allocate(struct gradient *g)
{
  const struct mo_body *body = g->reference.body;
  const struct mo_controller *controller = g->reference.controller;
  const size_t n = (size_t)body->n_masses * 3;
  const size_t pass = mo_controller_tape_doubles(controller, body->n_springs);
  const uint32_t n_steps = g->reference.physics->scheme.n_steps,
                 period = g->reference.control_steps;
  g->n_state = 2 * n + body->n_springs;
  const uint32_t periods = ((uint32_t)ceil(sqrt((double)n_steps)) + period - 1) / period;
  g->segment = periods * period;
  const size_t states = (size_t)(segments(g) + 1) * g->n_state,
               step = 3 * n + 2 * (size_t)body->n_springs,
               tapes = g->segment * step + periods * pass;
  g->memory = calloc(states + tapes + 3 * n + 2 * (size_t)body->n_springs + controller->n_inputs +
                         controller->n_parameters,
                     sizeof(double));
  g->steps = calloc(g->segment, sizeof(*g->steps));
  g->control = calloc(periods, sizeof(*g->control));
  if (g->memory == NULL || g->steps == NULL || g->control == NULL)
    return MO_ERR_NO_MEMORY;
  double *memory = g->memory;
  for (uint32_t p = 0; p < periods; p++, memory += pass)
    g->control[p] = mo_controller_tape_place(controller, body->n_springs, memory);
  for (uint32_t s = 0; s < g->segment; s++, memory += step)
    g->steps[s] = (struct mo_step_tape){memory,
                                        memory + n,
                                        memory + 2 * n,
                                        memory + 3 * n,
                                        memory + 3 * n + body->n_springs,
                                        g->control[s / period]};
  g->states = g->memory + tapes;
  g->adjoint.d_position = g->states + states;
  g->adjoint.d_velocity = g->adjoint.d_position + n;
  g->adjoint.d_impulse = g->adjoint.d_velocity + n;
  g->adjoint.d_output = g->adjoint.d_impulse + n;
  g->adjoint.d_previous = g->adjoint.d_output + body->n_springs;
  g->adjoint.d_input = g->adjoint.d_previous + body->n_springs;
  g->d_parameters = g->adjoint.d_input + controller->n_inputs;
  return MO_OK;
}

/* Keeps the state at the start of each segment. */
static void keep_state(void *context, uint32_t step)
{
  struct gradient *g = context;
  const struct mo_reference *r = &g->reference;
  const size_t n = 3 * (size_t)r->body->n_masses;
  double *state = g->states + step / g->segment * g->n_state;
  if (step % g->segment != 0)
    return;
  memcpy(state, r->position_m, n * sizeof(double));
  memcpy(state + n, r->velocity_m_per_s, n * sizeof(double));
  memcpy(state + 2 * n, r->output, r->body->n_springs * sizeof(double));
}

/* Reruns steps first … first + n − 1, onto the tapes. */
static void replay(struct gradient *g, uint32_t first, uint32_t n)
{
  struct mo_reference *r = &g->reference;
  const size_t size = 3 * (size_t)r->body->n_masses;
  const double *state = g->states + first / g->segment * g->n_state;
  memcpy(r->position_m, state, size * sizeof(double));
  memcpy(r->velocity_m_per_s, state + size, size * sizeof(double));
  memcpy(r->output, state + 2 * size, r->body->n_springs * sizeof(double));
  for (uint32_t s = 0; s < n; s++) {
    r->tape = &g->steps[s];
    mo_reference_step(r, first + s);
  }
}

static double norm(const double *x, size_t n)
{
  double sum = 0;
  for (size_t i = 0; i < n; i++)
    sum += x[i] * x[i];
  return sqrt(sum);
}

/* Begins the backward pass of tasks other than plain ones. */
static void start_at_end(struct gradient *g)
{
  const struct mo_course *course = &g->reference.course;
  const struct mo_track *end = g->reference.tracks + course->n_periods;
  double d_com[3];
  mo_course_end_back(course, end - 1, end, g->reference.work_j, &g->adjoint.course, d_com);
  mo_adjoint_start_at(&g->reference, d_com, &g->adjoint);
}

/* Restarts the backward pass after step number `step`, before which the center of mass was at
 * com_m. */
static void restart(struct gradient *g, uint32_t step, const double com_m[3])
{
  const struct mo_reference *r = &g->reference;
  const uint32_t k = step / r->control_steps;
  double d_com[3];
  mo_course_restart(&r->course, k * r->control_steps * r->physics->scheme.dt_s, r->tracks + k,
                    com_m, g->options->restart_weight, &g->adjoint.course, d_com);
  mo_adjoint_start_at(r, d_com, &g->adjoint);
}

/* Applies the rule (clip or restart) to an adjoint after `steps` steps whose m is above the bound.
 * before_m: positions of the masses one step earlier. */
static void take_back(struct gradient *g, uint32_t steps, double m, const double *before_m)
{
  if (g->options->adjoint_rule == MO_ADJOINT_RESTART) {
    double com_m[3];
    mo_scene_com(before_m, g->reference.body->n_masses, com_m);
    if (g->reference.tracks != NULL)
      restart(g, steps - 1, com_m);
    else
      mo_adjoint_start(&g->reference, com_m, &g->goal, g->options->restart_weight, &g->adjoint);
    return;
  }
  const double scale = g->options->adjoint_bound / m;
  for (size_t i = 0; i < 3 * (size_t)g->reference.body->n_masses; i++) {
    g->adjoint.d_position[i] *= scale;
    g->adjoint.d_velocity[i] *= scale;
  }
}

/* Measures the adjoint of the state after `step` steps and limits it to the bound. Returns false if
 * it is not finite. */
static bool limit(struct gradient *g, uint32_t step, const double *before_m, bool *clipped)
{
  const size_t n = 3 * (size_t)g->reference.body->n_masses;
  double *dx = g->adjoint.d_position, *dv = g->adjoint.d_velocity;
  if (g->probe != NULL && g->probe->before != NULL)
    g->probe->before(g->probe->context, step, dx, dv);
  const double scale_m = g->goal.scale_m;
  const double x = scale_m * norm(dx, n), v = scale_m * MO_ADJOINT_RATE_PER_S * norm(dv, n);
  if (!isfinite(x) || !isfinite(v))
    return false;
  const double m = fmax(x, v), bound = g->options->adjoint_bound;
  g->counts.largest = fmax(g->counts.largest, m);
  if (bound > 0 && m > bound) {
    take_back(g, step, m, before_m);
    g->counts.clipped_steps++;
    *clipped = true;
  }
  if (g->probe != NULL && g->probe->after != NULL)
    g->probe->after(g->probe->context, step, dx, dv);
  return true;
}

/* Runs the backward pass. Returns false if the adjoint, or a parameter's gradient, is not
 * finite. */
static bool run_backward(struct gradient *g, const struct mo_outcome *outcome)
{
  const struct mo_reference *r = &g->reference;
  bool clipped = false;
  if (r->tracks != NULL)
    start_at_end(g);
  else
    mo_adjoint_start(r, outcome->com_end_m, &g->goal, 1.0, &g->adjoint);
  for (uint32_t k = segments(g); k-- > 0;) {
    const uint32_t first = k * g->segment;
    const uint32_t n = r->physics->scheme.n_steps - first < g->segment
                           ? r->physics->scheme.n_steps - first
                           : g->segment;
    replay(g, first, n);
    for (uint32_t s = n; s-- > 0;) {
      g->counts.steps++;
      if (!limit(g, first + s + 1, g->steps[s].position_m, &clipped)) {
        g->counts.clipped_robots += clipped;
        return false;
      }
      mo_adjoint_step(r, first + s, &g->steps[s], &g->adjoint);
    }
    mo_controller_accumulate(r->controller, r->body->spring_lattice, r->body->n_springs, g->control,
                             (n + r->control_steps - 1) / r->control_steps, g->d_parameters);
  }
  g->counts.clipped_robots += clipped;
  for (size_t i = 0; i < r->controller->n_parameters; i++)
    if (!isfinite(g->options->weight * g->d_parameters[i]))
      return false;
  return true;
}

void mo_gradient_counts_add(struct mo_gradient_counts *sum, const struct mo_gradient_counts *counts)
{
  sum->robots += counts->robots;
  sum->steps += counts->steps;
  sum->clipped_steps += counts->clipped_steps;
  sum->clipped_robots += counts->clipped_robots;
  sum->zeroed_robots += counts->zeroed_robots;
  sum->diverged_robots += counts->diverged_robots;
  sum->largest = fmax(sum->largest, counts->largest);
}

int mo_gradient_probed(const struct mo_body *body, const struct mo_controller *controller,
                       const struct mo_environment *environment, const struct mo_physics *physics,
                       const struct mo_gradient_options *options,
                       const struct mo_gradient_probe *probe, struct mo_outcome *outcome,
                       double *d_parameters, struct mo_gradient_counts *counts)
{
  if (controller == NULL)
    return MO_ERR_INVALID;
  int r = mo_gradient_options_check(options);
  if (r == MO_OK)
    r = mo_task_check_gradient(&environment->task, NULL);
  if (r < 0)
    return r;
  struct gradient g = {.options = options, .probe = probe, .counts = {.robots = 1}};
  r = mo_reference_init(&g.reference, body, controller, environment, physics);
  if (r < 0)
    return r;
  r = allocate(&g);
  if (r == MO_OK) {
    mo_reference_run(&g.reference, keep_state, &g, outcome);
    mo_reference_finish(&g.reference, NULL, outcome);
    g.goal = mo_goal_of(environment, outcome->com_start_m);
    if (g.reference.tracks != NULL)
      g.goal.scale_m = g.reference.course.scale_m;
    if (outcome->diverged_step != 0)
      g.counts.diverged_robots++;
    else if (!run_backward(&g, outcome))
      g.counts.zeroed_robots++;
    else
      for (size_t i = 0; i < controller->n_parameters; i++)
        d_parameters[i] += options->weight * g.d_parameters[i];
    if (counts != NULL)
      mo_gradient_counts_add(counts, &g.counts);
  }
  release(&g);
  return r;
}

int mo_gradient_reference(const struct mo_body *body, const struct mo_controller *controller,
                          const struct mo_environment *environment,
                          const struct mo_physics *physics,
                          const struct mo_gradient_options *options, struct mo_outcome *outcome,
                          double *d_parameters, struct mo_gradient_counts *counts)
{
  return mo_gradient_probed(body, controller, environment, physics, options, NULL, outcome,
                            d_parameters, counts);
}
