/* pool.c: see pool.h. request.h says which thread owns a request. */

#include "base/processors.h"
#include "base/thread.h"
#include "http/query.h"
#include "http/server.h"

/* Chooses the queue of a request. Lists take a core for milliseconds each, and clients that read
 * one often read more. So they have a queue of their own, and run on at most half of the threads
 * and half of the cores. */
static struct mo_queue *queue_of(struct mo_pool *pool, const struct mo_request *request)
{
  bool list = (request->route->flags & MO_ROUTE_LIST) && request->stream == NULL;
  return list ? &pool->lists : &pool->others;
}

/* Says whether a request is new: not the next piece of a reply, and not a wait that is over. */
static bool is_new(const struct mo_request *request)
{
  return request->stage == MO_STAGE_HANDLING && !request->wait_over;
}

static void push(struct mo_pool *pool, struct mo_request *request)
{
  struct mo_queue *queue = queue_of(pool, request);
  STAILQ_INSERT_TAIL(&queue->requests, request, next_queued);
  queue->n += is_new(request);
  pool->n_queued++;
  pthread_cond_signal(&pool->work);
}

/* Takes the next request that may run, the older of the two queues' first. NULL: none. */
static struct mo_request *take(struct mo_pool *pool, bool *is_list)
{
  const struct mo_request *other = STAILQ_FIRST(&pool->others.requests);
  struct mo_request *next =
      pool->n_lists < pool->max_lists ? STAILQ_FIRST(&pool->lists.requests) : NULL;
  *is_list = next != NULL && (other == NULL || next->started_us < other->started_us);
  struct mo_queue *queue = *is_list ? &pool->lists : &pool->others;
  if ((next = STAILQ_FIRST(&queue->requests)) == NULL)
    return NULL;
  STAILQ_REMOVE_HEAD(&queue->requests, next_queued);
  queue->n -= is_new(next);
  pool->n_queued--;
  pool->n_running++;
  pool->n_lists += *is_list;
  return next;
}

static void unlink_waiting(struct mo_request *request)
{
  LIST_REMOVE(request, others_waiting);
  request->wait_for = 0;
}

/* Parks a request whose handler waits. False: the wait is over already. */
static bool park(struct mo_request *request)
{
  struct mo_pool *pool = &request->http->pool;
  MO_GUARD(&pool->lock);
  bool parked =
      !request->wait_fired && !pool->closed && !mo_connection_has_left(request->connection);
  if (parked) {
    request->wait_parked = true;
    mo_client_park(&request->http->clients, request->client, true);
  } else {
    unlink_waiting(request);
  }
  return parked;
}

/* Runs the handler of a request. False: the request is parked, and may have ended meanwhile. */
static bool handle(struct mo_request *request)
{
  if (request->wait_over || mo_query_begin(request))
    request->route->handler(request);
  while (request->wait_for != 0) {
    if (park(request))
      return false;
    request->wait_over = true;
    request->route->handler(request);
  }
  mo_pack_reply(request);
  request->stage = MO_STAGE_REPLY;
  return true;
}

static void *worker(void *context)
{
  struct mo_http *http = context;
  struct mo_pool *pool = &http->pool;
  pthread_mutex_lock(&pool->lock);
  for (;;) {
    bool is_list;
    struct mo_request *request = take(pool, &is_list);
    if (request == NULL && pool->quit)
      break;
    if (request == NULL) {
      pthread_cond_wait(&pool->work, &pool->lock);
      continue;
    }
    pthread_mutex_unlock(&pool->lock);
    struct MHD_Connection *mhd = request->mhd;
    bool back = false;
    if (request->stage == MO_STAGE_REPLY)
      request->refill(request); /* resumes the connection itself */
    else
      back = handle(request);
    if (back)
      MHD_resume_connection(mhd);
    pthread_mutex_lock(&pool->lock);
    pool->n_running--;
    pool->n_lists -= is_list;
    if (is_list && !STAILQ_EMPTY(&pool->lists.requests))
      pthread_cond_signal(&pool->work); /* a thread that skipped this request may be asleep */
    if (back)
      pool->n_outside--;
    pthread_cond_broadcast(&pool->idle);
  }
  pthread_mutex_unlock(&pool->lock);
  return NULL;
}

