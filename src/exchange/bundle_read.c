/* bundle_read.c: reads the members of a bundle in their order. See docs/bundles.md;
 * bundle_campaign.c reads the content of a campaign. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "exchange/bundle_reading.h"

/* A name that ends with a slash is a folder; its members are numbered. */
static const char *const parts[] = {
    [MO_PART_CAMPAIGN] = "campaign.json", [MO_PART_ENVIRONMENTS] = "environments.ndjson",
    [MO_PART_DESIGNS] = "designs/",       [MO_PART_GENERATIONS] = "generations/",
    [MO_PART_LEARNING] = "learning/",     [MO_PART_SCORES] = "scores/",
    [MO_PART_RECORDINGS] = "recordings/"};

/* ---- the head and the controllers ---- */

static int read_head(struct mo_reading *reading)
{
  struct mo_archive_member *member = &reading->member;
  struct mo_message words = {""};
  size_t at = 0, size;
  char *line;
  if (strcmp(member->name, "bundle.json") != 0)
    return mo_reading_refuse(reading, 0, "a bundle must begin with bundle.json");
  int error = mo_reading_check_lines(reading);
  if (error != MO_OK)
    return error;
  mo_archive_line(member, &at, &line, &size);
  error = mo_bundle_read_head(reading->lines, line, size, &reading->head, &words);
  if (error == MO_ERR_FORMAT)
    return mo_reading_refuse(reading, 1, words.text);
  return error == MO_OK && at < member->size
             ? mo_reading_refuse(reading, 2, "must have exactly one line")
             : error;
}

static int read_controller(struct mo_reading *reading)
{
  const struct mo_archive_member *member = &reading->member;
  struct mo_controller *controller = NULL;
  if (reading->n_controllers == sizeof(reading->controllers) / sizeof(reading->controllers[0]))
    return mo_reading_refuse(reading, 0, "too many controllers");
  int error = mo_bundle_read_weights(member, &controller, reading->message);
  if (error != MO_OK)
    return error;
  if (!mo_workspace_equal(controller->workspace, MO_STORE_WORKSPACE)) {
    mo_controller_free(controller);
    return mo_reading_refuse(reading, 0, "the controller has a different workspace");
  }
  if (mo_reading_find_controller(reading, &member->sha256) < reading->n_controllers) {
    mo_controller_free(controller);
    return mo_reading_refuse(reading, 0, "duplicate controller");
  }
  reading->controllers[reading->n_controllers++] =
      (struct mo_known_controller){member->sha256, controller->sensor};
  reading->summary->n_controllers++;
  if (reading->sink->controller != NULL)
    error = reading->sink->controller(reading->sink->context, controller, &member->sha256,
                                      member->bytes, member->size);
  mo_controller_free(controller);
  return error;
}

/* ---- members ---- */

/* Begins the next campaign in bundle.json. */
static int next_campaign(struct mo_reading *reading)
{
  const struct mo_bundle_head *head = &reading->head;
  const int error = mo_reading_end(reading);
  if (error != MO_OK)
    return error;
  if (reading->summary->n == head->n)
    return mo_reading_refuse(reading, 0, "bundle.json does not list the campaign");
  snprintf(reading->folder, sizeof(reading->folder), "campaigns/%lld/",
           (long long)head->campaigns[reading->summary->n]);
  if (strncmp(reading->member.name, reading->folder, strlen(reading->folder)) != 0)
    return mo_reading_refuse(reading, 0, "bundle.json lists a different campaign here");
  reading->part = MO_PART_CAMPAIGN;
  return mo_reading_begin(reading);
}

