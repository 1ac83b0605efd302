/* metrics.c: the page /metrics (Prometheus text format). Uses only data in memory, and never waits
 * for computations or the store. */
#include <math.h>
#include <stdio.h>
#include <string.h>

#include "api/handlers.h"
#include "fleet/facts.h"
#include "http/metrics.h"
#include "jobs/live.h"

#define RUNNING_MAX 32 /* limit of running jobs with their own series */

/* Write a metric of one line to `text`. */
#define GAUGE(name, value, help)   mo_metric(text, name, "gauge", help, (double)(value))
#define COUNTER(name, value, help) mo_metric(text, name, "counter", help, (double)(value))

static void write_compute(struct mo_api *api, struct mo_text *text)
{
  struct mo_compute_stats c;
  mo_compute_get_stats(api->compute, &c);
  GAUGE("morphod_workers", c.n_workers, "Computing threads.");
  GAUGE("morphod_workers_busy", c.n_busy, "Computing threads inside a block.");
  COUNTER("morphod_worker_busy_seconds_total", c.busy_s,
          "Time of computing threads inside blocks.");
  GAUGE("morphod_worker_scratch_bytes", c.worker_bytes_max,
        "Largest scratch memory of any computing thread.");
  COUNTER("morphod_blocks_total", c.blocks_done, "Blocks computed.");
  COUNTER("morphod_blocks_preempted_total", c.blocks_preempted,
          "Blocks set aside for urgent ones.");
  mo_metric_head(text, "morphod_blocks_queued", "gauge", "Blocks waiting for a computing thread.");
  mo_metric_line(text, "morphod_blocks_queued", "priority", "interactive",
                 (double)c.queued_interactive);
  mo_metric_line(text, "morphod_blocks_queued", "priority", "batch", (double)c.queued_batch);
  COUNTER("morphod_rollouts_total", c.rollouts_done, "Rollouts computed.");
  COUNTER("morphod_rollout_steps_total", c.rollout_steps, "Steps of rollouts computed.");
  COUNTER("morphod_rollouts_diverged_total", c.rollouts_diverged, "Rollouts that diverged.");
}

/* Writes one series per device. */
static void write_devices(struct mo_api *api, struct mo_text *text)
{
  enum { LOST, LOAD, BUSY, CALLS, ROLLOUTS, ROBOTS, MEMORY, FREE, SERIES };
  static const struct {
    const char *name, *type, *help;
  } series[SERIES] = {
      [LOST] = {"morphod_device_lost", "gauge",
                "1 if the device has failed and no longer computes."},
      [LOAD] = {"morphod_device_load", "gauge",
                "Share of the last ten seconds in which the device was busy."},
      [BUSY] = {"morphod_device_busy_seconds_total", "counter", "Time of calls to the device."},
      [CALLS] = {"morphod_device_calls_total", "counter",
                 "Calls: chunks of rollouts, parts of gradients."},
      [ROLLOUTS] = {"morphod_device_rollouts_total", "counter", "Rollouts computed by the device."},
      [ROBOTS] = {"morphod_device_gradient_robots_total", "counter",
                  "Robots whose gradient the device computed."},
      [MEMORY] = {"morphod_device_memory_bytes", "gauge", "Memory of the device."},
      [FREE] = {"morphod_device_memory_free_bytes", "gauge",
                "Free memory, as of the previous request."},
  };
  struct mo_device_status status;
  for (int s = 0; s < SERIES && mo_compute_devices(api->compute) > 0; s++) {
    mo_metric_head(text, series[s].name, series[s].type, series[s].help);
    for (uint32_t i = 0; mo_compute_device(api->compute, i, &status) == MO_OK; i++) {
      const double values[SERIES] = {[LOST] = status.state == MO_DEVICE_LOST,
                                     [LOAD] = status.load,
                                     [BUSY] = status.busy_s,
                                     [CALLS] = (double)status.calls,
                                     [ROLLOUTS] = (double)status.rollouts_done,
                                     [ROBOTS] = (double)status.gradient_robots_done,
                                     [MEMORY] = (double)status.memory_bytes,
                                     [FREE] = (double)status.free_bytes};
      char index[16];
      snprintf(index, sizeof(index), "%u", status.index);
      mo_metric_line(text, series[s].name, "device", index, values[s]);
    }
  }
}

