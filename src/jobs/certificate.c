/* certificate.c: the kind "certificate": scores designs in trials (morpho/certificate.h).
 *
 * The rollouts of all trials are one sequence: trial by trial, within a trial by parts of up to 64
 * environments, within a part design by design. Consecutive parts with the same physics, precision
 * and width form a group, whose cells are one grid with a set of environments per part, so that the
 * back end rarely idles. Losses are saved in the order of the sequence, about once a second. The
 * number of saved rollouts therefore determines where a job continues, no matter what stopped it.
 *
 * Losses under different code (a different instruction set, or an update) must not be compared: if
 * a job continues under different code, it begins again. */
#include <stdlib.h>
#include <string.h>

#include "base/clock.h"
#include "base/thread.h"
#include "jobs/certificate_figures.h"
#include "jobs/certificates.h"
#include "jobs/scoring.h"
#include "rollout/physics.h"
#include "store/worlds.h"

/* Losses are saved at these intervals. A new process begins with the shorter one, so that the job
 * makes progress no matter how often it is killed. */
#define SAVED_FIRST_US INT64_C(60000)
#define SAVED_EVERY_US INT64_C(1000000)
#define GROUP_ROLLOUTS 524288 /* limit of rollouts in a group with several parts */
#define ROW_LOSSES     65536  /* of a saved row */
#define ROWS_MAX       64     /* per save; a group ends a row at each trial */
#define FLOAT64_COST   2.0    /* time of a rollout, relative to float32 */
/* Measured, and rounded up: the cells, losses and environments of a group; and the measures of the
 * base. */
#define GROUP_BYTES  (UINT64_C(24) << 20)
#define FLIGHT_BYTES 4096

/* Consecutive environments of a trial. */
struct part {
  uint32_t trial, first, n; /* environments first … first + n − 1 */
  uint64_t place;           /* of its first rollout, within the trial */
};

struct group {
  const struct part *parts; /* (n) of the same physics, precision and width */
  uint32_t n, width, n_entries;
  struct mo_bits *genotypes;           /* (n, n_designs) */
  struct mo_environment *environments; /* (n, width) grids are borrowed */
  float *losses;                       /* (n_entries, width) */
  double (*measures)[MO_MEASURES];     /* (n_entries, width) NULL: none are requested */
  uint32_t saved;                      /* entries: a design in a part */
};

struct run {
  struct mo_runner *runner;
  struct mo_jobs *jobs;
  int64_t id;
  struct mo_certificate_status status;
  struct mo_environment *environments; /* the base's */
  struct mo_certificate_base base;
  struct mo_bits *genotypes; /* (n_designs) */
  uint32_t n_designs;
  struct mo_trial *trials; /* (n_trials) */
  uint32_t n_trials;
  struct part *parts; /* (n_parts) */
  uint32_t n_parts;
  struct mo_controller *controller;
  struct mo_compute_controller *ready;
  struct group group;
  struct mo_scoring scoring;
  bool is_scoring; /* the group has a grid */
  struct mo_certificate_losses rows[ROWS_MAX];
  size_t n_rows;
  uint32_t n_unsaved; /* 1: losses have arrived that are not processed yet */
  int64_t saved_us, every_us;
  double pace; /* cost computed per second, as last measured; 0: unknown */
};

/* ---- live figures ---- */

/* Returns the time of a rollout in a trial, relative to the base. */
static double cost_of(const struct run *run, const struct mo_trial *trial)
{
  return (double)trial->physics.scheme.n_steps / run->base.physics.scheme.n_steps *
         (trial->precision == MO_FLOAT64 ? FLOAT64_COST : 1);
}

/* Sums the costs of all rollouts that are not saved. */
static double cost_left(const struct run *run)
{
  uint64_t before = 0;
  double sum = 0;
  for (uint32_t t = 0; t < run->n_trials; t++) {
    const uint64_t n = (uint64_t)run->n_designs * run->trials[t].n_environments;
    const uint64_t done = run->status.record.rollouts_done;
    const uint64_t left = done <= before ? n : done < before + n ? before + n - done : 0;
    sum += (double)left * cost_of(run, &run->trials[t]);
    before += n;
  }
  return sum;
}

