/* bundle_import.h: imports the campaigns of a bundle into the store. */
#ifndef MORPHO_EXCHANGE_BUNDLE_IMPORT_H
#define MORPHO_EXCHANGE_BUNDLE_IMPORT_H

#include "exchange/bundle.h"

struct mo_bundle_import {
  struct mo_store *store;
  const struct mo_lattice *lattice;
  const void *bytes; /* the bundle, in memory */
  size_t size;
  bool (*is_over)(void *context); /* returns whether to stop early, with MO_ERR_CANCELLED */
  void *context;
  /* The content of the bundle, and the result. Begin with zeros. */
  struct mo_bundle_summary summary;
  int64_t ids[MO_BUNDLE_CAMPAIGNS];  /* ids in this store; 0: not here */
  bool entered[MO_BUNDLE_CAMPAIGNS]; /* by this import; the others already existed */
  bool is_new;                       /* the import added something */
  uint64_t n_scores;                 /* losses that were new */
  bool has_begun;                    /* to store; without an error, `is_new` */
};
/* Checks all of a bundle and compares it with the store. If `enters`, stores the campaigns that are
 * not here, all or none (store/imports.h). MO_ERR_FORMAT, MO_ERR_CONFLICT: the message says what is
 * wrong. `has_begun`: some designs and scores may have been stored before an error. */
int mo_bundle_import(struct mo_bundle_import *import, bool enters, struct mo_message *message);

#endif
