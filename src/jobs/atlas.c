/* atlas.c: the kind "atlas": scores all bodies of a scope, in order, and writes an atlas file.
 *
 * Bodies come from a stream and are scored in waves, so memory does not depend on their number. A
 * body is added to the file when it and all bodies before it have their losses; about once a second
 * the file is made durable, and then the row with the progress is written. The database never
 * contains the scores. Whatever stops the job, it continues after the last durable body of the
 * file. The losses of a body depend only on the body and the settings, so the file has the same
 * bytes as without the interruption.
 *
 * A file begins with a description of everything that its losses depend on. If a job continues
 * under different code (a different instruction set, or an update), the unfinished file no longer
 * belongs to it, and the job starts again. */
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "atlas/file.h"
#include "base/clock.h"
#include "base/thread.h"
#include "jobs/atlas_wave.h"
#include "jobs/atlases.h"
#include "jobs/scoring.h"
#include "jobs/submission.h"
#include "store/worlds.h"

/* Bodies are saved at these intervals. A new process begins with the shorter one, so that the job
 * makes progress no matter how often it is killed. */
#define SAVED_FIRST_US INT64_C(60000)
#define SAVED_EVERY_US INT64_C(1000000)
/* A wave fills several windows of the back end, so that devices rarely idle at its end. */
#define WINDOWS      4
#define WAVE_MIN     4096
#define WAVE_MAX     131072
#define ROLLOUTS_MAX 1310720 /* of a wave, if it has more than WAVE_LEAST designs */
#define WAVE_LEAST   2048
#define VALUES_BYTES (UINT64_C(64) << 20) /* bytes of its measures, in the same case */
/* Measured, and rounded up: of two streams of bodies, and of the writer. */
#define TEN_VOXELS_BYTES  (UINT64_C(40) << 20)
#define NINE_VOXELS_BYTES (UINT64_C(8) << 20)
#define LESS_BYTES        (UINT64_C(2) << 20)
#define FLIGHT_BYTES      1024
#define MEASURED_BYTES    (MO_BLOCK_LANES * sizeof(double[MO_MEASURES])) /* added per flight */

struct run {
  struct mo_runner *runner;
  struct mo_jobs *jobs;
  int64_t id;
  struct mo_atlas_status status;
  struct mo_atlas_source source;
  struct mo_environment *environments; /* (n) */
  uint32_t n_environments;
  struct mo_atlas_writer *writer; /* NULL: at first, and if the file was already complete */
  struct mo_atlas_bodies *bodies;
  struct mo_controller *controller;
  struct mo_compute_controller *ready;
  struct mo_atlas_wave wave;
  struct mo_scoring scoring;
  uint32_t added;     /* bodies of the wave that were added to the file */
  uint32_t n_unsaved; /* 1: losses have arrived that are not processed yet */
  bool is_complete;   /* the file has its final name */
  uint64_t shown;     /* bodies in the row */
  int64_t saved_us, every_us;
};

/* ---- the size of waves ---- */

static uint32_t wave_designs(const struct mo_jobs *jobs, enum mo_back_end back_end,
                             uint32_t n_environments, uint32_t n_measures)
{
  const uint64_t values_bytes = sizeof(double) * (uint64_t)n_environments * n_measures;
  const uint64_t windows = (uint64_t)WINDOWS * mo_back_end_window(jobs, back_end);
  uint64_t most = windows < WAVE_MIN ? WAVE_MIN : windows > WAVE_MAX ? WAVE_MAX : windows;
  if (most * n_environments > ROLLOUTS_MAX)
    most = ROLLOUTS_MAX / n_environments;
  if (most * values_bytes > VALUES_BYTES)
    most = VALUES_BYTES / values_bytes;
  return most > WAVE_LEAST ? (uint32_t)most : WAVE_LEAST;
}

static struct mo_need estimate(const struct mo_jobs *jobs, uint32_t voxels, uint32_t n_environments,
                               uint32_t measures, enum mo_back_end back_end)
{
  const uint32_t n_measures = (uint32_t)__builtin_popcount(measures);
  const uint32_t most = wave_designs(jobs, back_end, n_environments, n_measures);
  const uint64_t of_bodies = voxels > 9   ? TEN_VOXELS_BYTES
                             : voxels > 8 ? NINE_VOXELS_BYTES
                                          : LESS_BYTES;
  return (struct mo_need){.own = of_bodies + mo_atlas_wave_bytes(most, n_environments, n_measures) +
                                 (uint64_t)most * (n_environments + 1) +
                                 (uint64_t)mo_back_end_window(jobs, back_end) *
                                     (FLIGHT_BYTES + (measures != 0 ? MEASURED_BYTES : 0))};
}