/* rollouts_per_s: of the current group; 0: unknown. */
static void advance(struct run *run, double rollouts_per_s)
{
  const struct mo_certificate_record *record = &run->status.record;
  struct mo_runner *runner = run->runner;
  const double left = cost_left(run);
  const struct mo_trial *now = run->is_scoring ? &run->trials[run->group.parts[0].trial] : NULL;
  MO_GUARD(&runner->runners->mutex);
  struct mo_live *live = &runner->live;
  live->done = record->rollouts_done;
  live->total = record->n_rollouts;
  live->position = record->trials_done;
  live->last = record->n_trials;
  if (rollouts_per_s > 0 && now != NULL) {
    live->rate = rollouts_per_s;
    run->pace = rollouts_per_s * cost_of(run, now);
  }
  if (run->pace > 0)
    live->seconds_left = left / run->pace;
}

/* ---- saving ---- */

/* Lists the entries that have all their losses, and follow the saved ones. Returns the first entry
 * after them. */
static uint32_t list_rows(struct run *run)
{
  const struct group *group = &run->group;
  const struct mo_grid *grid = &run->scoring.grid;
  const uint32_t most = ROW_LOSSES / group->width;
  uint32_t entry = group->saved, in_row = 0;
  run->n_rows = 0;
  for (; entry < group->n_entries && grid->left[entry] == 0; entry++, in_row++) {
    const struct part *part = &group->parts[entry / run->n_designs];
    const size_t first = (size_t)entry * group->width;
    struct mo_certificate_losses *row = run->n_rows > 0 ? &run->rows[run->n_rows - 1] : NULL;
    if (row == NULL || row->trial != part->trial || in_row == most) {
      if (run->n_rows == ROWS_MAX)
        break;
      row = &run->rows[run->n_rows++];
      *row = (struct mo_certificate_losses){
          .trial = part->trial,
          .place = part->place + (uint64_t)(entry % run->n_designs) * group->width,
          .losses = group->losses + first,
          .measures = group->measures != NULL
                          ? (const double(*)[MO_MEASURES])group->measures + first
                          : NULL};
      in_row = 0;
    }
    row->n += group->width;
  }
  return entry;
}

static int write_rows(void *context)
{
  struct run *run = context;
  return mo_store_certificate_save(run->jobs->store, run->id, run->rows, run->n_rows,
                                   &run->status.record);
}

static void count_trials(struct run *run)
{
  struct mo_certificate_record *record = &run->status.record;
  uint64_t end = 0;
  record->trials_done = 0;
  for (uint32_t t = 0; t < run->n_trials; t++) {
    end += (uint64_t)run->n_designs * run->trials[t].n_environments;
    record->trials_done += end <= record->rollouts_done;
  }
}

static int save_now(struct run *run)
{
  struct group *group = &run->group;
  int error = MO_OK;
  for (;;) {
    const struct mo_certificate_record before = run->status.record;
    const uint32_t end = list_rows(run);
    if (error != MO_OK || run->n_rows == 0)
      break;
    run->status.record.rollouts_done += (uint64_t)(end - group->saved) * group->width;
    count_trials(run);
    error = mo_runner_persist(run->runner, write_rows, run, "the losses of the certificate");
    if (error == MO_OK) {
      group->saved = end;
      mo_memory_prove(run->jobs, run->id);
    } else {
      run->status.record = before;
    }
  }
  run->saved_us = mo_clock_us();
  return error;
}

/* ---- scoring ---- */

static void take(void *context, const struct mo_flight *flight, bool is_done)
{
  struct run *run = context;
  struct group *group = &run->group;
  const struct mo_block *block = &flight->block;
  const size_t first = (size_t)flight->design * group->width;
  (void)is_done;
  for (uint32_t i = 0; i < block->n_environments; i++) {
    const size_t cell = first + flight->places[i];
    group->losses[cell] = (float)block->outcomes[i].loss;
    if (group->measures != NULL)
      memcpy(group->measures[cell], block->measuring->values[i], sizeof(group->measures[cell]));
  }
  atomic_fetch_add(&run->jobs->certificate_rollouts, block->n_environments);
  run->n_unsaved = 1;
}

static int save_arrived(void *context)
{
  struct run *run = context;
  run->n_unsaved = 0;
  if (mo_clock_us() < run->saved_us + run->every_us)
    return MO_OK;
  run->every_us = 2 * run->every_us < SAVED_EVERY_US ? 2 * run->every_us : SAVED_EVERY_US;
  return save_now(run);
}

