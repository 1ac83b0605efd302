/* state.h: sessions and leases, shared by the files of this room.
 *
 * One mutex guards all of it. What must be called without it (the source, wake, event) is collected
 * in a struct mo_after while the mutex is held, and done by mo_after_run later. "Locked" in a
 * comment: call it with the mutex held. A thread reads the clock before it has the mutex, so that
 * `now_ns` may be older than a time that is stored here.
 *
 * A lease is work while it has its parcel: the blocks, which are delivered or put back once. When
 * they were delivered it may live on as a check, until its rows are compared: votes[0] are the rows
 * that were delivered, votes[1] those that differ. */
#ifndef MORPHO_FLEET_STATE_H
#define MORPHO_FLEET_STATE_H

#include <stdatomic.h>
#include <stdio.h>
#include <sys/queue.h>

#include "base/text.h"
#include "base/thread.h"
#include "fleet/facts.h"
#include "fleet/suspects.h"

#define MO_HOLDS           3 /* sessions that hold a lease at one time */
#define MO_VOTES           2 /* results of a check */
#define MO_CHECKS_MAX      512
#define MO_DROPPED_MAX     16 /* orders that wait for a session */
#define MO_ENDED_MAX       256
#define MO_SESSION_BUCKETS 4096
#define MO_LEASE_BUCKETS   16384

#define MO_S_NS UINT64_C(1000000000)

/* Blocks on their way back to the source. Allocated with the lease, so that nothing is lost. */
struct mo_parcel {
  struct mo_taken *taken;
  bool is_delivered, is_kept; /* neither: put back */
  struct mo_remote_result result;
  SLIST_ENTRY(mo_parcel) next;
};

struct mo_hold {
  struct mo_session *session;
  uint64_t given_ns, due_ns, late_ns, end_ns;
  bool is_late; /* late_ns has come */
};

struct mo_vote {
  uint64_t session; /* 0: this process */
  char name[MO_FLEET_NAME_BYTES + 1], host[MO_FLEET_NAME_BYTES + 1];
  double *losses;
  uint32_t *diverged_steps;
  struct mo_sha256 sum; /* of a gradient: of its sum and counts; otherwise zeros */
};

struct mo_lease {
  uint64_t number;
  struct mo_wire_lease content;
  struct mo_weights *weights;
  struct mo_parcel *parcel; /* NULL: a check */
  uint64_t steps;           /* of its rollouts */
  uint32_t n_holds, n_votes;
  struct mo_hold holds[MO_HOLDS];
  struct mo_vote votes[MO_VOTES];
  bool is_suspect;  /* has bodies whose leases ended sessions */
  bool is_kept;     /* goes back to be computed here: workers of its class cannot */
  bool is_only;     /* the same, three: its session holds no other lease */
  bool is_audit;    /* a check that waits for more results, not only for those that are coming */
  bool is_disputed; /* its votes differ, and this process decides */
  bool is_deciding; /* this process computes it now */
  bool is_listed;   /* in its class's list: another session should take it; or in `disputed` */
  uint64_t listed_ns;
  LIST_ENTRY(mo_lease) by_number;
  TAILQ_ENTRY(mo_lease) all, listed;
};

TAILQ_HEAD(mo_session_list, mo_session);
TAILQ_HEAD(mo_lease_list, mo_lease);

/* The measured rate of a session, over about its last ten leases. */
struct mo_pace {
  double steps, rows, s;
  uint64_t result_ns, lease_steps; /* of the newest */
};

struct mo_session {
  uint64_t id, worker; /* worker: a hash of its token, name and host */
  struct mo_fleet_offer offer;
  int64_t origin; /* 0: it delivered nothing yet */
  enum mo_session_state state, told;
  char why[128];
  uint64_t joined_ns, heard_ns, ended_ns, rest_ns; /* rest: no lease before this */
  bool serves[2], is_older, for_upgrade; /* older: its version; for_upgrade: it was drained so */
  struct mo_lease *held[2][MO_FLEET_LEASES];
  uint32_t n_held[2], n_taking[2]; /* taking: between the source and the table */
  struct mo_pace pace[2];
  uint32_t n_dropped, n_failures, n_refusals; /* the last two: leases in a row */
  struct mo_lease_id dropped[MO_DROPPED_MAX];
  double busy_s;
  uint64_t leases_done, leases_lost, rows_done, audits, audits_failed;
  LIST_ENTRY(mo_session) by_id;
  TAILQ_ENTRY(mo_session) all;
  TAILQ_ENTRY(mo_session) waiting[2];
  struct mo_session_list *waits_in[2]; /* NULL: does not wait */
};

/* Sessions and leases of one back end. */
struct mo_class {
  uint32_t n_sessions;               /* active */
  double steps_per_s;                /* of all of these that were measured; as of the last tick */
  struct mo_lease_list listed;       /* oldest first */
  struct mo_session_list idle, busy; /* they wait for work; busy ones hold some */
  bool may_have_work;                /* the source was not found empty since work came */
  double block_steps;                /* mean rollout steps of a block */
  uint32_t wanted;                   /* as told to the source */
};

struct mo_fleet {
  struct mo_fleet_config config;
  pthread_mutex_t mutex;
  atomic_bool arrived;
  uint64_t silence_ns, next_lease, refused_ns; /* refused: when the last event said so */
  struct mo_class classes[2];
  LIST_HEAD(, mo_session) sessions_by_id[MO_SESSION_BUCKETS];
  LIST_HEAD(, mo_lease) leases_by_number[MO_LEASE_BUCKETS];
  struct mo_session_list sessions, ended; /* in order of joining; newest end first */
  struct mo_lease_list leases;            /* oldest first */
  struct mo_lease_list disputed;          /* for this process to decide, oldest first */
  struct mo_decision {                    /* the block that this process computes */
    struct mo_lease *lease;               /* NULL: none */
    pthread_t thread;
    atomic_bool is_done;
    volatile int cancel;
    int error;
    uint64_t retry_ns; /* none before this */
    double losses[MO_BLOCK_LANES];
    uint32_t diverged_steps[MO_BLOCK_LANES];
  } decision;
  uint32_t n_sessions, n_ended, n_checks; /* checks: audits */
  LIST_HEAD(, mo_weights) weights;
  struct mo_suspects suspects;
  struct mo_fleet_status counts;
};

#endif
