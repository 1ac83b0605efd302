/* studies.h: studies in the store: campaigns in which a client makes the children.
 *
 * A study is a campaign of the mode MO_STUDY. A batch of children that the client submits becomes
 * the next generation: its row waits in `studies` until mo_store_campaign_commit commits its
 * scores. At most one batch is pending. The state of the sampler is stored as the checkpoint of its
 * batch.
 *
 * Threads and errors as in store/campaigns.h. */
#ifndef MORPHO_STORE_STUDIES_H
#define MORPHO_STORE_STUDIES_H

#include "store/campaign_records.h"
#include "store/design_notes.h"

/* Finds the newest study with exactly this label that has not ended. MO_ERR_NOT_FOUND. */
int mo_store_study_find(struct mo_store *store, const char *label, int64_t *id);

/* A child of a batch. */
struct mo_study_child {
  struct mo_genotype genotype; /* placed */
  uint32_t place;              /* in the request */
  struct mo_descent descent;   /* parents: numbers of any designs born before the batch; op: below
                                  MO_OPERATORS, or MO_OPERATORS + index of the study's own word */
};
struct mo_study_batch {
  uint32_t number; /* = generation */
  uint32_t n_children, n_measures, n_survivors;
  struct mo_study_child *children; /* (n_children) */
  double *measures;                /* (n_children, n_measures) NaN: not given */
  double *scores;      /* (n_children) the client's own scores, finite; NULL: the service's are
                          used */
  bool selects;        /* true: `survivors` of the population survive; false: the settings select */
  uint32_t *survivors; /* (n_survivors) numbers */
};
void mo_study_batch_free(void *batch); /* NULL-safe */

/* A batch that is being submitted. Its words are in `words`, and may be new to the study. */
struct mo_study_telling {
  struct mo_study_batch batch;
  struct mo_study_words words;
  const uint8_t *sampler; /* (sampler_size ≤ MO_SAMPLER_BYTES_MAX); NULL: none */
  size_t sampler_size;
  struct mo_design_note *notes; /* (n_notes) ascending, as in mo_evaluation_request */
  uint32_t n_notes;
  struct mo_sha256 sha256; /* of the request */
};
/* Faults of a batch. */
enum mo_telling_fault {
  MO_TELLING_NUMBER,   /* MO_ERR_CONFLICT: a different batch is next */
  MO_TELLING_OTHER,    /* MO_ERR_CONFLICT: this number was used by a different request */
  MO_TELLING_ENDED,    /* MO_ERR_CONFLICT: the study has ended */
  MO_TELLING_PARENT,   /* MO_ERR_RANGE: child `place` has a parent that is not born yet */
  MO_TELLING_SURVIVOR, /* MO_ERR_INVALID: survivor `place` is not in the population, or is a
                        * duplicate */
  MO_TELLING_MANY,     /* MO_ERR_RANGE: more survivors and children than fit into the population */
  MO_TELLING_SCORE,    /* MO_ERR_INVALID: child `place` has a body whose own score is `score` */
  MO_TELLING_WORDS,    /* MO_ERR_LIMIT: too many words */
  MO_TELLING_DESIGNS   /* MO_ERR_LIMIT: too many batches, or too many designs in all batches */
};
struct mo_telling_reply {
  enum mo_telling_fault fault;
  uint32_t place, next; /* next: the number of the next batch */
  double score;
  bool is_new; /* false: the same batch was submitted before */
};
/* Stores a batch, with the checkpoint of the sampler, in one transaction. Submitting the same batch
 * again changes nothing. A batch has scores if, and only if, the study has its own score; a body
 * has only one such score in the whole study. MO_ERR_NOT_FOUND: no such study; for other errors see
 * reply->fault. */
int mo_store_study_tell(struct mo_store *store, int64_t id, const struct mo_study_telling *telling,
                        struct mo_telling_reply *reply);

/* Reads the newest submitted batch, pending or not. MO_ERR_NOT_FOUND: no batch was submitted
 * yet. */
int mo_store_study_batch(struct mo_store *store, int64_t id, struct mo_study_batch **batch);
/* Reads the words of the designs: the names of the service's measures that the campaign names, then
 * the words that a study defines. */
int mo_store_study_words(struct mo_store *store, int64_t id, struct mo_study_words *words);

/* queued, paused → succeeded, if no batch is pending. A study that has succeeded stays unchanged
 * (*before). MO_ERR_NOT_FOUND, MO_ERR_CONFLICT. */
int mo_store_study_finish(struct mo_store *store, int64_t id, enum mo_job_state *before);

#endif
