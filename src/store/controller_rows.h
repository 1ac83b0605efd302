/* controller_rows.h: storing and finding controllers from other source files of this room. Only for
 * this room. */
#ifndef MORPHO_STORE_CONTROLLER_ROWS_H
#define MORPHO_STORE_CONTROLLER_ROWS_H

#include "store/internal.h"

/* Finds a controller's row and sensor by name or "sha256:…", and completes the physics (nullable)
 * with its control period. MO_ERR_NOT_FOUND; MO_ERR_UNSUPPORTED: its workspace is not the default
 * one; MO_ERR_RANGE: its control period is not a whole multiple of the physics' time step. */
int mo_controller_find(struct mo_connection *connection, const char *name, int64_t *row,
                       enum mo_sensor *sensor, struct mo_physics *physics);
/* Reports the controller files that nothing refers to, or (report NULL) removes them. */
int mo_controllers_clean(struct mo_store *store,
                         void (*report)(void *context, const char *name, uint64_t bytes),
                         void *context);

/* Stores a file of weights, then its row and name. Call _begin on any thread, _row in an operation,
 * and _end in any case. */
struct mo_controller_put {
  const char *name;
  const struct mo_controller *controller;
  struct mo_sha256 sha256;
  size_t size;
  bool created, is_locked;
  int64_t row, version, stored_us; /* results */
};
/* Writes only the file, under the lock of controllers. */
int mo_controller_write_file(struct mo_store *store, const struct mo_sha256 *sha256,
                             const uint8_t *bytes, size_t size);
/* Finds or inserts a row without a name. */
int mo_controller_content_row(struct mo_connection *writer, const struct mo_controller *controller,
                              const struct mo_sha256 *sha256, size_t size, int64_t now_us,
                              int64_t *row);
int mo_controller_put_begin(struct mo_store *store, const char *name, const uint8_t *bytes,
                            size_t size, const struct mo_controller *controller,
                            struct mo_controller_put *call);
/* Returns the path of the file (malloc). */
char *mo_controller_path(const struct mo_store *store, const struct mo_sha256 *sha256);
int mo_controller_put_row(struct mo_store *store, struct mo_controller_put *call);
void mo_controller_put_end(struct mo_store *store, struct mo_controller_put *call);

#endif
