/* bundle.c: bundles of campaigns. The input is the content of an archive (members.h). A second pass
 * reads the input as the file itself, a third one as the line of an evaluation with recordings.
 * What is accepted must be complete: it must have as many designs and generations as the campaign
 * says. */
#include "members.h"
#include "target.h"

#include <stdlib.h>
#include <string.h>

#include "exchange/bundle.h"

struct seen {
  const struct mo_lattice *lattice;
  struct mo_imported_campaign campaign;
  uint64_t n_designs;
  int64_t generation;
  bool is_open;
};

static void check_closed(struct seen *seen)
{
  if (seen->is_open) {
    FUZZ_PROMISE(seen->n_designs == seen->campaign.n_designs);
    FUZZ_PROMISE(seen->generation == seen->campaign.generation);
  }
  seen->is_open = false;
}

static int take_campaign(void *context, const struct mo_imported_campaign *campaign)
{
  struct seen *seen = context;
  check_closed(seen);
  *seen = (struct seen){
      .lattice = seen->lattice, .campaign = *campaign, .generation = -1, .is_open = true};
  FUZZ_PROMISE(mo_campaign_settings_check(&campaign->record.settings, NULL) == MO_OK);
  FUZZ_PROMISE(campaign->record.n_environments >= 1 &&
               campaign->record.n_environments <= MO_ENVIRONMENTS_MAX);
  return 1;
}

static int take_design(void *context, const struct mo_campaign_design *design)
{
  struct seen *seen = context;
  FUZZ_PROMISE(design->number == seen->n_designs++);
  FUZZ_PROMISE(mo_genotype_is_contiguous(MO_DEFAULT_WORKSPACE, design->genotype.words) == 1);
  for (int p = 0; p < 2; p++)
    FUZZ_PROMISE(design->descent.parents[p] == MO_NO_PARENT ||
                 design->descent.parents[p] < design->number);
  return MO_OK;
}

static int take_generation(void *context, const struct mo_campaign_generation *row,
                           const struct mo_descent *births,
                           const struct mo_campaign_member *members, uint32_t n)
{
  struct seen *seen = context;
  (void)births;
  FUZZ_PROMISE(row->generation == seen->generation + 1);
  seen->generation = row->generation;
  for (uint32_t i = 0; i < n; i++)
    FUZZ_PROMISE(members[i].number < seen->n_designs);
  return MO_OK;
}

static int take_score(void *context, const struct mo_campaign_score *score)
{
  const struct seen *seen = context;
  FUZZ_PROMISE(score->number < seen->n_designs && score->n >= 1 && score->n <= MO_BLOCK_LANES);
  for (uint32_t k = 0; k < score->n; k++)
    FUZZ_PROMISE(score->environments[k] < seen->campaign.record.n_environments);
  return MO_OK;
}

static void read_bundle(const void *bytes, size_t size, const struct mo_lattice *lattice)
{
  struct seen *seen = calloc(1, sizeof(*seen));
  struct mo_bundle_summary *summary = calloc(1, sizeof(*summary));
  struct mo_message message = {""};
  FUZZ_PROMISE(seen != NULL && summary != NULL);
  seen->lattice = lattice;
  const struct mo_bundle_sink sink = {.context = seen,
                                      .campaign = take_campaign,
                                      .design = take_design,
                                      .generation = take_generation,
                                      .score = take_score};
  const int error = mo_bundle_read(bytes, size, lattice, &sink, NULL, summary, &message);
  FUZZ_PROMISE(error == MO_OK || error == MO_ERR_NO_MEMORY ||
               (error == MO_ERR_FORMAT && message.text[0] != '\0'));
  if (error == MO_OK) {
    check_closed(seen);
    FUZZ_PROMISE(summary->n >= 1 && summary->n <= MO_BUNDLE_CAMPAIGNS);
  }
  free(seen);
  free(summary);
}

static void read_evaluation(const uint8_t *data, size_t size, const struct mo_lattice *lattice)
{
  struct mo_bundle_lines *lines = mo_bundle_lines_create(lattice, false);
  struct mo_imported_evaluation *evaluation = malloc(sizeof(*evaluation));
  struct mo_message message = {""};
  char *line = strndup((const char *)data, size);
  FUZZ_PROMISE(lines != NULL && evaluation != NULL && line != NULL);
  const int error = mo_bundle_read_evaluation(lines, line, strlen(line), evaluation, &message);
  FUZZ_PROMISE(error == MO_OK || (error == MO_ERR_FORMAT && message.text[0] != '\0'));
  if (error == MO_OK)
    FUZZ_PROMISE(evaluation->n_designs >= 1 && evaluation->n_designs <= MO_DESIGNS_MAX &&
                 evaluation->n_environments >= 1 &&
                 evaluation->n_environments <= MO_ENVIRONMENTS_MAX && evaluation->record >= 1 &&
                 evaluation->record < 1U << MO_CHANNELS);
  mo_bundle_lines_free(lines);
  free(evaluation);
  free(line);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
  static struct mo_lattice *lattice;
  struct mo_text archive = {0};
  if (lattice == NULL)
    FUZZ_PROMISE(mo_lattice_create(MO_DEFAULT_WORKSPACE, &lattice) == MO_OK);
  read_bundle(data, size, lattice);
  pack(data, size, &archive);
  read_bundle(archive.data, archive.size, lattice);
  read_evaluation(data, size, lattice);
  mo_text_free(&archive);
  return 0;
}
