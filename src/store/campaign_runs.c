/* campaign_runs.c: operations of a campaign's runner between generations: start, park, checkpoints
 * within a generation, the end, and the state to resume from. Writes are fenced as in runs.h. */
#include <stdlib.h>

#include "store/campaign_rows.h"
#include "store/rows.h"

/* ---- events ---- */

struct fault_arguments {
  int64_t id;
  const struct mo_sha256 *sha256;
  const char *field, *detail;
};

static int announce_fault(struct mo_store *store, void *arguments)
{
  const struct fault_arguments *call = arguments;
  int error = mo_run_touch(store, call->id);
  return error == MO_OK ? mo_writer_event(store, call->id, "campaign.lineage_unreadable",
                                          "{\"id\":\"%lld\",\"controller\":\"%s\",\"field\":\"%."
                                          "40s\",\"detail\":\"%.240s\"}",
                                          (long long)call->id, MO_SHA256_HEX(call->sha256),
                                          call->field, call->detail)
                        : error;
}

int mo_store_campaign_lineage_fault(struct mo_store *store, int64_t id,
                                    const struct mo_sha256 *sha256, const char *field,
                                    const char *detail)
{
  return mo_write(store, announce_fault, &(struct fault_arguments){id, sha256, field, detail});
}

struct progress_arguments {
  int64_t id;
  const char *data;
};

static int announce_progress(struct mo_store *store, void *arguments)
{
  const struct progress_arguments *call = arguments;
  const int error = mo_run_touch(store, call->id);
  return error == MO_OK ? mo_writer_event(store, call->id, "campaign.progress", "%s", call->data)
                        : error;
}

int mo_store_campaign_progress(struct mo_store *store, int64_t id, const char *data)
{
  return mo_write(store, announce_progress, &(struct progress_arguments){id, data});
}

/* ---- the end ---- */

struct end {
  enum mo_campaign_end end;
  uint32_t generations;
};

/* MO_ERR_CONFLICT: the campaign was extended. */
static int end_campaign(struct mo_connection *writer, int64_t id, const void *context)
{
  static const char sql[] = "UPDATE campaigns SET ended=?2 WHERE job=?1 AND generations<=?3";
  const struct end *end = context;
  return mo_sql_change(writer, sql, mo_int(id), mo_int(end->end), mo_int(end->generations));
}

int mo_store_campaign_finish(struct mo_store *store, int64_t id, enum mo_campaign_end end,
                             uint32_t generations, const char *name, const uint8_t *bytes,
                             size_t size, const struct mo_controller *controller)
{
  const struct mo_run_result result = {name, bytes, size, controller};
  const struct end context = {end, generations};
  return mo_run_finish(store, id, &result,
                       end == MO_CAMPAIGN_EXHAUSTED ? ",\"end\":\"exhausted\""
                                                    : ",\"end\":\"completed\"",
                       end_campaign, &context);
}

/* ---- checkpoints ----
 *
 * Two checkpoints are kept: the state after the newest committed generation, which scored its
 * population, and the newest state within the current generation. */

int mo_campaign_checkpoint_row(struct mo_store *store, struct mo_checkpoint *checkpoint,
                               bool is_committed)
{
  /* The next generation needs only the state after this one. A checkpoint within a generation keeps
   * the state before that generation. */
  static const char sql[] = "SELECT generation,step,size FROM checkpoints WHERE job=?1"
                            " AND NOT (generation=?2 AND step=?3) AND (?4 OR generation<>?2-1)";
  const int error = mo_checkpoint_row_write(store, checkpoint);
  return error == MO_OK ? mo_checkpoint_drop(store, sql, is_committed, checkpoint) : error;
}

struct inside_arguments {
  struct mo_checkpoint checkpoint;
  const struct mo_campaign_step *steps;
  size_t n_steps;
};

static int save_inside(struct mo_store *store, void *arguments)
{
  struct inside_arguments *call = arguments;
  struct mo_campaign_head head = {0};
  const int64_t id = call->checkpoint.id;
  int error = mo_run_touch(store, id);
  if (error == MO_OK)
    error = mo_campaign_head_get(&store->writer, id, &head);
  if (error == MO_OK && head.generation + 1 != call->checkpoint.place.generation)
    error = MO_ERR_CONFLICT;
  for (size_t i = 0; i < call->n_steps && error == MO_OK; i++)
    error = mo_row_write(&store->writer, MO_CAMPAIGN_STEPS, id, &call->steps[i]);
  return error == MO_OK ? mo_campaign_checkpoint_row(store, &call->checkpoint, false) : error;
}

int mo_store_campaign_checkpoint(struct mo_store *store, int64_t id, uint32_t generation,
                                 uint32_t step, const uint8_t *bytes, size_t size,
                                 const struct mo_campaign_step *steps, size_t n_steps)
{
  struct inside_arguments call = {
      {.id = id, .kind = MO_JOB_CAMPAIGN, .place = {generation, step}, .size = size},
      steps,
      n_steps};
  return mo_checkpoint_write(store, bytes, &call.checkpoint, save_inside, &call);
}

