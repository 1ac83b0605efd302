/* recordings.h: what replies about recordings share. */
#ifndef MORPHO_API_RECORDINGS_H
#define MORPHO_API_RECORDINGS_H

struct mo_job;
struct mo_request;

/* Says why there is no such recording: it is removed, not made yet, or was never made. */
void mo_reply_no_recording(struct mo_request *request, const struct mo_job *job, int error);

#endif
