/* studies.c: see studies.h. campaign_commit.c commits a batch like any generation. */
#include "store/studies.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "base/clock.h"
#include "store/campaign_rows.h"
#include "store/contents.h"
#include "store/scores.h"

/* ---- by name ---- */

int mo_study_find(struct mo_connection *connection, const char *label, int64_t *id)
{
  static const char sql[] =
      "SELECT j.id FROM jobs j JOIN studies s ON s.job=j.id WHERE j.label=?1 AND j.kind=?2"
      " AND j.state IN(0,1,2) ORDER BY j.id DESC LIMIT 1";
  return mo_sql_find(connection, id, sql, mo_string(label), mo_int(MO_JOB_CAMPAIGN));
}

int mo_store_study_find(struct mo_store *store, const char *label, int64_t *id)
{
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  return mo_study_find(reader, label, id);
}

/* ---- words ---- */

/* Finds or adds a word. Returns its index, MO_ERR_LIMIT, or another error. */
static int64_t place_word(struct mo_connection *writer, int64_t id, int kind, const char *word,
                          char known[][MO_STUDY_WORD_MAX + 1], uint32_t *n, uint32_t most)
{
  static const char sql[] = "INSERT INTO study_words(job,kind,place,word) VALUES(?1,?2,?3,?4)";
  for (uint32_t i = 0; i < *n; i++)
    if (strcmp(known[i], word) == 0)
      return i;
  if (*n == most)
    return MO_ERR_LIMIT;
  int error = mo_sql_do(writer, sql, mo_int(id), mo_int(kind), mo_int(*n), mo_string(word));
  memcpy(known[*n], word, MO_STUDY_WORD_MAX + 1);
  return error == MO_OK ? (int64_t)(*n)++ : error;
}

/* ---- the children of a batch as bytes ---- */

/* The packed form: the number of measures as 32 bits, then for each child the struct below and its
 * numbers, then a checksum. The numbers are the measures and, if the top bit of the first 32 is
 * set, the client's own score. */
#define HAS_SCORES (UINT32_C(1) << 31)
struct told_row {
  uint8_t bits[MO_BITS_BYTES];
  uint8_t op;
  uint32_t parents[2], place;
} __attribute__((packed));

static size_t row_bytes(uint32_t n_numbers)
{
  return sizeof(struct told_row) + n_numbers * sizeof(double);
}

/* Indices of a batch's words among the study's words; n_measures: of the study. */
struct places {
  uint32_t operators[MO_STUDY_OPERATORS_MAX], measures[MO_STUDY_MEASURES_MAX], n_measures;
};

static uint8_t *encode(int64_t id, const struct mo_study_batch *batch, const struct places *places,
                       size_t *size)
{
  const bool has_scores = batch->scores != NULL;
  const uint32_t n = places->n_measures + has_scores;
  const uint32_t head = places->n_measures | (has_scores ? HAS_SCORES : 0);
  const size_t bytes = sizeof(head) + batch->n_children * row_bytes(n);
  uint8_t *encoded = malloc(bytes + 8), *at = encoded;
  if (encoded == NULL)
    return NULL;
  memcpy(at, &head, sizeof(head));
  at += sizeof(head);
  for (uint32_t i = 0; i < batch->n_children; i++, at += row_bytes(n)) {
    const struct mo_study_child *child = &batch->children[i];
    const uint8_t op = child->descent.op;
    struct told_row row = {
        .op =
            op < MO_OPERATORS ? op : (uint8_t)(MO_OPERATORS + places->operators[op - MO_OPERATORS]),
        .parents = {child->descent.parents[0], child->descent.parents[1]},
        .place = child->place};
    double numbers[MO_STUDY_MEASURES_MAX + 1];
    for (uint32_t m = 0; m < places->n_measures; m++)
      numbers[m] = NAN;
    for (uint32_t m = 0; m < batch->n_measures; m++)
      numbers[places->measures[m]] = batch->measures[(size_t)batch->n_measures * i + m];
    if (has_scores)
      numbers[places->n_measures] = batch->scores[i];
    mo_encode_genotype(child->genotype.words, row.bits);
    memcpy(at, &row, sizeof(row));
    memcpy(at + sizeof(row), numbers, n * sizeof(*numbers));
  }
  uint64_t checksum = mo_row_checksum(&id, 1, encoded, bytes);
  memcpy(at, &checksum, sizeof(checksum));
  *size = bytes + sizeof(checksum);
  return encoded;
}

