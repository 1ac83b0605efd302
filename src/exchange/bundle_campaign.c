/* bundle_campaign.c: reads the members of one campaign of a bundle and checks that their lines
 * agree with each other. See docs/bundles.md. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "exchange/bundle_reading.h"
#include "store/store.h"

#define ALIVE UINT32_MAX

#define LINES_BETWEEN_LOOKS 256 /* how often to check whether to stop early */

int mo_reading_refuse(struct mo_reading *reading, uint32_t line, const char *words)
{
  return mo_archive_refuse(&reading->member, line, words, reading->message);
}

bool mo_reading_is_over(const struct mo_reading *reading)
{
  return reading->sink->is_over != NULL && reading->sink->is_over(reading->sink->context);
}

int mo_reading_check_lines(struct mo_reading *reading)
{
  const struct mo_archive_member *member = &reading->member;
  return member->size > 0 && member->bytes[member->size - 1] == '\n'
             ? MO_OK
             : mo_reading_refuse(reading, 0, "has no line, or its last line has no newline");
}

uint32_t mo_reading_find_controller(const struct mo_reading *reading,
                                    const struct mo_sha256 *sha256)
{
  uint32_t i = 0;
  while (i < reading->n_controllers && !mo_sha256_equal(&reading->controllers[i].sha256, sha256))
    i++;
  return i;
}

/* Finds a controller of a campaign. It must be one that was used before, or the next one;
 * otherwise, returns NULL. */
static const struct mo_known_controller *use_controller(struct mo_reading *reading,
                                                        const struct mo_sha256 *sha256)
{
  const uint32_t i = mo_reading_find_controller(reading, sha256);
  if (i == reading->n_controllers || i > reading->n_used)
    return NULL;
  reading->n_used += i == reading->n_used;
  return &reading->controllers[i];
}

/* ---- beginning and end of a campaign ---- */

static struct mo_bundle_campaign *summary_of(struct mo_reading *reading)
{
  return &reading->summary->campaigns[reading->summary->n - 1];
}

/* Returns the number of learning steps of a generation. */
static uint32_t steps_of(const struct mo_campaign_settings *settings, uint32_t generation)
{
  return mo_modes[settings->mode].learns
             ? (generation > 0 ? settings->parent_steps : 0) + settings->child_steps
             : 0;
}

static uint32_t n_means_of(const struct mo_reading *reading)
{
  return (uint32_t)__builtin_popcount(reading->campaign.record.measures);
}

/* Finishes the scores of a design. */
static int end_scores(struct mo_reading *reading)
{
  struct mo_message words = {""};
  if (reading->scored_number == 0)
    return MO_OK;
  const struct mo_born *born = &reading->born[reading->scored_number - 1];
  const uint32_t n_means = n_means_of(reading);
  const double *means =
      n_means > 0 ? reading->means + (size_t)n_means * (reading->scored_number - 1) : NULL;
  const int error = mo_bundle_scores_end(reading->scores, born->score, born->is_cut, means, &words);
  return error == MO_OK ? MO_OK
                        : mo_fail(reading->message, error, "%.90sscores/: %.150s", reading->folder,
                                  words.text);
}

int mo_reading_end(struct mo_reading *reading)
{
  const struct mo_imported_campaign *campaign = &reading->campaign;
  const struct mo_campaign_settings *settings = &campaign->record.settings;
  if (reading->part == MO_PART_NOTHING)
    return MO_OK;
  if (reading->part < MO_PART_ENVIRONMENTS || reading->n_born != campaign->n_designs ||
      reading->generation != campaign->generation)
    return mo_fail(reading->message, MO_ERR_FORMAT,
                   "%s: environments, designs or generations are missing", reading->folder);
  if (reading->recordings->channel != 0)
    return mo_fail(reading->message, MO_ERR_FORMAT, "%s: a recording lacks arrays",
                   reading->folder);
  uint64_t n_steps = 0;
  for (int64_t generation = 0; generation <= campaign->generation; generation++)
    n_steps += steps_of(settings, (uint32_t)generation);
  if (reading->n_steps != n_steps)
    return mo_fail(reading->message, MO_ERR_FORMAT,
                   "%slearning/: has %llu steps, but the campaign has %llu", reading->folder,
                   (unsigned long long)reading->n_steps, (unsigned long long)n_steps);
  const int error = end_scores(reading);
  if (error != MO_OK)
    return error;
  if (campaign->generation < 0)
    mo_bundle_digest_source(&reading->digest, &campaign->source, campaign->created_us);
  if (reading->digest.failed)
    return MO_ERR_NO_MEMORY;
  mo_sha256_of(reading->digest.data, reading->digest.size, &summary_of(reading)->source.digest);
  reading->part = MO_PART_NOTHING;
  return MO_OK;
}

