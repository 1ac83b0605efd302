/* fields.h: the settings of learning and of trainings as tables of fields. */
#ifndef MORPHO_LEARNING_FIELDS_H
#define MORPHO_LEARNING_FIELDS_H

#include <morpho/learning.h>

#include "base/fields.h"

/* Of struct mo_learning: schedule, Adam, limits of the gradient. */
extern const struct mo_fields mo_learning_fields;
/* Of struct mo_training_settings: what a controller's metadata store about its training: steps,
 * batch, learning, physics. */
extern const struct mo_fields mo_recipe_fields;
/* The same with seed and sensor. */
extern const struct mo_fields mo_training_fields;
/* Of enum mo_training_kind: "pretrain", "finetune", NULL. */
extern const char *const mo_training_kind_words[];

#endif
