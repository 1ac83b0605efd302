/* request_parts.h: what the bodies of several requests have in common: designs, physics, controllers, labels. Each reads one
 * value; what is wrong with it becomes a fault at its place (json.h). */
#ifndef MORPHO_HTTP_REQUEST_PARTS_H
#define MORPHO_HTTP_REQUEST_PARTS_H

#include "http/json.h"
#include "store/records.h"

#define MO_SEED_MAX INT64_C(9007199254740991) /* 2^53 − 1: any JSON reader keeps it exact */

/* A key that the object does not have. `expected`: those that it may have, in words. */
void mo_read_unknown(struct mo_json *json, const char *expected);

/* 1 to MO_DESIGNS_MAX designs, as given, not placed. *genotypes (malloc; the caller frees it in every case). MO_OK (faults or
 * not) or MO_ERR_NO_MEMORY. */
int mo_read_designs(struct mo_json *json, struct mo_bits **genotypes, uint32_t *n_designs);

/* The fields that are given; the others stay. */
void mo_read_physics(struct mo_json *json, struct mo_physics *physics);

/* A controller's name, or "sha256:" and 64 digits. Untouched if it is neither. */
void mo_read_controller(struct mo_json *json, char controller[MO_NAME_BYTES_MAX + 8]);

/* At most 200 characters. */
bool mo_read_label(struct mo_json *json, char label[MO_LABEL_BYTES_MAX + 1]);

/* One of two words: 0 or 1 in *choice; false when it is neither. */
bool mo_read_choice(struct mo_json *json, const char *first, const char *second, int *choice);

#endif
