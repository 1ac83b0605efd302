/* learning_parts.h: what the bodies of requests that make a controller learn have in common: the
 * learning rate and the optimizer. Each reads one value; what is wrong with it becomes a fault at
 * its place (json.h). */
#ifndef MORPHO_HTTP_LEARNING_PARTS_H
#define MORPHO_HTTP_LEARNING_PARTS_H

#include <morpho/learning.h>

#include "http/json.h"
#include "store/trainings.h"

/* A schedule by name, or as an object whose missing fields are those of the paper's pretraining or
 * of one cosine. Untouched if it is not valid. */
void mo_read_schedule(struct mo_json *json, struct mo_schedule *schedule);

/* The fields that are given; the others stay. */
void mo_read_adam(struct mo_json *json, double *beta1, double *beta2, double *epsilon);

/* clip or restart. */
void mo_read_adjoint_rule(struct mo_json *json, enum mo_adjoint_rule *rule);

/* inverse_sqrt or inverse_square. */
void mo_read_sensor(struct mo_json *json, enum mo_sensor *sensor);

#endif
