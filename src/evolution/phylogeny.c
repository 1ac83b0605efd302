/* phylogeny.c: ancestors, descendants and the Newick tree. Parents have lower numbers than their
 * children, so one pass over the numbers is enough at any depth of the tree: downwards for
 * ancestors, upwards for descendants. A parent whose number is not lower is ignored. */
#include "evolution/internal.h"

#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

void mo_ancestors(const struct mo_descent *descents, uint32_t n, uint32_t number, uint8_t *marks)
{
  if (number >= n)
    return;
  for (uint32_t i = number + 1; i-- > 0;) {
    if (i != number && !marks[i])
      continue;
    for (int k = 0; k < 2; k++)
      if (descents[i].parents[k] < i)
        marks[descents[i].parents[k]] = 1;
  }
}

void mo_descendants(const struct mo_descent *descents, uint32_t n, uint32_t number, uint8_t *marks)
{
  if (number >= n)
    return;
  for (uint32_t i = number + 1; i < n; i++)
    for (int k = 0; k < 2; k++) {
      const uint32_t parent = descents[i].parents[k];
      if (parent < i && (parent == number || marks[parent]))
        marks[i] = 1;
    }
}

/* ---- Newick ---- */

#define BUFFER_BYTES 8192
#define PIECE_BYTES  64 /* more than any one piece: ")n4294967295:4294967295;\n" */

struct writer {
  int (*write)(void *context, const char *text, size_t length);
  void *context;
  size_t used;
  char buffer[BUFFER_BYTES];
};

static int flush(struct writer *writer)
{
  const size_t used = writer->used;
  writer->used = 0;
  return used > 0 ? writer->write(writer->context, writer->buffer, used) : 0;
}

static int put(struct writer *writer, const char *text, size_t length)
{
  const int r = writer->used + length > BUFFER_BYTES ? flush(writer) : 0;
  if (r != 0)
    return r;
  memcpy(writer->buffer + writer->used, text, length);
  writer->used += length;
  return 0;
}

/* The forest: each design hangs on its first parent. */
struct forest {
  const struct mo_descent *descents;
  const uint32_t *born;
  uint32_t *child; /* (n) first child; MO_NO_PARENT */
  uint32_t *next;  /* (n) next child of the same parent */
  uint8_t *kept;   /* (n) */
};

static uint32_t parent_of(const struct forest *forest, uint32_t i)
{
  const uint32_t parent = forest->descents[i].parents[0];
  return parent < i ? parent : MO_NO_PARENT;
}

/* Builds the child lists from the last design to the first: a parent comes after all its children,
 * and lists end up ascending. */
static void grow(const struct forest *forest, const uint8_t *keep, uint32_t n)
{
  memset(forest->child, 0xff, n * sizeof(*forest->child));
  memset(forest->next, 0xff, n * sizeof(*forest->next));
  for (uint32_t i = n; i-- > 0;) {
    const uint32_t parent = parent_of(forest, i);
    if (keep == NULL || keep[i])
      forest->kept[i] = 1;
    if (!forest->kept[i] || parent == MO_NO_PARENT)
      continue;
    forest->kept[parent] = 1;
    forest->next[i] = forest->child[parent];
    forest->child[parent] = i;
  }
}

static int put_label(const struct forest *forest, uint32_t i, struct writer *writer)
{
  char text[PIECE_BYTES];
  const uint32_t parent = parent_of(forest, i);
  int length;
  if (parent == MO_NO_PARENT)
    length = snprintf(text, sizeof(text), "n%" PRIu32 ";\n", i);
  else
    length = snprintf(
        text, sizeof(text), "n%" PRIu32 ":%" PRIu32, i,
        forest->born[i] > forest->born[parent] ? forest->born[i] - forest->born[parent] : 0);
  return put(writer, text, (size_t)length);
}

static int put_tree(const struct forest *forest, uint32_t root, struct writer *writer)
{
  int r = 0;
  for (uint32_t i = root; r == 0;) {
    for (; r == 0 && forest->child[i] != MO_NO_PARENT; i = forest->child[i])
      r = put(writer, "(", 1);
    if (r == 0)
      r = put_label(forest, i, writer);
    while (r == 0 && i != root && forest->next[i] == MO_NO_PARENT) {
      i = parent_of(forest, i);
      r = put(writer, ")", 1);
      if (r == 0)
        r = put_label(forest, i, writer);
    }
    if (r != 0 || i == root)
      break;
    i = forest->next[i];
    r = put(writer, ",", 1);
  }
  return r;
}

int mo_newick(const struct mo_descent *descents, const uint32_t *born, const uint8_t *keep,
              uint32_t n, int (*write)(void *context, const char *text, size_t length),
              void *context)
{
  if (n == 0)
    return MO_OK;
  struct writer *writer = malloc(sizeof(*writer));
  struct forest forest = {.descents = descents,
                          .born = born,
                          .child = malloc(n * sizeof(*forest.child)),
                          .next = malloc(n * sizeof(*forest.next)),
                          .kept = calloc(n, 1)};
  int r = MO_ERR_NO_MEMORY;
  if (writer != NULL && forest.child != NULL && forest.next != NULL && forest.kept != NULL) {
    writer->write = write;
    writer->context = context;
    writer->used = 0;
    grow(&forest, keep, n);
    r = 0;
    for (uint32_t i = 0; i < n && r == 0; i++)
      if (forest.kept[i] && parent_of(&forest, i) == MO_NO_PARENT)
        r = put_tree(&forest, i, writer);
    if (r == 0)
      r = flush(writer);
  }
  free(forest.kept);
  free(forest.next);
  free(forest.child);
  free(writer);
  return r;
}
