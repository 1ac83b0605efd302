/* tables.c: lists and curves in formats other than JSON. The handler of a list makes its pages as
 * JSON. Lines and columns are made from these pages one by one, so that memory for only one page is
 * needed, however many lines there are. See tables.h. */
#include "api/tables.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "api/handlers.h"
#include "api/scene.h"
#include "base/json.h"
#include "http/download.h"

#define COLUMNS_MAX  96
#define COLUMNS_SIZE ((size_t)64 << 20) /* bytes of all columns of a reply */
#define PATH_BYTES   96

/* ---- formats ---- */

static const char *const forms[] = {"json", "csv", "ndjson", "columns", NULL};
static const char *const types[] = {"application/json", "text/csv", "application/x-ndjson",
                                    MO_SCENE_TYPE, NULL};

bool mo_table_form(struct mo_request *request, int *form)
{
  return mo_query_form(request, forms, types, form);
}

/* ---- the columns of a list ---- */

/* The type of the numbers of a column, by the type of a row's column or by the letter in a list of
 * columns. */
static const struct numbers {
  char letter;
  const char *type;
  size_t width;
} numbers[] = {[MO_COLUMN_COUNT] = {'u', "uint32", sizeof(uint32_t)},
               [MO_COLUMN_LONG] = {'l', "uint64", sizeof(uint64_t)},
               [MO_COLUMN_NUMBER] = {'n', "float64", sizeof(double)},
               [MO_COLUMN_FLAG] = {0, "uint8", sizeof(uint8_t)}};
#define NUMBERS (sizeof(numbers) / sizeof(numbers[0]))

struct column {
  const char *path;
  size_t size;
  char name[48];                 /* the path with _ for each dot */
  const char *csv;               /* its name in CSV; NULL: as `name` */
  const struct numbers *numbers; /* NULL: any JSON */
  char letter;                   /* before its values in CSV; 0: none */
  /* Its value in the current row: a range of `cells`. */
  enum mo_json_kind found;
  size_t at, length;
  struct mo_text values; /* for the form `columns`: the values of all rows */
};

struct table {
  struct mo_request *request;
  void (*page)(struct mo_request *request);
  enum mo_form form;
  bool headed, is_limited; /* is_limited: the client set the number of rows */
  bool is_last;            /* no page follows the one in `body` */
  char *body;              /* of a page, malloc; NULL: not read yet */
  size_t size;
  char cursor[256], limit[24];
  uint64_t left; /* rows that may still be added */
  uint32_t n_rows;
  unsigned n;
  struct column columns[COLUMNS_MAX];
  struct mo_text cells;
  struct mo_json json;
};

static struct column *add_column(struct table *table, const char *path, size_t size)
{
  struct column *column = &table->columns[table->n++];
  *column = (struct column){.path = path, .size = size};
  for (size_t i = 0; i < size && i < sizeof(column->name) - 1; i++)
    column->name[i] = (char)(path[i] == '.' ? '_' : path[i]);
  return column;
}

static void read_columns(struct table *table, const char *columns, const struct mo_columns *rows)
{
  while (*columns != '\0' && table->n < COLUMNS_MAX) {
    const size_t size = strcspn(columns, " "), path = strcspn(columns, ": ");
    struct column *column = add_column(table, columns, path);
    const char letter = path < size ? columns[path + 1] : 0;
    for (size_t i = 0; i < NUMBERS && letter != 0; i++)
      if (numbers[i].letter == letter)
        column->numbers = &numbers[i];
    column->letter = column->numbers == NULL ? letter : 0;
    columns += size + (columns[size] == ' ');
  }
  for (size_t i = 0; rows != NULL && i < rows->n && table->n < COLUMNS_MAX; i++) {
    const struct mo_column *row = &rows->items[i];
    struct column *column = add_column(table, row->path, strlen(row->path));
    column->csv = row->csv;
    column->numbers = row->type < NUMBERS ? &numbers[row->type] : NULL;
  }
}

/* ---- pages ---- */