/* Writes zeros if there is no fleet, so that alert rules need no special case. */
static void write_fleet(struct mo_api *api, struct mo_text *text)
{
  static const char serving[] = "morphod_fleet_sessions";
  struct mo_fleet *fleet = atomic_load(&api->fleet);
  struct mo_fleet_status f = {0};
  if (fleet != NULL)
    mo_fleet_status(fleet, &f);
  GAUGE("morphod_fleet_listening", fleet != NULL, "1 while workers on other machines can join.");
  GAUGE("morphod_fleet_only", fleet != NULL && strcmp(api->fleet_compute, "fleet") == 0,
        "1 while only workers on other machines compute the scores of batch jobs.");
  mo_metric_head(text, serving, "gauge", "Workers on other machines that accept work, by class.");
  mo_metric_line(text, serving, "class", "cpu", f.n_serving[MO_ON_CPU]);
  mo_metric_line(text, serving, "class", "device", f.n_serving[MO_ON_DEVICE]);
  GAUGE("morphod_fleet_threads", f.n_threads, "Computing threads of these workers.");
  GAUGE("morphod_fleet_devices", f.n_devices, "GPUs of these workers.");
  GAUGE("morphod_fleet_leases", f.leases, "Leases that workers hold.");
  GAUGE("morphod_fleet_rollouts_out", f.rows_out, "Rollouts in these leases.");
  COUNTER("morphod_fleet_joined_total", f.joined, "Sessions that joined since the start.");
  COUNTER("morphod_fleet_lost_total", f.lost,
          "Sessions that ended without leaving since the start.");
  COUNTER("morphod_fleet_leases_total", f.leases_done, "Leases computed since the start.");
  COUNTER("morphod_fleet_leases_again_total", f.leases_again, "Leases reissued since the start.");
  COUNTER("morphod_fleet_rollouts_total", f.rows_done,
          "Rollouts computed by workers on other machines since the start.");
  COUNTER("morphod_fleet_rollouts_twice_total", f.rows_twice,
          "Of these, rollouts that had been computed before.");
  COUNTER("morphod_fleet_audits_total", f.audits, "Leases computed twice and compared.");
  COUNTER("morphod_fleet_audits_failed_total", f.audits_failed,
          "Audits that found different bits.");
}

static void write_jobs(struct mo_api *api, struct mo_text *text, const struct mo_jobs_stats *j)
{
  static const char finished[] = "morphod_jobs_finished_total";
  static const char worker[] = "morphod_job_worker_seconds_total";
  static const char device[] = "morphod_job_device_seconds_total";
  mo_metric_head(text, "morphod_jobs", "gauge", "Jobs by state, at most a second old.");
  for (int state = 0; state < MO_JOB_STATES; state++)
    mo_metric_line(text, "morphod_jobs", "state", mo_job_state_name((enum mo_job_state)state),
                   (double)atomic_load(&api->jobs_by_state[state]));
  COUNTER("morphod_jobs_submitted_total", j->jobs_submitted, "Jobs accepted since the start.");
  mo_metric_head(text, finished, "counter", "Jobs ended since the start.");
  mo_metric_line(text, finished, "state", "succeeded", (double)j->jobs_succeeded);
  mo_metric_line(text, finished, "state", "failed", (double)j->jobs_failed);
  mo_metric_line(text, finished, "state", "cancelled", (double)j->jobs_cancelled);
  GAUGE("morphod_rollouts_open", j->open_rollouts, "Rollouts accepted and not yet done.");
  COUNTER("morphod_rollouts_cached_total", j->rollouts_cached,
          "Rollouts found in the store since the start.");
  COUNTER("morphod_rollouts_shared_total", j->rollouts_shared,
          "Rollouts computed once for several jobs since the start.");
  /* Includes urgent blocks. */
  mo_metric_head(text, worker, "counter",
                 "Time of computing threads by kind of job, since the start.");
  for (int kind = 0; kind < MO_JOB_KINDS; kind++)
    mo_metric_line(text, worker, "kind", mo_job_kind_name((enum mo_job_kind)kind),
                   j->worker_s[kind]);
  mo_metric_head(text, device, "counter", "Time of devices by kind of job, since the start.");
  for (int kind = 0; kind < MO_JOB_KINDS; kind++)
    mo_metric_line(text, device, "kind", mo_job_kind_name((enum mo_job_kind)kind),
                   j->device_s[kind]);
}

