/* metrics.c: see metrics.h. Names follow the rules of Prometheus: base units, _total for counters,
 * no labels with unbounded values. */
#include "http/metrics.h"

#include <stdio.h>
#include <string.h>

#include "http/server.h"

static const unsigned statuses[MO_METRIC_STATUSES] = {200, 201, 202, 204, 304, 400, 401, 403, 404,
                                                      405, 406, 408, 409, 411, 413, 414, 415, 417,
                                                      422, 429, 431, 500, 501, 503, 505, 507, 0};
static const double bounds_s[MO_METRIC_BUCKETS] = {
    0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30, 60};

void mo_metrics_request(struct mo_metrics *metrics, enum mo_route route, unsigned status,
                        int64_t duration_us, bool stream)
{
  size_t s = 0;
  while (s < MO_METRIC_STATUSES - 1 && statuses[s] != status)
    s++;
  atomic_fetch_add_explicit(&metrics->requests[route][s], 1, memory_order_relaxed);
  if (stream)
    return;
  size_t b = 0;
  while (b < MO_METRIC_BUCKETS && (double)duration_us > bounds_s[b] * 1e6)
    b++;
  atomic_fetch_add_explicit(&metrics->latency[b], 1, memory_order_relaxed);
  atomic_fetch_add_explicit(&metrics->latency_us, (uint64_t)(duration_us > 0 ? duration_us : 0),
                            memory_order_relaxed);
}

static void head(struct mo_text *text, const char *name, const char *type, const char *help)
{
  mo_text_format(text, "# HELP %s %s\n# TYPE %s %s\n", name, help, name, type);
}

static void whole(struct mo_text *text, const char *name, const char *type, const char *help,
                  uint64_t value)
{
  head(text, name, type, help);
  mo_text_format(text, "%s %llu\n", name, (unsigned long long)value);
}

static void real(struct mo_text *text, const char *name, const char *type, const char *help,
                 double value)
{
  head(text, name, type, help);
  mo_text_format(text, "%s %.9g\n", name, value);
}

static void write_requests(struct mo_http *http, struct mo_text *text)
{
  struct mo_metrics *metrics = &http->metrics;
  head(text, "morphod_http_requests_total", "counter",
       "Requests by route and status; code 0: ended before a reply.");
  for (size_t r = 0; r < MO_ROUTES; r++)
    for (size_t s = 0; s < MO_METRIC_STATUSES; s++) {
      uint64_t n = atomic_load_explicit(&metrics->requests[r][s], memory_order_relaxed);
      if (n > 0)
        mo_text_format(text, "morphod_http_requests_total{route=\"%s\",code=\"%u\"} %llu\n",
                       mo_routes[r].path, statuses[s], (unsigned long long)n);
    }
  head(text, "morphod_http_request_duration_seconds", "histogram",
       "Time from the end of a request's header to the end of its reply, event streams excepted.");
  uint64_t sum_us = atomic_load_explicit(&metrics->latency_us, memory_order_relaxed), n = 0;
  for (size_t b = 0; b < MO_METRIC_BUCKETS; b++) {
    n += atomic_load_explicit(&metrics->latency[b], memory_order_relaxed);
    mo_text_format(text, "morphod_http_request_duration_seconds_bucket{le=\"%g\"} %llu\n",
                   bounds_s[b], (unsigned long long)n);
  }
  n += atomic_load_explicit(&metrics->latency[MO_METRIC_BUCKETS], memory_order_relaxed);
  mo_text_format(text,
                 "morphod_http_request_duration_seconds_bucket{le=\"+Inf\"} %llu\n"
                 "morphod_http_request_duration_seconds_sum "
                 "%.6f\nmorphod_http_request_duration_seconds_count %llu\n",
                 (unsigned long long)n, (double)sum_us * 1e-6, (unsigned long long)n);
}

static void write_http(struct mo_http *http, struct mo_text *text)
{
  struct mo_metrics *m = &http->metrics;
  struct mo_http_stats stats;
  mo_http_get_stats(http, &stats);
  whole(text, "morphod_http_connections", "gauge", "Open connections.", stats.connections);
  whole(text, "morphod_http_connections_max", "gauge",
        "Connections that may be open: max_connections, or what the limit of open files leaves.",
        stats.max_connections);
  whole(text, "morphod_http_requests_in_flight", "gauge",
        "Requests under way, event streams included.", stats.in_flight);
  whole(text, "morphod_http_requests_queued", "gauge", "Requests waiting for an API thread.",
        stats.queued);
  whole(text, "morphod_http_connections_accepted_total", "counter", "Connections accepted.",
        stats.connections_accepted);
  whole(text, "morphod_http_connections_refused_total", "counter",
        "Connections refused: too many, or not allowed.", stats.connections_refused);
  whole(text, "morphod_http_connections_timed_out_total", "counter",
        "Connections cut off at a deadline.", stats.connections_timed_out);
  whole(text, "morphod_http_connections_gave_way_total", "counter",
        "Connections without a whole request that were closed for new ones.",
        stats.connections_gave_way);
  whole(text, "morphod_http_bodies_gave_way_total", "counter",
        "Half-sent request bodies that were dropped because others needed their memory.",
        atomic_load(&m->bodies_gave_way));
  whole(text, "morphod_http_unauthorized_total", "counter", "Requests without a valid token.",
        atomic_load(&m->unauthorized));
  whole(text, "morphod_http_request_body_bytes_total", "counter", "Bytes of request bodies.",
        atomic_load(&m->body_in));
  whole(text, "morphod_http_response_body_bytes_total", "counter", "Bytes of reply bodies.",
        atomic_load(&m->body_out));
  whole(text, "morphod_event_streams", "gauge", "Open event streams.", stats.streams);
  whole(text, "morphod_events_sent_total", "counter", "Events written to streams.",
        atomic_load(&m->events_sent));
  whole(text, "morphod_event_streams_dropped_total", "counter",
        "Event streams ended because their reader did not read.", atomic_load(&m->streams_dropped));
}

