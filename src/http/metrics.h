/* metrics.h: counters of the HTTP room, and writers of the Prometheus text format. It uses only
 * atomics and never waits. */
#ifndef MORPHO_HTTP_METRICS_H
#define MORPHO_HTTP_METRICS_H

#include <stdatomic.h>
#include <stdint.h>

#include "base/text.h"
#include "http/route.h"

#define MO_METRIC_STATUSES 27
#define MO_METRIC_BUCKETS  15

struct mo_metrics {
  _Atomic uint64_t requests[MO_ROUTES_MAX + 1][MO_METRIC_STATUSES]; /* by the first line of the
                                                                       path; the last: unknown
                                                                       paths */
  _Atomic uint64_t latency[MO_METRIC_BUCKETS + 1]; /* not cumulative; the last: above all bounds */
  _Atomic uint64_t latency_us;
  _Atomic uint64_t body_in, body_out;
  _Atomic uint64_t accepted, refused, timed_out, gave_way, bodies_gave_way, unauthorized,
      events_sent, streams_dropped;
};

struct mo_http;

/* Counts one request. route nullable. Streams are not in the histogram of latencies. */
void mo_metrics_request(struct mo_http *http, const struct mo_route *route, unsigned status,
                        int64_t duration_us, bool stream);
/* Write the head of a metric, one line of a metric (label nullable), and a complete metric of one
 * line. */
void mo_metric_head(struct mo_text *text, const char *name, const char *type, const char *help);
void mo_metric_line(struct mo_text *text, const char *name, const char *label, const char *of,
                    double value);
void mo_metric(struct mo_text *text, const char *name, const char *type, const char *help,
               double value);
/* Writes the value of a label in quotes, which may be any text. */
void mo_metric_label(struct mo_text *text, const char *value);
/* Writes the metrics of this room. */
void mo_metrics_write(struct mo_http *http, struct mo_text *text);

#endif
