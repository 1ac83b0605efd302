/* screen.h: a live view on a terminal, redrawn in place; and where to start following
 * events. */
#ifndef MORPHOCTL_SCREEN_H
#define MORPHOCTL_SCREEN_H

#include <jansson.h>

#include "ctl.h"

struct screen {
  bool live;          /* standard output is a terminal that supports escapes */
  int lines, columns; /* lines drawn now, and the width they were drawn for */
  double drawn_s;
};
struct screen screen_open(const struct ctl *ctl);

/* Redraws the screen with what `write` writes into `file` for a terminal of this size. Redraws at
 * most ten times per second unless `now`. */
void screen_draw(struct screen *screen, bool now,
                 void (*write)(void *context, FILE *file, int columns, int rows), void *context);
/* Writes one line of a view, cut to the width. before, after: escapes around it. */
void screen_line(FILE *file, int columns, const char *before, const char *words, const char *after);
/* Writes lines that were drawn before, e.g. a plot. */
void screen_lines(FILE *file, const char *text);

/* Prints a line with the event's time (NULL: now) if the screen is not live. */
void screen_event(const struct screen *screen, const struct ctl *ctl, const json_t *at,
                  const char *words);
/* Prints such a line for an earlier event, whose time is not known. */
void screen_earlier(const struct screen *screen, const struct ctl *ctl, const char *words);

/* Finds the sequence of the newest event, as reported by a page that starts beyond it. */
int newest_event(struct ctl *ctl, int64_t *newest);

#endif
