/* request_parts.h: what the bodies of several requests have in common: numbers, designs,
 * environments, physics, names, labels. Each reads one value; what is wrong with it becomes a fault
 * at its place (json.h). */
#ifndef MORPHO_HTTP_REQUEST_PARTS_H
#define MORPHO_HTTP_REQUEST_PARTS_H

#include "http/json.h"
#include "store/records.h"

#define MO_SEED_MAX INT64_C(9007199254740991) /* 2^53 − 1: any JSON reader keeps it exact */

/* A key that the object does not have. `expected`: those that it may have, in words. */
void mo_read_unknown(struct mo_json *json, const char *expected);

/* A first pass over the text, for members that others depend on: the words of these keys of the
 * object, "" where there is none (or a longer one). It tells no faults. MO_ERR_NO_MEMORY. */
#define MO_WORD_BYTES 32
int mo_find_words(struct mo_json *json, const char *text, size_t size, const char *const *keys,
                  char (*words)[MO_WORD_BYTES], size_t n);

/* Numbers. False, and *value as it was: it is something else. */
bool mo_read_count(struct mo_json *json, uint32_t min, uint32_t max,
                   uint32_t *count);                                    /* min … max */
bool mo_read_positive(struct mo_json *json, double max, double *value); /* above 0, at most max */
void mo_read_limit(struct mo_json *json, double max, double *value); /* the same, or 0: no limit */

/* 1 to MO_DESIGNS_MAX designs, as given, not placed. *genotypes (malloc; the caller frees it in
 * every case). MO_OK (faults or not) or MO_ERR_NO_MEMORY. */
int mo_read_designs(struct mo_json *json, struct mo_bits **genotypes, uint32_t *n_designs);

/* "paper-test" (*environments stays NULL), or an array of 1 to MO_ENVIRONMENTS_MAX (malloc; the
 * caller frees it in every case). MO_OK (faults or not) or MO_ERR_NO_MEMORY. */
int mo_read_environments(struct mo_json *json, struct mo_environment **environments,
                         uint32_t *n_environments);

/* The fields that are given; the others stay. */
void mo_read_physics(struct mo_json *json, struct mo_physics *physics);

/* A controller's name, or "sha256:" and 64 digits. Untouched if it is neither. */
void mo_read_controller(struct mo_json *json, char controller[MO_NAME_BYTES_MAX + 8]);

/* A name that a controller may get. Untouched if it is none. */
void mo_read_name(struct mo_json *json, char name[MO_NAME_BYTES_MAX + 1]);

/* A job's id in a string. what: "an evaluation". */
bool mo_read_job_id(struct mo_json *json, const char *what, int64_t *id);

/* At most 200 characters. */
bool mo_read_label(struct mo_json *json, char label[MO_LABEL_BYTES_MAX + 1]);

/* A job's weight, MO_WEIGHT_MIN to MO_WEIGHT_MAX. Untouched if it is not one. */
bool mo_read_weight(struct mo_json *json, double *weight);

/* Where a job is to be computed, "auto", "cpu" or "cuda": what a request's back_end takes.
 * Untouched if it is none of these. */
void mo_read_device(struct mo_json *json, int *back_end);

/* One of two words: 0 or 1 in *choice; false when it is neither. */
bool mo_read_choice(struct mo_json *json, const char *first, const char *second, int *choice);

/* A word of a closed list. find: MO_OK when it knows the word; expected: all that it knows, in
 * words. False, and the fault told: it is none of them. */
bool mo_read_word(struct mo_json *json, int (*find)(const char *word, int *value),
                  const char *expected, int *value);

#endif
