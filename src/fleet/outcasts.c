/* outcasts.c: see outcasts.h. The mutex `saving` orders the copies that are stored, so that the
 * newest is the last one. It is locked before the fleet's. */
#include "fleet/outcasts.h"

#include <stdlib.h>
#include <string.h>

const struct mo_outcast *mo_outcast_find(const struct mo_fleet *fleet, const char *user,
                                         const char *name)
{
  for (uint32_t i = 0; i < fleet->n_quarantined; i++)
    if (strcmp(fleet->quarantined[i].user, user) == 0 &&
        strcmp(fleet->quarantined[i].name, name) == 0)
      return &fleet->quarantined[i];
  return NULL;
}

static void forget(struct mo_fleet *fleet, uint32_t i)
{
  fleet->n_quarantined--;
  memmove(&fleet->quarantined[i], &fleet->quarantined[i + 1],
          (fleet->n_quarantined - i) * sizeof(fleet->quarantined[0]));
}

void mo_outcast_add(struct mo_fleet *fleet, const struct mo_outcast *outcast)
{
  if (fleet->n_quarantined == MO_OUTCASTS_MAX)
    forget(fleet, 0);
  fleet->quarantined[fleet->n_quarantined++] = *outcast;
}

/* Copies the list; returns the length of the copy. */
static uint32_t copy(struct mo_fleet *fleet, const char *without, struct mo_outcast *items)
{
  uint32_t n = 0;
  MO_GUARD(&fleet->mutex);
  for (uint32_t i = 0; i < fleet->n_quarantined; i++)
    if (without == NULL || strcmp(fleet->quarantined[i].name, without) != 0)
      items[n++] = fleet->quarantined[i];
  if (without != NULL && n == fleet->n_quarantined)
    n = UINT32_MAX;
  return n;
}

static void release(struct mo_fleet *fleet, const char *name)
{
  MO_GUARD(&fleet->mutex);
  for (uint32_t i = fleet->n_quarantined; i-- > 0;)
    if (strcmp(fleet->quarantined[i].name, name) == 0)
      forget(fleet, i);
}

int mo_outcasts_save(struct mo_fleet *fleet, const char *without)
{
  const struct mo_fleet_config *config = &fleet->config;
  struct mo_outcast *items = malloc(MO_OUTCASTS_MAX * sizeof(*items));
  if (items == NULL)
    return MO_ERR_NO_MEMORY;
  pthread_mutex_lock(&fleet->saving);
  const uint32_t n = copy(fleet, without, items);
  int error = n == UINT32_MAX ? MO_ERR_NOT_FOUND : MO_OK;
  if (error == MO_OK && config->save_outcasts != NULL)
    error = config->save_outcasts(config->context, items, n);
  if (error == MO_OK && without != NULL)
    release(fleet, without);
  pthread_mutex_unlock(&fleet->saving);
  free(items);
  return error;
}
