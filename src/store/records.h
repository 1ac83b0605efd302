/* records.h: what the store returns: jobs, designs, controllers, events.
 *
 * Times are microseconds since 1970-01-01 UTC; 0 means "not yet". Strings are UTF-8 and always
 * terminated. The service works in the default workspace, so a genotype has MO_DEFAULT_WORDS words.
 */
#ifndef MORPHO_STORE_RECORDS_H
#define MORPHO_STORE_RECORDS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include <morpho/compute.h>
#include <morpho/controller.h>
#include <morpho/learning.h>
#include <morpho/morphospace.h>
#include <morpho/rollout.h>
#include <morpho/world.h>

#include "store/design_notes.h"
#include "store/hash.h"

#define MO_DESIGNS_MAX           10000 /* of one evaluation */
#define MO_ENVIRONMENTS_MAX      64    /* of one evaluation */
#define MO_LABEL_BYTES_MAX       800   /* 200 characters of UTF-8 */
#define MO_USER_BYTES_MAX        64    /* the name of a token */
#define MO_NAME_BYTES_MAX        64    /* of the name of a controller or a set of environments */
#define MO_IDEMPOTENCY_BYTES_MAX 255
#define MO_PAGE_MAX              1000 /* rows of one page of any list */
#define MO_WEIGHT_MIN            1e-3 /* of a job */
#define MO_WEIGHT_MAX            1e3

struct mo_bits {
  uint64_t words[MO_DEFAULT_WORDS];
};

enum mo_job_kind { MO_JOB_EVALUATION = 0, MO_JOB_TRAINING = 1, MO_JOB_CAMPAIGN = 2 };
#define MO_JOB_KINDS 3
enum mo_job_state {
  MO_JOB_QUEUED = 0,
  MO_JOB_RUNNING = 1,
  MO_JOB_PAUSED = 2,
  MO_JOB_SUCCEEDED = 3,
  MO_JOB_FAILED = 4,
  MO_JOB_CANCELLED = 5
};
#define MO_JOB_STATES 6
const char *mo_job_state_name(enum mo_job_state state); /* "queued" … "cancelled" */
const char *mo_job_kind_name(enum mo_job_kind kind);    /* "evaluation", "training", "campaign" */
extern const char *const mo_job_state_words[], *const mo_job_kind_words[]; /* base/words.h */
static inline bool mo_job_state_is_final(enum mo_job_state state)
{
  return state >= MO_JOB_SUCCEEDED;
}

/* A job. An evaluation is complete but for its results; a training or a campaign has what lists
 * show (the rest: store/trainings.h, store/campaigns.h). Owns nothing, so it may be copied. */
struct mo_job {
  int64_t id;      /* ≥ 1 */
  int64_t version; /* grows with every change of the row: the ETag */
  enum mo_job_kind kind;
  enum mo_job_state state;
  enum mo_urgency priority;
  double weight; /* MO_WEIGHT_MIN … MO_WEIGHT_MAX: its share of the cores among batch jobs */
  enum mo_back_end back_end;          /* chosen at submission; never changes */
  char label[MO_LABEL_BYTES_MAX + 1]; /* "" when none was given */
  bool has_label;
  char submitted_by[MO_USER_BYTES_MAX + 1]; /* the name of a token; "": submitted without one */
  int64_t created_us, started_us, finished_us;
  uint32_t attempts; /* crashes and runner errors so far */
  int error; /* MO_OK or a code; set when the job failed, or by the last unsuccessful attempt;
                MO_ERR_DEVICE: paused for lack of a device */
  char error_text[256];
  /* For an evaluation all of these. For a training: the controller that it starts from ("" and
   * zeros: random weights), sensor, physics, n_designs. For a campaign: likewise the controller,
   * and environments, sensor, physics; n_designs is the population. */
  char controller_name[MO_NAME_BYTES_MAX + 8]; /* as requested at submission; "": by hash */
  struct mo_sha256 controller_sha256;
  enum mo_sensor sensor;
  char environment_set[MO_NAME_BYTES_MAX + 1];   /* "paper-test", or "": listed in the request */
  uint32_t n_environments, n_designs, n_skipped; /* n_skipped: of the designs of an evaluation */
  struct mo_physics physics;
  enum mo_precision precision;
  bool verify;
  unsigned record; /* channels */
  uint32_t record_stride;
  uint64_t recorded_bytes;       /* of its recordings that are stored */
  int64_t recordings_removed_us; /* 0: they were not */
  /* 0 in a training; done includes cached. */
  uint64_t rollouts_total, rollouts_done, rollouts_cached, rollouts_diverged;
  /* Training: steps. Campaign: generations, without generation 0; done: committed. */
  uint32_t steps_total, steps_done;
};

struct mo_controller_record {
  char name[MO_NAME_BYTES_MAX + 1]; /* "" when looked up by hash */
  int64_t version;                  /* of the name: grows when the name gets other content */
  struct mo_sha256 sha256;          /* of the file's bytes */
  uint64_t size;                    /* bytes */
  enum mo_sensor sensor;
  struct mo_workspace workspace;
  uint64_t n_parameters;
  int64_t stored_us; /* when this name got this content (by hash: when the content was stored) */
};

/* One page row of designs. */
struct mo_design_row {
  int64_t row;         /* cursor of sort=id */
  struct mo_bits form; /* canonical */
  int64_t first_seen_us;
  struct mo_bits genotype; /* sort=score: the scored genotype, oriented and placed */
  double score; /* sort=score: mean loss; +infinity when a rollout diverged. NaN otherwise */
  int64_t genotype_row; /* sort=score: with score, the cursor */
};

/* The score of one oriented genotype under one setting: over a whole named set, or in one
 * environment that belongs to no set. */
struct mo_design_score {
  struct mo_sha256 controller_sha256, physics_sha256;
  enum mo_precision precision;
  enum mo_sensor sensor;
  char environment_set[MO_NAME_BYTES_MAX + 1]; /* "": one environment, named by its hash */
  struct mo_sha256 environment_sha256;         /* when environment_set is "" */
  double score; /* mean; +infinity when a rollout diverged; NaN when the set is incomplete */
  uint32_t n_losses;
  double losses[MO_ENVIRONMENTS_MAX]; /* NaN: not computed yet */
  int32_t diverged_steps[MO_ENVIRONMENTS_MAX];
  int64_t computed_us;                    /* when the newest rollout was computed */
  char fingerprint[MO_FINGERPRINT_BYTES]; /* its class */
  char origin[65];                        /* the host that computed the newest rollout */
};

struct mo_design_orientation {
  struct mo_bits genotype; /* placed */
  uint32_t n_scores;
  struct mo_design_score *scores; /* (n_scores) */
};

struct mo_design {
  struct mo_bits form; /* canonical */
  int64_t first_seen_us;
  uint32_t n_orientations;
  struct mo_design_orientation *orientations; /* (n_orientations) the first seen first */
  bool truncated; /* more than 1000 rollouts are stored; the first 1000 are reported */
};
void mo_design_free(void *design); /* NULL-safe */

#endif
