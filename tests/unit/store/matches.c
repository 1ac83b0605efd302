/* matches.c: is the store what a model says: everything that was acknowledged, bit for bit, and
 * nothing else? */
#include <dirent.h>
#include <math.h>
#include <sqlite3.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "life.h"

bool life_differs(char text[300], const char *format, ...)
{
  va_list arguments;
  va_start(arguments, format);
  vsnprintf(text, 300, format, arguments);
  va_end(arguments);
  return false;
}

/* ---- controllers ---- */

static bool content_matches(const struct life *life, uint64_t seed, char text[300])
{
  uint8_t *expected = NULL, *found = NULL;
  struct mo_sha256 hash;
  size_t size = 0;
  const size_t expected_size = life_content(seed, &expected);
  mo_sha256_of(expected, expected_size, &hash);
  int error = mo_store_controller_bytes(life->store, &hash, &found, &size);
  bool same = error == MO_OK && size == expected_size && memcmp(found, expected, size) == 0;
  free(expected);
  if (error == MO_OK)
    free(found);
  return same || life_differs(text, "a controller's bytes: error %d, %zu of %zu bytes", error, size,
                              expected_size);
}

static bool name_matches(const struct life *life, const struct model *model, const char *name,
                         int content, int64_t version, char text[300])
{
  struct mo_controller_record record;
  struct mo_sha256 hash;
  uint8_t *bytes = NULL;
  const int error = mo_store_controller(life->store, name, &record);
  if (content < 0)
    return error == MO_ERR_NOT_FOUND ||
           life_differs(text, "the name %s is there (%d)", name, error);
  if (error != MO_OK)
    return life_differs(text, "the name %s: error %d", name, error);
  mo_sha256_of(bytes, life_content(model->contents[content], &bytes), &hash);
  mo_sha256_of(bytes, record.size, &hash);
  free(bytes);
  return (mo_sha256_equal(&hash, &record.sha256) && record.version == version) ||
         life_differs(text, "the name %s has version %lld, not %lld, or other bytes", name,
                      (long long)record.version, (long long)version);
}

static bool controllers_match(const struct life *life, const struct model *model, char text[300])
{
  bool same = true;
  char name[32];
  for (int i = 0; i < NAMES && same; i++) {
    char own[16];
    life_name(i, own);
    same = name_matches(life, model, own, model->names[i].content, model->names[i].version, text);
  }
  for (int i = 0; i < model->n_trainings && same; i++) {
    snprintf(name, sizeof(name), "training-%lld", model->trainings[i].id);
    same = name_matches(life, model, name, model->trainings[i].result, 1, text);
  }
  for (int i = 0; i < model->n_campaigns && same; i++) {
    snprintf(name, sizeof(name), "campaign-%lld", model->campaigns[i].id);
    same = name_matches(life, model, name, model->campaigns[i].result, 1, text);
  }
  for (int i = 0; i < model->n_contents && same; i++)
    same = content_matches(life, model->contents[i], text);
  return same;
}

/* ---- evaluations ---- */

static bool same_double(double a, double b)
{
  return memcmp(&a, &b, sizeof(a)) == 0;
}

static bool results_match(const struct life *life, const struct evaluation_model *evaluation,
                          int index, char text[300])
{
  struct mo_evaluation_results *results = NULL;
  const int error = mo_store_results(life->store, evaluation->id, &results);
  bool same = error == MO_OK && results->n_designs == evaluation->n_designs &&
              results->n_environments == MO_PAPER_TEST_COUNT;
  for (uint32_t n = 0; same && n < evaluation->n_designs; n++) {
    const size_t body = (size_t)index * DESIGNS_MAX + n;
    same = memcmp(&results->genotypes[n], &life->genotypes[body], sizeof(struct mo_bits)) == 0 &&
           memcmp(&results->forms[n], &life->forms[body], sizeof(struct mo_bits)) == 0;
    for (uint32_t k = 0; same && k < MO_PAPER_TEST_COUNT; k++) {
      const size_t cell = (size_t)n * MO_PAPER_TEST_COUNT + k;
      int32_t step;
      const double loss = life_loss(evaluation->seed, n, k, &step);
      same = n < evaluation->saved
                 ? same_double(results->losses[cell], loss) && results->diverged_steps[cell] == step
                 : isnan(results->losses[cell]);
    }
    if (!same)
      (void)life_differs(text,
                         "job %lld of %u designs, %u saved: design %u is not what it should be",
                         evaluation->id, evaluation->n_designs, evaluation->saved, n);
  }
  if (error != MO_OK)
    return life_differs(text, "results of job %lld: error %d", evaluation->id, error);
  mo_evaluation_results_free(results);
  return same;
}

