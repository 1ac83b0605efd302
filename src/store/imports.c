/* imports.c: the rows of an import, except those of recordings. They are the same as those of
 * mo_store_submit_campaign and mo_store_campaign_commit, except that times and origins come from
 * the source. import_pieces.c calls this in transactions of the writer. */
#include "store/imports.h"

#include <stdlib.h>
#include <string.h>

#include "store/campaign_rows.h"
#include "store/contents.h"
#include "store/controller_rows.h"
#include "store/import_state.h"
#include "store/measures.h"
#include "store/recordings.h"
#include "store/rows.h"
#include "store/scores.h"

/* ---- files of weights ---- */

void mo_store_import_begin(struct mo_store *store)
{
  pthread_rwlock_rdlock(&store->controllers_lock);
}

void mo_store_import_end(struct mo_store *store)
{
  pthread_rwlock_unlock(&store->controllers_lock);
}

int mo_store_import_file(struct mo_store *store, const struct mo_sha256 *sha256,
                         const uint8_t *bytes, size_t size)
{
  return mo_controller_write_file(store, sha256, bytes, size);
}

/* ---- what already exists ---- */

int mo_store_import_own(struct mo_store *store, const struct mo_import_source *source, int64_t *id)
{
  static const char sql[] = "SELECT id FROM jobs WHERE id=?1 AND kind=?2 AND state<6"
                            " AND NOT EXISTS(SELECT 1 FROM imports WHERE job=?1)";
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  return source->store == mo_store_id(store)
             ? mo_sql_find(reader, id, sql, mo_int(source->job), mo_int(MO_JOB_CAMPAIGN))
             : MO_ERR_NOT_FOUND;
}

int mo_store_import_find(struct mo_store *store, const struct mo_import_source *source, int64_t *id)
{
  static const char sql[] =
      "SELECT i.job FROM imports i JOIN jobs j ON j.id=i.job WHERE i.digest=?1 AND j.state<6";
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  return mo_sql_find(reader, id, sql, mo_hash(&source->digest));
}

int mo_import_find(struct mo_import *import, const struct mo_import_source *source, int64_t own,
                   int64_t *id)
{
  static const char own_sql[] = "SELECT id FROM jobs WHERE id=?1 AND state<6";
  static const char sql[] = "SELECT job FROM imports WHERE digest=?1"; /* also a hidden one */
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(import->store);
  const int error = own > 0 ? mo_sql_find(reader, id, own_sql, mo_int(own)) : MO_ERR_NOT_FOUND;
  return error == MO_ERR_NOT_FOUND ? mo_sql_find(reader, id, sql, mo_hash(&source->digest)) : error;
}

/* ---- rows ---- */

static int controller_row(struct mo_connection *writer, const struct mo_sha256 *sha256,
                          int64_t *row)
{
  static const char sql[] = "SELECT id FROM controllers WHERE sha256=?1";
  return mo_sql_find(writer, row, sql, mo_hash(sha256));
}

/* Finds the local group for a group of the source. Returns 0 if there is none yet. */
static int64_t *group_of(struct mo_import *import, int64_t source)
{
  uint32_t i = 0;
  while (i < import->n_groups && import->groups[i][0] != source)
    i++;
  if (i == import->n_groups && i < MO_REPLICATES_MAX) {
    import->groups[import->n_groups][0] = source;
    import->groups[import->n_groups++][1] = 0;
  }
  return i < MO_REPLICATES_MAX ? &import->groups[i][1] : NULL;
}

static int insert_job(struct mo_import *import, const struct mo_imported_campaign *campaign)
{
  static const char sql[] =
      "INSERT INTO jobs(kind,state,priority,version,epoch,attempts,label,created_us,started_us,"
      "finished_us,error,weight,back_end,experiment,note)"
      " VALUES(?1,6,0,1,?2,0,?3,?4,?5,?6,0,?7,?8,nullif(?9,''),nullif(?10,''))";
  const int error = mo_sql_insert(
      &import->store->writer, &import->id, sql, mo_int(MO_JOB_CAMPAIGN),
      mo_int(MO_IMPORT_EPOCH(campaign->state)),
      campaign->has_label ? mo_string(campaign->label) : mo_null(), mo_int(campaign->created_us),
      mo_int(campaign->started_us), mo_int(campaign->finished_us), mo_real(campaign->weight),
      mo_int(campaign->back_end), mo_string(campaign->experiment), mo_string(campaign->note));
  return error == MO_OK ? mo_import_hide(import->store, import->id) : error;
}

