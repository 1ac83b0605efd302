/* state.h: sessions and leases, which the files of this room share.
 *
 * One mutex (the lock) guards all of this. Calls that must be made without it (source, wake, event)
 * are collected in a struct mo_after while the mutex is held, and mo_after_run makes them later. A
 * thread reads the clock before it takes the mutex, so `now_ns` may be older than a time that is
 * stored here.
 *
 * A lease is work as long as it has its parcel, which are the blocks that are delivered or put back
 * once. After delivery, the lease may remain as a check until its rows are compared: votes[0] has
 * the delivered rows, votes[1] the rows that differ. */
#ifndef MORPHO_FLEET_STATE_H
#define MORPHO_FLEET_STATE_H

#include <stdatomic.h>
#include <stdio.h>
#include <sys/queue.h>

#include "base/text.h"
#include "base/thread.h"
#include "fleet/facts.h"
#include "fleet/suspects.h"

#define MO_HOLDS           3 /* sessions that may hold a lease at the same time */
#define MO_VOTES           2 /* results of a check */
#define MO_CHECKS_MAX      512
#define MO_DROPPED_MAX     16 /* orders that are waiting for a session */
#define MO_ENDED_MAX       256
#define MO_SESSION_BUCKETS 4096
#define MO_LEASE_BUCKETS   16384

#define MO_S_NS UINT64_C(1000000000)

/* Blocks on their way back to the source. Allocated together with the lease, so that this cannot
 * fail later. */
struct mo_parcel {
  struct mo_taken *taken;
  bool is_delivered, is_kept; /* neither delivered nor kept: put back */
  struct mo_remote_result result;
  SLIST_ENTRY(mo_parcel) next;
};

struct mo_hold {
  struct mo_session *session;
  uint64_t given_ns, due_ns, late_ns, end_ns;
  bool is_late; /* late_ns has passed */
};

struct mo_vote {
  uint64_t session; /* 0: this process */
  char name[MO_FLEET_NAME_BYTES + 1], host[MO_FLEET_NAME_BYTES + 1];
  double *losses;
  uint32_t *diverged_steps;
  double (*measures)[MO_MEASURES]; /* NULL: none */
  struct mo_sha256 sum;            /* of a gradient: hash of its sum and counts; otherwise zeros */
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
  bool is_suspect;  /* has bodies that ended sessions */
  bool is_kept;     /* put back, to be computed here: workers of its class cannot */
  bool is_only;     /* its bodies were lost three times: its session holds no other lease */
  bool is_audit;    /* a check that needs one more session, besides those already computing */
  bool is_disputed; /* its votes differ, and this process decides */
  bool is_deciding; /* this process is computing it */
  bool is_listed;   /* in the list of its class (another session should take it), or in
                     * `disputed` */
  uint64_t listed_ns;
  LIST_ENTRY(mo_lease) by_number;
  TAILQ_ENTRY(mo_lease) all, listed;
};

TAILQ_HEAD(mo_session_list, mo_session);
TAILQ_HEAD(mo_lease_list, mo_lease);

/* The measured rate of a session, over about its last ten leases. */
struct mo_pace {
  double steps, rows, s;
  uint64_t result_ns, lease_steps; /* of the newest result */
};

struct mo_session {
  uint64_t id, worker; /* worker: a hash of its token, name and host */
  struct mo_fleet_offer offer;
  int64_t origin; /* 0: it has not delivered yet */
  enum mo_session_state state, told;
  char why[128];
  uint64_t joined_ns, heard_ns, ended_ns, rest_ns; /* rest_ns: no lease before this time */
  bool serves[2], is_older, for_upgrade;           /* is_older: its version; for_upgrade: why it was
                                                    * drained */
  struct mo_lease *held[2][MO_FLEET_LEASES];
  uint32_t n_held[2], n_taking[2]; /* n_taking: between the source and the table */
  struct mo_pace pace[2];
  uint32_t n_dropped, n_failures, n_refusals; /* the last two count leases in a row */
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
  double steps_per_s;                /* of all measured sessions among these, as of the last tick */
  struct mo_lease_list listed;       /* oldest first */
  struct mo_session_list idle, busy; /* sessions that wait for work; busy ones hold leases */
  bool may_have_work;                /* work arrived since the source was last found empty */
  double block_steps;                /* mean rollout steps of a block */
  uint32_t wanted;                   /* the number last reported to the source */
};

struct mo_fleet {
  struct mo_fleet_config config;
  pthread_mutex_t mutex;
  atomic_bool arrived;
  uint64_t silence_ns, next_lease, refused_ns; /* refused_ns: time of the last event about a
                                                * refusal */
  struct mo_class classes[2];
  LIST_HEAD(, mo_session) sessions_by_id[MO_SESSION_BUCKETS];
  LIST_HEAD(, mo_lease) leases_by_number[MO_LEASE_BUCKETS];
  struct mo_session_list sessions, ended; /* in order of joining; most recently ended first */
  struct mo_lease_list leases;            /* oldest first */
  struct mo_lease_list disputed;          /* for this process to decide, oldest first */
  struct mo_decision {                    /* the block that this process is computing */
    struct mo_lease *lease;               /* NULL: none */
    pthread_t thread;
    atomic_bool is_done;
    volatile int cancel;
    int error;
    uint64_t retry_ns; /* no new attempt before this time */
    double losses[MO_BLOCK_LANES];
    uint32_t diverged_steps[MO_BLOCK_LANES];
    double measures[MO_BLOCK_LANES][MO_MEASURES];
  } decision;
  uint32_t n_sessions, n_ended, n_checks; /* n_checks: audits */
  LIST_HEAD(, mo_weights) weights;
  struct mo_suspects suspects;
  struct mo_fleet_status counts;
};

#endif
