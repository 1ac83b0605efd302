/* phylogeny.c: the designs of a campaign: its populations, each design with its lineage, the
 * whole phylogeny. */
#include <inttypes.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "api/job_json.h"
#include "api/jobs.h"
#include "api/scene.h"
#include "api/tables.h"
#include "base/words.h"
#include "http/download.h"
#include "store/studies.h"

/* Cursors have at most as many digits as the contract allows. A cursor beyond the last design marks
 * the end. */
#define POPULATION_CURSOR_MAX 999999

static const char newick_type[] = "text/x-nh; charset=utf-8";

/* ---- one design as CSV ---- */

static const char csv_heading[] =
    "id,ancestor_list,origin_time,destruction_time,operator,"
    "score,design,robot,genotype,voxels,footprint,masses,springs,lower_bound,held_out_mean,"
    "held_out_low,held_out_high,certificate,certificate_class";

void mo_campaign_csv_design(struct mo_text *text, const struct mo_campaign_design *row, int64_t end,
                            const struct mo_phylogeny_shape *shape)
{
  struct mo_descent descent = row->descent;
  if (shape->first_parent)
    descent.parents[1] = MO_NO_PARENT;
  const bool orphan = descent.parents[0] == MO_NO_PARENT && descent.parents[1] == MO_NO_PARENT;
  mo_text_format(text, "%u,\"[", row->number);
  mo_parents_write(text, &descent);
  if (orphan && shape->root >= 0)
    mo_text_format(text, "%lld", (long long)shape->root);
  else if (orphan)
    mo_text_add(text, "none");
  mo_text_format(text, "]\",%u,", row->born);
  if (row->died >= 0 && row->died <= end)
    mo_text_format(text, "%lld", (long long)row->died);
  else
    mo_text_add(text, "inf");
  mo_text_format(text, ",%s,", mo_campaign_operator(row));
  if (isfinite(row->score))
    mo_text_json_number(text, row->score);
  /* Preceded by letters, because programs that read tables mistake 8e00… for a number. */
  mo_text_add(text, ",d");
  mo_form_write(text, &row->form);
  mo_text_add(text, ",");
  mo_robot_write(text, &row->genotype);
  mo_text_add(text, ",g");
  mo_genotype_write(text, &row->genotype);
  mo_text_format(text, ",%u,%u,%u,%u,%d", row->size.voxels, row->size.footprint, row->size.masses,
                 row->size.springs, row->is_cut);
  const struct mo_interval interval = mo_held_out_interval(&row->held_out);
  const double held_out[3] = {row->held_out.worlds > 0 ? row->held_out.mean : (double)NAN,
                              interval.lo, interval.hi};
  for (int i = 0; i < 3; i++) {
    mo_text_add(text, ",");
    if (isfinite(held_out[i]))
      mo_text_json_number(text, held_out[i]);
  }
  mo_text_add(text, ",");
  if (row->certified.id > 0)
    mo_text_format(text, "%lld", (long long)row->certified.id);
  mo_text_format(text, ",%s",
                 row->certified.id > 0 && row->certified.verdict >= 0
                     ? mo_word(mo_verdict_words, (unsigned)row->certified.verdict)
                     : "");
  for (uint32_t m = 0; m < shape->n_measures; m++) {
    mo_text_add(text, ",");
    if (m < row->n_measures && isfinite(row->measures[m]))
      mo_text_json_number(text, row->measures[m]);
  }
  mo_text_add(text, "\n");
}

/* ---- shared by the routes ---- */

static void write_rows(struct mo_text *text, const struct mo_campaign_design *rows, size_t n,
                       const struct mo_study_words *words)
{
  mo_text_open(text, "items", "[");
  for (size_t i = 0; i < n; i++) {
    mo_text_object(text);
    mo_campaign_json_design(text, &rows[i], words);
    mo_text_add(text, "}");
  }
  mo_text_add(text, "]");
}

/* ---- populations ---- */

/* Reads the cursor "G-N": N designs of generation G have been sent. */
static bool read_population_cursor(const char *text, int64_t *generation, int64_t *offset)
{
  size_t n = strcspn(text, "-");
  return text[n] == '-' && mo_decimal(text, n, 0, POPULATION_CURSOR_MAX, generation) &&
         mo_decimal(text + n + 1, strlen(text + n + 1), 0, POPULATION_CURSOR_MAX, offset);
}

