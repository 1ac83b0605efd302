/* campaign_commit.c: commits a generation of a campaign, completely or not at all.
 *
 * All results of a generation are stored in one operation of the writer; the checkpoint's file is
 * written before it. A generation out of order is a conflict. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "store/campaign_rows.h"
#include "store/scores.h"

#include "base/clock.h"
#include "store/contents.h"
#include "store/measures.h"
#include "store/rows.h"

struct commit_arguments {
  int64_t id;
  const struct mo_campaign_commit *commit;
  struct mo_checkpoint checkpoint;
  struct mo_campaign_head head;
  int64_t *genotypes;               /* (n_children) rows */
  uint8_t *lives;                   /* (n_parents + n_children) */
  struct mo_birth_row *births;      /* (n_children) */
  struct mo_member_row *population; /* (n_survivors) */
};

/* ---- before the transaction ---- */

static uint32_t parent_number(const struct mo_campaign_commit *commit, const struct mo_birth *birth,
                              int which)
{
  return birth->parents[which] == MO_NO_PARENT || commit->is_study
             ? birth->parents[which]
             : commit->parent_numbers[birth->parents[which]];
}

/* Prepares the BLOBs, and marks the survivors. */
static int prepare(struct commit_arguments *call)
{
  const struct mo_campaign_commit *commit = call->commit;
  uint32_t n_children = commit->row.n_children, n_parents = commit->n_parents;
  call->genotypes = calloc(n_children + 1, sizeof(*call->genotypes));
  call->lives = calloc((size_t)n_parents + n_children + 1, 1);
  call->births = calloc(n_children + 1, sizeof(*call->births));
  call->population = calloc(commit->n_survivors + 1, sizeof(*call->population));
  if (call->genotypes == NULL || call->lives == NULL || call->births == NULL ||
      call->population == NULL)
    return MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < n_children; i++)
    call->births[i] = (struct mo_birth_row){(uint8_t)commit->births[i].op,
                                            {parent_number(commit, &commit->births[i], 0),
                                             parent_number(commit, &commit->births[i], 1)}};
  for (uint32_t i = 0; i < commit->n_survivors; i++) {
    const uint32_t place = commit->survivors[i];
    call->lives[place] = 1;
    call->population[i] =
        place < n_parents
            ? (struct mo_member_row){commit->parent_numbers[place], commit->parent_scores[place]}
            : (struct mo_member_row){(uint32_t)commit->row.born_before + place - n_parents,
                                     commit->child_scores[place - n_parents]};
  }
  return MO_OK;
}

static int check_turn(struct mo_store *store, struct commit_arguments *call)
{
  /* A study waits in the queue for its next batch, and is not started until then. */
  static const char sql[] =
      "UPDATE jobs SET " MO_NEXT_VERSION ",attempts=0,state=iif(?3 AND state=1,0,state)"
      " WHERE id=?1 AND kind=2 AND state<=2 AND epoch=?2";
  struct mo_connection *writer = &store->writer;
  int error = mo_sql_change(writer, sql, mo_int(call->id), mo_int(store->epoch),
                            mo_int(call->commit->is_study));
  if (error == MO_OK)
    error = mo_campaign_head_get(writer, call->id, &call->head);
  if (error == MO_OK && call->head.generation + 1 != call->commit->row.generation)
    error = MO_ERR_CONFLICT;
  return error;
}

/* ---- designs ---- */

static int64_t packed_size(const struct mo_design_size *size)
{
  return (int64_t)((uint64_t)size->springs | (uint64_t)size->masses << 16 |
                   (uint64_t)size->voxels << 26 | (uint64_t)size->footprint << 36);
}

/* Returns a parent's number, or NULL. */
static struct mo_value parent_value(const struct mo_descent *descent, int which)
{
  return descent->parents[which] == MO_NO_PARENT ? mo_null() : mo_int(descent->parents[which]);
}

int mo_campaign_design_row(struct mo_connection *writer, int64_t id, int64_t genotype,
                           const struct mo_campaign_design *design, const double *measures,
                           uint32_t n)
{
  static const char sql[] =
      "INSERT INTO campaign_designs(job,number,genotype,operator,parent,other_parent,born,died,"
      "score,size,measures,is_cut) VALUES(?1,?2,?3,?4,?5,?6,?7,?8,?9,?10,?11,?12)";
  return mo_sql_do(
      writer, sql, mo_int(id), mo_int(design->number), mo_int(genotype), mo_int(design->descent.op),
      parent_value(&design->descent, 0), parent_value(&design->descent, 1), mo_int(design->born),
      design->died < 0 ? mo_null() : mo_int(design->died), mo_blob(&design->score, 8),
      mo_int(packed_size(&design->size)),
      n > 0 ? mo_blob(measures, n * sizeof(*measures)) : mo_null(), mo_int(design->is_cut));
}