static int decode_child(const uint8_t *at, struct mo_study_child *child)
{
  struct told_row row;
  memcpy(&row, at, sizeof(row));
  child->place = row.place;
  child->descent = (struct mo_descent){{row.parents[0], row.parents[1]}, row.op};
  return mo_decode_genotype(row.bits, sizeof(row.bits), &child->genotype);
}

static int decode(int64_t id, const uint8_t *bytes, size_t size, struct mo_study_batch *batch)
{
  uint64_t checksum;
  uint32_t head;
  int error = MO_OK;
  if (bytes == NULL || size < sizeof(head) + sizeof(checksum))
    return MO_ERR_CORRUPT;
  size -= sizeof(checksum);
  memcpy(&checksum, bytes + size, sizeof(checksum));
  memcpy(&head, bytes, sizeof(head));
  bytes += sizeof(head);
  const bool has_scores = (head & HAS_SCORES) != 0;
  const uint32_t n_measures = head & ~HAS_SCORES, n = n_measures + has_scores;
  if (checksum != mo_row_checksum(&id, 1, bytes - sizeof(head), size) ||
      n_measures > MO_STUDY_MEASURES_MAX || (size - sizeof(head)) % row_bytes(n) != 0)
    return MO_ERR_CORRUPT;
  batch->n_measures = n_measures;
  batch->n_children = (uint32_t)((size - sizeof(head)) / row_bytes(n));
  batch->children = calloc((size_t)batch->n_children + 1, sizeof(*batch->children));
  batch->measures = calloc((size_t)batch->n_children * n_measures + 1, sizeof(*batch->measures));
  batch->scores = has_scores ? calloc((size_t)batch->n_children + 1, sizeof(*batch->scores)) : NULL;
  if (batch->children == NULL || batch->measures == NULL || (has_scores && batch->scores == NULL))
    return MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < batch->n_children && error == MO_OK; i++, bytes += row_bytes(n)) {
    const uint8_t *numbers = bytes + sizeof(struct told_row);
    error = decode_child(bytes, &batch->children[i]);
    memcpy(batch->measures + (size_t)n_measures * i, numbers, n_measures * sizeof(double));
    if (has_scores) {
      memcpy(&batch->scores[i], numbers + n_measures * sizeof(double), sizeof(double));
      if (!(fabs(batch->scores[i]) <= MO_OWN_SCORE_MAX))
        error = MO_ERR_CORRUPT;
    }
  }
  return error;
}

/* ---- reading ---- */

void mo_study_batch_free(void *any)
{
  struct mo_study_batch *batch = any;
  if (batch == NULL)
    return;
  free(batch->children);
  free(batch->measures);
  free(batch->scores);
  free(batch->survivors);
  free(batch);
}

static int load_batch(struct mo_connection *reader, const void *key, void *ret)
{
  static const char sql[] =
      "SELECT batch,children,survivors FROM studies WHERE job=?1 AND batch>=0";
  const int64_t id = *(const int64_t *)key;
  struct mo_study_batch *batch = ret;
  sqlite3_stmt *row;
  int error = mo_sql_row(reader, &row, sql, mo_int(id));
  if (error != MO_OK)
    return error;
  batch->number = mo_column_u32(row, 0);
  error = decode(id, sqlite3_column_blob(row, 1), (size_t)sqlite3_column_bytes(row, 1), batch);
  batch->selects = sqlite3_column_type(row, 2) != SQLITE_NULL;
  if (error != MO_OK || !batch->selects)
    return error;
  const void *survivors = sqlite3_column_blob(row, 2);
  const size_t size = (size_t)sqlite3_column_bytes(row, 2);
  batch->n_survivors = (uint32_t)(size / sizeof(*batch->survivors));
  batch->survivors = malloc(size + 1);
  if (batch->survivors == NULL)
    return MO_ERR_NO_MEMORY;
  if (size > 0 && survivors == NULL)
    return mo_column_missing(row);
  if (size > 0)
    memcpy(batch->survivors, survivors, size);
  return MO_OK;
}

int mo_store_study_batch(struct mo_store *store, int64_t id, struct mo_study_batch **ret)
{
  int error;
  *ret = mo_read_whole(store, sizeof(**ret), load_batch, &id, mo_study_batch_free, &error);
  return error;
}

/* ---- submitting a batch ---- */

