/* warnings.c: see warnings.h. */
#include "store/warnings.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>

#include "rollout/scene.h"
#include "store/campaigns.h"
#include "store/encode.h"
#include "store/evaluations.h"
#include "store/rows.h"
#include "store/trainings.h"

/* At this distance from the middle of the workspace, a light is more than a voxel away from the
 * center of mass of any body at the start. */
#define LIGHT_CLEAR_M 0.3

static const char remedy[] = "choose a smaller dt_s or stiffness_n_per_m";

static void __attribute__((format(printf, 3, 4)))
warn(struct mo_job *job, const char *code, const char *format, ...)
{
  struct mo_warning *warning = &job->warnings[job->n_warnings++];
  va_list arguments;
  warning->code = code;
  warning->of_request = false;
  va_start(arguments, format);
  vsnprintf(warning->detail, sizeof(warning->detail), format, arguments);
  va_end(arguments);
}

/* ---- robots that diverged ---- */

/* Only a final evaluation can have all its rollouts diverged: before that, the remaining ones may
 * not diverge. */
static void warn_of_rollouts(struct mo_job *job)
{
  const uint64_t run = job->rollouts_done - job->rollouts_cut, diverged = job->rollouts_diverged;
  const bool is_final = mo_job_state_is_final(job->state);
  if (diverged > 0 && diverged >= run && is_final)
    warn(job, "all_diverged", "every rollout diverged (%llu), so no robot has a score; %s",
         (unsigned long long)diverged, remedy);
  else if (diverged > 0 && job->tolerance > 0)
    warn(job, "diverged",
         "%llu of %llu rollouts%s diverged; a rung with a diverged rollout has no estimated error "
         "and is chosen only if there is no other; %s",
         (unsigned long long)diverged, (unsigned long long)run, is_final ? "" : " so far", remedy);
  else if (diverged > 0)
    warn(job, "diverged",
         "%llu of %llu rollouts%s diverged, and a robot has no score if any of its rollouts "
         "diverged%s; %s",
         (unsigned long long)diverged, (unsigned long long)run, is_final ? "" : " so far",
         job->n_displaced > 0 ? ", and no error if one of the additional ones did" : "", remedy);
}

/* Warns about a step of a training run, or the population of a generation. */
static void warn_of_robots(struct mo_job *job, const char *when, uint32_t number, uint32_t diverged,
                           uint32_t n)
{
  if (n > 0 && diverged >= n)
    warn(job, "all_diverged", "every robot of %s %u diverged (%u); %s", when, (unsigned)number,
         (unsigned)diverged, remedy);
  else if (diverged > n / 2)
    warn(job, "diverged", "%u of %u robots of %s %u diverged; %s", (unsigned)diverged, (unsigned)n,
         when, (unsigned)number, remedy);
}

static int warn_of_step(struct mo_connection *connection, struct mo_job *job,
                        const struct mo_training_record *record)
{
  struct mo_training_step_row last;
  bool found;
  const int error = mo_row_newest(connection, MO_TRAINING_STEPS, job->id, &last, &found);
  if (error == MO_OK && found)
    warn_of_robots(job, "step", last.report.step, last.report.diverged, record->settings.batch);
  return error;
}

/* With select_by, designs without a value of the measure count as diverged. */
static int warn_of_generation(struct mo_connection *connection, struct mo_job *job,
                              const struct mo_campaign_record *record)
{
  static const char sql[] = "SELECT ended,generation FROM campaigns WHERE job=?1";
  struct mo_campaign_generation last;
  bool found;
  sqlite3_stmt *row;
  int error = mo_row_newest(connection, MO_CAMPAIGN_GENERATIONS, job->id, &last, &found);
  if (error == MO_OK && found && !record->select_by.is_set)
    warn_of_robots(job, "generation", last.generation, last.stats.n_diverged, last.stats.n);
  else if (error == MO_OK && found && last.stats.n_diverged > last.stats.n / 2)
    warn(job, "no_measure",
         "%u of %u designs of generation %u have no value of %s or diverged; they rank last",
         (unsigned)last.stats.n_diverged, (unsigned)last.stats.n, (unsigned)last.generation,
         mo_measure_info[record->select_by.measure].name);
  if (error == MO_OK)
    error = mo_sql_row(connection, &row, sql, mo_int(job->id));
  if (error == MO_OK && sqlite3_column_int(row, 0) == MO_CAMPAIGN_EXHAUSTED)
    warn(job, "exhausted", "it ended at generation %lld of %u because no unseen bodies are left",
         (long long)sqlite3_column_int64(row, 1), (unsigned)job->steps_total);
  return error;
}

