/* queue.c: see queue.h. Each client has a list: its oldest request is in the queue, and the others
 * are linked to that one. A list moves to the end of the queue when its first request is taken. */
#include "http/queue.h"

#include <string.h>

void mo_queue_init(struct mo_queue *queue, uint32_t most_of_client)
{
  TAILQ_INIT(&queue->clients);
  queue->most_of_client = most_of_client;
}

/* Returns whether a request is new, rather than the next piece of a reply or a wait that is
 * over. */
static bool is_new(const struct mo_request *request)
{
  return request->stage == MO_STAGE_HANDLING && !request->wait_over;
}

void mo_queue_push(struct mo_queue *queue, struct mo_request *request)
{
  struct mo_request *first;
  STAILQ_INIT(&request->behind);
  queue->n_new += is_new(request);
  TAILQ_FOREACH(first, &queue->clients, other_clients)
  {
    if (memcmp(first->client_key, request->client_key, 16) == 0) {
      STAILQ_INSERT_TAIL(&first->behind, request, next_behind);
      return;
    }
  }
  TAILQ_INSERT_TAIL(&queue->clients, request, other_clients);
}

static uint32_t n_running_of(const struct mo_queue *queue, const unsigned char client_key[16])
{
  uint32_t n = 0;
  for (uint32_t i = 0; i < queue->n_running; i++)
    n += memcmp(queue->running[i], client_key, 16) == 0;
  return n;
}

/* Takes a client's oldest request; the client's next request waits behind all other clients. */
static void take_first(struct mo_queue *queue, struct mo_request *request)
{
  struct mo_request *next = STAILQ_FIRST(&request->behind);
  TAILQ_REMOVE(&queue->clients, request, other_clients);
  if (next == NULL)
    return;
  STAILQ_REMOVE_HEAD(&request->behind, next_behind);
  STAILQ_INIT(&next->behind);
  STAILQ_CONCAT(&next->behind, &request->behind);
  TAILQ_INSERT_TAIL(&queue->clients, next, other_clients);
}

struct mo_request *mo_queue_take(struct mo_queue *queue)
{
  struct mo_request *request;
  if (queue->n_running == MO_QUEUE_THREADS_MAX)
    return NULL;
  TAILQ_FOREACH(request, &queue->clients, other_clients)
  {
    const uint32_t n_running = n_running_of(queue, request->client_key);
    if (n_running < queue->most_of_client) {
      request->is_crowded = n_running > 0 || !STAILQ_EMPTY(&request->behind);
      take_first(queue, request);
      memcpy(queue->running[queue->n_running++], request->client_key, 16);
      queue->n_new -= is_new(request);
      break;
    }
  }
  return request;
}

void mo_queue_done(struct mo_queue *queue, const unsigned char client_key[16])
{
  uint32_t i = 0;
  while (memcmp(queue->running[i], client_key, 16) != 0)
    i++;
  memmove(queue->running[i], queue->running[--queue->n_running], 16);
}
