/* problem.h: the problem document (RFC 9457), which says what is wrong with a request. */
#ifndef MORPHO_HTTP_PROBLEM_H
#define MORPHO_HTTP_PROBLEM_H

#include "base/faults.h"
#include "base/text.h"

/* Writes a problem document. Its type is the path of a page that explains it: docs/problems.md has
 * a part for each. faults nullable. */
void mo_problem_write(struct mo_text *text, unsigned status, const char *detail,
                      const char *instance, const char *request_id, const struct mo_faults *faults);

#endif
