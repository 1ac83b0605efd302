/* score_import.c: imports blocks of scores (score_blocks.h), each in one transaction of the writer.
 * A stored loss is never replaced: losses with different bits are counted and reported. */
#include "store/score_blocks.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "base/clock.h"
#include "store/contents.h"
#include "store/controller_rows.h"
#include "store/internal.h"
#include "store/scores.h"

struct entry {
  const struct mo_score_block *block;
  struct mo_message *message;
  struct mo_scores_imported own; /* counts of this block */
  int64_t now_us;
  /* Rows of the block's tables; 0: not looked up yet. */
  int64_t conditions[MO_SCORED_CONDITIONS][2]; /* controller, physics */
  int64_t environments[MO_SCORED_ENVIRONMENTS];
  int64_t designs[MO_SCORED_ROWS];
  /* Rows of the previous score, which the next one usually shares. */
  const struct mo_campaign_score *before;
  int64_t origin;
  struct mo_condition condition;
  int64_t set;   /* named set that contains environments of the condition; 0: none */
  bool is_whole; /* the condition has all environments of the set, in order */
};

/* ---- the tables of the block ---- */

static int import_condition(struct mo_store *store, struct entry *entry, uint32_t place)
{
  const struct mo_scored_condition *condition = &entry->block->conditions[place];
  struct mo_connection *writer = &store->writer;
  char name[8 + MO_SHA256_DIGITS] = "sha256:";
  enum mo_sensor sensor = condition->sensor;
  mo_sha256_to_hex(&condition->controller, name + 7);
  int error = mo_controller_find(writer, name, &entry->conditions[place][0], &sensor, NULL);
  if (error == MO_ERR_NOT_FOUND)
    return mo_fail(entry->message, MO_ERR_INVALID,
                   "the controller %s is not stored here but is in an earlier block of the file; "
                   "send the file from its start, or store the controller first",
                   name);
  if (error == MO_ERR_UNSUPPORTED || (error == MO_OK && sensor != condition->sensor))
    return mo_fail(entry->message, MO_ERR_INVALID,
                   "the workspace or sensor of controller %s differs from its scores", name);
  return error == MO_OK ? mo_physics_row(writer, &condition->physics, condition->precision,
                                         condition->sensor, &entry->conditions[place][1])
                        : error;
}

static int import_tables(struct mo_store *store, struct entry *entry)
{
  const struct mo_score_block *block = entry->block;
  int64_t row = 0;
  int error =
      block->controller != NULL
          ? mo_controller_content_row(&store->writer, block->controller, &block->weights_sha256,
                                      block->weights_size, entry->now_us, &row)
          : MO_OK;
  for (uint32_t i = 0; i < block->n_conditions && error == MO_OK; i++)
    error = import_condition(store, entry, i);
  for (uint32_t i = 0; i < block->n_environments && error == MO_OK; i++)
    error = mo_environment_row(&store->writer, &block->environments[i], &entry->environments[i]);
  for (uint32_t i = 0; i < block->n_designs && error == MO_OK; i++)
    error = mo_genotype_row(&store->writer, block->designs[i].form.words,
                            block->designs[i].genotype.words, entry->now_us, &entry->designs[i]);
  return error;
}

/* ---- a score ---- */

/* Finds the named set that contains environments of the condition; this can only be the paper's
 * test set. */
static int find_set(struct mo_connection *writer, struct entry *entry)
{
  static const char sql[] =
      "SELECT m.environment_set,s.n,sum(m.position=v.position) FROM condition_environments v"
      " JOIN environment_set_members m ON m.environment=v.environment"
      " JOIN environment_sets s ON s.id=m.environment_set WHERE v.condition=?1"
      " GROUP BY m.environment_set";
  const struct mo_condition *condition = &entry->condition;
  sqlite3_stmt *row;
  const int error = mo_sql_row(writer, &row, sql, mo_int(condition->id));
  entry->set = 0;
  if (error != MO_OK)
    return error == MO_ERR_NOT_FOUND ? MO_OK : error;
  entry->set = sqlite3_column_int64(row, 0);
  entry->is_whole =
      sqlite3_column_int64(row, 1) == condition->n && sqlite3_column_int64(row, 2) == condition->n;
  return MO_OK;
}