static void show(void *context, double rollouts_per_s)
{
  advance(context, rollouts_per_s);
}

static void free_group(struct group *group)
{
  free(group->genotypes);
  free(group->environments);
  free(group->losses);
  free(group->measures);
  memset(group, 0, sizeof(*group));
}

/* Fills in the environments of the parts, which begin and end within a trial. */
static int make_environments(struct run *run)
{
  struct group *group = &run->group;
  struct mo_environment *all = NULL;
  int error = MO_OK;
  for (uint32_t i = 0; i < group->n && error == MO_OK; i++) {
    const struct part *part = &group->parts[i];
    const struct mo_trial *trial = &run->trials[part->trial];
    if (i == 0 || part->trial != part[-1].trial) {
      free(all);
      all = calloc((size_t)trial->n_environments + 1, sizeof(*all));
      if (all == NULL)
        return MO_ERR_NO_MEMORY;
      error = mo_certificate_environments(&run->status.record.settings, &run->base, trial, all);
    }
    if (error == MO_OK)
      memcpy(group->environments + (size_t)i * group->width, all + part->first,
             part->n * sizeof(*all));
  }
  free(all);
  return error;
}

/* Allocates the group of `n` parts, starting with `first`. */
static int make_group(struct run *run, uint32_t first, uint32_t n)
{
  struct group *group = &run->group;
  group->parts = &run->parts[first];
  group->n = n;
  group->width = group->parts[0].n;
  group->n_entries = n * run->n_designs;
  const size_t n_cells = (size_t)group->n_entries * group->width;
  group->genotypes = malloc(group->n_entries * sizeof(*group->genotypes));
  group->environments = calloc((size_t)n * group->width, sizeof(*group->environments));
  group->losses = malloc(n_cells * sizeof(*group->losses));
  if (run->trials[group->parts[0].trial].measures)
    group->measures = malloc(n_cells * sizeof(*group->measures));
  if (group->genotypes == NULL || group->environments == NULL || group->losses == NULL ||
      (run->trials[group->parts[0].trial].measures && group->measures == NULL))
    return MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < n; i++)
    memcpy(group->genotypes + (size_t)i * run->n_designs, run->genotypes,
           run->n_designs * sizeof(*run->genotypes));
  return make_environments(run);
}

/* Returns how many parts, starting with `first`, form a group. */
static uint32_t group_size(const struct run *run, uint32_t first)
{
  const struct part *begin = &run->parts[first];
  const struct mo_trial *trial = &run->trials[begin->trial];
  uint32_t n = 1;
  while (first + n < run->n_parts &&
         (uint64_t)(n + 1) * run->n_designs * begin->n <= GROUP_ROLLOUTS) {
    const struct part *next = begin + n;
    const struct mo_trial *other = &run->trials[next->trial];
    if (next->n != begin->n || other->precision != trial->precision ||
        other->measures != trial->measures ||
        !mo_fields_equal(&mo_physics_fields, &other->physics, &trial->physics))
      break;
    n++;
  }
  return n;
}

/* Scores a group from its first entry without stored losses. float64 is computed on CPUs. */
static int score_group(struct run *run)
{
  struct group *group = &run->group;
  const struct mo_trial *trial = &run->trials[group->parts[0].trial];
  struct mo_scoring *scoring = &run->scoring;
  *scoring = (struct mo_scoring){.runner = run->runner,
                                 .grid = {.block = mo_block_of(run->jobs, &run->status.job),
                                          .genotypes = group->genotypes,
                                          .environments = group->environments,
                                          .n_designs = group->n_entries,
                                          .n_environments = group->width,
                                          .n_sets = group->n},
                                 .context = run,
                                 .take = take,
                                 .save = save_arrived,
                                 .n_unsaved = &run->n_unsaved,
                                 .measures = group->measures != NULL,
                                 .show = show};
  struct mo_block *block = &scoring->grid.block;
  block->controller = run->ready;
  block->physics = trial->physics;
  block->precision = trial->precision;
  if (trial->precision == MO_FLOAT64)
    block->back_end = MO_ON_CPU;
  int error = mo_grid_create(&scoring->grid);
  for (uint32_t entry = 0; entry < group->saved && error == MO_OK; entry++)
    mo_grid_finish_design(&scoring->grid, entry);
  run->is_scoring = error == MO_OK;
  advance(run, 0);
  if (error == MO_OK)
    error = mo_score(scoring);
  return error == MO_OK ? save_now(run) : error;
}

