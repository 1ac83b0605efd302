/* atlas_library.c: see atlas_library.h.
 *
 * An entry is a file under a name, with the file system's identification of the file. Every use
 * looks the name up again, so files that jobs, requests and operators add, replace or remove are
 * noticed at once, and no other part of the service has to report them. An entry whose name now
 * refers to another file is removed from the list, and freed when its last user releases it.
 *
 * Files are opened and indexed without the mutex, so that a slow disk or a large file delays only
 * the requests for that file: meanwhile, the entry is busy, and others that need it wait. */
#include "api/atlas_library.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

#include "base/files.h"
#include "base/thread.h"
#include "store/store.h"

#define BYTES_PER_BODY 8
#define KEPT_BYTES     ((size_t)256 << 10) /* longer descriptions are written each time */
#define ATTEMPTS       3                   /* to open a file that is being replaced */

/* Identifies a file: different files, or different contents, differ in at least one of these. */
struct identity {
  dev_t device;
  ino_t inode;
  off_t size;
  int64_t modified_ns;
};

struct mo_atlas_entry {
  char name[MO_ATLAS_NAME_MAX + 1];
  struct identity identity;
  uint32_t n_users;
  bool is_listed;
  bool is_busy;           /* one of its users opens or indexes it */
  uint64_t used;          /* time of the last use, by the library's clock */
  struct mo_atlas *atlas; /* NULL: not open */
  struct mo_atlas_index *index;
  struct mo_atlas_basins *basins;
  uint64_t optima; /* UINT64_MAX: unknown */
  struct mo_text description;
  int error; /* why this content cannot be opened; MO_OK: unknown */
  struct mo_message message;
  LIST_ENTRY(mo_atlas_entry) others;
};

void mo_atlas_library_init(struct mo_atlas_library *library, struct mo_store *store,
                           int (*describe)(const struct mo_atlas_use *use,
                                           const struct mo_atlas_facts *facts,
                                           struct mo_text *text))
{
  *library = (struct mo_atlas_library){.store = store,
                                       .describe = describe,
                                       .mutex = PTHREAD_MUTEX_INITIALIZER,
                                       .heavy = PTHREAD_MUTEX_INITIALIZER,
                                       .idle = PTHREAD_COND_INITIALIZER};
  LIST_INIT(&library->entries);
}

/* ---- entries: called with the mutex held ---- */

static void close_file(struct mo_atlas_entry *entry)
{
  mo_atlas_basins_free(entry->basins);
  mo_atlas_index_free(entry->index);
  mo_atlas_close(entry->atlas);
  entry->basins = NULL;
  entry->index = NULL;
  entry->atlas = NULL;
}

static void discard(struct mo_atlas_entry *entry)
{
  close_file(entry);
  mo_text_free(&entry->description);
  free(entry);
}

/* Removes an entry from the list. */
static void drop(struct mo_atlas_entry *entry)
{
  LIST_REMOVE(entry, others);
  entry->is_listed = false;
  if (entry->n_users == 0)
    discard(entry);
}

void mo_atlas_library_free(struct mo_atlas_library *library)
{
  struct mo_atlas_entry *entry = LIST_FIRST(&library->entries);
  while (entry != NULL) {
    struct mo_atlas_entry *next = LIST_NEXT(entry, others);
    discard(entry);
    entry = next;
  }
  LIST_INIT(&library->entries);
  pthread_cond_destroy(&library->idle);
}

/* Identifies what is at a path, a file or not: opening it then says what is wrong with it. */
static int identify(const char *path, struct identity *identity)
{
  struct stat status;
  if (stat(path, &status) != 0 && lstat(path, &status) != 0) /* a link may lead nowhere */
    return errno == ENOENT ? MO_ERR_NOT_FOUND : mo_open_error();
  *identity =
      (struct identity){status.st_dev, status.st_ino, status.st_size,
                        (int64_t)status.st_mtim.tv_sec * 1000000000 + status.st_mtim.tv_nsec};
  return MO_OK;
}

static bool is_same(const struct identity *a, const struct identity *b)
{
  return a->device == b->device && a->inode == b->inode && a->size == b->size &&
         a->modified_ns == b->modified_ns;
}

