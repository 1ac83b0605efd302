/* client.h: limits per user or address: requests in flight, body memory, rate of submissions. */
#ifndef MORPHO_HTTP_CLIENT_H
#define MORPHO_HTTP_CLIENT_H

#include <pthread.h>
#include <stdbool.h>
#include <stdint.h>

#include <morpho/error.h>

struct mo_client;
struct mo_clients {
  pthread_mutex_t lock;
  struct mo_client *buckets[256];
};
void mo_clients_free(struct mo_clients *clients);
/* Takes one of the client's `max` places. Returns NULL if all are taken (*refused is true) or
 * memory runs out. */
struct mo_client *mo_client_enter(struct mo_clients *clients, const unsigned char key[16],
                                  uint32_t max, bool *refused);
void mo_client_leave(struct mo_clients *clients, struct mo_client *client, int64_t now_us);
/* Parks or wakes a client's request. A parked request takes no place; when it wakes, it takes one
 * again, even beyond `max`. */
void mo_client_park(struct mo_clients *clients, struct mo_client *client, bool parked);
/* Reserves `more` bytes for the body or reply of a request that already holds `held` bytes. Allowed
 * if the client's requests then hold at most `most` bytes, or if no other of its requests holds
 * any. Returns NULL if this is not allowed, or memory runs out. */
struct mo_client *mo_client_hold(struct mo_clients *clients, const unsigned char key[16],
                                 uint64_t held, uint64_t more, uint64_t most);
void mo_client_give_back(struct mo_clients *clients, struct mo_client *client, uint64_t bytes,
                         int64_t now_us);
/* Counts one submission. Returns whether the rate allows it. The rate is per second, with a burst
 * of the same size, at least 1. */
bool mo_client_spend(struct mo_clients *clients, struct mo_client *client, uint32_t rate_per_s,
                     int64_t now_us);
void mo_clients_sweep(struct mo_clients *clients, int64_t now_us); /* forgets idle clients */

#endif
