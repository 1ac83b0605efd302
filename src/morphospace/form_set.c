/* form_set.c: an exact set of canonical forms, designed for tens of millions of them.
 *
 * Open addressing with linear probing over bare forms of ceil(voxels / 8) bytes (18 in the default
 * workspace). A slot of zeros is free, because no form is empty. The hash's top bits choose one of
 * MO_FORM_SEGMENTS tables, its other bits the slot. Each table independently grows by a quarter
 * when it is 4/5 full, so that a growing set never holds two copies of itself: the peak is the set
 * plus one table, and forms take between 1.25 and 1.57 times their own size.
 *
 * Threads that add many forms divide the tables: each thread adds the forms of its own tables, in
 * their order. No two threads therefore touch the same table, and every table gets the same content
 * as with one thread. A form's slot is prefetched a few forms ahead, because in a set of millions
 * it is not in any cache. */
#include "morphospace/form_set.h"

#include "base/thread.h"
#include "morphospace/bits.h"

#include <math.h>
#include <stdatomic.h>
#include <sys/mman.h>

#define SEGMENT_FIRST  16 /* initial number of slots of a table */
#define SLOTS_MAX      (UINT64_C(1) << 32)
#define FETCHED        16  /* forms whose slots are being prefetched; a power of two */
#define WORTH_A_THREAD 512 /* number of forms that makes another thread worthwhile: about 50 µs */

int mo_form_set_create(struct mo_workspace workspace, struct mo_form_set **set)
{
  int code = mo_workspace_check(workspace);
  if (code != MO_OK)
    return code;
  struct mo_form_set *made = calloc(1, sizeof(*made));
  if (made == NULL)
    return MO_ERR_NO_MEMORY;
  made->workspace = workspace;
  made->form_bytes = (mo_workspace_voxels(workspace) + 7) / 8;
  *set = made;
  return MO_OK;
}

void mo_form_set_free(struct mo_form_set *set)
{
  if (set == NULL)
    return;
  for (int i = 0; i < MO_FORM_SEGMENTS && set->mapped == NULL; i++)
    free(set->segments[i].slots);
  if (set->mapped != NULL)
    (void)munmap(set->mapped, set->mapped_bytes);
  free(set);
}

_Static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__,
               "a form's first bytes are the low bytes of its first word");

static inline uint64_t load(const uint8_t *bytes, size_t n)
{
  uint64_t word = 0;
  memcpy(&word, bytes, n);
  return word;
}

static uint64_t mix(uint64_t a, uint64_t b)
{
  unsigned __int128 product = (unsigned __int128)a * b;
  return (uint64_t)product ^ (uint64_t)(product >> 64);
}

uint64_t mo_form_hash(const uint8_t *form, size_t n)
{
  uint64_t state = UINT64_C(0x9e3779b97f4a7c15) ^ n;
  while (n > 16) {
    state = mix(load(form, 8) ^ UINT64_C(0xa0761d6478bd642f), load(form + 8, 8) ^ state);
    form += 16;
    n -= 16;
  }
  size_t low = n < 8 ? n : 8;
  state = mix(load(form, low) ^ UINT64_C(0xe7037ed1a0b428db), load(form + low, n - low) ^ state);
  return mix(state ^ UINT64_C(0x8ebc6af09c88c6e3), UINT64_C(0x589965cc75374cc3));
}

static inline __attribute__((always_inline)) int is_free(const uint8_t *slot, size_t n)
{
  uint64_t any = 0;
  size_t i = 0;
  for (; i + 8 <= n; i += 8)
    any |= load(slot + i, 8);
  return (any | load(slot + i, n - i)) == 0;
}

static inline __attribute__((always_inline)) int is_equal(const uint8_t *a, const uint8_t *b,
                                                          size_t n)
{
  uint64_t difference = 0;
  size_t i = 0;
  for (; i + 8 <= n; i += 8)
    difference |= load(a + i, 8) ^ load(b + i, 8);
  return (difference | (load(a + i, n - i) ^ load(b + i, n - i))) == 0;
}

