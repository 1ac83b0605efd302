/* records.h: records of jobs that the store returns, and definitions that other records share with
 * them.
 *
 * Times are microseconds since 1970-01-01 UTC; 0 means "not yet". Strings are UTF-8 and always
 * terminated. Lists of genotypes (struct mo_bits) belong to the store's workspace. */
#ifndef MORPHO_STORE_RECORDS_H
#define MORPHO_STORE_RECORDS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include <morpho/compute.h>
#include <morpho/controller.h>
#include <morpho/learning.h>
#include <morpho/morphospace.h>
#include <morpho/score_ladder.h>
#include <morpho/world.h>

#include "store/design_notes.h"
#include "store/hash.h"

/* The workspace of the genotypes and ids in the database, and of the controllers that score. The
 * service's lattice is made for it. */
#define MO_STORE_WORKSPACE MO_DEFAULT_WORKSPACE

#define MO_DESIGNS_MAX           10000    /* in a request's list, except for large evaluations */
#define MO_LARGE_MAX             1000000  /* designs of an evaluation */
#define MO_RANDOM_BODIES_MAX     1000000  /* of one seed */
#define MO_LARGE_ROLLOUTS_MAX    10000000 /* of an evaluation that is large or has random bodies */
#define MO_ENVIRONMENTS_MAX      64       /* of one evaluation */
#define MO_LABEL_BYTES_MAX       800      /* 200 characters of UTF-8 */
#define MO_EXPERIMENT_BYTES_MAX  400      /* 100 characters */
#define MO_NOTE_BYTES_MAX        4000     /* 1000 characters */
#define MO_USER_BYTES_MAX        64       /* the name of a token */
#define MO_NAME_BYTES_MAX        64       /* of the name of a controller or a set of environments */
#define MO_ORIGIN_BYTES          130      /* "name@host" of a worker, with NUL */
#define MO_IDEMPOTENCY_BYTES_MAX 255
#define MO_PAGE_MAX              1000 /* rows of one page of any list */
#define MO_WEIGHT_MIN            1e-3 /* of a job */
#define MO_WEIGHT_MAX            1e3

enum mo_job_kind {
  MO_JOB_EVALUATION = 0,
  MO_JOB_TRAINING,
  MO_JOB_CAMPAIGN,
  MO_JOB_ATLAS,
  MO_JOB_CERTIFICATE
};
#define MO_JOB_KINDS 5
enum mo_job_state {
  MO_JOB_QUEUED = 0,
  MO_JOB_RUNNING = 1,
  MO_JOB_PAUSED = 2,
  MO_JOB_SUCCEEDED = 3,
  MO_JOB_FAILED = 4,
  MO_JOB_CANCELLED = 5
};
#define MO_JOB_STATES 6 /* in the database, 6 is a job that is being deleted */
const char *mo_job_state_name(enum mo_job_state state); /* "queued" … "cancelled" */
const char *mo_job_kind_name(enum mo_job_kind kind);    /* "evaluation", "training" … */
extern const char *const mo_job_state_words[], *const mo_job_kind_words[]; /* base/words.h */
static inline bool mo_job_state_is_final(enum mo_job_state state)
{
  return state >= MO_JOB_SUCCEEDED;
}

/* Identifies a request that a client may repeat during idempotency_keep_s: its key and its hash. */
struct mo_request_key {
  const char *text; /* ≤ MO_IDEMPOTENCY_BYTES_MAX; NULL: none */
  struct mo_sha256 sha256;
};

/* The part of a submission that all kinds of jobs share. */
struct mo_submission {
  int priority;                   /* enum mo_urgency */
  int back_end;                   /* enum mo_back_end */
  double weight;                  /* MO_WEIGHT_MIN … MO_WEIGHT_MAX; 0: 1 */
  const char *label, *experiment; /* nullable */
  const char *submitted_by;       /* nullable: the name of a token */
  struct mo_request_key key;
};

/* A caution for readers of a job's result. code: "diverged", "unstable_step" … (warnings.c) */
struct mo_warning {
  const char *code;
  bool of_request; /* already known at submission */
  char detail[231];
};
#define MO_WARNINGS_MAX 5

/* A job. It describes an evaluation completely except for its results. For a training run or a
 * campaign, it contains the members that lists show (for the rest, see store/trainings.h and
 * store/campaigns.h). It owns nothing, so it may be copied. */
struct mo_job {
  int64_t id;      /* ≥ 1 */
  int64_t version; /* incremented with every change to the row: the ETag */
  enum mo_job_kind kind;
  enum mo_job_state state;
  enum mo_urgency priority;
  double weight; /* MO_WEIGHT_MIN … MO_WEIGHT_MAX: its share of the cores among batch jobs */
  enum mo_back_end back_end;          /* chosen at submission; never changes */
  char label[MO_LABEL_BYTES_MAX + 1]; /* "": none */
  bool has_label, verify;             /* verify: of an evaluation */
  char experiment[MO_EXPERIMENT_BYTES_MAX + 1], note[MO_NOTE_BYTES_MAX + 1]; /* "": none */
  char submitted_by[MO_USER_BYTES_MAX + 1]; /* the name of a token; "": submitted without one */
  int64_t created_us, started_us, finished_us, archived_us;
  double worker_s, device_s; /* seconds of computing for this job, up to its last event */
  uint32_t attempts;         /* crashes and runner errors so far */
  int error; /* MO_OK or a code; set when the job failed, or by the last unsuccessful attempt;
                MO_ERR_DEVICE: paused for lack of a device */
  char error_text[256];
  /* An evaluation has all of the following. A training run has the controller that it starts from
   * (has_controller false: random weights), sensor, physics, n_designs, and optionally
   * environments. A campaign has the same, always with environments; its n_designs is the
   * population. */
  bool has_controller;
  char controller_name[MO_NAME_BYTES_MAX + 8]; /* as requested at submission; "": by hash */
  struct mo_sha256 controller_sha256;          /* the content of the name at submission */
  enum mo_sensor sensor; /* of the controller, or of the settings without one */
  bool has_result;       /* a training run or campaign has made this controller: */
  struct mo_sha256 result_sha256;
  char environment_set[MO_NAME_BYTES_MAX + 1];   /* a set or suite, or "": listed */
  uint32_t n_environments, n_designs, n_skipped; /* n_skipped: designs of an evaluation */
  bool is_random; /* the designs of an evaluation are random bodies of a seed */
  uint64_t random_seed;
  uint32_t random_first, n_waiting; /* n_waiting: number of its last designs that are not stored
                                       yet */
  uint32_t best, measures; /* best designs that get complete scores, 0: all; measures, as bits */
  uint32_t n_displaced;    /* displaced starts that estimate the errors of scores; 0: no estimate */
  double tolerance;        /* of the scores' estimated errors; 0: none was requested */
  struct mo_physics physics;
  enum mo_precision precision;
  uint32_t record, record_stride; /* channels; steps between two frames */
  uint64_t recorded_bytes;        /* of its recordings that are stored */
  int64_t recordings_removed_us;  /* 0: not removed */
  /* 0 for a training run; done includes cached and cut rollouts, which are not computed. */
  uint64_t rollouts_total, rollouts_done, rollouts_cached, rollouts_diverged, rollouts_cut;
  /* Training: steps. Campaign: generations, without generation 0; done: committed. */
  uint32_t steps_total, steps_done;
  /* For training runs and campaigns, set only if requested when reading. */
  struct mo_warning warnings[MO_WARNINGS_MAX];
  uint32_t n_warnings;
};

#endif
