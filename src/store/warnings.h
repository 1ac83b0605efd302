/* warnings.h: cautions for readers of the result of a job that otherwise succeeded. They are
 * derived from stored data whenever a job is read. Only for this room. */
#ifndef MORPHO_STORE_WARNINGS_H
#define MORPHO_STORE_WARNINGS_H

#include "store/sql.h"
#include "store/store.h"

/* Sets the warnings of a job that mo_job_read has read. record: the record of its kind; not read
 * for an evaluation. */
int mo_job_warn(struct mo_connection *connection, struct mo_job *job, const void *record);

#endif
