/* memory.c: every allocation of the room fails once, in turn. The call must report it, leave its
 * outputs unchanged, leak nothing (checked by the address sanitizer), and succeed when memory is
 * available again. Linked with --wrap for the allocating functions. */
#include "../failing.h"
#include "../make.h"

static const struct mo_workspace large = {13, 12, 27}; /* too large for the stack */
#define WORDS 66

static struct mo_lattice *lattice;
static uint64_t body_bits[WORDS];
static uint64_t other_bits[WORDS];

static int create_lattice(void)
{
  struct mo_lattice *made = NULL;
  int code = mo_lattice_create(large, &made);
  CHECK((made == NULL) == (code != MO_OK));
  mo_lattice_free(made);
  return code;
}

static int create_body(void)
{
  struct mo_body *made = NULL;
  int code = mo_body_create(lattice, body_bits, &made);
  CHECK((made == NULL) == (code != MO_OK));
  mo_body_free(made);
  return code;
}

/* Calls that write a genotype: a failure leaves the genotype unchanged. */
static int written(int code, const uint64_t bits[WORDS])
{
  for (int w = 0; w < WORDS && code < 0; w++)
    CHECK(bits[w] == 0);
  return code;
}

static int draw_random(void)
{
  struct mo_random random = dice(1, 0, 0);
  uint64_t bits[WORDS] = {0};
  return written(mo_genotype_random(large, &random, bits), bits);
}

static int mutate(void)
{
  struct mo_random random = dice(2, 0, 0);
  uint64_t bits[WORDS] = {0};
  return written(mo_genotype_mutate(large, body_bits, 0.01, &random, bits), bits);
}

static int cross(void)
{
  uint64_t bits[WORDS] = {0};
  return written(mo_genotype_crossover(large, body_bits, other_bits, bits), bits);
}

static int read_cells(void)
{
  const int64_t cells[2][3] = {{0, 0, 0}, {0, 0, 1}};
  uint64_t bits[WORDS] = {0};
  return written(mo_genotype_from_cells(large, cells, 2, bits, NULL), bits);
}

static int read_text(void)
{
  char text[WORDS * 64 + 1];
  uint64_t bits[WORDS] = {0};
  mo_genotype_to_text(large, body_bits, text);
  return written(mo_genotype_from_text(large, text, mo_workspace_voxels(large), bits, NULL), bits);
}

static int read_id(void)
{
  char id[WORDS * 16 + 1];
  uint64_t bits[WORDS] = {0};
  const int code = mo_genotype_id(large, body_bits, id);
  if (code != MO_OK)
    return code;
  return written(mo_genotype_from_id(large, id, strlen(id), bits), bits);
}

static int read_robot(void)
{
  char robot[WORDS * 16 + 3];
  uint64_t bits[WORDS] = {0};
  int k = 0;
  const int code = mo_genotype_robot(large, body_bits, robot);
  if (code != MO_OK)
    return code;
  return written(mo_genotype_from_robot(large, robot, strlen(robot), bits, &k), bits);
}

static int contiguous(void)
{
  return mo_genotype_is_contiguous(large, body_bits) == 1 ? MO_OK : MO_ERR_NO_MEMORY;
}

static int keep_largest(void)
{
  uint64_t bits[WORDS];
  memcpy(bits, body_bits, sizeof(bits));
  int code = mo_genotype_keep_largest(large, bits);
  CHECK(memcmp(bits, body_bits, sizeof(bits)) == 0);
  return code;
}

static int create_set(void)
{
  struct mo_form_set *set = NULL;
  int code = mo_form_set_create(large, &set);
  CHECK((set == NULL) == (code != MO_OK));
  mo_form_set_free(set);
  return code;
}

static int create_stream(void)
{
  struct mo_body_stream *stream = NULL;
  int code = mo_body_stream_create(large, 1, &stream);
  CHECK((stream == NULL) == (code != MO_OK));
  mo_body_stream_free(stream);
  return code;
}

static void every_allocation(void)
{
  struct mo_random random = dice(3, 0, 0);
  while (mo_genotype_count(large, body_bits) < 300)
    REQUIRE(mo_genotype_random(large, &random, body_bits) == MO_OK);
  REQUIRE(mo_genotype_random(large, &random, other_bits) == MO_OK);
  lattice = make_lattice(large);
  each_fails(create_lattice, 2);
  each_fails(create_body, 2);
  each_fails(draw_random, 3);
  each_fails(mutate, 3);
  each_fails(cross, 3);
  each_fails(read_cells, 2);
  each_fails(read_text, 3);
  each_fails(read_id, 4);
  each_fails(read_robot, 5);
  each_fails(contiguous, 2);
  each_fails(keep_largest, 2);
  each_fails(create_set, 1);
  each_fails(create_stream, 4);
}

/* A set that cannot grow stays unchanged, and can grow later. */
static void growing_set(void)
{
  const struct mo_workspace home = MO_DEFAULT_WORKSPACE;
  struct mo_form_set *set = make_form_set(home);
  int failures = 0;
  for (uint64_t i = 1; i <= 20000; i++) {
    const uint64_t form[3] = {i, i * i, 0};
    left = 0;
    int code = mo_form_set_add(set, form);
    left = -1;
    if (code != 1) {
      failures++;
      CHECK_INT(code, MO_ERR_NO_MEMORY);
      CHECK_INT(mo_form_set_count(set), i - 1);
      CHECK_INT(mo_form_set_has(set, form), 0);
      CHECK_INT(mo_form_set_add(set, form), 1);
    }
  }
  CHECK(failures > 256);
  for (uint64_t i = 1; i <= 20000; i++) {
    const uint64_t form[3] = {i, i * i, 0};
    CHECK_INT(mo_form_set_has(set, form), 1);
  }
}

/* A stream interrupted by a lack of memory continues with the next body. */
static void interrupted_stream(void)
{
  const struct mo_workspace home = MO_DEFAULT_WORKSPACE;
  struct mo_body_stream *calm = make_body_stream(home, 1);
  struct mo_body_stream *rough = make_body_stream(home, 1);
  int failures = 0;
  for (int i = 0; i < 5000; i++) {
    uint64_t a[3];
    uint64_t b[3];
    REQUIRE(mo_body_stream_next(calm, a, NULL) == MO_OK);
    left = 0;
    int code = mo_body_stream_next(rough, b, NULL);
    left = -1;
    if (code != MO_OK) {
      failures++;
      CHECK_INT(code, MO_ERR_NO_MEMORY);
      REQUIRE(mo_body_stream_next(rough, b, NULL) == MO_OK);
    }
    CHECK(memcmp(a, b, sizeof(a)) == 0);
  }
  CHECK(failures > 100);
  CHECK_INT(mo_body_stream_draws(calm), mo_body_stream_draws(rough));
}

static const struct check_case cases[] = {
    {"every allocation may fail", every_allocation},
    {"a set that cannot grow stays intact", growing_set},
    {"a stream continues where it was", interrupted_stream},
};
CHECK_MAIN(cases)
