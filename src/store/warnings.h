/* warnings.h: what a result's reader must know of a job, although it did what was asked. Derived
 * from what is stored, whenever a job is read. Only for this room. */
#ifndef MORPHO_STORE_WARNINGS_H
#define MORPHO_STORE_WARNINGS_H

#include "store/sql.h"
#include "store/store.h"

/* Sets the warnings of a job that mo_job_read has read. record: of its kind; an evaluation's is not
 * read. */
int mo_job_warn(struct mo_connection *connection, struct mo_job *job, const void *record);

#endif
