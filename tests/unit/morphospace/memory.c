/* memory.c: every allocation of the room fails once, in turn. The call must say so, leave its
 * outputs as they were, leak nothing (the address sanitizer looks), and succeed when memory is
 * back. Linked with --wrap for the allocating functions. */
#include "../check.h"

#include <morpho/morphospace.h>

void *__real_malloc(size_t size);
void *__real_calloc(size_t count, size_t size);
void *__real_aligned_alloc(size_t alignment, size_t size);
void *__wrap_malloc(size_t size);
void *__wrap_calloc(size_t count, size_t size);
void *__wrap_aligned_alloc(size_t alignment, size_t size);

static long fail_at = -1; /* allocations until one fails; negative: never */

static int fails(void)
{
  return fail_at >= 0 && fail_at-- == 0;
}

void *__wrap_malloc(size_t size)
{
  return fails() ? NULL : __real_malloc(size);
}

void *__wrap_calloc(size_t count, size_t size)
{
  return fails() ? NULL : __real_calloc(count, size);
}

void *__wrap_aligned_alloc(size_t alignment, size_t size)
{
  return fails() ? NULL : __real_aligned_alloc(alignment, size);
}

static const struct mo_workspace large = {13, 12, 11}; /* beyond what fits the stack */
#define WORDS 27

/* Runs `call` with its first, second, … allocation failing until it succeeds; returns how many
 * could fail. */
static int exhaust(int (*call)(void))
{
  for (int k = 0; k < 1000; k++) {
    fail_at = k;
    int code = call();
    int reached = fail_at < 0;
    fail_at = -1;
    if (!reached) {
      CHECK(code >= 0);
      return k;
    }
    CHECK_INT(code, MO_ERR_NO_MEMORY);
  }
  return -1;
}

static struct mo_lattice *lattice;
static uint64_t body_bits[WORDS];
static uint64_t other_bits[WORDS];

static int make_lattice(void)
{
  struct mo_lattice *made = NULL;
  int code = mo_lattice_create(large, &made);
  CHECK((made == NULL) == (code != MO_OK));
  mo_lattice_free(made);
  return code;
}

static int make_body(void)
{
  struct mo_body *made = NULL;
  int code = mo_body_create(lattice, body_bits, &made);
  CHECK((made == NULL) == (code != MO_OK));
  mo_body_free(made);
  return code;
}

/* Runs one of the calls that write a genotype and checks that a failure leaves it alone. */
static int write_bits(int (*call)(uint64_t *bits))
{
  uint64_t bits[WORDS];
  memset(bits, 0x5a, sizeof(bits));
  int code = call(bits);
  if (code < 0) {
    for (int w = 0; w < WORDS; w++) {
      CHECK(bits[w] == UINT64_C(0x5a5a5a5a5a5a5a5a));
    }
  }
  return code;
}

static int call_random(uint64_t *bits)
{
  struct mo_random random;
  mo_random_init(&random, 1, MO_PURPOSE_CHECK, 0, 0);
  return mo_genotype_random(large, &random, bits);
}

static int call_mutate(uint64_t *bits)
{
  struct mo_random random;
  mo_random_init(&random, 2, MO_PURPOSE_CHECK, 0, 0);
  return mo_genotype_mutate(large, body_bits, 0.01, &random, bits);
}

static int call_crossover(uint64_t *bits)
{
  return mo_genotype_crossover(large, body_bits, other_bits, bits);
}

static int call_cells(uint64_t *bits)
{
  const int64_t cells[2][3] = {{0, 0, 0}, {0, 0, 1}};
  return mo_genotype_from_cells(large, cells, 2, bits, NULL);
}

static int call_text(uint64_t *bits)
{
  char text[WORDS * 64 + 1];
  mo_genotype_to_text(large, body_bits, text);
  return mo_genotype_from_text(large, text, mo_workspace_voxels(large), bits, NULL);
}

static int call_id(uint64_t *bits)
{
  char id[WORDS * 16 + 1];
  mo_genotype_id(large, body_bits, id);
  return mo_genotype_from_id(large, id, strlen(id), bits);
}

static int draw_random(void)
{
  return write_bits(call_random);
}

static int mutate(void)
{
  return write_bits(call_mutate);
}

static int cross(void)
{
  return write_bits(call_crossover);
}

