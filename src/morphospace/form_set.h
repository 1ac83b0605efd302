/* form_set.h: many forms at once into a set, on several threads. */
#ifndef MORPHO_MORPHOSPACE_FORM_SET_H
#define MORPHO_MORPHOSPACE_FORM_SET_H

#include <morpho/morphospace.h>

enum mo_form_mark {
  MO_FORM_OUT = 0, /* not to be added; stays so */
  MO_FORM_IN = 1,  /* to be added; afterwards: it was there */
  MO_FORM_NEW = 2  /* it was added */
};

/* Where a set keeps a form: for mo_form_set_add_many; a function of the form and the set's
 * workspace. */
uint64_t mo_form_set_hash(const struct mo_form_set *set, const uint64_t *form);

/* What mo_form_set_add of each that is MO_FORM_IN would do, one after the other, on up to n_threads
 * threads: the same set, and the same ones of equal forms are new. forms: (n, words), canonical,
 * those to be added not empty; hashes: (n) of those; marks: (n). MO_ERR_NO_MEMORY: some of them
 * were added. */
int mo_form_set_add_many(struct mo_form_set *set, const uint64_t *forms, const uint64_t *hashes,
                         size_t n, uint32_t n_threads, uint8_t *marks);

#endif
