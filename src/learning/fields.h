/* fields.h: the settings of learning and of training runs as tables of fields. */
#ifndef MORPHO_LEARNING_FIELDS_H
#define MORPHO_LEARNING_FIELDS_H

#include <morpho/learning.h>

#include "base/fields.h"

/* For struct mo_learning: schedule, Adam, limits of the gradient. */
extern const struct mo_fields mo_learning_fields;
/* For struct mo_training_settings: the part that a controller's metadata stores: steps, batch,
 * learning, physics. */
extern const struct mo_fields mo_recipe_fields;
/* The same plus seed and sensor. */
extern const struct mo_fields mo_training_fields;
/* For enum mo_training_kind: "pretrain", "finetune", NULL. */
extern const char *const mo_training_kind_words[];

#endif
