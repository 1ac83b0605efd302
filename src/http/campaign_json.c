/* campaign_json.c: see campaign_json.h. */
#include "http/campaign_json.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

#include "http/job_json.h"
#include "http/learning_json.h"
#include "store/fields.h"

enum mo_job_state mo_campaign_state_shown(const struct mo_campaign_status *status,
                                          const struct mo_campaign_live *live)
{
  bool waits = status->job.state == MO_JOB_RUNNING && live->phase == MO_CAMPAIGN_WAIT;
  return waits ? MO_JOB_PAUSED : status->job.state;
}

static void write_reason(struct mo_text *text, const struct mo_campaign_status *status,
                         const struct mo_campaign_live *live)
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
                           const struct mo_campaign_live *live)
{
  bool runs = live->phase != MO_CAMPAIGN_IDLE;
  if (status->generation >= 0)
    mo_text_format(text, ",\"progress\":{\"generation\":%lld", (long long)status->generation);
  else
    mo_text_add(text, ",\"progress\":{\"generation\":null");
  mo_text_member_count(text, "generations", status->record.settings.generations);
  if (runs)
    mo_text_member_count(text, "under_way", live->generation);
  else
    mo_text_add(text, ",\"under_way\":null");
  mo_text_member_count(text, "done", runs ? live->done : 0);
  mo_text_member_count(text, "total", runs ? live->total : 0);
  mo_text_member_count(text, "designs", status->n_designs);
  mo_text_member_number(text, "rollouts_per_s",
                        runs && live->rollouts_per_s > 0 ? live->rollouts_per_s : (double)NAN);
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
                            const struct mo_campaign_live *live)
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
  mo_text_member(text, "phase", mo_campaign_phase_name(live->phase));
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
    mo_campaign_json_generation(text, &status->last);
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
                          const struct mo_campaign_live *live)
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

/* ---- generations ---- */

static const char *const quantile_names[MO_QUANTILES] = {"p0",  "p5",  "p25", "p50",
                                                         "p75", "p95", "p100"};

static void write_operator(struct mo_text *text, const char *name, uint64_t born, uint64_t survived,
                           uint64_t attempts)
{
  mo_text_format(text, "\"%s\":{\"born\":%llu", name, (unsigned long long)born);
  mo_text_member_count(text, "survived", survived);
  mo_text_member_count(text, "attempts", attempts);
  mo_text_add(text, "}");
}

static void write_spread(struct mo_text *text, const char *name, const struct mo_spread *spread)
{
  mo_text_format(text, ",\"%s\":{\"least\":", name);
  mo_text_json_number(text, spread->least);
  mo_text_member_number(text, "mean", spread->mean);
  mo_text_member_number(text, "most", spread->most);
  mo_text_add(text, "}");
}

