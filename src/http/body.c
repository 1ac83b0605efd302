/* body.c: the memory of request bodies, and the choice of a body to drop when memory runs out.
 *
 * A body that is still being received holds memory for a client that may have stopped sending. When
 * another body needs memory and none is free, the body with the longest time without progress is
 * dropped, if that time is at least MO_STALL_US: its memory is freed, its client gets 503 and its
 * connection is closed. Complete requests therefore never wait for incomplete ones. The thread that
 * needs memory drops the body of another thread's request, so all bodies being received are in a
 * list, and are accessed only with its lock held.
 *
 * An eighth of the memory is reserved for small bodies: large bodies and large replies cannot use
 * it, however slowly they are read. */
#include <stdlib.h>
#include <string.h>

#include "base/clock.h"
#include "base/thread.h"
#include "http/server.h"

#define SMALL_BYTES ((UINT64_C(64) << 10) + 1)

bool mo_body_memory_take(struct mo_http *http, uint64_t held, uint64_t more, bool small)
{
  uint64_t max = http->config.max_body_memory, before = atomic_fetch_add(&http->body_memory, more);
  if (before == held || before + more <= (small ? max : max - max / 8))
    return true;
  atomic_fetch_sub(&http->body_memory, more);
  return false;
}

uint64_t mo_body_memory_of_client(const struct mo_request *request)
{
  const bool is_worker = request->route != NULL && request->route->right == MO_RIGHT_WORKER;
  return request->http->config.max_body_memory / (is_worker ? 1 : 2);
}

/* Call the functions below with the bodies' lock held or, once the body is no longer being
 * received, on the thread that owns the request. */

static void leave_list(struct mo_request *request)
{
  if (request->body_coming)
    LIST_REMOVE(request, other_bodies);
  request->body_coming = false;
}

static void join_list(struct mo_request *request)
{
  if (!request->body_coming)
    LIST_INSERT_HEAD(&request->http->bodies, request, other_bodies);
  request->body_coming = true;
}

static void give_back(struct mo_request *request)
{
  free(request->body);
  request->body = NULL;
  request->body_size = request->body_capacity = 0;
  atomic_fetch_sub(&request->http->body_memory, request->body_reserved);
  if (request->body_client != NULL)
    mo_client_give_back(&request->http->clients, request->body_client, request->body_reserved,
                        mo_clock_us());
  request->body_client = NULL;
  request->body_reserved = 0;
}

/* Reserves memory for n more bytes. MO_ERR_LIMIT: the client has used its share. */
static int reserve(struct mo_request *request, size_t n)
{
  if (request->body_size + n + 1 <= request->body_capacity)
    return MO_OK;
  size_t capacity = request->body_capacity > 0 ? request->body_capacity : 16384;
  while (capacity < request->body_size + n + 1)
    capacity *= 2;
  if (capacity > request->body_limit + 1)
    capacity = (size_t)request->body_limit + 1;
  struct mo_http *http = request->http;
  uint64_t more = capacity - request->body_capacity;
  struct mo_client *client =
      mo_client_hold(&http->clients, request->connection->client_key, request->body_reserved, more,
                     mo_body_memory_of_client(request));
  if (client == NULL)
    return MO_ERR_LIMIT;
  bool taken = mo_body_memory_take(http, request->body_reserved, more, capacity <= SMALL_BYTES);
  char *body = taken ? realloc(request->body, capacity) : NULL;
  if (body == NULL) {
    if (taken)
      atomic_fetch_sub(&http->body_memory, more);
    mo_client_give_back(&http->clients, client, more, mo_clock_us());
    return MO_ERR_NO_MEMORY;
  }
  request->body_client = client;
  request->body_reserved += more;
  request->body = body;
  request->body_capacity = capacity;
  return MO_OK;
}

/* Drops the body with the longest time without progress; of_client: only bodies of the same client.
 * Returns false if all bodies make progress. */
static bool drop_another(const struct mo_request *request, bool of_client)
{
  struct mo_http *http = request->http;
  struct mo_request *stalest = NULL, *other;
  int64_t stalest_us = mo_clock_us() - MO_STALL_US;
  LIST_FOREACH(other, &http->bodies, other_bodies)
  {
    int64_t since_us = atomic_load(&other->connection->spare_us);
    bool helps = !of_client ||
                 memcmp(other->connection->client_key, request->connection->client_key, 16) == 0;
    if (other != request && since_us <= stalest_us && helps) {
      stalest = other;
      stalest_us = since_us;
    }
  }
  if (stalest == NULL)
    return false;
  leave_list(stalest);
  give_back(stalest);
  stalest->body_gave_way = true;
  atomic_fetch_add(&http->metrics.bodies_gave_way, 1);
  mo_connection_cut(http, stalest->connection, stalest->id, MO_BODY_GAVE_WAY);
  return true;
}

int mo_body_add(struct mo_request *request, const char *bytes, size_t n)
{
  struct mo_http *http = request->http;
  int code = MO_ERR_CANCELLED;
  MO_GUARD(&http->bodies_lock);
  if (!request->body_gave_way)
    do
      code = reserve(request, n);
    while (code != MO_OK && drop_another(request, code == MO_ERR_LIMIT));
  if (code == MO_OK) {
    memcpy(request->body + request->body_size, bytes, n);
    request->body_size += n;
    request->body[request->body_size] = '\0';
    join_list(request);
  }
  return code;
}

bool mo_body_end(struct mo_request *request)
{
  MO_GUARD(&request->http->bodies_lock);
  leave_list(request);
  return !request->body_gave_way;
}

void mo_request_drop_body(struct mo_request *request)
{
  mo_body_end(request);
  give_back(request);
}
