/* pool.h: the API threads, and parked requests. */
#ifndef MORPHO_HTTP_POOL_H
#define MORPHO_HTTP_POOL_H

#include "http/queue.h"

#define MO_QUEUED_MAX 256 /* requests that wait for an API thread, in each queue */
#define MO_WAITING    256 /* lists of waiting requests */

/* Each queue has its own threads, so that a request never waits for another kind of request. */
enum mo_queue_kind { MO_QUICK, MO_LISTS, MO_ROLLOUTS, MO_HEAVY, MO_QUEUES };

struct mo_api_thread {
  pthread_t thread;
  struct mo_http *http;
  enum mo_queue_kind kind;
};

struct mo_pool {
  pthread_mutex_t lock;
  pthread_cond_t work[MO_QUEUES], idle;
  struct mo_queue queues[MO_QUEUES];
  atomic_uint n_queued;
  uint32_t n_running;
  uint32_t n_outside; /* suspended requests: queued, running or parked */
  bool closed;        /* no new requests are accepted */
  bool quit;
  struct mo_api_thread threads[MO_QUEUES * MO_QUEUE_THREADS_MAX];
  uint32_t n_threads;
  LIST_HEAD(, mo_request)
  waiting[MO_WAITING]; /* parked, or about to be parked; grouped by what they wait for */
};

int mo_pool_start(struct mo_http *http);
/* Queues a request and suspends its connection. MO_ERR_BUSY (full), MO_ERR_CANCELLED (closed): the
 * connection is not suspended. */
int mo_pool_give(struct mo_http *http, struct mo_request *request);

/* Waiting. A handler calls mo_wait_begin, then checks whether `what` has ended. If so, it calls
 * mo_wait_end and replies. If not, it returns without a reply: the request is parked, and the
 * handler runs again, with request->wait_over, after mo_waits_end is called for `what`, after the
 * deadline, or within about 20 ms after the client leaves (mo_connection_has_left). */
void mo_wait_begin(struct mo_request *request, int64_t what, int64_t deadline_us);
void mo_wait_end(struct mo_request *request);
/* Ends the waits for `what` (−1: the waits of clients that have left), and those with a deadline
 * before now_us (INT64_MIN: no others; MO_NEVER: all). */
void mo_waits_end(struct mo_http *http, int64_t what, int64_t now_us);

void mo_pool_close(struct mo_http *http); /* returns when no connection is suspended */
void mo_pool_stop(struct mo_http *http);

#endif
