/* weights.c: see weights.h. A controller's identity is valid only while blocks of it are taken. It
 * is forgotten with the last parcel, because another controller may then get the same identity.
 * After that, weights are found by comparing them, which takes a fiftieth of the time needed to
 * make the file. */
#include "fleet/weights.h"

#include <stdlib.h>
#include <string.h>

int mo_weights_create(const struct mo_taken *taken, struct mo_weights **ret)
{
  struct mo_weights *weights = calloc(1, sizeof(*weights));
  if (weights == NULL)
    return MO_ERR_NO_MEMORY;
  uint8_t *bytes = NULL;
  int error = mo_controller_encode(taken->controller, &bytes, &weights->file.size);
  if (error != MO_OK) {
    free(weights);
    return error;
  }
  mo_sha256_of(bytes, weights->file.size, &weights->hash);
  weights->file.bytes = bytes;
  weights->identity = taken->identity;
  weights->sensor = taken->controller->sensor;
  *ret = weights;
  return MO_OK;
}

static void discard(struct mo_weights *weights)
{
  free((void *)weights->file.bytes);
  free(weights);
}

void mo_weights_forget(struct mo_weights *weights)
{
  LIST_REMOVE(weights, next);
  discard(weights);
}

static struct mo_weights *use(struct mo_weights *weights)
{
  if (weights != NULL)
    weights->n_users++;
  return weights;
}

/* Compares parameters with the last bytes of a file. */
static bool same_weights(const struct mo_weights *weights, const struct mo_controller *controller)
{
  const size_t bytes = controller->n_parameters * sizeof(*controller->parameters);
  const struct mo_fleet_file *file = &weights->file;
  return weights->sensor == controller->sensor && file->size > bytes &&
         memcmp(file->bytes + file->size - bytes, controller->parameters, bytes) == 0;
}

struct mo_weights *mo_weights_find(struct mo_fleet *fleet, const struct mo_taken *taken)
{
  struct mo_weights *weights = LIST_FIRST(&fleet->weights);
  while (weights != NULL && weights->identity != taken->identity)
    weights = LIST_NEXT(weights, next);
  if (weights != NULL)
    return use(weights);
  weights = LIST_FIRST(&fleet->weights);
  while (weights != NULL &&
         (weights->identity != NULL || !same_weights(weights, taken->controller)))
    weights = LIST_NEXT(weights, next);
  if (weights != NULL)
    weights->identity = taken->identity;
  return use(weights);
}

static struct mo_weights *of(const struct mo_fleet *fleet, const struct mo_sha256 *hash)
{
  struct mo_weights *weights = LIST_FIRST(&fleet->weights);
  while (weights != NULL && !mo_sha256_equal(&weights->hash, hash))
    weights = LIST_NEXT(weights, next);
  return weights;
}

int mo_weights_read(struct mo_fleet *fleet, const struct mo_sha256 *hash,
                    struct mo_weights **weights)
{
  const struct mo_weights *other;
  uint32_t n_only_read = 0;
  LIST_FOREACH(other, &fleet->weights, next)
  n_only_read += other->n_readers > 0 && other->n_readers == other->n_users;
  *weights = use(of(fleet, hash));
  if (*weights == NULL)
    return MO_ERR_NOT_FOUND;
  const bool is_leased = (*weights)->n_users > (*weights)->n_readers + 1;
  if (!is_leased && n_only_read >= MO_WEIGHTS_READ) {
    mo_weights_release(fleet, *weights);
    return MO_ERR_BUSY;
  }
  (*weights)->n_readers++;
  return MO_OK;
}

struct mo_weights *mo_weights_add(struct mo_fleet *fleet, struct mo_weights *weights)
{
  struct mo_weights *same = of(fleet, &weights->hash);
  if (same == NULL || (same->identity != NULL && same->identity != weights->identity)) {
    weights->file.fleet = fleet;
    LIST_INSERT_HEAD(&fleet->weights, weights, next);
    return use(weights);
  }
  same->identity = weights->identity;
  discard(weights);
  return use(same);
}

void mo_weights_end_parcel(struct mo_weights *weights)
{
  if (weights != NULL && --weights->n_parcels == 0)
    weights->identity = NULL;
}

void mo_weights_release(struct mo_fleet *fleet, struct mo_weights *weights)
{
  struct mo_weights *oldest = NULL, *other;
  uint32_t n_unused = 0;
  if (weights == NULL || --weights->n_users > 0)
    return;
  LIST_REMOVE(weights, next); /* move to the front, so that the last unused one is the oldest */
  LIST_INSERT_HEAD(&fleet->weights, weights, next);
  LIST_FOREACH(other, &fleet->weights, next)
  {
    n_unused += other->n_users == 0;
    oldest = other->n_users == 0 ? other : oldest;
  }
  if (n_unused > MO_WEIGHTS_UNUSED)
    mo_weights_forget(oldest);
}