int mo_reading_begin(struct mo_reading *reading)
{
  struct mo_imported_campaign *campaign = &reading->campaign;
  const struct mo_campaign_record *record = &campaign->record;
  struct mo_bundle_summary *summary = reading->summary;
  struct mo_message words = {""};
  const struct mo_known_controller *start;
  mo_environments_drop(campaign->environments, MO_ENVIRONMENTS_MAX);
  int error = mo_bundle_read_campaign(reading->lines, reading->member.bytes, reading->member.size,
                                      campaign, &words);
  if (error != MO_OK)
    return error == MO_ERR_FORMAT ? mo_reading_refuse(reading, 1, words.text) : error;
  start = campaign->has_controller ? use_controller(reading, &campaign->controller_sha256) : NULL;
  if ((campaign->has_controller && (start == NULL || start->sensor != record->settings.sensor)) ||
      (campaign->has_result && use_controller(reading, &campaign->result_sha256) == NULL))
    return mo_reading_refuse(reading, 1,
                             "the controller is missing, out of order, or has a different sensor");
  summary->campaigns[summary->n] =
      (struct mo_bundle_campaign){.source = campaign->source,
                                  .n_designs = campaign->n_designs,
                                  .generation = campaign->generation,
                                  .has_result = campaign->has_result,
                                  .result_sha256 = campaign->result_sha256};
  if (reading->known != NULL)
    campaign->source.digest = reading->known->campaigns[summary->n].source.digest;
  summary->n++;
  free(reading->births);
  free(reading->deaths);
  reading->births = calloc((size_t)campaign->generation + 2, sizeof(*reading->births));
  reading->deaths = calloc((size_t)campaign->generation + 2, sizeof(*reading->deaths));
  if (reading->births == NULL || reading->deaths == NULL)
    return MO_ERR_NO_MEMORY;
  reading->n_environments = reading->n_born = reading->n_alive = 0;
  reading->step_generation = reading->step = 0;
  reading->n_steps = 0;
  reading->scored_number = 0;
  reading->generation = -1;
  reading->digest.size = 0;
  reading->recordings->n = 0;
  return MO_OK;
}

/* Reads the environments, and passes the campaign to the sink. */
int mo_reading_environments(struct mo_reading *reading)
{
  struct mo_imported_campaign *campaign = &reading->campaign;
  size_t at = 0, size;
  char *line;
  int error = mo_reading_check_lines(reading);
  if (error != MO_OK)
    return error;
  while (mo_archive_line(&reading->member, &at, &line, &size)) {
    struct mo_message words = {""};
    if (reading->n_environments == campaign->record.n_environments)
      return mo_reading_refuse(reading, reading->n_environments + 1,
                               "there are too many environments");
    error = mo_bundle_read_environment(reading->lines, line, size,
                                       &campaign->environments[reading->n_environments++], &words);
    if (error != MO_OK)
      return error == MO_ERR_FORMAT
                 ? mo_reading_refuse(reading, reading->n_environments, words.text)
                 : error;
  }
  if (reading->n_environments != campaign->record.n_environments)
    return mo_reading_refuse(reading, 0, "environments are missing");
  mo_bundle_scores_open(reading->scores, campaign);
  const int taken = reading->sink->campaign != NULL
                        ? reading->sink->campaign(reading->sink->context, campaign)
                        : 1;
  reading->taken = taken == 1;
  return taken < 0 ? taken : MO_OK;
}

/* ---- lines of a campaign ---- */

/* Returns whether the score of a design is the mean of the measure that the campaign selects by. */
static bool is_score_of_measure(const struct mo_campaign_record *record,
                                const struct mo_campaign_design *design)
{
  const struct mo_select_by *by = &record->select_by;
  const uint32_t before = (UINT32_C(1) << by->measure) - 1; /* the measures before this one */
  const double mean = design->measures[__builtin_popcount(record->measures & before)];
  const double score = mo_select_by_score(by, mean);
  return !design->is_cut && (score == design->score); /* false for NaN */
}

