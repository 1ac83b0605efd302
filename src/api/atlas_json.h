/* atlas_json.h: what the handlers of atlases share: reading the parameters that name bodies and
 * steps, and writing bodies as in the contract. */
#ifndef MORPHO_API_ATLAS_JSON_H
#define MORPHO_API_ATLAS_JSON_H

#include "api/handlers.h"

/* ---- requests: these return false if they have replied ---- */

/* Opens the atlas in the path (atlas_library.h). The caller releases it with mo_atlas_done. */
bool mo_atlas_begin(struct mo_request *request, enum mo_atlas_need need, struct mo_atlas_use *use);
/* The same for a name from elsewhere. */
bool mo_atlas_begin_named(struct mo_request *request, const char *name, enum mo_atlas_need need,
                          struct mo_atlas_use *use);
void mo_atlas_done(struct mo_request *request, struct mo_atlas_use *use);
/* Replies with the error of an atlas that cannot be used. */
void mo_atlas_refuse(struct mo_request *request, const char *name, int error,
                     const struct mo_message *message);

/* Reads the body that `design` or `position` names. */
bool mo_atlas_query_body(struct mo_request *request, const struct mo_atlas_use *use,
                         uint64_t *position);
/* Reads `steps`, as bits of enum mo_atlas_step; adding and removing if it is absent. */
bool mo_atlas_query_steps(struct mo_request *request, unsigned *steps);
/* Reads `voxels`: 1 to the atlas's largest number; 0 if it is absent. */
bool mo_atlas_query_voxels(struct mo_request *request, const struct mo_atlas_use *use,
                           uint32_t *n_voxels);
/* Read `lo` and `hi`, which do not change if they are absent; lo must be below hi. */
bool mo_atlas_query_range(struct mo_request *request, float *lo, float *hi);
bool mo_atlas_query_interval(struct mo_request *request, const char *low, const char *high,
                             float *lo, float *hi); /* reads the same under other names */

/* Reads `measure`, which the atlas must have, as enum mo_measure; −1 if it is absent. */
bool mo_atlas_query_measure(struct mo_request *request, const struct mo_atlas_use *use,
                            int *measure);
/* Sorts all bodies by a measure, or by its negative value. The caller frees the index. */
bool mo_atlas_sort_by(struct mo_request *request, const struct mo_atlas_use *use, int measure,
                      bool is_negative, struct mo_atlas_index **index);

/* ---- replies ---- */

/* Write a body, without its braces, so that more can follow; with its braces, as a member; and as
 * an item of an array. */
void mo_atlas_write_body(struct mo_text *text, const struct mo_atlas_use *use, uint64_t position);
void mo_atlas_member_body(struct mo_text *text, const char *name, const struct mo_atlas_use *use,
                          uint64_t position);
void mo_atlas_item_body(struct mo_text *text, const struct mo_atlas_use *use, uint64_t position);
/* Writes a body's measures as a member, or their percentiles among the bodies of its size, if the
 * atlas has measures. */
void mo_atlas_member_measures(struct mo_text *text, const struct mo_atlas_use *use,
                              uint64_t position, bool as_percentiles);
/* Writes an array of scores, such as edges, as a member. */
void mo_atlas_member_floats(struct mo_text *text, const char *name, const float *values, size_t n);

/* Describes an atlas for the library: an object that is left open, for "optima". */
int mo_atlas_write_description(const struct mo_atlas_use *use, const struct mo_atlas_facts *facts,
                               struct mo_text *text);
extern const char *const mo_atlas_step_words[]; /* "add", "remove", "move", NULL */
/* Returns the word of a step. */
const char *mo_atlas_step_word(enum mo_atlas_step step);

#endif
