/* target.h: shared by the fuzz targets. A target reads hostile bytes. It may refuse them, but must
 * not crash, leak, or accept anything that breaks a promise: FUZZ_PROMISE(condition) aborts the run
 * and prints the promise. */
#ifndef MORPHO_TESTS_FUZZ_TARGET_H
#define MORPHO_TESTS_FUZZ_TARGET_H

#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

#define FUZZ_PROMISE(condition)                                                                    \
  do {                                                                                             \
    if (!(condition)) {                                                                            \
      fprintf(stderr, "%s:%d: broken promise: %s\n", __FILE__, __LINE__, #condition);              \
      abort();                                                                                     \
    }                                                                                              \
  } while (0)

#endif
