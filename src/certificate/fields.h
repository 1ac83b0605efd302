/* fields.h: settings of a certificate as a table of fields, for requests, replies and the store. */
#ifndef MORPHO_CERTIFICATE_FIELDS_H
#define MORPHO_CERTIFICATE_FIELDS_H

#include <morpho/certificate.h>

#include "base/fields.h"

/* For struct mo_certificate_settings, all of it. */
extern const struct mo_fields mo_certificate_fields;

#endif
