/* studies.h: studies in the store: campaigns whose children somebody else makes.
 *
 * A study is a campaign of the mode MO_STUDY. A batch of children is told, and is then the next
 * generation: its row waits in `studies` until mo_store_campaign_commit has committed its scores.
 * At most one batch is pending. The state of the sampler is the checkpoint of its batch.
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
  struct mo_bits genotype;   /* placed */
  uint32_t place;            /* in the request */
  struct mo_descent descent; /* parents: numbers of any designs born before the batch; op: below
                                MO_OPERATORS, or MO_OPERATORS + place of the study's own word */
};
struct mo_study_batch {
  uint32_t number; /* = generation */
  uint32_t n_children, n_measures, n_survivors;
  struct mo_study_child *children; /* (n_children) */
  double *measures;                /* (n_children, n_measures) NaN: not given */
  bool selects; /* those of the population that live on are `survivors`; else the settings select */
  uint32_t *survivors; /* (n_survivors) numbers */
};
void mo_study_batch_free(void *batch); /* NULL-safe */

/* A batch that is told. Its words are those of `words`, which may be new to the study. */
struct mo_study_telling {
  struct mo_study_batch batch;
  struct mo_study_words words;
  const uint8_t *sampler; /* (sampler_size ≤ MO_SAMPLER_BYTES_MAX); NULL: none */
  size_t sampler_size;
  struct mo_design_note *notes; /* (n_notes) ascending, as mo_evaluation_request */
  uint32_t n_notes;
  struct mo_sha256 sha256; /* of the request */
};
/* What is wrong with a batch. */
enum mo_telling_fault {
  MO_TELLING_NUMBER,   /* MO_ERR_CONFLICT: another batch is next */
  MO_TELLING_OTHER,    /* MO_ERR_CONFLICT: this number was told with another request */
  MO_TELLING_ENDED,    /* MO_ERR_CONFLICT: the study has ended */
  MO_TELLING_PARENT,   /* MO_ERR_RANGE: child `place` has a parent that was not born yet */
  MO_TELLING_SURVIVOR, /* MO_ERR_INVALID: survivor `place` is not in the population, or twice */
  MO_TELLING_MANY,     /* MO_ERR_RANGE: more survivors and children than the population holds */
  MO_TELLING_WORDS,    /* MO_ERR_LIMIT: too many words of its own */
  MO_TELLING_DESIGNS   /* MO_ERR_LIMIT: too many batches, or designs of all of them */
};
struct mo_telling_reply {
  enum mo_telling_fault fault;
  uint32_t place, next; /* next: the number of the next batch */
  bool is_new;          /* else the same batch was told before */
};
/* Stores a batch, with the checkpoint of the sampler, in one transaction. The same batch told again
 * changes nothing. MO_ERR_NOT_FOUND: no such study; else as reply->fault says. */
int mo_store_study_tell(struct mo_store *store, int64_t id, const struct mo_study_telling *telling,
                        struct mo_telling_reply *reply);

/* Reads the newest batch that was told, pending or not. MO_ERR_NOT_FOUND: none was told yet. */
int mo_store_study_batch(struct mo_store *store, int64_t id, struct mo_study_batch **batch);
/* Reads a study's own words; there are none in other campaigns. */
int mo_store_study_words(struct mo_store *store, int64_t id, struct mo_study_words *words);

/* queued, paused → succeeded; nothing is pending. A study that has succeeded stays as it is
 * (*before). MO_ERR_NOT_FOUND, MO_ERR_CONFLICT. */
int mo_store_study_finish(struct mo_store *store, int64_t id, enum mo_job_state *before);

#endif
