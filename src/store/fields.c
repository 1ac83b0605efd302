/* fields.c: see fields.h. */
#include "store/fields.h"

#include <string.h>

#include "evolution/fields.h"
#include "learning/fields.h"
#include "store/campaigns.h"
#include "store/trainings.h"

/* ---- training runs ---- */

#define AT(member) offsetof(struct mo_training_record, member)
static const struct mo_field validation_rows[] = {
    {"every_steps", MO_FIELD_COUNT, 0, AT(validate_every_steps), .min = 0,
     .max = MO_TRAINING_STEPS_MAX, .unit = "steps",
     .help = "steps between two validations; 0: none"},
    {"designs", MO_FIELD_COUNT, 0, AT(settings.held_out_designs), .min = 1,
     .max = MO_TRAINING_DESIGNS_MAX, .unit = "designs", .help = "held-out designs"},
    {"environments", MO_FIELD_COUNT, 0, AT(settings.held_out_environments), .min = 1,
     .max = MO_HELD_OUT_ENVIRONMENTS_MAX, .unit = "environments", .help = "held-out environments"},
};
static const struct mo_fields validation = MO_FIELDS(validation_rows);
static const struct mo_field checkpoint_rows[] = {
    {"every_steps", MO_FIELD_COUNT, 0, AT(checkpoint_every_steps), .min = 0,
     .max = MO_TRAINING_STEPS_MAX, .unit = "steps",
     .help = "steps between two checkpoints; 0: by time only"},
    {"every_s", MO_FIELD_COUNT, 0, AT(checkpoint_every_s), .min = 0,
     .max = MO_CHECKPOINT_SECONDS_MAX, .unit = "s",
     .help = "seconds between two checkpoints; 0: by steps only"},
    {"keep", MO_FIELD_COUNT, 0, AT(checkpoints_kept), .min = 1, .max = MO_CHECKPOINTS_KEPT_MAX,
     .unit = "checkpoints", .help = "newest checkpoints that are kept"},
};
static const struct mo_fields checkpoint = MO_FIELDS(checkpoint_rows);
static const struct mo_field training_rows[] = {
    {NULL, MO_FIELD_INLINE, 0, AT(settings), .group = &mo_training_fields},
    {"validation", MO_FIELD_GROUP, 0, 0, .group = &validation, .unit = "",
     .help = "scores on held-out designs"},
    {"checkpoint", MO_FIELD_GROUP, 0, 0, .group = &checkpoint, .unit = "",
     .help = "when checkpoints are written"},
};
const struct mo_fields mo_training_record_fields = MO_FIELDS(training_rows);
static const struct mo_field stored_training_rows[] = {
    {"kind", MO_FIELD_WORD, 0, AT(settings.kind), .words = mo_training_kind_words, .unit = "",
     .help = ""},
    {NULL, MO_FIELD_INLINE, 0, 0, .group = &mo_training_record_fields},
};
/* The rows of a training run in its own environments. */
static const struct mo_field stored_own_rows[] = {
    {NULL, MO_FIELD_INLINE, 0, 0,
     .group = &(const struct mo_fields)MO_FIELDS(stored_training_rows)},
    {"environment_set", MO_FIELD_TEXT, MO_FIELD_NULL, AT(environment_set), .min = 1,
     .max = MO_NAME_BYTES_MAX, .unit = "", .help = ""},
    {"n_environments", MO_FIELD_COUNT, 0, AT(n_environments), .min = 1,
     .max = MO_TRAINING_ENVIRONMENTS_MAX, .unit = "", .help = ""},
    {"draws_worlds", MO_FIELD_FLAG, 0, AT(draws_worlds), .unit = "", .help = ""},
};
const char *const mo_keep_words[] = {"none", "all", NULL};
static const struct mo_field stored_each_rows[] = {
    {"each", MO_FIELD_FLAG, 0, AT(each), .unit = "", .help = ""},
    {"keep", MO_FIELD_WORD, 0, AT(keep), .words = mo_keep_words, .unit = "", .help = ""},
    {"keep_best", MO_FIELD_COUNT, 0, AT(keep_best), .min = 0, .max = MO_TRAINING_DESIGNS_MAX,
     .unit = "", .help = ""},
};
/* A training run has the first of these or, if it has its own environments, the second. */
enum { DRAWN_WORLDS, OWN_WORLDS, EACH, SAMPLE, N_TRAINING_ROWS };
static const struct mo_field all_training_rows[N_TRAINING_ROWS] = {
    [DRAWN_WORLDS] = {NULL, MO_FIELD_INLINE, 0, 0,
                      .group = &(const struct mo_fields)MO_FIELDS(stored_training_rows)},
    [OWN_WORLDS] = {NULL, MO_FIELD_INLINE, 0, 0,
                    .group = &(const struct mo_fields)MO_FIELDS(stored_own_rows)},
    [EACH] = {NULL, MO_FIELD_INLINE, 0, 0,
              .group = &(const struct mo_fields)MO_FIELDS(stored_each_rows)},
    [SAMPLE] = {"sample", MO_FIELD_GROUP, 0, AT(sample), .group = &mo_atlas_sample_fields,
                .unit = "", .help = ""},
};
/* All rows that can be read. */
static const struct mo_fields stored_training = {&all_training_rows[OWN_WORLDS],
                                                 N_TRAINING_ROWS - OWN_WORLDS};
