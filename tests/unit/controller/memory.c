/* memory.c: every allocation of this room and of the reference rollout fails once; each time the
 * function says so, leaves its outputs alone and leaks nothing (the address sanitizer looks). */
#include "../check.h"
#include "../failing.h"

#include <jansson.h>

#include <morpho/rollout.h>

static int reached; /* whether the failing allocation was asked for in the last call */

static void stop_failing(void)
{
  reached = left < 0;
  left = -1;
}

static const struct mo_workspace tiny = {1, 1, 1};
static struct mo_controller *shared;
static uint8_t *file;
static size_t file_size;

static int create(void)
{
  struct mo_controller *c = NULL;
  const int r = mo_controller_create(tiny, MO_SENSOR_INVERSE_SQRT, &c);
  stop_failing();
  CHECK((c != NULL) == (r == MO_OK));
  mo_controller_free(c);
  return r;
}

static int decode(void)
{
  struct mo_controller *c = NULL;
  struct mo_message message = {""};
  const int r = mo_controller_decode(file, file_size, &c, &message);
  stop_failing();
  CHECK((c != NULL) == (r == MO_OK));
  CHECK((message.text[0] != '\0') == (r != MO_OK));
  if (c != NULL) {
    CHECK(memcmp(c->parameters, shared->parameters, c->n_parameters * sizeof(float)) == 0);
    CHECK_INT(c->n_metadata, shared->n_metadata);
    for (size_t i = 0; i < c->n_metadata && i < shared->n_metadata; i++)
      CHECK(strcmp(c->metadata[i].value, shared->metadata[i].value) == 0);
  }
  mo_controller_free(c);
  return r == MO_ERR_FORMAT ? MO_ERR_NO_MEMORY : r; /* the JSON parser cannot tell */
}

static int encode(void)
{
  uint8_t *bytes = NULL;
  size_t size = 0;
  const int r = mo_controller_encode(shared, &bytes, &size);
  stop_failing();
  CHECK((bytes != NULL) == (r == MO_OK));
  CHECK(r != MO_OK || (size == file_size && memcmp(bytes, file, size) == 0));
  free(bytes);
  return r;
}

static int put(void)
{
  const int r = mo_controller_set_metadata(shared, "a key", "a value");
  stop_failing();
  CHECK((mo_controller_get_metadata(shared, "a key") != NULL) == (r == MO_OK));
  return r;
}

static struct mo_body *body;

static int rollout(void)
{
  struct mo_environment environment = {.light_xy_m = {1, 1}};
  struct mo_physics physics = mo_default_physics();
  physics.n_steps = 3;
  struct mo_outcome outcome = {.loss = -1};
  const int r = mo_rollout_reference(body, shared, &environment, &physics, NULL, &outcome);
  stop_failing();
  CHECK((outcome.loss > 0) == (r == MO_OK));
  return r;
}

/* Fails allocation 0, 1, 2, … until the call gets by without asking for it. */
static void exhaust(int (*call)(void), long at_least)
{
  for (long n = 0; n < 10000; n++) {
    left = n;
    const int r = call();
    if (!reached) {
      CHECK_INT(r, MO_OK);
      CHECK(n >= at_least);
      printf("# %ld allocations\n", n);
      return;
    }
    CHECK_INT(r, MO_ERR_NO_MEMORY);
  }
  CHECK(0);
}

static void creating(void)
{
  exhaust(create, 10);
}

static void decoding(void)
{
  exhaust(decode, 50);
}

static void encoding(void)
{
  exhaust(encode, 2);
}

static void rolling_out(void)
{
  exhaust(rollout, 2);
}

static void setting_metadata(void)
{
  exhaust(put, 3);
}

static const struct check_case cases[] = {{"create", creating},
                                          {"decode", decoding},
                                          {"encode", encoding},
                                          {"reference rollout", rolling_out},
                                          {"set metadata", setting_metadata}};

int main(int argc, char **argv)
{
  struct mo_lattice *lattice = NULL;
  const uint64_t bits = 1;
  json_object_seed(1);
  json_set_alloc_funcs(__wrap_malloc, free);
  if (mo_controller_create(tiny, MO_SENSOR_INVERSE_SQRT, &shared) < 0 ||
      mo_controller_encode(shared, &file, &file_size) < 0 ||
      mo_lattice_create(tiny, &lattice) < 0 || mo_body_create(lattice, &bits, &body) < 0)
    return 1;
  const int r = check_run(cases, COUNT(cases), argc, argv);
  mo_body_free(body);
  mo_lattice_free(lattice);
  mo_controller_free(shared);
  free(file);
  return r;
}
