/* labels.h: edits of jobs by clients after submission, and the usage of jobs. Threads and errors as
 * in store.h. */
#ifndef MORPHO_STORE_LABELS_H
#define MORPHO_STORE_LABELS_H

#include "store/records.h"

struct mo_store;

/* Changes to a job. NULL removes a text. */
struct mo_job_edit {
  bool has_label, has_experiment, has_note, has_archived; /* whether each of these is changed */
  bool archived;
  const char *label, *experiment, *note;
};
/* Changes a job, with its event. MO_ERR_NOT_FOUND. */
int mo_store_edit_job(struct mo_store *store, int64_t id, const struct mo_job_edit *edit);

enum mo_usage_by { MO_USAGE_KIND, MO_USAGE_LABEL, MO_USAGE_EXPERIMENT, MO_USAGE_SUBMITTED_BY };
#define MO_USAGES 4
struct mo_usage_row {
  char name[MO_LABEL_BYTES_MAX + 1]; /* "": jobs without one; by kind: digits */
  uint64_t jobs;
  double worker_s, device_s;
};
/* Sums the usage of jobs, including deleted ones; largest usage first. Returns the number of rows,
 * at most `limit` ≤ MO_PAGE_MAX, or an error. */
int64_t mo_store_usage(struct mo_store *store, enum mo_usage_by by, struct mo_usage_row *rows,
                       size_t limit);

/* Sets a callback that reports the total seconds that a running job has used, and returns false if
 * the job is not running. The writer calls it with each event of a job. used NULL removes it. */
void mo_store_meter(struct mo_store *store,
                    bool (*used)(void *context, int64_t job, double *worker_s, double *device_s),
                    void *context);

#endif