static int insert_children(struct mo_connection *writer, struct commit_arguments *call,
                           int64_t now_us)
{
  const struct mo_campaign_commit *commit = call->commit;
  const uint32_t born = commit->row.generation;
  int error = MO_OK;
  for (uint32_t i = 0; i < commit->row.n_children && error == MO_OK; i++)
    error = mo_genotype_row(writer, commit->forms[i].words, commit->genotypes[i].words, now_us,
                            &call->genotypes[i]);
  for (uint32_t i = 0; i < commit->row.n_children && error == MO_OK; i++) {
    const struct mo_campaign_design design = {
        .number = (uint32_t)commit->row.born_before + i,
        .descent = {{call->births[i].parents[0], call->births[i].parents[1]}, call->births[i].op},
        .born = born,
        .died = call->lives[commit->n_parents + i] ? -1 : (int64_t)born,
        .score = commit->child_scores[i],
        .is_cut = commit->children_cut != NULL && commit->children_cut[i],
        .size = commit->sizes[i]};
    error = mo_campaign_design_row(
        writer, call->id, call->genotypes[i], &design,
        commit->n_measures > 0 ? commit->measures + (size_t)commit->n_measures * i : NULL,
        commit->n_measures);
  }
  return error;
}

/* Updates parents that died or, if the controller learns, have a new score and new measures. */
static int update_parents(struct mo_connection *writer, const struct commit_arguments *call)
{
  static const char sql[] = "UPDATE campaign_designs SET died=?3,score=?4,"
                            "measures=coalesce(?5,measures) WHERE job=?1 AND number=?2";
  const struct mo_campaign_commit *commit = call->commit;
  int error = MO_OK;
  for (uint32_t i = 0; i < commit->n_parents && error == MO_OK; i++) {
    if (call->lives[i] && !mo_modes[call->head.mode].learns)
      continue;
    error = mo_sql_change(writer, sql, mo_int(call->id), mo_int(commit->parent_numbers[i]),
                          call->lives[i] ? mo_null() : mo_int(commit->row.generation),
                          mo_blob(&commit->parent_scores[i], 8),
                          commit->parent_measures != NULL
                              ? mo_blob(commit->parent_measures + (size_t)commit->n_measures * i,
                                        commit->n_measures * sizeof(double))
                              : mo_null());
    if (error == MO_ERR_CONFLICT)
      error = MO_ERR_CORRUPT;
  }
  return error;
}

/* The conditions that the losses of a generation share. */
struct conditions {
  const struct mo_campaign_head *head;
  int64_t environments[MO_ENVIRONMENTS_MAX];
  int64_t fingerprints[2]; /* of the campaign's back end, and of the workers */
  /* For each block, with its id: the newest condition of children that were cut short, and of all
   * others. */
  struct mo_condition last[MO_ENVIRONMENTS_MAX / MO_BLOCK_LANES][2];
};

/* The losses of a block of environments that one machine computed. */
struct part {
  struct mo_condition condition;
  double losses[MO_BLOCK_LANES];
  uint32_t diverged_steps[MO_BLOCK_LANES];
  int64_t origin;
  double measures[MO_BLOCK_LANES][MO_MEASURES]; /* of a campaign that names some */
};

/* Collects the losses of a block with the same origin and class as the loss of environment `first`,
 * and marks them in `taken`. */
static void take_part(const struct conditions *conditions, const struct mo_campaign_loss *loss,
                      uint32_t first, uint32_t end, uint64_t *taken, struct part *part)
{
  const uint64_t by_workers = loss->by_workers >> first & 1;
  *part = (struct part){.origin = loss->origins[first],
                        .condition = {.controller = conditions->head->controller,
                                      .physics = conditions->head->physics,
                                      .fingerprint = conditions->fingerprints[by_workers]}};
  for (uint32_t k = first; k < end; k++) {
    if (*taken >> k & 1 || isnan(loss->losses[k]) || loss->origins[k] != part->origin ||
        (loss->by_workers >> k & 1) != by_workers)
      continue;
    const uint32_t n = part->condition.n++;
    part->condition.environments[n] = conditions->environments[k];
    part->losses[n] = loss->losses[k];
    part->diverged_steps[n] = (uint32_t)loss->diverged_steps[k];
    if (loss->measures != NULL)
      memcpy(part->measures[n], loss->measures[k], sizeof(part->measures[n]));
    *taken |= UINT64_C(1) << k;
  }
}