/* Returns the reason why a design contradicts its parents or the campaign, or NULL if it does
 * not. */
static const char *check_design(const struct mo_reading *reading,
                                const struct mo_campaign_design *design)
{
  static const int n_parents[] = {0, 0, 0, 1, 2};
  const struct mo_descent *descent = &design->descent;
  const struct mo_campaign_record *record = &reading->campaign.record;
  const int n = (descent->parents[0] != MO_NO_PARENT) + (descent->parents[1] != MO_NO_PARENT);
  struct mo_bits moved;
  if (design->number != reading->n_born || design->number >= reading->campaign.n_designs ||
      design->number / MO_BUNDLE_PART_ROWS != reading->part_number)
    return "designs are numbered out of order, too many, or in the wrong part";
  if (n != n_parents[descent->op])
    return "the number of parents does not match the operator";
  if (design->born > reading->campaign.generation ||
      (reading->n_born > 0 && design->born < reading->born[reading->n_born - 1].born) ||
      (design->died >= 0 && design->died < design->born) ||
      design->died > reading->campaign.generation)
    return "birth and death generations are out of order";
  if (design->n_measures != n_means_of(reading))
    return "expected exactly the measures that the campaign names";
  if (record->select_by.is_set && !is_score_of_measure(record, design))
    return "the score does not match the mean of the measure in select_by";
  if (design->score < 0 && !record->select_by.is_set)
    return "a score must be at least 0";
  if (design->is_cut && (n == 0 || design->died != design->born || !isfinite(design->score)))
    return "only the score of a child that was never selected can be a lower bound";
  if (!mo_workspace_equal(record->settings.workspace, design->genotype.workspace) &&
      mo_workspace_words(record->settings.workspace) <= MO_DEFAULT_WORDS &&
      mo_genotype_move(design->genotype.workspace, design->genotype.words,
                       record->settings.workspace, moved.words) != MO_OK)
    return "the body does not fit the workspace of the campaign";
  for (int p = 0; p < n; p++) {
    const uint32_t parent = descent->parents[p];
    if (parent >= design->number || reading->born[parent].born >= design->born ||
        reading->born[parent].died < design->born)
      return "a parent was not alive at the child's birth";
  }
  return NULL;
}

/* Returns space for the means of the next design; the array doubles when full. NULL: no memory. */
static double *keep_means(struct mo_reading *reading, uint32_t n)
{
  const size_t used = (size_t)n * reading->n_born, all = used + n;
  if (all > reading->means_room) {
    double *means = realloc(reading->means, 2 * all * sizeof(*means));
    if (means == NULL)
      return NULL;
    reading->means = means;
    reading->means_room = 2 * all;
  }
  return reading->means + used;
}

static int read_design(struct mo_reading *reading, uint32_t n, const char *line, size_t size)
{
  struct mo_campaign_design design;
  struct mo_message words = {""};
  int error = mo_bundle_read_design(reading->lines, line, size, &design, &words);
  if (error != MO_OK)
    return error == MO_ERR_FORMAT ? mo_reading_refuse(reading, n, words.text) : error;
  const char *fault = check_design(reading, &design);
  if (fault != NULL)
    return mo_reading_refuse(reading, n, fault);
  if (reading->n_born == reading->room) {
    const uint32_t room = reading->room > 0 ? 2 * reading->room : 4096;
    struct mo_born *born = realloc(reading->born, room * sizeof(*born));
    if (born == NULL)
      return MO_ERR_NO_MEMORY;
    reading->born = born;
    reading->room = room;
  }
  if (design.n_measures > 0) {
    double *means = keep_means(reading, design.n_measures);
    if (means == NULL)
      return MO_ERR_NO_MEMORY;
    memcpy(means, design.measures, design.n_measures * sizeof(*means));
  }
  reading->born[reading->n_born++] =
      (struct mo_born){.descent = design.descent,
                       .born = design.born,
                       .died = design.died >= 0 ? (uint32_t)design.died : ALIVE,
                       .masses = (uint16_t)design.size.masses,
                       .springs = (uint16_t)design.size.springs,
                       .is_cut = design.is_cut,
                       .score = design.score};
  reading->births[design.born]++;
  if (design.died >= 0)
    reading->deaths[design.died]++;
  return reading->taken && reading->sink->design != NULL
             ? reading->sink->design(reading->sink->context, &design)
             : MO_OK;
}