static struct mo_atlas_entry *find_name(const struct mo_atlas_library *library, const char *name)
{
  struct mo_atlas_entry *entry;
  LIST_FOREACH(entry, &library->entries, others)
  {
    if (strcmp(entry->name, name) == 0)
      break;
  }
  return entry;
}

/* Drops the unused entries of names without a file. */
static void drop_missing(struct mo_atlas_library *library)
{
  struct mo_atlas_entry *entry = LIST_FIRST(&library->entries);
  while (entry != NULL) {
    struct mo_atlas_entry *next = LIST_NEXT(entry, others);
    struct identity identity = {.size = -1};
    char *path = mo_store_atlas_path(library->store, entry->name);
    if (path != NULL && entry->n_users == 0 && identify(path, &identity) == MO_ERR_NOT_FOUND)
      drop(entry);
    free(path);
    entry = next;
  }
}

/* Finds or makes the entry of the file that now has this path. */
static int find_entry(struct mo_atlas_library *library, const char *name, const char *path,
                      struct mo_atlas_entry **ret)
{
  struct identity identity = {.size = -1};
  struct mo_atlas_entry *entry = find_name(library, name);
  const int error = identify(path, &identity);
  if (error == MO_OK && entry != NULL && is_same(&entry->identity, &identity)) {
    *ret = entry;
    return MO_OK;
  }
  if (entry != NULL && error != MO_ERR_NO_MEMORY)
    drop(entry);
  if (error != MO_OK)
    return error;
  drop_missing(library);
  entry = calloc(1, sizeof(*entry));
  if (entry == NULL)
    return MO_ERR_NO_MEMORY;
  snprintf(entry->name, sizeof(entry->name), "%s", name);
  entry->identity = identity;
  entry->optima = UINT64_MAX;
  entry->is_listed = true;
  LIST_INSERT_HEAD(&library->entries, entry, others);
  *ret = entry;
  return MO_OK;
}

/* ---- limits: called with the mutex held ---- */

static uint64_t bytes_of(const struct mo_atlas_entry *entry)
{
  const uint64_t parts = (uint64_t)(entry->index != NULL) + (entry->basins != NULL);
  return parts > 0 ? parts * BYTES_PER_BODY * mo_atlas_bodies_of(entry->atlas) : 0;
}

/* Frees parts until `bytes` more fit: of the least recently used entry, basins first. */
static void limit_memory(struct mo_atlas_library *library, uint64_t bytes)
{
  for (;;) {
    struct mo_atlas_entry *entry, *oldest = NULL;
    uint64_t sum = bytes;
    LIST_FOREACH(entry, &library->entries, others)
    {
      const uint64_t held = bytes_of(entry);
      sum += held;
      if (held > 0 && entry->n_users == 0 && (oldest == NULL || entry->used < oldest->used))
        oldest = entry;
    }
    if (sum <= MO_ATLAS_MEMORY || oldest == NULL)
      return;
    if (oldest->basins != NULL) {
      mo_atlas_basins_free(oldest->basins);
      oldest->basins = NULL;
    } else {
      mo_atlas_index_free(oldest->index);
      oldest->index = NULL;
    }
  }
}

/* Closes files until `more` can be opened. */
static void limit_files(struct mo_atlas_library *library, uint32_t more)
{
  for (;;) {
    struct mo_atlas_entry *entry, *oldest = NULL;
    uint32_t n_open = more;
    LIST_FOREACH(entry, &library->entries, others)
    {
      n_open += entry->atlas != NULL || entry->is_busy;
      if (entry->atlas != NULL && entry->n_users == 0 &&
          (oldest == NULL || entry->used < oldest->used))
        oldest = entry;
    }
    if (n_open <= MO_ATLAS_FILES_OPEN || oldest == NULL)
      return;
    close_file(oldest);
  }
}

void mo_atlas_make_room(struct mo_atlas_library *library, uint64_t bytes)
{
  MO_GUARD(&library->mutex);
  limit_memory(library, bytes);
}

