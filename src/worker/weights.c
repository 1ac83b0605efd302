/* weights.c: see weights.h. */
#include "worker/weights.h"

static void forget(struct mo_kept *item)
{
  mo_compute_controller_free(item->prepared);
  mo_controller_free(item->controller);
  *item = (struct mo_kept){0};
}

int mo_kept_weights_init(struct mo_kept_weights *weights, struct mo_compute *compute)
{
  *weights = (struct mo_kept_weights){.compute = compute};
  weights->items[0].users = 1; /* so that it is never evicted */
  return mo_compute_controller_create(compute, NULL, &weights->items[0].prepared);
}

void mo_kept_weights_clear(struct mo_kept_weights *weights)
{
  for (size_t i = 0; i < MO_WEIGHTS_KEPT; i++)
    forget(&weights->items[i]);
}

/* Returns a free entry, or else the entry that has been unused for the longest time. Returns NULL
 * if all are in use. */
static struct mo_kept *oldest(struct mo_kept_weights *weights)
{
  struct mo_kept *found = NULL;
  for (struct mo_kept *item = weights->items; item < weights->items + MO_WEIGHTS_KEPT; item++)
    if (item->users == 0 && (found == NULL || item->used < found->used))
      found = item;
  return found;
}

int mo_kept_weights_add(struct mo_kept_weights *weights, const struct mo_sha256 *hash,
                        struct mo_workspace workspace, const uint8_t *bytes, size_t size,
                        struct mo_message *message)
{
  struct mo_sha256 actual;
  struct mo_kept made = {.hash = *hash}, *place = oldest(weights);
  mo_sha256_of(bytes, size, &actual);
  if (!mo_sha256_equal(&actual, hash))
    return mo_fail(message, MO_ERR_CORRUPT, "the weights do not match their hash");
  if (place == NULL)
    return mo_fail(message, MO_ERR_EXHAUSTED, "all %d places for controllers are in use",
                   MO_WEIGHTS_KEPT);
  int error = mo_controller_decode(bytes, size, &made.controller, message);
  if (error != MO_OK)
    return error;
  if (!mo_workspace_equal(made.controller->workspace, workspace))
    error = mo_fail(message, MO_ERR_FORMAT, "the weights are for a different workspace");
  if (error == MO_OK)
    error = mo_compute_controller_create(weights->compute, made.controller, &made.prepared);
  if (error != MO_OK) {
    mo_controller_free(made.controller);
    return error;
  }
  forget(place);
  *place = made;
  return MO_OK;
}

struct mo_compute_controller *mo_kept_weights_take(struct mo_kept_weights *weights,
                                                   const struct mo_sha256 *hash)
{
  for (struct mo_kept *item = weights->items; item < weights->items + MO_WEIGHTS_KEPT; item++)
    if (item->prepared != NULL && mo_sha256_equal(&item->hash, hash)) {
      item->users++;
      item->used = ++weights->takes;
      return item->prepared;
    }
  return NULL;
}

void mo_kept_weights_release(struct mo_kept_weights *weights,
                             const struct mo_compute_controller *controller)
{
  for (struct mo_kept *item = weights->items; item < weights->items + MO_WEIGHTS_KEPT; item++)
    if (item->prepared == controller)
      item->users--;
}