static int insert_run(struct mo_import *import, const struct mo_imported_campaign *campaign)
{
  static const char sql[] = "UPDATE runs SET result=?2 WHERE job=?1";
  struct mo_connection *writer = &import->store->writer;
  const struct mo_campaign_record *record = &campaign->record;
  int64_t result = 0;
  int error = MO_OK;
  import->controller = 0;
  if (campaign->has_controller)
    error = controller_row(writer, &campaign->controller_sha256, &import->controller);
  if (error == MO_OK && campaign->has_result)
    error = controller_row(writer, &campaign->result_sha256, &result);
  if (error == MO_OK)
    error = mo_run_insert(writer, import->id, MO_JOB_CAMPAIGN, record, record->name,
                          import->controller, campaign->controller_name);
  return error == MO_OK && result != 0 ? mo_sql_do(writer, sql, mo_int(import->id), mo_int(result))
                                       : error;
}

/* Finds the set with the environments of the campaign. Returns 0 if there is none. */
static int find_set(struct mo_import *import, const struct mo_campaign_record *record,
                    int64_t group)
{
  static const char sql[] = "SELECT count(*) FROM environment_set_members m JOIN job_environments e"
                            " ON e.position=m.position AND e.environment=m.environment"
                            " WHERE m.environment_set=?1 AND e.job=?2";
  struct mo_connection *writer = &import->store->writer;
  int64_t n = 0, same = 0;
  import->set = 0;
  int error = record->environment_set[0] != '\0'
                  ? mo_environment_set_find(writer, record->environment_set, &import->set, &n)
                  : MO_ERR_NOT_FOUND;
  if (error == MO_OK)
    error = mo_sql_find(writer, &same, sql, mo_int(import->set), mo_int(group));
  if (error != MO_OK || same != n || n != record->n_environments)
    import->set = 0;
  return error == MO_ERR_NOT_FOUND ? MO_OK : error;
}

int mo_source_insert(struct mo_import *import, int64_t id, const struct mo_import_source *source)
{
  static const char sql[] =
      "INSERT INTO imports(job,store,source,digest,imported_us) VALUES(?1,?2,?3,?4,?5)";
  return mo_sql_do(&import->store->writer, sql, mo_int(id), mo_int((int64_t)source->store),
                   mo_int(source->job), mo_hash(&source->digest), mo_int(import->now_us));
}

static int insert_campaign(struct mo_import *import, const struct mo_imported_campaign *campaign,
                           int64_t group)
{
  static const char sql[] =
      "INSERT INTO campaigns(job,generations,preset,physics,environment_set,n_environments,"
      "n_listed,initial_campaign,replicates_of,replicate,replicates,generation,n_designs,"
      "best_score,diversity_max,ended,scored_generation,scored)"
      " VALUES(?1,?2,?3,?4,NULL,?5,?6,0,?7,?8,?9,?10,?11,NULL,?12,?13,-1,0)";
  const struct mo_campaign_record *record = &campaign->record;
  return mo_sql_do(&import->store->writer, sql, mo_int(import->id),
                   mo_int(record->settings.generations), mo_string(record->preset),
                   mo_int(import->physics), mo_int(record->n_environments),
                   mo_int(record->n_listed), mo_int(group), mo_int(record->replicate),
                   mo_int(record->replicates), mo_int(campaign->generation),
                   mo_int((int64_t)campaign->n_designs), mo_real(campaign->diversity_max),
                   mo_int(campaign->end));
}

/* Inserts the environments of the first campaign of a group; the other campaigns have the same
 * environments. */
