/* contents.h: rows that are identified by their content, and the environments and designs of a job.
 * Only for this room. */
#ifndef MORPHO_STORE_CONTENTS_H
#define MORPHO_STORE_CONTENTS_H

#include "store/sql.h"

/* Each finds or inserts a row. */
int mo_environment_row(struct mo_connection *writer, const struct mo_environment *environment,
                       int64_t *row);
int mo_physics_row(struct mo_connection *writer, const struct mo_physics *physics,
                   enum mo_precision precision, enum mo_sensor sensor, int64_t *row);
/* Finds the settings of the additional runs that estimate errors (score_ladder.h): rows
 * (mo_ladder_runs(n_displaced, tolerance)); rows[0] does not change. MO_ERR_CORRUPT: not stored. */
int mo_physics_runs(struct mo_connection *connection, const struct mo_setting *first,
                    enum mo_sensor sensor, uint32_t n_displaced, double tolerance, int64_t *rows);
/* Finds or inserts a design and one of its orientations. */
int mo_genotype_row(struct mo_connection *writer, const uint64_t *form, const uint64_t *genotype,
                    int64_t now_us, int64_t *row);
enum mo_texts { MO_FINGERPRINTS, MO_ORIGINS };
int mo_text_row(struct mo_connection *writer, enum mo_texts table, const char *text, int64_t *id);
/* Finds a named set and its size. MO_ERR_NOT_FOUND. */
int mo_environment_set_find(struct mo_connection *connection, const char *name, int64_t *row,
                            int64_t *n);
/* Returns the rows of the sets of a suite (MO_SUITE_TASKS of them) and the total number of
 * environments. A single set counts as a suite of one. MO_ERR_NOT_FOUND. */
int mo_suite_find(struct mo_connection *connection, const char *name, int64_t *rows,
                  uint32_t *n_sets, int64_t *n);
/* Inserts the environments of a job: those of the first set, then those of the next, and so on. */
int mo_suite_insert(struct mo_connection *writer, int64_t id, const int64_t *sets, uint32_t n_sets);

/* Inserts the environments of a job: the environments of `set`, or the given ones if set is 0. */
int mo_environments_insert(struct mo_connection *writer, int64_t id, int64_t set,
                           const struct mo_environment *environments, uint32_t n);
/* Inserts the designs of a job, in order. The places of skipped designs stay empty. */
int mo_designs_insert(struct mo_connection *writer, int64_t id, const struct mo_bits *forms,
                      const struct mo_bits *genotypes, uint32_t n,
                      const struct mo_design_note *notes, uint32_t n_notes, int64_t now_us);
int mo_notes_insert(struct mo_connection *writer, int64_t id, const struct mo_design_note *notes,
                    uint32_t n);
/* Reads the notes on a job's designs, ascending. The caller frees the list, even after an error. */
int mo_notes_read(struct mo_connection *reader, int64_t id, struct mo_design_note **notes,
                  uint32_t *n);
int mo_design_insert(struct mo_connection *writer, int64_t id, uint32_t position, int64_t genotype);
/* Reads the n environments of a job and their rows, each nullable. MO_ERR_CORRUPT: the job has a
 * different number. */
int mo_environments_read(struct mo_connection *connection, int64_t id, uint32_t n,
                         struct mo_environment *environments, int64_t *rows);
struct mo_designs {
  struct mo_bits *genotypes; /* (n) malloc */
  int64_t *rows;             /* (n) malloc */
  uint32_t *positions;       /* (n) malloc: places in the request */
  uint32_t n;
};
/* Reads the designs of a job. The caller frees the lists, even after an error. */
int mo_designs_read(struct mo_connection *connection, int64_t id, struct mo_designs *designs);

#endif
