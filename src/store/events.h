/* events.h: the events of jobs and controllers, in order. Threads and errors as in store.h. */
#ifndef MORPHO_STORE_EVENTS_H
#define MORPHO_STORE_EVENTS_H

#include "store/records.h"

struct mo_store;

struct mo_event {
  int64_t sequence; /* ≥ 1, grows by commit order, never reused */
  int64_t time_us;
  int64_t job;    /* 0: not about a job */
  char type[32];  /* "job.created", "job.started", "job.weight", "job.progress", "job.paused",
                     "job.resumed", "job.requeued", "job.finished", "job.warning",
                     "evaluation.code_changed", "evaluation.recordings_removed",
                     "training.progress", "training.validation", "training.checkpoint",
                     "training.code_changed", "campaign.progress", "campaign.generation",
                     "campaign.diversity_collapse", "campaign.extended", "campaign.imported",
                     "campaign.lineage_unreadable", "controller.stored", "controller.removed",
                     "fleet.joined", "fleet.left", "fleet.lost", "fleet.refused",
                     "fleet.older", "fleet.differs", "fleet.empty", "scores.imported",
                     "scores.differ" */
  char data[512]; /* a JSON object */
};

/* Queues an event that is not about a job, without waiting. type: fewer than 32 bytes; data: a JSON
 * object of fewer than 512 bytes. MO_ERR_LIMIT. */
int mo_store_event(struct mo_store *store, const char *type, const char *data);

/* Called on the writer's thread after each commit with new events, in order. It must be short and
 * must not call functions of the store that write. */
typedef void (*mo_store_listener)(void *context, const struct mo_event *events, size_t n);
/* MO_ERR_NO_MEMORY, MO_ERR_LIMIT. */
int mo_store_subscribe(struct mo_store *store, mo_store_listener listener, void *context,
                       int *ret_handle);
/* After it returns, the listener is not called again. */
void mo_store_unsubscribe(struct mo_store *store, int handle);

/* Finds the newest kept event with a sequence of at most `after`: `after` itself, unless it was
 * pruned or belongs to a different history of the store. 0: no such event. */
int mo_store_event_before(struct mo_store *store, int64_t after, int64_t *sequence);
/* Reads events with sequence > after, ascending, at most `limit`; job 0: of all jobs. Returns the
 * number written to `events` or an error. *oldest, *newest (nullable): the range of kept events (0,
 * 0: no events yet), of up to 18 digits. If after < *oldest − 1, some events were pruned, and the
 * client needs a `reset`. */
int64_t mo_store_events(struct mo_store *store, int64_t after, int64_t job, struct mo_event *events,
                        size_t limit, int64_t *oldest, int64_t *newest);

#endif
