/* metrics.c: the page /metrics (Prometheus text format). Names follow the rules of Prometheus: base
 * units, _total for counters, no labels with unbounded values. Uses only atomics and never waits.
 */
#include <string.h>

#include "api/handlers.h"
#include "http/metrics.h"

static void write_compute(struct mo_api *api, struct mo_text *text)
{
  struct mo_compute_stats c;
  mo_compute_get_stats(api->compute, &c);
  mo_metric_count(text, "morphod_workers", "gauge", "Computing threads.", c.n_workers);
  mo_metric_count(text, "morphod_workers_busy", "gauge", "Computing threads inside a block.",
                  c.n_busy);
  mo_metric_number(text, "morphod_worker_busy_seconds_total", "counter",
                   "Time of computing threads inside blocks.", c.busy_s);
  mo_metric_count(text, "morphod_worker_scratch_bytes", "gauge",
                  "Largest scratch memory of one computing thread.", c.worker_bytes_max);
  mo_metric_count(text, "morphod_blocks_total", "counter", "Blocks computed.", c.blocks_done);
  mo_metric_count(text, "morphod_blocks_preempted_total", "counter",
                  "Blocks set aside for urgent ones.", c.blocks_preempted);
  mo_metric_head(text, "morphod_blocks_queued", "gauge", "Blocks waiting for a computing thread.");
  mo_text_format(text,
                 "morphod_blocks_queued{priority=\"interactive\"} "
                 "%llu\nmorphod_blocks_queued{priority=\"batch\"} %llu\n",
                 (unsigned long long)c.queued_interactive, (unsigned long long)c.queued_batch);
  mo_metric_count(text, "morphod_rollouts_total", "counter", "Rollouts computed.", c.rollouts_done);
  mo_metric_count(text, "morphod_rollout_steps_total", "counter", "Steps of rollouts computed.",
                  c.rollout_steps);
  mo_metric_count(text, "morphod_rollouts_diverged_total", "counter",
                  "Rollouts whose numbers left the sane range.", c.rollouts_diverged);
}

/* Writes one series per device. */
static void write_devices(struct mo_api *api, struct mo_text *text)
{
  enum { LOST, LOAD, BUSY, CALLS, ROLLOUTS, ROBOTS, MEMORY, FREE, SERIES };
  static const struct {
    const char *name, *type, *help;
  } series[SERIES] = {
      [LOST] = {"morphod_device_lost", "gauge",
                "1 of a device that has failed and computes nothing any more."},
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
                "Free memory, as of the look before this one."},
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
      mo_text_format(text, "%s{device=\"%u\"} %.17g\n", series[s].name, status.index, values[s]);
    }
  }
}

static void write_jobs(struct mo_api *api, struct mo_text *text)
{
  struct mo_jobs_stats j;
  mo_jobs_get_stats(api->jobs, &j);
  mo_metric_head(text, "morphod_jobs", "gauge", "Jobs by state, at most a second old.");
  for (int state = 0; state < MO_JOB_STATES; state++)
    mo_text_format(text, "morphod_jobs{state=\"%s\"} %llu\n",
                   mo_job_state_name((enum mo_job_state)state),
                   (unsigned long long)atomic_load(&api->jobs_by_state[state]));
  mo_metric_count(text, "morphod_jobs_submitted_total", "counter", "Jobs accepted since the start.",
                  j.jobs_submitted);
  mo_metric_head(text, "morphod_jobs_finished_total", "counter", "Jobs ended since the start.");
  mo_text_format(text,
                 "morphod_jobs_finished_total{state=\"succeeded\"} "
                 "%llu\nmorphod_jobs_finished_total{state=\"failed\"} %llu\n"
                 "morphod_jobs_finished_total{state=\"cancelled\"} %llu\n",
                 (unsigned long long)j.jobs_succeeded, (unsigned long long)j.jobs_failed,
                 (unsigned long long)j.jobs_cancelled);
  mo_metric_count(text, "morphod_rollouts_open", "gauge", "Rollouts accepted and not yet done.",
                  j.open_rollouts);
  mo_metric_count(text, "morphod_rollouts_cached_total", "counter",
                  "Rollouts found in the store since the start.", j.rollouts_cached);
  mo_metric_count(text, "morphod_rollouts_shared_total", "counter",
                  "Rollouts computed once for several jobs since the start.", j.rollouts_shared);
}

/* Writes the time of the workers, urgent blocks included. */
static void write_worker_time(struct mo_api *api, struct mo_text *text)
{
  struct mo_jobs_stats j;
  mo_jobs_get_stats(api->jobs, &j);
  mo_metric_head(text, "morphod_job_worker_seconds_total", "counter",
                 "Time of computing threads by kind of job, since the start.");
  for (int kind = 0; kind < MO_JOB_KINDS; kind++) {
    mo_text_format(text, "morphod_job_worker_seconds_total{kind=\"%s\"} ",
                   mo_job_kind_name((enum mo_job_kind)kind));
    mo_text_json_number(text, j.worker_s[kind]);
    mo_text_add(text, "\n");
  }
  mo_metric_head(text, "morphod_job_device_seconds_total", "counter",
                 "Time of devices by kind of job, since the start.");
  for (int kind = 0; kind < MO_JOB_KINDS; kind++) {
    mo_text_format(text, "morphod_job_device_seconds_total{kind=\"%s\"} ",
                   mo_job_kind_name((enum mo_job_kind)kind));
    mo_text_json_number(text, j.device_s[kind]);
    mo_text_add(text, "\n");
  }
}