void mo_api_get_campaign_population(struct mo_request *request)
{
  struct mo_store *store = mo_api_of(request)->store;
  const char *cursor = mo_query(request, "cursor");
  int64_t id, generation = -1, asked, offset = 0;
  size_t limit;
  if (!mo_query_number(request, "generation", 0, MO_GENERATIONS_MAX, &generation) ||
      !mo_query_limit(request, &limit) || !mo_path_id(request, 0, &id))
    return;
  asked = generation;
  if (cursor != NULL && (!read_population_cursor(cursor, &generation, &offset) ||
                         (asked >= 0 && asked != generation))) {
    mo_reply_bad_parameter(request, "cursor", MO_CURSOR_WORDS);
    return;
  }
  struct mo_campaign_status status;
  struct mo_campaign_design *rows = malloc(limit * sizeof(*rows));
  uint32_t size = 0;
  int64_t n = rows != NULL ? mo_store_campaign(store, id, &status) : MO_ERR_NO_MEMORY;
  const bool known = n == MO_OK;
  if (known && generation < 0)
    generation = status.generation; /* later pages stay in this generation, even if the next one is
                                     * committed in between */
  if (known)
    n = generation >= 0 ? mo_store_campaign_population(store, id, generation, (uint32_t)offset,
                                                       rows, limit, &size)
                        : MO_ERR_NOT_FOUND;
  if (n == MO_ERR_NOT_FOUND && known && generation < 0) {
    mo_reply_problem(
        request, 404, NULL,
        "The campaign has no population yet, because its first population has not been scored.");
  } else if (n == MO_ERR_NOT_FOUND && known) {
    mo_reply_problem(request, 404, NULL, "The campaign has no generation %lld; the newest is %lld.",
                     (long long)generation, (long long)status.generation);
  } else {
    struct mo_text text = {0};
    mo_text_format(&text, "{\"generation\":%lld,\"size\":%u", (long long)generation, size);
    mo_member_own_score(&text, &status.record.own_score);
    mo_member_fresh_worlds(&text, &status.record);
    write_rows(&text, rows, n > 0 ? (size_t)n : 0, &status.words);
    offset += n;
    if (offset < size)
      mo_text_format(&text, ",\"next_cursor\":\"%lld-%lld\"}", (long long)generation,
                     (long long)offset);
    else
      mo_text_add(&text, ",\"next_cursor\":null}");
    mo_reply_text(request, n < 0 ? (int)n : MO_OK, &text, "campaign");
  }
  free(rows);
}

/* ---- one design and its lineage ---- */

/* The descents of a campaign, and the number of one design, both from the path. Free `descents` in
 * every case. */
struct lineage {
  int64_t id;
  uint32_t number, n;
  struct mo_descent *descents;
  struct mo_study_words words;
};

/* Reads the lineage. Returns false if it has replied. */
static bool read_lineage(struct mo_request *request, struct lineage *lineage)
{
  const char *text = request->parameters[1];
  int64_t number = -1;
  *lineage = (struct lineage){0};
  if (!mo_path_job(request, &lineage->id))
    return false;
  if ((text[0] == '0' && text[1] != '\0') ||
      !mo_decimal(text, strlen(text), 0, UINT32_MAX - 1, &number)) {
    mo_reply_problem(
        request, 404, NULL,
        "There is no design \"%s\": give its number in the campaign, in decimal digits.",
        MO_SHOWN(text));
    return false;
  }
  int code = mo_store_campaign_descents(mo_api_of(request)->store, lineage->id, &lineage->descents,
                                        NULL, &lineage->n);
  if (code == MO_OK)
    code = mo_store_study_words(mo_api_of(request)->store, lineage->id, &lineage->words);
  if (code != MO_OK)
    mo_reply_error(request, code, "campaign");
  else if (lineage->n == 0)
    mo_reply_problem(request, 404, NULL, "The campaign has no designs yet.");
  else if (number >= lineage->n)
    mo_reply_problem(request, 404, NULL,
                     "There is no design \"%s\": the campaign has designs 0 to %u.", MO_SHOWN(text),
                     lineage->n - 1);
  lineage->number = (uint32_t)number;
  return code == MO_OK && number < lineage->n;
}

