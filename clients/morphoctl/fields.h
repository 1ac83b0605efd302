/* fields.h: options that are fields of a request. */
#ifndef MORPHOCTL_FIELDS_H
#define MORPHOCTL_FIELDS_H

#include <jansson.h>

#include "ctl.h"

/* An option and its place in the request: "group.field" is a field of an object. */
struct field {
  const char *option, *place;
  enum { FIELD_WHOLE, FIELD_REAL, FIELD_WORD } kind;
};

/* Adds the values of the given options to the request, creating the objects around them. The server
 * checks bounds and reports them. */
int fill_fields(const struct ctl *ctl, json_t *request, const struct field *fields, size_t n);

/* Adds --schedule and the options of its kinds as "schedule" of `object`. */
int fill_schedule(const struct ctl *ctl, json_t *object);
/* Adds --beta1, --beta2, --epsilon, --gradient-norm-limit, --adjoint-bound, --adjoint-rule,
 * --restart-weight. */
int fill_optimizer(const struct ctl *ctl, json_t *object);

/* Help texts of the options that these two functions read. */
#define SCHEDULE_OPTIONS                                                                           \
  {"peak", 0, "RATE", "Largest rate (default: 0.002 for cosine, else 0.001)."},                    \
      {"floor", 0, "RATE", "Smallest rate (default: 1e-5)."},                                      \
      {"decay", 0, "FACTOR", "restarts: of the peak from one cycle to the next (default: 0.7)."},  \
      {"cycle-steps", 0, "N", "restarts: steps of the first cycle (default: 10)."},                \
      {"cycle-growth", 0, "N",                                                                     \
       "restarts: of the length from one cycle to the next (default: 2)."},                        \
  {                                                                                                \
    "warmup-steps", 0, "N",                                                                        \
        "Steps in which the rate grows to its peak (default: 10 for cosine, else 0)."              \
  }
#define OPTIMIZER_OPTIONS                                                                          \
  {"beta1", 0, "X", "Adam's decay of the mean of gradients (default: 0.9)."},                      \
      {"beta2", 0, "X", "Adam's decay of the mean of their squares (default: 0.999)."},            \
      {"epsilon", 0, "X", "Adam's smallest divisor (default: 1e-8)."},                             \
      {"gradient-norm-limit", 0, "X", "Largest norm of a step's gradient; 0: off (default: 1)."},  \
      {"adjoint-bound", 0, "X",                                                                    \
       "Bound of each robot's adjoint on the way back; 0: off (default: 2)."},                     \
      {"adjoint-rule", 0, "RULE",                                                                  \
       "Above the bound: clip (default), or restart, as if the rollout ended there."},             \
  {                                                                                                \
    "restart-weight", 0, "X", "restart: of what the adjoint begins anew with (default: 3)."        \
  }

#endif