static void write_trainings(struct mo_api *api, struct mo_text *text)
{
  struct mo_jobs_stats j;
  mo_jobs_get_stats(api->jobs, &j);
  mo_metric_count(text, "morphod_trainings_running", "gauge",
                  "Trainings that run or are being prepared.", j.active_trainings);
  mo_metric_count(text, "morphod_training_steps_total", "counter",
                  "Steps of learning since the start.", j.training_steps);
  mo_metric_number(text, "morphod_training_step_seconds_total", "counter",
                   "Time of these steps: over their number, seconds per step.", j.training_step_s);
  mo_metric_count(text, "morphod_training_robots_total", "counter",
                  "Robots of these steps, each with its gradient.", j.training_robots);
  mo_metric_count(text, "morphod_training_robots_diverged_total", "counter",
                  "Of these, robots whose rollout diverged.", j.training_diverged);
  mo_metric_count(text, "morphod_training_robots_zeroed_total", "counter",
                  "Of these, robots whose gradient was not finite.", j.training_zeroed);
  mo_metric_count(text, "morphod_training_validations_total", "counter",
                  "Validations since the start.", j.training_validations);
  mo_metric_count(text, "morphod_training_checkpoints_total", "counter",
                  "Checkpoints written since the start.", j.training_checkpoints);
}

static void write_campaigns(struct mo_api *api, struct mo_text *text)
{
  struct mo_jobs_stats j;
  mo_jobs_get_stats(api->jobs, &j);
  mo_metric_count(text, "morphod_campaigns_running", "gauge",
                  "Campaigns that run or are being prepared.", j.active_campaigns);
  mo_metric_count(text, "morphod_campaign_generations_total", "counter",
                  "Generations committed since the start.", j.campaign_generations);
  mo_metric_count(text, "morphod_campaign_designs_total", "counter",
                  "Designs born in these generations.", j.campaign_designs);
  mo_metric_count(text, "morphod_campaign_rollouts_total", "counter",
                  "Rollouts computed for scores of campaigns.", j.campaign_rollouts);
  mo_metric_count(text, "morphod_campaign_rollouts_cached_total", "counter",
                  "Rollouts of committed generations that were found in the store.",
                  j.campaign_cached);
  mo_metric_count(text, "morphod_campaign_rollouts_diverged_total", "counter",
                  "Rollouts of committed generations that diverged.", j.campaign_diverged);
  mo_metric_count(text, "morphod_campaign_learning_steps_total", "counter",
                  "Steps of learning in campaigns.", j.campaign_steps);
}

static void write_store(struct mo_api *api, struct mo_text *text)
{
  struct mo_store_stats s;
  mo_store_get_stats(api->store, &s);
  mo_metric_count(text, "morphod_store_commits_total", "counter", "Commits since the start.",
                  s.commits);
  mo_metric_count(text, "morphod_store_operations_total", "counter",
                  "Operations written since the start.", s.operations);
  mo_metric_count(text, "morphod_store_operations_failed_total", "counter",
                  "Operations that failed since the start.", s.operations_failed);
  mo_metric_count(text, "morphod_store_operations_queued", "gauge",
                  "Operations waiting for the writer.", s.queued);
  mo_metric_number(text, "morphod_store_commit_seconds_total", "counter", "Time spent in commits.",
                   s.commit_s);
  mo_metric_count(text, "morphod_store_database_bytes", "gauge", "Size of the database.",
                  s.database_bytes > 0 ? (uint64_t)s.database_bytes : 0);
  mo_metric_count(text, "morphod_store_wal_bytes", "gauge", "Size of the write-ahead log.",
                  s.wal_bytes > 0 ? (uint64_t)s.wal_bytes : 0);
  mo_metric_count(text, "morphod_store_no_space", "gauge", "1 while the disk is full.", s.no_space);
}

void mo_api_metrics_write(struct mo_api *api, struct mo_text *text)
{
  mo_metric_head(text, "morphod_build_info", "gauge", "1; the labels tell the build.");
  mo_text_format(text, "morphod_build_info{version=\"%s\",fingerprint=", api->version);
  const char *fingerprint = mo_compute_fingerprint(api->compute, MO_FLOAT32);
  mo_text_json_string(text, fingerprint, strlen(fingerprint));
  mo_text_add(text, "} 1\n");
  mo_metric_count(text, "morphod_ready", "gauge", "1 while new work is taken.",
                  mo_http_is_ready(api->http));
  if (api->log_dropped != NULL)
    mo_metric_count(text, "morphod_log_lines_dropped_total", "counter",
                    "Log lines that standard error did not take.", api->log_dropped());
  mo_metrics_write(api->http, text);
  write_compute(api, text);
  write_devices(api, text);
  write_jobs(api, text);
  write_worker_time(api, text);
  write_trainings(api, text);
  write_campaigns(api, text);
  write_store(api, text);
}
