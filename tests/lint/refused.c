/* Faults that clang-tidy must find, for tidy.sh. This file is not compiled. The comment at the end
 * of a line is the name of the check. */
#include <stdlib.h>
#include <string.h>

struct list {
  struct list *next;
  int *values;
  size_t n;
};

static int *first_of(const struct list *list)
{
  return list && list->n ? list->values : NULL;
}

/* Through two calls: the values of an empty list. */
int sum_of_first(const struct list *list, const struct list *other)
{
  int *values = first_of(list);
  if (!values && other)
    values = first_of(other);
  return *values; // clang-analyzer-core.NullDereference
}

static void drop(struct list *list)
{
  free(list->values);
  free(list);
}

size_t length_after_the_end(struct list *list)
{
  size_t n = 0;
  for (struct list *at = list, *next; at; at = next) {
    next = at->next;
    drop(at);
    n += at->n; // clang-analyzer-unix.Malloc
  }
  return n;
}

int *copy_of(const struct list *list, size_t most)
{
  int *copy = malloc(list->n * sizeof(*copy));
  if (!copy)
    return NULL;
  for (size_t i = 0; i < list->n; i++) {
    if (i == most)
      return NULL; // clang-analyzer-unix.Malloc
    copy[i] = list->values[i];
  }
  return copy;
}

int last_of(const struct list *list)
{
  int last;
  for (size_t i = 0; i < list->n; i++)
    last = list->values[i];
  return last; // clang-analyzer-core.uninitialized.UndefReturn
}

void clear(struct list *list)
{
  memset(list, 0, sizeof(list)); // bugprone-sizeof-expression
}
