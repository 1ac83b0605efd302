/* state.c: see state.h. */
#include "state.h"

#include "bench.h"

#include <ftw.h>
#include <stdlib.h>

static char folder[512];

static int remove_entry(const char *path, const struct stat *status, int kind, struct FTW *place)
{
  (void)status;
  (void)kind;
  (void)place;
  return remove(path);
}

static void remove_folder(void)
{
  (void)nftw(folder, remove_entry, 16, FTW_DEPTH | FTW_PHYS);
}

const char *bench_state_make(const char *parent)
{
  snprintf(folder, sizeof(folder), "%s/morpho-bench-XXXXXX", parent);
  if (mkdtemp(folder) == NULL) {
    fprintf(stderr, "morpho-bench: cannot make a folder in %s\n", parent);
    exit(1);
  }
  atexit(remove_folder);
  return folder;
}

struct mo_store *bench_state_open(const char *path)
{
  const struct mo_store_config config = {.path = path};
  struct mo_store *store = NULL;
  struct mo_controller_record record;
  struct mo_controller *controller = NULL;
  uint8_t *bytes = NULL;
  size_t size = 0;
  bool created;
  bench_check(mo_store_open(&config, &store, NULL), "store");
  bench_check(mo_controller_create(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT, &controller),
              "controller");
  bench_check(mo_controller_encode(controller, &bytes, &size), "controller");
  bench_check(mo_store_controller_put(store, "default", bytes, size, controller, &record, &created),
              "controller");
  free(bytes);
  mo_controller_free(controller);
  return store;
}