/* Writes one series per running job of batch priority, for at most RUNNING_MAX jobs. Unknown values
 * have no series. */
static void write_running(struct mo_api *api, struct mo_text *text)
{
  enum { SHARE, DONE, PARTS, RATE, LEFT, BEST, SERIES };
  static const struct {
    const char *name, *help;
  } series[SERIES] = {
      [SHARE] = {"morphod_job_progress_ratio", "Share of a running job that is done."},
      [DONE] = {"morphod_job_parts_done", "Finished parts of a running job: rollouts of an "
                                          "evaluation, steps of a training run, generations of a "
                                          "campaign including the first population, bodies of "
                                          "an atlas, rollouts of a certificate."},
      [PARTS] = {"morphod_job_parts", "All parts of a running job."},
      [RATE] = {"morphod_job_rollouts_per_second",
                "Recent rollouts per second of a running job; for a training run, those with a "
                "gradient."},
      [LEFT] = {"morphod_job_left_seconds", "Estimated time until a running job ends."},
      [BEST] = {"morphod_job_best_score",
                "Best score in the newest population of a running campaign."},
  };
  struct mo_running jobs[RUNNING_MAX];
  const size_t n = mo_jobs_running(api->jobs, jobs, RUNNING_MAX);
  for (int s = 0; s < SERIES && n > 0; s++) {
    mo_metric_head(text, series[s].name, "gauge", series[s].help);
    for (size_t i = 0; i < n; i++) {
      const struct mo_live *live = &jobs[i].live;
      const bool evolves = jobs[i].kind == MO_JOB_CAMPAIGN;
      const bool counts = jobs[i].kind != MO_JOB_TRAINING && !evolves;
      const double done = counts ? (double)live->done : live->position;
      const double parts = counts ? (double)live->total : (double)live->last + evolves;
      const double begun = evolves && live->phase == MO_PHASE_SCORE && live->total > 0
                               ? (double)live->done / (double)live->total
                               : 0;
      const double values[SERIES] = {[SHARE] = (done + begun) / parts,
                                     [DONE] = done,
                                     [PARTS] = parts > 0 ? parts : NAN,
                                     [RATE] = live->rate > 0 ? live->rate : NAN,
                                     [LEFT] = live->seconds_left >= 0 ? live->seconds_left : NAN,
                                     [BEST] = live->best_score > 0 ? live->best_score : NAN};
      if (isnan(values[s]))
        continue;
      mo_text_format(text, "%s{id=\"%lld\",kind=\"%s\",label=", series[s].name,
                     (long long)jobs[i].id, mo_job_kind_name(jobs[i].kind));
      mo_metric_label(text, jobs[i].label);
      mo_text_add(text, "} ");
      mo_text_json_number(text, values[s]);
      mo_text_add(text, "\n");
    }
  }
}

static void write_trainings(struct mo_text *text, const struct mo_jobs_stats *j)
{
  GAUGE("morphod_trainings_running", j->active_trainings,
        "Training runs that are running or being prepared.");
  COUNTER("morphod_training_steps_total", j->training_steps, "Steps of learning since the start.");
  COUNTER("morphod_training_step_seconds_total", j->training_step_s,
          "Time of these steps; divided by their number, the seconds per step.");
  COUNTER("morphod_training_robots_total", j->training_robots,
          "Robots of these steps, each with its gradient.");
  COUNTER("morphod_training_robots_diverged_total", j->training_diverged,
          "Of these, robots whose rollout diverged.");
  COUNTER("morphod_training_robots_zeroed_total", j->training_zeroed,
          "Of these, robots whose gradient was not finite.");
  COUNTER("morphod_training_validations_total", j->training_validations,
          "Validations since the start.");
  COUNTER("morphod_training_checkpoints_total", j->training_checkpoints,
          "Checkpoints written since the start.");
}

static void write_atlases(struct mo_text *text, const struct mo_jobs_stats *j)
{
  GAUGE("morphod_atlases_running", j->active_atlases, "Atlases that are being built.");
  COUNTER("morphod_atlas_bodies_total", j->atlas_bodies,
          "Bodies added to files of atlases since the start.");
  COUNTER("morphod_atlas_rollouts_total", j->atlas_rollouts,
          "Rollouts computed for atlases since the start.");
}