/* Writes the page of marked designs after `after`: adds "items" and "next_cursor" to `text`. */
static int write_marked(struct mo_request *request, const struct lineage *lineage,
                        const uint8_t *marks, int64_t after, size_t limit, struct mo_text *text)
{
  uint32_t *numbers = malloc(limit * sizeof(*numbers));
  struct mo_campaign_design *rows = calloc(limit, sizeof(*rows));
  size_t n = 0;
  bool more = false;
  int code = numbers != NULL && rows != NULL ? MO_OK : MO_ERR_NO_MEMORY;
  for (int64_t i = after + 1; i < lineage->n && code == MO_OK && !more; i++) {
    if (!marks[i])
      continue;
    more = n == limit;
    if (!more)
      numbers[n++] = (uint32_t)i;
  }
  if (code == MO_OK && n > 0)
    code = mo_store_campaign_designs_of(mo_api_of(request)->store, lineage->id, numbers, n, rows);
  if (code == MO_OK) {
    write_rows(text, rows, n, &lineage->words);
    mo_text_member_id(text, "next_cursor", more ? (int64_t)numbers[n - 1] : -1);
  }
  free(numbers);
  free(rows);
  return code;
}

static void finish(struct mo_request *request, int code, struct mo_text *text)
{
  mo_text_add(text, "}");
  mo_reply_text(request, code, text, "campaign");
}

/* Reads the requested page, and the lineage. marks: malloc (lineage->n). Returns false if it has
 * replied. Free `marks` and the descents in every case. */
static bool read_relatives(struct mo_request *request, struct lineage *lineage, int64_t *after,
                           size_t *limit, uint8_t **marks)
{
  if (!mo_query_limit(request, limit) || !mo_query_cursor(request, after) ||
      !read_lineage(request, lineage))
    return false;
  *marks = calloc(lineage->n, 1);
  if (*marks == NULL)
    mo_reply_error(request, MO_ERR_NO_MEMORY, "campaign");
  return *marks != NULL;
}

void mo_api_get_campaign_design(struct mo_request *request)
{
  struct lineage lineage = {0};
  struct mo_campaign_design row;
  struct mo_text text = {0};
  uint8_t *marks = NULL;
  int64_t after;
  size_t limit;
  if (read_relatives(request, &lineage, &after, &limit, &marks)) {
    int code = mo_store_campaign_designs_of(mo_api_of(request)->store, lineage.id, &lineage.number,
                                            1, &row);
    for (uint32_t i = lineage.number + 1; i < lineage.n && code == MO_OK; i++) {
      const uint32_t *parents = lineage.descents[i].parents;
      marks[i] = parents[0] == lineage.number || parents[1] == lineage.number;
    }
    if (code == MO_OK) {
      mo_text_object(&text);
      mo_text_member_id(&text, "campaign", lineage.id);
      mo_campaign_json_design(&text, &row, &lineage.words);
      mo_text_add(&text, ",\"children\":{");
      code = write_marked(request, &lineage, marks, after, limit, &text);
      mo_text_add(&text, "}");
    }
    finish(request, code, &text);
  }
  free(marks);
  free(lineage.descents);
}

/* Replies with ancestors or descendants, depending on the last part of the route. */
void mo_api_get_campaign_relatives(struct mo_request *request)
{
  const bool up = strstr(request->route->path, "/ancestors") != NULL;
  struct lineage lineage = {0};
  struct mo_text text = {0};
  uint8_t *marks = NULL;
  uint64_t total = 0;
  int64_t after;
  size_t limit;
  if (read_relatives(request, &lineage, &after, &limit, &marks)) {
    (up ? mo_ancestors : mo_descendants)(lineage.descents, lineage.n, lineage.number, marks);
    for (uint32_t i = 0; i < lineage.n; i++)
      total += marks[i];
    mo_text_object(&text);
    mo_text_member_count(&text, "total", total);
    finish(request, write_marked(request, &lineage, marks, after, limit, &text), &text);
  }
  free(marks);
  free(lineage.descents);
}

/* ---- the whole phylogeny ---- */

static void reply_page(struct mo_request *request, const struct mo_campaign_status *status,
                       int64_t after, size_t limit)
{
  const int64_t id = status->job.id;
  struct mo_campaign_design *rows = malloc(limit * sizeof(*rows));
  int64_t n = rows != NULL
                  ? mo_store_campaign_designs(mo_api_of(request)->store, id, after, rows, limit)
                  : MO_ERR_NO_MEMORY;
  struct mo_text text = {0};
  mo_text_add(&text, "{");
  write_rows(&text, rows, n > 0 ? (size_t)n : 0, &status->words);
  mo_member_own_score(&text, &status->record.own_score);
  mo_text_member_id(&text, "next_cursor",
                    n > 0 && (size_t)n == limit ? (int64_t)rows[n - 1].number : -1);
  finish(request, n < 0 ? (int)n : MO_OK, &text);
  free(rows);
}

