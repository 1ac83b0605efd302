/* queue.h: requests that wait for an API thread. Clients take turns: the next request is the oldest
 * one of the client that has waited longest for its turn. A client therefore waits for at most one
 * request of each other client, however many they have sent. The pool's lock guards a queue. */
#ifndef MORPHO_HTTP_QUEUE_H
#define MORPHO_HTTP_QUEUE_H

#include "http/request.h"

#define MO_QUEUE_THREADS_MAX 4

struct mo_queue {
  TAILQ_HEAD(, mo_request) clients; /* the oldest request of each client, in the order of turns */
  uint32_t n_new; /* excludes requests that ran before: ended waits, and later pieces of replies */
  uint32_t n_running, most_of_client;              /* requests being handled; the limit for one
                                                      client */
  unsigned char running[MO_QUEUE_THREADS_MAX][16]; /* client keys */
};

void mo_queue_init(struct mo_queue *queue, uint32_t most_of_client);
void mo_queue_push(struct mo_queue *queue, struct mo_request *request);
/* Takes the next request that may run, and sets its `is_crowded`. Returns NULL if there is none. */
struct mo_request *mo_queue_take(struct mo_queue *queue);
/* Records that a request of this client was handled; the request may have been freed. */
void mo_queue_done(struct mo_queue *queue, const unsigned char client_key[16]);

#endif
