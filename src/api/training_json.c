/* training_json.c: see training_json.h. */
#include "api/training_json.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

#include "api/columns.h"
#include "api/job_json.h"
#include "rollout/physics.h"
#include "store/fields.h"

static const char *kind_name(const struct mo_training_status *status)
{
  return status->record.settings.kind == MO_TRAINING_FINETUNE ? "finetune" : "pretrain";
}

/* Returns the steps applied. After a crash, a run that resumed from a checkpoint may be behind the
 * stored curve. A run that is being prepared does not know its step yet. */
static uint32_t step_of(const struct mo_training_status *status, const struct mo_live *live)
{
  if (live->phase == MO_PHASE_IDLE)
    return status->step;
  return live->position > 0 ? live->position : status->checkpoint_step;
}

/* ---- settings ---- */

static void write_settings(struct mo_text *text, const struct mo_training_record *record,
                           enum mo_job_kind population_kind)
{
  struct mo_training_record shown = *record;
  if (record->has_parent)
    shown.settings.sensor = (enum mo_sensor) - 1; /* null: that of the parent */
  mo_text_add(text, ",\"settings\":{");
  mo_fields_write(text, &mo_training_record_fields, &shown);
  mo_member_count_if(text, "n_designs", record->settings.kind == MO_TRAINING_FINETUNE,
                     record->n_designs);
  if (record->population > 0)
    mo_text_format(text, ",\"population\":{\"%s\":\"%lld\"}}", mo_job_kind_name(population_kind),
                   (long long)record->population);
  else
    mo_text_add(text, ",\"population\":null}");
}

/* ---- progress ---- */

static void write_progress(struct mo_text *text, const struct mo_training_status *status,
                           const struct mo_live *live)
{
  const struct mo_training_report *last = &status->last.report;
  bool runs = live->phase != MO_PHASE_IDLE, any = status->step > 0;
  mo_text_format(text, ",\"progress\":{\"step\":%u,\"steps\":%u", step_of(status, live),
                 status->record.settings.n_steps);
  mo_member_number_if(text, "mean_loss", any, last->mean_loss);
  mo_member_number_if(text, "gradient_norm", any, last->gradient_norm);
  mo_member_number_if(text, "rate", any, last->rate);
  mo_member_number_if(text, "clipped_share", any, last->clipped_share);
  mo_member_number_if(text, "clipped_robots_share", any, last->clipped_robots_share);
  mo_text_member_count(text, "diverged", any ? last->diverged : 0);
  mo_text_member_count(text, "zeroed", any ? last->zeroed : 0);
  mo_text_member_bool(text, "skipped", any && last->skipped);
  mo_member_number_if(text, "bodies_per_s", runs && live->rate > 0, live->rate);
  mo_member_number_if(text, "seconds_left", runs && live->seconds_left >= 0, live->seconds_left);
  mo_member_number_if(text, "busy_s", runs && live->busy_s >= 0, live->busy_s);
  mo_text_member_count(text, "replayed", runs ? live->done : 0);
  mo_text_member_count(text, "replay_total", runs ? live->total : 0);
  mo_text_add(text, "}");
}

static void write_code(struct mo_text *text, const struct mo_training_lineage *lineage)
{
  mo_text_add(text, ",\"code\":[");
  for (uint32_t i = 0; i < lineage->n; i++) {
    const struct mo_training_code *code = &lineage->codes[i];
    mo_text_format(text, "%s{\"from_step\":%u,\"fingerprint\":", i > 0 ? "," : "", code->from_step);
    mo_text_json_string(text, code->fingerprint, strlen(code->fingerprint));
    mo_text_add(text, "}");
  }
  mo_text_add(text, "]");
}

