/* screen.h: a live view on a terminal, redrawn in place; and the beginning of following a job. */
#ifndef MORPHOCTL_SCREEN_H
#define MORPHOCTL_SCREEN_H

#include <jansson.h>

#include "ctl.h"

struct screen {
  bool live;          /* standard output is a terminal that obeys escapes */
  int lines, columns; /* of what stands on it */
  double drawn_s;
};
struct screen screen_open(const struct ctl *ctl);

/* Draws what `write` writes into `file` for a terminal of this size, over what stands there, at
 * most ten times per second, or `now`. */
void screen_draw(struct screen *screen, bool now,
                 void (*write)(void *context, FILE *file, int columns, int rows), void *context);
/* One line of a view, cut to the width. `before` and `after`: escapes around it. */
void screen_line(FILE *file, int columns, const char *before, const char *text, const char *after);
/* Lines that a drawing made, e.g. a plot. */
void screen_lines(FILE *file, const char *text);

/* Elsewhere: a line with the event's time (NULL: now). Nothing on a live screen. */
void screen_event(const struct screen *screen, const struct ctl *ctl, const json_t *at,
                  const char *words);
/* The same of what was before, at a time that is not known. */
void screen_earlier(const struct screen *screen, const struct ctl *ctl, const char *words);

/* The place of the newest event: what a page from beyond it says. */
int newest_event(struct ctl *ctl, int64_t *newest);

#endif
