/* held_out.h: the fresh worlds of the axis `held_out`. */
#ifndef MORPHO_CERTIFICATE_HELD_OUT_H
#define MORPHO_CERTIFICATE_HELD_OUT_H

#include <morpho/certificate.h>

/* Returns why there are no fresh worlds of the base's kind, as a sentence; NULL if there are. */
const char *mo_fresh_refuses(const struct mo_certificate_base *base);
/* Returns how many of the `wanted` worlds exist. */
uint32_t mo_fresh_count(const struct mo_certificate_base *base, uint32_t wanted);
/* Returns how the fresh worlds differ in kind from the base's, as a sentence; NULL: they do not. */
const char *mo_fresh_kind(const struct mo_certificate_base *base);
/* Fills in the first n fresh worlds. MO_ERR_RANGE: there are fewer, or none; MO_ERR_NO_MEMORY. */
int mo_fresh_worlds(const struct mo_certificate_base *base, uint64_t seed, uint32_t n,
                    struct mo_environment *environments);

#endif
