/* scene.h: writes scenes (docs/scenes.md): bodies, worlds and recordings in one reply, as a JSON
 * header and the arrays that it describes; and arrays of recordings. */
#ifndef MORPHO_API_SCENE_H
#define MORPHO_API_SCENE_H

#include "base/text.h"
#include "jobs/rollouts.h"
#include "store/evaluations.h"

struct mo_request;

#define MO_SCENE_TYPE "application/vnd.morphod.scene"

/* An array of numbers, little-endian as this machine is. */
struct mo_scene_array {
  const char *name, *type; /* "uint16" */
  const void *numbers;
  size_t width; /* bytes of one */
  uint32_t shape[3];
  unsigned dimensions;
};
/* Describes a channel of a recording of `frames` frames. False: it is not recorded. */
bool mo_scene_channel(const struct mo_recording *recording, enum mo_channel channel,
                      uint32_t frames, uint32_t n_masses, uint32_t n_springs,
                      struct mo_scene_array *array);
/* Writes an array as a member of an object: described, with its numbers at the end of `arrays`, or,
 * where that is NULL, as JSON. */
void mo_scene_write_array(struct mo_text *text, struct mo_text *arrays,
                          const struct mo_scene_array *array);
/* Writes the arrays of a body's geometry, as members of an object: masses, springs, rest_lengths_m,
 * voxels, faces. With `arrays` they are described, and their numbers go there; without, they are
 * arrays of JSON. MO_ERR_NO_MEMORY. */
int mo_scene_write_body(struct mo_text *text, struct mo_text *arrays,
                        const struct mo_lattice *lattice, const struct mo_body *body,
                        const struct mo_bits *genotype);
/* Replies with what rollouts were computed with and what came of them: as a scene, or as JSON,
 * which has no recordings. */
void mo_reply_rollouts(struct mo_request *request, const struct mo_rollouts *rollouts,
                       bool as_scene);
/* Replies with the phylogeny of a campaign as columns: the designs behind number `after` (-1: all),
 * or, of them, the ancestors of the living and the living. tag: its ETag. */
void mo_api_reply_columns(struct mo_request *request, int64_t id, int64_t after, bool lineages,
                          const char *tag);

/* ---- recordings ---- */

/* Returns which array to give where none is named: masses, else the first that is recorded. */
static inline unsigned mo_usual_channel(unsigned record)
{
  return (unsigned)__builtin_ctz(record & MO_RECORD_MASSES ? MO_RECORD_MASSES : record);
}
/* Says why there is no such recording: it is removed, not made yet, or was never made. */
void mo_reply_no_recording(struct mo_request *request, const struct mo_job *job, int error);

/* ---- the parts together ---- */

/* Joins header and arrays; *size bytes, malloc. NULL: no memory. Frees both. */
char *mo_scene_join(struct mo_text *header, struct mo_text *arrays, size_t *size);

#endif