static void write_compute(struct mo_http *http, struct mo_text *text)
{
  struct mo_compute_stats c;
  mo_compute_get_stats(http->services.compute, &c);
  whole(text, "morphod_workers", "gauge", "Computing threads.", c.n_workers);
  whole(text, "morphod_workers_busy", "gauge", "Computing threads inside a block.", c.n_busy);
  real(text, "morphod_worker_busy_seconds_total", "counter",
       "Time of computing threads inside blocks.", c.busy_s);
  whole(text, "morphod_worker_scratch_bytes", "gauge",
        "Largest scratch memory of one computing thread.", c.worker_bytes_max);
  whole(text, "morphod_blocks_total", "counter", "Blocks computed.", c.blocks_done);
  whole(text, "morphod_blocks_preempted_total", "counter", "Blocks set aside for urgent ones.",
        c.blocks_preempted);
  head(text, "morphod_blocks_queued", "gauge", "Blocks waiting for a computing thread.");
  mo_text_format(text,
                 "morphod_blocks_queued{priority=\"interactive\"} "
                 "%llu\nmorphod_blocks_queued{priority=\"batch\"} %llu\n",
                 (unsigned long long)c.queued_interactive, (unsigned long long)c.queued_batch);
  whole(text, "morphod_rollouts_total", "counter", "Rollouts computed.", c.rollouts_done);
  whole(text, "morphod_rollout_steps_total", "counter", "Steps of rollouts computed.",
        c.rollout_steps);
  whole(text, "morphod_rollouts_diverged_total", "counter",
        "Rollouts whose numbers left the sane range.", c.rollouts_diverged);
}

