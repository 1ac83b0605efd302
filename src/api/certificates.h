/* certificates.h: what the replies about certificates share. Only for the files certificate*.c of
 * this room. */
#ifndef MORPHO_API_CERTIFICATES_H
#define MORPHO_API_CERTIFICATES_H

#include "api/handlers.h"
#include "store/certificates.h"

/* Writes two members: the axes that were requested but do not apply, with the reasons, and what a
 * reader of the other axes must know. */
void mo_members_axes(struct mo_text *text, const struct mo_certificate_settings *settings,
                     const struct mo_certificate_base *base);

#endif
