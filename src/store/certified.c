/* certified.c: see certified.h. */
#include "store/certified.h"

#include "store/certificate_rows.h"
#include "store/internal.h"

struct mo_certified mo_column_certified(sqlite3_stmt *row, int column)
{
  const bool is_known = sqlite3_column_type(row, column + 1) != SQLITE_NULL;
  return (struct mo_certified){sqlite3_column_int64(row, column),
                               is_known ? sqlite3_column_int(row, column + 1) : -1};
}

int mo_store_certified(struct mo_store *store, const struct mo_sha256 *controller,
                       const struct mo_genotype *genotype, struct mo_certified *certified)
{
  static const char sql[] =
      "SELECT v.job,v.verdict FROM genotypes g CROSS JOIN certificate_verdicts v ON"
      " v.genotype=g.id WHERE g.bits=?1 AND (?2 IS NULL OR v.controller="
      "(SELECT id FROM controllers WHERE sha256=?2)) ORDER BY v.job DESC LIMIT 1";
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  uint8_t bits[MO_BITS_BYTES];
  sqlite3_stmt *row;
  mo_encode_genotype(genotype->words, bits);
  const int error = mo_sql_row(reader, &row, sql, mo_blob(bits, sizeof(bits)),
                               controller != NULL ? mo_hash(controller) : mo_null());
  *certified = error == MO_OK ? mo_column_certified(row, 0) : (struct mo_certified){.id = 0};
  return error == MO_ERR_NOT_FOUND ? MO_OK : error;
}
