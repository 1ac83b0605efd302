/* campaign.h: a campaign with its curves. */
#ifndef MORPHOCTL_CAMPAIGN_H
#define MORPHOCTL_CAMPAIGN_H

#include "live.h"

enum { CAMPAIGN_VALUES = 8 }; /* mean, median, best, diversity, mutants, recombinants, voxels, s */

struct campaign_row {
  int64_t generation;
  double values[CAMPAIGN_VALUES]; /* NaN if missing; mutants and recombinants in percent */
};

struct campaign {
  struct live live;
  struct campaign_row *rows;
  size_t n, capacity;
  size_t printed; /* rows printed so far, if not on a terminal */
};

/* Draws a curve in `width` characters, with the newest value on the right. Characters from smallest
 * to largest: ▁▂▃▄▅▆▇█ if the locale has them, otherwise digits 0 to 9; blanks for missing values.
 * If there are more values than characters, groups are averaged. text: 3 · width + 1 bytes. */
void sparkline(const double *values, size_t n, int width, bool utf8, char *text);
/* Writes one generation as a line. */
void campaign_row_text(const struct campaign_row *row, char *text, size_t size);
/* Draws the curves as labeled sparklines, `columns` wide, then the newest `table_rows` generations
 * as a table (malloc). */
char *campaign_draw(const struct campaign *campaign, int columns, int table_rows);

#endif