static int insert_environments(struct mo_import *import,
                               const struct mo_imported_campaign *campaign, int64_t group)
{
  static const char sql[] = "UPDATE campaigns SET environment_set=?2 WHERE job=?1";
  struct mo_connection *writer = &import->store->writer;
  const struct mo_campaign_record *record = &campaign->record;
  struct mo_environment known[MO_ENVIRONMENTS_MAX] = {{.grid = NULL}};
  bool differ = false;
  int error = group == import->id ? mo_environments_insert(writer, group, 0, campaign->environments,
                                                           record->n_environments)
                                  : MO_OK;
  if (error == MO_OK)
    error =
        mo_environments_read(writer, group, record->n_environments, known, import->environments);
  for (uint32_t k = 0; k < record->n_environments && error == MO_OK && !differ; k++) {
    struct mo_sha256 hashes[2];
    mo_environment_hash(&known[k], &hashes[0]);
    mo_environment_hash(&campaign->environments[k], &hashes[1]);
    differ = !mo_sha256_equal(&hashes[0], &hashes[1]);
  }
  mo_environments_drop(known, MO_ENVIRONMENTS_MAX);
  if (error == MO_ERR_CORRUPT || differ)
    return MO_ERR_INVALID; /* replicates with different environments */
  import->n_environments = record->n_environments;
  if (error == MO_OK)
    error = find_set(import, record, group);
  return error == MO_OK && import->set != 0
             ? mo_sql_do(writer, sql, mo_int(import->id), mo_int(import->set))
             : error;
}

int mo_enter_campaign(struct mo_import *import, const struct mo_imported_campaign *campaign)
{
  const struct mo_campaign_settings *settings = &campaign->record.settings;
  int64_t *group = group_of(import, campaign->record.group);
  int error = group == NULL ? MO_ERR_LIMIT : insert_job(import, campaign);
  if (error == MO_OK && *group == 0)
    *group = import->id;
  if (error == MO_OK)
    error = insert_run(import, campaign);
  if (error == MO_OK)
    error = mo_physics_row(&import->store->writer, &settings->physics, MO_FLOAT32, settings->sensor,
                           &import->physics);
  if (error == MO_OK)
    error = insert_campaign(import, campaign, *group);
  if (error == MO_OK)
    error = insert_environments(import, campaign, *group);
  return error == MO_OK ? mo_source_insert(import, import->id, &campaign->source) : error;
}

int mo_enter_design(struct mo_import *import, const struct mo_campaign_design *design)
{
  int64_t genotype = 0;
  const int error = mo_genotype_row(&import->store->writer, design->form.words,
                                    design->genotype.words, import->now_us, &genotype);
  return error == MO_OK ? mo_campaign_design_row(&import->store->writer, import->id, genotype,
                                                 design, design->measures, design->n_measures)
                        : error;
}

int mo_enter_generation(struct mo_import *import, const struct mo_campaign_generation *row,
                        const struct mo_descent *births, const struct mo_campaign_member *members,
                        uint32_t n_members)
{
  static const char sql[] =
      "INSERT INTO campaign_populations(job,generation,births,population) VALUES(?1,?2,?3,?4)";
  static const char best_sql[] =
      "UPDATE campaigns SET best_score=?2 WHERE job=?1 AND generation=?3";
  struct mo_connection *writer = &import->store->writer;
  struct mo_birth_row *born = calloc(row->n_children + 1, sizeof(*born));
  struct mo_member_row *population = calloc((size_t)n_members + 1, sizeof(*population));
  int error = born != NULL && population != NULL ? MO_OK : MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; error == MO_OK && i < row->n_children; i++)
    born[i] = (struct mo_birth_row){births[i].op, {births[i].parents[0], births[i].parents[1]}};
  for (uint32_t i = 0; error == MO_OK && i < n_members; i++)
    population[i] = (struct mo_member_row){members[i].number, members[i].score};
  if (error == MO_OK)
    error = mo_sql_do(writer, sql, mo_int(import->id), mo_int(row->generation),
                      mo_blob(born, row->n_children * sizeof(*born)),
                      mo_blob(population, n_members * sizeof(*population)));
  if (error == MO_OK)
    error = mo_row_write(writer, MO_CAMPAIGN_GENERATIONS, import->id, row);
  if (error == MO_OK && n_members > 0)
    error = mo_sql_do(writer, best_sql, mo_int(import->id), mo_real(members[0].score),
                      mo_int(row->generation));
  free(born);
  free(population);
  return error;
}

