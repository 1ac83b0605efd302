/* differences.h: the settings in which two runs differ. */
#ifndef MORPHOCTL_DIFFERENCES_H
#define MORPHOCTL_DIFFERENCES_H

#include <jansson.h>

#include "ctl.h"

/* Returns, kept, an array of {"setting", "values": [of a, of b]} with the members that differ;
 * those of nested objects have paths with dots. */
json_t *differences_of(const json_t *a, const json_t *b);
/* Ends the program if two operands are the same. noun: what they name. */
void require_distinct(const struct ctl *ctl, const char *noun);
/* Returns a value (nullable) as JSON in at most 40 characters, kept; "-" for none. */
const char *short_text(const json_t *value);
/* Prints what differences_of found, a line each. subject: the run b. */
void print_setting_differences(const struct ctl *ctl, const char *subject,
                               const json_t *differences);

#endif
