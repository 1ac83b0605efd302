/* state.c: states of rollouts: their memory, and whether a rollout can start from one. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "base/sha256.h"
#include "rollout/carve.h"
#include "rollout/physics.h"
#include "rollout/scene.h"
#include "rollout/window.h"
#include "world/environment.h"

/* ---- memory ---- */

static size_t lay_out(struct mo_state *state, char *base)
{
  struct carver carver = {base, 0};
  const size_t n = state->n_masses;
  state->position_m = carve(&carver, 3 * n, sizeof(double));
  state->position_rest_m = carve(&carver, 3 * n, sizeof(double));
  state->velocity_m_per_s = carve(&carver, 3 * n, sizeof(double));
  state->output = carve(&carver, state->n_springs, sizeof(double));
  state->contacts = carve(&carver, n, 1);
  state->cut = carve(&carver, state->n_springs, 1);
  state->inverted = carve(&carver, state->n_voxels, 1);
  return carver.used;
}

int mo_state_create(struct mo_state *state, uint32_t n_masses, uint32_t n_springs,
                    uint32_t n_voxels)
{
  struct mo_state made = *state;
  made.n_masses = n_masses;
  made.n_springs = n_springs;
  made.n_voxels = n_voxels;
  const size_t bytes = lay_out(&made, NULL);
  char *base = aligned_alloc(MO_ALIGNMENT, bytes > 0 ? bytes : MO_ALIGNMENT);
  if (base == NULL)
    return MO_ERR_NO_MEMORY;
  memset(base, 0, bytes);
  lay_out(&made, base);
  *state = made;
  return MO_OK;
}

void mo_state_free(struct mo_state *state)
{
  if (state == NULL)
    return;
  free(state->position_m); /* the first array */
  *state = (struct mo_state){0};
}

/* ---- what must not change ---- */

static void hash(const struct mo_fields *fields, unsigned version, const void *settings,
                 uint8_t bytes[MO_STATE_KEY_BYTES])
{
  uint8_t packed[sizeof(struct mo_physics)];
  struct mo_sha256 of;
  mo_fields_pack(fields, version, settings, packed);
  mo_sha256_of(packed, mo_fields_packed_bytes(fields, version), &of);
  memcpy(bytes, of.bytes, MO_STATE_KEY_BYTES);
}

static void hash_environment(const struct mo_environment *environment,
                             uint8_t bytes[MO_STATE_KEY_BYTES])
{
  struct mo_sha256 of;
  mo_environment_digest(environment, &of);
  memcpy(bytes, of.bytes, MO_STATE_KEY_BYTES);
}

static void hash_task(const struct mo_environment *environment, uint8_t bytes[MO_STATE_KEY_BYTES])
{
  struct mo_environment task = mo_environment_defaults;
  task.task = environment->task;
  hash_environment(&task, bytes);
}

void mo_window_identify(const struct mo_environment *environment, const struct mo_physics *physics,
                        struct mo_state *state)
{
  struct mo_environment terrain = mo_environment_defaults;
  struct mo_physics lasting = *physics;
  memcpy(terrain.terrain_heights_m, environment->terrain_heights_m,
         sizeof(terrain.terrain_heights_m));
  terrain.n_profile = environment->n_profile;
  terrain.profile_spacing_m = environment->profile_spacing_m;
  terrain.grid = environment->grid;
  terrain.factors = environment->factors;
  lasting.scheme.n_steps = 1;
  lasting.drop_height_m = 0;
  mo_fields_clear_minus(&mo_physics_fields, &lasting);
  hash_environment(&terrain, state->terrain_key);
  hash_task(environment, state->task_key);
  hash(&mo_physics_fields, mo_physics_version(&lasting), &lasting, state->physics_key);
}

/* ---- checks ---- */

static bool is_same(const uint8_t a[MO_STATE_KEY_BYTES], const uint8_t b[MO_STATE_KEY_BYTES])
{
  return memcmp(a, b, MO_STATE_KEY_BYTES) == 0;
}