/* Finds the part where the job continues, and how many of its designs are stored. */
static uint32_t find_place(const struct run *run, uint32_t *n_saved)
{
  uint64_t at = run->status.record.rollouts_done;
  uint32_t i = 0;
  for (; i < run->n_parts; i++) {
    const uint64_t n = (uint64_t)run->n_designs * run->parts[i].n;
    if (at < n)
      break;
    at -= n;
  }
  *n_saved = i < run->n_parts ? (uint32_t)(at / run->parts[i].n) : 0;
  return i;
}

static int score_all(struct run *run)
{
  uint32_t n_saved, n;
  int error = MO_OK;
  (void)mo_runner_enter(run->runner, MO_PHASE_SCORE);
  for (uint32_t i = find_place(run, &n_saved); i < run->n_parts && error == MO_OK; i += n) {
    n = group_size(run, i);
    error = make_group(run, i, n);
    run->group.saved = n_saved;
    if (error == MO_OK)
      error = score_group(run);
    if (error != MO_OK)
      break; /* `save` may still need the group */
    run->is_scoring = false;
    mo_grid_free(&run->scoring.grid);
    free_group(&run->group);
    n_saved = 0;
  }
  return error;
}

/* ---- an attempt ---- */

static int cut_parts(struct run *run)
{
  uint64_t n_rollouts = 0;
  for (uint32_t t = 0; t < run->n_trials; t++) {
    run->n_parts += (run->trials[t].n_environments + MO_CERTIFICATE_PART - 1) / MO_CERTIFICATE_PART;
    n_rollouts += (uint64_t)run->n_designs * run->trials[t].n_environments;
  }
  if (run->n_trials != run->status.record.n_trials || n_rollouts != run->status.record.n_rollouts)
    return mo_runner_give_up(
        run->runner, MO_ERR_UNSUPPORTED,
        "a different version of the program, with different trials, accepted this "
        "certificate; submit it again");
  run->parts = malloc((run->n_parts + 1) * sizeof(*run->parts));
  if (run->parts == NULL)
    return MO_ERR_NO_MEMORY;
  struct part *part = run->parts;
  for (uint32_t t = 0; t < run->n_trials; t++) {
    const uint32_t n = run->trials[t].n_environments;
    for (uint32_t first = 0; first < n; first += MO_CERTIFICATE_PART)
      *part++ =
          (struct part){.trial = t,
                        .first = first,
                        .n = n - first < MO_CERTIFICATE_PART ? n - first : MO_CERTIFICATE_PART,
                        .place = (uint64_t)first * run->n_designs};
  }
  return MO_OK;
}

static int write_start(void *context)
{
  struct run *run = context;
  const struct mo_compute *compute = run->jobs->compute;
  const char *const by[2] = {run->status.job.back_end == MO_ON_DEVICE
                                 ? mo_compute_device_fingerprint(compute)
                                 : mo_compute_fingerprint(compute, MO_FLOAT32),
                             mo_compute_fingerprint(compute, MO_FLOAT64)};
  struct mo_certificate_classes classes;
  bool restarts = false;
  for (int i = 0; i < 2; i++) {
    if (by[i] == NULL)
      return MO_ERR_DEVICE;
    snprintf(classes.fingerprint[i], sizeof(classes.fingerprint[i]), "%s", by[i]);
  }
  const int error = mo_store_certificate_start(run->jobs->store, run->id, &classes, &restarts);
  if (error == MO_OK && restarts) {
    run->status.record.rollouts_done = run->status.record.trials_done = 0;
    mo_runner_warn(run->runner, MO_ERR_CONFLICT,
                   "the stored losses were computed by different code, so the certificate is being "
                   "computed again from the start");
  }
  return error;
}