static bool same_bits(double a, double b)
{
  uint64_t words[2];
  memcpy(&words[0], &a, sizeof(a));
  memcpy(&words[1], &b, sizeof(b));
  return words[0] == words[1];
}

/* Returns the reason why a population does not match its generation, or NULL if it does. */
static const char *check_population(struct mo_reading *reading, uint32_t generation, uint32_t n)
{
  for (uint32_t i = 0; i < n; i++) {
    const struct mo_campaign_member *member = &reading->members[i];
    struct mo_born *born = member->number < reading->n_born ? &reading->born[member->number] : NULL;
    if (born == NULL || born->born > generation ||
        (born->died != ALIVE && born->died <= generation) || born->stamp == generation + 1)
      return "the population has a duplicate design, or one that was not alive";
    born->stamp = generation + 1;
    if ((member->score < 0 && !reading->campaign.record.select_by.is_set) ||
        (generation == reading->campaign.generation && !same_bits(member->score, born->score)))
      return "a score in the population differs from the design's score";
  }
  return n == reading->n_alive ? NULL : "the population lacks a design that was alive";
}

static uint32_t count_cut(const struct mo_reading *reading,
                          const struct mo_campaign_generation *row)
{
  uint32_t n = 0;
  for (uint32_t i = 0; i < row->n_children; i++)
    n += reading->born[row->born_before + i].is_cut;
  return n;
}

/* Returns whether the population contains a design. */
static bool has_member(const struct mo_reading *reading, uint32_t n_members, uint32_t number)
{
  for (uint32_t i = 0; i < n_members; i++)
    if (reading->members[i].number == number)
      return true;
  return false;
}

/* Completes the results of a re-evaluated generation, and the row. Returns the reason why they do
 * not match the generation, or NULL if they do. */
static const char *check_held_out(const struct mo_reading *reading, uint32_t n_members,
                                  struct mo_campaign_generation *row,
                                  struct mo_re_evaluated *held_out, uint32_t n)
{
  const struct mo_re_evaluation *settings = &reading->campaign.record.re_evaluate;
  uint32_t numbers[MO_ELITE_BEST_MAX];
  double scores[MO_ELITE_BEST_MAX];
  uint32_t n_best = n_members < settings->designs ? n_members : settings->designs;
  if (n > 0 && settings->every == 0)
    return "the campaign does not re-evaluate designs";
  if (settings->every == 0)
    n_best = 0;
  for (uint32_t i = 0; i < n; i++) {
    const bool has_mean = isfinite(held_out[i].mean) && isfinite(held_out[i].standard_error);
    held_out[i].generation = row->generation;
    held_out[i].worlds = settings->environments;
    if ((i > 0 && held_out[i].number <= held_out[i - 1].number) ||
        !has_member(reading, n_members, held_out[i].number))
      return "re-evaluated designs are out of order, or not in the population";
    if (held_out[i].diverged > held_out[i].worlds || has_mean != (held_out[i].diverged == 0) ||
        (has_mean && !(held_out[i].standard_error >= 0)))
      return "the result of a re-evaluated design contradicts its divergences";
  }
  for (uint32_t i = 0; i < n_best; i++) {
    numbers[i] = reading->members[i].number;
    scores[i] = reading->members[i].score;
  }
  row->held_out = mo_held_out_summary(settings, held_out, n, numbers, scores, n_best);
  return NULL;
}