static void write_certificates(struct mo_text *text, const struct mo_jobs_stats *j)
{
  GAUGE("morphod_certificates_running", j->active_certificates,
        "Certificates that are being computed.");
  COUNTER("morphod_certificate_rollouts_total", j->certificate_rollouts,
          "Rollouts computed for certificates since the start.");
}

static void write_campaigns(struct mo_text *text, const struct mo_jobs_stats *j)
{
  GAUGE("morphod_campaigns_running", j->active_campaigns,
        "Campaigns that are running or being prepared.");
  COUNTER("morphod_campaign_generations_total", j->campaign_generations,
          "Generations committed since the start.");
  COUNTER("morphod_campaign_designs_total", j->campaign_designs,
          "Designs born in these generations.");
  COUNTER("morphod_campaign_rollouts_total", j->campaign_rollouts,
          "Rollouts computed for scores of campaigns.");
  COUNTER("morphod_campaign_rollouts_cached_total", j->campaign_cached,
          "Rollouts of committed generations that were found in the store.");
  COUNTER("morphod_campaign_rollouts_diverged_total", j->campaign_diverged,
          "Rollouts of committed generations that diverged.");
  COUNTER("morphod_campaign_learning_steps_total", j->campaign_steps,
          "Steps of learning in campaigns.");
}

static void write_store(struct mo_api *api, struct mo_text *text)
{
  struct mo_store_stats s;
  mo_store_get_stats(api->store, &s);
  COUNTER("morphod_store_commits_total", s.commits, "Commits since the start.");
  COUNTER("morphod_store_operations_total", s.operations, "Operations written since the start.");
  COUNTER("morphod_store_operations_failed_total", s.operations_failed,
          "Operations that failed since the start.");
  GAUGE("morphod_store_operations_queued", s.queued, "Operations waiting for the writer.");
  COUNTER("morphod_store_commit_seconds_total", s.commit_s, "Time spent in commits.");
  GAUGE("morphod_store_database_bytes", s.database_bytes > 0 ? s.database_bytes : 0,
        "Size of the database.");
  GAUGE("morphod_store_wal_bytes", s.wal_bytes > 0 ? s.wal_bytes : 0,
        "Size of the write-ahead log.");
  GAUGE("morphod_recordings_bytes", s.recorded_bytes, "Size of the recordings that are kept.");
  COUNTER("morphod_recordings_removed_total", s.recordings_removed,
          "Evaluations whose recordings were removed since the start.");
  COUNTER("morphod_recordings_removed_bytes_total", s.recordings_removed_bytes,
          "Size of the recordings removed since the start.");
  COUNTER("morphod_jobs_expired_total", s.jobs_expired, "Jobs deleted by age since the start.");
  GAUGE("morphod_clock_ahead_seconds", (double)s.clock_ahead_us * 1e-6,
        "How far the clock is ahead of a credible time, so that nothing is deleted by age; "
        "otherwise 0.");
  GAUGE("morphod_store_no_space", s.no_space, "1 while the disk is full.");
}

void mo_api_metrics_write(struct mo_api *api, struct mo_text *text)
{
  struct mo_jobs_stats jobs;
  mo_jobs_get_stats(api->jobs, &jobs);
  mo_metric_head(text, "morphod_build_info", "gauge", "1; the labels show the build.");
  mo_text_format(text, "morphod_build_info{version=\"%s\",fingerprint=", api->version);
  const char *fingerprint = mo_compute_fingerprint(api->compute, MO_FLOAT32);
  mo_metric_label(text, fingerprint);
  mo_text_add(text, "} 1\n");
  GAUGE("morphod_ready", mo_http_is_ready(api->http), "1 while new work is accepted.");
  if (api->log_dropped != NULL)
    COUNTER("morphod_log_lines_dropped_total", api->log_dropped(),
            "Log lines that could not be written to standard error.");
  mo_metrics_write(api->http, text);
  write_compute(api, text);
  write_devices(api, text);
  write_fleet(api, text);
  write_jobs(api, text, &jobs);
  write_running(api, text);
  write_trainings(text, &jobs);
  write_campaigns(text, &jobs);
  write_atlases(text, &jobs);
  write_certificates(text, &jobs);
  write_store(api, text);
}
