/* designs.c: designs and their scores. */
#include <inttypes.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "api/handlers.h"
#include "api/job_json.h"
#include "api/requests.h"

#define CAMPAIGNS_MAX 100

/* Opens the object and writes the members that every representation of a design has. May fail with
 * MO_ERR_NO_MEMORY. */
static int write_head(struct mo_api *api, struct mo_text *text, const struct mo_genotype *form,
                      int64_t first_seen_us)
{
  struct mo_design_size size = {0};
  const int error = mo_design_size(api->lattice, form->words, &size);
  mo_text_object(text);
  mo_member_form(text, "id", form);
  mo_text_member_count(text, "voxels", size.voxels);
  mo_text_member_count(text, "masses", size.masses);
  mo_text_member_count(text, "springs", size.springs);
  mo_member_genotype(text, "genotype", form);
  mo_text_member_time(text, "first_seen_at", first_seen_us);
  return error;
}

/* Returns whether some losses of the set are unknown, for example because the design was cut
 * short. */
static bool is_partial(const struct mo_design_score *score)
{
  bool is_finite = true, is_whole = true;
  for (uint32_t k = 0; k < score->n_losses; k++) {
    is_finite = is_finite && !isinf(score->losses[k]);
    is_whole = is_whole && !isnan(score->losses[k]);
  }
  return is_finite && !is_whole;
}

static void write_score(struct mo_text *text, const struct mo_design_score *score)
{
  mo_text_object(text);
  mo_member_hash(text, "controller", &score->controller_sha256);
  if (score->environment_set[0] != '\0') {
    mo_text_member(text, "environments", score->environment_set);
  } else {
    mo_text_format(text, ",\"environments\":[\"%s\"]", MO_SHA256_HEX(&score->environment_sha256));
  }
  mo_member_hash(text, "physics", &score->physics_sha256);
  mo_text_member(text, "precision", score->precision == MO_FLOAT64 ? "float64" : "float32");
  mo_text_member_number(text, "score", mo_race_score(score->losses, score->n_losses));
  mo_text_member_bool(text, "lower_bound", is_partial(score));
  mo_member_numbers(text, "losses", score->losses, score->n_losses);
  mo_text_member_time(text, "computed_at", score->computed_us);
  mo_text_member(text, "fingerprint", score->fingerprint);
  mo_text_member(text, "origin", score->origin);
  mo_text_add(text, "}");
}

/* Writes the campaigns in which the design was born. Its lineage differs between campaigns. */
static int write_campaigns(struct mo_store *store, struct mo_text *text,
                           const struct mo_genotype *form)
{
  struct mo_campaign_place *places = malloc(CAMPAIGNS_MAX * sizeof(*places));
  int64_t n = places != NULL ? mo_store_campaigns_of_design(store, form, 0, places, CAMPAIGNS_MAX)
                             : MO_ERR_NO_MEMORY;
  int code = n < 0 ? (int)n : MO_OK;
  mo_text_add(text, ",\"campaigns\":[");
  for (int64_t i = 0; i < n && code == MO_OK; i++) {
    struct mo_campaign_design row;
    struct mo_campaign_status status;
    code = mo_store_campaign_designs_of(store, places[i].campaign, &places[i].number, 1, &row);
    if (code == MO_OK)
      code = mo_store_campaign(store, places[i].campaign, &status);
    if (code != MO_OK)
      break;
    mo_text_object(text);
    mo_text_member_id(text, "campaign", places[i].campaign);
    mo_text_member_count(text, "number", places[i].number);
    mo_campaign_json_life(text, &row);
    mo_member_own_score(text, &status.record.own_score);
    mo_text_add(text, "}");
  }
  mo_text_add(text, "]");
  free(places);
  return code;
}

/* Writes the newest certificate of a robot under a controller; NULL: under any. */
static int write_certificate(struct mo_store *store, struct mo_text *text,
                             const struct mo_sha256 *controller, const struct mo_genotype *genotype)
{
  struct mo_certified certified = {.id = 0};
  const int error = mo_store_certified(store, controller, genotype, &certified);
  mo_member_certificate(text, &certified);
  return error;
}

