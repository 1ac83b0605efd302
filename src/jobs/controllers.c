/* controllers.c: a small cache of controllers that are ready for the back end; evicts the least
 * recently used. */
#include <stdlib.h>

#include "jobs/internal.h"

static void free_loaded(struct mo_loaded *loaded)
{
  mo_compute_controller_free(loaded->ready);
  mo_controller_free(loaded->controller);
  free(loaded);
}

/* Evicts unused controllers, oldest first, until `keep` remain. */
static void trim(struct mo_jobs *jobs, uint32_t keep)
{
  for (;;) {
    struct mo_loaded **oldest = NULL, *gone;
    uint32_t n = 0;
    for (struct mo_loaded **link = &jobs->controllers; *link != NULL; link = &(*link)->next) {
      n++;
      if ((*link)->users == 0 && (oldest == NULL || (*link)->last_used < (*oldest)->last_used))
        oldest = link;
    }
    if (n <= keep || oldest == NULL)
      return;
    gone = *oldest;
    *oldest = gone->next;
    free_loaded(gone);
  }
}

static int load(struct mo_jobs *jobs, const struct mo_sha256 *sha256, struct mo_loaded *loaded)
{
  uint8_t *bytes = NULL;
  size_t size = 0;
  int error = mo_store_controller_bytes(jobs->store, sha256, &bytes, &size);
  if (error == MO_OK)
    error = mo_controller_decode(bytes, size, &loaded->controller, NULL);
  free(bytes);
  if (error == MO_OK)
    error = mo_compute_controller_create(jobs->compute, loaded->controller, &loaded->ready);
  return error;
}

int mo_loaded_acquire(struct mo_jobs *jobs, const struct mo_sha256 *sha256, struct mo_loaded **ret)
{
  struct mo_loaded *loaded;
  int error;
  for (loaded = jobs->controllers; loaded != NULL; loaded = loaded->next)
    if (mo_sha256_equal(&loaded->sha256, sha256))
      break;
  if (loaded == NULL) {
    trim(jobs, jobs->config.controllers_kept - 1);
    loaded = calloc(1, sizeof(*loaded));
    if (loaded == NULL)
      return MO_ERR_NO_MEMORY;
    loaded->sha256 = *sha256;
    error = load(jobs, sha256, loaded);
    if (error != MO_OK) {
      free_loaded(loaded);
      return error;
    }
    loaded->next = jobs->controllers;
    jobs->controllers = loaded;
  }
  loaded->users++;
  loaded->last_used = ++jobs->use_clock;
  *ret = loaded;
  return MO_OK;
}

void mo_loaded_release(struct mo_jobs *jobs, struct mo_loaded *loaded)
{
  if (loaded == NULL)
    return;
  loaded->users--;
  trim(jobs, jobs->config.controllers_kept);
}

void mo_loaded_free_all(struct mo_jobs *jobs)
{
  while (jobs->controllers != NULL) {
    struct mo_loaded *loaded = jobs->controllers;
    jobs->controllers = loaded->next;
    free_loaded(loaded);
  }
}
