/* atlas_sample.h: bodies drawn from an atlas, one from each of equally large parts of its ranking.
 *
 * The bodies with a finite score are ranked, best first, with ties in the order of positions.
 * Stratum i of `count` has the places floor(i · bodies / count) up to but not including
 * floor((i + 1) · bodies / count); one of them is drawn, all equally likely, with the seed. The
 * places therefore follow from the numbers of the sample alone, even when the atlas no longer
 * exists. */
#ifndef MORPHO_STORE_ATLAS_SAMPLE_H
#define MORPHO_STORE_ATLAS_SAMPLE_H

#include <morpho/morphospace.h>

#include "base/fields.h"
#include "base/sha256.h"
#include "store/atlas_names.h"
#include "store/records.h"

#define MO_ATLAS_SAMPLE_MAX 10000 /* bodies */

struct mo_atlas_sample {
  char atlas[MO_ATLAS_NAME_MAX + 1]; /* its name when the sample was drawn; "": no sample */
  uint32_t count;                    /* 1 … MO_ATLAS_SAMPLE_MAX, at most `bodies` */
  uint64_t seed;
  char sha256[MO_SHA256_DIGITS + 1]; /* of the file. In a request: "": any file */
  /* From the file. */
  uint32_t bodies, diverged;                /* ranked; left out, because the score is infinite */
  int orientations;                         /* enum mo_atlas_orientations */
  char environments[MO_NAME_BYTES_MAX + 1]; /* a word of mo_set_words; "": other environments */
  char controller[MO_SHA256_DIGITS + 1];    /* hash of the controller of all scores */
};
/* All members, as in the database; the first four, which requests contain; the others. */
extern const struct mo_fields mo_atlas_sample_fields, mo_atlas_asked_fields, mo_atlas_drawn_fields;

/* Opens the atlas, draws the bodies, from the best stratum to the worst, as canonical forms (count,
 * malloc), and completes the sample. Takes 8 bytes of memory per body of the atlas, and a tenth of
 * a second for the 158,096 bodies of at most nine voxels.
 * - MO_ERR_NOT_FOUND: no atlas has this name
 * - MO_ERR_CONFLICT: it is being built, cannot be used, or is not the one with `sha256`
 * - MO_ERR_RANGE: count exceeds the number of ranked bodies
 * - MO_ERR_NO_MEMORY, MO_ERR_IO */
int mo_store_atlas_sample(struct mo_store *store, struct mo_atlas_sample *sample,
                          struct mo_bits **bodies, struct mo_message *message);
/* Returns the place in the ranking, from 0, of body i of a complete sample. */
uint32_t mo_atlas_sample_place(const struct mo_atlas_sample *sample, uint32_t i);

#endif