/* Writes one series per device. */
static void write_devices(struct mo_http *http, struct mo_text *text)
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
  for (int s = 0; s < SERIES && mo_compute_devices(http->services.compute) > 0; s++) {
    head(text, series[s].name, series[s].type, series[s].help);
    for (uint32_t i = 0; mo_compute_device(http->services.compute, i, &status) == MO_OK; i++) {
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

static void write_jobs(struct mo_http *http, struct mo_text *text)
{
  struct mo_jobs_stats j;
  mo_jobs_get_stats(http->services.jobs, &j);
  head(text, "morphod_jobs", "gauge", "Jobs by state, at most a second old.");
  for (int state = 0; state < MO_JOB_STATES; state++)
    mo_text_format(text, "morphod_jobs{state=\"%s\"} %llu\n",
                   mo_job_state_name((enum mo_job_state)state),
                   (unsigned long long)atomic_load(&http->jobs_by_state[state]));
  whole(text, "morphod_jobs_submitted_total", "counter", "Jobs accepted since the start.",
        j.jobs_submitted);
  head(text, "morphod_jobs_finished_total", "counter", "Jobs ended since the start.");
  mo_text_format(text,
                 "morphod_jobs_finished_total{state=\"succeeded\"} "
                 "%llu\nmorphod_jobs_finished_total{state=\"failed\"} %llu\n"
                 "morphod_jobs_finished_total{state=\"cancelled\"} %llu\n",
                 (unsigned long long)j.jobs_succeeded, (unsigned long long)j.jobs_failed,
                 (unsigned long long)j.jobs_cancelled);
  whole(text, "morphod_rollouts_open", "gauge", "Rollouts accepted and not yet done.",
        j.open_rollouts);
  whole(text, "morphod_rollouts_cached_total", "counter",
        "Rollouts found in the store since the start.", j.rollouts_cached);
  whole(text, "morphod_rollouts_shared_total", "counter",
        "Rollouts computed once for several jobs since the start.", j.rollouts_shared);
}

/* Writes the time of the workers, urgent blocks included. */
static void write_worker_time(struct mo_http *http, struct mo_text *text)
{
  struct mo_jobs_stats j;
  mo_jobs_get_stats(http->services.jobs, &j);
  head(text, "morphod_job_worker_seconds_total", "counter",
       "Time of computing threads by kind of job, since the start.");
  for (int kind = 0; kind < MO_JOB_KINDS; kind++) {
    mo_text_format(text, "morphod_job_worker_seconds_total{kind=\"%s\"} ",
                   mo_job_kind_name((enum mo_job_kind)kind));
    mo_text_json_number(text, j.worker_s[kind]);
    mo_text_add(text, "\n");
  }
  head(text, "morphod_job_device_seconds_total", "counter",
       "Time of devices by kind of job, since the start.");
  for (int kind = 0; kind < MO_JOB_KINDS; kind++) {
    mo_text_format(text, "morphod_job_device_seconds_total{kind=\"%s\"} ",
                   mo_job_kind_name((enum mo_job_kind)kind));
    mo_text_json_number(text, j.device_s[kind]);
    mo_text_add(text, "\n");
  }
}

static void write_trainings(struct mo_http *http, struct mo_text *text)
{
  struct mo_jobs_stats j;
  mo_jobs_get_stats(http->services.jobs, &j);
  whole(text, "morphod_trainings_running", "gauge", "Trainings that run or are being prepared.",
        j.active_trainings);
  whole(text, "morphod_training_steps_total", "counter", "Steps of learning since the start.",
        j.training_steps);
  real(text, "morphod_training_step_seconds_total", "counter",
       "Time of these steps: over their number, seconds per step.", j.training_step_s);
  whole(text, "morphod_training_robots_total", "counter",
        "Robots of these steps, each with its gradient.", j.training_robots);
  whole(text, "morphod_training_robots_diverged_total", "counter",
        "Of these, robots whose rollout diverged.", j.training_diverged);
  whole(text, "morphod_training_robots_zeroed_total", "counter",
        "Of these, robots whose gradient was not finite.", j.training_zeroed);
  whole(text, "morphod_training_validations_total", "counter", "Validations since the start.",
        j.training_validations);
  whole(text, "morphod_training_checkpoints_total", "counter",
        "Checkpoints written since the start.", j.training_checkpoints);
}

static void write_campaigns(struct mo_http *http, struct mo_text *text)
{
  struct mo_jobs_stats j;
  mo_jobs_get_stats(http->services.jobs, &j);
  whole(text, "morphod_campaigns_running", "gauge", "Campaigns that run or are being prepared.",
        j.active_campaigns);
  whole(text, "morphod_campaign_generations_total", "counter",
        "Generations committed since the start.", j.campaign_generations);
  whole(text, "morphod_campaign_designs_total", "counter", "Designs born in these generations.",
        j.campaign_designs);
  whole(text, "morphod_campaign_rollouts_total", "counter",
        "Rollouts computed for scores of campaigns.", j.campaign_rollouts);
  whole(text, "morphod_campaign_rollouts_cached_total", "counter",
        "Rollouts of committed generations that were found in the store.", j.campaign_cached);
  whole(text, "morphod_campaign_rollouts_diverged_total", "counter",
        "Rollouts of committed generations that diverged.", j.campaign_diverged);
  whole(text, "morphod_campaign_learning_steps_total", "counter", "Steps of learning in campaigns.",
        j.campaign_steps);
}

static void write_store(struct mo_http *http, struct mo_text *text)
{
  struct mo_store_stats s;
  mo_store_get_stats(http->services.store, &s);
  whole(text, "morphod_store_commits_total", "counter", "Commits since the start.", s.commits);
  whole(text, "morphod_store_operations_total", "counter", "Operations written since the start.",
        s.operations);
  whole(text, "morphod_store_operations_failed_total", "counter",
        "Operations that failed since the start.", s.operations_failed);
  whole(text, "morphod_store_operations_queued", "gauge", "Operations waiting for the writer.",
        s.queued);
  real(text, "morphod_store_commit_seconds_total", "counter", "Time spent in commits.", s.commit_s);
  whole(text, "morphod_store_database_bytes", "gauge", "Size of the database.",
        s.database_bytes > 0 ? (uint64_t)s.database_bytes : 0);
  whole(text, "morphod_store_wal_bytes", "gauge", "Size of the write-ahead log.",
        s.wal_bytes > 0 ? (uint64_t)s.wal_bytes : 0);
  whole(text, "morphod_store_no_space", "gauge", "1 while the disk is full.", s.no_space);
}

void mo_metrics_write(struct mo_http *http, struct mo_text *text)
{
  head(text, "morphod_build_info", "gauge", "1; the labels tell the build.");
  mo_text_format(text, "morphod_build_info{version=\"%s\",fingerprint=", http->version);
  const char *fingerprint = mo_compute_fingerprint(http->services.compute, MO_FLOAT32);
  mo_text_json_string(text, fingerprint, strlen(fingerprint));
  mo_text_add(text, "} 1\n");
  whole(text, "morphod_ready", "gauge", "1 while new work is taken.", atomic_load(&http->ready));
  if (http->config.log_dropped != NULL)
    whole(text, "morphod_log_lines_dropped_total", "counter",
          "Log lines that standard error did not take.", http->config.log_dropped());
  write_requests(http, text);
  write_http(http, text);
  write_compute(http, text);
  write_devices(http, text);
  write_jobs(http, text);
  write_worker_time(http, text);
  write_trainings(http, text);
  write_campaigns(http, text);
  write_store(http, text);
}
