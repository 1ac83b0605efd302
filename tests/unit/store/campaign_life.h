/* campaign_life.h: the lives of a campaign, an evaluation and a training in the store, in parts
 * that can fail, and all that is stored as a number. */
#ifndef MORPHO_TESTS_STORE_CAMPAIGN_LIFE_H
#define MORPHO_TESTS_STORE_CAMPAIGN_LIFE_H

#include <dirent.h>
#include <sqlite3.h>

#include "campaign_fixture.h"
#include "store/trainings.h"

struct life {
  struct fixture fixture;
  struct mo_store_config config; /* but for its path */
  struct mo_bits *forms, *genotypes;
  struct mo_controller *controller;
  uint8_t *weights;
  size_t size;
  struct made made;
  int64_t id, training;
};

#define LIFE_DESIGNS 300 /* of the evaluation; the first 3 are listed for the campaign */

enum {
  SUBMIT,
  START,
  SAVE_LOSSES,
  CHECKPOINT,
  FIRST_COMMIT,
  SECOND_CHECKPOINT,
  SECOND_COMMIT,
  PARK,
  START_AGAIN,
  THIRD_COMMIT,
  EXTEND,
  FINISH,
  EVALUATE,
  TRAIN,
  TRAIN_START,
  TRAIN_PROGRESS,
  TRAIN_CHECKPOINT,
  TRAIN_CHECKPOINT_AGAIN,
  TRAIN_PARK,
  TRAIN_START_AGAIN,
  TRAIN_FINISH,
  LIFE
};

/* Returns the job that must run before a part; 0: none. */
static inline int64_t runs_before(const struct life *life, int part)
{
  if (part == START_AGAIN || part == TRAIN_START_AGAIN)
    return 0;
  return part > START && part <= FINISH ? life->id : part > TRAIN_START ? life->training : 0;
}

static inline int open_life(struct life *life)
{
  struct mo_store_config config = life->config;
  int error;
  config.path = life->fixture.path;
  mo_store_close(life->fixture.store);
  life->fixture.store = NULL;
  error = mo_store_open(&config, &life->fixture.store, &life->fixture.message);
  life->made.store = life->fixture.store;
  return error;
}

static inline int begin_life(struct life *life, const struct mo_store_config *config)
{
  struct mo_controller_record record;
  int error;
  memset(life, 0, sizeof(*life));
  life->config = *config;
  if (fixture_folder(&life->fixture) != 0)
    return MO_ERR_IO;
  error = open_life(life);
  if (error == MO_OK)
    error = fixture_controller(life->fixture.store, "default", 1, &record);
  if (error == MO_OK)
    error = fixture_bodies(55, LIFE_DESIGNS, &life->forms, &life->genotypes);
  if (error == MO_OK)
    error = mo_controller_create(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT, &life->controller);
  if (error == MO_OK) {
    mo_controller_randomize(life->controller, 7);
    error = mo_controller_encode(life->controller, &life->weights, &life->size);
  }
  if (error == MO_OK)
    error = made_start(&life->made, life->fixture.store, 0, MO_ZERO_SHOT, MADE_POPULATION, 9);
  return error;
}

static inline void end_life(struct life *life)
{
  made_free(&life->made);
  free(life->forms);
  free(life->genotypes);
  free(life->weights);
  mo_controller_free(life->controller);
  fixture_end(&life->fixture);
}

static inline int commit_life(struct life *life)
{
  life->made.commit.checkpoint = (const uint8_t *)"the state after a generation";
  life->made.commit.checkpoint_size = 28;
  life->made.commit.checkpoint_step = 5;
  life->made.commit.collapse_data = "{}";
  life->made.commit.steps = life->made.steps;
  life->made.commit.n_steps = 1;
  life->made.steps[0] =
      (struct mo_campaign_step){.generation = life->made.commit.row.generation, .step = 1};
  return mo_store_campaign_commit(life->fixture.store, life->id, &life->made.commit);
}

/* What a part needs that cannot fail. */
static inline int prepare_life(struct life *life, int part)
{
  return part == SAVE_LOSSES || part == SECOND_CHECKPOINT || part == THIRD_COMMIT
             ? made_next(&life->made)
             : MO_OK;
}

static inline int train_on(struct life *life, int part)
{
  const struct mo_training_submission submission = {
      .record = {.settings = mo_training_defaults(MO_TRAINING_PRETRAIN), .checkpoints_kept = 1}};
  const struct mo_training_validation_row validation = {
      .step = 20, .rollouts = 4, .mean_score = 0.5};
  static const uint8_t state[5000];
  struct mo_store *store = life->fixture.store;
  struct mo_training_step_row rows[20];
  enum mo_job_state after;
  bool replayed;
  for (uint32_t i = 0; i < 20; i++)
    rows[i] =
        (struct mo_training_step_row){.report = {.step = i + 1, .mean_loss = 0.5, .rate = 1e-3}};
  switch (part) {
  case TRAIN: return mo_store_submit_training(store, &submission, &life->training, &replayed);
  case TRAIN_START:
  case TRAIN_START_AGAIN: return mo_store_run_start(store, life->training);
  case TRAIN_PROGRESS:
    return mo_store_training_progress(store, life->training, rows, 20, &validation, "{}");
  case TRAIN_CHECKPOINT:
    return mo_store_training_checkpoint(store, life->training, 10, state, sizeof(state), 1);
  case TRAIN_CHECKPOINT_AGAIN:
    return mo_store_training_checkpoint(store, life->training, 20, state, sizeof(state), 1);
  case TRAIN_PARK:
    return mo_store_run_park(store, life->training, MO_ERR_NO_MEMORY, "out of memory", 3, &after);
  default:
    return mo_store_training_finish(store, life->training, "runner", life->weights, life->size,
                                    life->controller);
  }
}

