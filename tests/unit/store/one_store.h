/* one_store.h: for programs in which each case has its own store with the weights "default". The
 * store is created before the case and removed after it. */
#ifndef MORPHO_TESTS_STORE_ONE_STORE_H
#define MORPHO_TESTS_STORE_ONE_STORE_H

#include <dirent.h>

#include "fixture.h"
#include "store/fields.h"

static struct mo_bits *forms, *genotypes; /* for draw_evaluation */

static inline void with_a_store(void (*run)(void))
{
  CHECK_OK(fixture_start());
  if (check_failures == 0)
    run();
  fixture_end();
}

/* Recreates the store after damage that cannot be repaired. */
static inline void start_over(void)
{
  fixture_end();
  make_check(fixture_start(), "a store");
}

/* Draws n bodies and submits an evaluation of them. */
static inline struct mo_evaluation_request draw_evaluation(uint64_t seed, uint32_t n)
{
  genotypes = make_bodies(seed, n, &forms);
  return fixture_submission(forms, genotypes, n);
}

/* Returns the job's id, or an error. */
static inline int64_t submit_evaluation(const struct mo_evaluation_request *submission)
{
  bool replayed;
  int64_t id = 0;
  const int error = mo_store_submit(store, submission, &id, &replayed);
  return error == MO_OK ? id : error;
}

static inline int change(int64_t id, enum mo_job_change kind)
{
  return mo_store_change_job(store, id, kind, NULL);
}

/* Returns the newest event of a job. */
static inline struct mo_event last_event(int64_t id)
{
  struct mo_event events[200] = {{0}};
  const int64_t n = mo_store_events(store, 0, id, events, 200, NULL, NULL);
  return events[n > 0 ? n - 1 : 0];
}

static inline struct mo_job job_of(int64_t id)
{
  struct mo_job job = {.state = MO_JOB_FAILED};
  CHECK_OK(mo_store_job(store, id, &job));
  return job;
}

static inline enum mo_job_state state_of(int64_t id)
{
  return job_of(id).state;
}

/* Ends the current attempt of a running job, with an error or MO_OK. Returns the job's state, or an
 * error. */
static inline int park(int64_t id, int error)
{
  enum mo_job_state after = MO_JOB_CANCELLED;
  const int parked =
      mo_store_run_park(store, id, error, error != MO_OK ? "out of memory" : NULL, 3, &after);
  return parked != MO_OK ? parked : (int)after;
}

/* Returns the bodies in a job's request. */
static inline struct mo_bits *designs_of(int64_t id, uint32_t *n)
{
  struct mo_bits *found = NULL;
  CHECK_OK(mo_store_job_designs(store, id, &found, n));
  return check_keep(found, free);
}

/* Returns the best of the designs that a job scored. */
static inline struct mo_bits *best_of(int64_t id, uint32_t best, uint32_t *n)
{
  struct mo_bits *found = NULL;
  CHECK_OK(mo_store_population(store, id, best, &found, n));
  return check_keep(found, free);
}

/* Returns whether the settings of two campaigns or training runs are stored as the same text. */
static inline bool same_settings(enum mo_job_kind kind, const void *a, const void *b)
{
  struct mo_text texts[2] = {{0}, {0}};
  mo_settings_write(kind, a, &texts[0]);
  mo_settings_write(kind, b, &texts[1]);
  const bool same =
      texts[0].data != NULL && texts[1].data != NULL && strcmp(texts[0].data, texts[1].data) == 0;
  mo_text_free(&texts[0]);
  mo_text_free(&texts[1]);
  return same;
}

static inline bool same_bits(double a, double b)
{
  return SAME(&a, &b, 1);
}

/* Returns the number of files in a folder, without hidden ones; −1 if the folder does not exist. */
static inline int files_of(const char *kind, int64_t id)
{
  DIR *folder = opendir(path_of("%s/%lld", kind, (long long)id));
  int n = 0;
  if (folder == NULL)
    return -1;
  for (struct dirent *entry; (entry = readdir(folder)) != NULL;)
    n += entry->d_name[0] != '.' || strncmp(entry->d_name, ".tmp-", 5) == 0;
  closedir(folder);
  return n;
}

static inline int put_file(const char *path, const char *text)
{
  FILE *file = fopen(path, "w");
  return file != NULL && fputs(text, file) >= 0 && fclose(file) == 0 ? 0 : -1;
}

#endif
