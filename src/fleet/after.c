/* after.c: see after.h. mo_after_run puts blocks back at the front of their share, the last block
 * first, so that they end up in their original order. */
#include "fleet/after.h"

#include <stdlib.h>

struct mo_event {
  const char *type;
  char *data;
  struct mo_event *next;
};

void mo_after_put_back(struct mo_after *after, struct mo_parcel *parcel)
{
  parcel->is_delivered = false;
  after->is_put_back[parcel->taken->back_end] = true;
  SLIST_INSERT_HEAD(&after->parcels, parcel, next);
}

void mo_after_deliver(struct mo_after *after, struct mo_parcel *parcel,
                      const struct mo_remote_result *result)
{
  parcel->is_delivered = true;
  parcel->result = *result;
  SLIST_INSERT_HEAD(&after->parcels, parcel, next);
}

void mo_after_wake(struct mo_after *after, uint64_t session)
{
  if (after->n_wakes == after->wakes_capacity) {
    const uint32_t capacity = after->wakes_capacity > 0 ? 2 * after->wakes_capacity : 16;
    uint64_t *grown = realloc(after->wakes, capacity * sizeof(*grown));
    if (grown == NULL)
      return;
    after->wakes = grown;
    after->wakes_capacity = capacity;
  }
  after->wakes[after->n_wakes++] = session;
}

void mo_after_event(struct mo_after *after, const char *type, struct mo_text *data)
{
  struct mo_event *event = malloc(sizeof(*event));
  mo_text_add(data, "}");
  if (event == NULL || data->failed) {
    free(event);
    mo_text_free(data);
    return;
  }
  struct mo_event **last = &after->events;
  while (*last != NULL)
    last = &(*last)->next;
  *event = (struct mo_event){.type = type, .data = data->data};
  *last = event;
}

void mo_event_member(struct mo_text *text, const char *name, const char *words, size_t most)
{
  size_t n = 0;
  for (size_t bytes = 0; words[n] != '\0'; n++) {
    bytes += words[n] == '"' || words[n] == '\\' ? 2 : 1;
    if (bytes > most)
      break;
  }
  mo_text_name(text, name);
  mo_text_json_string(text, words, n);
}

void mo_event_session(struct mo_text *text, const char *name, const char *host, const char *why)
{
  mo_text_object(text);
  mo_event_member(text, "name", name, MO_EVENT_NAME_BYTES);
  mo_event_member(text, "host", host, MO_EVENT_NAME_BYTES);
  if (why[0] != '\0')
    mo_event_member(text, "why", why, MO_EVENT_WHY_BYTES);
}

static bool work_waits(const struct mo_fleet *fleet, const struct mo_after *after,
                       enum mo_back_end back_end)
{
  const struct mo_fleet_source *source = &fleet->config.source;
  return after->is_put_back[back_end] || source->waiting(source->compute, back_end) > 0;
}

void mo_after_run(struct mo_fleet *fleet, struct mo_after *after)
{
  const struct mo_fleet_config *config = &fleet->config;
  struct mo_parcel *parcel;
  while ((parcel = SLIST_FIRST(&after->parcels)) != NULL) {
    SLIST_REMOVE_HEAD(&after->parcels, next);
    if (parcel->is_delivered)
      config->source.deliver(config->source.compute, parcel->taken, &parcel->result);
    else if (parcel->is_kept)
      config->source.keep(config->source.compute, parcel->taken);
    else
      config->source.put_back(config->source.compute, parcel->taken);
    free(parcel);
  }
  for (uint32_t b = 0; b < 2; b++) {
    if (!after->is_emptied[b] || !work_waits(fleet, after, (enum mo_back_end)b))
      continue;
    struct mo_text data = {0};
    mo_text_object(&data);
    mo_event_member(&data, "class", config->classes[b].scores, MO_EVENT_NAME_BYTES);
    mo_after_event(after, "fleet.empty", &data);
  }
  for (struct mo_event *event = after->events, *next; event != NULL; event = next) {
    next = event->next;
    if (config->event != NULL)
      config->event(config->context, event->type, event->data);
    free(event->data);
    free(event);
  }
  for (uint32_t i = 0; i < after->n_wakes && config->wake != NULL; i++)
    config->wake(config->context, after->wakes[i]);
  free(after->wakes);
  *after = (struct mo_after){0};
}