static int read_generation(struct mo_reading *reading, uint32_t n, const char *line, size_t size)
{
  struct mo_campaign_generation row;
  struct mo_re_evaluated held_out[MO_ELITE_MAX];
  struct mo_message words = {""};
  uint32_t n_members = 0, n_held_out = 0;
  int error =
      mo_bundle_read_generation(reading->lines, line, size, &row, reading->members,
                                MO_POPULATION_MAX, &n_members, held_out, &n_held_out, &words);
  if (error != MO_OK)
    return error == MO_ERR_FORMAT ? mo_reading_refuse(reading, n, words.text) : error;
  const uint32_t generation = (uint32_t)(reading->generation + 1);
  if (row.generation != generation || generation > reading->campaign.generation)
    return mo_reading_refuse(reading, n, "the generation is out of order");
  reading->n_alive += reading->births[generation] - reading->deaths[generation];
  const char *fault = check_population(reading, generation, n_members);
  if (fault == NULL &&
      (row.stats.n != n_members || row.n_children != reading->births[generation] ||
       row.born_before + row.n_children > reading->n_born ||
       (row.n_children > 0 && reading->born[row.born_before].born != generation) ||
       (row.born_before > 0 && reading->born[row.born_before - 1].born >= generation) ||
       row.children_cut != count_cut(reading, &row)))
    fault = "the statistics do not match the population";
  if (fault == NULL)
    fault = check_held_out(reading, n_members, &row, held_out, n_held_out);
  if (fault != NULL)
    return mo_reading_refuse(reading, n, fault);
  reading->generation = generation;
  if (!reading->taken || reading->sink->generation == NULL)
    return MO_OK;
  struct mo_descent *births = malloc(((size_t)row.n_children + 1) * sizeof(*births));
  if (births == NULL)
    return MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < row.n_children; i++)
    births[i] = reading->born[row.born_before + i].descent;
  error =
      reading->sink->generation(reading->sink->context, &row, births, reading->members, n_members);
  for (uint32_t i = 0; i < n_held_out && error == MO_OK && reading->sink->held_out != NULL; i++)
    error = reading->sink->held_out(reading->sink->context, &held_out[i]);
  free(births);
  return error;
}

static int read_step(struct mo_reading *reading, uint32_t n, const char *line, size_t size)
{
  struct mo_campaign_step step;
  struct mo_message words = {""};
  const int error = mo_bundle_read_step(reading->lines, line, size, &step, &words);
  if (error != MO_OK)
    return error == MO_ERR_FORMAT ? mo_reading_refuse(reading, n, words.text) : error;
  const struct mo_campaign_settings *settings = &reading->campaign.record.settings;
  if (reading->n_steps / MO_BUNDLE_PART_ROWS != reading->part_number)
    return mo_reading_refuse(reading, n, "the step belongs in another part");
  while (reading->step == steps_of(settings, reading->step_generation) &&
         reading->step_generation < reading->campaign.generation) {
    reading->step_generation++;
    reading->step = 0;
  }
  if (step.generation != reading->step_generation || step.step != reading->step + 1 ||
      step.step > steps_of(settings, step.generation))
    return mo_reading_refuse(reading, n, "the step is out of order");
  reading->step = step.step;
  reading->n_steps++;
  return reading->taken && reading->sink->step != NULL
             ? reading->sink->step(reading->sink->context, &step)
             : MO_OK;
}

static int read_score(struct mo_reading *reading, uint32_t n, const char *line, size_t size)
{
  struct mo_campaign_score score;
  struct mo_message words = {""};
  uint64_t places = 0;
  int error = mo_bundle_read_score(reading->lines, line, size, &score, &words);
  if (error != MO_OK)
    return error == MO_ERR_FORMAT ? mo_reading_refuse(reading, n, words.text) : error;
  if (score.measures != NULL && reading->campaign.record.measures == 0)
    return mo_reading_refuse(reading, n, "the campaign names no measures");
  for (uint32_t k = 0; k < score.n; k++) {
    if (score.environments[k] >= reading->n_environments ||
        (places >> score.environments[k] & 1) != 0 ||
        score.diverged_steps[k] > reading->campaign.record.settings.physics.scheme.n_steps)
      return mo_reading_refuse(reading, n,
                               "duplicate or unknown environment, or a step beyond the last");
    places |= UINT64_C(1) << score.environments[k];
  }
  if (score.number >= reading->n_born || mo_modes[reading->campaign.record.settings.mode].learns)
    return mo_reading_refuse(
        reading, n,
        "the score must belong to a design of the campaign, and the campaign must not learn");
  if (score.number + 1 < reading->scored_number ||
      score.number / MO_BUNDLE_PART_ROWS != reading->part_number)
    return mo_reading_refuse(reading, n, "the score is out of order, or in the wrong part");
  if (score.number + 1 != reading->scored_number) {
    error = end_scores(reading);
    if (error != MO_OK)
      return error;
    reading->scored_number = score.number + 1;
    mo_bundle_scores_begin(reading->scores, score.number);
  }
  error = mo_bundle_scores_add(reading->scores, &score, &words);
  if (error < 0)
    return mo_reading_refuse(reading, n, words.text);
  summary_of(reading)->n_scores += score.n;
  return reading->taken && reading->sink->score != NULL
             ? reading->sink->score(reading->sink->context, &score)
             : MO_OK;
}

/* ---- recordings of a campaign ---- */

