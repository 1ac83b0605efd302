/* atlas_files.h: the complete atlases of the state folder: lists, stores and deletes their files.
 * Their names are defined in atlas_names.h. Other errors as in store.h. */
#ifndef MORPHO_STORE_ATLAS_FILES_H
#define MORPHO_STORE_ATLAS_FILES_H

#include <stddef.h>
#include <stdint.h>

#include "store/atlas_names.h"

/* A name with its NUL. */
struct mo_atlas_name {
  char text[MO_ATLAS_NAME_MAX + 1];
};
/* Reads the names of all complete atlases, in alphabetical order: (n), malloc. */
int mo_store_atlas_names(const struct mo_store *store, struct mo_atlas_name **names, uint32_t *n);

/* Stores a file under a valid name, durably, or replaces the file that has it; processes that have
 * the old file mapped keep it. A file gets its name only after it has been read and checked.
 * *created: the name is new. MO_ERR_CONFLICT: a job is building an atlas of this name, or a
 * directory has it;
 * MO_ERR_FORMAT, MO_ERR_UNSUPPORTED, MO_ERR_CORRUPT: not a whole atlas of the store's workspace.
 * message says why. */
int mo_store_atlas_put(struct mo_store *store, const char *name, const void *bytes, size_t size,
                       bool *created, struct mo_message *message);
/* Deletes a file, durably; processes that have it mapped keep it. MO_ERR_NOT_FOUND;
 * MO_ERR_CONFLICT: it is a directory. */
int mo_store_atlas_delete(struct mo_store *store, const char *name);

/* Opens a file of the folder, which may then change: a copy is mapped (mo_atlas_open_copy), unless
 * disk space is short. Errors of mo_atlas_open; MO_ERR_UNSUPPORTED also: a different workspace. */
struct mo_atlas;
int mo_store_atlas_open(const struct mo_store *store, const char *path, struct mo_atlas **atlas,
                        struct mo_message *message);

#endif