int mo_store_campaign_checkpoint_of(struct mo_store *store, int64_t id, uint32_t generation,
                                    uint32_t *step, uint8_t **bytes, size_t *size)
{
  struct mo_checkpoint_place place;
  const int error =
      mo_checkpoint_read(store, id, MO_JOB_CAMPAIGN, generation, -1, &place, bytes, size);
  if (error == MO_OK)
    *step = place.step;
  return error;
}

/* ---- the state to resume from ---- */

void mo_campaign_state_free(void *any)
{
  struct mo_campaign_state *state = any;
  if (state == NULL)
    return;
  free(state->numbers);
  free(state->born);
  free(state->genotypes);
  free(state->scores);
  free(state);
}

static int load_member(struct mo_connection *reader, int64_t id, struct mo_campaign_state *state,
                       uint32_t i)
{
  static const char sql[] =
      "SELECT d.born,g.bits,x.form FROM campaign_designs d JOIN genotypes g ON g.id=d.genotype"
      " JOIN designs x ON x.id=g.design WHERE d.job=?1 AND d.number=?2";
  sqlite3_stmt *row;
  const int error = mo_sql_row(reader, &row, sql, mo_int(id), mo_int(state->numbers[i]));
  if (error != MO_OK)
    return error == MO_ERR_NOT_FOUND ? MO_ERR_CORRUPT : error;
  state->born[i] = mo_column_u32(row, 0);
  return mo_column_listed(row, 1, 2, &state->genotypes[i], NULL);
}

static int load_state(struct mo_connection *reader, const void *key, void *ret)
{
  const int64_t id = *(const int64_t *)key;
  struct mo_campaign_state *state = ret;
  struct mo_campaign_members members = {.n = 0};
  struct mo_campaign_head head = {0};
  int error = mo_campaign_head_get(reader, id, &head);
  if (error == MO_OK)
    error = mo_campaign_members_get(reader, id, head.generation, &members);
  if (error != MO_OK)
    return error;
  state->generation = (uint32_t)head.generation;
  state->n = members.n;
  state->n_designs = head.n_designs;
  state->diversity_max = head.diversity_max;
  state->race_pays = head.race_pays;
  state->numbers = calloc(members.n + 1, sizeof(*state->numbers));
  state->born = calloc(members.n + 1, sizeof(*state->born));
  state->genotypes = calloc(members.n + 1, sizeof(*state->genotypes));
  state->scores = calloc(members.n + 1, sizeof(*state->scores));
  if (state->numbers == NULL || state->born == NULL || state->genotypes == NULL ||
      state->scores == NULL)
    return MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < members.n && error == MO_OK; i++) {
    state->numbers[i] = members.population[i].number;
    state->scores[i] = members.population[i].score;
    error = load_member(reader, id, state, i);
  }
  return error;
}

int mo_store_campaign_state(struct mo_store *store, int64_t id, struct mo_campaign_state **ret)
{
  int error;
  *ret = mo_read_whole(store, sizeof(**ret), load_state, &id, mo_campaign_state_free, &error);
  return error;
}

#define EACH_PAGE 4096

/* Reads a page of designs. Designs are never deleted, so no reader is held while `take` runs. */
static int64_t load_page(struct mo_store *store, int64_t id, int64_t after,
                         struct mo_genotype *designs)
{
  static const char sql[] =
      "SELECT d.number,g.bits FROM campaign_designs d CROSS JOIN genotypes g ON g.id=d.genotype"
      " WHERE d.job=?1 AND d.number>?2 ORDER BY d.number LIMIT ?3";
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  int64_t n = 0;
  int error = MO_OK;
  sqlite3_stmt *row =
      mo_sql_rows(reader, &error, sql, mo_int(id), mo_int(after), mo_int(EACH_PAGE));
  for (; mo_sql_next(reader, row, &error); n++)
    error = sqlite3_column_int64(row, 0) == after + 1 + n ? mo_column_genotype(row, 1, &designs[n])
                                                          : MO_ERR_CORRUPT;
  return error != MO_OK ? error : n;
}

int mo_store_campaign_each(struct mo_store *store, int64_t id,
                           int (*take)(void *context, const struct mo_genotype *genotype),
                           void *context)
{
  struct mo_genotype *page = calloc(EACH_PAGE, sizeof(*page));
  int64_t after = -1, n = EACH_PAGE;
  int status = page == NULL ? MO_ERR_NO_MEMORY : MO_OK;
  while (status == MO_OK && n == EACH_PAGE) {
    n = load_page(store, id, after, page);
    if (n < 0)
      status = (int)n;
    for (int64_t i = 0; i < n && status == MO_OK; i++)
      status = take(context, &page[i]);
    after += n;
  }
  free(page);
  return status;
}
