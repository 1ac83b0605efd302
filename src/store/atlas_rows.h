/* atlas_rows.h: jobs that build atlases, for other files of this room. Only for this room. */
#ifndef MORPHO_STORE_ATLAS_ROWS_H
#define MORPHO_STORE_ATLAS_ROWS_H

#include "store/atlas_names.h"
#include "store/internal.h"

/* Finds the job that builds an atlas of this name, or failed and can be resumed; *id 0: none. */
int mo_atlas_builder(struct mo_connection *connection, const char *name, int64_t *id);
/* Like mo_store_atlas_name_check. */
int mo_atlas_name_find(const struct mo_store *store, struct mo_connection *connection,
                       const char *name, struct mo_message *message);
/* Deletes unfinished files of jobs that have ended. Call it before the writer starts. */
int mo_atlases_sort_out(struct mo_store *store);

#endif
