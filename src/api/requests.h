/* requests.h: parses the bodies of requests. Does no I/O: the fuzz targets call this.
 *
 * Each function parses `size` bytes (text[size] must be NUL). MO_OK: complete, with all defaults;
 * MO_ERR_FORMAT: not JSON (faults->malformed); MO_ERR_INVALID: see the faults; MO_ERR_NO_MEMORY.
 * Free `parts` in every case. Even with MO_ERR_INVALID, the resources of the request (controller,
 * population, initial campaign) have valid values, so that the caller can look them up and report
 * all faults at once. mo_post_sign completes `job`. */
#ifndef MORPHO_API_REQUESTS_H
#define MORPHO_API_REQUESTS_H

#include "base/fields.h"
#include "jobs/campaigns.h"
#include "jobs/evaluations.h"
#include "jobs/studies.h"
#include "jobs/trainings.h"
#include "store/labels.h"

/* ---- what several bodies share (request_parts.c, design_request.c) ---- */

/* How to treat invalid designs and designs in several pieces. */
enum mo_on_fault { MO_FAULT_REFUSE = 0, MO_FAULT_SKIP = 1 };
enum mo_repair { MO_REPAIR_NONE = 0, MO_REPAIR_LARGEST = 1 };

struct mo_parts {           /* everything that a submission of any kind may request */
  struct mo_submission job; /* priority −1: not given */
  int device, error;        /* device 0: any; error: MO_ERR_NO_MEMORY */
  bool has_controller, no_controller /* null was given */, has_designs, has_environments;
  bool has_tasks, has_random, estimates_error, takes_suites, only_named, is_varied; /* worlds */
  char label[MO_LABEL_BYTES_MAX + 1], experiment[MO_EXPERIMENT_BYTES_MAX + 1];
  char controller[MO_NAME_BYTES_MAX + 8]; /* "": none */
  int on_fault, repair;                   /* enum mo_on_fault, enum mo_repair */
  struct mo_bits *genotypes;              /* (n_designs) the accepted ones, as given, not placed */
  uint32_t n_designs, n_environments, most_designs; /* most: longest list; 0: MO_DESIGNS_MAX */
  struct mo_design_note *notes; /* (n_notes) ascending: skipped, repaired, or given by id */
  uint32_t n_notes, n_skipped;
  struct mo_environment *environments; /* (n_environments); NULL: the set. mo_tasks_field: tasks */
  const char *environment_set;         /* of mo_set_words, mo_suite_words; NULL: "paper-test" */
  struct mo_random_bodies random;      /* count 0: none */
};
/* controller, label, experiment, priority, weight, device; and only a weight, one double. */
extern const struct mo_fields mo_parts_fields, mo_weight_fields;
/* Fields of struct mo_parts: 1 to MO_DESIGNS_MAX designs; a word of mo_set_words or 1 to
 * MO_ENVIRONMENTS_MAX environments, or only their tasks; a request has only one of these. */
extern const struct mo_field_own mo_designs_field, mo_environments_field, mo_tasks_field,
    mo_controller_field, mo_label_field;
/* on_fault and repair, together and separately. Read them ahead of the designs. */
extern const struct mo_fields mo_design_rules_fields, mo_on_fault_fields, mo_repair_fields;
extern const struct mo_field_own mo_name_field; /* a controller's: MO_NAME_BYTES_MAX + 1 bytes */

/* Reads the design at `place` of a request by its rules: adds it to the genotypes, as given and not
 * placed, unless it was skipped. Returns false if memory runs out. */
bool mo_parts_design(struct mo_json *json, struct mo_parts *parts, uint32_t place);
/* Adds a note about a design; with a fault, the design was skipped. False: out of memory. */
bool mo_parts_note(struct mo_parts *parts, const struct mo_design_note *note);
/* Reads a robot's notation or an id, optionally after the letter d, as in CSV files, into the words
 * of a genotype with a workspace: placed. Errors and *orientation as in mo_genotype_from_robot. */
int mo_robot_read(const char *text, size_t size, struct mo_genotype *genotype, int *orientation);
void *mo_next_item(void **items, size_t n, size_t size); /* of a growing array; NULL: no memory */
const char *mo_parts_controller(const struct mo_parts *parts); /* NULL: none */
const char *mo_parts_set(const struct mo_parts *parts);        /* NULL: a list is given */
/* Report invalid products of factors, also with `vary` (nullable); tasks without gradients. */
void mo_parts_check_factors(struct mo_json *json, struct mo_parts *parts,
                            const struct mo_physics *physics, const struct mo_factor_ranges *vary);
