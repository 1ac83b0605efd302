/* form_set.h: the layout of a set of forms, and adding many forms on several threads.
 */
#ifndef MORPHO_MORPHOSPACE_FORM_SET_H
#define MORPHO_MORPHOSPACE_FORM_SET_H

#include <morpho/morphospace.h>

/* A table with open addressing over bare forms; a slot of zeros is free, and at least one is
 * free. */
struct mo_form_segment {
  uint8_t *slots; /* (capacity, form_bytes) */
  uint64_t capacity, used;
};

#define MO_FORM_SEGMENTS 256
struct mo_form_set {
  struct mo_workspace workspace;
  size_t form_bytes;
  struct mo_form_segment segments[MO_FORM_SEGMENTS];
  void *mapped; /* a file that holds the slots (form_file.h), which are then const; or NULL */
  size_t mapped_bytes;
};

/* Returns the hash that determines the slot of a form; also serves as a checksum of many bytes. n ≥
 * 1. */
uint64_t mo_form_hash(const uint8_t *bytes, size_t n);
/* Makes a copy with a different capacity, above `used`. n: bytes of a form. MO_ERR_NO_MEMORY. */
int mo_form_segment_copy(const struct mo_form_segment *segment, size_t n, uint64_t capacity,
                         struct mo_form_segment *copy);

enum mo_form_mark {
  MO_FORM_OUT = 0, /* not to be added; never changes */
  MO_FORM_IN = 1,  /* to be added; afterward: was already present */
  MO_FORM_NEW = 2  /* was added */
};

/* Returns the hash for mo_form_set_add_many; depends only on the form and the set's workspace. */
uint64_t mo_form_set_hash(const struct mo_form_set *set, const uint64_t *form);

/* Adds each form marked MO_FORM_IN on up to n_threads threads. The set, and the choice of the new
 * one among equal forms, are the same as with successive calls of mo_form_set_add. forms: (n,
 * words), canonical; forms to be added must not be empty. hashes: (n) hashes of the forms to be
 * added; marks: (n). MO_ERR_NO_MEMORY: some forms were added. */
int mo_form_set_add_many(struct mo_form_set *set, const uint64_t *forms, const uint64_t *hashes,
                         size_t n, uint32_t n_threads, uint8_t *marks);

#endif
