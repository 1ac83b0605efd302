/* by_hand.h: access to the database from outside the store, and scores saved the way the scheduler
 * saves them. */
#ifndef MORPHO_TESTS_STORE_BY_HAND_H
#define MORPHO_TESTS_STORE_BY_HAND_H

#include <pthread.h>
#include <sqlite3.h>

#include "fixture.h"

static const struct mo_job_query any_job = {.state = -1, .kind = -1};

static inline sqlite3 *open_outside(void)
{
  char path[512];
  sqlite3 *db = NULL;
  snprintf(path, sizeof(path), "%s/morphod.db", fixture.path);
  CHECK_OK(sqlite3_open(path, &db));
  return db;
}

/* Runs SQL directly on the database, without the store, which must be closed. */
static inline int outside(const char *sql)
{
  sqlite3 *db = open_outside();
  const int result = sqlite3_exec(db, sql, NULL, NULL, NULL);
  sqlite3_close(db);
  return result;
}

static inline int64_t outside_integer(const char *sql)
{
  sqlite3 *db = open_outside();
  sqlite3_stmt *statement = NULL;
  int64_t value = -1;
  if (sqlite3_prepare_v2(db, sql, -1, &statement, NULL) == SQLITE_OK &&
      sqlite3_step(statement) == SQLITE_ROW)
    value = sqlite3_column_int64(statement, 0);
  sqlite3_finalize(statement);
  sqlite3_close(db);
  return value;
}

/* Closes the store, runs SQL directly on the database, and returns the error of reopening the
 * store. */
static inline int reopen_after(const char *sql)
{
  close_store();
  CHECK_OK(outside(sql));
  return reopen();
}

struct waiter {
  pthread_mutex_t mutex;
  pthread_cond_t changed;
  int status;
  bool done;
};

static inline void save_done(struct mo_save *save, int status)
{
  struct waiter *waiter = save->context;
  pthread_mutex_lock(&waiter->mutex);
  waiter->status = status;
  waiter->done = true;
  pthread_cond_signal(&waiter->changed);
  pthread_mutex_unlock(&waiter->mutex);
}

static inline int save_and_wait(struct mo_save *save)
{
  struct waiter waiter = {.mutex = PTHREAD_MUTEX_INITIALIZER, .changed = PTHREAD_COND_INITIALIZER};
  save->done = save_done;
  save->context = &waiter;
  int error = mo_store_save(store, save);
  if (error != MO_OK)
    return error;
  pthread_mutex_lock(&waiter.mutex);
  while (!waiter.done)
    pthread_cond_wait(&waiter.changed, &waiter.mutex);
  pthread_mutex_unlock(&waiter.mutex);
  return waiter.status;
}

static inline double made_up_loss(uint32_t n, uint32_t k)
{
  return 0.1 * (n + 1) + 0.001 * k + 1e-17 * n;
}

/* Runs a whole job without a scheduler: starts it, saves made-up losses and finishes it. */
static inline int run_by_hand(int64_t id, double (*loss)(uint32_t n, uint32_t k))
{
  struct mo_work *work = NULL;
  struct mo_job_update updates[2] = {{.job = id, .step = MO_STEP_START},
                                     {.job = id, .step = MO_STEP_SUCCEED}};
  struct mo_saved_design *designs;
  struct mo_save save = {.updates = updates, .n_updates = 2};
  int64_t fingerprint = 0;
  int error = mo_store_fingerprint(store, "by hand", &fingerprint);
  if (error == MO_OK)
    error = mo_store_load_work(store, id, fixture_classes(fingerprint), &work);
  if (error != MO_OK)
    return error;
  updates[0].fingerprint = updates[0].workers = fingerprint;
  save.blocks = make_zeros((size_t)work->n_designs * work->n_environments, sizeof(*save.blocks));
  designs = make_zeros(work->n_designs, sizeof(*designs));
  for (uint32_t n = 0; n < work->n_designs; n++) {
    for (uint32_t k = 0; k < work->n_environments; k++) {
      double value = loss(n, k);
      fixture_loss(&save, work, n, k, fingerprint, value, isinf(value) ? 17 : 0);
    }
    designs[n] =
        (struct mo_saved_design){work->genotype_rows[n], work->controller, work->physics_rows[0],
                                 work->sets[0],          fingerprint,      fingerprint};
  }
  save.designs = designs;
  save.n_designs = work->sets[0] != 0 ? work->n_designs : 0;
  updates[1].done = updates[1].total = (uint64_t)work->n_designs * work->n_environments;
  error = save_and_wait(&save);
  if (error == MO_OK && (!updates[0].applied || !updates[1].applied))
    error = MO_ERR_CONFLICT;
  mo_work_free(work);
  return error;
}

#endif
