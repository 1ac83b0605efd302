/* bundle_read.c: reads a bundle and checks it as a whole: which members there are and in which
 * order, and what the lines of a campaign say of each other. See docs/bundles.md. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "api/bundle.h"
#include "api/bundle_scores.h"
#include "store/store.h"

#define ALIVE UINT32_MAX

/* The members of a campaign, in their order. */
enum part { NOTHING, CAMPAIGN, ENVIRONMENTS, DESIGNS, GENERATIONS, LEARNING, SCORES, RECORDINGS };
/* A name that ends with a slash is a folder; its members are numbered. */
static const char *const parts[] = {
    [CAMPAIGN] = "campaign.json", [ENVIRONMENTS] = "environments.ndjson",
    [DESIGNS] = "designs/",       [GENERATIONS] = "generations/",
    [LEARNING] = "learning/",     [SCORES] = "scores/",
    [RECORDINGS] = "recordings/"};

#define LINES_BETWEEN_LOOKS 256 /* whether to end early */

/* What is known of a design. */
struct born {
  struct mo_descent descent;
  uint32_t born, died, stamp; /* stamp: the last population that has it, plus 1 */
  uint16_t masses, springs;
  bool is_cut;
  double score;
};

struct known_controller {
  struct mo_sha256 sha256;
  enum mo_sensor sensor;
};

struct reading {
  struct mo_archive_reader *archive;
  struct mo_archive_member member;
  struct mo_bundle_lines *lines;
  const struct mo_bundle_sink *sink;
  const struct mo_bundle_summary *known;
  struct mo_bundle_summary *summary;
  struct mo_message *message;
  struct mo_bundle_head head;     /* version 0: bundle.json was not read */
  uint32_t n_controllers, n_used; /* n_used: that campaigns so far begin or end with */
  struct known_controller controllers[2 * MO_BUNDLE_CAMPAIGNS];
  /* The campaign that is read. */
  enum part part;
  uint32_t n_parts;     /* numbers of parts that are used */
  uint64_t part_number; /* of this one */
  size_t part_size;
  bool taken; /* the sink takes it */
  char folder[64];
  struct mo_imported_campaign campaign;
  uint32_t n_environments;
  struct born *born; /* (n_born) */
  uint32_t n_born, room;
  uint32_t *births, *deaths; /* (generation + 1) */
  int64_t generation;        /* of the newest row */
  uint32_t n_alive;
  struct mo_campaign_member *members; /* (MO_POPULATION_MAX) */
  uint32_t step_generation, step;     /* of the newest step of learning */
  uint64_t n_steps;
  struct mo_bundle_scores *scores; /* of the design scored_number − 1 */
  uint32_t scored_number;          /* 0: there were no scores yet */
  struct mo_text digest;           /* lines of the members that make the history */
  struct mo_bundle_recordings *recordings;
  bool evaluation_taken;
};

static int refuse(struct reading *reading, uint32_t line, const char *words)
{
  return mo_archive_refuse(&reading->member, line, words, reading->message);
}

/* ---- the head and the controllers ---- */

static bool is_over(const struct reading *reading)
{
  return reading->sink->is_over != NULL && reading->sink->is_over(reading->sink->context);
}

/* Refuses a member with lines that has none, or whose last one does not end. */
static int check_lines(struct reading *reading)
{
  const struct mo_archive_member *member = &reading->member;
  return member->size > 0 && member->bytes[member->size - 1] == '\n'
             ? MO_OK
             : refuse(reading, 0, "has no line, or its last one has no end");
}

static int read_head(struct reading *reading)
{
  struct mo_archive_member *member = &reading->member;
  struct mo_message words = {""};
  size_t at = 0, size;
  char *line;
  if (strcmp(member->name, "bundle.json") != 0)
    return refuse(reading, 0, "a bundle begins with bundle.json");
  int error = check_lines(reading);
  if (error != MO_OK)
    return error;
  mo_archive_line(member, &at, &line, &size);
  error = mo_bundle_read_head(reading->lines, line, size, &reading->head, &words);
  if (error == MO_ERR_FORMAT)
    return refuse(reading, 1, words.text);
  return error == MO_OK && at < member->size ? refuse(reading, 2, "one line is expected") : error;
}

