/* rows.h: rows of numbers that training runs and campaigns write, in tables made from lists of
 * columns. Only for this room. */
#ifndef MORPHO_STORE_ROWS_H
#define MORPHO_STORE_ROWS_H

#include "store/sql.h"

enum mo_row_table {
  MO_TRAINING_STEPS,       /* struct mo_training_step_row */
  MO_TRAINING_VALIDATIONS, /* struct mo_training_validation_row */
  MO_CAMPAIGN_GENERATIONS, /* struct mo_campaign_generation */
  MO_CAMPAIGN_STEPS,       /* struct mo_campaign_step */
  MO_ROW_TABLES
};

/* Creates the tables with the columns of store/columns.h. */
int mo_rows_create(struct mo_connection *writer);

/* Adds the columns that tables of an earlier version lack. */
int mo_rows_extend(struct mo_connection *writer);

/* Writes a row of a job. A rewritten row replaces the old one. */
int mo_row_write(struct mo_connection *writer, enum mo_row_table which, int64_t id,
                 const void *row);
/* Reads the newest row of a job, if there is one; not for MO_CAMPAIGN_STEPS. */
int mo_row_newest(struct mo_connection *reader, enum mo_row_table which, int64_t id, void *row,
                  bool *found);

#endif
