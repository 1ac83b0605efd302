/* campaign_json.c: see campaign_json.h. */
#include "api/campaign_json.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

#include "api/columns.h"
#include "api/job_json.h"
#include "store/fields.h"

/* ---- settings ---- */

static void write_initial(struct mo_text *text, const struct mo_campaign_record *record)
{
  if (record->initial_campaign > 0)
    mo_text_format(text, ",\"initial\":{\"campaign\":\"%lld\"}",
                   (long long)record->initial_campaign);
  else if (record->n_listed > 0)
    mo_text_format(text, ",\"initial\":{\"n_designs\":%u}", record->n_listed);
  else
    mo_text_member(text, "initial", "random");
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
  mo_member_environments(text, record->environment_set, record->n_environments);
  write_initial(text, record);
  mo_text_name(text, "learning");
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
  mo_text_format(text, ",\"progress\":{\"generations\":%u", status->record.settings.generations);
  mo_member_count_if(text, "generation", status->generation >= 0, (uint64_t)status->generation);
  mo_member_count_if(text, "under_way", runs, live->position);
  mo_text_member_count(text, "done", runs ? live->done : 0);
  mo_text_member_count(text, "total", runs ? live->total : 0);
  mo_text_member_count(text, "designs", status->n_designs);
  mo_member_number_if(text, "rollouts_per_s", runs && live->rate > 0, live->rate);
  mo_member_number_if(text, "seconds_left", runs && live->seconds_left >= 0, live->seconds_left);
  mo_member_number_if(text, "busy_s", runs && live->busy_s >= 0, live->busy_s);
  mo_text_add(text, "}");
}

void mo_campaign_json_write(struct mo_text *text, const struct mo_campaign_status *status,
                            const struct mo_live *live)
{
  static const char *const ends[] = {[MO_CAMPAIGN_OPEN] = NULL,
                                     [MO_CAMPAIGN_COMPLETED] = "completed",
                                     [MO_CAMPAIGN_EXHAUSTED] = "exhausted"};
  static const char *const below[] = {"generations", "generations", "learning",    "learning",
                                      "population",  "population",  "phylogeny",   "phylogeny",
                                      "champions",   "champions",   "checkpoints", "checkpoints",
                                      "replicates",  "replicates",  NULL};
  const struct mo_campaign_record *record = &status->record;
  char made[MO_MADE_BYTES];
  const char *name = mo_result_name(&status->job, record->name, made);
  mo_text_object(text);
  mo_text_member_id(text, "id", status->job.id);
  mo_text_member(text, "mode", mo_campaign_mode_name(record->settings.mode));
  mo_text_member(text, "preset", record->preset[0] != '\0' ? record->preset : NULL);
  mo_text_member(text, "name", record->settings.mode != MO_ZERO_SHOT ? name : NULL);
  mo_job_write_head(text, &status->job, live);
  mo_text_member(text, "phase", mo_phase_name(live->phase));
  mo_member_controller(text, "controller", record->has_controller, record->controller_name,
                       &record->controller_sha256);
  write_settings(text, record);
  mo_text_format(text, ",\"group\":{\"id\":\"%lld\",\"replicate\":%u,\"replicates\":%u}",
                 (long long)record->group, record->replicate, record->replicates);
  write_progress(text, status, live);
  mo_text_member(text, "end", ends[status->end]);
  mo_text_name(text, "newest");
  mo_columns_json(text, &mo_generation_columns, status->generation >= 0 ? &status->last : NULL);
  if (status->has_result) {
    mo_text_add(text, ",\"result\":{");
    mo_member_controller(text, "controller", true, name, &status->result_sha256);
    mo_text_add(text, "}");
  } else {
    mo_text_member(text, "result", NULL);
  }
  mo_links_write(text, &status->job, below);
  mo_text_add(text, "}");
}

void mo_campaign_json_job(struct mo_text *text, const void *any, const struct mo_live *live)
{
  const struct mo_campaign_status *status = any;
  mo_text_object(text);
  mo_text_member_id(text, "id", status->job.id);
  mo_text_member(text, "kind", mo_job_kind_name(status->job.kind));
  mo_job_write_head(text, &status->job, live);
  mo_text_format(text, ",\"campaign\":{\"mode\":\"%s\"",
                 mo_campaign_mode_name(status->record.settings.mode));
  mo_text_member_count(text, "population", status->record.settings.population);
  mo_member_count_if(text, "generation", status->generation >= 0, (uint64_t)status->generation);
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
  mo_text_add(text, "]");
  mo_text_member(text, "operator", mo_operator_name((enum mo_operator)row->descent.op));
  mo_text_member_count(text, "born", row->born);
  mo_member_count_if(text, "died", row->died >= 0, (uint64_t)row->died);
  mo_text_member_number(text, "score", row->score);
}

void mo_campaign_json_design(struct mo_text *text, const struct mo_campaign_design *row)
{
  mo_text_member_count(text, "number", row->number);
  mo_member_form(text, "id", &row->form);
  mo_member_bits(text, "genotype", &row->genotype);
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
    mo_text_format(text, "%lld", (long long)row->died);
  else
    mo_text_add(text, "inf");
  mo_text_format(text, ",%s,", mo_operator_name((enum mo_operator)row->descent.op));
  if (isfinite(row->score))
    mo_text_json_number(text, row->score);
  mo_text_add(text, ",d"); /* letters, because programs that read tables take 8e00… for a number */
  mo_bits_write_id(text, &row->form);
  mo_text_add(text, ",g");
  mo_bits_write(text, &row->genotype);
  mo_text_format(text, ",%u,%u,%u,%u\n", row->size.voxels, row->size.footprint, row->size.masses,
                 row->size.springs);
}