static int write_design(struct mo_api *api, struct mo_text *text, const struct mo_design *design)
{
  int error = write_head(api, text, &design->form, design->first_seen_us);
  mo_text_open(text, "orientations", "[");
  for (uint32_t i = 0; i < design->n_orientations; i++) {
    const struct mo_design_orientation *orientation = &design->orientations[i];
    mo_text_object(text);
    mo_member_robot(text, &orientation->genotype);
    mo_member_genotype(text, "genotype", &orientation->genotype);
    if (error == MO_OK)
      error = write_certificate(api->store, text, NULL, &orientation->genotype);
    mo_text_open(text, "scores", "[");
    for (uint32_t k = 0; k < orientation->n_scores; k++)
      write_score(text, &orientation->scores[k]);
    mo_text_add(text, "]}");
  }
  mo_text_add(text, "]");
  mo_text_member_bool(text, "truncated", design->truncated);
  if (error == MO_OK)
    error = write_campaigns(api->store, text, &design->form);
  mo_text_add(text, "}");
  return error;
}

void mo_api_get_design(struct mo_request *request)
{
  struct mo_api *api = mo_api_of(request);
  const char *id = request->parameters[0];
  struct mo_design *design = NULL;
  struct mo_text text = {0};
  struct mo_genotype genotype = {.workspace = api->lattice->workspace};
  int orientation;
  if (mo_robot_read(id, strlen(id), &genotype, &orientation) != MO_OK) {
    mo_reply_problem(request, 404, NULL,
                     "There is no design \"%s\": an id must have the %d hexadecimal digits of a "
                     "canonical form, optionally with an orientation, @0 to @7.",
                     MO_SHOWN(id), MO_DEFAULT_ID_DIGITS);
    return;
  }
  const struct mo_genotype form = mo_genotype_form(&genotype);
  int error = mo_store_design(api->store, &form, &design);
  if (error == MO_OK)
    error = write_design(api, &text, design);
  mo_design_free(design);
  mo_reply_text(request, error, &text, "design");
}

/* Reads the cursor: a row for sort=id, or the bits of the score and a row for sort=score. */
static bool read_cursor(const char *text, struct mo_design_query *query)
{
  if (query->sort == MO_DESIGNS_BY_ID)
    return mo_id(text, &query->after_row);
  char digits[17] = "";
  size_t n = strspn(text, "0123456789abcdef");
  if (n != 16 || text[16] != '-' || !mo_id(text + 17, &query->after_row))
    return false;
  memcpy(digits, text, 16);
  uint64_t bits = strtoull(digits, NULL, 16);
  memcpy(&query->after_score, &bits, sizeof(bits));
  return !isnan(query->after_score) && !signbit(query->after_score);
}

static void write_page(struct mo_request *request, const struct mo_design_query *query,
                       const struct mo_design_row *rows, size_t n, size_t limit)
{
  struct mo_text text = {0};
  int error = MO_OK;
  mo_text_add(&text, "{\"items\":[");
  for (size_t i = 0; i < n && error == MO_OK; i++) {
    error = write_head(mo_api_of(request), &text, &rows[i].form, rows[i].first_seen_us);
    if (query->sort == MO_DESIGNS_BY_SCORE) {
      mo_text_member_number(&text, "score", rows[i].score);
      mo_member_robot(&text, &rows[i].genotype);
      mo_member_genotype(&text, "scored_genotype", &rows[i].genotype);
      if (error == MO_OK)
        error = write_certificate(mo_api_of(request)->store, &text, &query->controller_sha256,
                                  &rows[i].genotype);
    }
    mo_text_add(&text, "}");
  }
  mo_text_add(&text, "]");
  if (n < limit || n == 0) {
    mo_text_member(&text, "next_cursor", NULL);
  } else if (query->sort == MO_DESIGNS_BY_ID) {
    mo_text_member_id(&text, "next_cursor", rows[n - 1].row);
  } else {
    uint64_t bits;
    memcpy(&bits, &rows[n - 1].score, sizeof(bits));
    mo_text_format(&text, ",\"next_cursor\":\"%016" PRIx64 "-%" PRId64 "\"", bits,
                   rows[n - 1].genotype_row);
  }
  mo_text_add(&text, "}");
  mo_reply_text(request, error, &text, "page");
}

