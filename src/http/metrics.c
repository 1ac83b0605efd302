/* metrics.c: see metrics.h. Names follow the rules of Prometheus: base units, _total for counters,
 * no labels with unbounded values. */
#include "http/metrics.h"

#include <string.h>

#include "http/server.h"

/* Write a metric of one line to `text`. */
#define GAUGE(name, value, help)   mo_metric(text, name, "gauge", help, (double)(value))
#define COUNTER(name, value, help) mo_metric(text, name, "counter", help, (double)(value))

static const unsigned statuses[MO_METRIC_STATUSES] = {200, 201, 202, 204, 304, 400, 401, 403, 404,
                                                      405, 406, 408, 409, 411, 413, 414, 415, 417,
                                                      422, 429, 431, 500, 501, 503, 505, 507, 0};
static const double bounds_s[MO_METRIC_BUCKETS] = {
    0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30, 60};

/* Returns the index of a route in the counters, which is the index of the first line of its
 * path. */
static size_t place_of(const struct mo_routes *routes, const struct mo_route *route)
{
  if (route == NULL)
    return MO_ROUTES_MAX;
  size_t place = (size_t)(route - routes->items);
  while (place > 0 && strcmp(routes->items[place - 1].path, route->path) == 0)
    place--;
  return place;
}

void mo_metrics_request(struct mo_http *http, const struct mo_route *route, unsigned status,
                        int64_t duration_us, bool stream)
{
  struct mo_metrics *metrics = &http->metrics;
  size_t s = 0, place = place_of(&http->service.routes, route);
  while (s < MO_METRIC_STATUSES - 1 && statuses[s] != status)
    s++;
  atomic_fetch_add_explicit(&metrics->requests[place][s], 1, memory_order_relaxed);
  if (stream)
    return;
  size_t b = 0;
  while (b < MO_METRIC_BUCKETS && (double)duration_us > bounds_s[b] * 1e6)
    b++;
  atomic_fetch_add_explicit(&metrics->latency[b], 1, memory_order_relaxed);
  atomic_fetch_add_explicit(&metrics->latency_us, (uint64_t)(duration_us > 0 ? duration_us : 0),
                            memory_order_relaxed);
}

void mo_metric_head(struct mo_text *text, const char *name, const char *type, const char *help)
{
  mo_text_format(text, "# HELP %s %s\n# TYPE %s %s\n", name, help, name, type);
}

void mo_metric_label(struct mo_text *text, const char *value)
{
  mo_text_bytes(text, "\"", 1);
  for (; *value != '\0'; value++) {
    if (*value == '\\' || *value == '"' || *value == '\n')
      mo_text_bytes(text, "\\", 1);
    mo_text_bytes(text, *value == '\n' ? "n" : value, 1);
  }
  mo_text_bytes(text, "\"", 1);
}

void mo_metric_line(struct mo_text *text, const char *name, const char *label, const char *of,
                    double value)
{
  mo_text_format(text, label != NULL ? "%s{%s=\"%s\"} " : "%s ", name, label, of);
  mo_text_json_number(text, value);
  mo_text_add(text, "\n");
}

void mo_metric(struct mo_text *text, const char *name, const char *type, const char *help,
               double value)
{
  mo_metric_head(text, name, type, help);
  mo_metric_line(text, name, NULL, NULL, value);
}

void mo_http_get_stats(struct mo_http *http, struct mo_http_stats *stats)
{
  *stats = (struct mo_http_stats){
      .connections = atomic_load(&http->n_connections),
      .in_flight = atomic_load(&http->n_in_flight),
      .max_connections = http->config.max_connections,
  };
  for (size_t r = 0; r <= MO_ROUTES_MAX; r++)
    for (size_t s = 0; s < MO_METRIC_STATUSES; s++)
      stats->requests += atomic_load_explicit(&http->metrics.requests[r][s], memory_order_relaxed);
  int64_t beats[] = {atomic_load(&http->acceptor_us), atomic_load(&http->clock_us)};
  stats->heartbeat_us = beats[0] < beats[1] ? beats[0] : beats[1];
}

static void write_requests(struct mo_http *http, struct mo_text *text)
{
  struct mo_metrics *metrics = &http->metrics;
  mo_metric_head(text, "morphod_http_requests_total", "counter",
                 "Requests by route and status; code 0: ended without a reply.");
  for (size_t r = 0; r <= MO_ROUTES_MAX; r++)
    for (size_t s = 0; s < MO_METRIC_STATUSES; s++) {
      uint64_t n = atomic_load_explicit(&metrics->requests[r][s], memory_order_relaxed);
      if (n > 0)
        mo_text_format(text, "morphod_http_requests_total{route=\"%s\",code=\"%u\"} %llu\n",
                       r < MO_ROUTES_MAX ? http->service.routes.items[r].path : "other",
                       statuses[s], (unsigned long long)n);
    }
  mo_metric_head(
      text, "morphod_http_request_duration_seconds", "histogram",
      "Time from the end of a request's header to the end of its reply, except event streams.");
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

void mo_metrics_write(struct mo_http *http, struct mo_text *text)
{
  struct mo_metrics *m = &http->metrics;
  write_requests(http, text);
  GAUGE("morphod_http_connections", atomic_load(&http->n_connections), "Open connections.");
  GAUGE("morphod_http_connections_max", http->config.max_connections,
        "Limit on open connections: max_connections, or fewer if the limit on open files requires "
        "it.");
  GAUGE("morphod_http_requests_in_flight", atomic_load(&http->n_in_flight),
        "Requests in flight, including event streams.");
  GAUGE("morphod_http_requests_queued", atomic_load(&http->pool.n_queued),
        "Requests waiting for an API thread.");
  COUNTER("morphod_http_connections_accepted_total", atomic_load(&m->accepted),
          "Connections accepted.");
  COUNTER("morphod_http_connections_refused_total", atomic_load(&m->refused),
          "Connections refused: too many, or not allowed.");
  COUNTER("morphod_http_connections_timed_out_total", atomic_load(&m->timed_out),
          "Connections cut off at a deadline.");
  COUNTER("morphod_http_connections_gave_way_total", atomic_load(&m->gave_way),
          "Connections without a complete request that were closed to make room for new ones.");
  COUNTER("morphod_http_bodies_gave_way_total", atomic_load(&m->bodies_gave_way),
          "Incomplete request bodies that were dropped because others needed their memory.");
  COUNTER("morphod_http_unauthorized_total", atomic_load(&m->unauthorized),
          "Requests without a valid token.");
  COUNTER("morphod_http_request_body_bytes_total", atomic_load(&m->body_in),
          "Bytes of request bodies.");
  COUNTER("morphod_http_response_body_bytes_total", atomic_load(&m->body_out),
          "Bytes of reply bodies.");
  GAUGE("morphod_event_streams", atomic_load(&http->streams.n), "Open event streams.");
  COUNTER("morphod_events_sent_total", atomic_load(&m->events_sent), "Events written to streams.");
  COUNTER("morphod_event_streams_dropped_total", atomic_load(&m->streams_dropped),
          "Event streams closed because the client did not read them.");
}
