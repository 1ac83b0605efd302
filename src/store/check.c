/* check.c: see check.h. */
#include "store/check.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "store/certificate_rows.h"
#include "store/controller_rows.h"
#include "store/folder.h"
#include "store/jobs.h"
#include "store/measures.h"
#include "store/scores.h"

struct walk {
  struct mo_store *store;
  struct mo_connection *reader;
  void (*report)(void *context, const char *finding);
  void *context;
  struct mo_check_counts *counts;
};

/* ---- rows ---- */

static int check_genotype(sqlite3_stmt *row)
{
  struct mo_genotype genotype, form;
  return mo_column_design(row, 1, 2, &genotype, &form);
}

static int check_environment(sqlite3_stmt *row)
{
  struct mo_environment environment;
  const int error = mo_column_environment(row, 1, 2, &environment);
  mo_environments_drop(&environment, 1);
  return error;
}

static int check_physics(sqlite3_stmt *row)
{
  struct mo_sha256 stored, found;
  struct mo_physics physics;
  enum mo_precision precision;
  enum mo_sensor sensor;
  if (mo_column_hash(row, 2, &stored) != MO_OK ||
      mo_column_physics(row, 1, &physics, &precision, &sensor) != MO_OK)
    return MO_ERR_CORRUPT;
  mo_physics_hash(&physics, precision, sensor, &found);
  return mo_sha256_equal(&stored, &found) ? MO_OK : MO_ERR_CORRUPT;
}

static int check_score(sqlite3_stmt *row)
{
  struct mo_condition condition;
  double losses[MO_BLOCK_LANES];
  uint32_t steps[MO_BLOCK_LANES];
  return mo_score_from_row(row, 1, &condition, losses, steps);
}

static int check_measures(sqlite3_stmt *row)
{
  struct mo_condition condition;
  double values[MO_BLOCK_LANES][MO_MEASURES];
  uint32_t n;
  return mo_measures_from_row(row, 1, &condition, values, &n);
}

static int check_member(sqlite3_stmt *row)
{
  const int64_t position = sqlite3_column_int64(row, 1), environment = sqlite3_column_int64(row, 2);
  const uint8_t *bytes = sqlite3_column_blob(row, 3);
  return bytes != NULL && position >= 0 && position < sqlite3_column_bytes(row, 3) / 8 &&
                 memcmp(bytes + 8 * position, &environment, 8) == 0
             ? MO_OK
             : MO_ERR_CORRUPT;
}

static int check_campaign_losses(sqlite3_stmt *row)
{
  int64_t key[2 + MO_ENVIRONMENTS_MAX] = {sqlite3_column_int64(row, 0),
                                          sqlite3_column_int64(row, 1)};
  const int64_t n = sqlite3_column_int64(row, 3);
  const int origins_size = sqlite3_column_bytes(row, 5); /* 0: this host computed them */
  size_t n_key = 2;
  double losses[MO_ENVIRONMENTS_MAX];
  double measures[MO_ENVIRONMENTS_MAX][MO_MEASURES];
  uint32_t steps[MO_ENVIRONMENTS_MAX], n_measures;
  if (n < 1 || n > MO_ENVIRONMENTS_MAX)
    return MO_ERR_CORRUPT;
  if (origins_size == (int)(MO_ENVIRONMENTS_MAX * sizeof(*key))) {
    memcpy(key + 2, sqlite3_column_blob(row, 5), (size_t)origins_size);
    n_key += MO_ENVIRONMENTS_MAX;
  }
  const int error =
      mo_unpack_losses(key, n_key, sqlite3_column_blob(row, 2),
                       (size_t)sqlite3_column_bytes(row, 2), (uint32_t)n, losses, steps);
  return error == MO_OK && sqlite3_column_type(row, 4) != SQLITE_NULL
             ? mo_unpack_measures(key, 2, sqlite3_column_blob(row, 4),
                                  (size_t)sqlite3_column_bytes(row, 4), (uint32_t)n, measures,
                                  &n_measures)
             : error;
}

static int check_mean(sqlite3_stmt *row)
{
  double mean;
  return mo_set_score_from_row(row, 2, sqlite3_column_int64(row, 1), sqlite3_column_int64(row, 0),
                               &mean);
}

