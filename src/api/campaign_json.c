/* campaign_json.c: see campaign_json.h. */
#include "api/campaign_json.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

#include "api/columns.h"
#include "api/job_json.h"
#include "store/fields.h"

enum mo_job_state mo_campaign_state_shown(const struct mo_campaign_status *status,
                                          const struct mo_live *live)
{
  bool waits = status->job.state == MO_JOB_RUNNING && live->phase == MO_PHASE_WAIT;
  return waits ? MO_JOB_PAUSED : status->job.state;
}

static void write_reason(struct mo_text *text, const struct mo_campaign_status *status,
                         const struct mo_live *live)
{
  if (live->reason[0] != '\0' && !mo_job_state_is_final(status->job.state))
    mo_text_member(text, "reason", live->reason);
  else if (mo_job_lacks_device(&status->job))
    mo_text_member(text, "reason", status->job.error_text);
  else
    mo_text_add(text, ",\"reason\":null");
}

/* Writes the name that the resulting controller has or will have. */
static void write_name(struct mo_text *text, const struct mo_campaign_status *status)
{
  char made[40];
  snprintf(made, sizeof(made), "campaign-%lld", (long long)status->job.id);
  if (status->record.settings.mode == MO_ZERO_SHOT)
    mo_text_add(text, ",\"name\":null");
  else
    mo_text_member(text, "name", status->record.name[0] != '\0' ? status->record.name : made);
}

/* ---- settings ---- */

static void write_environments(struct mo_text *text, const struct mo_campaign_record *record)
{
  if (record->environment_set[0] != '\0')
    mo_text_member(text, "environments", record->environment_set);
  else
    mo_text_format(text, ",\"environments\":{\"count\":%u}", record->n_environments);
}

static void write_initial(struct mo_text *text, const struct mo_campaign_record *record)
{
  if (record->initial_campaign > 0)
    mo_text_format(text, ",\"initial\":{\"campaign\":\"%lld\"}",
                   (long long)record->initial_campaign);
  else if (record->n_listed > 0)
    mo_text_format(text, ",\"initial\":{\"n_designs\":%u}", record->n_listed);
  else
    mo_text_add(text, ",\"initial\":\"random\"");
}

static void write_settings(struct mo_text *text, const struct mo_campaign_record *record)
{
  struct mo_campaign_record shown = *record; /* with values in place of null */
  struct mo_campaign_settings *settings = &shown.settings;
  if (settings->mutation_rate == 0)
    settings->mutation_rate = 1.0 / mo_workspace_voxels(settings->workspace);
  if (settings->batch == 0)
    settings->batch = settings->population;
  if (record->has_controller)
    settings->sensor = (enum mo_sensor) - 1; /* null: that of the controller */
  mo_text_add(text, ",\"settings\":{");
  mo_fields_write(text, &mo_campaign_record_fields, &shown);
  write_environments(text, record);
  write_initial(text, record);
  mo_text_add(text, ",\"learning\":");
  if (settings->mode == MO_ZERO_SHOT)
    mo_text_add(text, "null");
  else
    mo_fields_write_object(text, &mo_campaign_record_learning_fields, &shown);
  mo_text_add(text, "}");
}

/* ---- the campaign ---- */

static void write_progress(struct mo_text *text, const struct mo_campaign_status *status,
                           const struct mo_live *live)
{
  bool runs = live->phase != MO_PHASE_IDLE;
  if (status->generation >= 0)
    mo_text_format(text, ",\"progress\":{\"generation\":%lld", (long long)status->generation);
  else
    mo_text_add(text, ",\"progress\":{\"generation\":null");
  mo_text_member_count(text, "generations", status->record.settings.generations);
  if (runs)
    mo_text_member_count(text, "under_way", live->position);
  else
    mo_text_add(text, ",\"under_way\":null");
  mo_text_member_count(text, "done", runs ? live->done : 0);
  mo_text_member_count(text, "total", runs ? live->total : 0);
  mo_text_member_count(text, "designs", status->n_designs);
  mo_text_member_number(text, "rollouts_per_s", runs && live->rate > 0 ? live->rate : (double)NAN);
  mo_text_member_number(text, "seconds_left",
                        runs && live->seconds_left >= 0 ? live->seconds_left : (double)NAN);
  mo_text_member_number(text, "busy_s", runs && live->busy_s >= 0 ? live->busy_s : (double)NAN);
  mo_text_add(text, "}");
}

static void write_end(struct mo_text *text, enum mo_campaign_end end)
{
  if (end == MO_CAMPAIGN_COMPLETED)
    mo_text_member(text, "end", "completed");
  else if (end == MO_CAMPAIGN_EXHAUSTED)
    mo_text_member(text, "end", "exhausted");
  else
    mo_text_add(text, ",\"end\":null");
}

static void write_result(struct mo_text *text, const struct mo_campaign_status *status)
{
  char made[40];
  snprintf(made, sizeof(made), "campaign-%lld", (long long)status->job.id);
  if (!status->has_result) {
    mo_text_add(text, ",\"result\":null");
    return;
  }
  mo_text_add(text, ",\"result\":{\"controller\":");
  mo_reference_write(text, status->record.name[0] != '\0' ? status->record.name : made,
                     &status->result_sha256);
  mo_text_add(text, "}");
}

static void write_links(struct mo_text *text, long long id)
{
  static const char *const below[] = {"generations", "learning",    "population", "phylogeny",
                                      "champions",   "checkpoints", "replicates"};
  mo_text_format(text, ",\"links\":{\"job\":\"/v1/jobs/%lld\",\"events\":\"/v1/events?job=%lld\"",
                 id, id);
  for (size_t i = 0; i < sizeof(below) / sizeof(below[0]); i++)
    mo_text_format(text, ",\"%s\":\"/v1/campaigns/%lld/%s\"", below[i], id, below[i]);
  mo_text_add(text, "}");
}

