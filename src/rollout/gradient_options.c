/* gradient_options.c: the options of a gradient, their defaults and bounds. */
#include "rollout/gradient_options.h"

#include <math.h>

const char *const mo_adjoint_words[] = {"clip", "restart", NULL};

struct mo_gradient_options mo_default_gradient_options(void)
{
  return (struct mo_gradient_options){.adjoint_bound = MO_ADJOINT_BOUND,
                                      .weight = 1.0,
                                      .adjoint_rule = MO_ADJOINT_CLIP,
                                      .restart_weight = MO_RESTART_WEIGHT};
}

int mo_gradient_options_check(const struct mo_gradient_options *options)
{
  if (!isfinite(options->adjoint_bound) || !isfinite(options->weight) ||
      !isfinite(options->restart_weight) || (unsigned)options->adjoint_rule > MO_ADJOINT_RESTART)
    return MO_ERR_INVALID;
  return options->adjoint_bound < 0 || options->restart_weight < 0 ||
                 options->restart_weight > MO_RESTART_WEIGHT_MAX
             ? MO_ERR_RANGE
             : MO_OK;
}

/* ---- the fields ---- */

#define AT(member) offsetof(struct mo_gradient_options, member)
static const struct mo_field rows[] = {
    {"adjoint_bound", MO_FIELD_NUMBER, 0, AT(adjoint_bound), .min = 0, .max = MO_ADJOINT_BOUND_MAX,
     .unit = "", .help = "bound of each robot's adjoint in the backward pass; 0: no bound"},
    {"adjoint_rule", MO_FIELD_WORD, 0, AT(adjoint_rule), .words = mo_adjoint_words, .unit = "",
     .help = "above the bound: clip, or restart the backward pass"},
    {"restart_weight", MO_FIELD_NUMBER, 0, AT(restart_weight), .min = 0,
     .max = MO_RESTART_WEIGHT_MAX, .unit = "",
     .help = "restart: weight of what the adjoint restarts with, relative to the end of a rollout; "
             "0: none"},
};
const struct mo_fields mo_gradient_fields = MO_FIELDS(rows);

/* ---- packed ---- */

/* The weight is not a setting. In the packed form, it comes after the bound. */
static const struct mo_fields bound = {rows, 1},
                              others = {rows + 1, sizeof(rows) / sizeof(*rows) - 1};
static const struct mo_field packed_rows[] = {
    {NULL, MO_FIELD_INLINE, 0, 0, .group = &bound},
    {"weight", MO_FIELD_NUMBER, 0, AT(weight)},
    {NULL, MO_FIELD_INLINE, 0, 0, .group = &others},
};
#undef AT
const struct mo_fields mo_gradient_packed_fields = MO_FIELDS(packed_rows);