void mo_campaign_json_generation(struct mo_text *text, const struct mo_campaign_generation *row)
{
  const struct mo_population_stats *stats = &row->stats;
  mo_text_format(text, "{\"generation\":%u", row->generation);
  mo_text_member_count(text, "population", stats->n);
  mo_text_member_count(text, "born", row->n_children);
  mo_text_member_count(text, "first_number", row->born_before);
  mo_text_add(text, ",\"score\":{\"mean\":");
  mo_text_json_number(text, stats->mean_score);
  mo_text_add(text, ",\"quantiles\":{");
  for (int q = 0; q < MO_QUANTILES; q++) {
    mo_text_format(text, q > 0 ? ",\"%s\":" : "\"%s\":", quantile_names[q]);
    mo_text_json_number(text, stats->quantiles[q]);
  }
  mo_text_format(text, "},\"diverged\":%u}", stats->n_diverged);
  mo_text_member_number(text, "diversity", stats->diversity);
  mo_text_member_count(text, "species", stats->species);
  mo_text_member_number(text, "turnover", row->turnover);
  mo_text_add(text, ",\"operators\":{");
  write_operator(text, "mutation", row->variation.mutants, row->survived_mutants,
                 row->variation.mutation_attempts);
  mo_text_add(text, ",");
  write_operator(text, "crossover", row->variation.recombinants, row->survived_recombinants,
                 row->variation.crossover_attempts);
  mo_text_member_count(text, "fallbacks", row->variation.fallbacks);
  mo_text_add(text, "}");
  write_spread(text, "voxels", &stats->voxels);
  write_spread(text, "footprint", &stats->footprint);
  write_spread(text, "masses", &stats->masses);
  write_spread(text, "springs", &stats->springs);
  mo_text_member_number(text, "parents_mean", row->mean_parents);
  mo_text_member_number(text, "children_mean", row->mean_children);
  mo_text_format(text, ",\"learning\":{\"steps\":%u", row->learning_steps);
  mo_text_member_number(text, "first_loss", row->first_loss);
  mo_text_member_number(text, "last_loss", row->last_loss);
  mo_text_add(text, "}");
  mo_text_member_count(text, "rollouts", row->rollouts);
  mo_text_member_count(text, "cached", row->rollouts_cached);
  mo_text_member_count(text, "rollouts_diverged", row->rollouts_diverged);
  mo_text_member_bool(text, "exhausted", row->variation.exhausted);
  mo_text_member_bool(text, "collapse", row->collapse);
  mo_text_member_number(text, "seconds", row->seconds);
  mo_text_add(text, "}");
}

const char mo_campaign_csv_generations[] =
    "generation,population,born,first_number,mean,p0,p5,p25,p50,p75,p95,p100,diverged,diversity,"
    "species,turnover,"
    "mutation_born,mutation_survived,mutation_attempts,crossover_born,crossover_survived,crossover_"
    "attempts,fallbacks,"
    "voxels_least,voxels_mean,voxels_most,footprint_least,footprint_mean,footprint_most,masses_"
    "least,masses_mean,"
    "masses_most,springs_least,springs_mean,springs_most,parents_mean,children_mean,learning_steps,"
    "first_loss,last_"
    "loss,"
    "rollouts,cached,rollouts_diverged,exhausted,collapse,seconds\n";

static void csv_spread(struct mo_text *text, const struct mo_spread *spread)
{
  mo_csv_number(text, spread->least);
  mo_csv_number(text, spread->mean);
  mo_csv_number(text, spread->most);
}

void mo_campaign_csv_generation(struct mo_text *text, const struct mo_campaign_generation *row)
{
  const struct mo_population_stats *stats = &row->stats;
  const struct mo_variation_counts *variation = &row->variation;
  mo_text_format(text, "%u,%u,%u,%llu", row->generation, stats->n, row->n_children,
                 (unsigned long long)row->born_before);
  mo_csv_number(text, stats->mean_score);
  for (int q = 0; q < MO_QUANTILES; q++)
    mo_csv_number(text, stats->quantiles[q]);
  mo_text_format(text, ",%u", stats->n_diverged);
  mo_csv_number(text, stats->diversity);
  mo_text_format(text, ",%u", stats->species);
  mo_csv_number(text, row->turnover);
  mo_text_format(text, ",%u,%u,%llu,%u,%u,%llu,%u", variation->mutants, row->survived_mutants,
                 (unsigned long long)variation->mutation_attempts, variation->recombinants,
                 row->survived_recombinants, (unsigned long long)variation->crossover_attempts,
                 variation->fallbacks);
  csv_spread(text, &stats->voxels);
  csv_spread(text, &stats->footprint);
  csv_spread(text, &stats->masses);
  csv_spread(text, &stats->springs);
  mo_csv_number(text, row->mean_parents);
  mo_csv_number(text, row->mean_children);
  mo_text_format(text, ",%u", row->learning_steps);
  mo_csv_number(text, row->first_loss);
  mo_csv_number(text, row->last_loss);
  mo_text_format(text, ",%llu,%llu,%llu,%d,%d", (unsigned long long)row->rollouts,
                 (unsigned long long)row->rollouts_cached,
                 (unsigned long long)row->rollouts_diverged, variation->exhausted, row->collapse);
  mo_csv_number(text, row->seconds);
  mo_text_add(text, "\n");
}