/* ---- live figures ---- */

static void advance(struct run *run, double rollouts_per_s)
{
  const struct mo_atlas_record *record = &run->status.record;
  const struct mo_atlas_wave *wave = &run->wave;
  struct mo_runner *runner = run->runner;
  MO_GUARD(&runner->runners->mutex);
  struct mo_live *live = &runner->live;
  live->done = record->bodies_done;
  live->total = record->bodies_total;
  if (rollouts_per_s > 0)
    live->rate = rollouts_per_s;
  /* Later bodies are assumed to have about as many designs as those of this wave. */
  if (live->rate > 0 && wave->n > 0)
    live->seconds_left = (double)(record->bodies_total - record->bodies_done) *
                         ((double)wave->n_designs / wave->n) * run->n_environments / live->rate;
}

/* ---- the file ---- */

/* Examines the file with the atlas's name. MO_OK with run->is_complete: the file is complete and
 * contains what this job writes. Nothing else uses the name while the job is open, so the process
 * must have ended between completing the file and finishing the job. MO_ERR_NOT_FOUND;
 * MO_ERR_DUPLICATE: it is a different atlas, and the job gives up. */
static int adopt(struct run *run)
{
  struct mo_atlas_record *record = &run->status.record;
  struct mo_message message = {.text = ""}, reason = {.text = ""};
  struct mo_atlas *atlas = NULL;
  bool is_own = false;
  char *path = mo_store_atlas_path(run->jobs->store, record->name);
  if (path == NULL)
    return MO_ERR_NO_MEMORY;
  int error = mo_atlas_open(path, &atlas, &reason);
  free(path);
  if (error == MO_ERR_NOT_FOUND || error == MO_ERR_NO_MEMORY)
    return error;
  if (error == MO_ERR_IO) {
    (void)mo_fail(&message, error, "the file of the atlas cannot be used: %.200s", reason.text);
    return mo_runner_fail(run->runner, error, message.text);
  }
  if (error == MO_OK)
    error = mo_atlas_is_of(atlas, &run->source, run->environments, run->n_environments, &is_own);
  else
    error = MO_OK; /* damaged, or of a different kind */
  if (error == MO_OK && !is_own)
    error = mo_runner_give_up(run->runner, MO_ERR_DUPLICATE,
                              "another atlas now has this name; delete or rename it, "
                              "then resume the job");
  if (error == MO_OK) /* the earlier attempt may not have synced its name */
    error = mo_store_atlases_sync(run->jobs->store);
  if (error == MO_OK) {
    /* Remove the unfinished file, which is not needed. */
    (void)mo_store_atlas_restart(run->jobs->store, record->name);
    run->is_complete = true;
    record->bodies_total = mo_atlas_bodies_of(atlas);
  }
  mo_atlas_close(atlas);
  return error;
}

/* Determines why the writer could not begin. MO_OK: try again, unless run->is_complete. */
static int resolve(struct run *run)
{
  const int error = adopt(run);
  if (error != MO_ERR_NOT_FOUND)
    return error;
  mo_runner_warn(
      run->runner, MO_ERR_CONFLICT,
      "the unfinished atlas was computed by different code, so it is being rebuilt from the start");
  return mo_store_atlas_restart(run->jobs->store, run->status.record.name);
}

static int open_writer(void *context)
{
  struct run *run = context;
  struct mo_message message = {.text = ""};
  struct mo_store *store = run->jobs->store;
  int error = MO_ERR_CONFLICT;
  if (mo_store_is_short(store))
    return MO_ERR_NO_SPACE;
  for (int i = 0; i < 2 && error == MO_ERR_CONFLICT && !run->is_complete; i++) {
    error = mo_store_atlas_writer(store, run->status.record.name, &run->source, run->environments,
                                  run->n_environments, &run->writer, &message);
    if (error == MO_ERR_CONFLICT) {
      const int unresolved = resolve(run);
      if (unresolved != MO_OK)
        return unresolved;
    }
  }
  if (run->is_complete || error == MO_OK)
    return MO_OK;
  run->runner->busy_text = "another process is writing the unfinished file of this atlas; stop it, "
                           "and the job will continue";
  return mo_runner_fail(run->runner, error == MO_ERR_CONFLICT ? MO_ERR_DUPLICATE : error,
                        message.text);
}

