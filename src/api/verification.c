/* verification.c: POST /v1/fleet/verify: recomputes the results of a worker. */
#include <inttypes.h>
#include <stdlib.h>
#include <string.h>

#include "api/fleet.h"
#include "api/job_json.h"
#include "api/submission.h"

/* ---- the request ---- */

#define LIMIT 16 /* number of rows, unless the request specifies it */

struct parsed {
  char origin[MO_ORIGIN_BYTES]; /* NAME@HOST, or a host */
  struct mo_origin_place after;
  uint32_t limit;
  bool repair;
};
_Static_assert(MO_ORIGIN_BYTES == 2 * MO_FLEET_NAME_BYTES + 2, "a name, @, a host");

/* Reads "G-C", the `next` of the previous reply. */
static void read_place(struct mo_json *json, void *value)
{
  const unsigned depth = json->depth;
  struct mo_origin_place place;
  struct mo_json_slice text;
  if (!mo_json_string(json, &text))
    return;
  const char *dash = memchr(text.bytes, '-', text.size);
  const size_t n = dash != NULL ? (size_t)(dash - text.bytes) : 0;
  if (dash != NULL && mo_decimal(text.bytes, n, 1, INT64_MAX, &place.genotype) &&
      mo_decimal(dash + 1, text.size - n - 1, 1, INT64_MAX, &place.condition))
    *(struct mo_origin_place *)value = place;
  else
    mo_json_fault_at(json, depth, "", "must be the `next` of an earlier reply");
}

static const struct mo_field_own origin_place = {.read = read_place};
#define AT(member) offsetof(struct parsed, member)
static const struct mo_field rows[] = {
    {"origin", MO_FIELD_TEXT, 0, AT(origin), .min = 1, .max = MO_ORIGIN_BYTES - 1},
    {"after", MO_FIELD_OWN, 0, AT(after), .own = &origin_place},
    {"limit", MO_FIELD_COUNT, 0, AT(limit), .min = 1, .max = MO_VERIFIED_MAX, .unit = ""},
    {"repair", MO_FIELD_FLAG, 0, AT(repair)},
};
#undef AT
static const struct mo_fields fields = MO_FIELDS(rows);

static int check(struct mo_json *json, void *any)
{
  const struct parsed *parsed = any;
  if (json->faults->n == 0 && parsed->origin[0] == '\0')
    mo_json_fault_at(json, 0, "", "origin is missing; give NAME@HOST, or a host");
  return MO_OK;
}

/* ---- the reply ---- */

/* Writes a row; of its measures, only those that differ. */
static void write_row(struct mo_text *text, const char *name, const struct mo_origin_row *row,
                      uint32_t k, const struct mo_loss_row *losses,
                      const struct mo_measures_row *measures, uint32_t differing)
{
  mo_text_open(text, name, "{");
  if (row->has_losses) {
    mo_text_member_number(text, "loss", losses->losses[k]);
    mo_text_member_count(text, "diverged_step", losses->diverged_steps[k]);
  }
  if (differing != 0)
    mo_text_open(text, "measures", "{");
  for (unsigned m = 0; m < MO_MEASURES; m++)
    if (differing >> m & 1)
      mo_text_member_number(text, mo_measure_info[m].name, measures->values[k][m]);
  mo_text_add(text, differing != 0 ? "}}" : "}");
}

/* Returns the measures of a rollout that differ, as bits. */
static uint32_t differing_measures(const struct mo_origin_row *row, uint32_t k)
{
  uint32_t set = 0;
  for (uint32_t m = 0; row->has_measures && m < row->n_measures; m++)
    if (!mo_measure_equal(row->stored_measures.values[k][m], row->again_measures.values[k][m]))
      set |= UINT32_C(1) << m;
  return set;
}

static bool loss_differs(const struct mo_origin_row *row, uint32_t k)
{
  const struct mo_loss_row stored = {{row->stored.losses[k]}, {row->stored.diverged_steps[k]}},
                           again = {{row->again.losses[k]}, {row->again.diverged_steps[k]}};
  return row->has_losses && !mo_loss_rows_equal(&stored, &again, 1);
}

void mo_json_differences(struct mo_text *text, const struct mo_origin_row *row)
{
  for (uint32_t k = 0; k < row->n; k++) {
    const uint32_t differing = differing_measures(row, k);
    if (differing == 0 && !loss_differs(row, k))
      continue;
    mo_text_object(text);
    mo_member_form(text, "id", &row->form);
    mo_member_robot(text, &row->genotype);
    mo_member_genotype(text, "genotype", &row->genotype);
    mo_member_hash(text, "controller", &row->controller_sha256);
    mo_member_hash(text, "environment", &row->environment_sha256[k]);
    mo_member_hash(text, "physics", &row->physics_sha256);
    mo_text_member(text, "fingerprint", row->fingerprint);
    mo_text_member_time(text, "computed_at", row->computed_us);
    write_row(text, "stored", row, k, &row->stored, &row->stored_measures, differing);
    write_row(text, "computed", row, k, &row->again, &row->again_measures, differing);
    mo_text_add(text, "}");
  }
}

static void reply(struct mo_request *request, const struct mo_verification *done)
{
  struct mo_text text = {0};
  mo_text_object(&text);
  mo_text_member(&text, "origin", done->origin);
  mo_text_member_count(&text, "checked", done->checked);
  mo_text_member_count(&text, "skipped", done->skipped);
  mo_text_member_bool(&text, "repaired", done->repair && done->n > 0);
  mo_text_add(&text, ",\"different\":[");
  for (size_t i = 0; i < done->n; i++)
    mo_json_differences(&text, &done->rows[i]);
  mo_text_add(&text, "]");
  if (done->is_last)
    mo_text_member(&text, "next", NULL);
  else
    mo_text_format(&text, ",\"next\":\"%" PRId64 "-%" PRId64 "\"", done->place.genotype,
                   done->place.condition);
  mo_text_add(&text, "}");
  mo_reply_json(request, 200, &text);
}

void mo_api_verify_origin(struct mo_request *request)
{
  struct parsed parsed = {.limit = LIMIT};
  if (!mo_read_request(request, &fields, &parsed, NULL, check, "origin"))
    return;
  struct mo_verification verification = {.origin = parsed.origin,
                                         .place = parsed.after,
                                         .limit = parsed.limit,
                                         .repair = parsed.repair};
  const int error = mo_jobs_verify(mo_api_of(request)->jobs, &verification);
  if (error == MO_ERR_NOT_FOUND)
    mo_reply_missing(request, "origin", parsed.origin);
  else if (error != MO_OK)
    mo_reply_error(request, error, "origin");
  else
    reply(request, &verification);
  if (error == MO_OK && verification.n > 0)
    mo_request_note(request, "%s of losses or measures from \"%s\" that differ when recomputed%s",
                    MO_COUNTED(verification.n, "row"), parsed.origin,
                    parsed.repair ? ", and were replaced" : "");
  free(verification.rows);
}