/* Returns whether the name of a member is the next one of a part; sets part_number. */
static bool is_next(struct mo_reading *reading, enum mo_bundle_part part, const char *name)
{
  const size_t folder = strlen(parts[part]);
  char expected[MO_ARCHIVE_NAME_BYTES];
  if (parts[part][folder - 1] != '/')
    return strcmp(name, parts[part]) == 0 && part != reading->part;
  if (part == MO_PART_RECORDINGS)
    return true; /* see read_recordings */
  const uint32_t n_parts = part == reading->part ? reading->n_parts : 0;
  const uint64_t number = strtoull(name + folder, NULL, 10);
  snprintf(expected, sizeof(expected), "%s%08llu.ndjson", parts[part], (unsigned long long)number);
  /* Designs without scores may fill a part. */
  if (strcmp(name, expected) != 0 || number >= UINT32_MAX || number < n_parts ||
      (number > n_parts && part != MO_PART_SCORES) ||
      (part == MO_PART_GENERATIONS && number > 0 && reading->part_size < MO_BUNDLE_PART_BYTES))
    return false;
  reading->part_number = number;
  reading->part_size = reading->member.size;
  reading->n_parts = (uint32_t)number + 1;
  return true;
}

/* Reads a member of campaigns/ID/. */
static int read_of_campaign(struct mo_reading *reading)
{
  const char *name = reading->member.name, *slash = strchr(name + strlen("campaigns/"), '/');
  const size_t folder = strlen(reading->folder);
  enum mo_bundle_part part = MO_PART_CAMPAIGN;
  if (slash != NULL && strcmp(slash + 1, parts[MO_PART_CAMPAIGN]) == 0)
    return next_campaign(reading);
  if (reading->part == MO_PART_NOTHING || strncmp(name, reading->folder, folder) != 0)
    return mo_reading_refuse(reading, 0, "the member does not belong to the campaign");
  name += folder;
  while (part <= MO_PART_RECORDINGS && strncmp(name, parts[part], strlen(parts[part])) != 0)
    part++;
  if (part > MO_PART_RECORDINGS)
    return mo_reading_refuse(reading, 0, "not a member of a bundle");
  if (part < reading->part ||
      (part > MO_PART_ENVIRONMENTS && reading->part < MO_PART_ENVIRONMENTS) ||
      (part > MO_PART_DESIGNS && reading->n_born != reading->campaign.n_designs) ||
      !is_next(reading, part, name))
    return mo_reading_refuse(reading, 0, "the member is out of order or has an unexpected name");
  reading->part = part;
  if (part < MO_PART_SCORES) /* scores and recordings may be added later */
    mo_text_format(&reading->digest, "%s  %s\n", MO_SHA256_HEX(&reading->member.sha256), name);
  return part == MO_PART_ENVIRONMENTS ? mo_reading_environments(reading)
         : part == MO_PART_RECORDINGS ? mo_reading_recordings(reading, name)
                                      : mo_reading_lines(reading);
}

static int read_members(struct mo_reading *reading)
{
  int more = 1, error = MO_OK;
  while (error == MO_OK &&
         (more = mo_archive_next(reading->archive, &reading->member, reading->message)) > 0) {
    const char *name = reading->member.name;
    if (mo_reading_is_over(reading))
      error = MO_ERR_CANCELLED;
    else if (reading->head.version == 0)
      error = read_head(reading);
    else if (strncmp(name, "campaigns/", strlen("campaigns/")) == 0)
      error = read_of_campaign(reading);
    else if (strncmp(name, "controllers/", strlen("controllers/")) == 0 && reading->summary->n == 0)
      error = read_controller(reading);
    else
      error = mo_reading_refuse(reading, 0, "not a member of a bundle, or out of order");
  }
  if (error == MO_OK && more == 0)
    error = mo_reading_end(reading);
  if (error == MO_OK && more == 0 &&
      (reading->summary->n != reading->head.n || reading->n_used != reading->n_controllers))
    error = mo_fail(reading->message, MO_ERR_FORMAT,
                    "the bundle lacks a campaign that bundle.json lists, or has a controller that "
                    "no campaign uses");
  return error != MO_OK ? error : more;
}

int mo_bundle_read(const void *bytes, size_t size, const struct mo_lattice *lattice,
                   const struct mo_bundle_sink *sink, const struct mo_bundle_summary *known,
                   struct mo_bundle_summary *summary, struct mo_message *message)
{
  struct mo_reading *reading = calloc(1, sizeof(*reading));
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
  free(reading->means);
  mo_environments_drop(reading->campaign.environments, MO_ENVIRONMENTS_MAX);
  free(reading);
  return error;
}
