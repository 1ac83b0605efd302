/* fields.h: options that are fields of a request. */
#ifndef MORPHOCTL_FIELDS_H
#define MORPHOCTL_FIELDS_H

#include <jansson.h>

#include "ctl.h"

/* Adds the given options of the command that have a place to the request. The server checks bounds
 * and reports them. */
int fill_fields(const struct ctl *ctl, json_t *request);
/* Puts a value at its place, with the objects around it. Takes the reference. */
void fill_place(json_t *request, const char *place, json_t *value);
/* Reads a value; NULL: it is not of this kind. */
json_t *field_value(enum field_kind kind, const char *text);
/* "whole number", "number" or "text in UTF-8". */
const char *field_kind_name(enum field_kind kind);

/* Adds --schedule, a name or a kind, at its place. The options of a kind need one. Call it before
 * fill_fields. */
int fill_schedule(const struct ctl *ctl, json_t *request, const char *place);

#endif