/* Inlined with a constant n for the default workspace. */
static inline __attribute__((always_inline)) uint64_t probe(const struct mo_form_segment *segment,
                                                            const uint8_t *form, size_t n,
                                                            uint64_t slot, int *found)
{
  for (;;) {
    const uint8_t *there = segment->slots + slot * n;
    if (is_equal(there, form, n)) {
      *found = 1;
      return slot;
    }
    if (is_free(there, n)) {
      *found = 0;
      return slot;
    }
    slot = slot + 1 < segment->capacity ? slot + 1 : 0;
  }
}

static uint64_t first_slot(const struct mo_form_segment *segment, uint64_t hashed)
{
  return (hashed & UINT32_MAX) * segment->capacity >> 32;
}

/* Finds the slot of the form, or the free slot where it belongs. The table must have a free
 * slot. */
static uint64_t find(const struct mo_form_segment *segment, const uint8_t *form, size_t n,
                     uint64_t hashed, int *found)
{
  const uint64_t slot = first_slot(segment, hashed);
  return n == 18 ? probe(segment, form, 18, slot, found) : probe(segment, form, n, slot, found);
}

int mo_form_segment_copy(const struct mo_form_segment *segment, size_t n, uint64_t capacity,
                         struct mo_form_segment *copy)
{
  struct mo_form_segment made = {.capacity = capacity, .used = segment->used};
  if (capacity > SLOTS_MAX || capacity > SIZE_MAX / n)
    return MO_ERR_NO_MEMORY;
  made.slots = calloc(capacity, n);
  if (made.slots == NULL)
    return MO_ERR_NO_MEMORY;
  for (uint64_t slot = 0; slot < segment->capacity; slot++) {
    const uint8_t *form = segment->slots + slot * n;
    if (!is_free(form, n)) {
      int found;
      uint64_t to = find(&made, form, n, mo_form_hash(form, n), &found);
      memcpy(made.slots + to * n, form, n);
    }
  }
  *copy = made;
  return MO_OK;
}

static int grow(struct mo_form_segment *segment, size_t n)
{
  struct mo_form_segment larger;
  const int code = mo_form_segment_copy(
      segment, n,
      segment->capacity == 0 ? SEGMENT_FIRST : segment->capacity + segment->capacity / 4, &larger);
  if (code != MO_OK)
    return code;
  free(segment->slots);
  *segment = larger;
  return MO_OK;
}

/* Adds a form. Returns 1 if it was added, or 0 if it was already present. */
static int add(struct mo_form_segment *segment, const uint8_t *form, size_t n, uint64_t hashed)
{
  int found = 0;
  uint64_t slot = 0;
  if (segment->capacity > 0) {
    slot = find(segment, form, n, hashed, &found);
    if (found)
      return 0;
  }
  if ((segment->used + 1) * 5 > segment->capacity * 4) {
    int code = grow(segment, n);
    if (code != MO_OK)
      return code;
    slot = find(segment, form, n, hashed, &found);
  }
  memcpy(segment->slots + slot * n, form, n);
  segment->used++;
  return 1;
}

int mo_form_set_add(struct mo_form_set *set, const uint64_t *form)
{
  const size_t n = set->form_bytes;
  if (mo_bits_empty(form, mo_workspace_words(set->workspace)))
    return MO_ERR_EMPTY;
  const uint8_t *bytes = (const uint8_t *)form;
  const uint64_t hashed = mo_form_hash(bytes, n);
  return add(&set->segments[hashed >> 56], bytes, n, hashed);
}

/* ---- many at once ---- */

uint64_t mo_form_set_hash(const struct mo_form_set *set, const uint64_t *form)
{
  return mo_form_hash((const uint8_t *)form, set->form_bytes);
}

struct adding {
  struct mo_form_set *set;
  const uint64_t *forms, *hashes;
  size_t words, n;
  uint8_t *marks;
  atomic_int error;
};

