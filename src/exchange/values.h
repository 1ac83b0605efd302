/* values.h: values in the form of replies and files: as JSON, and recordings as NumPy arrays. */
#ifndef MORPHO_EXCHANGE_VALUES_H
#define MORPHO_EXCHANGE_VALUES_H

#include <morpho/measure.h>

#include "base/fields.h"
#include "base/text.h"
#include "store/campaign_designs.h"
#include "store/evaluations.h"

/* Write the digits of a genotype, or of an id, without quotes. */
void mo_genotype_write(struct mo_text *text, const struct mo_genotype *genotype);
void mo_form_write(struct mo_text *text, const struct mo_genotype *form);
/* Write members of an object: a genotype, the id of a form, a hash, an array of numbers. */
void mo_member_genotype(struct mo_text *text, const char *name, const struct mo_genotype *genotype);
void mo_member_form(struct mo_text *text, const char *name, const struct mo_genotype *form);
void mo_member_hash(struct mo_text *text, const char *name, const struct mo_sha256 *hash);
void mo_member_numbers(struct mo_text *text, const char *name, const double *numbers, size_t n);
/* Write the notation of a genotype as it is scored: the member "robot"; only the value, without
 * quotes. */
void mo_member_robot(struct mo_text *text, const struct mo_genotype *genotype);
void mo_robot_write(struct mo_text *text, const struct mo_genotype *genotype);
/* Write members that are null if the value is not known. */
void mo_member_count_if(struct mo_text *text, const char *name, bool known, uint64_t count);
void mo_member_number_if(struct mo_text *text, const char *name, bool known, double number);
extern const struct mo_field_own mo_hash_field; /* a struct mo_sha256 */

/* Writes the value that corresponds to a loss in a task, and its unit, as members; nothing for a
 * plain task. */
void mo_members_value(struct mo_text *text, const struct mo_task *task, double loss);
/* The measures of n rollouts of a design, as input of mo_members_losses. */
struct mo_measured {
  uint32_t set;         /* as bits: the measures that were requested */
  const double *values; /* (n, measures of the set); NaN: null */
  const uint8_t *flags; /* (n) bits of enum mo_measure_flag */
  bool has_means;       /* the means are written elsewhere */
};
/* Writes losses as the member "losses". If an environment (nullable) has a task that is not plain,
 * or if `measured` is given, each loss becomes an object with its value and unit; if all units are
 * the same, the mean of the values and the unit follow as members "value" and "unit". With
 * `measured` (nullable), each object also contains "measures" and "flags", and the means of the
 * measures and the flags of all rollouts follow; a mean is null if one of its numbers is null. */
void mo_members_losses(struct mo_text *text, const double *losses, size_t n,
                       const struct mo_environment *environments,
                       const struct mo_measured *measured);
/* Writes the names of flags (enum mo_measure_flag) as the member "flags". */
void mo_member_flags(struct mo_text *text, unsigned flags);
/* Writes the names of measures as a member. */
void mo_member_measures(struct mo_text *text, const char *name, uint32_t set);

/* Writes an environment as an object. */
void mo_environment_write(struct mo_text *text, const struct mo_environment *environment);

/* ---- designs of campaigns ---- */

/* Write the result of a re-evaluation as the member "held_out", and the newest certificate of a
 * design as "certificate"; null: none. */
void mo_member_held_out(struct mo_text *text, const struct mo_re_evaluated *held_out);
void mo_member_certificate(struct mo_text *text, const struct mo_certified *certified);
/* Writes a design of a campaign: the members of an object without its braces, so that more can
 * follow. words: the words of a study, so that its measures are written as well; NULL for a line of
 * a bundle, which has only what the campaign made of the design. */
void mo_campaign_json_design(struct mo_text *text, const struct mo_campaign_design *row,
                             const struct mo_study_words *words);
/* Writes the history of the design in the campaign, as further members: parents, operator, born,
 * died, score. */
void mo_campaign_json_life(struct mo_text *text, const struct mo_campaign_design *row);
/* Write the parents, either as a member or as numbers separated by commas. */
void mo_member_parents(struct mo_text *text, const struct mo_descent *descent);
void mo_parents_write(struct mo_text *text, const struct mo_descent *descent);

/* ---- recordings ---- */

#define MO_NPY_HEADER 192 /* bytes of the header of a NumPy array; a multiple of 64 */
/* Appends the header of an array of a channel: (`leading`, frames, …). leading: "10, ", or "". */
void mo_recording_header(struct mo_text *text, enum mo_channel channel, const char *leading,
                         const struct mo_trajectory_sides *sides);

#endif
