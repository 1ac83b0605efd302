/* controllers.c: loads controllers from the store, and keeps a small cache of controllers that are
 * ready for the back end. */
#include "jobs/controllers.h"

#include <stdio.h>
#include <stdlib.h>

#include "base/thread.h"

#define KEPT 8

int mo_controller_load(struct mo_store *store, const struct mo_sha256 *sha256,
                       struct mo_controller **controller)
{
  uint8_t *bytes = NULL;
  size_t size = 0;
  int error = mo_store_controller_bytes(store, sha256, &bytes, &size);
  if (error == MO_OK)
    error = mo_controller_decode(bytes, size, controller, NULL);
  free(bytes);
  return error;
}

void mo_controller_describe_fault(const struct mo_sha256 *sha256, const char *then, char text[256])
{
  snprintf(text, 256,
           "the file controllers/%s.safetensors is missing, damaged or unreadable; store the same "
           "file again (PUT /v1/controllers/<name>), then %s",
           MO_SHA256_HEX(sha256), then);
}

/* ---- the cache ---- */

static void free_loaded(struct mo_loaded *loaded)
{
  mo_compute_controller_free(loaded->ready);
  mo_controller_free(loaded->controller);
  free(loaded);
}

/* Evicts unused controllers, oldest first, until `keep` remain. */
static void trim(struct mo_controller_cache *cache, uint32_t keep)
{
  for (;;) {
    struct mo_loaded **oldest = NULL, *gone;
    uint32_t n = 0;
    for (struct mo_loaded **link = &cache->first; *link != NULL; link = &(*link)->next) {
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

static int load(struct mo_controller_cache *cache, const struct mo_sha256 *sha256,
                struct mo_loaded **ret)
{
  struct mo_loaded *loaded = calloc(1, sizeof(*loaded));
  if (loaded == NULL)
    return MO_ERR_NO_MEMORY;
  loaded->sha256 = *sha256;
  int error = mo_controller_load(cache->store, sha256, &loaded->controller);
  if (error == MO_OK)
    error = mo_compute_controller_create(cache->compute, loaded->controller, &loaded->ready);
  if (error != MO_OK) {
    free_loaded(loaded);
    return error;
  }
  loaded->next = cache->first;
  *ret = cache->first = loaded;
  return MO_OK;
}

int mo_loaded_acquire(struct mo_controller_cache *cache, const struct mo_sha256 *sha256,
                      struct mo_loaded **ret)
{
  int error = MO_OK;
  MO_GUARD(&cache->mutex);
  struct mo_loaded *loaded = cache->first;
  while (loaded != NULL && !mo_sha256_equal(&loaded->sha256, sha256))
    loaded = loaded->next;
  if (loaded == NULL) {
    trim(cache, KEPT - 1);
    error = load(cache, sha256, &loaded);
  }
  if (error == MO_OK) {
    loaded->users++;
    loaded->last_used = ++cache->clock;
    *ret = loaded;
  }
  return error;
}

void mo_loaded_release(struct mo_controller_cache *cache, struct mo_loaded *loaded)
{
  if (loaded == NULL)
    return;
  MO_GUARD(&cache->mutex);
  loaded->users--;
  trim(cache, KEPT);
}

void mo_loaded_free_all(struct mo_controller_cache *cache)
{
  trim(cache, 0);
}