static uint32_t find_controller(const struct reading *reading, const struct mo_sha256 *sha256)
{
  uint32_t i = 0;
  while (i < reading->n_controllers && !mo_sha256_equal(&reading->controllers[i].sha256, sha256))
    i++;
  return i;
}

static int read_controller(struct reading *reading)
{
  const struct mo_archive_member *member = &reading->member;
  struct mo_controller *controller = NULL;
  if (reading->n_controllers == sizeof(reading->controllers) / sizeof(reading->controllers[0]))
    return refuse(reading, 0, "too many controllers");
  int error = mo_bundle_read_weights(member, &controller, reading->message);
  if (error != MO_OK)
    return error;
  if (!mo_workspace_equal(controller->workspace, MO_DEFAULT_WORKSPACE)) {
    mo_controller_free(controller);
    return refuse(reading, 0, "the controller has another workspace");
  }
  if (find_controller(reading, &member->sha256) < reading->n_controllers) {
    mo_controller_free(controller);
    return refuse(reading, 0, "the controller is there twice");
  }
  reading->controllers[reading->n_controllers++] =
      (struct known_controller){member->sha256, controller->sensor};
  reading->summary->n_controllers++;
  if (reading->sink->controller != NULL)
    error = reading->sink->controller(reading->sink->context, controller, &member->sha256,
                                      member->bytes, member->size);
  mo_controller_free(controller);
  return error;
}

/* Finds a controller of a campaign: one that was used, or the next one. NULL: it is neither. */
static const struct known_controller *use_controller(struct reading *reading,
                                                     const struct mo_sha256 *sha256)
{
  const uint32_t i = find_controller(reading, sha256);
  if (i == reading->n_controllers || i > reading->n_used)
    return NULL;
  reading->n_used += i == reading->n_used;
  return &reading->controllers[i];
}

/* ---- a campaign begins and ends ---- */

static struct mo_bundle_campaign *summary_of(struct reading *reading)
{
  return &reading->summary->campaigns[reading->summary->n - 1];
}

/* Returns how many steps a generation learns. */
static uint32_t steps_of(const struct mo_campaign_settings *settings, uint32_t generation)
{
  return mo_mode_learns(settings->mode)
             ? (generation > 0 ? settings->parent_steps : 0) + settings->child_steps
             : 0;
}

/* Ends the scores of a design. */
static int end_scores(struct reading *reading)
{
  struct mo_message words = {""};
  if (reading->scored_number == 0)
    return MO_OK;
  const struct born *born = &reading->born[reading->scored_number - 1];
  const int error = mo_bundle_scores_end(reading->scores, born->score, born->is_cut, &words);
  return error == MO_OK ? MO_OK
                        : mo_fail(reading->message, error, "%.90sscores/: %.150s", reading->folder,
                                  words.text);
}

static int end_campaign(struct reading *reading)
{
  const struct mo_imported_campaign *campaign = &reading->campaign;
  const struct mo_campaign_settings *settings = &campaign->record.settings;
  if (reading->part == NOTHING)
    return MO_OK;
  if (reading->part < ENVIRONMENTS || reading->n_born != campaign->n_designs ||
      reading->generation != campaign->generation)
    return mo_fail(reading->message, MO_ERR_FORMAT,
                   "%s: there are fewer environments, designs or generations than the campaign has",
                   reading->folder);
  if (reading->recordings->channel != 0)
    return mo_fail(reading->message, MO_ERR_FORMAT, "%s: a recording lacks arrays",
                   reading->folder);
  uint64_t n_steps = 0;
  for (int64_t generation = 0; generation <= campaign->generation; generation++)
    n_steps += steps_of(settings, (uint32_t)generation);
  if (reading->n_steps != n_steps)
    return mo_fail(reading->message, MO_ERR_FORMAT,
                   "%slearning/: there are %llu steps, but the campaign learned in %llu",
                   reading->folder, (unsigned long long)reading->n_steps,
                   (unsigned long long)n_steps);
  const int error = end_scores(reading);
  if (error != MO_OK)
    return error;
  if (campaign->generation < 0)
    mo_bundle_digest_source(&reading->digest, &campaign->source, campaign->created_us);
  if (reading->digest.failed)
    return MO_ERR_NO_MEMORY;
  mo_sha256_of(reading->digest.data, reading->digest.size, &summary_of(reading)->source.digest);
  reading->part = NOTHING;
  return MO_OK;
}

