/* checkpoint_files.h: how checkpoints are written and read. Only for this room.
 *
 * A file is written before its row and deleted after it. A crash in between leaves a file without a
 * row, which is removed the next time the store is opened. store->checkpoints_mutex is held from
 * the write of a file to the deletion of the files that it replaces, and from the deletion of a row
 * to the deletion of its file. Otherwise a new file of an old step could be deleted instead of the
 * old one. */
#ifndef MORPHO_STORE_CHECKPOINT_FILES_H
#define MORPHO_STORE_CHECKPOINT_FILES_H

#include "store/checkpoints.h"
#include "store/internal.h"

/* A checkpoint that is being written. */
struct mo_checkpoint {
  int64_t id;
  enum mo_job_kind kind;
  struct mo_checkpoint_place place;
  uint64_t size;
  struct mo_sha256 sha256;
  char *path;
  /* Nullable: checks, before the file is written, whether the write is allowed. */
  int (*check)(struct mo_store *store, void *arguments);
  bool is_urgent; /* may use the reserve */
  bool was_there;
  struct mo_checkpoints_removed dropped; /* checkpoints that it replaces */
};
/* Writes the row, in an operation. */
int mo_checkpoint_row_write(struct mo_store *store, const struct mo_checkpoint *checkpoint);
/* Deletes, in an operation, the rows that a query selects. list_sql: ?1 job, ?2 generation, ?3
 * step, ?4 available to the query; columns generation, step, size. */
int mo_checkpoint_drop(struct mo_store *store, const char *list_sql, int64_t fourth,
                       struct mo_checkpoint *checkpoint);
/* Deletes, in an operation, up to 16 checkpoints of jobs that are being deleted (deletion.c). Their
 * files are deleted first, because nothing uses them anymore. This frees space on a full disk, even
 * if the operation fails. */
int mo_checkpoints_forget(struct mo_store *store, uint64_t *n);
/* Writes the file (unless bytes is NULL), then runs an operation, which calls the functions above,
 * then deletes the files of the rows that it dropped. After an error the new file is deleted. */
int mo_checkpoint_write(struct mo_store *store, const uint8_t *bytes,
                        struct mo_checkpoint *checkpoint,
                        int (*run)(struct mo_store *store, void *arguments), void *arguments);

/* Reads the bytes of the newest checkpoint of a generation and step; −1 matches any (malloc).
 * *place: the checkpoint that was found. Checks the hash: MO_ERR_CORRUPT. */
int mo_checkpoint_read(struct mo_store *store, int64_t id, enum mo_job_kind kind,
                       int64_t generation, int64_t step, struct mo_checkpoint_place *place,
                       uint8_t **bytes, size_t *size);

#endif
