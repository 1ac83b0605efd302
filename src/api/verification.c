/* verification.c: POST /v1/fleet/verify: what a worker gave, computed again. */
#include <inttypes.h>
#include <stdlib.h>

#include "api/fleet.h"
#include "api/job_json.h"
#include "api/submission.h"

static void write_loss(struct mo_text *text, const char *name, const struct mo_loss_row *row,
                       uint32_t k)
{
  mo_text_open(text, name, "{");
  mo_text_member_number(text, "loss", row->losses[k]);
  mo_text_member_count(text, "diverged_step", row->diverged_steps[k]);
  mo_text_add(text, "}");
}

void mo_json_differences(struct mo_text *text, const struct mo_origin_row *row)
{
  for (uint32_t k = 0; k < row->n; k++) {
    const struct mo_loss_row stored = {{row->stored.losses[k]}, {row->stored.diverged_steps[k]}},
                             again = {{row->again.losses[k]}, {row->again.diverged_steps[k]}};
    if (mo_loss_rows_equal(&stored, &again, 1))
      continue;
    mo_text_object(text);
    mo_member_form(text, "id", &row->form);
    mo_member_bits(text, "genotype", &row->genotype);
    mo_member_hash(text, "controller", &row->controller_sha256);
    mo_member_hash(text, "environment", &row->environment_sha256[k]);
    mo_member_hash(text, "physics", &row->physics_sha256);
    mo_text_member(text, "fingerprint", row->fingerprint);
    mo_text_member_time(text, "computed_at", row->computed_us);
    write_loss(text, "stored", &row->stored, k);
    write_loss(text, "computed", &row->again, k);
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
  struct mo_parsed_verification parsed;
  struct mo_faults faults = {0};
  if (!mo_check_content(request, "application/json", NULL))
    return;
  int error = mo_verification_parse(request->body, request->body_size, &parsed, &faults);
  if (error != MO_OK) {
    mo_reply_parse_error(request, error, &faults, "origin");
    return;
  }
  struct mo_verification verification = {.origin = parsed.origin,
                                         .place = parsed.after,
                                         .limit = parsed.limit,
                                         .repair = parsed.repair};
  error = mo_jobs_verify(mo_api_of(request)->jobs, &verification);
  if (error != MO_OK)
    mo_reply_error(request, error, "origin");
  else
    reply(request, &verification);
  if (error == MO_OK && verification.n > 0)
    mo_request_note(request, "%zu rows of losses of \"%s\" were not what is computed%s",
                    verification.n, parsed.origin, parsed.repair ? ", and are replaced" : "");
  free(verification.rows);
}
