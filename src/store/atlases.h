/* atlases.h: jobs that build atlases: settings, progress, and the file that grows.
 *
 * An atlas is a job of kind MO_JOB_ATLAS. Its settings never change. Its results are only in the
 * file of its name (atlas_names.h), never in rows: a job continues where the file ends. The file is
 * durable before the row says so; after a crash, the row may lag behind. It may be ahead by less
 * than one block if the crash interrupted a save, which overwrites the previous save of the same
 * block; those bodies are then computed again.
 *
 * Threads and errors as in store.h. */
#ifndef MORPHO_STORE_ATLASES_H
#define MORPHO_STORE_ATLASES_H

#include <morpho/atlas.h>

#include "store/atlas_names.h"
#include "store/store.h"

/* The settings of an atlas, and its progress. Environments, controller, physics and precision are
 * members of the job. */
struct mo_atlas_record {
  char name[MO_ATLAS_NAME_MAX + 1];
  uint32_t voxels; /* the largest number */
  enum mo_atlas_orientations orientations;
  uint32_t measures;                   /* bits; 0: none */
  uint64_t bodies_total;               /* 0: not counted yet, because the job has not started */
  uint64_t bodies_done, rollouts_done; /* in the file */
};
struct mo_atlas_status {
  struct mo_job job;
  struct mo_atlas_record record;
};

/* ---- submission (by jobs) ---- */

struct mo_atlas_request {
  struct mo_submission job;
  char name[MO_ATLAS_NAME_MAX + 1]; /* "": a free name is made from the base */
  char base[MO_ATLAS_NAME_MAX + 1]; /* valid, and at most 58 characters */
  uint32_t voxels;
  int orientations;  /* enum mo_atlas_orientations */
  uint32_t measures; /* bits; 0: none */
  struct mo_physics physics;
  const char *controller;                    /* name or "sha256:<hex>" */
  const char *environment_set;               /* NULL: listed */
  const struct mo_environment *environments; /* (n_environments) */
  uint32_t n_environments;
};
/* Errors as in mo_store_submit; MO_ERR_DUPLICATE: the name is taken, as message says. */
int mo_store_submit_atlas(struct mo_store *store, const struct mo_atlas_request *request,
                          int64_t *id, bool *replayed, struct mo_message *message);

/* ---- reading ---- */

/* MO_ERR_NOT_FOUND. */
int mo_store_atlas(struct mo_store *store, int64_t id, struct mo_atlas_status *status);
/* ---- the runner's writes ---- */

/* Creates the writer of a job's file, with the store's system calls: like
 * mo_atlas_writer_create. */
int mo_store_atlas_writer(struct mo_store *store, const char *name,
                          const struct mo_atlas_source *source,
                          const struct mo_environment *environments, uint32_t n,
                          struct mo_atlas_writer **writer, struct mo_message *message);
/* Removes an unfinished file that a writer rejected. */
int mo_store_atlas_restart(struct mo_store *store, const char *name);
/* Makes the names of all atlas files durable. MO_ERR_NO_MEMORY, MO_ERR_IO. */
int mo_store_atlases_sync(struct mo_store *store);
/* Returns whether the disk is full, so that only urgent writes may use the rest of it. */
bool mo_store_is_short(const struct mo_store *store);
/* Stores the progress, with the event "atlas.progress". data: a JSON object; NULL: no event,
 * because no body was added, so the attempt does not count as healthy yet. More bodies than before
 * reset the job's attempts. MO_ERR_CONFLICT: the job has ended, or was not started under this
 * opening of the store. */
int mo_store_atlas_progress(struct mo_store *store, int64_t id,
                            const struct mo_atlas_record *progress, const char *data);
/* running → succeeded, once the file is complete. The record has the last progress. Deletes the
 * file if the job was cancelled first (MO_ERR_CONFLICT). */
int mo_store_atlas_finish(struct mo_store *store, int64_t id,
                          const struct mo_atlas_record *progress);
/* Deletes the unfinished file of a job that was cancelled or deleted, unless another job builds an
 * atlas of the same name. */
void mo_store_atlas_drop(struct mo_store *store, int64_t id);

#endif
