/* job_json.c: see job_json.h. */
#include "api/job_json.h"
#include "rollout/physics.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

void mo_bits_write_bare(struct mo_text *text, const struct mo_bits *bits)
{
  char digits[MO_DEFAULT_VOXELS + 1];
  mo_genotype_to_text(MO_DEFAULT_WORKSPACE, bits->words, digits);
  mo_text_bytes(text, digits, MO_DEFAULT_VOXELS);
}

void mo_bits_write(struct mo_text *text, const struct mo_bits *bits)
{
  mo_text_bytes(text, "\"", 1);
  mo_bits_write_bare(text, bits);
  mo_text_bytes(text, "\"", 1);
}

void mo_bits_write_id_bare(struct mo_text *text, const struct mo_bits *form)
{
  char id[MO_DEFAULT_ID_DIGITS + 1];
  mo_genotype_id(MO_DEFAULT_WORKSPACE, form->words, id);
  mo_text_bytes(text, id, MO_DEFAULT_ID_DIGITS);
}

void mo_bits_write_id(struct mo_text *text, const struct mo_bits *form)
{
  mo_text_bytes(text, "\"", 1);
  mo_bits_write_id_bare(text, form);
  mo_text_bytes(text, "\"", 1);
}

void mo_hash_write(struct mo_text *text, const struct mo_sha256 *hash)
{
  mo_text_bytes(text, "\"", 1);
  mo_text_hex(text, hash->bytes, sizeof(hash->bytes));
  mo_text_bytes(text, "\"", 1);
}

void mo_controller_write(struct mo_text *text, const char *name, const struct mo_sha256 *sha256)
{
  mo_text_add(text, "{\"name\":");
  if (name[0] != '\0')
    mo_text_json_string(text, name, strlen(name));
  else
    mo_text_add(text, "null");
  mo_text_add(text, ",\"sha256\":");
  mo_hash_write(text, sha256);
  mo_text_add(text, "}");
}

void mo_reference_write(struct mo_text *text, const char *member, bool known, const char *name,
                        const struct mo_sha256 *sha256)
{
  mo_text_format(text, ",\"%s\":", member);
  if (known)
    mo_controller_write(text, name, sha256);
  else
    mo_text_add(text, "null");
}

void mo_loss_write(struct mo_text *text, double loss)
{
  mo_text_json_number(text, loss); /* null when diverged */
}

static void write_losses(struct mo_text *text, const char *name, const double *losses, uint32_t n)
{
  mo_text_format(text, ",\"%s\":[", name);
  for (uint32_t k = 0; k < n; k++) {
    if (k > 0)
      mo_text_bytes(text, ",", 1);
    mo_loss_write(text, losses[k]);
  }
  mo_text_bytes(text, "]", 1);
}

static void write_results(struct mo_text *text, const struct mo_evaluation_results *results)
{
  uint32_t columns = results->n_environments;
  mo_text_add(text, ",\"results\":[");
  for (uint32_t d = 0; d < results->n_designs; d++) {
    const int32_t *steps = &results->diverged_steps[(size_t)d * columns];
    mo_text_add(text, d > 0 ? ",{\"id\":" : "{\"id\":");
    mo_bits_write_id(text, &results->forms[d]);
    mo_text_add(text, ",\"genotype\":");
    mo_bits_write(text, &results->genotypes[d]);
    mo_text_add(text, ",\"score\":");
    mo_loss_write(text, results->scores[d]);
    write_losses(text, "losses", &results->losses[(size_t)d * columns], columns);
    mo_text_add(text, ",\"diverged\":[");
    bool first = true;
    for (uint32_t k = 0; k < columns; k++)
      if (steps[k] != 0) {
        mo_text_format(text, "%s{\"environment\":%u,\"step\":%d}", first ? "" : ",", k,
                       (int)steps[k]);
        first = false;
      }
    mo_text_bytes(text, "]", 1);
    if (results->stored_losses != NULL) {
      const double *stored = &results->stored_losses[(size_t)d * columns];
      bool any = false;
      for (uint32_t k = 0; k < columns; k++)
        any |= !isnan(stored[k]);
      write_losses(text, "stored_losses", stored, columns);
      mo_text_format(text, ",\"agrees\":%s", !any ? "null" : results->agrees[d] ? "true" : "false");
    }
    mo_text_bytes(text, "}", 1);
  }
  mo_text_bytes(text, "]", 1);
}

/* Says whether a job is paused because no device is available to compute it. */
static bool lacks_device(const struct mo_job *job)
{
  return job->state == MO_JOB_PAUSED && job->error == MO_ERR_DEVICE;
}

enum mo_job_state mo_job_state_shown(const struct mo_job *job, const struct mo_live *live)
{
  bool waits = job->state == MO_JOB_RUNNING && live->phase == MO_PHASE_WAIT;
  return waits ? MO_JOB_PAUSED : job->state;
}

