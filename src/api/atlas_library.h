/* atlas_library.h: the atlas files that are open, and the data about them in memory.
 *
 * A file is opened, and checked as a whole, when a request first needs it, and stays mapped: as a
 * copy, so that changes of the file do not reach requests that use it. The index (ranks) and the
 * basins of a file take 8 bytes per body each, and are made when they are first needed. At most
 * MO_ATLAS_FILES_OPEN files are open and MO_ATLAS_MEMORY bytes used: the least recently used parts
 * are freed first. What a request uses stays until it is released, even if the file is deleted or
 * replaced in the meantime; so these limits are briefly exceeded if many requests use many files.
 * Without atlases, nothing is allocated. */
#ifndef MORPHO_API_ATLAS_LIBRARY_H
#define MORPHO_API_ATLAS_LIBRARY_H

#include <pthread.h>
#include <sys/queue.h>

#include <morpho/atlas.h>

#include "base/text.h"
#include "store/atlas_files.h"

#define MO_ATLAS_FILES_OPEN 4
#define MO_ATLAS_MEMORY     (UINT64_C(18) << 20) /* index and basins of 1.1 million bodies */

struct mo_atlas_entry;

/* A file that a request uses. Pointers are valid until it is released. */
struct mo_atlas_use {
  struct mo_atlas_entry *entry;
  const struct mo_atlas *atlas;
  const struct mo_atlas_index *index;   /* NULL: not requested */
  const struct mo_atlas_basins *basins; /* NULL: not in memory */
};

/* Facts that are not in the file itself. */
struct mo_atlas_facts {
  const char *name;
  uint64_t bytes;
  int64_t modified_us;
};

struct mo_atlas_library {
  struct mo_store *store;
  /* Writes the description of a file, which is then kept: called once, when it is first needed. */
  int (*describe)(const struct mo_atlas_use *use, const struct mo_atlas_facts *facts,
                  struct mo_text *text);
  pthread_mutex_t mutex; /* of everything below; never held for long */
  pthread_mutex_t heavy; /* held while basins are made (3 s); locked before the other one */
  pthread_cond_t idle;   /* an entry is no longer being opened or indexed */
  LIST_HEAD(, mo_atlas_entry) entries;
  uint64_t clock; /* counts uses */
};

void mo_atlas_library_init(struct mo_atlas_library *library, struct mo_store *store,
                           int (*describe)(const struct mo_atlas_use *use,
                                           const struct mo_atlas_facts *facts,
                                           struct mo_text *text));
/* Closes everything. No request may use it. */
void mo_atlas_library_free(struct mo_atlas_library *library);

enum mo_atlas_need { MO_ATLAS_NEED_FILE, MO_ATLAS_NEED_INDEX, MO_ATLAS_NEED_BASINS };

/* Opens an atlas for a request, with the parts that it needs; basins that are in memory come with
 * every need. The caller releases it. MO_ERR_NOT_FOUND: no such atlas; MO_ERR_FORMAT,
 * MO_ERR_UNSUPPORTED, MO_ERR_CORRUPT: the file is damaged or of a different kind; MO_ERR_IO: it
 * cannot be read, or is not a file; then message says what to do. MO_ERR_NO_MEMORY. */
int mo_atlas_use(struct mo_atlas_library *library, const char *name, enum mo_atlas_need need,
                 struct mo_atlas_use *use, struct mo_message *message);
void mo_atlas_release(struct mo_atlas_library *library, struct mo_atlas_use *use);

/* Appends the description of an atlas, and *optima, its number of local optima, or UINT64_MAX if
 * its basins were never made. Errors as above. */
int mo_atlas_describe(struct mo_atlas_library *library, const char *name, struct mo_text *text,
                      uint64_t *optima, struct mo_message *message);

/* Closes a file that was deleted, once no request uses it. */
void mo_atlas_forget(struct mo_atlas_library *library, const char *name);

/* Frees parts that no request uses until `bytes` more are within the limit. */
void mo_atlas_make_room(struct mo_atlas_library *library, uint64_t bytes);

#endif