static int add_one(struct adding *adding, size_t i)
{
  const int code = add(&adding->set->segments[adding->hashes[i] >> 56],
                       (const uint8_t *)(adding->forms + adding->words * i),
                       adding->set->form_bytes, adding->hashes[i]);
  if (code == 1)
    adding->marks[i] = MO_FORM_NEW;
  return code;
}

static void add_to_segments(void *context, size_t first, size_t end)
{
  struct adding *adding = context;
  const struct mo_form_set *set = adding->set;
  size_t waiting[FETCHED]; /* forms that wait to be added */
  size_t found = 0, added = 0;
  int code = MO_OK;
  for (size_t i = 0; i < adding->n && code >= 0; i++) {
    const uint64_t hashed = adding->hashes[i];
    if (hashed >> 56 < first || hashed >> 56 >= end || adding->marks[i] == MO_FORM_OUT)
      continue; /* marks of other threads' forms belong to those threads */
    const struct mo_form_segment *segment = &set->segments[hashed >> 56];
    if (segment->capacity > 0)
      __builtin_prefetch(segment->slots + first_slot(segment, hashed) * set->form_bytes, 1);
    if (found - added == FETCHED)
      code = add_one(adding, waiting[added++ % FETCHED]);
    waiting[found++ % FETCHED] = i;
  }
  while (added < found && code >= 0)
    code = add_one(adding, waiting[added++ % FETCHED]);
  if (code < 0)
    atomic_store(&adding->error, code);
}

int mo_form_set_add_many(struct mo_form_set *set, const uint64_t *forms, const uint64_t *hashes,
                         size_t n, uint32_t n_threads, uint8_t *marks)
{
  struct adding adding = {.set = set,
                          .forms = forms,
                          .hashes = hashes,
                          .words = mo_workspace_words(set->workspace),
                          .n = n,
                          .marks = marks};
  const size_t enough = 1 + n / WORTH_A_THREAD;
  mo_parallel(n_threads < enough ? n_threads : (uint32_t)enough, MO_FORM_SEGMENTS, add_to_segments,
              &adding);
  return atomic_load(&adding.error);
}

int mo_form_set_has(const struct mo_form_set *set, const uint64_t *form)
{
  const uint8_t *bytes = (const uint8_t *)form;
  uint64_t hashed = mo_form_hash(bytes, set->form_bytes);
  const struct mo_form_segment *segment = &set->segments[hashed >> 56];
  int found = 0;
  if (segment->capacity > 0 && !mo_bits_empty(form, mo_workspace_words(set->workspace)))
    find(segment, bytes, set->form_bytes, hashed, &found);
  return found;
}

/* Each table gets a 256th of the forms, plus four standard deviations. A fifth is added to the
 * total, because all tables grow at about the same time, and the heap cannot reuse the old tables
 * until all have grown. */
size_t mo_form_set_estimate(struct mo_workspace workspace, uint64_t n)
{
  const double forms = (double)n / MO_FORM_SEGMENTS;
  const size_t form_bytes = (mo_workspace_voxels(workspace) + 7) / 8;
  double capacity = SEGMENT_FIRST;
  while (capacity * 4 < (forms + 4 * sqrt(forms) + 1) * 5)
    capacity = floor(capacity * 5 / 4);
  return sizeof(struct mo_form_set) +
         (size_t)(capacity * MO_FORM_SEGMENTS * 1.2 * (double)form_bytes);
}

uint64_t mo_form_set_count(const struct mo_form_set *set)
{
  uint64_t count = 0;
  for (int i = 0; i < MO_FORM_SEGMENTS; i++)
    count += set->segments[i].used;
  return count;
}

size_t mo_form_set_bytes(const struct mo_form_set *set)
{
  size_t bytes = sizeof(*set);
  for (int i = 0; i < MO_FORM_SEGMENTS; i++)
    bytes += set->segments[i].capacity * set->form_bytes;
  return bytes;
}