/* Sets a query parameter to a value, which must stay valid. */
static void set(struct mo_query *query, const char *name, const char *value)
{
  unsigned i = 0;
  while (i < query->n && strcmp(query->items[i].name, name) != 0)
    i++;
  if (i == MO_QUERY_MAX)
    return;
  query->n += i == query->n;
  query->items[i].name = name;
  query->items[i].value = value;
}

/* Reads the next page into `body`. A status other than 200 stays as the reply to the request. */
static bool read_page(struct table *table)
{
  struct mo_request *request = table->request;
  const struct mo_reply sent = request->reply;
  request->reply = (struct mo_reply){0};
  set(&request->query, "format", forms[MO_FORM_JSON]);
  if (table->cursor[0] != '\0')
    set(&request->query, "cursor", table->cursor);
  if (table->cursor[0] != '\0' || !table->is_limited) { /* otherwise the handler checks the client's
                                                           limit */
    snprintf(table->limit, sizeof(table->limit), "%u",
             table->left < MO_LIST_MAX ? (unsigned)table->left : MO_LIST_MAX);
    set(&request->query, "limit", table->limit);
  }
  const char *tags = request->framing.if_none_match;
  request->framing.if_none_match = NULL; /* these fields are about the table, not about a page */
  table->page(request);
  request->framing.if_none_match = tags;
  if (request->reply.status != 200 || request->reply.body == NULL)
    return false;
  table->body = request->reply.body;
  table->size = request->reply.size;
  request->reply = sent;
  return true;
}

/* ---- rows ---- */

static bool leads_to(const struct column *column, const char *path, size_t size)
{
  return column->size > size && memcmp(column->path, path, size) == 0 && column->path[size] == '.';
}

/* Keeps the value. For CSV, strings are decoded; anything else is kept as written. */
static void keep(struct table *table, struct column *column)
{
  struct mo_json *json = &table->json;
  struct mo_json_slice value = {0};
  column->found = mo_json_peek(json);
  const size_t from = json->at;
  if (column->found == MO_JSON_STRING && table->form == MO_FORM_CSV) {
    mo_json_string(json, &value);
  } else {
    mo_json_skip(json);
    value = (struct mo_json_slice){json->text + from, json->at - from};
  }
  column->at = table->cells.size;
  column->length = value.size;
  mo_text_bytes(&table->cells, value.bytes, value.size);
  mo_text_bytes(&table->cells, "", 1); /* the end of a number */
}

/* Reads the value at a path, and the values below it that have columns. */
static void read_value(struct table *table, char path[PATH_BYTES], size_t size)
{
  struct mo_json *json = &table->json;
  struct mo_json_slice key;
  bool leads = false;
  for (unsigned i = 0; i < table->n; i++) {
    struct column *column = &table->columns[i];
    if (column->size == size && memcmp(column->path, path, size) == 0) {
      keep(table, column);
      return;
    }
    leads = leads || size == 0 || leads_to(column, path, size);
  }
  const size_t from = size + (size > 0);
  const enum mo_json_kind kind = leads ? mo_json_peek(json) : MO_JSON_NONE;
  if (size > 0)
    path[size] = '.';
  if (kind == MO_JSON_OBJECT && mo_json_object(json)) {
    while (mo_json_member(json, &key)) {
      const bool fits = from + key.size < PATH_BYTES;
      if (fits)
        memcpy(path + from, key.bytes, key.size);
      fits ? read_value(table, path, from + key.size) : mo_json_skip(json);
    }
  } else if (kind == MO_JSON_ARRAY && mo_json_array(json)) {
    for (unsigned i = 0; mo_json_item(json); i++)
      read_value(table, path, from + (size_t)snprintf(path + from, 12, "%u", i));
  } else {
    mo_json_skip(json);
  }
}

static void write_quoted(struct mo_text *text, const char *bytes, size_t size)
{
  mo_text_bytes(text, "\"", 1);
  for (size_t i = 0, n; i < size; i += n) {
    const char *quote = memchr(bytes + i, '"', size - i);
    n = quote != NULL ? (size_t)(quote - bytes) + 1 - i : size - i;
    mo_text_bytes(text, bytes + i, n);
    if (quote != NULL)
      mo_text_bytes(text, "\"", 1);
  }
  mo_text_bytes(text, "\"", 1);
}

