/* campaign_json.h: writes campaigns as JSON and CSV, as in the contract. */
#ifndef MORPHO_HTTP_CAMPAIGN_JSON_H
#define MORPHO_HTTP_CAMPAIGN_JSON_H

#include "base/text.h"
#include "jobs/campaigns.h"

/* Returns the state to show: a running campaign that waits for disk space is shown as paused. */
enum mo_job_state mo_campaign_state_shown(const struct mo_campaign_status *status,
                                          const struct mo_campaign_live *live);

/* Writes a campaign. live: its current live state. */
void mo_campaign_json_write(struct mo_text *text, const struct mo_campaign_status *status,
                            const struct mo_campaign_live *live);
void mo_campaign_json_checkpoint(struct mo_text *text, const struct mo_checkpoint_row *row);
/* Writes a campaign as an item of the list of jobs. */
void mo_campaign_json_job(struct mo_text *text, const struct mo_campaign_status *status,
                          const struct mo_campaign_live *live);

/* Write rows as JSON objects, or as CSV lines under their heading. In CSV a number that is not
 * finite is an empty cell. */
void mo_campaign_json_generation(struct mo_text *text, const struct mo_campaign_generation *row);
void mo_campaign_csv_generation(struct mo_text *text, const struct mo_campaign_generation *row);
void mo_campaign_json_step(struct mo_text *text, const struct mo_campaign_step *row);
void mo_campaign_csv_step(struct mo_text *text, const struct mo_campaign_step *row);
extern const char mo_campaign_csv_generations[], mo_campaign_csv_steps[];

/* One generation over several campaigns: the mean, least and most of each number, over the
 * campaigns in which it is finite. */
enum mo_replicate_number {
  MO_REPLICATE_MEAN,
  MO_REPLICATE_BEST,
  MO_REPLICATE_DIVERSITY,
  MO_REPLICATE_NUMBERS
};
struct mo_replicate_row {
  uint32_t generation, campaigns;
  struct {
    uint32_t n;
    double sum, least, most;
  } numbers[MO_REPLICATE_NUMBERS];
};
void mo_replicate_add(struct mo_replicate_row *row, const struct mo_campaign_generation *of_one);
void mo_replicate_json(struct mo_text *text, const struct mo_replicate_row *row);
void mo_replicate_csv(struct mo_text *text, const struct mo_replicate_row *row);
extern const char mo_replicate_csv_heading[];

/* Writes a design of a campaign: the members of an object without its braces, so that more can
 * follow. */
void mo_campaign_json_design(struct mo_text *text, const struct mo_campaign_design *row);
/* Writes what the campaign did with the design, as further members: parents, operator, born, died,
 * score. */
void mo_campaign_json_life(struct mo_text *text, const struct mo_campaign_design *row);
/* Writes a line of the phylogeny in the ALife data standard. end: the last generation to report; a
 * design that died later is written as alive. */
void mo_campaign_csv_design(struct mo_text *text, const struct mo_campaign_design *row,
                            int64_t end);
extern const char mo_campaign_csv_designs[];

#endif