/* Writes the designs that existed when the reply began, as CSV lines. */
struct lines {
  struct mo_store *store;
  struct mo_phylogeny_shape shape;
  int64_t id, after, newest; /* newest: the last generation of the reply */
  uint64_t left;
  bool headed;
  struct mo_study_words words;
};

static int more_lines(void *context, struct mo_text *text)
{
  struct lines *lines = context;
  size_t limit = lines->left < MO_PAGE_MAX ? (size_t)lines->left : MO_PAGE_MAX;
  if (!lines->headed) {
    mo_text_add(text, csv_heading);
    for (uint32_t m = 0; m < lines->words.n_measures; m++)
      mo_text_format(text, ",measures.%s", lines->words.measures[m]);
    mo_text_add(text, "\n");
  }
  if (!lines->headed && lines->shape.root >= 0) {
    mo_text_format(text, "%lld,\"[none]\",0,inf,root,,,,,,,,,,,,,,", (long long)lines->shape.root);
    for (uint32_t m = 0; m < lines->words.n_measures; m++)
      mo_text_add(text, ",");
    mo_text_add(text, "\n");
  }
  lines->headed = true;
  if (limit == 0)
    return 0;
  struct mo_campaign_design *rows = malloc(limit * sizeof(*rows));
  int64_t n = rows != NULL
                  ? mo_store_campaign_designs(lines->store, lines->id, lines->after, rows, limit)
                  : MO_ERR_NO_MEMORY;
  for (int64_t i = 0; i < n; i++) {
    mo_campaign_csv_design(text, &rows[i], lines->newest, &lines->shape);
    lines->after = rows[i].number;
  }
  free(rows);
  if (n <= 0)
    return n < 0 ? (int)n : MO_ERR_CORRUPT; /* there are fewer designs than the campaign's count */
  lines->left -= (uint64_t)n;
  return lines->left > 0;
}

static void reply_csv(struct mo_request *request, const struct mo_campaign_status *status,
                      const struct mo_phylogeny_shape *shape, const char *tag)
{
  struct lines *lines = malloc(sizeof(*lines));
  if (lines == NULL) {
    mo_reply_error(request, MO_ERR_NO_MEMORY, "reply");
    return;
  }
  *lines = (struct lines){.store = mo_api_of(request)->store,
                          .shape = *shape,
                          .id = status->job.id,
                          .after = -1,
                          .newest = status->generation,
                          .left = status->n_designs,
                          .words = status->words};
  mo_download_open(request, "text/csv; charset=utf-8; header=present", tag, sizeof(*lines),
                   more_lines, lines, free);
}

/* Writes the Newick text of the designs. */
struct tree {
  struct mo_descent *descents;
  uint32_t *born;
  struct mo_newick *newick;
};

static int more_tree(void *context, struct mo_text *text)
{
  struct tree *tree = context;
  char piece[64 * 1024];
  size_t size;
  const bool more = mo_newick_next(tree->newick, piece, sizeof(piece), &size);
  mo_text_bytes(text, piece, size);
  return more;
}

static void free_tree(void *context)
{
  struct tree *tree = context;
  mo_newick_free(tree->newick);
  free(tree->descents);
  free(tree->born);
  free(tree);
}

static void reply_newick(struct mo_request *request, const struct mo_campaign_status *status,
                         const char *tag)
{
  uint32_t n = 0;
  struct tree *tree = calloc(1, sizeof(*tree));
  if (tree == NULL) {
    mo_reply_error(request, MO_ERR_NO_MEMORY, "campaign");
    return;
  }
  int code = mo_store_campaign_descents(mo_api_of(request)->store, status->job.id, &tree->descents,
                                        &tree->born, &n);
  if (n > status->n_designs)
    n = (uint32_t)status->n_designs; /* only designs that the tag covers */
  if (code == MO_OK)
    code = mo_newick_create(tree->descents, tree->born, n, &tree->newick);
  if (code != MO_OK) {
    free_tree(tree);
    mo_reply_error(request, code, "campaign");
    return;
  }
  mo_download_open(request, newick_type, tag, n * (sizeof(*tree->descents) + 3 * sizeof(uint32_t)),
                   more_tree, tree, free_tree);
}