/* Rejects a condition that lists an environment twice (two lines of the block may be the same),
 * because the losses of one rollout could differ within a row. */
static int check_environments(const struct entry *entry, uint32_t i)
{
  const struct mo_campaign_score *score = &entry->block->scores[i];
  const struct mo_condition *condition = &entry->condition;
  for (uint32_t k = 0; k < condition->n; k++)
    for (uint32_t j = 0; j < k; j++)
      if (condition->environments[j] == condition->environments[k])
        return mo_fail(
            entry->message, MO_ERR_INVALID,
            "scores/%08u.ndjson has a row with a duplicate environment: lines %u and %u of "
            "environments.ndjson, counting from 0, are the same; use only one of them",
            entry->block->condition_of[i], score->environments[j], score->environments[k]);
  return MO_OK;
}

/* Finds the rows of origin, class and condition, unless they are the same as for the previous
 * score. */
static int find_condition(struct mo_store *store, struct entry *entry, uint32_t i)
{
  const struct mo_score_block *block = entry->block;
  const struct mo_campaign_score *score = &block->scores[i], *before = entry->before;
  const int64_t *rows = entry->conditions[block->condition_of[i]];
  struct mo_connection *writer = &store->writer;
  struct mo_condition *condition = &entry->condition;
  int error = MO_OK;
  if (before == NULL || strcmp(before->origin, score->origin) != 0)
    error = mo_text_row(writer, MO_ORIGINS, score->origin, &entry->origin);
  entry->before = score;
  if (error != MO_OK ||
      (before != NULL && condition->controller == rows[0] && condition->physics == rows[1] &&
       strcmp(before->fingerprint, score->fingerprint) == 0 && before->n == score->n &&
       memcmp(before->environments, score->environments, score->n * sizeof(*score->environments)) ==
           0))
    return error;
  *condition = (struct mo_condition){.controller = rows[0], .physics = rows[1], .n = score->n};
  for (uint32_t k = 0; k < score->n; k++)
    condition->environments[k] = entry->environments[score->environments[k]];
  error = check_environments(entry, i);
  if (error == MO_OK)
    error = mo_text_row(writer, MO_FINGERPRINTS, score->fingerprint, &condition->fingerprint);
  if (error == MO_OK)
    error = mo_condition_row(writer, condition);
  return error == MO_OK ? find_set(writer, entry) : error;
}

/* Describes a row that differs. */
static void note_difference(struct entry *entry, uint32_t i, const struct mo_score *stored)
{
  const struct mo_score_block *block = entry->block;
  const struct mo_campaign_score *score = &block->scores[i];
  const struct mo_scored_condition *condition = &block->conditions[block->condition_of[i]];
  if (entry->own.n == MO_DIFFERENCES_MAX)
    return;
  struct mo_origin_row *row = &entry->own.differences[entry->own.n++];
  *row = (struct mo_origin_row){.form = block->designs[score->number].form,
                                .genotype = block->designs[score->number].genotype,
                                .controller_sha256 = condition->controller,
                                .physics = condition->physics,
                                .precision = condition->precision,
                                .computed_us = score->computed_us,
                                .n = score->n,
                                .has_losses = true};
  mo_physics_hash(&condition->physics, condition->precision, condition->sensor,
                  &row->physics_sha256);
  memcpy(row->fingerprint, score->fingerprint, sizeof(row->fingerprint));
  for (uint32_t k = 0; k < score->n; k++) {
    row->environments[k] = block->environments[score->environments[k]];
    mo_environment_hash(&row->environments[k], &row->environment_sha256[k]);
    /* The grid belongs to the block, which differences may outlive. */
    row->environments[k].grid = NULL;
    row->again.losses[k] = score->losses[k];
    row->again.diverged_steps[k] = score->diverged_steps[k];
    row->stored.losses[k] = stored[k].known ? stored[k].loss : score->losses[k];
    row->stored.diverged_steps[k] =
        stored[k].known ? (uint32_t)stored[k].diverged_step : score->diverged_steps[k];
  }
}