/* Appends a text as a CSV cell, in quotes if it needs them. */
static void write_text(struct mo_text *text, const char *bytes, size_t size)
{
  bool plain = size > 0 && bytes[0] != ' ' && bytes[size - 1] != ' ';
  for (size_t i = 0; i < size && plain; i++)
    plain = (unsigned char)bytes[i] >= ' ' && bytes[i] != '"' && bytes[i] != ',';
  if (plain)
    mo_text_bytes(text, bytes, size);
  else
    write_quoted(text, bytes, size);
}

static void write_cell(struct table *table, struct mo_text *text, const struct column *column)
{
  const char *bytes = table->cells.data + column->at;
  const char letter[2] = {column->letter, '\0'};
  switch (column->found) {
  case MO_JSON_NONE:
  case MO_JSON_NULL: break;
  case MO_JSON_TRUE: mo_text_add(text, "1"); break;
  case MO_JSON_FALSE: mo_text_add(text, "0"); break;
  case MO_JSON_NUMBER: mo_text_bytes(text, bytes, column->length); break;
  default: mo_text_add(text, letter); write_text(text, bytes, column->length);
  }
}

static void gather_cell(struct table *table, struct column *column)
{
  const char *bytes = table->cells.data + column->at;
  struct mo_text *values = &column->values;
  if (column->numbers == NULL) {
    const bool is_present = column->found != MO_JSON_NONE;
    mo_text_add(values, values->size > 0 ? "," : "");
    mo_text_bytes(values, is_present ? bytes : "null", is_present ? column->length : 4);
    return;
  }
  const double value = column->found == MO_JSON_NUMBER  ? strtod(bytes, NULL)
                       : column->found == MO_JSON_TRUE  ? 1
                       : column->found == MO_JSON_FALSE ? 0
                                                        : (double)NAN;
  const uint64_t count = (uint64_t)(value >= 0 ? value : 0); /* its first bytes are the number */
  const bool is_whole = column->numbers->type[0] == 'u';
  mo_text_bytes(values, is_whole ? (const void *)&count : (const void *)&value,
                column->numbers->width);
}

static void take_row(struct table *table, struct mo_text *text)
{
  struct mo_json *json = &table->json;
  char path[PATH_BYTES];
  table->n_rows++;
  if (table->form == MO_FORM_NDJSON) {
    mo_json_peek(json);
    const size_t from = json->at;
    mo_json_skip(json);
    mo_text_bytes(text, json->text + from, json->at - from);
    mo_text_add(text, "\n");
    return;
  }
  table->cells.size = 0;
  for (unsigned i = 0; i < table->n; i++)
    table->columns[i].found = MO_JSON_NONE;
  read_value(table, path, 0);
  for (unsigned i = 0; i < table->n; i++)
    if (table->form == MO_FORM_COLUMNS) {
      gather_cell(table, &table->columns[i]);
    } else {
      write_cell(table, text, &table->columns[i]);
      mo_text_add(text, i + 1 < table->n ? "," : "\n");
    }
}

/* Takes the rows of the page in `body`, and its cursor. */
static int take_page(struct table *table, struct mo_text *text)
{
  struct mo_json *json = &table->json;
  struct mo_json_slice key, cursor = {0};
  struct mo_faults faults = {0};
  const uint32_t before = table->n_rows;
  mo_json_start(json, table->body, table->size, &faults);
  if (mo_json_object(json))
    while (mo_json_member(json, &key)) {
      if (mo_json_is(key, "items") && mo_json_array(json))
        while (mo_json_item(json))
          take_row(table, text);
      else if (mo_json_is(key, "next_cursor") && mo_json_peek(json) == MO_JSON_STRING &&
               mo_json_string(json, &cursor))
        snprintf(table->cursor, sizeof(table->cursor), "%.*s", (int)cursor.size, cursor.bytes);
      else if (!mo_json_is(key, "items"))
        mo_json_skip(json);
    }
  const bool good = mo_json_finish(json) && faults.n == 0;
  const uint32_t taken = table->n_rows - before;
  free(table->body);
  table->body = NULL;
  table->left -= taken < table->left ? taken : table->left;
  table->is_last = cursor.size == 0 || table->left == 0;
  return !good ? MO_ERR_CORRUPT : table->cells.failed ? MO_ERR_NO_MEMORY : MO_OK;
}

