/* fleet.h: workers on other machines that compute for this daemon.
 *
 * A worker opens a session. It takes leases, which are blocks from the fair queue of its class, and
 * returns their rows. Leases exist only in memory, so they are recomputed after a restart of the
 * daemon. If a session leaves, is silent, or takes too long for a lease, the lease is given to
 * another session. The first result counts, and later ones are compared with it.
 *
 * This room does not depend on HTTP or SQL. Time is the argument `now_ns` (from mo_clock_ns), so
 * that tests can set the clock. All functions may be called from any thread. */
#ifndef MORPHO_FLEET_FLEET_H
#define MORPHO_FLEET_FLEET_H

#include "fleet/source.h"

/* Incremented with every change to the messages, the wire format or the canary. Workers of any
 * version of the program may join if they use this protocol and compute the same bits. */
#define MO_FLEET_PROTOCOL 7

#define MO_FLEET_SESSIONS_MAX 4096
#define MO_FLEET_TOKEN_MAX    2048 /* sessions opened with one token */
#define MO_FLEET_NAME_BYTES   64   /* name of a session or host, without NUL */
#define MO_FLEET_SILENCE_MS   6000
#define MO_FLEET_LEASE_S      1.0 /* time that a lease should take */
#define MO_FLEET_LEASES       2   /* that a session holds at a time, for each back end */

enum mo_session_state {
  MO_SESSION_ACTIVE,
  MO_SESSION_DRAINING, /* gets no further leases */
  MO_SESSION_REFUSED,  /* returned wrong bits; its later results are ignored */
  MO_SESSION_LEFT,     /* it left */
  MO_SESSION_LOST      /* its connection ended, or it stopped responding */
};
extern const char *const mo_session_state_words[]; /* "active", …; ends with NULL */

struct mo_fleet_config {
  struct mo_fleet_source source;
  struct mo_workspace workspace; /* of all bodies and controllers */
  uint64_t epoch;
  uint64_t seed;       /* for choosing audits; fixed in tests */
  const char *version; /* of the program; a worker of any version may join if it serves one of these
                        * classes */
  /* By enum mo_back_end: the class, and the hash that its canary must have. class NULL: not served.
   * is_absent: only workers have the class. The canary of the first such worker becomes the
   * reference, and `name_class` names the class. */
  struct {
    const char *scores, *gradients;
    struct mo_sha256 canary;
    bool is_absent;
  } classes[2];
  uint32_t silence_ms; /* 0: MO_FLEET_SILENCE_MS */
  /* Each may be NULL; called without locks. name_class: a worker has an absent class that has no
   * name yet. Returns permanent names for it; an error refuses the session. origin: returns the
   * number of the "name@host" that results are delivered under, called before the first delivery;
   * an error refuses the results. wake: there may be orders for the session, or work for its
   * waiting request. event: type such as "fleet.joined", data: a JSON object. */
  int (*name_class)(void *context, enum mo_back_end back_end, const char *scores,
                    const char *gradients, const char *names[2]);
  int (*origin)(void *context, const char *text, int64_t *number);
  void (*wake)(void *context, uint64_t session);
  void (*event)(void *context, const char *type, const char *data);
  void *context;
};

struct mo_fleet;
int mo_fleet_create(const struct mo_fleet_config *config, struct mo_fleet **fleet);
/* Puts all leases back. NULL-safe. Call it before mo_compute_free. */
void mo_fleet_free(struct mo_fleet *fleet);

/* ---- canary: frozen rollouts and a gradient that have the same bits throughout a class ---- */
/* Computes the canary of a class with the CPU workers or the devices of a back end. It takes half a
 * second of one CPU. MO_ERR_DEVICE, MO_ERR_NO_MEMORY. */
int mo_fleet_canary(struct mo_compute *compute, enum mo_back_end back_end, struct mo_sha256 *hash);

/* ---- sessions ---- */
struct mo_fleet_offer {
  char name[MO_FLEET_NAME_BYTES + 1], host[MO_FLEET_NAME_BYTES + 1], version[32];
  char user[MO_FLEET_NAME_BYTES + 1]; /* the user of its token; "": none */
  uint32_t n_threads, n_devices;
  struct {
    char scores[128], gradients[128]; /* "": does not serve this back end */
    struct mo_sha256 canary;
  } classes[2]; /* by enum mo_back_end */
};
/* Opens a session. Returns its id, an unguessable number from 1 to 10^18. MO_ERR_UNSUPPORTED: this
 * daemon serves none of its classes; MO_ERR_CONFLICT: a wrong canary (the message contains both
 * hashes); MO_ERR_LIMIT. */
int64_t mo_fleet_join(struct mo_fleet *fleet, const struct mo_fleet_offer *offer, uint64_t now_ns,
                      struct mo_message *message);
/* Returns whether a session is open and was opened with this user's token. */
bool mo_fleet_is_of(struct mo_fleet *fleet, uint64_t session, const char *user);
/* Closes a session and puts its leases back. why: "left", "connection ended". MO_ERR_NOT_FOUND. */
int mo_fleet_leave(struct mo_fleet *fleet, uint64_t session, bool is_lost, uint64_t now_ns);
/* Takes results, and gives leases while the session holds fewer than MO_FLEET_LEASES. `up`: a
 * message of results, or size 0; results are ignored if the session does not hold their leases.
 * `down` (malloc): a message of leases. *n_leases: the number of leases; if 0, call this again
 * after `wake`. MO_ERR_NOT_FOUND: the session does not exist, or ended, so the worker must join
 * again; MO_ERR_FORMAT: no result was taken; MO_ERR_CONFLICT: the session is refused. */
int mo_fleet_exchange(struct mo_fleet *fleet, uint64_t session, const uint8_t *up, size_t up_size,
                      uint64_t now_ns, uint8_t **down, size_t *down_size, uint32_t *n_leases,
                      struct mo_message *message);

/* Orders that a session gets from its watch request: leases to drop, and whether to continue. */
struct mo_fleet_orders {
  enum mo_session_state state;
  char wanted[32]; /* if draining: the version with which its worker should be restarted; "":
                      none */
  uint32_t n_dropped;
  struct mo_lease_id dropped[16];
};
/* Reads the orders since the last call; a call also counts as a heartbeat. Returns 1 if there are
 * any, otherwise 0. MO_ERR_NOT_FOUND. */
int mo_fleet_orders(struct mo_fleet *fleet, uint64_t session, uint64_t now_ns,
                    struct mo_fleet_orders *orders);
/* Returns the weights that a lease uses: the file with this SHA-256, valid until it is released.
 * MO_ERR_NOT_FOUND; MO_ERR_BUSY: no current lease uses it, and slow readers already hold too many
 * files. */
struct mo_fleet_file {
  struct mo_fleet *fleet;
  const uint8_t *bytes;
  size_t size;
};
int mo_fleet_controller(struct mo_fleet *fleet, const struct mo_sha256 *hash,
                        struct mo_fleet_file **file);
void mo_fleet_file_release(void *file); /* call it before mo_fleet_free */

/* Call it about every 20 ms. Gives late leases to other sessions, ends silent sessions, drops
 * cancelled leases, and wakes sessions if there is work for them. */
void mo_fleet_tick(struct mo_fleet *fleet, uint64_t now_ns);
/* Reports that work was queued while the queue was empty; the next tick wakes sessions. Takes no
 * lock. */
void mo_fleet_arrived(struct mo_fleet *fleet);

/* For operators. MO_ERR_NOT_FOUND. */
int mo_fleet_drain(struct mo_fleet *fleet, uint64_t session, bool for_upgrade);

#endif