/* Stores a part of a child's losses, and its measures. last: its block's newest condition. */
static int insert_part(struct mo_store *store, struct part *part, int64_t genotype,
                       bool has_measures, struct mo_condition *last, int64_t now_us, bool *is_new)
{
  /* The losses may already be stored: some rollouts are computed only for their measures. */
  bool is_stored = false;
  int error = mo_condition_row_after(&store->writer, &part->condition, last);
  if (error == MO_OK && has_measures)
    error = mo_losses_are_known(&store->writer, &part->condition, genotype, &is_stored);
  *is_new = false;
  if (error == MO_OK && !is_stored)
    error = mo_losses_insert(store, &part->condition, genotype, part->origin, part->losses,
                             part->diverged_steps, now_us, is_new);
  return error == MO_OK && has_measures
             ? mo_measures_insert_row(store, &part->condition, genotype, part->origin,
                                      (const double(*)[MO_MEASURES])part->measures, now_us)
             : error;
}

/* Stores the losses of a child like the losses of an evaluation: a row for each block of
 * environments, or more if several machines computed it. */
static int insert_child_scores(struct mo_store *store, const struct commit_arguments *call,
                               const struct mo_campaign_loss *loss, struct conditions *conditions,
                               int64_t now_us)
{
  const struct mo_campaign_head *head = &call->head;
  const int64_t genotype = call->genotypes[loss->place];
  const struct mo_saved_design design = {genotype,
                                         head->controller,
                                         head->physics,
                                         head->environment_set,
                                         call->commit->fingerprint,
                                         call->commit->workers_fingerprint};
  bool all_new = loss->stored == 0, is_new = false, is_whole = true;
  uint64_t taken = loss->stored;
  double sum = 0;
  int error = MO_OK;
  for (uint32_t k = 0; k < head->n_environments && error == MO_OK; k++) {
    const uint32_t block = k / MO_BLOCK_LANES, full = (block + 1) * MO_BLOCK_LANES;
    const uint32_t end = full < head->n_environments ? full : head->n_environments;
    struct part part;
    is_whole = is_whole && !isnan(loss->losses[k]);
    sum += loss->losses[k];
    if (taken >> k & 1 || isnan(loss->losses[k]))
      continue;
    take_part(conditions, loss, k, end, &taken, &part);
    const bool is_full = part.condition.n == end - block * MO_BLOCK_LANES;
    error = insert_part(store, &part, genotype, loss->measures != NULL,
                        &conditions->last[block][is_full], now_us, &is_new);
    all_new = all_new && is_new;
  }
  if (error != MO_OK || head->environment_set == 0 || !is_whole)
    return error;
  return all_new ? mo_set_score_insert_mean(&store->writer, &design, sum / head->n_environments)
                 : mo_set_score_insert(&store->writer, &design);
}

static int insert_scores(struct mo_store *store, const struct commit_arguments *call,
                         int64_t now_us)
{
  const struct mo_campaign_commit *commit = call->commit;
  const struct mo_campaign_head *head = &call->head;
  struct conditions conditions = {
      .head = head, .fingerprints = {commit->fingerprint, commit->workers_fingerprint}};
  if (commit->n_losses == 0)
    return MO_OK;
  int error = mo_environments_read(&store->writer, head->group, head->n_environments, NULL,
                                   conditions.environments);
  for (uint32_t i = 0; i < commit->n_losses && error == MO_OK; i++)
    error = insert_child_scores(store, call, &commit->losses[i], &conditions, now_us);
  return error;
}

/* ---- the generation ---- */

static int insert_blobs(struct mo_connection *writer, const struct commit_arguments *call)
{
  static const char sql[] =
      "INSERT INTO campaign_populations(job,generation,births,population) VALUES(?1,?2,?3,?4)";
  const struct mo_campaign_commit *commit = call->commit;
  return mo_sql_do(writer, sql, mo_int(call->id), mo_int(commit->row.generation),
                   mo_blob(call->births, commit->row.n_children * sizeof(*call->births)),
                   mo_blob(call->population, commit->n_survivors * sizeof(*call->population)));
}

