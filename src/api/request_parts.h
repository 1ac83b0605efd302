/* request_parts.h: what the bodies of several requests share: a table of the members that every
 * submission may have, readers of designs, environments and names, and the reading of a whole body
 * by a table (base/fields.h). An invalid value adds a fault at its place (json.h). */
#ifndef MORPHO_API_REQUEST_PARTS_H
#define MORPHO_API_REQUEST_PARTS_H

#include "base/fields.h"
#include "store/records.h"

struct mo_environment;

/* What a submission of any kind may ask for. */
struct mo_parts {
  int priority; /* enum mo_urgency; −1: not given */
  int device;   /* 0: any */
  double weight;
  bool has_label, has_controller, no_controller, has_designs; /* no_controller: null was given */
  char label[MO_LABEL_BYTES_MAX + 1];
  char controller[MO_NAME_BYTES_MAX + 8]; /* "": none */
  struct mo_bits *genotypes;              /* (n_designs) as given, not placed */
  uint32_t n_designs;
  struct mo_environment *environments; /* (n_environments); NULL: "paper-test" */
  uint32_t n_environments;
  int error; /* MO_ERR_NO_MEMORY */
};
/* controller, label, priority, weight, device. */
extern const struct mo_fields mo_parts_fields;
extern const struct mo_fields mo_weight_fields; /* of one double */
/* Fields of struct mo_parts: 1 to MO_DESIGNS_MAX designs; "paper-test" or 1 to MO_ENVIRONMENTS_MAX
 * environments. */
extern const struct mo_field_own mo_designs_field, mo_environments_field;
/* A name for a controller, of MO_NAME_BYTES_MAX + 1 bytes. */
extern const struct mo_field_own mo_name_field;

int mo_parts_back_end(const struct mo_parts *parts);           /* as in mo_evaluation_request */
const char *mo_parts_controller(const struct mo_parts *parts); /* NULL: none */
void mo_parts_free(struct mo_parts *parts);

/* Reads a body by a table into `parsed`, which has `parts` (nullable), then calls `check`
 * (nullable; MO_OK or MO_ERR_NO_MEMORY), which adds faults about several fields. MO_OK;
 * MO_ERR_FORMAT: not JSON (faults->malformed); MO_ERR_INVALID: see the faults; MO_ERR_NO_MEMORY. */
int mo_read_body(const char *text, size_t size, const struct mo_fields *fields, void *parsed,
                 struct mo_parts *parts, int (*check)(struct mo_json *json, void *parsed),
                 struct mo_faults *faults);

/* Reads, in a first pass over the text, the words of two rows, because the defaults of other
 * members depend on them. *given: the key of the first row is there. Adds no faults. */
void mo_read_words(const char *text, size_t size, const struct mo_fields *fields, void *parsed,
                   bool *given);

/* Reads a job's id from a string. what: "an evaluation". */
bool mo_read_job_id(struct mo_json *json, const char *what, int64_t *id);

#endif