static inline int live_on(struct life *life, int part)
{
  struct mo_store *store = life->fixture.store;
  struct mo_campaign_submission submission = campaign_submission(MO_ZERO_SHOT, MADE_POPULATION, 1);
  const struct mo_submission evaluation =
      fixture_submission(life->forms, life->genotypes, LIFE_DESIGNS);
  enum mo_job_state state;
  int64_t id;
  bool replayed;
  switch (part) {
  case SUBMIT:
    submission.record.replicates = 2;
    submission.forms = life->forms;
    submission.genotypes = life->genotypes;
    submission.record.n_listed = 3;
    submission.idempotency_key = "once";
    return mo_store_submit_campaign(store, &submission, &life->id, &replayed);
  case START:
  case START_AGAIN: return mo_store_run_start(store, life->id);
  case SAVE_LOSSES:
    return mo_store_campaign_save_losses(store, life->id, 0, life->made.losses, 4, "{}");
  case CHECKPOINT:
    return mo_store_campaign_checkpoint(store, life->id, 0, 1, (const uint8_t *)"state", 5, NULL,
                                        0);
  case SECOND_CHECKPOINT:
    return mo_store_campaign_checkpoint(store, life->id, 1, 1, (const uint8_t *)"state", 5, NULL,
                                        0);
  case FIRST_COMMIT:
  case SECOND_COMMIT:
  case THIRD_COMMIT: return commit_life(life);
  case PARK:
    return mo_store_run_park(store, life->id, MO_ERR_NO_MEMORY, "out of memory", 3, &state);
  case EXTEND: return mo_store_extend_campaign(store, life->id, 3, NULL, &state);
  case EVALUATE: return mo_store_submit(store, &evaluation, &id, &replayed);
  case FINISH:
    return mo_store_campaign_finish(store, life->id, MO_CAMPAIGN_COMPLETED, 4, "walker",
                                    life->weights, life->size, life->controller);
  default: return train_on(life, part);
  }
}

static inline void note_life(struct life *life, int part)
{
  life->made.id = life->id;
  if (part == FIRST_COMMIT || part == SECOND_COMMIT || part == THIRD_COMMIT)
    made_apply(&life->made);
}

/* ---- all that is stored, as a number ---- */

static inline uint64_t mix(uint64_t hash, const void *bytes, size_t n)
{
  for (size_t i = 0; i < n; i++)
    hash = (hash ^ ((const uint8_t *)bytes)[i]) * UINT64_C(0x100000001B3);
  return hash * 31 + n;
}

static inline uint64_t table_digest(sqlite3 *db, const char *name, uint64_t hash)
{
  char sql[200];
  sqlite3_stmt *rows = NULL;
  snprintf(sql, sizeof(sql), "SELECT * FROM \"%s\"", name);
  if (sqlite3_prepare_v2(db, sql, -1, &rows, NULL) != SQLITE_OK)
    return 0;
  while (sqlite3_step(rows) == SQLITE_ROW)
    for (int i = 0; i < sqlite3_column_count(rows); i++) {
      const void *value = sqlite3_column_blob(rows, i);
      hash = mix(hash, value, value != NULL ? (size_t)sqlite3_column_bytes(rows, i) : 0);
    }
  sqlite3_finalize(rows);
  return hash;
}

/* The names of the files of a job. */
static inline uint64_t files_digest(const struct life *life, const char *kind, int64_t id,
                                    uint64_t hash)
{
  char path[512];
  uint64_t sum = 0; /* in whatever order they come */
  DIR *folder;
  snprintf(path, sizeof(path), "%s/%s/%lld", life->fixture.path, kind, (long long)id);
  folder = opendir(path);
  for (struct dirent *entry; folder != NULL && (entry = readdir(folder)) != NULL;)
    if (strncmp(entry->d_name, ".", 1) != 0)
      sum += mix(1, entry->d_name, strlen(entry->d_name));
  if (folder != NULL)
    closedir(folder);
  return mix(hash, &sum, sizeof(sum));
}

/* Every row of every table but `meta`, which counts openings, and the names of checkpoints. */
static inline uint64_t digest(const struct life *life)
{
  char path[512];
  uint64_t hash = 7;
  sqlite3 *db = NULL;
  sqlite3_stmt *tables = NULL;
  snprintf(path, sizeof(path), "%s/morphod.db", life->fixture.path);
  if (sqlite3_open_v2(path, &db, SQLITE_OPEN_READONLY, NULL) == SQLITE_OK &&
      sqlite3_prepare_v2(db,
                         "SELECT name FROM sqlite_schema WHERE type='table' AND name NOT IN "
                         "('meta','sqlite_sequence')"
                         " AND name NOT LIKE 'sqlite_stat%' ORDER BY name",
                         -1, &tables, NULL) == SQLITE_OK)
    while (sqlite3_step(tables) == SQLITE_ROW)
      hash = table_digest(db, (const char *)sqlite3_column_text(tables, 0), hash);
  sqlite3_finalize(tables);
  sqlite3_close(db);
  hash = files_digest(life, "campaigns", life->id, hash);
  return files_digest(life, "trainings", life->training, hash);
}

#endif
