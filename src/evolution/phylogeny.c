/* phylogeny.c: ancestors, descendants and the Newick tree. Parents have lower numbers than their
 * children, so one pass over the numbers suffices at any depth of the tree: in descending order for
 * ancestors, ascending for descendants. A parent whose number is not lower is ignored. */
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

/* The forest: each design is a child of its first parent. */
struct mo_newick {
  const struct mo_descent *descents;
  const uint32_t *born;
  uint32_t n, root; /* root: the first number that may be the root of another tree */
  uint32_t at;      /* the next design; MO_NO_PARENT: between two trees */
  bool is_open;     /* its children have been written */
  uint32_t *child;  /* (n) first child; MO_NO_PARENT */
  uint32_t *next;   /* (n) next child of the same parent */
};

static uint32_t parent_of(const struct mo_newick *newick, uint32_t i)
{
  const uint32_t parent = newick->descents[i].parents[0];
  return parent < i ? parent : MO_NO_PARENT;
}

int mo_newick_create(const struct mo_descent *descents, const uint32_t *born, uint32_t n,
                     struct mo_newick **ret)
{
  struct mo_newick *newick = malloc(sizeof(*newick));
  const size_t bytes = (n > 0 ? n : 1) * sizeof(uint32_t);
  if (newick == NULL)
    return MO_ERR_NO_MEMORY;
  *newick = (struct mo_newick){.descents = descents,
                               .born = born,
                               .n = n,
                               .at = MO_NO_PARENT,
                               .child = malloc(bytes),
                               .next = malloc(bytes)};
  if (newick->child == NULL || newick->next == NULL) {
    mo_newick_free(newick);
    return MO_ERR_NO_MEMORY;
  }
  memset(newick->child, 0xff, bytes);
  memset(newick->next, 0xff, bytes);
  for (uint32_t i = n; i-- > 0;) { /* starting with the last, so that the lists are ascending */
    const uint32_t parent = parent_of(newick, i);
    if (parent == MO_NO_PARENT)
      continue;
    newick->next[i] = newick->child[parent];
    newick->child[parent] = i;
  }
  *ret = newick;
  return MO_OK;
}

/* Writes the next piece: an opening parenthesis, or a label and the characters after it. */
static size_t step(struct mo_newick *newick, char text[MO_NEWICK_PIECE])
{
  const uint32_t i = newick->at, parent = parent_of(newick, i), *born = newick->born;
  if (!newick->is_open && newick->child[i] != MO_NO_PARENT) {
    newick->at = newick->child[i];
    text[0] = '(';
    return 1;
  }
  if (parent == MO_NO_PARENT) {
    newick->at = MO_NO_PARENT;
    return (size_t)snprintf(text, MO_NEWICK_PIECE, "n%" PRIu32 ";\n", i);
  }
  newick->is_open = newick->next[i] == MO_NO_PARENT;
  newick->at = newick->is_open ? parent : newick->next[i];
  return (size_t)snprintf(text, MO_NEWICK_PIECE, "n%" PRIu32 ":%" PRIu32 "%c", i,
                          born[i] > born[parent] ? born[i] - born[parent] : 0,
                          newick->is_open ? ')' : ',');
}

bool mo_newick_next(struct mo_newick *newick, char *text, size_t size, size_t *length)
{
  *length = 0;
  while (size - *length >= MO_NEWICK_PIECE) {
    if (newick->at == MO_NO_PARENT) {
      while (newick->root < newick->n && parent_of(newick, newick->root) != MO_NO_PARENT)
        newick->root++;
      if (newick->root == newick->n)
        return false;
      newick->at = newick->root++;
      newick->is_open = false;
    }
    *length += step(newick, text + *length);
  }
  return true;
}

void mo_newick_free(struct mo_newick *newick)
{
  if (newick == NULL)
    return;
  free(newick->child);
  free(newick->next);
  free(newick);
}