enum form { JSON, CSV, NEWICK, COLUMNS, NDJSON };

/* The parameters of a query, except the format. */
struct wanted {
  int64_t since; /* columns: they begin after this number */
  int lineages;  /* columns: 1: only the living and their ancestors */
  int parents;   /* CSV: 1: only the first parent of each design */
  int64_t root;  /* CSV: 1: with a root that all designs descend from */
};

/* Reads the parameters that only some formats support. Returns false if it has replied. */
static bool read_wanted(struct mo_request *request, int form, struct wanted *wanted)
{
  static const struct {
    const char *name, *words;
    unsigned forms; /* formats that support it */
  } own[] = {{"limit", "only JSON supports this parameter, because the other formats are complete",
              1U << JSON},
             {"cursor", "only JSON supports this parameter, because the other formats are complete",
              1U << JSON},
             {"keep", "only format=columns supports this parameter", 1U << COLUMNS},
             {"after", "only format=columns supports this parameter", 1U << COLUMNS},
             {"parents", "only format=csv supports this parameter", 1U << CSV},
             {"root", "only format=csv supports this parameter", 1U << CSV}};
  static const char *const keeps[] = {"all", "lineages", NULL}, *const all[] = {"all", "first",
                                                                                NULL};
  for (size_t i = 0; i < sizeof(own) / sizeof(own[0]); i++)
    if (!(own[i].forms >> form & 1) && mo_query(request, own[i].name) != NULL) {
      mo_reply_bad_parameter(request, own[i].name, own[i].words);
      return false;
    }
  *wanted = (struct wanted){.since = -1};
  return mo_query_word(request, "keep", keeps, &wanted->lineages) &&
         mo_query_number(request, "after", 0, MO_CURSOR_MAX, &wanted->since) &&
         mo_query_word(request, "parents", all, &wanted->parents) &&
         mo_query_number(request, "root", 0, 1, &wanted->root);
}

void mo_api_get_campaign_phylogeny(struct mo_request *request)
{
  static const char *const forms[] = {"json", "csv", "newick", "columns", "ndjson", NULL};
  static const char *const types[] = {
      "application/json", "text/csv", "text/x-nh", MO_SCENE_TYPE, "application/x-ndjson", NULL};
  struct mo_store *store = mo_api_of(request)->store;
  struct mo_campaign_status status;
  struct wanted wanted;
  int64_t id, after;
  size_t limit;
  int form;
  char tag[112];
  if (!mo_query_form(request, forms, types, &form) || !mo_query_limit(request, &limit) ||
      !mo_query_cursor(request, &after) || !mo_path_id(request, 0, &id) ||
      !read_wanted(request, form, &wanted))
    return;
  if (form == NDJSON) {
    mo_table_reply(request, MO_FORM_NDJSON, mo_api_get_campaign_phylogeny, "", NULL);
    return;
  }
  int code = mo_store_campaign(store, id, &status);
  if (code != MO_OK) {
    mo_reply_error(request, code, "campaign");
    return;
  }
  if (form == JSON) {
    reply_page(request, &status, after, limit);
    return;
  }
  snprintf(tag, sizeof(tag), "%" PRIx64 "-phylogeny-4-%s-%lld-%lld-%llu-%u-%d-%d-%d-%lld",
           mo_store_history(store), forms[form], (long long)id, (long long)status.generation,
           (unsigned long long)status.n_designs, (unsigned)status.words.n_measures, wanted.lineages,
           wanted.parents, (int)wanted.root, (long long)wanted.since);
  mo_reply_static(request, 200, types[form], "", 0);
  request->reply.packs = true;
  mo_reply_etag(request, "%s", tag);
  if (request->reply.status == 304)
    return; /* the tag answers the request before anything is read */
  if (form == COLUMNS) {
    mo_api_reply_columns(request, &status, wanted.since, wanted.lineages == 1, tag);
  } else if (form == NEWICK) {
    reply_newick(request, &status, tag);
  } else {
    const struct mo_phylogeny_shape shape = {wanted.parents == 1,
                                             wanted.root == 1 ? (int64_t)status.n_designs : -1,
                                             status.words.n_measures};
    reply_csv(request, &status, &shape, tag);
  }
}