static bool trajectories_match(const struct life *life, const struct evaluation_model *evaluation,
                               char text[300])
{
  for (uint32_t n = 0; n < evaluation->n_designs; n++) {
    struct mo_trajectory *trajectory = NULL;
    const int error = mo_store_trajectory(life->store, evaluation->id, n, 0, &trajectory);
    bool same = error == (n < evaluation->saved ? MO_OK : MO_ERR_NOT_FOUND);
    if (same && error == MO_OK) {
      same = trajectory->n_frames == 3 && trajectory->recording.com_m != NULL;
      for (int i = 0; same && i < 9; i++)
        same = trajectory->recording.com_m[i] == n + i * 0.125;
    }
    if (error == MO_OK)
      mo_trajectory_free(trajectory);
    if (!same)
      return life_differs(text, "trajectory %u of job %lld: error %d", n, evaluation->id, error);
  }
  return true;
}

static bool evaluation_matches(const struct life *life, const struct evaluation_model *evaluation,
                               int index, char text[300])
{
  struct mo_sha256 body;
  struct mo_job job;
  char key[32];
  int64_t id = 0;
  int error = mo_store_job(life->store, evaluation->id, &job);
  if (error != MO_OK || job.kind != MO_JOB_EVALUATION)
    return life_differs(text, "job %lld: error %d", evaluation->id, error);
  if (job.state != evaluation->state ||
      job.rollouts_done != (uint64_t)evaluation->saved * MO_PAPER_TEST_COUNT)
    return life_differs(text, "job %lld: state %d, %llu rollouts, not state %d, %u designs",
                        (long long)job.id, job.state, (unsigned long long)job.rollouts_done,
                        evaluation->state, evaluation->saved);
  life_key('e', index, key);
  mo_sha256_of(&evaluation->seed, sizeof(evaluation->seed), &body);
  error = mo_store_replay(life->store, key, &body, &id);
  if (error != MO_OK || id != evaluation->id)
    return life_differs(text, "the key of job %lld: error %d", evaluation->id, error);
  return results_match(life, evaluation, index, text) && trajectories_match(life, evaluation, text);
}

/* ---- trainings ---- */

static bool steps_match(const struct life *life, const struct training_model *training,
                        char text[300])
{
  static struct mo_training_step_row rows[MO_PAGE_MAX];
  uint32_t at = 0;
  int64_t n;
  do {
    n = mo_store_training_steps(life->store, training->id, at, 1, rows, MO_PAGE_MAX);
    for (int64_t i = 0; i < n; i++) {
      const struct mo_training_step_row row = life_step(training->seed, ++at);
      if (rows[i].report.step != at ||
          !same_double(rows[i].report.mean_loss, row.report.mean_loss) ||
          !same_double(rows[i].report.gradient_norm, row.report.gradient_norm) ||
          rows[i].report.zeroed != row.report.zeroed)
        return life_differs(text, "step %u of training %lld", at, training->id);
    }
  } while (n == MO_PAGE_MAX);
  return (n >= 0 && at == training->step) ||
         life_differs(text, "training %lld has %u steps, not %u", training->id, at, training->step);
}