static int begin_campaign(struct reading *reading)
{
  struct mo_imported_campaign *campaign = &reading->campaign;
  const struct mo_campaign_record *record = &campaign->record;
  struct mo_bundle_summary *summary = reading->summary;
  struct mo_message words = {""};
  const struct known_controller *start;
  int error = mo_bundle_read_campaign(reading->lines, reading->member.bytes, reading->member.size,
                                      campaign, &words);
  if (error != MO_OK)
    return error == MO_ERR_FORMAT ? refuse(reading, 1, words.text) : error;
  start = campaign->has_controller ? use_controller(reading, &campaign->controller_sha256) : NULL;
  if ((campaign->has_controller && (start == NULL || start->sensor != record->settings.sensor)) ||
      (campaign->has_result && use_controller(reading, &campaign->result_sha256) == NULL))
    return refuse(reading, 1,
                  "the bundle lacks the controller or has it out of order, or its sensor is "
                  "another one");
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

/* Reads the environments, and hands the campaign over. */
static int read_environments(struct reading *reading)
{
  struct mo_imported_campaign *campaign = &reading->campaign;
  size_t at = 0, size;
  char *line;
  int error = check_lines(reading);
  if (error != MO_OK)
    return error;
  while (mo_archive_line(&reading->member, &at, &line, &size)) {
    struct mo_message words = {""};
    if (reading->n_environments == campaign->record.n_environments)
      return refuse(reading, reading->n_environments + 1, "one environment too many");
    error = mo_bundle_read_environment(reading->lines, line, size,
                                       &campaign->environments[reading->n_environments++], &words);
    if (error != MO_OK)
      return error == MO_ERR_FORMAT ? refuse(reading, reading->n_environments, words.text) : error;
  }
  if (reading->n_environments != campaign->record.n_environments)
    return refuse(reading, 0, "there are fewer environments than the campaign has");
  mo_bundle_scores_open(reading->scores, campaign);
  const int taken = reading->sink->campaign != NULL
                        ? reading->sink->campaign(reading->sink->context, campaign)
                        : 1;
  reading->taken = taken == 1;
  return taken < 0 ? taken : MO_OK;
}

/* ---- lines of a campaign ---- */

/* Says whether a design agrees with its parents and with the campaign; NULL: it does. */
static const char *check_design(const struct reading *reading,
                                const struct mo_campaign_design *design)
{
  static const int n_parents[] = {0, 0, 0, 1, 2};
  const struct mo_descent *descent = &design->descent;
  const struct mo_campaign_record *record = &reading->campaign.record;
  const int n = (descent->parents[0] != MO_NO_PARENT) + (descent->parents[1] != MO_NO_PARENT);
  struct mo_bits moved;
  if (design->number != reading->n_born || design->number >= reading->campaign.n_designs ||
      design->number / MO_BUNDLE_PART_ROWS != reading->part_number)
    return "designs are not numbered in order, are too many, or are in another part";
  if (n != n_parents[descent->op])
    return "another number of parents than the operator has";
  if (design->born > reading->campaign.generation ||
      (reading->n_born > 0 && design->born < reading->born[reading->n_born - 1].born) ||
      (design->died >= 0 && design->died < design->born) ||
      design->died > reading->campaign.generation)
    return "born or died out of order";
  if (design->score < 0)
    return "a score is a loss, and not below 0";
  if (design->is_cut && (n == 0 || design->died != design->born || !isfinite(design->score)))
    return "a score is a lower bound only of a child that was never selected";
  if (memcmp(&record->settings.workspace, &MO_DEFAULT_WORKSPACE,
             sizeof(record->settings.workspace)) != 0 &&
      mo_workspace_words(record->settings.workspace) <= MO_DEFAULT_WORDS &&
      mo_genotype_move(MO_DEFAULT_WORKSPACE, design->genotype.words, record->settings.workspace,
                       moved.words) != MO_OK)
    return "the body does not fit the workspace of the campaign";
  for (int p = 0; p < n; p++) {
    const uint32_t parent = descent->parents[p];
    if (parent >= design->number || reading->born[parent].born >= design->born ||
        reading->born[parent].died < design->born)
      return "a parent did not live then";
  }
  return NULL;
}

static int read_design(struct reading *reading, uint32_t n, const char *line, size_t size)
{
  struct mo_campaign_design design;
  struct mo_message words = {""};
  int error = mo_bundle_read_design(reading->lines, line, size, &design, &words);
  if (error != MO_OK)
    return error == MO_ERR_FORMAT ? refuse(reading, n, words.text) : error;
  const char *fault = check_design(reading, &design);
  if (fault != NULL)
    return refuse(reading, n, fault);
  if (reading->n_born == reading->room) {
    const uint32_t room = reading->room > 0 ? 2 * reading->room : 4096;
    struct born *born = realloc(reading->born, room * sizeof(*born));
    if (born == NULL)
      return MO_ERR_NO_MEMORY;
    reading->born = born;
    reading->room = room;
  }
  reading->born[reading->n_born++] =
      (struct born){.descent = design.descent,
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

/* Says whether a population is that of its generation; NULL: it is. */
static const char *check_population(struct reading *reading, uint32_t generation, uint32_t n)
{
  for (uint32_t i = 0; i < n; i++) {
    const struct mo_campaign_member *member = &reading->members[i];
    struct born *born = member->number < reading->n_born ? &reading->born[member->number] : NULL;
    if (born == NULL || born->born > generation ||
        (born->died != ALIVE && born->died <= generation) || born->stamp == generation + 1)
      return "the population has a design twice, or one that did not live then";
    born->stamp = generation + 1;
    if (member->score < 0 ||
        (generation == reading->campaign.generation && !same_bits(member->score, born->score)))
      return "a score of the population is not that of the design";
  }
  return n == reading->n_alive ? NULL : "the population lacks a design that lived then";
}

static uint32_t count_cut(const struct reading *reading, const struct mo_campaign_generation *row)
{
  uint32_t n = 0;
  for (uint32_t i = 0; i < row->n_children; i++)
    n += reading->born[row->born_before + i].is_cut;
  return n;
}

static int read_generation(struct reading *reading, uint32_t n, const char *line, size_t size)
{
  struct mo_campaign_generation row;
  struct mo_message words = {""};
  uint32_t n_members = 0;
  int error = mo_bundle_read_generation(reading->lines, line, size, &row, reading->members,
                                        MO_POPULATION_MAX, &n_members, &words);
  if (error != MO_OK)
    return error == MO_ERR_FORMAT ? refuse(reading, n, words.text) : error;
  const uint32_t generation = (uint32_t)(reading->generation + 1);
  if (row.generation != generation || generation > reading->campaign.generation)
    return refuse(reading, n, "a generation out of order");
  reading->n_alive += reading->births[generation] - reading->deaths[generation];
  const char *fault = check_population(reading, generation, n_members);
  if (fault == NULL &&
      (row.stats.n != n_members || row.n_children != reading->births[generation] ||
       row.born_before + row.n_children > reading->n_born ||
       (row.n_children > 0 && reading->born[row.born_before].born != generation) ||
       (row.born_before > 0 && reading->born[row.born_before - 1].born >= generation) ||
       row.children_cut != count_cut(reading, &row)))
    fault = "the statistics are of another population";
  if (fault != NULL)
    return refuse(reading, n, fault);
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
  free(births);
  return error;
}

static int read_step(struct reading *reading, uint32_t n, const char *line, size_t size)
{
  struct mo_campaign_step step;
  struct mo_message words = {""};
  const int error = mo_bundle_read_step(reading->lines, line, size, &step, &words);
  if (error != MO_OK)
    return error == MO_ERR_FORMAT ? refuse(reading, n, words.text) : error;
  const struct mo_campaign_settings *settings = &reading->campaign.record.settings;
  if (reading->n_steps / MO_BUNDLE_PART_ROWS != reading->part_number)
    return refuse(reading, n, "the step belongs to another part");
  while (reading->step == steps_of(settings, reading->step_generation) &&
         reading->step_generation < reading->campaign.generation) {
    reading->step_generation++;
    reading->step = 0;
  }
  if (step.generation != reading->step_generation || step.step != reading->step + 1 ||
      step.step > steps_of(settings, step.generation))
    return refuse(reading, n, "a step out of order");
  reading->step = step.step;
  reading->n_steps++;
  return reading->taken && reading->sink->step != NULL
             ? reading->sink->step(reading->sink->context, &step)
             : MO_OK;
}

static int read_score(struct reading *reading, uint32_t n, const char *line, size_t size)
{
  struct mo_campaign_score score;
  struct mo_message words = {""};
  uint64_t places = 0;
  int error = mo_bundle_read_score(reading->lines, line, size, &score, &words);
  if (error != MO_OK)
    return error == MO_ERR_FORMAT ? refuse(reading, n, words.text) : error;
  for (uint32_t k = 0; k < score.n; k++) {
    if (score.environments[k] >= reading->n_environments ||
        (places >> score.environments[k] & 1) != 0 ||
        score.diverged_steps[k] > reading->campaign.record.settings.physics.n_steps)
      return refuse(reading, n, "an environment twice or unknown, or a step beyond the last");
    places |= UINT64_C(1) << score.environments[k];
  }
  if (score.number >= reading->n_born || reading->campaign.record.settings.mode != MO_ZERO_SHOT)
    return refuse(reading, n, "a score of no design of the campaign, or the campaign learns");
  if (score.number + 1 < reading->scored_number ||
      score.number / MO_BUNDLE_PART_ROWS != reading->part_number)
    return refuse(reading, n, "a score out of order, or in another part");
  if (score.number + 1 != reading->scored_number) {
    error = end_scores(reading);
    if (error != MO_OK)
      return error;
    reading->scored_number = score.number + 1;
    mo_bundle_scores_begin(reading->scores, score.number);
  }
  error = mo_bundle_scores_add(reading->scores, &score, &words);
  if (error < 0)
    return refuse(reading, n, words.text);
  summary_of(reading)->n_scores += score.n;
  return reading->taken && reading->sink->score != NULL
             ? reading->sink->score(reading->sink->context, &score)
             : MO_OK;
}

/* ---- recordings of a campaign ---- */

static int read_evaluation(struct reading *reading)
{
  struct mo_bundle_recordings *recordings = reading->recordings;
  const struct mo_imported_evaluation *evaluation = &recordings->evaluation;
  const struct mo_campaign_settings *settings = &reading->campaign.record.settings;
  struct mo_message words = {""};
  uint64_t places = 0;
  int error = mo_bundle_read_evaluation(reading->lines, reading->member.bytes, reading->member.size,
                                        &recordings->evaluation, &words);
  if (error != MO_OK)
    return error == MO_ERR_FORMAT ? refuse(reading, 1, words.text) : error;
  if (settings->mode != MO_ZERO_SHOT || evaluation->stride > settings->physics.n_steps)
    return refuse(reading, 1, "the campaign learns, or the stride is longer than a rollout");
  for (uint32_t k = 0; k < evaluation->n_environments; k++) {
    if (evaluation->environments[k] >= reading->n_environments ||
        (places >> evaluation->environments[k] & 1) != 0)
      return refuse(reading, 1, "an environment twice or unknown");
    places |= UINT64_C(1) << evaluation->environments[k];
  }
  for (uint32_t i = 0; i < evaluation->n_designs; i++)
    if (evaluation->numbers[i] >= reading->n_born)
      return refuse(reading, 1, "a recording of no design of the campaign");
  mo_bundle_recordings_begin(recordings, &settings->physics);
  summary_of(reading)->n_recordings++;
  const int taken = reading->taken && reading->sink->evaluation != NULL
                        ? reading->sink->evaluation(reading->sink->context, evaluation)
                        : 0;
  reading->evaluation_taken = taken == 1;
  return taken < 0 ? taken : MO_OK;
}

static int read_array(struct reading *reading)
{
  struct mo_bundle_recordings *recordings = reading->recordings;
  const struct born *born = &reading->born[recordings->evaluation.numbers[recordings->place]];
  recordings->n_masses = born->masses;
  recordings->n_springs = born->springs;
  struct mo_saved_trajectory rollout = {.design_position = recordings->place,
                                        .environment_position = recordings->environment,
                                        .frames = recordings->frames,
                                        .n_masses = born->masses,
                                        .n_springs = born->springs};
  int error = mo_bundle_read_array(recordings, reading->member.bytes, reading->member.size);
  if (error != MO_OK)
    return error == MO_ERR_FORMAT ? refuse(reading, 0, "not the array that was recorded") : error;
  if (mo_bundle_recordings_next(recordings) == 0)
    return MO_OK;
  rollout.recording = recordings->recording;
  if (reading->evaluation_taken && reading->sink->rollout != NULL)
    error = reading->sink->rollout(reading->sink->context, &rollout);
  mo_recording_free(&recordings->recording);
  recordings->recording.stride = 0;
  return error;
}

/* name: behind the folder of the campaign. */
static int read_recordings(struct reading *reading, const char *name)
{
  char expected[MO_ARCHIVE_NAME_BYTES];
  mo_bundle_recordings_name(reading->recordings, expected);
  if (strcmp(name, expected) != 0)
    return refuse(reading, 0, "the member is out of order");
  return reading->recordings->channel == 0 ? read_evaluation(reading) : read_array(reading);
}

static int read_lines(struct reading *reading)
{
  static int (*const read[])(struct reading * reading, uint32_t n, const char *line,
                             size_t size) = {[DESIGNS] = read_design,
                                             [GENERATIONS] = read_generation,
                                             [LEARNING] = read_step,
                                             [SCORES] = read_score};
  size_t at = 0, from = 0, size;
  uint32_t n = 0;
  int error = check_lines(reading);
  char *line;
  while (error == MO_OK && mo_archive_line(&reading->member, &at, &line, &size)) {
    if (reading->part == GENERATIONS && from >= MO_BUNDLE_PART_BYTES)
      return refuse(reading, n + 1, "the line belongs to the next part");
    from = at;
    error = n % LINES_BETWEEN_LOOKS == 0 && is_over(reading)
                ? MO_ERR_CANCELLED
                : read[reading->part](reading, ++n, line, size);
  }
  return error;
}

/* ---- members ---- */

/* Begins the campaign that is the next one of bundle.json. */
static int next_campaign(struct reading *reading)
{
  const struct mo_bundle_head *head = &reading->head;
  const int error = end_campaign(reading);
  if (error != MO_OK)
    return error;
  if (reading->summary->n == head->n)
    return refuse(reading, 0, "bundle.json does not name the campaign");
  snprintf(reading->folder, sizeof(reading->folder), "campaigns/%lld/",
           (long long)head->campaigns[reading->summary->n]);
  if (strncmp(reading->member.name, reading->folder, strlen(reading->folder)) != 0)
    return refuse(reading, 0, "bundle.json names another campaign here");
  reading->part = CAMPAIGN;
  return begin_campaign(reading);
}

/* Says whether the name of a member is that of the next one of a part; sets part_number. */
static bool is_next(struct reading *reading, enum part part, const char *name)
{
  const size_t folder = strlen(parts[part]);
  char expected[MO_ARCHIVE_NAME_BYTES];
  if (parts[part][folder - 1] != '/')
    return strcmp(name, parts[part]) == 0 && part != reading->part;
  if (part == RECORDINGS)
    return true; /* see read_recordings */
  const uint32_t n_parts = part == reading->part ? reading->n_parts : 0;
  const uint64_t number = strtoull(name + folder, NULL, 10);
  snprintf(expected, sizeof(expected), "%s%08llu.ndjson", parts[part], (unsigned long long)number);
  /* Designs without scores may fill a part. */
  if (strcmp(name, expected) != 0 || number >= UINT32_MAX || number < n_parts ||
      (number > n_parts && part != SCORES) ||
      (part == GENERATIONS && number > 0 && reading->part_size < MO_BUNDLE_PART_BYTES))
    return false;
  reading->part_number = number;
  reading->part_size = reading->member.size;
  reading->n_parts = (uint32_t)number + 1;
  return true;
}

/* Reads a member of campaigns/ID/. */
static int read_of_campaign(struct reading *reading)
{
  const char *name = reading->member.name, *slash = strchr(name + strlen("campaigns/"), '/');
  const size_t folder = strlen(reading->folder);
  enum part part = CAMPAIGN;
  if (slash != NULL && strcmp(slash + 1, parts[CAMPAIGN]) == 0)
    return next_campaign(reading);
  if (reading->part == NOTHING || strncmp(name, reading->folder, folder) != 0)
    return refuse(reading, 0, "the member is of another campaign, or of none");
  name += folder;
  while (part <= RECORDINGS && strncmp(name, parts[part], strlen(parts[part])) != 0)
    part++;
  if (part > RECORDINGS)
    return refuse(reading, 0, "not a member of a bundle");
  if (part < reading->part || (part > ENVIRONMENTS && reading->part < ENVIRONMENTS) ||
      (part > DESIGNS && reading->n_born != reading->campaign.n_designs) ||
      !is_next(reading, part, name))
    return refuse(reading, 0, "the member is out of order, or its name is not the one expected");
  reading->part = part;
  if (part < SCORES) /* scores and recordings may grow later */
    mo_text_format(&reading->digest, "%s  %s\n", MO_SHA256_HEX(&reading->member.sha256), name);
  return part == ENVIRONMENTS ? read_environments(reading)
         : part == RECORDINGS ? read_recordings(reading, name)
                              : read_lines(reading);
}

static int read_members(struct reading *reading)
{
  int more = 1, error = MO_OK;
  while (error == MO_OK &&
         (more = mo_archive_next(reading->archive, &reading->member, reading->message)) > 0) {
    const char *name = reading->member.name;
    if (is_over(reading))
      error = MO_ERR_CANCELLED;
    else if (reading->head.version == 0)
      error = read_head(reading);
    else if (strncmp(name, "campaigns/", strlen("campaigns/")) == 0)
      error = read_of_campaign(reading);
    else if (strncmp(name, "controllers/", strlen("controllers/")) == 0 && reading->summary->n == 0)
      error = read_controller(reading);
    else
      error = refuse(reading, 0, "not a member of a bundle, or out of order");
  }
  if (error == MO_OK && more == 0)
    error = end_campaign(reading);
  if (error == MO_OK && more == 0 &&
      (reading->summary->n != reading->head.n || reading->n_used != reading->n_controllers))
    error = mo_fail(reading->message, MO_ERR_FORMAT,
                    "the bundle lacks a campaign that bundle.json names, or has a controller that "
                    "no campaign has");
  return error != MO_OK ? error : more;
}

void mo_bundle_digest_source(struct mo_text *digest, const struct mo_import_source *source,
                             int64_t created_us)
{
  mo_text_format(digest, "%016llx %lld %lld\n", (unsigned long long)source->store,
                 (long long)source->job, (long long)created_us);
}

int mo_bundle_read(const void *bytes, size_t size, const struct mo_lattice *lattice,
                   const struct mo_bundle_sink *sink, const struct mo_bundle_summary *known,
                   struct mo_bundle_summary *summary, struct mo_message *message)
{
  struct reading *reading = calloc(1, sizeof(*reading));
  int error = MO_ERR_NO_MEMORY;
  memset(summary, 0, sizeof(*summary));
  if (reading == NULL)
    return error;
  reading->sink = sink;
  reading->known = known;
  reading->summary = summary;
  reading->message = message;
  reading->archive = mo_archive_open(bytes, size);
  reading->lines = mo_bundle_lines_create(lattice, known != NULL);
  reading->members = malloc(MO_POPULATION_MAX * sizeof(*reading->members));
  reading->recordings = calloc(1, sizeof(*reading->recordings));
  reading->scores = mo_bundle_scores_create();
  if (reading->archive != NULL && reading->lines != NULL && reading->members != NULL &&
      reading->recordings != NULL && reading->scores != NULL)
    error = read_members(reading);
  if (error == MO_OK && summary->n == 0)
    error = mo_fail(message, MO_ERR_FORMAT, "the bundle has no campaign");
  mo_archive_close(reading->archive);
  mo_bundle_lines_free(reading->lines);
  mo_text_free(&reading->digest);
  if (reading->recordings != NULL)
    mo_recording_free(&reading->recordings->recording);
  mo_bundle_scores_free(reading->scores);
  free(reading->recordings);
  free(reading->members);
  free(reading->births);
  free(reading->deaths);
  free(reading->born);
  free(reading);
  return error;
}