static int prepare(struct run *run)
{
  struct mo_store *store = run->jobs->store;
  int error = mo_store_certificate(store, run->id, &run->status);
  if (error == MO_OK)
    error = mo_store_job_designs(store, run->id, &run->genotypes, &run->n_designs);
  if (error == MO_OK && run->n_designs != run->status.job.n_designs)
    error = MO_ERR_CORRUPT;
  if (error == MO_OK)
    error = mo_store_certificate_base(store, &run->status, &run->environments, &run->base);
  if (error != MO_OK)
    return mo_runner_fail_unreadable(run->runner, error);
  error =
      mo_certificate_trials(&run->status.record.settings, &run->base, &run->trials, &run->n_trials);
  if (error == MO_OK)
    error = cut_parts(run);
  if (error == MO_OK)
    error = mo_back_end_check(run->jobs, run->status.job.back_end);
  if (error == MO_OK)
    error = mo_runner_load(run->runner, &run->status.job.controller_sha256, &run->controller);
  if (error == MO_OK)
    error = mo_compute_controller_create(run->jobs->compute, run->controller, &run->ready);
  if (error == MO_OK)
    error = mo_runner_persist(run->runner, write_start, run, "the start of the certificate");
  run->saved_us = mo_clock_us();
  run->every_us = SAVED_FIRST_US;
  return error;
}

/* Lists show the brief verdict of a certificate on a design. It is stored, because computing it
 * from losses would take too long. */
static int find_verdicts(const struct run *run, uint8_t *verdicts)
{
  struct mo_report report;
  const int error = mo_report_load(run->jobs->store, run->id, &report);
  for (uint32_t d = 0; d < run->n_designs && error == MO_OK; d++)
    verdicts[d] = (uint8_t)mo_certificate_brief(report.trials, report.n_trials, report.scores,
                                                report.n_designs, d)
                      .class;
  mo_report_free(&report);
  return error;
}

static int write_end(void *context)
{
  const struct run *run = context;
  uint8_t verdicts[MO_CERTIFICATE_DESIGNS_MAX];
  const int error = find_verdicts(run, verdicts);
  return error == MO_OK
             ? mo_store_certificate_finish(run->jobs->store, run->id, verdicts, run->n_designs)
             : error;
}

static int run_certificate(struct mo_runner *runner, void *context)
{
  struct run *run = context;
  run->runner = runner;
  run->jobs = runner->jobs;
  run->id = runner->id;
  int error = prepare(run);
  if (error == MO_OK)
    error = score_all(run);
  if (error == MO_OK) {
    (void)mo_runner_enter(runner, MO_PHASE_SAVE);
    error = mo_runner_persist(runner, write_end, run, "the end of the certificate");
  }
  return error;
}

/* Saves the losses that a stopped run has computed. */
static int save_rest(void *context)
{
  struct run *run = context;
  return run->is_scoring ? save_now(run) : MO_OK;
}

static void clean_up(void *context)
{
  struct run *run = context;
  if (run->is_scoring)
    mo_grid_free(&run->scoring.grid);
  free_group(&run->group);
  free(run->parts);
  free(run->trials);
  free(run->genotypes);
  mo_compute_controller_free(run->ready);
  mo_controller_free(run->controller);
  mo_environments_free(run->environments, run->base.n_environments);
}

/* ---- the kind ---- */

struct mo_need mo_certificate_need(const struct mo_jobs *jobs, uint32_t n_designs,
                                   uint64_t n_rollouts, enum mo_back_end back_end)
{
  /* At the end, all losses are in memory, instead of those of a group. */
  const uint64_t losses = n_rollouts * sizeof(float);
  return (struct mo_need){.own = (losses > GROUP_BYTES ? losses : GROUP_BYTES) +
                                 (uint64_t)n_designs * MO_CERTIFICATE_PART * MO_MEASURES *
                                     sizeof(double) +
                                 (uint64_t)mo_back_end_window(jobs, back_end) * FLIGHT_BYTES};
}

static int need(struct mo_jobs *jobs, int64_t id, struct mo_need *need)
{
  struct mo_certificate_status status;
  const int error = mo_store_certificate(jobs->store, id, &status);
  if (error == MO_OK)
    *need = mo_certificate_need(jobs, status.job.n_designs, status.record.n_rollouts,
                                status.job.back_end);
  return error;
}

const struct mo_kind mo_certificate_kind = {.kind = MO_JOB_CERTIFICATE,
                                            .need = need,
                                            .first = MO_PHASE_PREPARE,
                                            .run_bytes = sizeof(struct run),
                                            .run = run_certificate,
                                            .save = save_rest,
                                            .clean_up = clean_up};