uint32_t life_files(const struct life *life, const char *folder, int64_t id, uint64_t *sum)
{
  uint32_t files = 0;
  struct dirent *entry;
  char path[512];
  snprintf(path, sizeof(path), "%s/%s/%lld", disk_folder(life->disk), folder, (long long)id);
  DIR *stream = opendir(path);
  while (stream != NULL &&
         (entry = readdir(stream)) != NULL) { /* NOLINT(concurrency-mt-unsafe): this thread's own */
    struct mo_sha256 name;
    if (strcmp(entry->d_name, ".") == 0 || strcmp(entry->d_name, "..") == 0)
      continue;
    files++;
    mo_sha256_of(entry->d_name, strlen(entry->d_name), &name);
    if (sum != NULL)
      *sum += name.bytes[0] + ((uint64_t)name.bytes[1] << 8) + ((uint64_t)name.bytes[2] << 16);
  }
  if (stream != NULL)
    closedir(stream);
  return files;
}

/* Every row has its file, with the right bytes, and every file its row. */
static bool checkpoints_match(const struct life *life, const struct training_model *training,
                              char text[300])
{
  struct mo_checkpoint_row rows[KEPT_MAX + 1];
  const int64_t n = mo_store_checkpoints(life->store, training->id, rows, KEPT_MAX + 1);
  const uint32_t files = life_files(life, "trainings", training->id, NULL);
  if (n != training->n_checkpoints)
    return life_differs(text, "training %lld has %lld checkpoints, not %u", training->id,
                        (long long)n, training->n_checkpoints);
  for (int64_t i = 0; i < n; i++) {
    const uint32_t step = training->checkpoints[n - 1 - i];
    uint8_t *expected = NULL, *found = NULL;
    size_t size = 0;
    const size_t expected_size = life_checkpoint(training->seed, step, &expected);
    const int error =
        mo_store_training_checkpoint_bytes(life->store, training->id, step, &found, &size);
    const bool same = error == MO_OK && rows[i].step == step && size == expected_size &&
                      memcmp(found, expected, size) == 0;
    free(expected);
    if (error == MO_OK)
      free(found);
    if (!same)
      return life_differs(text, "checkpoint %u of training %lld: error %d", step, training->id,
                          error);
  }
  return files == training->n_checkpoints ||
         life_differs(text, "training %lld has %u files for %u checkpoints", training->id, files,
                      training->n_checkpoints);
}

static bool training_matches(const struct life *life, const struct training_model *training,
                             char text[300])
{
  static struct mo_training_status status;
  const int error = mo_store_training(life->store, training->id, &status);
  const uint32_t newest =
      training->n_checkpoints > 0 ? training->checkpoints[training->n_checkpoints - 1] : 0;
  if (error != MO_OK)
    return life_differs(text, "training %lld: error %d", training->id, error);
  if (status.job.state != training->state || status.job.attempts != training->attempts ||
      status.step != training->step || status.has_validation != (training->n_validations > 0) ||
      status.validation.step != training->last_validation || status.checkpoint_step != newest ||
      status.has_result != (training->result >= 0) || status.record.settings.seed != training->seed)
    return life_differs(
        text,
        "training %lld: state %d, attempts %u, step %u, validation %u, checkpoint %u, result %d",
        training->id, status.job.state, status.job.attempts, status.step, status.validation.step,
        status.checkpoint_step, status.has_result);
  return steps_match(life, training, text) && checkpoints_match(life, training, text);
}

/* ---- the whole ---- */