/* Adds the next bodies that have their losses. */
static int add_done(struct run *run)
{
  const struct mo_atlas_wave *wave = &run->wave;
  double losses[MO_ATLAS_ENVIRONMENTS_MAX], measures[MO_MEASURES];
  int error = MO_OK;
  while (run->added < wave->n && wave->left[run->added] == 0 && error == MO_OK) {
    mo_atlas_wave_mean(wave, run->added, losses, measures);
    error = mo_atlas_writer_add(run->writer, wave->forms[run->added].words, losses, measures);
    if (error != MO_OK)
      break;
    const uint32_t n = wave->begins[run->added + 1] - wave->begins[run->added];
    run->status.record.bodies_done++;
    run->status.record.rollouts_done += (uint64_t)n * run->n_environments;
    atomic_fetch_add(&run->jobs->atlas_bodies, 1);
    run->added++;
  }
  return error;
}

static int write_file(void *context)
{
  struct run *run = context;
  if (mo_store_is_short(run->jobs->store))
    return MO_ERR_NO_SPACE;
  const int error = add_done(run);
  return error == MO_OK ? mo_atlas_writer_save(run->writer) : error;
}

/* Writes the position at which the job would continue. */
static int write_place(void *context)
{
  struct run *run = context;
  return mo_store_atlas_progress(run->jobs->store, run->id, &run->status.record, NULL);
}

static int write_progress(void *context)
{
  struct run *run = context;
  const struct mo_atlas_record *record = &run->status.record;
  char data[192];
  snprintf(data, sizeof(data),
           "{\"id\":\"%lld\",\"bodies_done\":%llu,\"bodies_total\":%llu,\"rollouts_done\":%llu}",
           (long long)run->id, (unsigned long long)record->bodies_done,
           (unsigned long long)record->bodies_total, (unsigned long long)record->rollouts_done);
  return mo_store_atlas_progress(run->jobs->store, run->id, record, data);
}

/* Makes all finished bodies durable, and then updates the row. Only additional bodies count as
 * progress. */
static int save_now(struct run *run)
{
  int error = mo_runner_persist(run->runner, write_file, run, "the atlas");
  const bool has_more = run->status.record.bodies_done > run->shown;
  if (error == MO_OK && has_more)
    error = mo_runner_persist(run->runner, write_progress, run, "the progress of the atlas");
  run->saved_us = mo_clock_us();
  if (error == MO_OK && has_more) {
    run->shown = run->status.record.bodies_done;
    mo_memory_prove(run->jobs, run->id);
  }
  return error;
}

/* ---- scoring ---- */