struct tell_arguments {
  struct mo_checkpoint checkpoint; /* of the sampler */
  const struct mo_study_telling *telling;
  struct mo_telling_reply *reply;
  struct mo_campaign_head head;
};

static int refuse(struct tell_arguments *call, enum mo_telling_fault fault, uint32_t place,
                  int error)
{
  call->reply->fault = fault;
  call->reply->place = place;
  return error;
}

/* Checks whether the batch is the next one. MO_ERR_DUPLICATE: it was submitted before. */
static int check_turn(struct mo_connection *connection, struct tell_arguments *call)
{
  static const char sql[] = "SELECT j.state,s.batch,s.sha256 FROM studies s JOIN jobs j"
                            " ON j.id=s.job WHERE s.job=?1";
  const struct mo_study_batch *batch = &call->telling->batch;
  const int64_t id = call->checkpoint.id;
  struct mo_sha256 told;
  sqlite3_stmt *row;
  int error = mo_sql_row(connection, &row, sql, mo_int(id));
  if (error == MO_OK)
    error = mo_column_hash(row, 2, &told);
  if (error != MO_OK)
    return error;
  const enum mo_job_state state = (enum mo_job_state)sqlite3_column_int(row, 0);
  const int64_t newest = sqlite3_column_int64(row, 1);
  error = mo_campaign_head_get(connection, id, &call->head);
  if (error != MO_OK)
    return error;
  call->reply->next = (uint32_t)(call->head.generation + 1);
  call->reply->is_new = false;
  if (batch->number == newest && mo_sha256_equal(&told, &call->telling->sha256))
    return MO_ERR_DUPLICATE;
  call->reply->is_new = true;
  if (batch->number == newest)
    return refuse(call, MO_TELLING_OTHER, 0, MO_ERR_CONFLICT);
  if (mo_job_state_is_final(state))
    return refuse(call, MO_TELLING_ENDED, 0, MO_ERR_CONFLICT);
  return batch->number != call->reply->next || newest > call->head.generation
             ? refuse(call, MO_TELLING_NUMBER, 0, MO_ERR_CONFLICT)
             : MO_OK;
}

static int check_file(struct mo_store *store, void *arguments)
{
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  return check_turn(reader, arguments);
}

static int by_number(const void *a, const void *b)
{
  const uint32_t x = *(const uint32_t *)a, y = *(const uint32_t *)b;
  return x < y ? -1 : x > y;
}

/* Checks that the survivors are in the population, without duplicates. */
static int check_survivors(struct mo_connection *writer, struct tell_arguments *call)
{
  const struct mo_study_batch *batch = &call->telling->batch;
  struct mo_campaign_members members = {.n = 0};
  int error = call->head.generation < 0 ? MO_OK
                                        : mo_campaign_members_get(writer, call->checkpoint.id,
                                                                  call->head.generation, &members);
  uint32_t *numbers = calloc((size_t)members.n + 1, sizeof(*numbers));
  uint8_t *lives = calloc((size_t)members.n + 1, 1);
  if (error == MO_OK && (numbers == NULL || lives == NULL))
    error = MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < members.n && error == MO_OK; i++)
    numbers[i] = members.population[i].number;
  if (error == MO_OK)
    qsort(numbers, members.n, sizeof(*numbers), by_number);
  for (uint32_t i = 0; i < batch->n_survivors && error == MO_OK; i++) {
    const uint32_t *found =
        bsearch(&batch->survivors[i], numbers, members.n, sizeof(*numbers), by_number);
    if (found == NULL || lives[found - numbers]++ > 0)
      error = refuse(call, MO_TELLING_SURVIVOR, i, MO_ERR_INVALID);
  }
  free(numbers);
  free(lives);
  return error;
}

/* ---- the client's own scores: one for each body ---- */

struct told_score {
  uint8_t bits[MO_BITS_BYTES];
  uint32_t i; /* of the child */
};

static int by_bits(const void *a, const void *b)
{
  const struct told_score *x = a, *y = b;
  const int order = memcmp(x->bits, y->bits, sizeof(x->bits));
  return order != 0 ? order : by_number(&x->i, &y->i);
}

static int refuse_score(struct tell_arguments *call, uint32_t i, double score)
{
  call->reply->score = score;
  return refuse(call, MO_TELLING_SCORE, call->telling->batch.children[i].place, MO_ERR_INVALID);
}

