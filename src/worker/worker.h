/* worker.h: computes a daemon's leases until it is stopped.
 *
 * mo_worker_run joins the daemon and runs the session; when the connection is lost, it rejoins. A
 * session holds two leases, so that computing never waits for the network: the call that sends
 * results returns the next lease. A request for orders is always open; the daemon drops the session
 * as soon as its connection is closed. Results for a lost session are discarded, because the daemon
 * has given the work to other workers. */
#ifndef MORPHO_WORKER_WORKER_H
#define MORPHO_WORKER_WORKER_H

#include "fleet/fleet.h"
#include "worker/link.h"

enum mo_worker_end {
  MO_WORKER_LEFT,        /* as requested */
  MO_WORKER_UNWANTED,    /* the daemon requires a different version or class, or drains it for an
                          * upgrade */
  MO_WORKER_REFUSED,     /* its bits are wrong: its canary or its session is refused */
  MO_WORKER_DENIED,      /* token or certificate */
  MO_WORKER_MISPLACED,   /* the server is not a daemon with a fleet */
  MO_WORKER_UNREACHABLE, /* for longer than give_up_ms */
  MO_WORKER_FAILED       /* out of memory, or no computing device left */
};

enum mo_worker_news { MO_WORKER_INFO, MO_WORKER_WARNING };

struct mo_worker_config {
  struct mo_link_config link;
  struct mo_fleet_offer offer;
  struct mo_compute *compute;
  uint64_t idle_ms;    /* leave after this time without a lease; 0: never */
  uint64_t give_up_ms; /* exit after this time without the daemon; 0: never */
  int64_t leave_at_us; /* when to leave, by the wall clock; 0: never */
  /* Reports an event. Called on any thread of the worker. */
  void (*say)(void *context, enum mo_worker_news news, const char *what, const char *detail);
  void *context;
};

struct mo_worker;
/* Errors as in mo_link_create. */
int mo_worker_create(const struct mo_worker_config *config, struct mo_worker **worker,
                     struct mo_message *message);
void mo_worker_free(struct mo_worker *worker); /* NULL-safe; before mo_compute_free */

/* Runs until the worker leaves. message: the reason, or "" if a stop was requested. */
enum mo_worker_end mo_worker_run(struct mo_worker *worker, struct mo_message *message);
/* Stops the worker, from any thread: it returns the work that it has not begun, computes at most
 * MO_WORKER_STOP_MS longer, sends its results, and leaves. A second call makes it leave at once. */
#define MO_WORKER_STOP_MS 800
void mo_worker_stop(struct mo_worker *worker);

/* Writes one line that describes the worker's state. Any thread may call it. */
void mo_worker_describe(struct mo_worker *worker, char *text, size_t capacity);

#endif