static bool continues(const struct mo_state *from, const struct mo_environment *environment)
{
  uint8_t task_key[MO_STATE_KEY_BYTES];
  hash_task(environment, task_key);
  return is_same(from->task_key, task_key);
}

static bool is_within(const double *numbers, size_t n, double limit)
{
  for (size_t i = 0; i < n; i++)
    if (!(fabs(numbers[i]) <= limit)) /* false for NaN */
      return false;
  return true;
}

static int check_numbers(const struct mo_state *s, struct mo_message *message)
{
  const size_t n = 3 * (size_t)s->n_masses;
  if (!is_within(s->position_m, n, MO_STATE_POSITION_MAX_M))
    return mo_fail(message, MO_ERR_RANGE, "position components must be within ±%g m",
                   MO_STATE_POSITION_MAX_M);
  if (!is_within(s->position_rest_m, n, 1e-6))
    return mo_fail(
        message, MO_ERR_RANGE,
        "the remainders of positions must be at most 1e-6 m; send the state back unchanged");
  if (!is_within(s->velocity_m_per_s, n, MO_DIVERGED_SPEED_M_PER_S))
    return mo_fail(message, MO_ERR_RANGE, "velocity components must be within ±%g m/s",
                   MO_DIVERGED_SPEED_M_PER_S);
  if (!is_within(s->output, s->n_springs, 1.0001))
    return mo_fail(message, MO_ERR_RANGE, "controller outputs must be between −1 and 1");
  return MO_OK;
}

static int check_tally(const struct mo_state *s, const struct mo_environment *environment,
                       bool goes_on, struct mo_message *message)
{
  const struct mo_state_tally *t = &s->tally;
  const double numbers[] = {t->sum,    t->length_m,     t->before_m,      t->along_m,
                            t->peak_m, t->soft,         t->path_m,        t->height_sum_m,
                            t->turns,  t->pull_m2,      t->peak_height_m, t->work_j,
                            t->strain, t->strain_square};
  const uint64_t counts[] = {t->air_steps, t->hops, t->contacts, t->front_2, t->left_2};
  const uint32_t n_points = environment->task.guide.n_points;
  bool good = is_within(numbers, sizeof(numbers) / sizeof(*numbers), MO_STATE_SUM_MAX) &&
              is_within(t->sums, 5, MO_STATE_SUM_MAX) &&
              is_within(t->com_start_m, 3, MO_STATE_POSITION_MAX_M) &&
              is_within(t->com_m, 3, MO_STATE_POSITION_MAX_M) &&
              is_within(t->seen_com_m, 3, MO_STATE_POSITION_MAX_M) &&
              is_within(t->facing, 2, 1.0001) && is_within(t->turn, 2, MO_STATE_SUM_MAX) &&
              is_within(t->start_turn, 2, MO_STATE_SUM_MAX) && t->begun_step < s->step &&
              t->turns == trunc(t->turns) && t->n_heights <= s->step;
  for (size_t i = 0; i < sizeof(counts) / sizeof(*counts); i++)
    good = good && (double)counts[i] <= MO_STATE_SUM_MAX;
  if (goes_on)
    good = good && t->leg < (n_points > 0 ? n_points : 1);
  return good ? MO_OK
              : mo_fail(message, MO_ERR_RANGE,
                        "its tally cannot occur in a rollout; send the state back unchanged");
}