static void take(void *context, const struct mo_flight *flight, bool is_done)
{
  struct run *run = context;
  struct mo_atlas_wave *wave = &run->wave;
  const struct mo_block *block = &flight->block;
  double *losses = wave->losses + (size_t)flight->design * run->n_environments;
  for (uint32_t i = 0; i < block->n_environments; i++) {
    losses[flight->places[i]] = block->outcomes[i].loss;
    if (wave->measures != 0)
      mo_atlas_wave_measured(wave, flight->design, flight->places[i], block->measuring->values[i]);
  }
  atomic_fetch_add(&run->jobs->atlas_rollouts, block->n_environments);
  if (is_done)
    wave->left[wave->bodies[flight->design]]--;
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

static int score_wave(struct run *run)
{
  struct mo_scoring *scoring = &run->scoring;
  *scoring = (struct mo_scoring){.runner = run->runner,
                                 .grid = {.block = mo_block_of(run->jobs, &run->status.job),
                                          .genotypes = run->wave.designs,
                                          .environments = run->environments,
                                          .n_designs = run->wave.n_designs,
                                          .n_environments = run->n_environments},
                                 .context = run,
                                 .take = take,
                                 .save = save_arrived,
                                 .n_unsaved = &run->n_unsaved,
                                 .measures = run->source.measures != 0,
                                 .show = show};
  scoring->grid.block.controller = run->ready;
  int error = mo_grid_create(&scoring->grid);
  if (error == MO_OK)
    error = mo_score(scoring);
  mo_grid_free(&scoring->grid);
  return error;
}

static int build(struct run *run)
{
  int error = MO_OK;
  for (;;) {
    (void)mo_runner_enter(run->runner, MO_PHASE_PREPARE);
    run->added = 0;
    error = mo_atlas_wave_fill(&run->wave, run->bodies);
    if (error != MO_OK || run->wave.n == 0)
      return error;
    advance(run, 0);
    (void)mo_runner_enter(run->runner, MO_PHASE_SCORE);
    error = score_wave(run);
    if (error == MO_OK)
      error = save_now(run);
    if (error != MO_OK)
      return error;
  }
}

/* ---- an attempt ---- */

static const char *fingerprint_of(const struct run *run)
{
  return run->status.job.back_end == MO_ON_DEVICE
             ? mo_compute_device_fingerprint(run->jobs->compute)
             : mo_compute_fingerprint(run->jobs->compute, MO_FLOAT32);
}

static int describe_source(struct run *run)
{
  struct mo_atlas_source *source = &run->source;
  const char *fingerprint = fingerprint_of(run);
  const struct mo_job *job = &run->status.job;
  struct mo_sha256 physics;
  mo_physics_hash(&job->physics, job->precision, job->sensor, &physics);
  *source = (struct mo_atlas_source){.scope = {MO_STORE_WORKSPACE, run->status.record.voxels},
                                     .orientations = run->status.record.orientations,
                                     .measures = run->status.record.measures};
  memcpy(source->controller_sha256, run->status.job.controller_sha256.bytes,
         sizeof(source->controller_sha256));
  memcpy(source->physics_sha256, physics.bytes, sizeof(source->physics_sha256));
  if (fingerprint == NULL)
    return MO_ERR_DEVICE;
  if (strlen(fingerprint) >= sizeof(source->fingerprint))
    return MO_ERR_LIMIT;
  memcpy(source->fingerprint, fingerprint, strlen(fingerprint));
  return MO_OK;
}

/* Corrects the count of rollouts to the body at which the file ends, which may differ from the last
 * one in the row. */
static int recount(struct run *run)
{
  struct mo_atlas_record *record = &run->status.record;
  const uint64_t position =
      run->is_complete ? record->bodies_total : mo_atlas_writer_position(run->writer);
  const uint64_t from = position >= record->bodies_done ? record->bodies_done : 0;
  uint64_t n = 0;
  const int error =
      mo_atlas_count_designs(&run->source.scope, record->orientations, from, position, &n);
  if (error != MO_OK)
    return error;
  record->rollouts_done = (from == 0 ? 0 : record->rollouts_done) + n * run->n_environments;
  record->bodies_done = position;
  return MO_OK;
}

/* Finds the position at which to continue, and reports it. */
static int find_place(struct run *run)
{
  struct mo_atlas_record *record = &run->status.record;
  int error = mo_runner_persist(run->runner, open_writer, run, "the atlas");
  run->runner->busy_text = NULL;
  if (error != MO_OK)
    return error;
  run->runner->text[0] = '\0';
  if (!run->is_complete)
    record->bodies_total = mo_atlas_writer_bodies(run->writer);
  error = recount(run);
  run->shown = record->bodies_done;
  advance(run, 0);
  return error == MO_OK
             ? mo_runner_persist(run->runner, write_place, run, "the progress of the atlas")
             : error;
}

static int prepare(struct run *run)
{
  struct mo_store *store = run->jobs->store;
  int error = mo_store_atlas(store, run->id, &run->status);
  if (error == MO_OK)
    error = mo_store_job_environments(store, run->id, MO_JOB_ATLAS, &run->environments,
                                      &run->n_environments);
  if (error != MO_OK)
    return mo_runner_fail_unreadable(run->runner, error);
  error = mo_back_end_check(run->jobs, run->status.job.back_end);
  if (error == MO_OK)
    error = describe_source(run);
  if (error == MO_OK)
    error = mo_runner_load(run->runner, &run->status.job.controller_sha256, &run->controller);
  if (error == MO_OK)
    error = mo_compute_controller_create(run->jobs->compute, run->controller, &run->ready);
  if (error == MO_OK)
    error = find_place(run);
  if (error != MO_OK || run->is_complete)
    return error;
  const uint32_t n_measures = (uint32_t)__builtin_popcount(run->source.measures);
  run->wave = (struct mo_atlas_wave){
      .scope = run->source.scope,
      .orientations = run->source.orientations,
      .n_environments = run->n_environments,
      .measures = run->source.measures,
      .n_measures = n_measures,
      .most = wave_designs(run->jobs, run->status.job.back_end, run->n_environments, n_measures)};
  error = mo_atlas_wave_create(&run->wave);
  if (error == MO_OK)
    error = mo_atlas_bodies_create(&run->source.scope, &run->bodies);
  if (error == MO_OK)
    error = mo_atlas_bodies_seek(run->bodies, run->status.record.bodies_done);
  run->saved_us = mo_clock_us();
  run->every_us = SAVED_FIRST_US;
  return error;
}

/* Gives the file its name. If another file has taken the name in the meantime, that file stays. */
static int finish_file(struct run *run)
{
  struct mo_message message = {.text = ""};
  int error = mo_atlas_writer_finish(run->writer, &message);
  if (error == MO_ERR_CONFLICT)
    error = adopt(run);
  if (error == MO_ERR_CONFLICT)
    error = MO_ERR_DUPLICATE;
  run->is_complete = error == MO_OK;
  return error == MO_OK || run->runner->text[0] != '\0'
             ? error
             : mo_runner_fail(run->runner, error, message.text);
}

static int write_end(void *context)
{
  struct run *run = context;
  run->runner->text[0] = '\0';
  const int error = run->is_complete ? MO_OK : finish_file(run);
  return error == MO_OK ? mo_store_atlas_finish(run->jobs->store, run->id, &run->status.record)
                        : error;
}

static int run_atlas(struct mo_runner *runner, void *context)
{
  struct run *run = context;
  run->runner = runner;
  run->jobs = runner->jobs;
  run->id = runner->id;
  int error = prepare(run);
  if (error == MO_OK && !run->is_complete)
    error = build(run);
  if (error == MO_OK) {
    (void)mo_runner_enter(runner, MO_PHASE_SAVE);
    error = mo_runner_persist(runner, write_end, run, "the atlas");
  }
  return error;
}

/* Saves the bodies that a stopped run has finished. */
static int save_rest(void *context)
{
  struct run *run = context;
  return run->writer != NULL && run->wave.forms != NULL && !run->is_complete ? save_now(run)
                                                                             : MO_OK;
}

static void clean_up(void *context)
{
  struct run *run = context;
  mo_atlas_writer_free(run->writer);
  mo_atlas_bodies_free(run->bodies);
  mo_atlas_wave_free(&run->wave);
  mo_compute_controller_free(run->ready);
  mo_controller_free(run->controller);
  mo_environments_free(run->environments, run->n_environments);
  if (mo_runner_requested(run->runner) == MO_REQUEST_CANCEL)
    mo_store_atlas_drop(run->jobs->store, run->id);
}

/* ---- submission ---- */

#define LARGE_VOXELS 5 /* at this size or above, devices are worthwhile */

static int complete(struct mo_jobs *jobs, struct mo_atlas_request *request,
                    struct mo_message *message)
{
  int error = MO_OK;
  if (request->environment_set != NULL)
    error =
        mo_environments_count(jobs, request->environment_set, &request->n_environments, message);
  if (error == MO_OK)
    error = mo_back_end_choose(jobs, &request->job,
                               mo_back_end_unsuited(request->environments, request->n_environments),
                               request->voxels >= LARGE_VOXELS, message);
  if (error != MO_OK)
    return error;
  const struct mo_need need = estimate(jobs, request->voxels, request->n_environments,
                                       request->measures, (enum mo_back_end)request->job.back_end);
  return mo_memory_check(jobs, &need, message);
}

int mo_jobs_submit_atlas(struct mo_jobs *jobs, const struct mo_atlas_request *asked, int64_t *id,
                         bool *replayed, struct mo_message *message)
{
  struct mo_atlas_request request = *asked;
  struct mo_message taken = {.text = ""};
  request.controller = asked->controller != NULL ? asked->controller : "default";
  const struct mo_submitting submitting = {MO_JOB_ATLAS, &asked->job, request.controller, 1, 0};
  int error = mo_submitting_begin(jobs, &submitting, id, replayed, message);
  if (error != MO_OK || *replayed)
    return error;
  error = complete(jobs, &request, message);
  if (error == MO_OK)
    error = mo_jobs_admit(jobs, 1, 0, message);
  if (error != MO_OK)
    return error;
  error = mo_store_submit_atlas(jobs->store, &request, id, replayed, &taken);
  error = mo_submitting_end(jobs, &submitting, error, *replayed, message);
  if (error == MO_ERR_DUPLICATE && message != NULL)
    *message = taken;
  return error;
}

/* ---- the kind ---- */

static int need(struct mo_jobs *jobs, int64_t id, struct mo_need *need)
{
  struct mo_atlas_status status;
  const int error = mo_store_atlas(jobs->store, id, &status);
  if (error == MO_OK)
    *need = estimate(jobs, status.record.voxels, status.job.n_environments, status.record.measures,
                     status.job.back_end);
  return error;
}

const struct mo_kind mo_atlas_kind = {.kind = MO_JOB_ATLAS,
                                      .need = need,
                                      .first = MO_PHASE_PREPARE,
                                      .run_bytes = sizeof(struct run),
                                      .run = run_atlas,
                                      .save = save_rest,
                                      .clean_up = clean_up};