/* ---- the request ---- */

/* Rounds down to two digits. */
static double lower(double value)
{
  const double unit = pow(10, floor(log10(value)) - 1);
  return floor(value / unit) * unit;
}

/* where: the environment that has these constants, in words; "": all of them. */
static uint32_t warn_of_dt(const struct mo_physics *physics, const char *where,
                           struct mo_warning *warning)
{
  const struct mo_constants *constants = &physics->constants;
  if (mo_step_is_stable(physics, MO_EIGENVALUE_MAX))
    return 0;
  const double stable_s = mo_stable_step_s(physics, MO_EIGENVALUE_MAX);
  *warning = (struct mo_warning){.code = "unstable_step", .of_request = true};
  /* Moving bodies become unstable a little below the bound (docs/numerics.md, "Stable steps"). */
  snprintf(warning->detail, sizeof(warning->detail),
           "dt_s %.6g exceeds the linear stability bound of %.3g for stiffness_n_per_m %.6g, "
           "mass_kg %.6g, drag_per_s %.6g%s and integrator %s: expect bodies to blow up; use a "
           "dt_s of at most %.2g",
           physics->scheme.dt_s, stable_s, constants->stiffness_n_per_m, constants->mass_kg,
           constants->drag_per_s, where, mo_integrator_words[physics->scheme.integrator],
           lower(0.8 * stable_s));
  return 1;
}

/* Controllers without a control period mostly date from before control periods existed, when a step
 * took 4 ms: with shorter steps, they act more often than they have learned to. */
static uint32_t warn_of_every_step(const struct mo_physics *physics, struct mo_warning *warning)
{
  const struct mo_scheme *scheme = &physics->scheme;
  if (scheme->control_period_s > 0 || scheme->integrator != MO_INTEGRATOR_SPLIT ||
      !(scheme->dt_s < mo_paper_physics().scheme.dt_s))
    return 0;
  *warning = (struct mo_warning){.code = "every_step", .of_request = true};
  snprintf(warning->detail, sizeof(warning->detail),
           "without a control period, the controller acts at every step of %.6g s; if it was made "
           "for the paper's steps of 0.004 s, use \"physics\": \"paper\", or set control_period_s",
           scheme->dt_s);
  return 1;
}

/* A user who gives only a smaller dt_s probably wants a better result, not a shorter rollout.
 * An unstable step has a warning of its own, and its results are of no use. */
static uint32_t warn_of_duration(const struct mo_physics *physics, struct mo_warning *warning)
{
  const struct mo_scheme *scheme = &physics->scheme;
  const struct mo_scheme usual = scheme->integrator == MO_INTEGRATOR_SPLIT
                                     ? mo_default_physics().scheme
                                     : mo_paper_physics().scheme;
  const double usual_s = usual.n_steps * usual.dt_s;
  if (scheme->n_steps != usual.n_steps || scheme->dt_s == usual.dt_s)
    return 0;
  *warning = (struct mo_warning){.code = "other_duration", .of_request = true};
  snprintf(
      warning->detail, sizeof(warning->detail),
      "with dt_s %.6g, the default n_steps of %u makes rollouts last %.3g s instead of %.3g s; "
      "to keep the duration, set n_steps to %.0f",
      scheme->dt_s, (unsigned)usual.n_steps, scheme->n_steps * scheme->dt_s, usual_s,
      usual_s / scheme->dt_s);
  return 1;
}

uint32_t mo_warn_of_physics(const struct mo_physics *physics,
                            struct mo_warning warnings[MO_PHYSICS_WARNINGS_MAX])
{
  uint32_t n = warn_of_dt(physics, "", warnings);
  if (n == 0)
    n = warn_of_duration(physics, warnings);
  return n + warn_of_every_step(physics, warnings + n);
}

uint32_t mo_warn_of_world(const struct mo_physics *physics,
                          const struct mo_environment *environment, uint32_t position,
                          struct mo_warning *warning)
{
  struct mo_physics here = *physics;
  char where[64];
  if (environment->factors.given == 0 || !mo_step_is_stable(physics, MO_EIGENVALUE_MAX))
    return 0;
  here.constants = mo_scene_constants(environment, physics);
  snprintf(where, sizeof(where), " (with the factors of environment %u)", (unsigned)position);
  return warn_of_dt(&here, where, warning);
}

