/* fault.h: what is wrong with a request, and the problem document (RFC 9457) that says so.
 *
 * Faults are collected, not thrown: a client learns of up to MO_FAULTS_MAX of them at once, each
 * with the place it is at. */
#ifndef MORPHO_HTTP_FAULT_H
#define MORPHO_HTTP_FAULT_H

#include <stdbool.h>
#include <stddef.h>

#include "http/text.h"

#define MO_FAULTS_MAX 32

enum mo_fault_place {
  MO_FAULT_BODY,      /* a JSON pointer (RFC 6901) */
  MO_FAULT_PARAMETER, /* name of a path or query parameter */
  MO_FAULT_HEADER     /* name of a header field */
};

struct mo_fault {
  enum mo_fault_place place;
  char where[256];
  char detail[256];
};

struct mo_faults {
  unsigned n;     /* faults kept */
  bool malformed; /* the body is not JSON at all: 400, not 422 */
  struct mo_fault items[MO_FAULTS_MAX];
};

/* Adds one fault; those beyond MO_FAULTS_MAX are dropped. Longer texts are cut. */
void mo_faults_add(struct mo_faults *faults, enum mo_fault_place place, const char *where,
                   const char *format, ...) __attribute__((format(printf, 4, 5)));
static inline bool mo_faults_full(const struct mo_faults *faults)
{
  return faults->n == MO_FAULTS_MAX;
}

/* The reason phrase of a status that this service uses ("Not Found"); "Error" for others. */
const char *mo_status_title(unsigned status);

/* Writes a problem document. type: "about:blank" or "/problems/…"; faults nullable. */
void mo_problem_write(struct mo_text *text, unsigned status, const char *type, const char *detail,
                      const char *instance, const char *request_id, const struct mo_faults *faults);

#endif