void mo_atlas_forget(struct mo_atlas_library *library, const char *name)
{
  MO_GUARD(&library->mutex);
  struct mo_atlas_entry *entry = find_name(library, name);
  if (entry != NULL)
    drop(entry);
  drop_missing(library);
}

/* ---- use: called with the mutex held ---- */

static bool is_of_content(int error)
{
  return error == MO_ERR_FORMAT || error == MO_ERR_UNSUPPORTED || error == MO_ERR_CORRUPT;
}

static void begin_work(struct mo_atlas_library *library, struct mo_atlas_entry *entry)
{
  entry->is_busy = true;
  pthread_mutex_unlock(&library->mutex);
}

static void end_work(struct mo_atlas_library *library, struct mo_atlas_entry *entry)
{
  pthread_mutex_lock(&library->mutex);
  entry->is_busy = false;
  pthread_cond_broadcast(&library->idle);
}

/* Waits until no other user of an entry opens or indexes it. */
static void await_work(struct mo_atlas_library *library, const struct mo_atlas_entry *entry)
{
  while (entry->is_busy)
    pthread_cond_wait(&library->idle, &library->mutex);
}

/* Opens the file of an entry that the caller uses. Releases the mutex while it opens the file. */
static int ensure_open(struct mo_atlas_library *library, struct mo_atlas_entry *entry,
                       const char *path, struct mo_message *message)
{
  struct mo_atlas *made = NULL;
  await_work(library, entry);
  if (entry->atlas != NULL)
    return MO_OK;
  if (entry->error != MO_OK) {
    *message = entry->message;
    return entry->error;
  }
  limit_files(library, 1);
  begin_work(library, entry);
  const int error = mo_store_atlas_open(library->store, path, &made, message);
  end_work(library, entry);
  entry->atlas = made;
  if (is_of_content(error)) {
    entry->error = error;
    entry->message = *message;
  }
  return error;
}

/* Makes the index of an open file in the same way. */
static int ensure_index(struct mo_atlas_library *library, struct mo_atlas_entry *entry)
{
  struct mo_atlas_index *made = NULL;
  await_work(library, entry);
  if (entry->index != NULL)
    return MO_OK;
  limit_memory(library, BYTES_PER_BODY * mo_atlas_bodies_of(entry->atlas));
  begin_work(library, entry);
  const int error = mo_atlas_index_create(entry->atlas, &made);
  end_work(library, entry);
  entry->index = made;
  return error;
}

static void leave(struct mo_atlas_library *library, struct mo_atlas_entry *entry)
{
  entry->n_users--;
  limit_files(library, 0);
  limit_memory(library, 0);
  if (entry->n_users == 0 && !entry->is_listed)
    discard(entry);
}

/* Finds the file of a name, and opens it, unless only the description is needed and known. Adds a
 * user to the entry. */
static int take(struct mo_atlas_library *library, const char *name, bool to_describe,
                struct mo_atlas_entry **ret, struct mo_message *message)
{
  char *path = mo_atlas_name_is_valid(name) ? mo_store_atlas_path(library->store, name) : NULL;
  struct mo_atlas_entry *entry = NULL;
  struct identity now = {.size = -1};
  int error = path != NULL                   ? MO_OK
              : mo_atlas_name_is_valid(name) ? MO_ERR_NO_MEMORY
                                             : MO_ERR_NOT_FOUND;
  bool is_current = false; /* the file was not replaced while it was opened */
  for (int attempt = 0; error == MO_OK && !is_current; attempt++) {
    error = attempt < ATTEMPTS ? find_entry(library, name, path, &entry) : MO_ERR_BUSY;
    is_current = true;
    if (error != MO_OK)
      break;
    entry->n_users++;
    const bool is_enough = to_describe && entry->description.size > 0;
    if (!is_enough && entry->atlas == NULL) {
      error = ensure_open(library, entry, path, message);
      is_current = identify(path, &now) != MO_OK || is_same(&now, &entry->identity);
      error = is_current ? error : MO_OK;
    }
    if (error != MO_OK || !is_current)
      leave(library, entry);
  }
  free(path);
  if (error != MO_OK)
    return error;
  if (!to_describe) /* describing all atlases in a list is no reason to keep a file open */
    entry->used = ++library->clock;
  *ret = entry;
  return MO_OK;
}

