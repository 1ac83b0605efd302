/* atlas_names.h: the names and files of the service's atlases. The atlas NAME is the file
 * atlases/NAME.atlas of the state folder. While a job builds it, it is NAME.atlas.part. */
#ifndef MORPHO_STORE_ATLAS_NAMES_H
#define MORPHO_STORE_ATLAS_NAMES_H

#include <stdbool.h>
#include <sys/types.h>

#include <morpho/error.h>

struct mo_store;

#define MO_ATLAS_NAME_MAX   64 /* characters */
#define MO_ATLAS_NAME_WORDS "1 to 64 of a-z, 0-9 and '-', not beginning or ending with '-'"

bool mo_atlas_name_is_valid(const char *name);

/* Returns the path of the folder of all atlases. Opening the store creates it, and removes files in
 * it whose names begin with ".tmp-", and every NAME.atlas.part without an unfinished job. Valid as
 * long as the store is open. */
const char *mo_store_atlases_path(const struct mo_store *store);
/* Returns the path of an atlas with a valid name (malloc), or NULL if memory runs out. */
char *mo_store_atlas_path(const struct mo_store *store, const char *name);
/* Returns the type of what is at a path, as of stat, without following links; 0: nothing. */
mode_t mo_store_atlas_type(const char *path);

/* MO_ERR_CONFLICT: an atlas with this name exists, or is built by a job that has not ended, or that
 * failed and can be resumed; message (nullable) says which, and what to do. Errors as in
 * store.h. */
int mo_store_atlas_name_check(struct mo_store *store, const char *name, struct mo_message *message);

#endif