/* Takes the next page. Returns 1 if there may be more, 0 after the last one, or an error. After
 * MO_ERR_IO the reply gives the reason. */
static int take_next(struct table *table, struct mo_text *text)
{
  if (table->body == NULL && !read_page(table))
    return MO_ERR_IO;
  const int error = take_page(table, text);
  return error != MO_OK ? error : !table->is_last;
}

/* ---- replies ---- */

/* A callback of type mo_download_more. */
static int more_lines(void *context, struct mo_text *text)
{
  struct table *table = context;
  for (unsigned i = 0; i < table->n && table->form == MO_FORM_CSV && !table->headed; i++) {
    const struct column *column = &table->columns[i];
    mo_text_add(text, column->csv != NULL ? column->csv : column->name);
    mo_text_add(text, i + 1 < table->n ? "," : "\n");
  }
  table->headed = true;
  const struct mo_reply sent = table->request->reply;
  const int more = take_next(table, text);
  if (more == MO_ERR_IO) /* the reply breaks off */
    mo_reply_clear(&table->request->reply);
  table->request->reply = sent;
  return more;
}

static void free_table(void *context)
{
  struct table *table = context;
  free(table->body);
  mo_text_free(&table->cells);
  for (unsigned i = 0; i < table->n; i++)
    mo_text_free(&table->columns[i].values);
  free(table);
}

/* Checks that the columns fit in a reply. MO_ERR_LIMIT, MO_ERR_NO_MEMORY. */
static int check_columns(const struct table *table)
{
  size_t size = 0;
  for (unsigned i = 0; i < table->n; i++) {
    size += table->columns[i].values.size;
    if (table->columns[i].values.failed)
      return MO_ERR_NO_MEMORY;
  }
  return size > COLUMNS_SIZE ? MO_ERR_LIMIT : MO_OK;
}

static char *join(struct table *table, size_t *size)
{
  struct mo_text header = {0}, arrays = {0};
  mo_text_object(&header);
  mo_text_member_count(&header, "rows", table->n_rows);
  mo_text_open(&header, "columns", "{");
  for (unsigned i = 0; i < table->n; i++) {
    struct column *column = &table->columns[i];
    if (column->numbers != NULL) {
      mo_scene_write_array(&header, &arrays,
                           &(struct mo_scene_array){column->name,
                                                    column->numbers->type,
                                                    column->values.data,
                                                    column->numbers->width,
                                                    {table->n_rows},
                                                    1});
    } else {
      mo_text_open(&header, column->name, "[");
      mo_text_bytes(&header, column->values.data, column->values.size);
      mo_text_add(&header, "]");
    }
    mo_text_free(&column->values);
  }
  mo_text_add(&header, "}}");
  return mo_scene_join(&header, &arrays, size);
}

static void reply_columns(struct mo_request *request, struct table *table)
{
  int more = 1;
  while (more > 0) {
    more = take_next(table, NULL);
    const int fits = check_columns(table);
    more = more >= 0 && fits != MO_OK ? fits : more;
  }
  size_t size = 0;
  char *joined = more == MO_OK ? join(table, &size) : NULL;
  if (more == MO_ERR_LIMIT) {
    mo_reply_bad_parameter(request, "format",
                           "the columns of this reply would exceed 64 MiB; use csv or ndjson");
  } else if (joined != NULL) {
    mo_reply_bytes(request, 200, MO_SCENE_TYPE, joined, size);
    request->reply.packs = true;
    mo_reply_etag_of_body(request);
  } else if (more != MO_ERR_IO) {
    mo_reply_error(request, more != MO_OK ? more : MO_ERR_NO_MEMORY, "reply");
  }
}

