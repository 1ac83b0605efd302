/* What a device observes of rows that are measured, compiled for the host: poses bit by bit against
 * src/rollout/measuring.c, and whole rollouts, whose recordings are observed as a device would,
 * against the reference. */
#include "../make.h"
#include "../rollout/task-cases.h"

#include "compute/cuda/observe.cuh"
#include "compute/cuda/plan.h"
#include "rollout/measuring.h"

enum { ROBOTS = 2 * TASK_CASES, POSES = 2000, PERIOD = 4, STEPS = 120 };

static void poses(void)
{
  struct mo_random dice;
  const struct mo_physics physics = mo_default_physics();
  const struct mo_lattice *lattice = make_lattice(MO_DEFAULT_WORKSPACE);
  const uint64_t bits[MO_DEFAULT_WORDS] = {1};
  const struct mo_body *body = make_body(lattice, bits);
  int64_t most = 0;
  for (uint32_t k = 0; k < 8; k++) {
    struct mo_environment environment;
    struct mo_observer observer;
    struct mo_observed_row row;
    double com_m[3] = {2.5, 2.5, 0.1}, angle = 0;
    const double light_m[2] = {4, 3};
    mo_environment_training(5, 0, k, &environment);
    if (k % 2 == 1) {
      environment.n_profile = MO_TERRAIN_HEIGHTS;
      environment.profile_spacing_m = 0.2;
    }
    mo_random_init(&dice, 3, MO_PURPOSE_CHECK, k, 0);
    mo_observer_begin(&observer, body, &environment, &physics, com_m, light_m);
    observe_begin(&row, &environment, com_m);
    for (uint32_t i = 0; i < POSES; i++) {
      struct mo_pose pose;
      angle += 0.6 * (mo_random_uniform(&dice) - (k < 4 ? 0.3 : 0.7));
      for (int axis = 0; axis < 3; axis++)
        pose.com_m[axis] = com_m[axis] += 0.02 * mo_random_normal(&dice);
      pose.turn[0] = 2 * cos(angle);
      pose.turn[1] = 2 * sin(angle);
      mo_observe(&observer, &pose);
      observe_pose(&row, &environment, pose.com_m, pose.turn);
      CHECK(memcmp(row.com_m, observer.last.com_m, sizeof(row.com_m)) == 0);
      CHECK(memcmp(row.turn, observer.last.turn, sizeof(row.turn)) == 0);
      CHECK(row.path_m == observer.path_m && row.height_sum_m == observer.height_sum_m);
      CHECK(row.peak_height_m == observer.peak_height_m && row.turns == observer.turns);
    }
    most = llabs(observer.turns) > most ? llabs(observer.turns) : most;
  }
  CHECK(most > 10);
}

/* Observes a recording of every step as score_observe.cuh does. */
static void observe_recording(const struct mo_recording *recording, const struct mo_robot *robot,
                              const struct mo_physics *physics, const struct mo_outcome *outcome,
                              struct mo_observed_row *row)
{
  const struct mo_body *body = robot->body;
  const uint32_t n = body->n_masses;
  uint8_t ranks[MO_DEFAULT_MASSES], was[MO_DEFAULT_VOXELS] = {0};
  struct mo_plan_rest rest[MO_DEFAULT_MASSES];
  struct mo_plan_corners corners[MO_DEFAULT_VOXELS];
  double output[MO_DEFAULT_SPRINGS] = {0};
  const double actuation = mo_paper_physics().constants.actuation;
  for (uint32_t m = 0; m < n; m++)
    ranks[m] = (uint8_t)(n - 1 - m);
  mo_observe_tables(body, ranks, rest, corners);
  observe_begin(row, robot->environment, outcome->com_start_m);
  for (uint32_t step = 0; step <= STEPS; step++) {
    const float *masses = recording->mass_m + 3 * (size_t)n * step;
    if (step % PERIOD == 0 || step == STEPS) {
      double turn[2] = {0, 0}, up[3] = {0, 0, 0};
      for (uint32_t m = 0; m < n; m++) {
        const float *p = masses + 3 * (size_t)m, *of = rest[ranks[m]].row;
        turn[0] += of[0] * p[0] + of[1] * p[1];
        turn[1] += of[0] * p[1] - of[1] * p[0];
        for (int axis = 0; axis < 3; axis++)
          up[axis] += of[2] * p[axis];
      }
      if (step > 0)
        observe_pose(row, robot->environment, recording->com_m + 3 * (size_t)step, turn);
      memcpy(row->up, up, sizeof(up));
    }
    if (step == STEPS)
      return;
    const uint8_t *contacts = recording->contacts + (size_t)n * (step + 1);
    const int8_t *outputs = recording->actuation + (size_t)body->n_springs * (step + 1);
    const bool touches = memchr(contacts, 1, n) != NULL;
    row->air_steps += !touches;
    row->hops += row->touches && !touches;
    row->touches = touches;
    if (step % PERIOD != 0)
      continue;
    for (uint32_t m = 0; m < n; m++)
      if (contacts[m] != 0) {
        row->contacts++;
        row->front_2 += rest[ranks[m]].halves & 3;
        row->left_2 += rest[ranks[m]].halves >> 2;
      }
    for (uint32_t s = 0; s < body->n_springs; s++) {
      const float *a = masses + 3 * (size_t)body->spring_a[s],
                  *b = masses + 3 * (size_t)body->spring_b[s];
      const double d[3] = {(double)a[0] - b[0], (double)a[1] - b[1], (double)a[2] - b[2]};
      const double length = sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]),
                   at_rest = body->spring_rest_m[s], now = outputs[s] / 127.0;
      const double old = length - at_rest * (1 + actuation * output[s]),
                   new = length - at_rest *(1 + actuation * now);
      row->strain = fmaxf(row->strain, (float)fabs(length / at_rest - 1));
      row->energy_m2 += step > 0 ? fmax(new *new - old *old, 0) : 0;
      output[s] = now;
    }
    uint32_t inverted = 0;
    for (uint32_t v = 0; v < body->n_voxels; v++) {
      double e[3][3] = {{0}};
      for (uint32_t k = 0; k < 8; k++)
        for (uint32_t edge = 0; edge < 3; edge++)
          for (int axis = 0; axis < 3; axis++) {
            const double at = masses[3 * (size_t)(n - 1U - corners[v].mass[k]) + (size_t)axis];
            e[edge][axis] += (k >> (2 - edge) & 1) != 0 ? at : -at;
          }
      const bool is = e[0][0] * (e[1][1] * e[2][2] - e[1][2] * e[2][1]) +
                          e[0][1] * (e[1][2] * e[2][0] - e[1][0] * e[2][2]) +
                          e[0][2] * (e[1][0] * e[2][1] - e[1][1] * e[2][0]) <
                      0;
      inverted += is && was[v];
      was[v] = is;
    }
    row->inverted = inverted > row->inverted ? inverted : row->inverted;
  }
  (void)physics;
}