int mo_window_check(const struct mo_state *state, const struct mo_body *body,
                    const struct mo_environment *environment, const struct mo_physics *physics,
                    enum mo_precision precision, unsigned observations, struct mo_message *message)
{
  const struct mo_state *s = state;
  struct mo_state here;
  mo_window_identify(environment, physics, &here);
  if (s->n_masses != body->n_masses || s->n_springs != body->n_springs ||
      s->n_voxels != body->n_voxels)
    return mo_fail(message, MO_ERR_INVALID,
                   "it is for a body with %u masses and %u springs, but this one has %u and %u; "
                   "start the new body without a state",
                   s->n_masses, s->n_springs, body->n_masses, body->n_springs);
  if (s->step == 0 || s->step > UINT32_MAX - MO_STEPS_MAX ||
      s->step * physics->scheme.dt_s > MO_STATE_TIME_MAX_S * (1 + 1e-9))
    return mo_fail(message, MO_ERR_RANGE,
                   "its time must be above 0 and at most %g s; start again without a state",
                   MO_STATE_TIME_MAX_S);
  if (s->precision != precision)
    return mo_fail(
        message, MO_ERR_INVALID,
        "it comes from a rollout in %s; request that precision, or start without a state",
        s->precision == MO_FLOAT64 ? "float64" : "float32");
  if (!is_same(s->physics_key, here.physics_key))
    return mo_fail(
        message, MO_ERR_INVALID,
        "its physics differ from those of this request; only n_steps and drop_height_m may change, "
        "and the controller's control period must be the same; start without a state");
  if (!is_same(s->terrain_key, here.terrain_key))
    return mo_fail(message, MO_ERR_INVALID,
                   "its terrain or factors differ from those of the environment; only the light, "
                   "the task, the damage and drop_m may change; start a new world without a state");
  const int status = check_numbers(s, message);
  if (status != MO_OK)
    return status;
  const bool goes_on = is_same(s->task_key, here.task_key);
  if (goes_on && (observations & ~s->tally.observed) != 0)
    return mo_fail(message, MO_ERR_INVALID,
                   "its tally lacks numbers that the measures of this rollout need; send the state "
                   "back unchanged, and request the same measures in every window");
  return check_tally(s, environment, goes_on, message);
}

int mo_state_check(const struct mo_state *state, const struct mo_body *body,
                   const struct mo_environment *environment, const struct mo_physics *physics,
                   enum mo_precision precision, struct mo_message *message)
{
  return mo_window_check(state, body, environment, physics, precision,
                         mo_observations_for(&environment->task, NULL), message);
}

/* ---- a window ---- */

struct mo_window mo_window_of(const struct mo_scheme *scheme, const struct mo_state *from)
{
  /* A control period longer than the rollout is shortened to its length, so the number of steps of
   * the whole rollout is needed. */
  struct mo_scheme whole = *scheme;
  const uint32_t first = from != NULL ? from->step : 0;
  whole.n_steps += first;
  return (struct mo_window){first, whole.n_steps, mo_control_steps(&whole)};
}

/* Returns the number of instants after step `begun`: starts of control periods, and the end. */
static uint32_t periods_of(const struct mo_window *window, uint32_t begun)
{
  const uint32_t p = window->control_steps;
  return window->end_step / p + (window->end_step % p != 0) - begun / p;
}

uint32_t mo_window_begin(const struct mo_window *window, const struct mo_state *from,
                         const struct mo_environment *environment, const double com_m[3],
                         double com_start_m[3])
{
  const bool goes_on = from != NULL && continues(from, environment);
  memcpy(com_start_m, goes_on ? from->tally.com_start_m : com_m, 3 * sizeof(double));
  return goes_on ? from->tally.begun_step : window->first_step;
}

void mo_window_course(const struct mo_window *window, const struct mo_state *from, uint32_t begun,
                      const struct mo_environment *environment, const struct mo_scheme *scheme,
                      const double com_start_m[3], struct mo_course *course, struct mo_track *track)
{
  struct mo_scheme since = *scheme;
  since.n_steps = window->end_step - begun;
  mo_course_begin(course, environment, &since, com_start_m, track);
  course->n_periods = periods_of(window, begun);
  if (begun == window->first_step)
    return;
  const struct mo_state_tally *t = &from->tally;
  *track = (struct mo_track){.sum = t->sum,
                             .facing = {t->facing[0], t->facing[1]},
                             .length_m = t->length_m,
                             .before_m = t->before_m,
                             .along_m = t->along_m,
                             .leg = t->leg,
                             .tally = {.peak_m = t->n_heights > 0 ? t->peak_m : -(double)INFINITY,
                                       .soft = t->soft,
                                       .n_heights = t->n_heights}};
  memcpy(track->com_m, t->com_m, sizeof(track->com_m));
  memcpy(track->tally.sums, t->sums, sizeof(track->tally.sums));
}

