/* phylogeny.c: ancestors, descendants and Newick text against what recursion says, and a tree too
 * deep for recursion. */
#include "fixture.h"

#define N 300

static struct mo_descent descents[N];
static uint32_t born[N];

/* Births in order; parents anywhere before, some without. */
static void make_up(uint32_t step)
{
  struct mo_random random = check_stream(step, 0);
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

static void ancestors(void)
{
  for (uint32_t step = 0; step < 20; step++) {
    make_up(step);
    for (uint32_t number = 0; number < N; number += 7) {
      uint8_t marks[N] = {0}, expected[N] = {0};
      mo_ancestors(descents, N, number, marks);
      climb(number, expected);
      CHECK(memcmp(marks, expected, N) == 0);
      CHECK(!marks[number]);
    }
  }
}

static void descendants(void)
{
  for (uint32_t step = 0; step < 20; step++) {
    make_up(step);
    for (uint32_t number = 0; number < N; number += 7) {
      uint8_t marks[N] = {0}, expected[N] = {0};
      mo_descendants(descents, N, number, marks);
      for (uint32_t i = 0; i < N; i++) { /* whose ancestor it is */
        uint8_t above[N] = {0};
        climb(i, above);
        expected[i] = above[number];
      }
      CHECK(memcmp(marks, expected, N) == 0);
    }
  }
}

static void numbers_outside(void)
{
  uint8_t marks[N] = {0};
  make_up(1);
  mo_ancestors(descents, N, N, marks);
  mo_descendants(descents, N, N, marks);
  descents[0].parents[0] = 0; /* damaged data: its own parent, and one that is younger */
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
  size_t length, room, pieces, stop_after;
};

static int append(void *context, const char *bytes, size_t length)
{
  struct text *text = context;
  if (text->stop_after > 0 && ++text->pieces > text->stop_after)
    return 17;
  if (text->length + length + 1 > text->room) {
    text->room = 2 * text->room + length + 1;
    char *more = realloc(text->bytes, text->room);
    if (more == NULL)
      return MO_ERR_NO_MEMORY;
    text->bytes = more;
  }
  memcpy(text->bytes + text->length, bytes, length);
  text->length += length;
  text->bytes[text->length] = '\0';
  return 0;
}

static int append_text(struct text *text, const char *bytes)
{
  return append(text, bytes, strlen(bytes));
}

static void recurse(struct text *text, const uint8_t *kept, uint32_t number)
{
  char label[64];
  bool any = false;
  for (uint32_t i = number + 1; i < N; i++)
    if (kept[i] && descents[i].parents[0] == number) {
      append_text(text, any ? "," : "(");
      recurse(text, kept, i);
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
    struct mo_random random = check_stream(step, 1);
    struct text made = {0}, expected = {0};
    uint8_t keep[N], kept[N];
    make_up(step);
    for (uint32_t i = 0; i < N; i++)
      keep[i] = kept[i] = step % 2 == 0 || mo_random_below(&random, 20) == 0;
    for (uint32_t i = N; i-- > 0;)
      if (kept[i] && descents[i].parents[0] != MO_NO_PARENT)
        kept[descents[i].parents[0]] = 1;
    for (uint32_t i = 0; i < N; i++)
      if (kept[i] && descents[i].parents[0] == MO_NO_PARENT) {
        recurse(&expected, kept, i);
        append_text(&expected, ";\n");
      }
    CHECK_INT(mo_newick(descents, born, step % 2 == 0 ? NULL : keep, N, append, &made), MO_OK);
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
  static const uint8_t keep[] = {0, 0, 0, 0, 1};
  struct text all = {0}, one = {0}, none = {0};
  CHECK_INT(mo_newick(few, when, NULL, 5, append, &all), MO_OK);
  CHECK_TEXT(all.bytes, "((n4:3)n2:1,n3:1)n0;\nn1;\n");
  CHECK_INT(mo_newick(few, when, keep, 5, append, &one), MO_OK);
  CHECK_TEXT(one.bytes, "((n4:3)n2:1)n0;\n");
  CHECK_INT(mo_newick(few, when, NULL, 0, append, &none), MO_OK);
  CHECK(none.bytes == NULL);
  free(all.bytes);
  free(one.bytes);
}

/* One line of 200,000 generations, and another of 200,000 children. */
static void depth(void)
{
  const uint32_t n = 200000;
  struct mo_descent *chain = calloc(n, sizeof(*chain));
  uint32_t *when = calloc(n, sizeof(*when));
  uint8_t *marks = calloc(n, 1);
  REQUIRE(chain != NULL && when != NULL && marks != NULL);
  for (int star = 0; star < 2; star++) {
    struct text text = {0};
    for (uint32_t i = 0; i < n; i++) {
      chain[i] = (struct mo_descent){{i == 0 ? MO_NO_PARENT
                                      : star ? 0
                                             : i - 1,
                                      MO_NO_PARENT},
                                     MO_BORN_MUTATION};
      when[i] = i == 0 ? 0 : star ? 1 : i;
    }
    CHECK_INT(mo_newick(chain, when, NULL, n, append, &text), MO_OK);
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
    /* What `write` returns ends it. */
    struct text stopped = {.stop_after = 2};
    CHECK_INT(mo_newick(chain, when, NULL, n, append, &stopped), 17);
    CHECK(stopped.pieces == 3 && stopped.length < text.length);
    free(stopped.bytes);
    free(text.bytes);
  }
  free(chain);
  free(when);
  free(marks);
}

static const struct check_case cases[] = {
    {"ancestors as recursion finds them", ancestors},
    {"descendants are those whose ancestor it is", descendants},
    {"numbers outside and parents that are none", numbers_outside},
    {"newick as recursion writes it", newick},
    {"newick by hand", newick_by_hand},
    {"a line of 200,000 generations and a family of 200,000", depth},
};
CHECK_MAIN(cases)