static bool counts_match(sqlite3 *db, const struct model *model, char text[300])
{
  int64_t designs = 0, born = 0, saved = 0, scored = 0, steps = 0, validations = 0, checkpoints = 0,
          names = 0;
  int64_t generations = 0, known = 0, losses = 0, learned = 0, states = 0;
  for (int i = 0; i < model->n_evaluations; i++) {
    designs += model->evaluations[i].n_designs;
    saved += model->evaluations[i].saved;
  }
  for (int i = 0; i < model->n_trainings; i++) {
    steps += model->trainings[i].step;
    validations += model->trainings[i].n_validations;
    checkpoints += model->trainings[i].n_checkpoints;
    names += model->trainings[i].result >= 0;
  }
  for (int i = 0; i < model->n_campaigns; i++) {
    const struct campaign_model *campaign = &model->campaigns[i];
    generations += campaign->generation + 1;
    known += campaign->generation >= 0 ? MEMBERS * (campaign->generation + 1) : LISTED;
    scored += campaign->learns ? 0 : MEMBERS * (campaign->generation + 1);
    losses += campaign->scored;
    learned += campaign->learns ? LEARNING * (campaign->generation + 1) + campaign->inside : 0;
    states += (campaign->learns && campaign->generation >= 0) + (campaign->inside > 0);
    names += campaign->result >= 0;
  }
  born = MEMBERS * generations;
  scored += saved;
  for (int i = 0; i < NAMES; i++)
    names += model->names[i].content >= 0;
  const struct {
    const char *table;
    int64_t n;
  } counts[] = {{"jobs", model->jobs},
                {"runs", model->n_trainings + model->n_campaigns},
                {"evaluations", model->n_evaluations},
                {"job_designs", designs + (int64_t)LISTED * model->n_campaigns},
                {"job_environments",
                 (int64_t)(model->n_evaluations + model->n_campaigns) * MO_PAPER_TEST_COUNT},
                {"designs", designs + known},
                {"genotypes", designs + known},
                {"scores", scored},
                {"set_scores", scored},
                {"trajectories", saved},
                {"trainings", model->n_trainings},
                {"training_steps", steps},
                {"training_validations", validations},
                {"campaigns", model->n_campaigns},
                {"campaign_designs", born},
                {"campaign_generations", generations},
                {"campaign_populations", generations},
                {"campaign_losses", losses},
                {"campaign_steps", learned},
                {"checkpoints", checkpoints + states},
                {"controllers", model->n_contents},
                {"controller_names", names},
                {"idempotency_keys", model->jobs},
                {"events", model->events}};
  for (size_t i = 0; i < sizeof(counts) / sizeof(counts[0]); i++) {
    sqlite3_stmt *statement = NULL;
    int64_t n = -1;
    char sql[80];
    snprintf(sql, sizeof(sql), "SELECT count(*) FROM %s", counts[i].table);
    if (sqlite3_prepare_v2(db, sql, -1, &statement, NULL) == SQLITE_OK &&
        sqlite3_step(statement) == SQLITE_ROW)
      n = sqlite3_column_int64(statement, 0);
    sqlite3_finalize(statement);
    if (n != counts[i].n)
      return life_differs(text, "%lld %s, not %lld", (long long)n, counts[i].table,
                          (long long)counts[i].n);
  }
  return true;
}

/* The database at a path, by SQLite alone. */
static sqlite3 *open_database(const char *path)
{
  sqlite3 *db = NULL;
  if (sqlite3_open_v2(path, &db, SQLITE_OPEN_READONLY, NULL) != SQLITE_OK) {
    sqlite3_close(db);
    return NULL;
  }
  return db;
}

bool life_matches(const struct life *life, const struct model *model, char text[300])
{
  char path[512];
  snprintf(path, sizeof(path), "%s/morphod.db", disk_folder(life->disk));
  sqlite3 *db = open_database(path);
  bool same = db != NULL ? counts_match(db, model, text)
                         : life_differs(text, "the database cannot be opened");
  sqlite3_close(db);
  for (int i = 0; i < model->n_evaluations && same; i++)
    same = evaluation_matches(life, &model->evaluations[i], i, text);
  for (int i = 0; i < model->n_trainings && same; i++)
    same = training_matches(life, &model->trainings[i], text);
  for (int i = 0; i < model->n_campaigns && same; i++)
    same = campaign_matches(life, &model->campaigns[i], i, text);
  return same && controllers_match(life, model, text);
}