/* ---- use ---- */

/* Makes the basins of an entry that the caller uses. Only one thread does so at a time; queries
 * continue in the meantime. */
static int ensure_basins(struct mo_atlas_library *library, struct mo_atlas_entry *entry)
{
  struct mo_atlas_basins *made = NULL;
  MO_GUARD(&library->heavy);
  pthread_mutex_lock(&library->mutex);
  const bool is_there = entry->basins != NULL;
  if (!is_there)
    limit_memory(library, BYTES_PER_BODY * mo_atlas_bodies_of(entry->atlas));
  pthread_mutex_unlock(&library->mutex);
  if (is_there)
    return MO_OK;
  const int error = mo_atlas_basins_create(entry->atlas, entry->index, NULL, &made);
  if (error == MO_OK) {
    pthread_mutex_lock(&library->mutex);
    entry->basins = made;
    entry->optima = mo_atlas_optima(made);
    pthread_mutex_unlock(&library->mutex);
  }
  return error;
}

int mo_atlas_use(struct mo_atlas_library *library, const char *name, enum mo_atlas_need need,
                 struct mo_atlas_use *use, struct mo_message *message)
{
  struct mo_atlas_entry *entry = NULL;
  pthread_mutex_lock(&library->mutex);
  int error = take(library, name, false, &entry, message);
  if (error == MO_OK && need != MO_ATLAS_NEED_FILE) {
    error = ensure_index(library, entry);
    if (error != MO_OK)
      leave(library, entry);
  }
  pthread_mutex_unlock(&library->mutex);
  if (error != MO_OK)
    return error;
  *use = (struct mo_atlas_use){.entry = entry};
  if (need == MO_ATLAS_NEED_BASINS)
    error = ensure_basins(library, entry);
  if (error != MO_OK) {
    mo_atlas_release(library, use);
    return error;
  }
  MO_GUARD(&library->mutex);
  use->atlas = entry->atlas;
  use->index = entry->index;
  use->basins = entry->basins;
  return MO_OK;
}

void mo_atlas_release(struct mo_atlas_library *library, struct mo_atlas_use *use)
{
  MO_GUARD(&library->mutex);
  leave(library, use->entry);
  *use = (struct mo_atlas_use){.entry = NULL};
}

/* Writes the description of an entry that the caller uses, without the mutex. */
static int write_description(struct mo_atlas_library *library, struct mo_atlas_entry *entry,
                             struct mo_text *text)
{
  struct mo_text written = {0};
  int error = ensure_index(library, entry);
  const struct mo_atlas_use use = {
      .entry = entry, .atlas = entry->atlas, .index = entry->index, .basins = entry->basins};
  const struct mo_atlas_facts facts = {.name = entry->name,
                                       .bytes = (uint64_t)entry->identity.size,
                                       .modified_us = entry->identity.modified_ns / 1000};
  if (error == MO_OK) {
    pthread_mutex_unlock(&library->mutex);
    error = library->describe(&use, &facts, &written);
    pthread_mutex_lock(&library->mutex);
  }
  if (error == MO_OK && written.failed)
    error = MO_ERR_NO_MEMORY;
  if (error == MO_OK) {
    mo_text_bytes(text, written.data, written.size);
    if (written.size <= KEPT_BYTES && entry->description.size == 0) {
      entry->description = written;
      written = (struct mo_text){0};
    }
  }
  mo_text_free(&written);
  return error;
}

int mo_atlas_describe(struct mo_atlas_library *library, const char *name, struct mo_text *text,
                      uint64_t *optima, struct mo_message *message)
{
  struct mo_atlas_entry *entry = NULL;
  MO_GUARD(&library->mutex);
  int error = take(library, name, true, &entry, message);
  if (error != MO_OK)
    return error;
  if (entry->description.size > 0)
    mo_text_bytes(text, entry->description.data, entry->description.size);
  else
    error = write_description(library, entry, text);
  *optima = entry->optima;
  leave(library, entry);
  return error;
}
