/* lifecycle.c: the beginning and the end of a request. */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "base/clock.h"
#include "http/download.h"
#include "http/query.h"
#include "http/server.h"

struct mo_request *mo_request_begin(struct mo_connection *connection, struct MHD_Connection *mhd,
                                    const char *target)
{
  struct mo_http *http = connection->http;
  struct mo_request *request = calloc(1, sizeof(*request));
  if (request == NULL)
    return NULL;
  request->http = http;
  request->mhd = mhd;
  request->connection = connection;
  request->raw_target = strdup(target);
  request->wait_s = -1;
  request->started_us = mo_clock_us();
  uint64_t number = http->id_key ^ atomic_fetch_add(&http->next_id, 1);
  snprintf(request->id, sizeof(request->id), "%016" PRIx64, number);
  size_t n = 0;
  for (; target[n] != '\0' && target[n] != '?' && n < sizeof(request->path) - 1; n++)
    request->path[n] =
        (unsigned char)target[n] > 0x20 && (unsigned char)target[n] < 0x7F ? target[n] : '?';
  atomic_fetch_add(&http->n_in_flight, 1);
  connection->request = request;
  return request;
}

void mo_request_end(struct mo_connection *connection, bool complete)
{
  struct mo_http *http = connection->http;
  struct mo_request *request = connection->request;
  if (request == NULL)
    return;
  connection->request = NULL;
  bool stream = request->stream != NULL, gave_way = !mo_body_end(request);
  if (stream)
    mo_stream_free(request);
  mo_download_free(request);
  int64_t now_us = mo_clock_us();
  bool replied = request->reply.status != 0 && (complete || stream || request->answered);
  unsigned status = gave_way ? 503 : replied ? request->reply.status : 0;
  if (gave_way)
    mo_request_note(request, MO_BODY_GAVE_WAY);
  mo_metrics_request(http, request->route, status, now_us - request->started_us, stream);
  atomic_fetch_add(&http->metrics.body_out, request->sent);
  if (http->config.log != NULL) {
    struct mo_http_log_entry entry = {.client = connection->client,
                                      .user = request->caller.name,
                                      .method = request->method_text,
                                      .path = request->path,
                                      .reason = request->reason[0] != '\0' ? request->reason : NULL,
                                      .status = status,
                                      .body_in = request->body_seen,
                                      .body_out = request->sent,
                                      .duration_s = (double)(now_us - request->started_us) * 1e-6};
    memcpy(entry.request_id, request->id, sizeof(entry.request_id));
    http->config.log(http->config.log_context, &entry);
  }
  atomic_store(&connection->deadline_us, now_us + (int64_t)http->config.idle_timeout_ms * 1000);
  atomic_store(&connection->receiving, false);
  mo_connection_spare(connection, now_us);
  if (request->client != NULL)
    mo_client_leave(&http->clients, request->client, now_us);
  mo_request_drop_body(request);
  mo_reply_clear(&request->reply);
  mo_query_end(request);
  free(request->raw_target);
  free(request);
  atomic_fetch_sub(&http->n_in_flight, 1);
}