void mo_training_json_write(struct mo_text *text, const struct mo_training_status *status,
                            enum mo_job_kind population_kind, const struct mo_live *live)
{
  static const char *const below[] = {"steps",       "steps",       "validations", "validations",
                                      "checkpoints", "checkpoints", "controller",  "controller",
                                      "held_out",    "held-out",    NULL};
  const struct mo_training_record *record = &status->record;
  char made[MO_MADE_BYTES];
  const char *name = mo_result_name(&status->job, record->name, made);
  mo_text_format(text, "{\"id\":\"%lld\"", (long long)status->job.id);
  mo_text_member(text, "kind", kind_name(status));
  mo_text_member(text, "name", name);
  mo_job_write_head(text, &status->job, live);
  mo_text_member(text, "phase", mo_phase_name(live->phase));
  mo_reference_write(text, "parent", record->has_parent, record->parent_name,
                     &record->parent_sha256);
  write_settings(text, record, population_kind);
  write_progress(text, status, live);
  mo_text_add(text, ",\"validation\":");
  if (status->has_validation)
    mo_columns_json(text, &mo_validation_columns, &status->validation);
  else
    mo_text_add(text, "null");
  mo_member_count_if(text, "checkpoint_step", status->checkpoint_step > 0, status->checkpoint_step);
  write_code(text, &status->code);
  mo_reference_write(text, "controller", status->has_result, name, &status->result_sha256);
  mo_links_write(text, &status->job, below);
  mo_text_add(text, "}");
}

void mo_training_json_job(struct mo_text *text, const void *any, const struct mo_live *live)
{
  const struct mo_training_status *status = any;
  char made[MO_MADE_BYTES];
  mo_text_format(text, "{\"id\":\"%lld\"", (long long)status->job.id);
  mo_text_member(text, "kind", mo_job_kind_name(status->job.kind));
  mo_job_write_head(text, &status->job, live);
  mo_text_format(text, ",\"training\":{\"kind\":\"%s\"", kind_name(status));
  mo_text_member(text, "name", mo_result_name(&status->job, status->record.name, made));
  mo_text_format(text, ",\"step\":%u,\"steps\":%u}}", step_of(status, live),
                 status->record.settings.n_steps);
}

/* ---- rows ---- */

void mo_training_json_checkpoint(struct mo_text *text, const struct mo_checkpoint_row *row)
{
  mo_text_format(text, "{\"step\":%u,\"sha256\":", row->step);
  mo_hash_write(text, &row->sha256);
  mo_text_member_count(text, "size", row->size);
  mo_text_member_time(text, "stored_at", row->stored_us);
  mo_text_add(text, "}");
}

/* ---- held-out sets ---- */

void mo_held_out_write(struct mo_text *text, const struct mo_bits *genotypes, uint32_t n_designs,
                       const struct mo_environment *environments, uint32_t n_environments,
                       const struct mo_physics *physics)
{
  mo_text_add(text, "{\"designs\":[");
  for (uint32_t i = 0; i < n_designs; i++) {
    mo_text_add(text, i > 0 ? ",{\"voxels\":" : "{\"voxels\":");
    mo_bits_write(text, &genotypes[i]);
    mo_text_add(text, "}");
  }
  mo_text_add(text, "],\"environments\":[");
  for (uint32_t k = 0; k < n_environments; k++) {
    mo_text_add(text, k > 0 ? ",{\"light_xy_m\":[" : "{\"light_xy_m\":[");
    mo_text_json_number(text, environments[k].light_xy_m[0]);
    mo_text_bytes(text, ",", 1);
    mo_text_json_number(text, environments[k].light_xy_m[1]);
    mo_text_add(text, "],\"terrain_heights_m\":[");
    for (int i = 0; i < MO_TERRAIN_HEIGHTS; i++) {
      if (i > 0)
        mo_text_bytes(text, ",", 1);
      mo_text_json_number(text, environments[k].terrain_heights_m[i]);
    }
    mo_text_add(text, "]}");
  }
  mo_text_add(text, "]");
  if (physics != NULL) {
    mo_text_add(text, ",\"physics\":");
    mo_fields_write_object(text, &mo_physics_fields, physics);
  }
  mo_text_add(text, "}");
}