void mo_campaign_json_write(struct mo_text *text, const struct mo_campaign_status *status,
                            const struct mo_live *live)
{
  const struct mo_campaign_record *record = &status->record;
  mo_text_format(text, "{\"id\":\"%lld\",\"mode\":\"%s\"", (long long)status->job.id,
                 mo_campaign_mode_name(record->settings.mode));
  if (record->preset[0] != '\0')
    mo_text_member(text, "preset", record->preset);
  else
    mo_text_add(text, ",\"preset\":null");
  write_name(text, status);
  mo_job_write_common(text, &status->job, mo_campaign_state_shown(status, live));
  write_reason(text, status, live);
  mo_text_member(text, "phase", mo_phase_name(live->phase));
  mo_text_add(text, ",\"controller\":");
  if (record->has_controller)
    mo_reference_write(text, record->controller_name, &record->controller_sha256);
  else
    mo_text_add(text, "null");
  write_settings(text, record);
  mo_text_format(text, ",\"group\":{\"id\":\"%lld\",\"replicate\":%u,\"replicates\":%u}",
                 (long long)record->group, record->replicate, record->replicates);
  write_progress(text, status, live);
  write_end(text, status->end);
  mo_text_add(text, ",\"newest\":");
  if (status->generation >= 0)
    mo_columns_json(text, &mo_generation_columns, &status->last);
  else
    mo_text_add(text, "null");
  write_result(text, status);
  write_links(text, (long long)status->job.id);
  mo_text_add(text, "}");
}

void mo_campaign_json_checkpoint(struct mo_text *text, const struct mo_checkpoint_row *row)
{
  mo_text_format(text, "{\"generation\":%u,\"step\":%u,\"sha256\":", row->generation, row->step);
  mo_hash_write(text, &row->sha256);
  mo_text_member_count(text, "size", row->size);
  mo_text_member_time(text, "stored_at", row->stored_us);
  mo_text_add(text, "}");
}

void mo_campaign_json_job(struct mo_text *text, const struct mo_campaign_status *status,
                          const struct mo_live *live)
{
  mo_text_format(text, "{\"id\":\"%lld\"", (long long)status->job.id);
  mo_text_member(text, "kind", mo_job_kind_name(status->job.kind));
  mo_job_write_common(text, &status->job, mo_campaign_state_shown(status, live));
  write_reason(text, status, live);
  mo_text_format(text, ",\"campaign\":{\"mode\":\"%s\"",
                 mo_campaign_mode_name(status->record.settings.mode));
  mo_text_member_count(text, "population", status->record.settings.population);
  if (status->generation >= 0)
    mo_text_member_count(text, "generation", (uint64_t)status->generation);
  else
    mo_text_add(text, ",\"generation\":null");
  mo_text_member_count(text, "generations", status->record.settings.generations);
  mo_text_add(text, "}}");
}

/* ---- designs ---- */

static void write_parents(struct mo_text *text, const struct mo_descent *descent)
{
  for (int i = 0, n = 0; i < 2; i++)
    if (descent->parents[i] != MO_NO_PARENT)
      mo_text_format(text, n++ > 0 ? ",%u" : "%u", descent->parents[i]);
}

void mo_campaign_json_life(struct mo_text *text, const struct mo_campaign_design *row)
{
  mo_text_add(text, ",\"parents\":[");
  write_parents(text, &row->descent);
  mo_text_format(text, "],\"operator\":\"%s\",\"born\":%u,\"died\":",
                 mo_operator_name((enum mo_operator)row->descent.op), row->born);
  if (row->died >= 0)
    mo_text_json_integer(text, row->died);
  else
    mo_text_add(text, "null");
  mo_text_member_number(text, "score", row->score);
}

void mo_campaign_json_design(struct mo_text *text, const struct mo_campaign_design *row)
{
  mo_text_format(text, "\"number\":%u,\"id\":", row->number);
  mo_bits_write_id(text, &row->form);
  mo_text_add(text, ",\"genotype\":");
  mo_bits_write(text, &row->genotype);
  mo_campaign_json_life(text, row);
  mo_text_format(text, ",\"voxels\":%u,\"footprint\":%u,\"masses\":%u,\"springs\":%u",
                 row->size.voxels, row->size.footprint, row->size.masses, row->size.springs);
}

const char mo_campaign_csv_designs[] = "id,ancestor_list,origin_time,destruction_time,operator,"
                                       "score,design,genotype,voxels,footprint,masses,springs\n";

void mo_campaign_csv_design(struct mo_text *text, const struct mo_campaign_design *row, int64_t end)
{
  bool root = row->descent.parents[0] == MO_NO_PARENT && row->descent.parents[1] == MO_NO_PARENT;
  mo_text_format(text, "%u,\"[", row->number);
  write_parents(text, &row->descent);
  mo_text_format(text, root ? "none]\",%u," : "]\",%u,", row->born);
  if (row->died >= 0 && row->died <= end)
    mo_text_json_integer(text, row->died);
  else
    mo_text_add(text, "inf");
  mo_text_format(text, ",%s", mo_operator_name((enum mo_operator)row->descent.op));
  mo_text_add(text, ",");
  if (isfinite(row->score))
    mo_text_json_number(text, row->score);
  mo_text_add(text, ",d"); /* letters, because programs that read tables take 8e00… for a number */
  mo_bits_write_id_bare(text, &row->form);
  mo_text_add(text, ",g");
  mo_bits_write_bare(text, &row->genotype);
  mo_text_format(text, ",%u,%u,%u,%u\n", row->size.voxels, row->size.footprint, row->size.masses,
                 row->size.springs);
}
