/* openapi.h: schema/openapi.yaml as JSON, and docs/problems.md; made by the build. */
#ifndef MORPHO_API_OPENAPI_H
#define MORPHO_API_OPENAPI_H

#include <stddef.h>

extern const char mo_openapi_json[];
extern const size_t mo_openapi_json_size;
extern const unsigned char mo_openapi_gzip[]; /* the same, compressed */
extern const size_t mo_openapi_gzip_size;
extern const unsigned char mo_problems[]; /* a text that ends with NUL */

#endif