/* Warns about the least stable of the worlds that learning draws: the stiffest and lightest, with
 * the lowest or the highest drag. */
static void warn_of_vary(struct mo_job *job, const struct mo_factor_ranges *vary)
{
  if (!vary->given || !mo_step_is_stable(&job->physics, MO_EIGENVALUE_MAX))
    return;
  for (int end = 0; end < 2; end++) {
    struct mo_physics worst = job->physics;
    worst.constants.stiffness_n_per_m *= vary->stiffness[1];
    worst.constants.mass_kg *= vary->mass[0];
    worst.constants.drag_per_s *= vary->drag[end];
    const uint32_t n =
        warn_of_dt(&worst, " (in worlds that vary draws)", &job->warnings[job->n_warnings]);
    job->n_warnings += n;
    if (n > 0)
      return;
  }
}

static void warn_of_physics(struct mo_job *job)
{
  job->n_warnings += mo_warn_of_physics(&job->physics, &job->warnings[job->n_warnings]);
}

static int warn_of_worlds(struct mo_connection *connection, struct mo_job *job, int64_t owner)
{
  static const char sql[] = "SELECT e.data,x.position FROM job_environments x JOIN environments e"
                            " ON e.id=x.environment WHERE x.job=?1 ORDER BY x.position";
  double nearest_m = INFINITY;
  uint32_t nearest = 0, n = 0, unstable = 0;
  int error = MO_OK;
  if (job->environment_set[0] != '\0') /* named sets cause no warning */
    return MO_OK;
  sqlite3_stmt *row = mo_sql_rows(connection, &error, sql, mo_int(owner));
  while (mo_sql_next(connection, row, &error)) {
    struct mo_environment environment;
    const uint32_t position = mo_column_u32(row, 1);
    error = mo_decode_environment(sqlite3_column_blob(row, 0), (size_t)sqlite3_column_bytes(row, 0),
                                  &environment);
    mo_environments_drop(&environment, 1);
    if (error == MO_OK && unstable == 0)
      unstable =
          mo_warn_of_world(&job->physics, &environment, position, &job->warnings[job->n_warnings]);
    if (error != MO_OK || !mo_guide_has_light(&environment.task.guide))
      continue;
    const double *light_m = environment.light_xy_m;
    const double distance_m = hypot(light_m[0] - MO_WORLD_CENTER_M, light_m[1] - MO_WORLD_CENTER_M);
    n += distance_m < LIGHT_CLEAR_M;
    if (distance_m < nearest_m) {
      nearest_m = distance_m;
      nearest = position;
    }
  }
  job->n_warnings += unstable;
  if (n == 0)
    return error;
  warn(job, "light_near_start",
       "the light of environment %u is %.2f m from the middle of the workspace%s; a robot that "
       "starts next to it has a very large loss, because losses are divided by the starting "
       "distance",
       (unsigned)nearest, nearest_m, n > 1 ? ", and so are other lights" : "");
  job->warnings[job->n_warnings - 1].of_request = true;
  return error;
}

int mo_job_warn(struct mo_connection *connection, struct mo_job *job, const void *record)
{
  job->n_warnings = 0;
  switch (job->kind) {
  case MO_JOB_EVALUATION:
    warn_of_rollouts(job);
    warn_of_physics(job);
    return warn_of_worlds(connection, job, job->id);
  case MO_JOB_ATLAS:
  case MO_JOB_CERTIFICATE: warn_of_physics(job); return warn_of_worlds(connection, job, job->id);
  case MO_JOB_TRAINING: {
    const struct mo_training_record *training = record;
    const int error = warn_of_step(connection, job, record);
    warn_of_physics(job);
    warn_of_vary(job, &training->settings.learning.vary);
    return error == MO_OK && job->n_environments > 0 ? warn_of_worlds(connection, job, job->id)
                                                     : error;
  }
  case MO_JOB_CAMPAIGN: {
    const struct mo_campaign_record *campaign = record;
    const int error = warn_of_generation(connection, job, campaign);
    warn_of_physics(job);
    if (mo_modes[campaign->settings.mode].learns)
      warn_of_vary(job, &campaign->settings.learning.vary);
    return error == MO_OK ? warn_of_worlds(connection, job, campaign->group) : error;
  }
  }
  return MO_OK;
}
