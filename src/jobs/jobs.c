/* jobs.c: the table of kinds; starting, stopping, controlling and waiting for jobs; statistics. */
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "base/clock.h"
#include "base/thread.h"
#include "jobs/submission.h"
#include "jobs/trainings.h"

#define MARKER_LINE_BYTES 64

const struct mo_kind *const mo_kinds[MO_JOB_KINDS] = {[MO_JOB_EVALUATION] = &mo_evaluation_kind,
                                                      [MO_JOB_TRAINING] = &mo_training_kind,
                                                      [MO_JOB_CAMPAIGN] = &mo_campaign_kind,
                                                      [MO_JOB_ATLAS] = &mo_atlas_kind,
                                                      [MO_JOB_CERTIFICATE] = &mo_certificate_kind};

/* ---- the configuration ---- */

/* Replaces 0 with the default, and limits the value. most 0: no limit. */
static void complete(uint32_t *value, uint32_t none, uint32_t most)
{
  if (*value == 0)
    *value = none;
  if (most > 0 && *value > most)
    *value = most;
}

static void complete_config(struct mo_jobs *jobs)
{
  struct mo_jobs_config *config = &jobs->config;
  complete(&config->max_open_jobs, 10000, 0);
  complete(&config->max_active_trainings, 1, 16);
  complete(&config->max_active_campaigns, 4, 64);
  complete(&config->retry_ms, 1000, 0);
  if (config->max_open_rollouts == 0)
    config->max_open_rollouts = 20000000;
  if (config->max_recorded_bytes == 0)
    config->max_recorded_bytes = UINT64_C(64) << 20;
  if (config->max_memory > 0 && config->max_recorded_bytes > config->max_memory / 4)
    config->max_recorded_bytes = config->max_memory / 4;
  config->crash_marker = NULL; /* already read, and owned by the caller */
}

/* ---- the marker: the job that a dying process was working on ---- */

static size_t put_number(char *to, int64_t value)
{
  char digits[24];
  size_t n = 0, length = 0;
  do {
    digits[n++] = (char)('0' + value % 10);
    value /= 10;
  } while (value > 0);
  while (n > 0)
    to[length++] = digits[--n];
  return length;
}

void mo_jobs_crash_note(int fd, int signal_number)
{
  const int64_t tag = mo_thread_tag;
  char line[MARKER_LINE_BYTES];
  if (tag <= 0 || signal_number < 0)
    return;
  size_t n = put_number(line, tag);
  line[n++] = ' ';
  n += put_number(line + n, signal_number);
  line[n++] = '\n';
  if (write(fd, line, n) < 0)
    return; /* nothing more can be done here */
}

/* Reads the last whole line "<job> <signal>" of the marker. job 0: there is none. */
static void read_marker(const char *path, int64_t *job, int *signal_number)
{
  FILE *file = path != NULL ? fopen(path, "re") : NULL;
  char line[MARKER_LINE_BYTES], *end;
  *job = 0;
  *signal_number = 0;
  while (file != NULL && fgets(line, sizeof(line), file) != NULL && strchr(line, '\n') != NULL) {
    *job = strtoll(line, &end, 10);
    *signal_number = (int)strtol(end, NULL, 10);
  }
  if (file != NULL)
    fclose(file);
  if (*job < 0)
    *job = 0;
}

/* Chooses the job that is charged with a kill of unknown cause: the only job that had saved nothing
 * since the process began. If there were several such jobs, or none, no job is charged, and jobs
 * start one at a time. */
static int blame(struct mo_jobs *jobs, int64_t *crashed)
{
  uint32_t n = 0, n_idle = 0;
  const int error = mo_store_running(jobs->store, jobs->config.killed_us, crashed, &n_idle, &n);
  if (n_idle != 1) {
    *crashed = 0;
    jobs->memory.n_suspects = n;
  }
  return error;
}

static int recover(struct mo_jobs *jobs, const char *marker)
{
  char text[192];
  int64_t crashed;
  int signal_number;
  int error;
  read_marker(marker, &crashed, &signal_number);
  snprintf(text, sizeof(text), "the process was killed by signal %d (%s) while it ran this job",
           signal_number,
           sigdescr_np(signal_number) != NULL ? sigdescr_np(signal_number) : "unknown");
  if (crashed == 0 && jobs->config.killed_us > 0) {
    snprintf(text, sizeof(text),
             "the process was killed while it ran this job, before the job had saved a generation, "
             "a checkpoint, or more than a second of scores; the machine may lack memory for it");
    error = blame(jobs, &crashed);
    if (error != MO_OK)
      return error;
  }
  error = mo_store_requeue(jobs->store, crashed, MO_ATTEMPTS_MAX, text);
  if (error == MO_OK && marker != NULL && truncate(marker, 0) != 0 && errno != ENOENT)
    error = MO_ERR_IO;
  return error;
}

