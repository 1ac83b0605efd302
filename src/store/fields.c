/* fields.c: see fields.h. */
#include "store/fields.h"

#include "evolution/fields.h"
#include "learning/fields.h"
#include "store/campaigns.h"
#include "store/trainings.h"

#define COUNT(array) (sizeof(array) / sizeof((array)[0]))

/* ---- trainings ---- */

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
static const struct mo_fields validation = {validation_rows, COUNT(validation_rows)};
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
static const struct mo_fields checkpoint = {checkpoint_rows, COUNT(checkpoint_rows)};
static const struct mo_field training_rows[] = {
    {NULL, MO_FIELD_INLINE, 0, AT(settings), .group = &mo_training_fields},
    {"validation", MO_FIELD_GROUP, 0, 0, .group = &validation, .unit = "",
     .help = "scores on held-out designs"},
    {"checkpoint", MO_FIELD_GROUP, 0, 0, .group = &checkpoint, .unit = "",
     .help = "when checkpoints are written"},
};
#undef AT
const struct mo_fields mo_training_record_fields = {training_rows, COUNT(training_rows)};

/* ---- campaigns ---- */

#define AT(member) offsetof(struct mo_campaign_record, member)
static const struct mo_field campaign_rows[] = {
    {NULL, MO_FIELD_INLINE, 0, AT(settings), .group = &mo_campaign_fields},
};
const struct mo_fields mo_campaign_record_fields = {campaign_rows, COUNT(campaign_rows)};
static const struct mo_field learning_rows[] = {
    {NULL, MO_FIELD_INLINE, 0, AT(settings), .group = &mo_campaign_learning_fields},
    {"checkpoint_every_s", MO_FIELD_COUNT, 0, AT(checkpoint_every_s), .min = 0,
     .max = MO_CHECKPOINT_SECONDS_MAX, .unit = "s",
     .help = "seconds between two checkpoints within a generation; 0: at its end only"},
};
#undef AT
const struct mo_fields mo_campaign_record_learning_fields = {learning_rows, COUNT(learning_rows)};