/* Each row of this query is a finding. */
static int is_finding(sqlite3_stmt *row)
{
  (void)row;
  return MO_ERR_CORRUPT;
}

static int check_job(struct walk *walk, sqlite3_stmt *row)
{
  struct mo_job job;
  sqlite3_stmt *whole;
  int error = mo_job_row(walk->reader, sqlite3_column_int64(row, 0), -1, &whole);
  if (error == MO_OK)
    error = mo_job_read(whole, &job, NULL);
  return error == MO_ERR_NOT_FOUND ? MO_ERR_CORRUPT : error;
}

/* ---- files ---- */

static int check_file(struct walk *walk, const char *path, uint64_t size,
                      const struct mo_sha256 *sha256)
{
  uint8_t *bytes = NULL;
  int error = mo_file_read_checked(path, (size_t)size, sha256, &bytes);
  free(bytes);
  walk->counts->files++;
  return error;
}

static int check_controller(struct walk *walk, sqlite3_stmt *row)
{
  struct mo_sha256 sha256;
  int error = mo_column_hash(row, 1, &sha256);
  if (error != MO_OK)
    return error;
  char *path = mo_controller_path(walk->store, &sha256);
  error = path == NULL ? MO_ERR_NO_MEMORY
                       : check_file(walk, path, (uint64_t)sqlite3_column_int64(row, 2), &sha256);
  free(path);
  return error;
}

/* Checks a checkpoint; column 3 has its path below the state folder. */
static int check_checkpoint(struct walk *walk, sqlite3_stmt *row)
{
  struct mo_sha256 sha256;
  char name[128], *path = NULL;
  int error = mo_column_hash(row, 1, &sha256);
  mo_column_text(row, 3, name, sizeof(name));
  if (error == MO_OK && asprintf(&path, "%s/%s", walk->store->path, name) < 0)
    return MO_ERR_NO_MEMORY;
  if (error == MO_OK)
    error = check_file(walk, path, (uint64_t)sqlite3_column_int64(row, 2), &sha256);
  free(path);
  return error;
}

/* ---- all parts ---- */

/* Column 0 of each query is the row reported in a finding. */
static const struct part {
  const char *what, *sql;
  int (*check)(sqlite3_stmt *row);                       /* MO_ERR_CORRUPT means a finding */
  int (*check_in)(struct walk *walk, sqlite3_stmt *row); /* instead of `check` */
} parts[] = {
    {"a genotype is damaged, or is not an orientation of its design: genotypes, row",
     "SELECT g.id,g.bits,d.form FROM genotypes g JOIN designs d ON d.id=g.design", check_genotype},
    {"an environment is damaged: environments, row", "SELECT id,data,sha256 FROM environments",
     check_environment},
    {"physics are damaged: physics, row", "SELECT id,encoding,sha256 FROM physics", check_physics},
    {"the environments of a condition are inconsistent: conditions, row",
     "SELECT v.condition,v.position,v.environment,c.environments FROM condition_environments v"
     " JOIN conditions c ON c.id=v.condition",
     check_member},
    {"environments of a condition are missing: conditions, row",
     "SELECT id FROM conditions WHERE length(environments)<>8*(SELECT count(*) FROM"
     " condition_environments WHERE condition=id)",
     is_finding},
    {"losses are damaged: scores, genotype",
     "SELECT x.genotype," MO_SCORE_COLUMNS " FROM scores x JOIN conditions c ON c.id=x.condition",
     check_score},
    {"measures are damaged: measures, genotype",
     "SELECT x.genotype," MO_MEASURE_COLUMNS
     " FROM measures x JOIN conditions c ON c.id=x.condition",
     check_measures},
    {"losses of a generation are damaged: campaign",
     "SELECT l.job,l.place,l.losses,c.n_environments,l.measures,l.origins FROM campaign_losses l"
     " JOIN campaigns c ON c.job=l.job",
     check_campaign_losses},
    {"losses of a trial are damaged: certificate",
     "SELECT job,trial,place,losses,measures FROM certificate_losses", mo_certificate_row_check},
    {"a mean loss is damaged: set_scores, genotype",
     "SELECT genotype,ranking,score,checksum FROM set_scores", check_mean},
    {"a job is damaged: jobs, row", "SELECT id FROM jobs WHERE state<>6", .check_in = check_job},
    {"a controller's file is missing or damaged: controllers, row",
     "SELECT id,sha256,size FROM controllers", .check_in = check_controller},
    {"a checkpoint's file is missing or damaged: job",
     "SELECT c.job,c.sha256,c.size,iif(j.kind=1,printf('trainings/%d/%d.checkpoint',c.job,c.step),"
     "printf('campaigns/%d/%d-%d.checkpoint',c.job,c.generation,c.step)) FROM checkpoints c"
     " JOIN jobs j ON j.id=c.job",
     .check_in = check_checkpoint},
};