bool mo_query_class(struct mo_request *request, const char **class)
{
  const char *text = mo_query(request, "class");
  bool is_good = text == NULL || (text[0] != '\0' && strlen(text) < MO_FINGERPRINT_BYTES);
  for (const char *c = text; c != NULL && *c != '\0'; c++)
    is_good = is_good && *c >= ' ' && *c <= '~';
  if (!is_good)
    mo_reply_bad_parameter(request, "class", "must be a fingerprint, as shown with scores");
  *class = text;
  return is_good;
}

/* Returns the class to rank by default: the class of the devices, which compute large batches, or
 * the class of the workers if there are no devices. */
static const char *own_class(const struct mo_compute *compute)
{
  return mo_compute_devices(compute) > 0 ? mo_compute_device_fingerprint(compute)
                                         : mo_compute_fingerprint(compute, MO_FLOAT32);
}

void mo_api_list_designs(struct mo_request *request)
{
  static const char *const of_score[] = {"controller", "environments", "physics", "class"};
  static const char *const sorts[] = {"id", "score", NULL},
                           *const orders[] = {"ascending", "descending", NULL},
                           *const kinds[] = {"default", "paper", NULL};
  const char *cursor = mo_query(request, "cursor"), *named = mo_query(request, "controller");
  const char *class = NULL;
  struct mo_store *store = mo_api_of(request)->store;
  struct mo_design_query query = {.physics = mo_default_physics(), .precision = MO_FLOAT32};
  size_t limit;
  int sort = MO_DESIGNS_BY_ID, set = 0, order = 0, kind = 0;
  if (!mo_query_limit(request, &limit) || !mo_query_word(request, "sort", sorts, &sort) ||
      !mo_query_word(request, "order", orders, &order))
    return;
  query.sort = (enum mo_design_sort)sort;
  query.is_descending = order == 1;
  for (size_t i = 0; i < sizeof(of_score) / sizeof(of_score[0]); i++)
    if (mo_query(request, of_score[i]) != NULL && query.sort != MO_DESIGNS_BY_SCORE) {
      mo_reply_bad_parameter(request, of_score[i], "only sort=score supports this parameter");
      return;
    }
  if (!mo_query_word(request, "environments", mo_set_words, &set) ||
      !mo_query_word(request, "physics", kinds, &kind))
    return;
  if (kind == 1)
    query.physics = mo_paper_physics();
  if (!mo_query_class(request, &class))
    return;
  if (cursor != NULL && !read_cursor(cursor, &query)) {
    mo_reply_bad_parameter(
        request, "cursor",
        "must be the next_cursor of an earlier page with the same sort and order");
    return;
  }
  if (query.sort == MO_DESIGNS_BY_SCORE) {
    struct mo_controller_record controller;
    const char *name = named != NULL ? named : "default";
    const int error = mo_store_controller(store, name, &controller);
    if (error == MO_ERR_NOT_FOUND)
      mo_reply_missing(request, "controller", name);
    else if (error != MO_OK)
      mo_reply_error(request, error, "controller");
    if (error != MO_OK)
      return;
    query.controller_sha256 = controller.sha256;
    /* If the period is not a multiple of the default step, nothing can have been scored. */
    (void)mo_physics_complete(&query.physics, controller.control_period_s);
    snprintf(query.environment_set, sizeof(query.environment_set), "%s", mo_set_words[set]);
    snprintf(query.fingerprint, sizeof(query.fingerprint), "%s",
             class != NULL ? class : own_class(mo_api_of(request)->compute));
  }
  struct mo_design_row *rows = malloc(limit * sizeof(*rows));
  int64_t n = rows != NULL ? mo_store_designs(store, &query, rows, limit) : MO_ERR_NO_MEMORY;
  if (n < 0)
    mo_reply_error(request, (int)n, "page");
  else
    write_page(request, &query, rows, (size_t)n, limit);
  free(rows);
}