static int read_evaluation(struct mo_reading *reading)
{
  struct mo_bundle_recordings *recordings = reading->recordings;
  const struct mo_imported_evaluation *evaluation = &recordings->evaluation;
  const struct mo_campaign_settings *settings = &reading->campaign.record.settings;
  struct mo_message words = {""};
  uint64_t places = 0;
  int error = mo_bundle_read_evaluation(reading->lines, reading->member.bytes, reading->member.size,
                                        &recordings->evaluation, &words);
  if (error != MO_OK)
    return error == MO_ERR_FORMAT ? mo_reading_refuse(reading, 1, words.text) : error;
  if (mo_modes[settings->mode].learns || evaluation->stride > settings->physics.scheme.n_steps)
    return mo_reading_refuse(
        reading, 1, "the campaign must not learn, and the stride must not exceed the rollout");
  for (uint32_t k = 0; k < evaluation->n_environments; k++) {
    if (evaluation->environments[k] >= reading->n_environments ||
        (places >> evaluation->environments[k] & 1) != 0)
      return mo_reading_refuse(reading, 1, "duplicate or unknown environment");
    places |= UINT64_C(1) << evaluation->environments[k];
  }
  for (uint32_t i = 0; i < evaluation->n_designs; i++)
    if (evaluation->numbers[i] >= reading->n_born)
      return mo_reading_refuse(reading, 1, "the recording must belong to a design of the campaign");
  mo_bundle_recordings_begin(recordings, &settings->physics);
  summary_of(reading)->n_recordings++;
  const int taken = reading->taken && reading->sink->evaluation != NULL
                        ? reading->sink->evaluation(reading->sink->context, evaluation)
                        : 0;
  reading->evaluation_taken = taken == 1;
  return taken < 0 ? taken : MO_OK;
}

static int read_array(struct mo_reading *reading)
{
  struct mo_bundle_recordings *recordings = reading->recordings;
  const struct mo_born *born = &reading->born[recordings->evaluation.numbers[recordings->place]];
  recordings->n_masses = born->masses;
  recordings->n_springs = born->springs;
  struct mo_saved_trajectory rollout = {.design_position = recordings->place,
                                        .environment_position = recordings->environment,
                                        .frames = recordings->frames,
                                        .n_masses = born->masses,
                                        .n_springs = born->springs};
  int error = mo_bundle_read_array(recordings, reading->member.bytes, reading->member.size);
  if (error != MO_OK)
    return error == MO_ERR_FORMAT
               ? mo_reading_refuse(reading, 0, "the array has the wrong type or shape")
               : error;
  if (mo_bundle_recordings_next(recordings) == 0)
    return MO_OK;
  rollout.recording = recordings->recording;
  if (reading->evaluation_taken && reading->sink->rollout != NULL)
    error = reading->sink->rollout(reading->sink->context, &rollout);
  mo_recording_free(&recordings->recording);
  recordings->recording.stride = 0;
  return error;
}

/* Reads a member with recordings. name: without the folder of the campaign. */
int mo_reading_recordings(struct mo_reading *reading, const char *name)
{
  char expected[MO_ARCHIVE_NAME_BYTES];
  mo_bundle_recordings_name(reading->recordings, expected);
  if (strcmp(name, expected) != 0)
    return mo_reading_refuse(reading, 0, "the member is out of order");
  return reading->recordings->channel == 0 ? read_evaluation(reading) : read_array(reading);
}

int mo_reading_lines(struct mo_reading *reading)
{
  static int (*const read[])(struct mo_reading * reading, uint32_t n, const char *line,
                             size_t size) = {[MO_PART_DESIGNS] = read_design,
                                             [MO_PART_GENERATIONS] = read_generation,
                                             [MO_PART_LEARNING] = read_step,
                                             [MO_PART_SCORES] = read_score};
  size_t at = 0, from = 0, size;
  uint32_t n = 0;
  int error = mo_reading_check_lines(reading);
  char *line;
  while (error == MO_OK && mo_archive_line(&reading->member, &at, &line, &size)) {
    if (reading->part == MO_PART_GENERATIONS && from >= MO_BUNDLE_PART_BYTES)
      return mo_reading_refuse(reading, n + 1, "the line belongs in the next part");
    from = at;
    error = n % LINES_BETWEEN_LOOKS == 0 && mo_reading_is_over(reading)
                ? MO_ERR_CANCELLED
                : read[reading->part](reading, ++n, line, size);
  }
  return error;
}