void mo_table_reply(struct mo_request *request, enum mo_form form,
                    void (*page)(struct mo_request *request), const char *columns,
                    const struct mo_columns *rows)
{
  struct table *table = calloc(1, sizeof(*table));
  const char *limit = mo_query(request, "limit");
  if (table == NULL) {
    mo_reply_error(request, MO_ERR_NO_MEMORY, "reply");
    return;
  }
  table->request = request;
  table->page = page;
  table->form = form;
  table->is_limited = limit != NULL;
  table->left = table->is_limited ? strtoull(limit, NULL, 10) : UINT64_MAX;
  request->framing.accept = NULL; /* the field has been read already, and pages are JSON */
  read_columns(table, columns, rows);
  if (!read_page(table)) { /* read_page has replied with the problem */
    free_table(table);
  } else if (form == MO_FORM_COLUMNS) {
    reply_columns(request, table);
    free_table(table);
  } else {
    mo_download_open(request,
                     form == MO_FORM_CSV ? "text/csv; charset=utf-8; header=present" : types[form],
                     NULL, sizeof(*table), more_lines, table, free_table);
  }
}

/* ---- the columns of each list of routes.inc ---- */

#define JOB                                                                                        \
  "state priority weight:n device label experiment note archived_at core_seconds:n"                \
  " device_seconds:n submitted_by created_at started_at finished_at attempts:n error.code"         \
  " error.detail warnings"
#define JOBS                                                                                       \
  "id kind " JOB " controller.name environments n_designs:n rollouts_total:n rollouts_done:n"      \
  " training.kind training.name training.step:n training.steps:n training.score:n campaign.mode"   \
  " campaign.population:n campaign.generation:n campaign.generations:n campaign.seed:n"            \
  " campaign.best_score:n atlas.name atlas.voxels:n atlas.bodies_done:n atlas.bodies_total:n"      \
  " certificate.designs:n certificate.trials_done:n certificate.trials:n"                          \
  " certificate.rollouts_done:n certificate.rollouts:n"
#define EVALUATIONS                                                                                \
  "id " JOB " controller.name controller.sha256 environments precision n_designs:n"                \
  " rollouts_total:n rollouts_done:n rollouts_cached:n rollouts_diverged:n record"                 \
  " recorded_bytes:n verify:n best:n rollouts_cut:n displaced_starts:n tolerance:n"
#define MEASURES                                                                                   \
  " measures.displacement_m:n measures.path_length_m:n measures.mean_speed_m_per_s:n"              \
  " measures.straightness:n measures.heading_error_rad:n measures.sideways_m:n"                    \
  " measures.peak_height_m:n measures.mean_height_m:n measures.tilt_rad:n"                         \
  " measures.yaw_rate_rad_per_s:n measures.air_share:n measures.contact_front_share:n"             \
  " measures.contact_back_share:n measures.contact_left_share:n"                                   \
  " measures.contact_right_share:n measures.hops_per_s:n measures.work_j:n"                        \
  " measures.cost_of_transport:n measures.peak_strain:n measures.inverted_voxels:n flags"
#define TASKS                                                                                      \
  " tasks.photo.loss:n tasks.photo.value:n tasks.photo-auc.loss:n tasks.photo-auc.value:n"         \
  " tasks.walk.loss:n tasks.walk.value:n tasks.rough.loss:n tasks.rough.value:n"                   \
  " tasks.up.loss:n tasks.up.value:n tasks.down.loss:n tasks.down.value:n"                         \
  " tasks.hurdle.loss:n tasks.hurdle.value:n tasks.gap.loss:n tasks.gap.value:n"                   \
  " tasks.circle.loss:n tasks.circle.value:n tasks.shuttle.loss:n tasks.shuttle.value:n"           \
  " tasks.path.loss:n tasks.path.value:n tasks.damage.loss:n tasks.damage.value:n"                 \
  " tasks_mean.loss:n tasks_mean.left_out"
