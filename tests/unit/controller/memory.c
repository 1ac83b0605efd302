/* memory.c: every allocation of this room and of the reference rollout fails once. Each time the
 * function must report the error, leave its outputs unchanged, and leak nothing (checked by the
 * address sanitizer). */
#include "../failing.h"
#include "../make.h"

#include <jansson.h>

static const struct mo_workspace tiny = {1, 1, 1};
static struct mo_controller *shared;
static struct mo_body *body;
static uint8_t *file;
static size_t file_size;

static int create(void)
{
  struct mo_controller *c = NULL;
  const int r = mo_controller_create(tiny, MO_SENSOR_INVERSE_SQRT, &c);
  CHECK((c != NULL) == (r == MO_OK));
  mo_controller_free(c);
  return r;
}

static int decode(void)
{
  struct mo_controller *c = NULL;
  struct mo_message message = {""};
  const int r = mo_controller_decode(file, file_size, &c, &message);
  CHECK((c != NULL) == (r == MO_OK));
  CHECK((message.text[0] != '\0') == (r != MO_OK));
  if (c != NULL) {
    CHECK(SAME(c->parameters, shared->parameters, c->n_parameters));
    CHECK_INT(c->n_metadata, shared->n_metadata);
    for (size_t i = 0; i < c->n_metadata && i < shared->n_metadata; i++)
      CHECK(strcmp(c->metadata[i].value, shared->metadata[i].value) == 0);
  }
  mo_controller_free(c);
  return r == MO_ERR_FORMAT ? MO_ERR_NO_MEMORY
                            : r; /* the JSON parser cannot report why it failed */
}

static int encode(void)
{
  uint8_t *bytes = NULL;
  size_t size = 0;
  const int r = mo_controller_encode(shared, &bytes, &size);
  CHECK((bytes != NULL) == (r == MO_OK));
  CHECK(r != MO_OK || (size == file_size && SAME(bytes, file, size)));
  free(bytes);
  return r;
}

static int put(void)
{
  const int r = mo_controller_set_metadata(shared, "a key", "a value");
  CHECK((mo_controller_get_metadata(shared, "a key") != NULL) == (r == MO_OK));
  return r;
}

static int rollout(void)
{
  struct mo_environment environment = {.light_xy_m = {1, 1}};
  const struct mo_physics physics = physics_of(3);
  struct mo_outcome outcome = {.loss = -1};
  double values[1][MO_MEASURES];
  const struct mo_measuring measuring = {MO_MEASURES_ALL, values};
  const int r =
      mo_rollout_reference(body, shared, &environment, &physics, NULL, &measuring, &outcome);
  CHECK((outcome.loss > 0) == (r == MO_OK));
  return r;
}

static void every_allocation(void)
{
  const uint64_t bits = 1;
  json_object_seed(1);
  json_set_alloc_funcs(__wrap_malloc, free);
  shared = make_controller(tiny, MO_SENSOR_INVERSE_SQRT);
  body = make_body(make_lattice(tiny), &bits);
  REQUIRE(mo_controller_encode(shared, &file, &file_size) == MO_OK);
  check_keep(file, free);
  each_fails(create, 10);
  each_fails(decode, 50);
  each_fails(encode, 1);
  each_fails(rollout, 1);
  each_fails(put, 3);
}

static const struct check_case cases[] = {{"each allocation fails once", every_allocation}};
CHECK_MAIN(cases)
