/* certificate_rows.h: rows of certificates, for other files of this room. Only for this room. */
#ifndef MORPHO_STORE_CERTIFICATE_ROWS_H
#define MORPHO_STORE_CERTIFICATE_ROWS_H

#include "store/certified.h"
#include "store/sql.h"

/* Checks a row of certificate_losses against its checksums: job, trial, place, losses, measures.
 * MO_ERR_CORRUPT. */
int mo_certificate_row_check(sqlite3_stmt *row);
/* Reads two columns of certificate_verdicts: job and verdict; NULL: no certificate. */
struct mo_certified mo_column_certified(sqlite3_stmt *row, int column);

#endif
