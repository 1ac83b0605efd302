/* learning_json.h: what trainings and campaigns report alike: controllers and steps of learning. */
#ifndef MORPHO_API_LEARNING_JSON_H
#define MORPHO_API_LEARNING_JSON_H

#include <morpho/learning.h>

#include "base/text.h"
#include "store/records.h"

/* Writes a controller as an object of name ("": null) and hash. */
void mo_reference_write(struct mo_text *text, const char *name, const struct mo_sha256 *sha256);

/* Write what a step of learning did: the JSON members after those that identify the step, or the
 * same values as CSV cells, whose heading is MO_REPORT_CSV. */
void mo_report_json(struct mo_text *text, const struct mo_training_report *report, double seconds);
void mo_report_csv(struct mo_text *text, const struct mo_training_report *report, double seconds);
#define MO_REPORT_CSV                                                                              \
  "mean_loss,rate,gradient_norm,clipped_share,clipped_robots_share,diverged,zeroed,skipped,"       \
  "bounded,seconds"

/* Writes a CSV cell with the comma before it: the number, or nothing when it is not finite. */
void mo_csv_number(struct mo_text *text, double value);

#endif
