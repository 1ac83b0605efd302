/* pool.c: see pool.h. request.h says which thread owns a request. */

#include <sched.h>
#include <string.h>
#include <sys/resource.h>
#include <unistd.h>

#include "base/processors.h"
#include "base/thread.h"
#include "http/query.h"
#include "http/server.h"

#define HEAVY_NICE 5 /* the default of the workers */

/* Chooses the queue of a request. Each list occupies a core for milliseconds, and clients that read
 * one list often read more. */
static enum mo_queue_kind kind_of(const struct mo_request *request)
{
  const unsigned flags = request->route->flags;
  return request->stream != NULL    ? MO_QUICK
         : flags & MO_ROUTE_HEAVY   ? MO_HEAVY
         : flags & MO_ROUTE_ROLLOUT ? MO_ROLLOUTS
         : flags & MO_ROUTE_LIST    ? MO_LISTS
                                    : MO_QUICK;
}

static void push(struct mo_pool *pool, struct mo_request *request)
{
  const enum mo_queue_kind kind = kind_of(request);
  mo_queue_push(&pool->queues[kind], request);
  pool->n_queued++;
  pthread_cond_signal(&pool->work[kind]);
}

bool mo_request_is_over(const struct mo_request *request)
{
  return atomic_load(&request->http->stopping) || mo_connection_has_left(request->connection);
}

static void unlink_waiting(struct mo_request *request)
{
  LIST_REMOVE(request, others_waiting);
  request->wait_for = 0;
}

/* Parks a request while its handler waits. Returns false if the wait is already over. */
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

/* Runs the handler of a request. Returns false if the request was parked; by then, it may even have
 * ended. */
static bool handle(struct mo_request *request)
{
  /* Long work does not start for a client that has left, or while the service stops. */
  if (kind_of(request) == MO_HEAVY && !request->wait_over &&
      (atomic_load(&request->http->stopping) || mo_connection_has_left(request->connection)))
    mo_reply_error(request, MO_ERR_CANCELLED, "request");
  else if (request->wait_over || mo_query_begin(request))
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

/* Requests that compute for seconds yield to all others, like the workers. */
static void lower_priority(void)
{
  const struct sched_param none = {0};
  const id_t thread = (id_t)gettid();
  (void)pthread_setschedparam(pthread_self(), SCHED_BATCH, &none);
  (void)setpriority(PRIO_PROCESS, thread, getpriority(PRIO_PROCESS, thread) + HEAVY_NICE);
}

static void *worker(void *context)
{
  const struct mo_api_thread *thread = context;
  struct mo_http *http = thread->http;
  struct mo_pool *pool = &http->pool;
  struct mo_queue *queue = &pool->queues[thread->kind];
  if (thread->kind == MO_HEAVY)
    lower_priority();
  pthread_mutex_lock(&pool->lock);
  for (;;) {
    struct mo_request *request = mo_queue_take(queue);
    if (request == NULL && pool->quit)
      break;
    if (request == NULL) {
      pthread_cond_wait(&pool->work[thread->kind], &pool->lock);
      continue;
    }
    pool->n_queued--;
    pool->n_running++;
    pthread_mutex_unlock(&pool->lock);
    struct MHD_Connection *mhd = request->mhd;
    unsigned char client_key[16];
    memcpy(client_key, request->client_key, sizeof(client_key));
    bool back = false;
    if (request->stage == MO_STAGE_REPLY)
      request->refill(request); /* resumes the connection itself */
    else
      back = handle(request);
    if (back)
      MHD_resume_connection(mhd);
    pthread_mutex_lock(&pool->lock);
    mo_queue_done(queue, client_key);
    pool->n_running--;
    if (back)
      pool->n_outside--;
    pthread_cond_broadcast(&pool->idle);
  }
  pthread_mutex_unlock(&pool->lock);
  return NULL;
}

/* Starts the threads of a queue. most_of_client: the largest number of requests from one client
 * that they run at once. */
static int start_queue(struct mo_http *http, enum mo_queue_kind kind, uint32_t n_threads,
                       uint32_t most_of_client)
{
  struct mo_pool *pool = &http->pool;
  mo_queue_init(&pool->queues[kind], most_of_client);
  pthread_cond_init(&pool->work[kind], NULL);
  for (uint32_t i = 0; i < n_threads; i++) {
    struct mo_api_thread *thread = &pool->threads[pool->n_threads];
    *thread = (struct mo_api_thread){.http = http, .kind = kind};
    if (pthread_create(&thread->thread, NULL, worker, thread) != 0)
      return MO_ERR_NO_MEMORY;
    pool->n_threads++;
  }
  return MO_OK;
}

int mo_pool_start(struct mo_http *http)
{
  const uint32_t cores = mo_processors();
  const uint32_t lists = cores < 4 ? 1 : 2, rollouts = cores < 4 ? 2 : 4;
  int error = start_queue(http, MO_QUICK, 4, 3);
  if (error == MO_OK)
    error = start_queue(http, MO_LISTS, lists, 1);
  if (error == MO_OK)
    error = start_queue(http, MO_ROLLOUTS, rollouts, rollouts / 2);
  if (error == MO_OK)
    error = start_queue(http, MO_HEAVY, 2, 1);
  return error;
}

int mo_pool_give(struct mo_http *http, struct mo_request *request)
{
  struct mo_pool *pool = &http->pool;
  MO_GUARD(&pool->lock);
  bool refill = request->stage == MO_STAGE_REPLY;
  int error = pool->closed ? MO_ERR_CANCELLED
              : !refill && pool->queues[kind_of(request)].n_new >= http->config.max_queued
                  ? MO_ERR_BUSY
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

/* Ends the wait of a request. A parked request is requeued; a request about to park will see
 * wait_fired. Call it with the pool's lock held. */
static void end_wait(struct mo_pool *pool, struct mo_request *request)
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
        end_wait(pool, request);
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
  for (int kind = 0; kind < MO_QUEUES; kind++)
    pthread_cond_broadcast(&pool->work[kind]);
  pthread_mutex_unlock(&pool->lock);
  for (uint32_t i = 0; i < pool->n_threads; i++)
    pthread_join(pool->threads[i].thread, NULL);
  pool->n_threads = 0;
}