#undef AT

/* ---- campaigns ---- */

#define AT(member) offsetof(struct mo_campaign_record, member)
static const struct mo_field campaign_rows[] = {
    {NULL, MO_FIELD_INLINE, 0, AT(settings), .group = &mo_campaign_fields},
    {"measures", MO_FIELD_OWN, 0, AT(measures), .own = &mo_measures_field, .unit = "",
     .help = "measures to compute for each design, in addition to its score"},
    {"select_by", MO_FIELD_OWN, 0, AT(select_by), .group = &mo_select_by_fields,
     .own = &mo_select_by_field, .unit = "", .help = "the measure to select by; null: the loss"},
    {NULL, MO_FIELD_INLINE, 0, AT(settings), .group = &mo_campaign_aggregate_fields},
    {"re_evaluate", MO_FIELD_OWN, 0, AT(re_evaluate), .group = &mo_re_evaluation_fields,
     .own = &mo_re_evaluation_field, .unit = "",
     .help =
         "scores of the best designs in fresh worlds, which do not affect selection; null: none"},
};
const struct mo_fields mo_campaign_record_fields = MO_FIELDS(campaign_rows);
const char *const mo_worlds_words[] = {"random", "environments", "tasks", NULL};
#define WORLDS_HELP                                                                                \
  "where robots learn: in random environments, in those of the campaign, or in random ones with "  \
  "their tasks"
static const struct mo_field stored_learning_rows[] = {
    {NULL, MO_FIELD_INLINE, 0, AT(settings), .group = &mo_campaign_learning_fields},
    {"checkpoint_every_s", MO_FIELD_COUNT, 0, AT(checkpoint_every_s), .min = 0,
     .max = MO_CHECKPOINT_SECONDS_MAX, .unit = "s",
     .help = "seconds between two checkpoints within a generation; 0: at its end only"},
};
static const struct mo_fields stored_learning = MO_FIELDS(stored_learning_rows);
static const struct mo_field learning_rows[] = {
    {NULL, MO_FIELD_INLINE, 0, 0, .group = &stored_learning},
    {"worlds", MO_FIELD_WORD, 0, AT(worlds), .words = mo_worlds_words, .unit = "",
     .help = WORLDS_HELP},
};
const struct mo_fields mo_campaign_record_learning_fields = MO_FIELDS(learning_rows);
static const struct mo_field stored_campaign_rows[] = {
    {"mode", MO_FIELD_WORD, 0, AT(settings.mode), .words = mo_campaign_mode_words, .unit = "",
     .help = ""},
    {NULL, MO_FIELD_INLINE, 0, AT(settings), .group = &mo_campaign_fields},
    {"learning", MO_FIELD_GROUP, 0, 0, .group = &stored_learning, .unit = "", .help = ""},
};
enum { STORED, OWN_SCORE, MEASURES, SELECT_BY, WORLDS, AGGREGATE, RE_EVALUATE, N_STORED_ROWS };
static const struct mo_field all_stored_rows[N_STORED_ROWS] = {
    [STORED] = {NULL, MO_FIELD_INLINE, 0, 0,
                .group = &(const struct mo_fields)MO_FIELDS(stored_campaign_rows)},
    [OWN_SCORE] = {"own_score", MO_FIELD_OWN, 0, AT(own_score), .group = &mo_own_score_fields,
                   .own = &mo_own_score_field, .unit = "", .help = ""},
    [MEASURES] = {"measures", MO_FIELD_OWN, 0, AT(measures), .own = &mo_measures_field, .unit = "",
                  .help = ""},
    [SELECT_BY] = {"select_by", MO_FIELD_OWN, 0, AT(select_by), .group = &mo_select_by_fields,
                   .own = &mo_select_by_field, .unit = "", .help = ""},
    [WORLDS] = {"learning_worlds", MO_FIELD_WORD, 0, AT(worlds), .words = mo_worlds_words,
                .unit = "", .help = ""},
    [AGGREGATE] = {NULL, MO_FIELD_INLINE, 0, AT(settings), .group = &mo_campaign_aggregate_fields},
    [RE_EVALUATE] = {"re_evaluate", MO_FIELD_OWN, 0, AT(re_evaluate),
                     .group = &mo_re_evaluation_fields, .own = &mo_re_evaluation_field, .unit = "",
                     .help = ""},
};
static const struct mo_fields all_stored = MO_FIELDS(all_stored_rows);
#undef AT

/* ---- in the database ---- */