int mo_pool_start(struct mo_http *http)
{
  struct mo_pool *pool = &http->pool;
  STAILQ_INIT(&pool->others.requests);
  STAILQ_INIT(&pool->lists.requests);
  uint32_t half = mo_processors() / 2, most = MO_API_THREADS / 2;
  pool->max_lists = half < 1 ? 1 : half < most ? half : most;
  for (; pool->n_threads < MO_API_THREADS; pool->n_threads++)
    if (pthread_create(&pool->threads[pool->n_threads], NULL, worker, http) != 0)
      return MO_ERR_NO_MEMORY;
  return MO_OK;
}

int mo_pool_give(struct mo_http *http, struct mo_request *request)
{
  struct mo_pool *pool = &http->pool;
  MO_GUARD(&pool->lock);
  bool refill = request->stage == MO_STAGE_REPLY;
  int error = pool->closed                                                       ? MO_ERR_CANCELLED
              : !refill && queue_of(pool, request)->n >= http->config.max_queued ? MO_ERR_BUSY
                                                                                 : MO_OK;
  if (error == MO_OK && !refill) {
    request->stage = MO_STAGE_HANDLING;
    pool->n_outside++;
    MHD_suspend_connection(request->mhd); /* before a worker can resume it */
  }
  if (error == MO_OK)
    push(pool, request);
  return error;
}

void mo_wait_begin(struct mo_request *request, int64_t what, int64_t deadline_us)
{
  struct mo_pool *pool = &request->http->pool;
  request->wait_for = what;
  request->wait_deadline_us = deadline_us;
  request->wait_fired = request->wait_parked = false;
  MO_GUARD(&pool->lock);
  LIST_INSERT_HEAD(&pool->waiting[(uint64_t)what % MO_WAITING], request, others_waiting);
}

void mo_wait_end(struct mo_request *request)
{
  struct mo_pool *pool = &request->http->pool;
  MO_GUARD(&pool->lock);
  unlink_waiting(request);
}

/* Ends the wait of a request. A parked one is queued again; one about to park will see wait_fired.
 * Call with the pool's lock. */
static void let_go(struct mo_pool *pool, struct mo_request *request)
{
  request->wait_fired = true;
  if (!request->wait_parked)
    return;
  unlink_waiting(request);
  mo_client_park(&request->http->clients, request->client, false);
  request->wait_over = true;
  push(pool, request);
}

void mo_waits_end(struct mo_http *http, int64_t what, int64_t now_us)
{
  struct mo_pool *pool = &http->pool;
  const size_t first = what < 0 ? 0 : (uint64_t)what % MO_WAITING;
  const size_t end = what < 0 ? MO_WAITING : first + 1;
  MO_GUARD(&pool->lock);
  for (size_t i = first; i < end; i++)
    for (struct mo_request *request = LIST_FIRST(&pool->waiting[i]), *next; request != NULL;
         request = next) {
      next = LIST_NEXT(request, others_waiting);
      if (request->wait_for == what || request->wait_deadline_us <= now_us ||
          (what < 0 && request->wait_parked && mo_connection_has_left(request->connection)))
        let_go(pool, request);
    }
}

void mo_pool_close(struct mo_http *http)
{
  struct mo_pool *pool = &http->pool;
  pthread_mutex_lock(&pool->lock);
  pool->closed = true;
  pthread_mutex_unlock(&pool->lock);
  mo_waits_end(http, -1, MO_NEVER);
  pthread_mutex_lock(&pool->lock);
  while (pool->n_outside > 0 || pool->n_queued > 0 || pool->n_running > 0)
    pthread_cond_wait(&pool->idle, &pool->lock);
  pthread_mutex_unlock(&pool->lock);
}

void mo_pool_stop(struct mo_http *http)
{
  struct mo_pool *pool = &http->pool;
  pthread_mutex_lock(&pool->lock);
  pool->quit = true;
  pthread_cond_broadcast(&pool->work);
  pthread_mutex_unlock(&pool->lock);
  for (uint32_t i = 0; i < pool->n_threads; i++)
    pthread_join(pool->threads[i], NULL);
  pool->n_threads = 0;
}
