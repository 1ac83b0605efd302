/* edit.h: the body of PATCH /v1/jobs/{id}, which is parsed as those of requests.h are. */
#ifndef MORPHO_API_EDIT_H
#define MORPHO_API_EDIT_H

#include "base/json.h"
#include "store/labels.h"

struct mo_parsed_edit {
  struct mo_job_edit edit; /* its texts are those below */
  char label[MO_LABEL_BYTES_MAX + 1], experiment[MO_EXPERIMENT_BYTES_MAX + 1],
      note[MO_NOTE_BYTES_MAX + 1];
};
int mo_edit_parse(const char *text, size_t size, struct mo_parsed_edit *parsed,
                  struct mo_faults *faults);

#endif