/* ---- start and stop ---- */

static int prepare(struct mo_jobs *jobs, const char *marker)
{
  int error = mo_lattice_create(MO_STORE_WORKSPACE, &jobs->lattice);
  if (error == MO_OK)
    error = mo_back_end_prepare(jobs);
  if (error == MO_OK)
    error = recover(jobs, marker);
  if (error == MO_OK)
    error = mo_jobs_recount(jobs);
  return error;
}

/* Asks all threads to stop. */
static void stop(struct mo_jobs *jobs)
{
  atomic_store(&jobs->is_stopping, true);
  for (int kind = 0; kind < MO_JOB_KINDS; kind++)
    mo_runners_stop(&jobs->runners[kind]);
}

static void free_jobs(struct mo_jobs *jobs)
{
  mo_store_meter(jobs->store, NULL, NULL);
  for (int kind = 0; kind < MO_JOB_KINDS; kind++)
    mo_runners_free(&jobs->runners[kind]);
  for (int kind = 0; kind < MO_JOB_KINDS; kind++)
    if (mo_kinds[kind]->close != NULL)
      mo_kinds[kind]->close(jobs);
  mo_loaded_free_all(&jobs->controllers);
  mo_lattice_free(jobs->lattice);
  free(jobs->code_versions[MO_ON_CPU]);
  free(jobs->code_versions[MO_ON_DEVICE]);
  mo_memory_free(jobs);
  free(jobs);
}

int mo_jobs_create(struct mo_store *store, struct mo_compute *compute,
                   const struct mo_jobs_config *config, struct mo_jobs **ret,
                   struct mo_message *message)
{
  struct mo_jobs *jobs = malloc(sizeof(*jobs));
  if (jobs == NULL)
    return mo_fail(message, MO_ERR_NO_MEMORY, "out of memory");
  *jobs = (struct mo_jobs){
      .store = store,
      .compute = compute,
      .config = *config,
      .memory.mutex = PTHREAD_MUTEX_INITIALIZER,
      .admission_mutex = PTHREAD_MUTEX_INITIALIZER,
      .class_mutex = PTHREAD_MUTEX_INITIALIZER,
      .weigh_mutex = PTHREAD_MUTEX_INITIALIZER,
      .shares_mutex = PTHREAD_MUTEX_INITIALIZER,
      .exclusions_mutex = PTHREAD_MUTEX_INITIALIZER,
      .controllers = {.store = store, .compute = compute, .mutex = PTHREAD_MUTEX_INITIALIZER}};
  complete_config(jobs);
  mo_memory_init(jobs);
  for (int kind = 0; kind < MO_JOB_KINDS; kind++)
    jobs->runners[kind] = (struct mo_runners){.kind = mo_kinds[kind],
                                              .mutex = PTHREAD_MUTEX_INITIALIZER,
                                              .news = PTHREAD_COND_INITIALIZER};
  const uint32_t n_threads[MO_JOB_KINDS] = {[MO_JOB_EVALUATION] = 1,
                                            [MO_JOB_TRAINING] = jobs->config.max_active_trainings,
                                            [MO_JOB_CAMPAIGN] = jobs->config.max_active_campaigns,
                                            [MO_JOB_ATLAS] = 1,
                                            [MO_JOB_CERTIFICATE] = 1};
  atomic_store(&jobs->heartbeat_us, mo_clock_us());
  mo_store_meter(store, mo_share_used, jobs);
  int error = prepare(jobs, config->crash_marker);
  for (int kind = 0; kind < MO_JOB_KINDS && error == MO_OK; kind++)
    if (mo_kinds[kind]->open != NULL)
      error = mo_kinds[kind]->open(jobs);
  for (int kind = 0; kind < MO_JOB_KINDS && error == MO_OK; kind++)
    error = mo_runners_start(jobs, &jobs->runners[kind], n_threads[kind]);
  if (error != MO_OK) {
    stop(jobs);
    free_jobs(jobs);
    return mo_fail(message, error, "the scheduler cannot start: %s", mo_error_text(error));
  }
  *ret = jobs;
  return MO_OK;
}

