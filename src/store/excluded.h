/* excluded.h: files of the bodies that campaigns exclude (src/morphospace/form_file.h), in the
 * folder "excluded" of the state folder.
 *
 * Each file can be recreated at any time, so no row refers to it, and errors are never fatal. The
 * least recently used files are removed to free space. A file is named after a controller. Once
 * that controller is removed, the next start removes the file. Campaigns of other controllers with
 * the same key also use it. */
#ifndef MORPHO_STORE_EXCLUDED_H
#define MORPHO_STORE_EXCLUDED_H

#include "store/store.h"

/* Opens the file of this key and marks it as most recently used. Returns a descriptor, which the
 * caller closes, or MO_ERR_NOT_FOUND, MO_ERR_NO_MEMORY, MO_ERR_IO. */
int mo_store_excluded_open(struct mo_store *store, uint64_t key);
/* Removes the files of this key. */
void mo_store_excluded_remove(struct mo_store *store, uint64_t key);
/* Writes a file of `bytes` bytes atomically: `make` passes it piece by piece to `put`, and returns
 * an error of `put` or its own. MO_ERR_UNSUPPORTED: the configuration does not keep such files;
 * MO_ERR_LIMIT: more than max_excluded; MO_ERR_NO_SPACE: the disk has less than twice this size
 * free; MO_ERR_CANCELLED: *cancel is set; MO_ERR_NO_MEMORY, MO_ERR_IO. */
int mo_store_excluded_write(struct mo_store *store, const struct mo_sha256 *controller,
                            uint64_t key, uint64_t bytes, const volatile int *cancel,
                            int (*make)(void *context,
                                        int (*put)(void *file, const void *bytes, size_t size),
                                        void *file),
                            void *context);

#endif