/* Computes the position of the light when the tally began. */
static void first_light(const struct mo_environment *environment, const struct mo_scheme *scheme,
                        const double com_start_m[3], double light_m[3])
{
  struct mo_course course;
  struct mo_track track;
  if (mo_task_is_plain(&environment->task)) {
    mo_scene_light(environment, light_m);
    return;
  }
  mo_course_begin(&course, environment, scheme, com_start_m, &track);
  mo_course_light(&course, 0, &track, light_m);
}

void mo_window_observer(const struct mo_window *window, const struct mo_state *from, uint32_t begun,
                        const struct mo_body *body, const struct mo_environment *environment,
                        const struct mo_physics *physics, const double com_start_m[3],
                        struct mo_observer *observer)
{
  struct mo_physics since = *physics;
  struct mo_observer *o = observer;
  double light_m[3];
  first_light(environment, &physics->scheme, com_start_m, light_m);
  since.scheme.n_steps = window->end_step - begun;
  mo_observer_begin(o, body, environment, &since, com_start_m, light_m);
  o->n_periods = periods_of(window, begun);
  if (begun == window->first_step)
    return;
  const struct mo_state_tally *t = &from->tally;
  memcpy(o->start_turn, t->start_turn, sizeof(o->start_turn));
  memcpy(o->last.com_m, t->seen_com_m, sizeof(o->last.com_m));
  memcpy(o->last.turn, t->turn, sizeof(o->last.turn));
  o->path_m = t->path_m;
  o->height_sum_m = t->height_sum_m;
  o->peak_height_m = t->peak_height_m;
  o->turns = (int64_t)t->turns;
  o->air_steps = t->air_steps;
  o->hops = t->hops;
  o->contacts = t->contacts;
  o->front_2 = t->front_2;
  o->left_2 = t->left_2;
  o->work_j = t->work_j;
  o->strain = t->strain;
  o->inverted = t->inverted_max;
}

void mo_window_save_track(const struct mo_track *track, struct mo_state_tally *tally)
{
  memcpy(tally->com_m, track->com_m, sizeof(tally->com_m));
  memcpy(tally->sums, track->tally.sums, sizeof(tally->sums));
  memcpy(tally->facing, track->facing, sizeof(tally->facing));
  tally->sum = track->sum;
  tally->length_m = track->length_m;
  tally->before_m = track->before_m;
  tally->along_m = track->along_m;
  tally->leg = track->leg;
  tally->n_heights = track->tally.n_heights;
  tally->peak_m = track->tally.n_heights > 0 ? track->tally.peak_m : 0;
  tally->soft = track->tally.soft;
}

void mo_window_save_observer(const struct mo_observer *observer, unsigned observed,
                             struct mo_state_tally *tally)
{
  const struct mo_observer *o = observer;
  struct mo_state_tally *t = tally;
  t->observed = observed;
  if ((observed & MO_OBSERVE_MOTION) != 0) {
    memcpy(t->start_turn, o->start_turn, sizeof(t->start_turn));
    memcpy(t->seen_com_m, o->last.com_m, sizeof(t->seen_com_m));
    memcpy(t->turn, o->last.turn, sizeof(t->turn));
    t->path_m = o->path_m;
    t->height_sum_m = o->height_sum_m;
    t->peak_height_m = o->peak_height_m;
    t->turns = (double)o->turns;
  }
  if ((observed & MO_OBSERVE_AIR) != 0) {
    t->air_steps = o->air_steps;
    t->hops = o->hops;
  }
  if ((observed & MO_OBSERVE_CONTACTS) != 0) {
    t->contacts = o->contacts;
    t->front_2 = o->front_2;
    t->left_2 = o->left_2;
  }
  if ((observed & MO_OBSERVE_VOXELS) != 0)
    t->inverted_max = o->inverted;
}