int mo_jobs_stop(struct mo_jobs *jobs, uint32_t deadline_ms)
{
  const int64_t end_us = mo_clock_us() + (int64_t)deadline_ms * 1000;
  bool is_saved = true;
  stop(jobs);
  for (int kind = 0; kind < MO_JOB_KINDS; kind++)
    is_saved = mo_runners_wait(&jobs->runners[kind], end_us) &&
               !atomic_load(&jobs->runners[kind].unsaved) && is_saved;
  atomic_store(&jobs->abandon, true); /* the time for retrying failed saves is over */
  return is_saved && !atomic_load(&jobs->no_space) ? MO_OK : MO_ERR_BUSY;
}

void mo_jobs_free(struct mo_jobs *jobs)
{
  if (jobs == NULL)
    return;
  stop(jobs);
  free_jobs(jobs);
}

/* ---- control ---- */

static int change(struct mo_jobs *jobs, int64_t id, enum mo_job_change change_to)
{
  struct mo_job job;
  struct mo_runners *runners;
  enum mo_job_state before = MO_JOB_QUEUED;
  int error = mo_store_job(jobs->store, id, &job);
  if (error != MO_OK)
    return error;
  runners = &jobs->runners[job.kind];
  bool reopens = runners->kind->run != NULL && change_to == MO_CHANGE_RESUME &&
                 job.state == MO_JOB_FAILED; /* the queue must have space for it */
  if (reopens)
    error = mo_jobs_admit(jobs, 1, 0, NULL);
  if (error != MO_OK)
    return error;
  error = mo_store_change_job(jobs->store, id, reopens ? MO_CHANGE_RETRY : change_to, &before);
  if (reopens && (error != MO_OK || before != MO_JOB_FAILED)) /* another request was faster */
    mo_jobs_closed(jobs, 1, 0);
  if (error != MO_OK)
    return error;
  if (change_to == MO_CHANGE_CANCEL) {
    atomic_fetch_add(&jobs->jobs_cancelled, 1);
    mo_jobs_closed(jobs, 1, mo_job_admitted(&job));
  }
  mo_memory_forget(jobs, id);
  if (change_to == MO_CHANGE_RESUME)
    mo_runners_wake(runners);
  else
    mo_runners_request(runners, id,
                       change_to == MO_CHANGE_CANCEL ? MO_REQUEST_CANCEL : MO_REQUEST_PAUSE);
  return MO_OK;
}

int mo_jobs_cancel(struct mo_jobs *jobs, int64_t id)
{
  return change(jobs, id, MO_CHANGE_CANCEL);
}

int mo_jobs_pause(struct mo_jobs *jobs, int64_t id)
{
  return change(jobs, id, MO_CHANGE_PAUSE);
}

int mo_jobs_resume(struct mo_jobs *jobs, int64_t id)
{
  return change(jobs, id, MO_CHANGE_RESUME);
}

int mo_jobs_set_weight(struct mo_jobs *jobs, int64_t id, double weight)
{
  const int error = mo_store_set_weight(jobs->store, id, weight);
  if (error != MO_OK)
    return error;
  (void)mo_share_reweigh(jobs, id); /* unreadable: the weight takes effect at the next start */
  return MO_OK;
}

int mo_jobs_edit(struct mo_jobs *jobs, int64_t id, const struct mo_job_edit *edit)
{
  const int error = mo_store_edit_job(jobs->store, id, edit);
  if (error == MO_OK && edit->has_label)
    (void)mo_share_reweigh(jobs, id); /* unreadable: metrics show the old label */
  return error;
}

/* ---- statistics ---- */

const struct mo_lattice *mo_jobs_lattice(const struct mo_jobs *jobs)
{
  return jobs->lattice;
}

void mo_jobs_get_stats(struct mo_jobs *jobs, struct mo_jobs_stats *stats)
{
  *stats = (struct mo_jobs_stats){
#define MO_JOBS_COUNT(name) .name = atomic_load(&jobs->name),
      MO_JOBS_COUNTS(MO_JOBS_COUNT)
#undef MO_JOBS_COUNT
          .active_trainings = atomic_load(&jobs->runners[MO_JOB_TRAINING].active),
      .active_campaigns = atomic_load(&jobs->runners[MO_JOB_CAMPAIGN].active),
      .active_atlases = atomic_load(&jobs->runners[MO_JOB_ATLAS].active),
      .active_certificates = atomic_load(&jobs->runners[MO_JOB_CERTIFICATE].active),
      .training_step_s = (double)atomic_load(&jobs->training_ns) * 1e-9,
      .heartbeat_us = atomic_load(&jobs->heartbeat_us),
      .no_space = atomic_load(&jobs->no_space),
  };
  mo_shares_seconds(jobs, stats->worker_s, stats->device_s);
}