static int read_cells(void)
{
  return write_bits(call_cells);
}

static int read_text(void)
{
  return write_bits(call_text);
}

static int read_id(void)
{
  return write_bits(call_id);
}

static int contiguous(void)
{
  return mo_genotype_is_contiguous(large, body_bits);
}

static int keep_largest(void)
{
  uint64_t bits[WORDS];
  memcpy(bits, body_bits, sizeof(bits));
  int code = mo_genotype_keep_largest(large, bits);
  CHECK(memcmp(bits, body_bits, sizeof(bits)) == 0);
  return code;
}

static int make_set(void)
{
  struct mo_form_set *set = NULL;
  int code = mo_form_set_create(large, &set);
  CHECK((set == NULL) == (code != MO_OK));
  mo_form_set_free(set);
  return code;
}

static int make_stream(void)
{
  struct mo_body_stream *stream = NULL;
  int code = mo_body_stream_create(large, 1, &stream);
  CHECK((stream == NULL) == (code != MO_OK));
  mo_body_stream_free(stream);
  return code;
}

static void every_allocation(void)
{
  struct mo_random random;
  mo_random_init(&random, 3, MO_PURPOSE_CHECK, 0, 0);
  while (mo_genotype_count(large, body_bits) < 300) {
    REQUIRE(mo_genotype_random(large, &random, body_bits) == MO_OK);
  }
  REQUIRE(mo_genotype_random(large, &random, other_bits) == MO_OK);
  REQUIRE(mo_lattice_create(large, &lattice) == MO_OK);
  CHECK_INT(exhaust(make_lattice), 7);
  CHECK_INT(exhaust(make_body), 2);
  CHECK_INT(exhaust(draw_random), 4);
  CHECK_INT(exhaust(mutate), 3);
  CHECK_INT(exhaust(cross), 3);
  CHECK_INT(exhaust(read_cells), 3);
  CHECK_INT(exhaust(read_text), 3);
  CHECK_INT(exhaust(read_id), 4);
  CHECK_INT(exhaust(contiguous), 2);
  CHECK_INT(exhaust(keep_largest), 2);
  CHECK_INT(exhaust(make_set), 1);
  CHECK_INT(exhaust(make_stream), 4);
  mo_lattice_free(lattice);
}

/* A set that cannot grow stays as it was, and grows later. */
static void growing_set(void)
{
  const struct mo_workspace home = MO_DEFAULT_WORKSPACE;
  struct mo_form_set *set = NULL;
  REQUIRE(mo_form_set_create(home, &set) == MO_OK);
  int failures = 0;
  for (uint64_t i = 1; i <= 20000; i++) {
    const uint64_t form[3] = {i, i * i, 0};
    fail_at = 0;
    int code = mo_form_set_add(set, form);
    fail_at = -1;
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
  mo_form_set_free(set);
}

/* A stream interrupted by a lack of memory goes on with the body that was due. */
static void interrupted_stream(void)
{
  const struct mo_workspace home = MO_DEFAULT_WORKSPACE;
  struct mo_body_stream *calm = NULL;
  struct mo_body_stream *rough = NULL;
  REQUIRE(mo_body_stream_create(home, 1, &calm) == MO_OK);
  REQUIRE(mo_body_stream_create(home, 1, &rough) == MO_OK);
  int failures = 0;
  for (int i = 0; i < 5000; i++) {
    uint64_t a[3];
    uint64_t b[3];
    REQUIRE(mo_body_stream_next(calm, a) == MO_OK);
    fail_at = 0;
    int code = mo_body_stream_next(rough, b);
    fail_at = -1;
    if (code != MO_OK) {
      failures++;
      CHECK_INT(code, MO_ERR_NO_MEMORY);
      REQUIRE(mo_body_stream_next(rough, b) == MO_OK);
    }
    CHECK(memcmp(a, b, sizeof(a)) == 0);
  }
  CHECK(failures > 100);
  CHECK_INT(mo_body_stream_draws(calm), mo_body_stream_draws(rough));
  mo_body_stream_free(calm);
  mo_body_stream_free(rough);
}

static const struct check_case cases[] = {
    {"every allocation may fail", every_allocation},
    {"a set that cannot grow stays whole", growing_set},
    {"a stream goes on where it was", interrupted_stream},
};
CHECK_MAIN(cases)
