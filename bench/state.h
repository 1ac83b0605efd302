/* state.h: a new state folder for a benchmark that uses the daemon's store. */
#ifndef MORPHO_BENCH_STATE_H
#define MORPHO_BENCH_STATE_H

#include "store/runner.h"

/* Makes a folder in `parent`, which is removed when the program ends, and returns its path. */
const char *bench_state_make(const char *parent);
/* Opens a store there. It has a controller named "default". */
struct mo_store *bench_state_open(const char *path);

#endif
