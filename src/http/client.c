/* client.c: limits per client: requests in flight, body memory, rate of submissions. A client is
 * kept while it has requests, and for a few more seconds because of its rate. */
#include <stdlib.h>
#include <string.h>

#include "base/thread.h"
#include "http/client.h"

#define KEEP_US 10000000

struct mo_client {
  struct mo_client *next;
  unsigned char key[16];
  uint32_t in_flight, parked;
  uint64_t body_bytes;  /* held by its requests' bodies, and by large replies */
  double allowance;     /* submissions allowed at that time */
  int64_t allowance_us; /* when `allowance` was last updated; 0: it is full */
  int64_t left_us;
};

void mo_clients_free(struct mo_clients *clients)
{
  for (size_t b = 0; b < 256; b++)
    while (clients->buckets[b] != NULL) {
      struct mo_client *client = clients->buckets[b];
      clients->buckets[b] = client->next;
      free(client);
    }
}

static struct mo_client **bucket_of(struct mo_clients *clients, const unsigned char key[16])
{
  unsigned hash = 2166136261U;
  for (int i = 0; i < 16; i++)
    hash = (hash ^ key[i]) * 16777619U;
  return &clients->buckets[(hash ^ hash >> 16) & 255];
}

/* Finds or adds a client. Call it with the lock held. Returns NULL if memory runs out. */
static struct mo_client *find_or_add(struct mo_clients *clients, const unsigned char key[16])
{
  struct mo_client **bucket = bucket_of(clients, key), *client = *bucket;
  while (client != NULL && memcmp(client->key, key, 16) != 0)
    client = client->next;
  if (client == NULL && (client = calloc(1, sizeof(*client))) != NULL) {
    memcpy(client->key, key, 16);
    client->next = *bucket;
    *bucket = client;
  }
  return client;
}

struct mo_client *mo_client_enter(struct mo_clients *clients, const unsigned char key[16],
                                  uint32_t max, bool *refused)
{
  *refused = false;
  MO_GUARD(&clients->lock);
  struct mo_client *client = find_or_add(clients, key);
  if (client != NULL && client->in_flight >= max) {
    *refused = true;
    client = NULL;
  }
  if (client != NULL)
    client->in_flight++;
  return client;
}

void mo_client_leave(struct mo_clients *clients, struct mo_client *client, int64_t now_us)
{
  MO_GUARD(&clients->lock);
  client->in_flight--;
  client->left_us = now_us;
}

void mo_client_park(struct mo_clients *clients, struct mo_client *client, bool parked)
{
  MO_GUARD(&clients->lock);
  client->in_flight += parked ? -1U : 1;
  client->parked += parked ? 1 : -1U;
}

struct mo_client *mo_client_hold(struct mo_clients *clients, const unsigned char key[16],
                                 uint64_t held, uint64_t more, uint64_t most)
{
  MO_GUARD(&clients->lock);
  struct mo_client *client = find_or_add(clients, key);
  if (client != NULL && client->body_bytes > held && client->body_bytes + more > most)
    client = NULL;
  if (client != NULL)
    client->body_bytes += more;
  return client;
}

void mo_client_give_back(struct mo_clients *clients, struct mo_client *client, uint64_t bytes,
                         int64_t now_us)
{
  MO_GUARD(&clients->lock);
  client->body_bytes -= bytes;
  client->left_us = now_us;
}

bool mo_client_spend(struct mo_clients *clients, struct mo_client *client, uint32_t rate_per_s,
                     int64_t now_us)
{
  if (rate_per_s == 0)
    return true;
  MO_GUARD(&clients->lock);
  double most = rate_per_s;
  client->allowance =
      client->allowance_us == 0
          ? most
          : client->allowance + (double)(now_us - client->allowance_us) * 1e-6 * most;
  if (client->allowance > most)
    client->allowance = most;
  client->allowance_us = now_us;
  bool allowed = client->allowance >= 1;
  if (allowed)
    client->allowance -= 1;
  return allowed;
}

void mo_clients_sweep(struct mo_clients *clients, int64_t now_us)
{
  MO_GUARD(&clients->lock);
  for (size_t b = 0; b < 256; b++)
    for (struct mo_client **at = &clients->buckets[b]; *at != NULL;) {
      struct mo_client *client = *at;
      if (client->in_flight == 0 && client->parked == 0 && client->body_bytes == 0 &&
          now_us - client->left_us > KEEP_US) {
        *at = client->next;
        free(client);
      } else {
        at = &client->next;
      }
    }
}