/* Finds the client's score that an earlier batch has for a body. */
static int find_score(struct mo_connection *writer, int64_t id, const uint8_t bits[MO_BITS_BYTES],
                      double *score)
{
  static const char sql[] = "SELECT d.score FROM genotypes g CROSS JOIN campaign_designs d"
                            " ON d.genotype=g.id WHERE g.bits=?1 AND d.job=?2 LIMIT 1";
  sqlite3_stmt *row;
  const int error = mo_sql_row(writer, &row, sql, mo_blob(bits, MO_BITS_BYTES), mo_int(id));
  return error == MO_OK ? mo_column_double(row, 0, score) : error;
}

/* Checks that no body gets a second score from the client that differs from its first one. */
static int check_scores(struct mo_connection *writer, struct tell_arguments *call)
{
  const struct mo_study_batch *batch = &call->telling->batch;
  struct told_score *told = calloc((size_t)batch->n_children + 1, sizeof(*told));
  int error = told == NULL ? MO_ERR_NO_MEMORY : MO_OK;
  for (uint32_t i = 0; i < batch->n_children && error == MO_OK; i++) {
    double before;
    told[i].i = i;
    mo_encode_genotype(batch->children[i].genotype.words, told[i].bits);
    error = find_score(writer, call->checkpoint.id, told[i].bits, &before);
    if (error == MO_OK && before != batch->scores[i])
      error = refuse_score(call, i, before);
    else if (error == MO_ERR_NOT_FOUND)
      error = MO_OK;
  }
  if (error == MO_OK)
    qsort(told, batch->n_children, sizeof(*told), by_bits);
  for (uint32_t k = 1; k < batch->n_children && error == MO_OK; k++) {
    const uint32_t first = told[k - 1].i, other = told[k].i;
    if (memcmp(told[k - 1].bits, told[k].bits, sizeof(told->bits)) == 0 &&
        batch->scores[first] != batch->scores[other])
      error = refuse_score(call, other, batch->scores[first]);
  }
  free(told);
  return error;
}

static int check_batch(struct mo_connection *writer, struct tell_arguments *call)
{
  const struct mo_study_batch *batch = &call->telling->batch;
  const struct mo_campaign_head *head = &call->head;
  if ((uint64_t)batch->n_children + batch->n_survivors > head->population)
    return refuse(call, MO_TELLING_MANY, head->population, MO_ERR_RANGE);
  if (batch->number > MO_GENERATIONS_MAX ||
      head->n_designs + batch->n_children > MO_CAMPAIGN_DESIGNS_MAX)
    return refuse(call, MO_TELLING_DESIGNS, 0, MO_ERR_LIMIT);
  for (uint32_t i = 0; i < batch->n_children; i++)
    for (int p = 0; p < 2; p++) {
      const uint32_t parent = batch->children[i].descent.parents[p];
      if (parent != MO_NO_PARENT && parent >= head->n_designs)
        return refuse(call, MO_TELLING_PARENT, batch->children[i].place, MO_ERR_RANGE);
    }
  const int error = batch->scores != NULL ? check_scores(writer, call) : MO_OK;
  return error == MO_OK && batch->selects ? check_survivors(writer, call) : error;
}

/* Finds the indices of the batch's words, and adds new words. */
static int place_words(struct mo_connection *writer, struct tell_arguments *call,
                       struct places *places)
{
  const struct mo_study_words *words = &call->telling->words;
  const int64_t id = call->checkpoint.id;
  struct mo_study_words known;
  int64_t place = mo_study_words_get(writer, id, &known);
  for (uint32_t i = 0; i < words->n_operators && place >= 0; i++) {
    place = place_word(writer, id, 0, words->operators[i], known.operators, &known.n_operators,
                       MO_STUDY_OPERATORS_MAX);
    places->operators[i] = (uint32_t)place;
  }
  for (uint32_t i = 0; i < words->n_measures && place >= 0; i++) {
    place = place_word(writer, id, 1, words->measures[i], known.measures, &known.n_measures,
                       MO_STUDY_MEASURES_MAX);
    places->measures[i] = (uint32_t)place;
  }
  places->n_measures = known.n_measures;
  return place == MO_ERR_LIMIT ? refuse(call, MO_TELLING_WORDS, 0, MO_ERR_LIMIT)
                               : (int)(place < 0 ? place : MO_OK);
}