static int walk_part(struct walk *walk, const struct part *part)
{
  int error = MO_OK;
  sqlite3_stmt *row = mo_sql_rows(walk->reader, &error, part->sql);
  while (mo_sql_next(walk->reader, row, &error)) {
    error = part->check != NULL ? part->check(row) : part->check_in(walk, row);
    walk->counts->rows++;
    if (error == MO_ERR_CORRUPT) {
      char finding[160];
      snprintf(finding, sizeof(finding), "%s %lld", part->what,
               (long long)sqlite3_column_int64(row, 0));
      walk->report(walk->context, finding);
      walk->counts->findings++;
      error = MO_OK;
    }
  }
  return error;
}

int mo_store_check_contents(struct mo_store *store,
                            void (*report)(void *context, const char *finding), void *context,
                            struct mo_check_counts *counts)
{
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  struct walk walk = {store, reader, report, context, counts};
  int error = MO_OK;
  *counts = (struct mo_check_counts){0};
  for (size_t i = 0; i < sizeof(parts) / sizeof(parts[0]) && error == MO_OK; i++)
    error = walk_part(&walk, &parts[i]);
  return error;
}

/* ---- a sample ---- */

static int take_sample(struct mo_connection *reader, sqlite3_stmt *row, uint64_t seed,
                       struct mo_score_sample *sample)
{
  struct mo_condition condition;
  double losses[MO_BLOCK_LANES];
  uint32_t steps[MO_BLOCK_LANES], k;
  enum mo_sensor sensor;
  int error = mo_score_from_row(row, 0, &condition, losses, steps);
  if (error == MO_OK)
    error = mo_column_genotype(row, 8, &sample->genotype);
  if (error == MO_OK)
    error = mo_column_hash(row, 9, &sample->controller_sha256);
  if (error == MO_OK)
    error = mo_column_physics(row, 10, &sample->physics, &sample->precision, &sensor);
  if (error != MO_OK)
    return error;
  k = (uint32_t)(seed % condition.n);
  sample->loss = losses[k];
  sample->diverged_step = (int32_t)steps[k];
  return mo_environment_get(reader, condition.environments[k], &sample->environment, NULL);
}

int64_t mo_store_sample(struct mo_store *store, const char *fingerprint, uint64_t seed,
                        struct mo_score_sample *samples, size_t n)
{
  static const char last_sql[] = "SELECT coalesce(max(genotype),0) FROM scores";
  static const char sql[] =
      "SELECT " MO_SCORE_COLUMNS ",g.bits,k.sha256,p.encoding FROM scores x"
      " CROSS JOIN conditions c ON c.id=x.condition JOIN genotypes g ON g.id=x.genotype"
      " JOIN controllers k ON k.id=c.controller JOIN physics p ON p.id=c.physics"
      " WHERE x.genotype>=?1 AND c.fingerprint=(SELECT id FROM fingerprints WHERE text=?2)"
      " ORDER BY x.genotype LIMIT 1";
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  int64_t last = 0, found = 0;
  int error = mo_sql_find(reader, &last, last_sql);
  for (size_t i = 0; i < n && error == MO_OK && last > 0; i++) {
    const uint64_t all = (uint64_t)last, first = 1 + (i * all + seed % all) / n;
    sqlite3_stmt *row =
        mo_sql_rows(reader, &error, sql, mo_int((int64_t)first), mo_string(fingerprint));
    if (mo_sql_next(reader, row, &error))
      error = take_sample(reader, row, seed + i, &samples[found++]);
  }
  return error != MO_OK ? error : found;
}