/* Writes the rows that a record has. */
static void write_those(const struct mo_field *all, const bool *has, size_t n_all,
                        const void *record, struct mo_text *text)
{
  struct mo_field
      rows[(int)N_STORED_ROWS > (int)N_TRAINING_ROWS ? (int)N_STORED_ROWS : (int)N_TRAINING_ROWS];
  size_t n = 0;
  for (size_t i = 0; i < n_all; i++)
    if (has[i])
      rows[n++] = all[i];
  mo_fields_write_object(text, &(const struct mo_fields){rows, n}, record);
}

static void write_training(const struct mo_training_record *record, struct mo_text *text)
{
  const bool has_own = record->n_environments > 0;
  const bool has[N_TRAINING_ROWS] = {[DRAWN_WORLDS] = !has_own,
                                     [OWN_WORLDS] = has_own,
                                     [EACH] = record->each,
                                     [SAMPLE] = record->sample.atlas[0] != '\0'};
  write_those(all_training_rows, has, N_TRAINING_ROWS, record, text);
}

/* Writes only members that the campaign uses: the settings of other campaigns keep their original
 * form, which bundles use, too. */
static void write_campaign(const struct mo_campaign_record *record, struct mo_text *text)
{
  const bool measured = record->measures != 0;
  const bool has[N_STORED_ROWS] = {
      [STORED] = true,
      [OWN_SCORE] = measured || mo_own_score_is_set(&record->own_score),
      [MEASURES] = measured,
      [SELECT_BY] = measured,
      [WORLDS] = record->worlds != MO_WORLDS_RANDOM,
      [AGGREGATE] = record->settings.aggregate.kind != MO_AGGREGATE_MEAN,
      [RE_EVALUATE] = record->re_evaluate.every > 0,
  };
  write_those(all_stored_rows, has, N_STORED_ROWS, record, text);
}

void mo_settings_write(enum mo_job_kind kind, const void *record, struct mo_text *text)
{
  if (kind == MO_JOB_CAMPAIGN)
    write_campaign(record, text);
  else
    write_training(record, text);
}

static int read_stored(const char *json, const struct mo_fields *fields, void *record)
{
  struct mo_message message;
  const int error = mo_fields_parse(json, strlen(json), fields, record, &message);
  return error == MO_ERR_FORMAT ? MO_ERR_CORRUPT : error;
}

/* Only a campaign that learns has worlds to learn in. A study re-evaluates nothing. Only a study
 * has an own score, unless it follows from the measure to select by, which is among the measures.
 * An own score has no aggregate; it also has no lower bounds, so racing is off. */
static bool is_consistent(const struct mo_campaign_record *record)
{
  const struct mo_aggregate *aggregate = &record->settings.aggregate;
  struct mo_own_score own;
  if (aggregate->kind != MO_AGGREGATE_MEAN && mo_own_score_is_set(&record->own_score))
    return false;
  if (!mo_aggregate_is_monotone(aggregate) && record->settings.racing != MO_RACING_OFF)
    return false;
  if (record->re_evaluate.every > 0 && !mo_modes[record->settings.mode].makes_children)
    return false;
  if (record->worlds != MO_WORLDS_RANDOM && !mo_modes[record->settings.mode].learns)
    return false;
  if (!record->select_by.is_set)
    return !mo_own_score_is_set(&record->own_score) ||
           !mo_modes[record->settings.mode].makes_children;
  mo_select_by_name(&record->select_by, &own);
  return mo_own_score_equal(&own, &record->own_score) &&
         (record->measures >> record->select_by.measure & 1) != 0 &&
         record->settings.racing == MO_RACING_OFF;
}

int mo_settings_read(enum mo_job_kind kind, const char *json, void *record)
{
  /* Settings that are not stored get their defaults: the parameters of other kinds of selection,
   * bisections with an exact time of impact, and settings newer than the row, which were the
   * paper's physics then. */
  if (kind == MO_JOB_TRAINING) {
    struct mo_training_record *training = record;
    struct mo_training_settings *settings = &training->settings;
    training->environment_set[0] = '\0';
    training->n_environments = 0;
    training->draws_worlds = training->each = false;
    training->keep = MO_KEEP_NONE;
    training->keep_best = 0;
    training->sample = (struct mo_atlas_sample){.atlas = ""};
    *settings = mo_training_preset(MO_TRAINING_PRETRAIN, MO_LEARNING_PRESET_WORKSTATION);
    settings->physics = mo_paper_physics();
    return read_stored(json, &stored_training, record);
  }
  struct mo_campaign_record *campaign = record;
  campaign->settings = mo_campaign_preset(MO_ZERO_SHOT, MO_PRESET_PAPER);
  campaign->own_score = (struct mo_own_score){.name = ""};
  campaign->measures = 0;
  campaign->select_by = (struct mo_select_by){.is_set = false};
  campaign->worlds = MO_WORLDS_RANDOM;
  campaign->re_evaluate = (struct mo_re_evaluation){.every = 0};
  const int error = read_stored(json, &all_stored, campaign);
  return error == MO_OK && !is_consistent(campaign) ? MO_ERR_CORRUPT : error;
}
