/* campaign_runs.c: what the runner of a campaign does between generations: start, park, finish,
 * read the state.
 *
 * Writes are fenced by the epoch like those of trainings: the campaign must have been started under
 * this opening of the store and must not be final. A campaign that was paused still takes losses
 * and generations, because its thread saves what it has computed. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "store/campaign_rows.h"

#include "base/clock.h"

/* ---- the queue and the attempt ---- */

int64_t mo_store_queued_campaigns(struct mo_store *store, int64_t *ids, size_t limit)
{
  return mo_run_queued(store, MO_JOB_CAMPAIGN, ids, limit);
}

int mo_store_campaign_start(struct mo_store *store, int64_t id)
{
  return mo_run_start(store, id, MO_JOB_CAMPAIGN);
}

int mo_store_campaign_park(struct mo_store *store, int64_t id, int error, const char *error_text,
                           uint32_t max_attempts, enum mo_job_state *after)
{
  return mo_run_park(store, id, MO_JOB_CAMPAIGN, error, error_text, max_attempts, after);
}

/* ---- warnings ---- */

struct fault_arguments {
  int64_t id;
  const char *data;
};

static int tell_fault(struct mo_store *store, void *arguments)
{
  const struct fault_arguments *call = arguments;
  int error = mo_run_touch(store, call->id, MO_JOB_CAMPAIGN);
  return error == MO_OK
             ? mo_writer_event(store, call->id, "campaign.lineage_unreadable", call->data)
             : error;
}

int mo_store_campaign_lineage_fault(struct mo_store *store, int64_t id,
                                    const struct mo_sha256 *sha256, const char *field,
                                    const char *detail)
{
  char data[480], digits[MO_SHA256_DIGITS + 1];
  struct fault_arguments call = {id, data};
  mo_sha256_to_hex(sha256, digits);
  snprintf(data, sizeof(data),
           "{\"id\":\"%lld\",\"controller\":\"%s\",\"field\":\"%.40s\",\"detail\":\"%.240s\"}",
           (long long)id, digits, field, detail);
  return mo_write(store, tell_fault, &call);
}

/* ---- the end ---- */

struct finish_arguments {
  int64_t id;
  enum mo_campaign_end end;
  uint32_t generations;
  struct mo_controller_put *put; /* NULL: none */
};

static int finish(struct mo_store *store, void *arguments)
{
  static const char job_sql[] =
      "UPDATE jobs SET state=3," MO_NEXT_VERSION ",finished_us=?3,error=0,error_text=NULL"
      " WHERE id=?1 AND kind=2 AND state=1 AND epoch=?2"
      " AND (SELECT generations FROM campaigns WHERE job=?1)<=?4";
  static const char sql[] = "UPDATE campaigns SET ended=?2,result=nullif(?3,0) WHERE job=?1";
  const struct finish_arguments *call = arguments;
  struct mo_connection *writer = &store->writer;
  char more[256], digits[MO_SHA256_DIGITS + 1];
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, job_sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, call->id);
  sqlite3_bind_int64(statement, 2, store->epoch);
  sqlite3_bind_int64(statement, 3, mo_clock_wall_us());
  sqlite3_bind_int64(statement, 4, call->generations);
  error = mo_run_changed(writer, statement);
  if (error == MO_OK && call->put != NULL)
    error = mo_controller_put_row(store, call->put);
  statement = error == MO_OK ? mo_sql(writer, sql, &error) : NULL;
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, call->id);
  sqlite3_bind_int64(statement, 2, call->end);
  sqlite3_bind_int64(statement, 3, call->put != NULL ? call->put->row : 0);
  error = mo_sql_run(writer, statement);
  if (error != MO_OK)
    return error;
  snprintf(more, sizeof(more), ",\"end\":\"%s\"",
           call->end == MO_CAMPAIGN_EXHAUSTED ? "exhausted" : "completed");
  if (call->put != NULL) {
    size_t length = strlen(more);
    mo_sha256_to_hex(&call->put->sha256, digits);
    snprintf(more + length, sizeof(more) - length, ",\"controller\":\"%s\",\"sha256\":\"%s\"",
             call->put->name, digits);
  }
  return mo_run_announce(store, call->id, MO_JOB_CAMPAIGN, "job.finished", MO_JOB_SUCCEEDED, more);
}

