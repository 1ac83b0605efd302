/* campaign.h: what the campaign commands share: a campaign with its curves, and how they are
 * shown. */
#ifndef MORPHOCTL_CAMPAIGN_H
#define MORPHOCTL_CAMPAIGN_H

#include <jansson.h>

#include "ctl.h"

/* What is drawn of a generation; NaN: no value. */
struct campaign_row {
  int64_t generation;
  double mean, median, best, diversity, mutants, recombinants, voxels,
      seconds; /* mutants, recombinants: share that survived */
};

struct campaign {
  char id[24];
  json_t *json; /* the latest reply of the API */
  struct campaign_row *rows;
  size_t n, capacity;
};

/* Fetches the campaign and the generations since the last fetch. */
int campaign_load(struct ctl *ctl, struct campaign *campaign);
void campaign_free(struct campaign *campaign);

/* Draws a curve in `width` characters, the newest value at the right. Characters from least to
 * most: ▁▂▃▄▅▆▇█ if the locale has them, else digits 0 to 9; blanks for missing values. If there
 * are more values than characters, groups are averaged. text: 3 · width + 1 bytes. */
void sparkline(const double *values, size_t n, int width, bool utf8, char *text);

/* Writes "generation 12 of 30". */
void campaign_generation_text(int64_t generation, int64_t generations, char *text, size_t size);
/* Writes the progress: "scoring 34 of 64 designs  210 rollouts/s  0:03:12 left"; "" when the
 * campaign is not running. */
void campaign_progress_text(const json_t *campaign, char *text, size_t size);
/* Writes one generation as a line. */
void campaign_row_text(const struct campaign_row *row, char *text, size_t size);
/* Writes two spaces and the content of a "campaign.…" event; nothing for other events. */
void campaign_event_text(const char *type, const json_t *data, char *text, size_t size);

/* Draws the curves as labeled sparklines, then the newest `table_rows` generations as a table, in
 * `columns`. Calls `line` for each line. */
void campaign_draw(const struct ctl *ctl, const struct campaign *campaign, int columns,
                   int table_rows, void (*line)(void *context, const char *text), void *context);

/* Follows a campaign to its end. An interrupt ends only the command, not the campaign. */
int watch_campaign(struct ctl *ctl, const char *id);

#endif
