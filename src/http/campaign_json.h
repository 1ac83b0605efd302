/* campaign_json.h: campaigns as the contract writes them. */
#ifndef MORPHO_HTTP_CAMPAIGN_JSON_H
#define MORPHO_HTTP_CAMPAIGN_JSON_H

#include "http/text.h"
#include "jobs/campaigns.h"

/* The state as it is shown: a running campaign that waits for room on the disk is paused. */
enum mo_job_state mo_campaign_state_shown(const struct mo_campaign_status *status,
                                          const struct mo_campaign_live *live);

/* The campaign. live: of this moment. */
void mo_campaign_json_write(struct mo_text *text, const struct mo_campaign_status *status,
                            const struct mo_campaign_live *live);
void mo_campaign_json_checkpoint(struct mo_text *text,
                                 const struct mo_campaign_checkpoint_row *row);
/* The same as an item of the list of jobs. */
void mo_campaign_json_job(struct mo_text *text, const struct mo_campaign_status *status,
                          const struct mo_campaign_live *live);

/* Rows as objects, or as lines of CSV (numbers that are not finite: nothing) under their heading.
 */
void mo_campaign_json_generation(struct mo_text *text, const struct mo_campaign_generation *row);
void mo_campaign_csv_generation(struct mo_text *text, const struct mo_campaign_generation *row);
void mo_campaign_json_step(struct mo_text *text, const struct mo_campaign_step *row);
void mo_campaign_csv_step(struct mo_text *text, const struct mo_campaign_step *row);
extern const char mo_campaign_csv_generations[], mo_campaign_csv_steps[];

/* One generation of several campaigns: mean, least and most over those whose number is finite. */
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

/* A design of a campaign: the members of an object, without its braces, so that more can follow. */
void mo_campaign_json_design(struct mo_text *text, const struct mo_campaign_design *row);
/* What the campaign did with it: parents, operator, born, died, score, as further members. */
void mo_campaign_json_life(struct mo_text *text, const struct mo_campaign_design *row);
/* A line of the phylogeny by the ALife data standard. end: generations after it are not told: what
 * died later lives. */
void mo_campaign_csv_design(struct mo_text *text, const struct mo_campaign_design *row,
                            int64_t end);
extern const char mo_campaign_csv_designs[];

#endif
