/* bundle_import.h: enters the campaigns of a bundle into the store. */
#ifndef MORPHO_EXCHANGE_BUNDLE_IMPORT_H
#define MORPHO_EXCHANGE_BUNDLE_IMPORT_H

#include "exchange/bundle.h"

struct mo_bundle_import {
  struct mo_store *store;
  const struct mo_lattice *lattice;
  const void *bytes; /* of a bundle in memory */
  size_t size;
  bool (*is_over)(void *context); /* whether to end early, with MO_ERR_CANCELLED */
  void *context;
  /* What it is, and what became of it. Begin with zeros. */
  struct mo_bundle_summary summary;
  int64_t ids[MO_BUNDLE_CAMPAIGNS];  /* here; 0: it is not here */
  bool entered[MO_BUNDLE_CAMPAIGNS]; /* now; the others were here */
  bool is_new;                       /* something was entered */
  uint64_t n_scores;                 /* losses that were not stored */
};
/* Checks all of a bundle, compares it with what is stored, and, if it `enters`, stores in one
 * transaction the campaigns that are not here. MO_ERR_FORMAT, MO_ERR_CONFLICT: the message says
 * what is wrong, and nothing was stored. */
int mo_bundle_import(struct mo_bundle_import *import, bool enters, struct mo_message *message);

#endif