static int write_batch(struct mo_connection *writer, struct tell_arguments *call)
{
  static const char sql[] =
      "UPDATE studies SET batch=?2,sha256=?3,children=?4,survivors=?5 WHERE job=?1";
  static const char campaign_sql[] = "UPDATE campaigns SET generations=?2 WHERE job=?1";
  static const char job_sql[] = "UPDATE jobs SET " MO_NEXT_VERSION " WHERE id=?1";
  static const char notes_sql[] = "DELETE FROM design_notes WHERE job=?1";
  const struct mo_study_batch *batch = &call->telling->batch;
  const struct mo_value id = mo_int(call->checkpoint.id), number = mo_int(batch->number);
  const char nothing = 0;
  struct places places = {.n_measures = 0};
  uint8_t *children = NULL;
  size_t size = 0;
  int error = place_words(writer, call, &places);
  if (error == MO_OK && (children = encode(call->checkpoint.id, batch, &places, &size)) == NULL)
    error = MO_ERR_NO_MEMORY;
  if (error == MO_OK)
    error = mo_sql_do(
        writer, sql, id, number, mo_hash(&call->telling->sha256), mo_blob(children, size),
        batch->selects ? mo_blob(batch->n_survivors > 0 ? (const void *)batch->survivors : &nothing,
                                 batch->n_survivors * sizeof(*batch->survivors))
                       : mo_null());
  if (error == MO_OK)
    error = mo_sql_do(writer, campaign_sql, id, number);
  if (error == MO_OK)
    error = mo_sql_do(writer, job_sql, id);
  if (error == MO_OK)
    error = mo_sql_do(writer, notes_sql, id);
  if (error == MO_OK)
    error =
        mo_notes_insert(writer, call->checkpoint.id, call->telling->notes, call->telling->n_notes);
  free(children);
  return error;
}

static int tell(struct mo_store *store, void *arguments)
{
  struct tell_arguments *call = arguments;
  struct mo_connection *writer = &store->writer;
  int error = check_turn(writer, call);
  call->checkpoint.dropped.n = 0;
  if (error == MO_OK)
    error = check_batch(writer, call);
  if (error == MO_OK)
    error = write_batch(writer, call);
  return error == MO_OK && call->telling->sampler != NULL
             ? mo_checkpoint_row_write(store, &call->checkpoint)
             : error;
}

int mo_store_study_tell(struct mo_store *store, int64_t id, const struct mo_study_telling *telling,
                        struct mo_telling_reply *reply)
{
  struct tell_arguments call = {.checkpoint = {.id = id,
                                               .kind = MO_JOB_CAMPAIGN,
                                               .place = {telling->batch.number, 0},
                                               .size = telling->sampler_size,
                                               .check = check_file},
                                .telling = telling,
                                .reply = reply};
  const int error = mo_checkpoint_write(store, telling->sampler, &call.checkpoint, tell, &call);
  return error == MO_ERR_DUPLICATE ? MO_OK : error;
}

/* ---- the end ---- */

struct finish_arguments {
  int64_t id;
  enum mo_job_state before;
};

static int finish(struct mo_store *store, void *arguments)
{
  static const char sql[] = "UPDATE jobs SET " MO_NEXT_VERSION
                            ",state=3,finished_us=?2 WHERE id=?1 AND state IN(0,2) AND EXISTS("
                            "SELECT 1 FROM studies s JOIN campaigns m ON m.job=s.job"
                            " WHERE s.job=?1 AND s.batch<=m.generation)";
  static const char end_sql[] = "UPDATE campaigns SET ended=?2 WHERE job=?1";
  struct finish_arguments *call = arguments;
  struct mo_connection *writer = &store->writer;
  enum mo_job_kind kind;
  int error = mo_job_state_get(writer, call->id, &call->before, &kind);
  if (error != MO_OK || call->before == MO_JOB_SUCCEEDED)
    return error;
  error = mo_sql_change(writer, sql, mo_int(call->id), mo_int(mo_clock_wall_us()));
  if (error == MO_OK)
    error = mo_sql_do(writer, end_sql, mo_int(call->id), mo_int(MO_CAMPAIGN_COMPLETED));
  return error == MO_OK ? mo_run_announce(store, call->id, kind, "job.finished", MO_JOB_SUCCEEDED,
                                          ",\"end\":\"completed\"")
                        : error;
}

int mo_store_study_finish(struct mo_store *store, int64_t id, enum mo_job_state *before)
{
  struct finish_arguments call = {.id = id};
  const int error = mo_write(store, finish, &call);
  if (error == MO_OK)
    *before = call.before;
  return error;
}
