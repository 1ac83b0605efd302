/* phylogeny.c: ancestors, descendants and Newick text compared with recursive versions, and a tree
 * that is too deep for recursion. */
#include "fixture.h"

#define N 300

static struct mo_descent descents[N];
static uint32_t born[N];

/* Draws births in order; each parent is any earlier design, and some designs have no parents. */
static void make_up(uint32_t step)
{
  struct mo_random random = dice(77, step, 0);
  for (uint32_t i = 0; i < N; i++) {
    uint32_t first = MO_NO_PARENT, second = MO_NO_PARENT;
    born[i] = 0;
    if (i >= 5 && mo_random_below(&random, 10) > 0) {
      first = mo_random_below(&random, i);
      born[i] = born[first];
      if (mo_random_below(&random, 3) > 0) {
        second = mo_random_below(&random, i);
        born[i] = born[second] > born[i] ? born[second] : born[i];
      }
      born[i] += 1 + mo_random_below(&random, 3);
    }
    descents[i] = (struct mo_descent){{first, second}, MO_BORN_RANDOM};
  }
}

static void climb(uint32_t number, uint8_t *marks)
{
  for (int k = 0; k < 2; k++) {
    const uint32_t parent = descents[number].parents[k];
    if (parent != MO_NO_PARENT && !marks[parent]) {
      marks[parent] = 1;
      climb(parent, marks);
    }
  }
}

static void ancestors_and_descendants(void)
{
  for (uint32_t step = 0; step < 20; step++) {
    make_up(step);
    for (uint32_t number = 0; number < N; number += 7) {
      uint8_t above[N] = {0}, below[N] = {0}, expected[N] = {0};
      mo_ancestors(descents, N, number, above);
      mo_descendants(descents, N, number, below);
      climb(number, expected);
      CHECK(SAME(above, expected, N));
      CHECK(!above[number]);
      for (uint32_t i = 0; i < N; i++) { /* the designs that have this ancestor */
        uint8_t marks[N] = {0};
        climb(i, marks);
        CHECK(below[i] == marks[number]);
      }
    }
  }
}

static void numbers_outside(void)
{
  uint8_t marks[N] = {0};
  make_up(1);
  mo_ancestors(descents, N, N, marks);
  mo_descendants(descents, N, N, marks);
  descents[0].parents[0] = 0; /* damaged data: itself, and a younger parent */
  descents[1].parents[0] = N + 1;
  descents[2].parents[0] = 250;
  for (uint32_t i = 0; i < 3; i++)
    mo_ancestors(descents, N, i, marks);
  for (uint32_t i = 0; i < N; i++)
    CHECK(!marks[i]);
}

/* ---- Newick ---- */

struct text {
  char *bytes;
  size_t length, room;
};

static void append(struct text *text, const char *bytes, size_t length)
{
  if (text->length + length + 1 > text->room) {
    text->room = 2 * text->room + length + 1;
    text->bytes = realloc(text->bytes, text->room);
    REQUIRE(text->bytes != NULL);
  }
  memcpy(text->bytes + text->length, bytes, length);
  text->length += length;
  text->bytes[text->length] = '\0';
}

static void append_text(struct text *text, const char *bytes)
{
  append(text, bytes, strlen(bytes));
}

/* Writes the Newick text in pieces of at most `size` bytes. */
static struct text make_newick(const struct mo_descent *of, const uint32_t *when, uint32_t n,
                               size_t size)
{
  struct mo_newick *tree = NULL;
  struct text text = {0};
  char part[1000];
  size_t length;
  bool more = mo_newick_create(of, when, n, &tree) == MO_OK;
  CHECK(more);
  while (more) {
    more = mo_newick_next(tree, part, size, &length);
    CHECK(length <= size && (!more || length > size - MO_NEWICK_PIECE));
    append(&text, part, length);
  }
  mo_newick_free(tree);
  return text;
}