void mo_member_text(struct mo_text *text, const char *name, const char *words)
{
  if (words != NULL)
    mo_text_member(text, name, words);
  else
    mo_text_format(text, ",\"%s\":null", name);
}

void mo_member_count_if(struct mo_text *text, const char *name, bool known, uint64_t count)
{
  if (known)
    mo_text_member_count(text, name, count);
  else
    mo_member_text(text, name, NULL);
}

void mo_member_number_if(struct mo_text *text, const char *name, bool known, double number)
{
  mo_text_member_number(text, name, known ? number : (double)NAN);
}

void mo_job_write_head(struct mo_text *text, const struct mo_job *job, const struct mo_live *live)
{
  mo_text_member(text, "state", mo_job_state_name(mo_job_state_shown(job, live)));
  mo_text_member(text, "priority", job->priority == MO_INTERACTIVE ? "interactive" : "batch");
  mo_text_member_number(text, "weight", job->weight);
  mo_text_member(text, "device", job->back_end == MO_ON_DEVICE ? "cuda" : "cpu");
  mo_member_text(text, "label", job->has_label ? job->label : NULL);
  mo_text_member_time(text, "created_at", job->created_us);
  mo_text_member_time(text, "started_at", job->started_us);
  mo_text_member_time(text, "finished_at", job->finished_us);
  mo_text_member_count(text, "attempts", job->attempts);
  if (job->state == MO_JOB_FAILED || lacks_device(job)) {
    mo_text_add(text, ",\"error\":{\"detail\":");
    mo_text_json_string(text, job->error_text, strlen(job->error_text));
    mo_text_member(text, "code", mo_error_name(job->error));
    mo_text_add(text, "}");
  } else {
    mo_text_add(text, ",\"error\":null");
  }
  if (job->kind == MO_JOB_EVALUATION)
    return;
  if (live->reason[0] != '\0' && !mo_job_state_is_final(job->state))
    mo_text_member(text, "reason", live->reason);
  else
    mo_member_text(text, "reason", lacks_device(job) ? job->error_text : NULL);
}

const char *mo_result_name(const struct mo_job *job, const char *asked, char made[MO_MADE_BYTES])
{
  snprintf(made, MO_MADE_BYTES, "%s-%lld", mo_job_kind_name(job->kind), (long long)job->id);
  return asked[0] != '\0' ? asked : made;
}

void mo_links_write(struct mo_text *text, const struct mo_job *job, const char *const *below)
{
  const long long id = (long long)job->id;
  mo_text_format(text, ",\"links\":{\"job\":\"/v1/jobs/%lld\",\"events\":\"/v1/events?job=%lld\"",
                 id, id);
  for (; below[0] != NULL; below += 2)
    mo_text_format(text, ",\"%s\":\"/v1/%ss/%lld/%s\"", below[0], mo_job_kind_name(job->kind), id,
                   below[1]);
  mo_text_add(text, "}");
}

void mo_job_write(struct mo_text *text, const struct mo_job *job,
                  const struct mo_evaluation_results *results)
{
  mo_text_format(text, "{\"id\":\"%lld\"", (long long)job->id);
  mo_text_member(text, "kind", mo_job_kind_name(job->kind));
  mo_job_write_head(text, job, &(struct mo_live){0});
  mo_reference_write(text, "controller", true, job->controller_name, &job->controller_sha256);
  if (job->environment_set[0] != '\0')
    mo_text_member(text, "environments", job->environment_set);
  else
    mo_text_format(text, ",\"environments\":{\"count\":%u}", job->n_environments);
  mo_text_add(text, ",\"physics\":");
  mo_fields_write_object(text, &mo_physics_fields, &job->physics);
  mo_text_member(text, "precision", job->precision == MO_FLOAT64 ? "float64" : "float32");
  mo_text_format(text, ",\"record\":[%s%s%s]", job->record_com ? "\"com\"" : "",
                 job->record_com && job->record_masses ? "," : "",
                 job->record_masses ? "\"masses\"" : "");
  mo_text_member_count(text, "record_stride", job->record_stride > 0 ? job->record_stride : 1);
  mo_text_format(text, ",\"verify\":%s", job->verify ? "true" : "false");
  mo_text_member_count(text, "n_designs", job->n_designs);
  mo_text_member_count(text, "rollouts_total", job->rollouts_total);
  mo_text_member_count(text, "rollouts_done", job->rollouts_done);
  mo_text_member_count(text, "rollouts_cached", job->rollouts_cached);
  mo_text_member_count(text, "rollouts_diverged", job->rollouts_diverged);
  if (results != NULL)
    write_results(text, results);
  mo_text_bytes(text, "}", 1);
}
