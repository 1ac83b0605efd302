/* recordings.h: what replies about recordings share. */
#ifndef MORPHO_API_RECORDINGS_H
#define MORPHO_API_RECORDINGS_H

#include "base/text.h"
#include "store/evaluations.h"

struct mo_request;

#define MO_NPY_HEADER 192 /* bytes of the header of an array of NumPy; a multiple of 64 */
/* Appends the header of an array of a channel: (`leading`, frames, …). leading: "10, ", or "". */
void mo_recording_header(struct mo_text *text, enum mo_channel channel, const char *leading,
                         const struct mo_trajectory_sides *sides);
/* Says why there is no such recording: it is removed, not made yet, or was never made. */
void mo_reply_no_recording(struct mo_request *request, const struct mo_job *job, int error);

#endif