static int update_campaign(struct mo_connection *writer, const struct commit_arguments *call)
{
  static const char sql[] =
      "UPDATE campaigns SET generation=?2,n_designs=?3,best_score=?4,diversity_max=?5,"
      "race_pays=?6,scored=0,scored_generation=-1 WHERE job=?1";
  const struct mo_campaign_commit *commit = call->commit;
  const double diversity = commit->row.stats.diversity, most = call->head.diversity_max;
  return mo_sql_do(writer, sql, mo_int(call->id), mo_int(commit->row.generation),
                   mo_int((int64_t)commit->row.born_before + commit->row.n_children),
                   commit->n_survivors > 0 ? mo_real(call->population[0].score) : mo_null(),
                   mo_real(diversity > most ? diversity : most), mo_int(commit->race_pays));
}

/* Returns whether all robots of this generation diverged, but not all of the previous one. With
 * select_by, robots without a value of the measure count, too. */
static int all_have_diverged(struct mo_connection *writer, const struct commit_arguments *call,
                             bool *ret)
{
  static const char sql[] = "SELECT best_score FROM campaigns WHERE job=?1";
  const struct mo_campaign_generation *now = &call->commit->row;
  sqlite3_stmt *row;
  if (now->stats.n == 0 || now->stats.n_diverged < now->stats.n)
    return MO_OK;
  const int error = mo_sql_row(writer, &row, sql, mo_int(call->id));
  *ret = error == MO_OK && (now->generation == 0 || isfinite(sqlite3_column_double(row, 0)));
  return error;
}

static int commit_generation(struct mo_store *store, void *arguments)
{
  static const char earlier_sql[] =
      "SELECT generation,step,size FROM checkpoints WHERE job=?1 AND generation<?2";
  struct commit_arguments *call = arguments;
  const struct mo_campaign_commit *commit = call->commit;
  struct mo_campaign_generation row = commit->row;
  struct mo_connection *writer = &store->writer;
  int64_t now_us = mo_clock_wall_us();
  bool has_diverged = false; /* all robots, for the first time */
  int error = check_turn(store, call);
  row.stored_us = now_us;
  if (error == MO_OK)
    error = insert_children(writer, call, now_us);
  if (error == MO_OK)
    error = update_parents(writer, call);
  if (error == MO_OK)
    error = insert_scores(store, call, now_us);
  if (error == MO_OK)
    error = mo_row_write(writer, MO_CAMPAIGN_GENERATIONS, call->id, &row);
  for (uint32_t i = 0; i < commit->n_held_out && error == MO_OK; i++)
    error = mo_campaign_held_out_row(writer, call->id, &commit->held_out[i]);
  if (error == MO_OK)
    error = insert_blobs(writer, call);
  for (uint32_t i = 0; i < commit->n_steps && error == MO_OK; i++)
    error = mo_row_write(writer, MO_CAMPAIGN_STEPS, call->id, &commit->steps[i]);
  if (error == MO_OK)
    error = commit->checkpoint != NULL
                ? mo_campaign_checkpoint_row(store, &call->checkpoint, true)
                : mo_checkpoint_drop(store, earlier_sql, 0, &call->checkpoint);
  if (error == MO_OK && call->head.scored_generation >= 0)
    error = mo_campaign_losses_drop(writer, call->id);
  if (error == MO_OK)
    error = all_have_diverged(writer, call, &has_diverged);
  if (error == MO_OK)
    error = update_campaign(writer, call);
  if (error == MO_OK && has_diverged)
    error = mo_run_announce_warnings(store, call->id, false);
  if (error == MO_OK && commit->event_data != NULL)
    error = mo_writer_event(store, call->id, "campaign.generation", "%s", commit->event_data);
  if (error == MO_OK && commit->collapse_data != NULL)
    error = mo_writer_event(store, call->id, "campaign.diversity_collapse", "%s",
                            commit->collapse_data);
  return error;
}

int mo_store_campaign_commit(struct mo_store *store, int64_t id,
                             const struct mo_campaign_commit *commit)
{
  struct commit_arguments call = {
      .id = id,
      .commit = commit,
      .checkpoint = {.id = id,
                     .kind = MO_JOB_CAMPAIGN,
                     .place = {commit->row.generation, commit->checkpoint_step},
                     .size = commit->checkpoint_size}};
  int error = prepare(&call);
  if (error == MO_OK)
    error =
        mo_checkpoint_write(store, commit->checkpoint, &call.checkpoint, commit_generation, &call);
  free(call.genotypes);
  free(call.lives);
  free(call.births);
  free(call.population);
  return error;
}
