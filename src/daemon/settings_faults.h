/* settings_faults.h: the faults of a configuration. */
#ifndef MORPHO_DAEMON_SETTINGS_FAULTS_H
#define MORPHO_DAEMON_SETTINGS_FAULTS_H

#include <stdbool.h>
#include <stddef.h>

/* Faults in the configuration, one sentence each. If `fatal` is false, the fault is only a
 * warning. */
struct settings_faults {
  struct settings_fault {
    char *text;
    bool fatal;
  } * items;
  size_t n, n_fatal;
};
void settings_fault(struct settings_faults *faults, bool fatal, const char *format, ...)
    __attribute__((format(printf, 3, 4)));
void settings_faults_print(const struct settings_faults *faults); /* on standard error */
void settings_faults_free(struct settings_faults *faults);

#endif