static void recurse(struct text *text, uint32_t number)
{
  char label[64];
  bool any = false;
  for (uint32_t i = number + 1; i < N; i++)
    if (descents[i].parents[0] == number) {
      append_text(text, any ? "," : "(");
      recurse(text, i);
      any = true;
    }
  if (any)
    append_text(text, ")");
  const uint32_t parent = descents[number].parents[0];
  if (parent == MO_NO_PARENT)
    snprintf(label, sizeof(label), "n%u", number);
  else
    snprintf(label, sizeof(label), "n%u:%u", number, born[number] - born[parent]);
  append_text(text, label);
}

static void newick(void)
{
  for (uint32_t step = 0; step < 40; step++) {
    struct text expected = {0};
    make_up(step);
    for (uint32_t i = 0; i < N; i++)
      if (descents[i].parents[0] == MO_NO_PARENT) {
        recurse(&expected, i);
        append_text(&expected, ";\n");
      }
    struct text made = make_newick(descents, born, N, step % 2 == 0 ? MO_NEWICK_PIECE : 1000);
    REQUIRE(made.bytes != NULL && expected.bytes != NULL);
    CHECK_TEXT(made.bytes, expected.bytes);
    free(made.bytes);
    free(expected.bytes);
  }
}

static void newick_by_hand(void)
{
  static const struct mo_descent few[] = {{{MO_NO_PARENT, MO_NO_PARENT}, MO_BORN_RANDOM},
                                          {{MO_NO_PARENT, MO_NO_PARENT}, MO_BORN_RANDOM},
                                          {{0, 1}, MO_BORN_CROSSOVER},
                                          {{0, MO_NO_PARENT}, MO_BORN_MUTATION},
                                          {{2, MO_NO_PARENT}, MO_BORN_MUTATION}};
  static const uint32_t when[] = {0, 0, 1, 1, 4};
  struct text all = make_newick(few, when, 5, 100), none = make_newick(few, when, 0, 100);
  CHECK_TEXT(all.bytes, "((n4:3)n2:1,n3:1)n0;\nn1;\n");
  CHECK_INT(none.length, 0);
  free(all.bytes);
  free(none.bytes);
}

/* One line of 200,000 generations, and one design with 200,000 children. */
static void depth(void)
{
  const uint32_t n = 200000;
  struct mo_descent *chain = make_zeros(n, sizeof(*chain));
  uint32_t *when = make_zeros(n, sizeof(*when));
  uint8_t *marks = make_zeros(n, 1);
  for (int star = 0; star < 2; star++) {
    for (uint32_t i = 0; i < n; i++) {
      chain[i] = (struct mo_descent){{i == 0 ? MO_NO_PARENT
                                      : star ? 0
                                             : i - 1,
                                      MO_NO_PARENT},
                                     MO_BORN_MUTATION};
      when[i] = i == 0 ? 0 : star ? 1 : i;
    }
    struct text text = make_newick(chain, when, n, 1000);
    REQUIRE(text.bytes != NULL);
    size_t open = 0, labels = 0;
    for (size_t i = 0; i < text.length; i++) {
      open += text.bytes[i] == '(';
      labels += text.bytes[i] == ':';
    }
    CHECK_INT(open, star ? 1 : n - 1);
    CHECK_INT(labels, n - 1);
    CHECK_TEXT(text.bytes + text.length - 5, ")n0;\n");
    memset(marks, 0, n);
    mo_ancestors(chain, n, n - 1, marks);
    uint32_t above = 0, below = 0;
    for (uint32_t i = 0; i < n; i++)
      above += marks[i];
    memset(marks, 0, n);
    mo_descendants(chain, n, 0, marks);
    for (uint32_t i = 0; i < n; i++)
      below += marks[i];
    CHECK_INT(above, star ? 1 : n - 1);
    CHECK_INT(below, n - 1);
    free(text.bytes);
  }
}

static const struct check_case cases[] = {
    {"ancestors and descendants, compared with recursion", ancestors_and_descendants},
    {"out-of-range numbers and invalid parents", numbers_outside},
    {"newick, compared with recursion", newick},
    {"newick by hand", newick_by_hand},
    {"a line of 200,000 generations and a family of 200,000", depth},
};
CHECK_MAIN(cases)