static int import_mean(struct mo_connection *writer, const struct entry *entry,
                       const struct mo_campaign_score *score)
{
  const struct mo_saved_design design =
      mo_design_under(&entry->condition, entry->designs[score->number], entry->set);
  double sum = 0;
  if (entry->set == 0)
    return MO_OK;
  for (uint32_t k = 0; k < score->n; k++)
    sum += score->losses[k];
  return entry->is_whole ? mo_set_score_insert_mean(writer, &design, sum / score->n)
                         : mo_set_score_insert(writer, &design);
}

static int import_score(struct mo_store *store, struct entry *entry, uint32_t i)
{
  const struct mo_campaign_score *score = &entry->block->scores[i];
  const int64_t genotype = entry->designs[score->number];
  struct mo_score stored[MO_BLOCK_LANES] = {{0}};
  uint32_t n_same = 0;
  bool is_new = false;
  int error = find_condition(store, entry, i);
  if (error != MO_OK)
    return error;
  error = mo_losses_compare(&store->writer, &entry->condition, genotype, score->losses,
                            score->diverged_steps, stored);
  const bool differs = error == MO_ERR_CONFLICT;
  if (error != MO_OK && !differs)
    return error;
  for (uint32_t k = 0; k < score->n; k++)
    n_same += stored[k].known && mo_same_bits(stored[k].loss, score->losses[k]) &&
              stored[k].diverged_step == (int32_t)score->diverged_steps[k];
  entry->own.n_known += n_same;
  *(differs ? &entry->own.n_different : &entry->own.n_new) += score->n - n_same;
  if (differs)
    note_difference(entry, i, stored);
  if (differs || n_same == score->n)
    return MO_OK;
  error = mo_losses_insert(store, &entry->condition, genotype, entry->origin, score->losses,
                           score->diverged_steps, score->computed_us, &is_new);
  return error == MO_OK ? import_mean(&store->writer, entry, score) : error;
}

/* ---- the block ---- */

static int announce(struct mo_store *store, const struct entry *entry)
{
  const struct mo_score_block *block = entry->block;
  const struct mo_scores_imported *own = &entry->own;
  char data[320];
  if (own->n_new == 0 && own->n_different == 0)
    return MO_OK;
  snprintf(data, sizeof(data),
           "{\"store\":\"%016llx\",\"host\":\"%s\",\"new\":%llu,\"known\":%llu,\"different\":%llu}",
           (unsigned long long)block->store, block->host, (unsigned long long)own->n_new,
           (unsigned long long)own->n_known, (unsigned long long)own->n_different);
  int error = own->n_new > 0 ? mo_writer_event(store, 0, "scores.imported", "%s", data) : MO_OK;
  if (error == MO_OK && own->n_different > 0)
    error = mo_writer_event(store, 0, "scores.differ", "%s", data);
  return error;
}

static int import_block(struct mo_store *store, void *arguments)
{
  struct entry *entry = arguments;
  memset(&entry->own, 0, sizeof(entry->own));
  entry->before = NULL;
  entry->now_us = mo_clock_wall_us();
  int error = import_tables(store, entry);
  for (uint32_t i = 0; i < entry->block->n_scores && error == MO_OK; i++)
    error = import_score(store, entry, i);
  return error == MO_OK ? announce(store, entry) : error;
}

static void add(struct mo_scores_imported *all, const struct mo_scores_imported *own)
{
  all->n_new += own->n_new;
  all->n_known += own->n_known;
  all->n_different += own->n_different;
  for (uint32_t i = 0; i < own->n && all->n < MO_DIFFERENCES_MAX; i++)
    all->differences[all->n++] = own->differences[i];
}

int mo_store_scores_import(struct mo_store *store, const struct mo_score_block *block,
                           struct mo_scores_imported *entered, struct mo_message *message)
{
  struct entry *entry = calloc(1, sizeof(*entry));
  int error = MO_OK;
  if (entry == NULL)
    return MO_ERR_NO_MEMORY;
  entry->block = block;
  entry->message = message;
  mo_store_import_begin(store);
  if (block->controller != NULL)
    error =
        mo_store_import_file(store, &block->weights_sha256, block->weights, block->weights_size);
  if (error == MO_OK)
    error = mo_write(store, import_block, entry);
  mo_store_import_end(store);
  if (error == MO_OK)
    add(entered, &entry->own);
  free(entry);
  return error;
}
