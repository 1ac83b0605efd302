/* assets.h: the dashboard's files, which clients/dashboard/embed.py puts into the program. */
#ifndef MORPHO_API_ASSETS_H
#define MORPHO_API_ASSETS_H

#include <stddef.h>

struct mo_asset {
  const char *name; /* "lib/dom.js" */
  const char *type;
  const unsigned char *bytes;
  size_t size;
  const unsigned char *gzip; /* the same, compressed */
  size_t gzip_size;
};

extern const struct mo_asset mo_assets[]; /* ascending names */
extern const size_t mo_assets_count;
extern const char mo_assets_version[]; /* of all assets together; part of their paths */

#endif
