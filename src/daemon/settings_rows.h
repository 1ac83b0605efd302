/* settings_rows.h: functions for any table of rows like the one in settings.h, for example the
 * table of `morphod worker`. `values` is the struct that the offsets of the rows refer to. It
 * begins with zeros. */
#ifndef MORPHO_DAEMON_SETTINGS_ROWS_H
#define MORPHO_DAEMON_SETTINGS_ROWS_H

#include "daemon/settings.h"

/* Reads one value from its text. `append`: adds to a list. MO_ERR_INVALID, MO_ERR_RANGE with a
 * message. */
int setting_read(void *values, const struct setting *setting, const char *text, bool append,
                 struct mo_message *message);
/* Returns the path of the credential "token", if systemd passes one in this folder (malloc). */
char *credential_path(const char *folder);
/* Returns the row of a flag such as "--state-dir", of `length` bytes, or NULL if there is none. */
const struct setting *setting_of_flag(const struct setting *rows, size_t n, const char *flag,
                                      size_t length);
void setting_free(void *values, const struct setting *setting);
/* Prints the rows in the form of --help. */
void settings_print_rows(const struct setting *rows, size_t n, FILE *file);

#endif
