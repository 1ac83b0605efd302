/* bundle_reading.h: the state while a bundle is read, and the lines of one campaign. Only for
 * bundle_read.c and bundle_campaign.c. */
#ifndef MORPHO_EXCHANGE_BUNDLE_READING_H
#define MORPHO_EXCHANGE_BUNDLE_READING_H

#include "exchange/bundle.h"
#include "exchange/bundle_scores.h"

/* The members of a campaign, in order. */
enum mo_bundle_part {
  MO_PART_NOTHING,
  MO_PART_CAMPAIGN,
  MO_PART_ENVIRONMENTS,
  MO_PART_DESIGNS,
  MO_PART_GENERATIONS,
  MO_PART_LEARNING,
  MO_PART_SCORES,
  MO_PART_RECORDINGS
};

/* What has been read about a design. */
struct mo_born {
  struct mo_descent descent;
  uint32_t born, died, stamp; /* stamp: the last population that contains it, plus 1 */
  uint16_t masses, springs;
  bool is_cut;
  double score;
};

struct mo_known_controller {
  struct mo_sha256 sha256;
  enum mo_sensor sensor;
};

struct mo_reading {
  struct mo_archive_reader *archive;
  struct mo_archive_member member;
  struct mo_bundle_lines *lines;
  const struct mo_bundle_sink *sink;
  const struct mo_bundle_summary *known;
  struct mo_bundle_summary *summary;
  struct mo_message *message;
  struct mo_bundle_head head;     /* version 0: bundle.json has not been read */
  uint32_t n_controllers, n_used; /* n_used: used by the campaigns so far */
  struct mo_known_controller controllers[2 * MO_BUNDLE_CAMPAIGNS];
  /* The current campaign. */
  enum mo_bundle_part part;
  uint32_t n_parts;     /* part numbers used so far */
  uint64_t part_number; /* of the current part */
  size_t part_size;
  bool taken; /* the sink receives it */
  char folder[64];
  struct mo_imported_campaign campaign;
  uint32_t n_environments;
  struct mo_born *born; /* (n_born) */
  double *means;        /* (n_born, measures of the campaign) */
  size_t means_room;
  uint32_t n_born, room;
  uint32_t *births, *deaths; /* (generation + 1) */
  int64_t generation;        /* of the newest row */
  uint32_t n_alive;
  struct mo_campaign_member *members; /* (MO_POPULATION_MAX) */
  uint32_t step_generation, step;     /* of the newest step of learning */
  uint64_t n_steps;
  struct mo_bundle_scores *scores; /* of the design scored_number − 1 */
  uint32_t scored_number;          /* 0: no scores yet */
  struct mo_text digest;           /* lines about the members of the history */
  struct mo_bundle_recordings *recordings;
  bool evaluation_taken;
};

/* ---- bundle_campaign.c ---- */

/* Fills the message with a fault in a line of the member (line 0: in the member). Returns
 * MO_ERR_FORMAT. */
int mo_reading_refuse(struct mo_reading *reading, uint32_t line, const char *words);
/* Rejects a member without lines, or without a newline at the end of its last line. */
int mo_reading_check_lines(struct mo_reading *reading);
bool mo_reading_is_over(const struct mo_reading *reading);
/* Returns the index of a controller, or n_controllers if it was not read. */
uint32_t mo_reading_find_controller(const struct mo_reading *reading,
                                    const struct mo_sha256 *sha256);
/* Read the members of a campaign. name: without its folder. */
int mo_reading_begin(struct mo_reading *reading);
int mo_reading_environments(struct mo_reading *reading);
int mo_reading_lines(struct mo_reading *reading);
int mo_reading_recordings(struct mo_reading *reading, const char *name);
int mo_reading_end(struct mo_reading *reading);

#endif
