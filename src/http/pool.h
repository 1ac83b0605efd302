/* pool.h: the API threads, and the requests that wait for something to end. */
#ifndef MORPHO_HTTP_POOL_H
#define MORPHO_HTTP_POOL_H

#include "http/request.h"

#define MO_API_THREADS 4
#define MO_QUEUED_MAX  256 /* requests that wait for an API thread, lists and others apart */
#define MO_WAITING     256 /* lists of waiting requests */

struct mo_queue {
  STAILQ_HEAD(, mo_request) requests;
  uint32_t n; /* without requests taken earlier: ended waits, and further pieces of replies */
};

struct mo_pool {
  pthread_mutex_t lock;
  pthread_cond_t work, idle;
  struct mo_queue others, lists;
  uint32_t n_lists, max_lists; /* being handled */
  atomic_uint n_queued;
  uint32_t n_running;
  uint32_t n_outside; /* requests that are suspended: queued, running or parked */
  bool closed;        /* no new requests are taken */
  bool quit;
  pthread_t threads[MO_API_THREADS];
  uint32_t n_threads;
  LIST_HEAD(, mo_request) waiting[MO_WAITING]; /* parked, or about to park; by what they wait for */
};

int mo_pool_start(struct mo_http *http);
/* Queues a request and suspends its connection. MO_ERR_BUSY (full), MO_ERR_CANCELLED (closed): the
 * connection is not suspended. */
int mo_pool_give(struct mo_http *http, struct mo_request *request);

/* Waiting. A handler calls mo_wait_begin, then looks whether `what` has ended. If so it calls
 * mo_wait_end and replies. If not it returns without a reply: the request is parked, and the
 * handler runs again, with request->wait_over, when mo_waits_end is called for `what`, when the
 * deadline passes, or, within some 20 ms, when the client leaves (mo_connection_has_left). */
void mo_wait_begin(struct mo_request *request, int64_t what, int64_t deadline_us);
void mo_wait_end(struct mo_request *request);
/* Ends the waits for `what`, or (−1) of clients that have left, and those whose deadline has passed
 * (INT64_MIN: none, MO_NEVER: all). */
void mo_waits_end(struct mo_http *http, int64_t what, int64_t now_us);

void mo_pool_close(struct mo_http *http); /* returns when no connection is suspended */
void mo_pool_stop(struct mo_http *http);

#endif
