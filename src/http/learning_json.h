/* learning_json.h: what trainings and campaigns tell alike: learning rate, optimizer, controllers,
 * what a step did. */
#ifndef MORPHO_HTTP_LEARNING_JSON_H
#define MORPHO_HTTP_LEARNING_JSON_H

#include <morpho/learning.h>

#include "http/text.h"
#include "store/records.h"

/* Members of an object that has one already: ,"schedule":{…} and ,"adam":{…}. */
void mo_schedule_write(struct mo_text *text, const struct mo_schedule *schedule);
void mo_adam_write(struct mo_text *text, double beta1, double beta2, double epsilon);

/* A controller by name ("": null) and hash: an object. */
void mo_reference_write(struct mo_text *text, const char *name, const struct mo_sha256 *sha256);

/* What a step of learning did: the members behind those that name the step, and the same as cells
 * of CSV under their heading. */
void mo_report_json(struct mo_text *text, const struct mo_training_report *report, double seconds);
void mo_report_csv(struct mo_text *text, const struct mo_training_report *report, double seconds);
#define MO_REPORT_CSV                                                                              \
  "mean_loss,rate,gradient_norm,clipped_share,clipped_robots_share,diverged,zeroed,skipped,"       \
  "bounded,seconds"

/* A cell of CSV with the comma before it: the number, or nothing when it is not finite. */
void mo_csv_number(struct mo_text *text, double value);

#endif