static void rollouts(void)
{
  const struct mo_lattice *lattice = make_lattice(MO_DEFAULT_WORKSPACE);
  struct mo_body_stream *stream = make_body_stream(MO_DEFAULT_WORKSPACE, 11);
  struct mo_controller *controller = make_controller(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT);
  struct mo_physics physics = mo_paper_physics();
  mo_controller_randomize(controller, 3);
  physics.scheme.control_period_s = PERIOD * physics.scheme.dt_s;
  physics.scheme.n_steps = STEPS;
  for (uint32_t i = 0; i < ROBOTS; i++) {
    uint64_t bits[MO_DEFAULT_WORDS];
    struct mo_environment environment;
    struct mo_outcome outcome;
    struct mo_observed_row row;
    struct mo_recording recording;
    double truth[1][MO_MEASURES], own[MO_MEASURES];
    const struct mo_measuring measuring = {.set = MO_MEASURES_ALL, .values = truth};
    make_check(mo_body_stream_next(stream, bits, NULL), "a body");
    const struct mo_body *body = make_body(lattice, bits);
    mo_environment_training(9, 0, i, &environment);
    if (i % 3 > 0)
      environment.task = task_case(i / 2);
    const struct mo_robot robot = {body, &environment};
    make_check(mo_recording_create(&recording,
                                   MO_RECORD_COM | MO_RECORD_MASSES | MO_RECORD_ACTUATION |
                                       MO_RECORD_CONTACTS,
                                   1, STEPS + 1, body->n_masses, body->n_springs),
               "recording");
    make_check(mo_rollout_reference(body, controller, &environment, &physics, &recording,
                                    &measuring, &outcome),
               "reference");
    observe_recording(&recording, &robot, &physics, &outcome, &row);
    mo_observe_measures(&row, &robot, &physics, &outcome, own);
    for (int k = 0; k < MO_MEASURES; k++) {
      const bool by_work = k == MO_MEASURE_WORK || k == MO_MEASURE_COST_OF_TRANSPORT;
      if (isnan(truth[0][k]) || isnan(own[k]))
        CHECK(isnan(truth[0][k]) && isnan(own[k]));
      else /* outputs are recorded in steps of 1/127, positions in float32 */
        CHECK_NEAR(own[k], truth[0][k], by_work ? 0.05 * truth[0][k] + 0.02 : 2e-5);
    }
    CHECK(row.contacts > 0 && row.energy_m2 > 0);
    outcome.diverged_step = 7;
    mo_observe_measures(&row, &robot, &physics, &outcome, own);
    for (int k = 0; k < MO_MEASURES; k++)
      CHECK(isnan(own[k]));
    mo_recording_free(&recording);
  }
}

static const struct check_case cases[] = {
    {"poses are those of measuring.c", poses},
    {"measures of observed rollouts are those of the reference", rollouts},
};
CHECK_MAIN(cases)
