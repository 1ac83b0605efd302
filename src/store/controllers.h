/* controllers.h: files of weights, by content and by name. Threads and errors as in store.h. */
#ifndef MORPHO_STORE_CONTROLLERS_H
#define MORPHO_STORE_CONTROLLERS_H

#include "store/records.h"

struct mo_store;

struct mo_controller_record {
  char name[MO_NAME_BYTES_MAX + 1]; /* "" when looked up by hash */
  int64_t version;                  /* version of the name: grows when the name gets new content */
  struct mo_sha256 sha256;          /* of the file's bytes */
  uint64_t size;                    /* bytes */
  enum mo_sensor sensor;
  struct mo_workspace workspace;
  uint64_t n_parameters;
  double control_period_s; /* 0: in every step */
  int64_t stored_us; /* when this name got this content (by hash: when the content was stored) */
};

int64_t mo_store_controllers(struct mo_store *store, const char *after_name,
                             struct mo_controller_record *records,
                             size_t limit); /* in order of names; after_name NULL: from the first */
/* `name`: a name, or "sha256:<64 hex>". MO_ERR_NOT_FOUND. */
int mo_store_controller(struct mo_store *store, const char *name,
                        struct mo_controller_record *record);
/* Reads the bytes of a controller's file (malloc) and checks their hash: MO_ERR_CORRUPT. */
int mo_store_controller_bytes(struct mo_store *store, const struct mo_sha256 *sha256,
                              uint8_t **bytes, size_t *size);
/* Reads a controller's metadata, a JSON object (malloc). */
int mo_store_controller_metadata(struct mo_store *store, const struct mo_sha256 *sha256,
                                 char **json);

/* Stores bytes under a name, or points an existing name to them. The caller has decoded the bytes
 * with mo_controller_decode and passes the result. *created: the name is new. MO_ERR_FORMAT: not a
 * name ([a-z0-9][a-z0-9._-]{0,63}). */
int mo_store_controller_put(struct mo_store *store, const char *name, const uint8_t *bytes,
                            size_t size, const struct mo_controller *controller,
                            struct mo_controller_record *record, bool *created);
/* Removes a name. The content stays. MO_ERR_NOT_FOUND. */
int mo_store_controller_remove(struct mo_store *store, const char *name);
/* Removes content ("sha256:…") and its file. Reads all scores. MO_ERR_NOT_FOUND; MO_ERR_CONFLICT:
 * something refers to it; `message` says what. */
int mo_store_controller_delete(struct mo_store *store, const char *reference,
                               struct mo_message *message);
int mo_controller_name_check(const char *name); /* MO_OK or MO_ERR_FORMAT */

#endif