/* ---- learning ---- */

void mo_campaign_json_step(struct mo_text *text, const struct mo_campaign_step *row)
{
  mo_text_format(text, "{\"generation\":%u,\"step\":%u,\"on\":\"%s\"", row->generation, row->step,
                 row->on_children ? "children" : "parents");
  mo_report_json(text, &row->report, row->seconds);
  mo_text_add(text, "}");
}

const char mo_campaign_csv_steps[] = "generation,step,on," MO_REPORT_CSV "\n";

void mo_campaign_csv_step(struct mo_text *text, const struct mo_campaign_step *row)
{
  mo_text_format(text, "%u,%u,%s", row->generation, row->step,
                 row->on_children ? "children" : "parents");
  mo_report_csv(text, &row->report, row->seconds);
  mo_text_add(text, "\n");
}

/* ---- replicates ---- */

static const char *const replicate_names[MO_REPLICATE_NUMBERS] = {"mean_score", "best_score",
                                                                  "diversity"};

void mo_replicate_add(struct mo_replicate_row *row, const struct mo_campaign_generation *of_one)
{
  const double numbers[MO_REPLICATE_NUMBERS] = {
      of_one->stats.mean_score, of_one->stats.quantiles[0], of_one->stats.diversity};
  row->generation = of_one->generation;
  row->campaigns++;
  for (int i = 0; i < MO_REPLICATE_NUMBERS; i++) {
    double number = numbers[i];
    if (!isfinite(number))
      continue;
    if (row->numbers[i].n == 0 || number < row->numbers[i].least)
      row->numbers[i].least = number;
    if (row->numbers[i].n == 0 || number > row->numbers[i].most)
      row->numbers[i].most = number;
    row->numbers[i].sum += number;
    row->numbers[i].n++;
  }
}

/* Returns the spread of a number over the campaigns. NaN: it is finite in no campaign. */
static struct mo_spread spread_of(const struct mo_replicate_row *row, int i)
{
  if (row->numbers[i].n == 0)
    return (struct mo_spread){NAN, NAN, NAN};
  return (struct mo_spread){row->numbers[i].least, row->numbers[i].sum / row->numbers[i].n,
                            row->numbers[i].most};
}

void mo_replicate_json(struct mo_text *text, const struct mo_replicate_row *row)
{
  mo_text_format(text, "{\"generation\":%u,\"campaigns\":%u", row->generation, row->campaigns);
  for (int i = 0; i < MO_REPLICATE_NUMBERS; i++) {
    struct mo_spread spread = spread_of(row, i);
    write_spread(text, replicate_names[i], &spread);
  }
  mo_text_add(text, "}");
}

const char mo_replicate_csv_heading[] =
    "generation,campaigns,mean_score_least,mean_score_mean,mean_score_most,best_score_least,best_"
    "score_mean,"
    "best_score_most,diversity_least,diversity_mean,diversity_most\n";

void mo_replicate_csv(struct mo_text *text, const struct mo_replicate_row *row)
{
  mo_text_format(text, "%u,%u", row->generation, row->campaigns);
  for (int i = 0; i < MO_REPLICATE_NUMBERS; i++) {
    struct mo_spread spread = spread_of(row, i);
    csv_spread(text, &spread);
  }
  mo_text_add(text, "\n");
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
  mo_csv_number(text, row->score);
  mo_text_add(text, ",d"); /* letters, because programs that read tables take 8e00… for a number */
  mo_bits_write_id_bare(text, &row->form);
  mo_text_add(text, ",g");
  mo_bits_write_bare(text, &row->genotype);
  mo_text_format(text, ",%u,%u,%u,%u\n", row->size.voxels, row->size.footprint, row->size.masses,
                 row->size.springs);
}
