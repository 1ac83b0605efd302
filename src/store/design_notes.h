/* design_notes.h: notes about the designs of a request that were skipped, repaired, or given as ids
 * without an orientation. */
#ifndef MORPHO_STORE_DESIGN_NOTES_H
#define MORPHO_STORE_DESIGN_NOTES_H

#include <stdbool.h>
#include <stdint.h>

#include <morpho/morphospace.h>

#include "base/faults.h"

/* How the orientation of a design was chosen. */
enum mo_orientation {
  MO_ORIENTATION_GIVEN = 0,     /* specified in the request */
  MO_ORIENTATION_CANONICAL = 1, /* an id was given, and none of its orientations has a score */
  MO_ORIENTATION_BEST = 2       /* an id was given, and this is the scored orientation with the best
                                   score */
};

struct mo_design_note {
  uint32_t place;   /* in the request, from 0 */
  uint32_t dropped; /* voxels that its repair removed */
  enum mo_orientation orientation;
  char robot[MO_DEFAULT_ROBOT_DIGITS + 1]; /* the robot chosen for an id; "": the request chose
                                            * it */
  struct mo_fault fault;                   /* why it was skipped; detail "": not skipped */
};
static inline bool mo_is_skipped(const struct mo_design_note *note)
{
  return note->fault.detail[0] != '\0';
}

/* Computes the places of the n designs that were not skipped. */
static inline void mo_notes_places(const struct mo_design_note *notes, uint32_t n_notes,
                                   uint32_t *places, uint32_t n)
{
  for (uint32_t i = 0, place = 0, k = 0; i < n; i++, place++) {
    for (; k < n_notes && notes[k].place <= place; k++)
      place += mo_is_skipped(&notes[k]);
    places[i] = place;
  }
}

#endif
