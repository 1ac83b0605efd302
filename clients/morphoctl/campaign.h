/* campaign.h: what the commands of campaigns share: a campaign with its curves, and how they are
 * told. */
#ifndef MORPHOCTL_CAMPAIGN_H
#define MORPHOCTL_CAMPAIGN_H

#include <jansson.h>

#include "ctl.h"

/* What is drawn of a generation; NaN: there is none. */
struct campaign_row {
  int64_t generation;
  double mean, median, best, diversity, mutants, recombinants, voxels,
      seconds; /* mutants, recombinants: share that survived */
};

struct campaign {
  char id[24];
  json_t *json; /* as the API last told it */
  struct campaign_row *rows;
  size_t n, capacity;
};

/* Fetches the campaign and the generations that came since the last time. */
int campaign_load(struct ctl *ctl, struct campaign *campaign);
void campaign_free(struct campaign *campaign);

/* A curve in `width` characters, the newest value at the right: ▁▂▃▄▅▆▇█ where the locale has them,
 * else digits 0 to 9, from the least to the most of the values; blanks where there is none. More
 * values than characters are averaged in groups. text: 3 · width + 1 bytes. */
void sparkline(const double *values, size_t n, int width, bool utf8, char *text);

/* "generation 12 of 30" */
void campaign_generation_text(int64_t generation, int64_t generations, char *text, size_t size);
/* What is under way: "scoring 34 of 64 designs  210 rollouts/s  0:03:12 left"; "" when it does not
 * run. */
void campaign_progress_text(const json_t *campaign, char *text, size_t size);
/* One generation in a line. */
void campaign_row_text(const struct campaign_row *row, char *text, size_t size);
/* Two spaces and what a "campaign.…" event tells; nothing of others. */
void campaign_event_text(const char *type, const json_t *data, char *text, size_t size);

/* The curves as labelled sparklines, then the newest `table_rows` generations as a table, fitting
 * `columns`. `line` gets each. */
void campaign_draw(const struct ctl *ctl, const struct campaign *campaign, int columns,
                   int table_rows, void (*line)(void *context, const char *text), void *context);

/* Follows a campaign to its end. An interrupt leaves it alone. */
int watch_campaign(struct ctl *ctl, const char *id);
/* STATUS_OK if it succeeded, else STATUS_NEGATIVE and a complaint. */
int campaign_outcome(const json_t *campaign);

#endif