int mo_enter_step(struct mo_import *import, const struct mo_campaign_step *step)
{
  return mo_row_write(&import->store->writer, MO_CAMPAIGN_STEPS, import->id, step);
}

/* ---- scores ---- */

/* Finds the rows of origin, class and condition. */
static int find_condition(struct mo_import *import, const struct mo_campaign_score *score,
                          int64_t *origin, struct mo_condition *condition)
{
  struct mo_connection *writer = &import->store->writer;
  *condition = (struct mo_condition){
      .controller = import->controller, .physics = import->physics, .n = score->n};
  for (uint32_t k = 0; k < score->n; k++)
    condition->environments[k] = import->environments[score->environments[k]];
  int error = mo_text_row(writer, MO_ORIGINS, score->origin, origin);
  if (error == MO_OK)
    error = mo_text_row(writer, MO_FINGERPRINTS, score->fingerprint, &condition->fingerprint);
  return error == MO_OK ? mo_condition_row_after(writer, condition, &import->last) : error;
}

/* Stores measures that are not stored yet. MO_ERR_CONFLICT: different ones are stored. */
static int insert_measures(struct mo_import *import, const struct mo_campaign_score *score,
                           const struct mo_condition *condition, int64_t genotype, int64_t origin)
{
  const struct mo_saved_design design = mo_design_under(condition, genotype, 0);
  uint64_t known = 0;
  const double(*measures)[MO_MEASURES] = (const double(*)[MO_MEASURES])score->measures;
  const int error = mo_measures_compare(&import->store->writer, &design, condition->environments,
                                        condition->n, measures, &known);
  return error == MO_OK && known != UINT64_MAX >> (64 - condition->n)
             ? mo_measures_insert_row(import->store, condition, genotype, origin, measures,
                                      score->computed_us)
             : error;
}

int mo_enter_score(struct mo_import *import, const struct mo_campaign_score *score)
{
  static const char sql[] = "SELECT genotype FROM campaign_designs WHERE job=?1 AND number=?2";
  struct mo_connection *writer = &import->store->writer;
  struct mo_score stored[MO_BLOCK_LANES];
  struct mo_condition condition;
  int64_t genotype = 0, origin = 0;
  double sum = 0;
  bool is_new = false;
  import->conflict = score->number;
  int error = mo_sql_find(writer, &genotype, sql, mo_int(import->id), mo_int(score->number));
  if (error == MO_OK)
    error = find_condition(import, score, &origin, &condition);
  if (error == MO_OK)
    error = mo_losses_compare(writer, &condition, genotype, score->losses, score->diverged_steps,
                              stored);
  if (error == MO_OK)
    error = mo_losses_insert(import->store, &condition, genotype, origin, score->losses,
                             score->diverged_steps, score->computed_us, &is_new);
  if (error == MO_OK && score->measures != NULL)
    error = insert_measures(import, score, &condition, genotype, origin);
  import->n_losses += error == MO_OK && is_new ? score->n : 0;
  if (error != MO_OK || !is_new || import->set == 0)
    return error;
  bool is_whole = score->n == import->n_environments;
  for (uint32_t k = 0; k < score->n; k++) {
    sum += score->losses[k];
    is_whole = is_whole && score->environments[k] == k;
  }
  const struct mo_saved_design design = mo_design_under(&condition, genotype, import->set);
  return is_whole ? mo_set_score_insert_mean(writer, &design, sum / score->n)
                  : mo_set_score_insert(writer, &design);
}

/* ---- export ---- */

