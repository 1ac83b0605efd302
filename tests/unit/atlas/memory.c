/* memory.c: no failed allocation leaks, crashes or changes what was there. */
#include "../failing.h"

#include <morpho/atlas.h>

static int stream(void)
{
  const struct mo_atlas_class class = {MO_DEFAULT_WORKSPACE, 7};
  struct mo_atlas_bodies *bodies = NULL;
  uint64_t form[MO_DEFAULT_WORDS], counts[MO_ATLAS_VOXELS_MAX];
  int error = mo_atlas_bodies_create(&class, &bodies);
  if (error == MO_OK)
    error = mo_atlas_bodies_next(bodies, form);
  if (error == MO_OK)
    error = mo_atlas_bodies_seek(bodies, 3000);
  if (error == MO_OK)
    error = mo_atlas_bodies_count(bodies, counts);
  mo_atlas_bodies_free(bodies);
  return error;
}

static void streams(void)
{
  each_fails(stream, 20);
}

static const struct check_case cases[] = {{"a stream of bodies", streams}};
CHECK_MAIN(cases)
