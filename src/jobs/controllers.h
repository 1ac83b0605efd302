/* controllers.h: loads controllers from the store; keeps some ready for the back end. */
#ifndef MORPHO_JOBS_CONTROLLERS_H
#define MORPHO_JOBS_CONTROLLERS_H

#include <pthread.h>

#include "jobs/live.h"

int mo_controller_load(struct mo_store *store, const struct mo_sha256 *sha256,
                       struct mo_controller **controller);
/* Returns whether a loading error means that the file is missing, damaged or unreadable. */
static inline bool mo_controller_is_unusable(int error)
{
  return error == MO_ERR_CORRUPT || error == MO_ERR_IO || error == MO_ERR_FORMAT;
}
/* Describes this fault, and what to do. then: "resume the job". */
void mo_controller_describe_fault(const struct mo_sha256 *sha256, const char *then, char text[256]);

/* A controller that is loaded into the back end. */
struct mo_loaded {
  struct mo_sha256 sha256;
  struct mo_controller *controller;
  struct mo_compute_controller *ready;
  uint32_t users;
  uint64_t last_used;
  struct mo_loaded *next;
};
/* A small cache; evicts the least recently used. */
struct mo_controller_cache {
  struct mo_store *store;
  struct mo_compute *compute;
  pthread_mutex_t mutex; /* held while a controller is loaded */
  uint64_t clock;
  struct mo_loaded *first;
};
int mo_loaded_acquire(struct mo_controller_cache *cache, const struct mo_sha256 *sha256,
                      struct mo_loaded **loaded);
void mo_loaded_release(struct mo_controller_cache *cache, struct mo_loaded *loaded); /* NULL-safe */
void mo_loaded_free_all(struct mo_controller_cache *cache);

#endif