int mo_store_campaign_members(struct mo_store *store, int64_t id, int64_t generation,
                              struct mo_campaign_member **ret, uint32_t *n)
{
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  struct mo_campaign_members found = {.n = 0};
  struct mo_campaign_member *members = NULL;
  int error = mo_campaign_members_get(reader, id, generation, &found);
  if (error == MO_OK && (members = malloc((found.n + 1) * sizeof(*members))) == NULL)
    error = MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; error == MO_OK && i < found.n; i++)
    members[i] = (struct mo_campaign_member){found.population[i].number, found.population[i].score};
  *n = found.n;
  *ret = members;
  return error;
}

/* Converts a stored block to places of the campaign's environments, and drops other
 * environments. */
static void keep_own(const int64_t *environments, uint32_t n, const struct mo_condition *condition,
                     struct mo_campaign_score *score)
{
  uint64_t taken = 0; /* a campaign may have an environment twice */
  score->n = 0;
  for (uint32_t i = 0; i < condition->n; i++)
    for (uint32_t k = 0; k < n; k++)
      if (environments[k] == condition->environments[i]) {
        if (taken >> k & 1)
          break;
        taken |= UINT64_C(1) << k;
        score->environments[score->n] = k;
        score->losses[score->n] = score->losses[i];
        score->diverged_steps[score->n++] = score->diverged_steps[i];
        break;
      }
}

/* Adds the measures of a block's rollouts, if those that the campaign names are stored for all. */
static int add_measures(struct mo_connection *reader, const struct mo_campaign_head *head,
                        const int64_t *environments, int64_t genotype,
                        const struct mo_condition *condition, double (*measures)[MO_MEASURES],
                        struct mo_campaign_score *score)
{
  const struct mo_saved_design design = mo_design_under(condition, genotype, 0);
  int64_t own[MO_BLOCK_LANES];
  uint64_t known = 0;
  for (uint32_t k = 0; k < score->n; k++)
    own[k] = environments[score->environments[k]];
  const int error =
      mo_measures_read(reader, &design, own, score->n, head->measures, measures, &known);
  if (error == MO_OK && known == UINT64_MAX >> (64 - score->n))
    score->measures = measures;
  return error;
}

int mo_store_campaign_scores(struct mo_store *store, int64_t id, uint32_t first, uint32_t last,
                             int (*take)(void *context, const struct mo_campaign_score *score),
                             void *context)
{
  static const char sql[] =
      "SELECT " MO_SCORE_COLUMNS ",d.number,f.text,o.text FROM campaign_designs d"
      " CROSS JOIN scores x ON x.genotype=d.genotype CROSS JOIN conditions c ON c.id=x.condition"
      " CROSS JOIN fingerprints f ON f.id=c.fingerprint CROSS JOIN origins o ON o.id=x.origin"
      " WHERE d.job=?1 AND d.number BETWEEN ?2 AND ?3 AND c.controller=?4 AND c.physics=?5"
      " ORDER BY d.number,x.condition";
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  struct mo_campaign_head head = {0};
  int64_t environments[MO_ENVIRONMENTS_MAX] = {0};
  int error = mo_campaign_head_get(reader, id, &head);
  if (error == MO_OK)
    error = mo_environments_read(reader, head.group, head.n_environments, NULL, environments);
  sqlite3_stmt *row = mo_sql_rows(reader, &error, sql, mo_int(id), mo_int(first), mo_int(last),
                                  mo_int(head.controller), mo_int(head.physics));
  while (mo_sql_next(reader, row, &error)) {
    double measures[MO_BLOCK_LANES][MO_MEASURES];
    struct mo_condition condition = {.n = 0};
    struct mo_campaign_score score = {.number = mo_column_u32(row, 8),
                                      .computed_us = sqlite3_column_int64(row, 6)};
    error = mo_score_from_row(row, 0, &condition, score.losses, score.diverged_steps);
    mo_column_text(row, 9, score.fingerprint, sizeof(score.fingerprint));
    mo_column_text(row, 10, score.origin, sizeof(score.origin));
    keep_own(environments, head.n_environments, &condition, &score);
    if (error == MO_OK && head.measures != 0 && score.n > 0)
      error = add_measures(reader, &head, environments, sqlite3_column_int64(row, 0), &condition,
                           measures, &score);
    if (error == MO_OK && score.n > 0)
      error = take(context, &score);
  }
  return error;
}