#define RESULTS                                                                                    \
  "number:n id:d robot genotype:g score:n lower_bound:n losses diverged voxels:n footprint:n "     \
  "masses:n"                                                                                       \
  " springs:n path_length_m:n repaired fault orientation error.low:n error.high:n"                 \
  " error.discretization:n error.rounding:n error.standard_error:n error.bifurcates value:n "      \
  "unit" MEASURES                                                                                  \
  " tolerance.asked:n tolerance.reached:n tolerance.estimated_error:n tolerance.bifurcates:n"      \
  " tolerance.dt_s:n tolerance.precision tolerance.rungs" TASKS
#define TRAININGS                                                                                  \
  "id kind name " JOB " phase parent.name parent.sha256 settings.seed:n settings.steps:n"          \
  " settings.batch:n progress.step:n progress.mean_loss:n progress.bodies_per_s:n"                 \
  " validation.step:n validation.mean_score:n controller.sha256"
#define CAMPAIGNS                                                                                  \
  "id mode preset name " JOB " phase controller.name controller.sha256 group.id group.replicate:n" \
  " settings.seed:n settings.population:n settings.generations:n progress.generation:n"            \
  " progress.designs:n newest.score.mean:n newest.score.quantiles.p0:n newest.diversity:n"         \
  " newest.held_out.mean:n newest.held_out.low:n newest.held_out.high:n end"                       \
  " result.controller.sha256"
#define DESIGNS                                                                                    \
  "id:d genotype:g voxels:n masses:n springs:n first_seen_at score:n"                              \
  " robot scored_genotype:g certificate.id certificate.class"
#define BORN                                                                                       \
  "number:n id:d robot genotype:g parents operator born:n died:n score:n voxels:n"                 \
  " footprint:n masses:n springs:n lower_bound:n measures held_out.generation:n"                   \
  " held_out.worlds:n held_out.mean:n held_out.standard_error:n held_out.low:n held_out.high:n"    \
  " held_out.diverged:n certificate.id certificate.class"
#define CHAMPIONS BORN " distinctiveness:n"
#define CONTROLLERS                                                                                \
  "name sha256 bytes:n parameters:n sensor control_period_s:n workspace metadata stored_at"
#define CERTIFICATES                                                                               \
  "id " JOB " certificate.controller.name certificate.controller.sha256 certificate.environments"  \
  " certificate.designs:n certificate.seed:n certificate.axes certificate.top:n"                   \
  " certificate.trials_done:n certificate.trials:n certificate.rollouts_done:n"                    \
  " certificate.rollouts:n"
#define EACH                                                                                       \
  "position:u id:d robot genotype:g voxels:n zero_shot:n finetuned:n gain:n zero_shot_diverged:u"  \
  " finetuned_diverged:u first_loss:n last_loss:n skipped:u controller.name controller.sha256"     \
  " place:n"
#define USAGE                "name jobs:n core_seconds:n device_seconds:n"
#define WORLDS               "sha256 light_xy_m.0:n light_xy_m.1:n terrain_heights_m terrain task"
#define CHECKPOINTS          "step:n sha256 size:n stored_at"
#define CAMPAIGN_CHECKPOINTS "generation:n step:n sha256 size:n stored_at"

static const struct {
  const char *path;
  void (*page)(struct mo_request *request);
  const char *columns;
} lists[] = {
#define ROUTE(PATH, METHOD, HANDLER, RIGHT, FLAGS, BODY, QUERY)
#define TABLE(PATH, HANDLER, QUERY, COLUMNS) {PATH, mo_api_##HANDLER, COLUMNS},
#include "api/routes.inc"
};

void mo_api_get_table(struct mo_request *request)
{
  size_t i = 0;
  int form;
  while (strcmp(lists[i].path, request->route->path) != 0)
    i++;
  if (!mo_table_form(request, &form))
    return;
  if (form == MO_FORM_JSON)
    lists[i].page(request);
  else
    mo_table_reply(request, (enum mo_form)form, lists[i].page, lists[i].columns, NULL);
}
