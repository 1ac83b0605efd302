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
/* Describes a channel of a recording of `frames` frames. Returns false if it was not recorded. */
bool mo_scene_channel(const struct mo_recording *recording, enum mo_channel channel,
                      uint32_t frames, uint32_t n_masses, uint32_t n_springs,
                      struct mo_scene_array *array);
/* Writes an array as a member of an object. If `arrays` is NULL, the member is the array itself as
 * JSON; otherwise, it is a description, and the numbers are appended to `arrays`. */
void mo_scene_write_array(struct mo_text *text, struct mo_text *arrays,
                          const struct mo_scene_array *array);
/* Writes the arrays of a body's geometry, as members of an object: masses, springs, rest_lengths_m,
 * voxels, faces. If `arrays` is NULL, they are JSON arrays; otherwise, they are descriptions, and
 * the numbers are appended to `arrays`. May fail with MO_ERR_NO_MEMORY. */
int mo_scene_write_body(struct mo_text *text, struct mo_text *arrays,
                        const struct mo_lattice *lattice, const struct mo_body *body,
                        const struct mo_genotype *genotype);
/* How rollouts are sent: as JSON, which has no recordings, or as a scene, whose positions are
 * float32, or int16 if that is close enough (masses_int16, docs/scenes.md). */
enum mo_rollouts_form { MO_ROLLOUTS_JSON, MO_ROLLOUTS_SCENE, MO_ROLLOUTS_INT16 };
/* Replies with the inputs and the results of rollouts. */
void mo_reply_rollouts(struct mo_request *request, const struct mo_rollouts *rollouts,
                       enum mo_rollouts_form form);
struct mo_campaign_status;
/* Replies with the phylogeny of a campaign as columns: the designs after number `after` (−1: all).
 * lineages: only the living ones and their ancestors. tag: the ETag. */
void mo_api_reply_columns(struct mo_request *request, const struct mo_campaign_status *status,
                          int64_t after, bool lineages, const char *tag);

/* ---- recordings ---- */

/* Returns the array to send by default: masses, or else the first one that was recorded. */
static inline unsigned mo_usual_channel(unsigned record)
{
  return (unsigned)__builtin_ctz(record & MO_RECORD_MASSES ? MO_RECORD_MASSES : record);
}
/* Replies with the reason why a recording does not exist: it was removed, has not been made yet, or
 * was never made. */
void mo_reply_no_recording(struct mo_request *request, const struct mo_job *job, int error);

/* ---- joining ---- */

/* Joins header and arrays, and frees both. Returns *size bytes (malloc), or NULL if memory runs
 * out. */
char *mo_scene_join(struct mo_text *header, struct mo_text *arrays, size_t *size);

#endif
