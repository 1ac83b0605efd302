/* faults.h: collects the faults of a request.
 *
 * A client receives up to MO_FAULTS_MAX faults at once, each with its location. */
#ifndef MORPHO_BASE_FAULTS_H
#define MORPHO_BASE_FAULTS_H

#include <stdbool.h>

#define MO_FAULTS_MAX 32

enum mo_fault_place {
  MO_FAULT_BODY,      /* a JSON pointer (RFC 6901) */
  MO_FAULT_PARAMETER, /* name of a path or query parameter */
  MO_FAULT_HEADER     /* name of a header field */
};

struct mo_fault {
  enum mo_fault_place place;
  char where[256];
  char detail[512];
};

struct mo_faults {
  unsigned n;      /* faults kept */
  bool malformed;  /* the body is not JSON at all: 400, not 422 */
  bool first_only; /* further faults are dropped, and reading continues */
  struct mo_fault items[MO_FAULTS_MAX];
};

/* Adds one fault. Faults beyond MO_FAULTS_MAX are dropped, and texts that are too long are cut. */
void mo_faults_add(struct mo_faults *faults, enum mo_fault_place place, const char *where,
                   const char *format, ...) __attribute__((format(printf, 4, 5)));
static inline bool mo_faults_full(const struct mo_faults *faults)
{
  return faults->n == MO_FAULTS_MAX;
}

#endif