void mo_parts_check_gradients(struct mo_json *json, const struct mo_parts *parts, const char *hint);
void mo_parts_free(struct mo_parts *parts);

/* Reads a body into `parsed` by a table; `parsed` has `parts` (nullable). Then calls `check`
 * (nullable; MO_OK or MO_ERR_NO_MEMORY), which adds faults about several fields. MO_OK;
 * MO_ERR_FORMAT: not JSON (faults->malformed); MO_ERR_INVALID: see the faults; MO_ERR_NO_MEMORY. */
int mo_read_body(const char *text, size_t size, const struct mo_fields *fields, void *parsed,
                 struct mo_parts *parts, int (*check)(struct mo_json *json, void *parsed),
                 struct mo_faults *faults);

/* Read, in a first pass, the members that others depend on, from a whole text or from the next
 * object. *given (nullable) is set if the key of the first row is present. They add no faults. */
void mo_read_words(const char *text, size_t size, const struct mo_fields *fields, void *parsed,
                   bool *given);
void mo_read_ahead(const struct mo_json *json, const struct mo_fields *fields, void *parsed,
                   bool *given);
bool mo_read_job_id(struct mo_json *json, const char *what /* "a job" */, int64_t *id);
/* Reads another job's designs (*best: 1 … most; kept if absent) or an atlas's (if sample). */
void mo_read_population(struct mo_json *json, uint32_t most, enum mo_job_kind *kind, int64_t *id,
                        uint32_t *best, struct mo_atlas_sample *sample);
extern const struct mo_field_own mo_channels_field; /* of a recording: words, each once */

/* ---- bodies ---- */

/* All members of a submission, as tables. Tests compare the contract with them. */
extern const struct mo_fields mo_evaluation_request_fields, mo_rollouts_request_fields,
    mo_training_request_fields, mo_campaign_request_fields, mo_random_request_fields,
    mo_mutation_request_fields, mo_crossing_request_fields, mo_canonical_request_fields,
    mo_tell_fields, mo_ask_fields;

/* A request, and the parts that its pointers point to. */
struct mo_parsed_evaluation {
  struct mo_evaluation_request request;
  struct mo_parts parts;
};
int mo_evaluation_parse(const char *text, size_t size, struct mo_parsed_evaluation *parsed,
                        struct mo_faults *faults);
/* The body of POST /v1/rollouts is in states.h. */

struct mo_parsed_training {
  struct mo_training_request request;
  struct mo_parts parts;
  enum mo_learning_preset preset;
  bool has_kind, has_population;
  enum mo_job_kind population_kind; /* kind of the job that provides the designs, if there is one */
};
int mo_training_parse(const char *text, size_t size, struct mo_parsed_training *parsed,
                      struct mo_faults *faults);

struct mo_parsed_campaign {
  struct mo_campaign_request request;
  struct mo_parts parts;       /* genotypes: those of the initial population */
  int mode, preset, if_exists; /* mode −1: not a valid word; if_exists 1: return the study */
  bool has_mode, has_learning, has_sensor;
};
int mo_campaign_parse(const char *text, size_t size, struct mo_parsed_campaign *parsed,
                      struct mo_faults *faults);

/* The bodies of POST …/tell and …/ask of a study. The caller frees `parents` in every case. */
struct mo_parsed_telling {
  struct mo_study_telling telling;
  struct mo_parts parts;         /* genotypes: those of the children */
  struct mo_workspace workspace; /* the study's, like has_scores and measures; bodies must fit */
  bool has_children, has_scores; /* has_scores: each child must have a score */
  uint32_t measures;             /* computed by the service; clients cannot use their names */
};
int mo_tell_parse(const char *text, size_t size, const struct mo_campaign_record *study,
                  struct mo_parsed_telling *parsed, struct mo_faults *faults);
void mo_tell_free(struct mo_parsed_telling *parsed);
struct mo_parsed_ask {
  struct mo_ask ask;
  int way;
  uint32_t *parents; /* of `ask` */
  int error;         /* MO_ERR_NO_MEMORY */
};
int mo_ask_parse(const char *text, size_t size, struct mo_parsed_ask *parsed,
                 struct mo_faults *faults);

/* The body of PATCH /v1/jobs/{id}. */
struct mo_parsed_edit {
  struct mo_job_edit edit; /* its texts are the buffers below */
  char label[MO_LABEL_BYTES_MAX + 1], experiment[MO_EXPERIMENT_BYTES_MAX + 1],
      note[MO_NOTE_BYTES_MAX + 1];
};
extern const struct mo_fields mo_edit_fields;

#endif
