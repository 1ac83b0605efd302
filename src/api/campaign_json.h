/* campaign_json.h: writes campaigns as JSON and CSV, as in the contract. */
#ifndef MORPHO_API_CAMPAIGN_JSON_H
#define MORPHO_API_CAMPAIGN_JSON_H

#include "base/text.h"
#include "jobs/campaigns.h"

/* Writes a campaign. live: its current live state. */
void mo_campaign_json_write(struct mo_text *text, const struct mo_campaign_status *status,
                            const struct mo_live *live);
/* Writes a campaign as an item of the list of jobs. status: struct mo_campaign_status. */
void mo_campaign_json_job(struct mo_text *text, const void *status, const struct mo_live *live);

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
