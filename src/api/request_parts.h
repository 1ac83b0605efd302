/* request_parts.h: readers for the parts that several request bodies share: numbers, designs,
 * environments, physics, names, labels. Each function reads one value. An invalid value adds a
 * fault at its place (json.h). */
#ifndef MORPHO_API_REQUEST_PARTS_H
#define MORPHO_API_REQUEST_PARTS_H

#include "base/fields.h"
#include "store/records.h"

/* Adds a fault for an unknown key of an object. `expected`: the known keys, in words. */
void mo_read_unknown(struct mo_json *json, const char *expected);

/* Finds, in a first pass over the text, the words of these keys, because other members depend on
 * them. A word is "" if it is absent or too long. Adds no faults. MO_ERR_NO_MEMORY. */
#define MO_WORD_BYTES 32
int mo_find_words(struct mo_json *json, const char *text, size_t size, const char *const *keys,
                  char (*words)[MO_WORD_BYTES], size_t n);

/* Reads a count. False: it is something else, and *count is unchanged. */
bool mo_read_count(struct mo_json *json, uint32_t min, uint32_t max,
                   uint32_t *count); /* min … max */

/* Reads 1 to MO_DESIGNS_MAX designs, as given, not placed. *genotypes: malloc; the caller frees it
 * in every case. MO_OK (faults or not) or MO_ERR_NO_MEMORY. */
int mo_read_designs(struct mo_json *json, struct mo_bits **genotypes, uint32_t *n_designs);

/* Reads "paper-test" (*environments stays NULL) or an array of 1 to MO_ENVIRONMENTS_MAX
 * environments (malloc; the caller frees it in every case). MO_OK (faults or not) or
 * MO_ERR_NO_MEMORY. */
int mo_read_environments(struct mo_json *json, struct mo_environment **environments,
                         uint32_t *n_environments);

/* Reads a controller's name, or "sha256:" and 64 digits. `controller` is unchanged if it is
 * neither. */
void mo_read_controller(struct mo_json *json, char controller[MO_NAME_BYTES_MAX + 8]);

/* Reads a name for a controller. `name` is unchanged if it is invalid. */
void mo_read_name(struct mo_json *json, char name[MO_NAME_BYTES_MAX + 1]);

/* Reads a job's id from a string. what: "an evaluation". */
bool mo_read_job_id(struct mo_json *json, const char *what, int64_t *id);

/* Reads a label of at most 200 characters. */
bool mo_read_label(struct mo_json *json, char label[MO_LABEL_BYTES_MAX + 1]);

/* Reads a job's weight, MO_WEIGHT_MIN to MO_WEIGHT_MAX. *weight is unchanged if it is invalid. */
bool mo_read_weight(struct mo_json *json, double *weight);

/* Reads where a job is to be computed ("auto", "cpu" or "cuda") into *back_end, which is unchanged
 * if the word is none of these. */
void mo_read_device(struct mo_json *json, int *back_end);

/* Reads one of two words into *choice as 0 or 1. False: it is neither. */
bool mo_read_choice(struct mo_json *json, const char *first, const char *second, int *choice);

/* Reads a word of a closed list. find: returns MO_OK for a known word; expected: all known words.
 * False: the word is unknown and a fault was added. */
bool mo_read_word(struct mo_json *json, int (*find)(const char *word, int *value),
                  const char *expected, int *value);

#endif