int mo_store_campaign_finish(struct mo_store *store, int64_t id, enum mo_campaign_end end,
                             uint32_t generations, const char *name, const uint8_t *bytes,
                             size_t size, const struct mo_controller *controller)
{
  struct mo_controller_put put = {.name = name};
  struct finish_arguments call = {id, end, generations, controller != NULL ? &put : NULL};
  int error = MO_OK;
  if (end != MO_CAMPAIGN_COMPLETED && end != MO_CAMPAIGN_EXHAUSTED)
    return MO_ERR_INVALID;
  if (controller != NULL)
    error = mo_controller_put_begin(store, name, bytes, size, controller, &put);
  if (error == MO_OK)
    error = mo_write(store, finish, &call);
  if (controller != NULL)
    mo_controller_put_end(store, &put);
  return error;
}

/* ---- the state from which a run resumes ---- */

void mo_campaign_state_free(struct mo_campaign_state *state)
{
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
  int error = MO_OK;
  int step;
  sqlite3_stmt *statement = mo_sql(reader, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, id);
  sqlite3_bind_int64(statement, 2, state->numbers[i]);
  step = mo_sql_step(reader, statement);
  if (step <= 0)
    return step < 0 ? step : MO_ERR_CORRUPT;
  state->born[i] = (uint32_t)sqlite3_column_int64(statement, 0);
  return mo_column_genotype(statement, 1, 2, &state->genotypes[i], NULL);
}

static int load_state(struct mo_connection *reader, int64_t id, struct mo_campaign_state *state)
{
  struct mo_campaign_blobs blobs;
  struct mo_campaign_head head = {0};
  int error = mo_sql_exec(reader, "BEGIN");
  if (error == MO_OK)
    error = mo_campaign_head_get(reader, id, &head);
  if (error == MO_OK)
    error = mo_campaign_blobs_get(reader, id, head.generation, &blobs);
  if (error != MO_OK)
    return error;
  state->generation = (uint32_t)head.generation;
  state->n = blobs.n;
  state->n_designs = head.n_designs;
  state->diversity_max = head.diversity_max;
  state->numbers = calloc(blobs.n + 1, sizeof(*state->numbers));
  state->born = calloc(blobs.n + 1, sizeof(*state->born));
  state->genotypes = calloc(blobs.n + 1, sizeof(*state->genotypes));
  state->scores = calloc(blobs.n + 1, sizeof(*state->scores));
  if (state->numbers == NULL || state->born == NULL || state->genotypes == NULL ||
      state->scores == NULL)
    return MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < blobs.n && error == MO_OK; i++) {
    const uint8_t *member = blobs.population + (size_t)i * MO_MEMBER_BYTES;
    state->numbers[i] = mo_decode_u32(member);
    state->scores[i] = mo_decode_double(member + 4);
    error = load_member(reader, id, state, i);
  }
  return error;
}

int mo_store_campaign_state(struct mo_store *store, int64_t id, struct mo_campaign_state **ret)
{
  struct mo_campaign_state *state = calloc(1, sizeof(*state));
  struct mo_connection *reader;
  int error;
  if (state == NULL)
    return MO_ERR_NO_MEMORY;
  reader = mo_reader_acquire(store);
  error = load_state(reader, id, state);
  mo_reader_release(store, reader);
  if (error != MO_OK) {
    mo_campaign_state_free(state);
    return error;
  }
  *ret = state;
  return MO_OK;
}

#define EACH_PAGE 4096

/* Reads a page of designs. Designs are never deleted, so no reader is held while `take` runs. */
static int64_t load_page(struct mo_store *store, int64_t id, int64_t after, struct mo_bits *page)
{
  static const char sql[] =
      "SELECT d.number,g.bits FROM campaign_designs d CROSS JOIN genotypes g ON g.id=d.genotype"
      " WHERE d.job=?1 AND d.number>?2 ORDER BY d.number LIMIT ?3";
  struct mo_connection *reader = mo_reader_acquire(store);
  int error = MO_OK;
  int64_t n = 0;
  int step = 0;
  sqlite3_stmt *statement = mo_sql(reader, sql, &error);
  if (statement != NULL) {
    sqlite3_bind_int64(statement, 1, id);
    sqlite3_bind_int64(statement, 2, after);
    sqlite3_bind_int64(statement, 3, EACH_PAGE);
    while (error == MO_OK && (step = mo_sql_step(reader, statement)) > 0) {
      n++;
      error = sqlite3_column_int64(statement, 0) != after + n
                  ? MO_ERR_CORRUPT
                  : mo_column_bits(statement, 1, &page[n - 1]);
    }
  }
  mo_reader_release(store, reader);
  return error != MO_OK ? error : step < 0 ? step : n;
}

int mo_store_campaign_each(struct mo_store *store, int64_t id,
                           int (*take)(void *context, const struct mo_bits *genotype),
                           void *context)
{
  struct mo_bits *page = calloc(EACH_PAGE, sizeof(*page));
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
