/* campaign_lineage.c: finds the pretraining runs that led to a campaign's controller.
 *
 * The metadata of a controller describes how it was made. A pretraining run has a seed, a batch and
 * a number of steps, which determine its bodies. A finetuning run or campaign has a parent; if the
 * parent's file is stored, it describes the parent in the same way. Each unreadable field is
 * reported as an event of the campaign, and the parts that depend on the field are omitted. */
#include <errno.h>
#include <inttypes.h>
#include <stdlib.h>
#include <string.h>

#include "jobs/campaign_excluded.h"
#include "jobs/controllers.h"

#define CONTROLLERS_MAX 64 /* in a lineage, including the campaign's own */

struct reading {
  struct mo_campaign_run *run; /* NULL: nothing is reported */
  struct mo_message *message;
  struct mo_lineage *lineage;
  struct mo_controller *controller; /* the controller being read */
  struct mo_sha256 sha256;          /* hash of its file */
};

/* ---- unreadable fields ---- */

struct fault {
  const struct reading *reading;
  const char *field, *detail;
};

static int write_fault(void *context)
{
  const struct fault *fault = context;
  const struct mo_campaign_run *run = fault->reading->run;
  return mo_store_campaign_lineage_fault(run->jobs->store, run->id, &fault->reading->sha256,
                                         fault->field, fault->detail);
}

static int report(const struct reading *reading, const char *field, const char *detail)
{
  struct fault fault = {reading, field, detail};
  if (reading->run == NULL)
    return MO_OK;
  return mo_runner_persist(reading->run->runner, write_fault, &fault,
                           "a warning about the controller's lineage");
}

/* ---- one controller ---- */

static bool read_number(const char *text, uint64_t *number)
{
  char *end = NULL;
  if (text == NULL || *text < '0' || *text > '9')
    return false;
  errno = 0;
  *number = strtoull(text, &end, 10);
  return errno == 0 && *end == '\0';
}

/* Reads the seed and size of a pretraining run. n_bodies is 0 if there are no bodies, or if their
 * number is unknown. */
static int read_pretraining(const struct reading *reading, struct mo_lineage_part *part)
{
  const struct mo_controller *controller = reading->controller;
  uint64_t steps = 0, batch = 0;
  const int read =
      mo_controller_get_metadata_number(controller, "morphod.settings", "batch", &batch);
  const struct {
    const char *field, *detail;
    bool is_read;
  } fields[] = {
      {"morphod.seed", "the pretraining seed cannot be read, so its bodies are not excluded",
       read_number(mo_controller_get_metadata(controller, "morphod.seed"), &part->seed)},
      {"morphod.step",
       "the number of steps cannot be read, so the pretraining bodies are not excluded",
       read_number(mo_controller_get_metadata(controller, "morphod.step"), &steps)},
      {"morphod.settings", "the batch cannot be read, so the pretraining bodies are not excluded",
       read == MO_OK && batch > 0},
  };
  bool is_whole = true;
  int error = read == MO_ERR_NO_MEMORY ? read : MO_OK;
  for (size_t i = 0; i < sizeof(fields) / sizeof(fields[0]) && error == MO_OK; i++) {
    is_whole = is_whole && fields[i].is_read;
    if (!fields[i].is_read)
      error = report(reading, fields[i].field, fields[i].detail);
  }
  part->n_bodies = !is_whole ? 0
                   : steps <= MO_TRAINING_STEPS_MAX && batch <= MO_TRAINING_BATCH_MAX
                       ? steps * batch
                       : UINT64_MAX;
  return error;
}

static int add_part(const struct reading *reading)
{
  struct mo_lineage *lineage = reading->lineage;
  struct mo_lineage_part part = {0, 0};
  const char *kind = mo_controller_get_metadata(reading->controller, "morphod.kind");
  uint64_t most = MO_TRAINING_BODIES_MAX; /* total of all parts */
  int error = MO_OK;
  if (kind != NULL && strcmp(kind, "pretrain") == 0)
    error = read_pretraining(reading, &part);
  else if (kind != NULL && strcmp(kind, "finetune") != 0)
    error = report(
        reading, "morphod.kind",
        "the kind is neither pretrain nor finetune, so its training bodies are not excluded");
  if (error != MO_OK || part.n_bodies == 0)
    return error;
  for (uint32_t i = 0; i < lineage->n_parts; i++)
    most -= lineage->parts[i].n_bodies;
  if (part.n_bodies > most)
    return mo_fail(reading->message, MO_ERR_LIMIT,
                   "the controller's lineage has more pretraining bodies than the %" PRIu64
                   " that can be redrawn; submit with exclude_pretraining false",
                   MO_TRAINING_BODIES_MAX);
  if (lineage->n_parts == MO_LINEAGE_PARTS_MAX)
    return mo_fail(
        reading->message, MO_ERR_LIMIT,
        "the controller's lineage has more than %d pretraining runs, so their bodies cannot "
        "all be redrawn; submit with exclude_pretraining false",
        MO_LINEAGE_PARTS_MAX);
  lineage->parts[lineage->n_parts++] = part;
  return MO_OK;
}

/* ---- its ancestors ---- */

/* MO_ERR_NOT_FOUND: the controller has no parent. */
static int read_parent(const struct reading *reading, struct mo_sha256 *sha256)
{
  const char *parent = mo_controller_get_metadata(reading->controller, "morphod.parent");
  if (parent == NULL || strcmp(parent, "random") == 0)
    return MO_ERR_NOT_FOUND;
  if (mo_sha256_from_hex(parent, strlen(parent), sha256) == MO_OK)
    return MO_OK;
  int error = report(
      reading, "morphod.parent",
      "the parent is neither random nor a file's hash, so its training bodies are not excluded");
  return error != MO_OK ? error : MO_ERR_NOT_FOUND;
}

static int report_length(const struct reading *reading)
{
  char text[128];
  snprintf(text, sizeof(text),
           "the lineage is longer than the limit of %d controllers, so the parent's training "
           "bodies are not excluded",
           CONTROLLERS_MAX);
  return report(reading, "morphod.parent", text);
}

int mo_lineage_read(struct mo_jobs *jobs, const struct mo_sha256 *sha256,
                    struct mo_campaign_run *run, struct mo_lineage *lineage,
                    struct mo_message *message)
{
  struct reading reading = {.run = run, .message = message, .lineage = lineage};
  struct mo_sha256 next = *sha256;
  int error = MO_OK;
  lineage->n_parts = 0;
  for (int i = 0; error == MO_OK; i++) {
    if (i == CONTROLLERS_MAX) {
      error = report_length(&reading);
      break;
    }
    reading.sha256 = next;
    error = mo_controller_load(jobs->store, &next, &reading.controller);
    if (mo_controller_is_unusable(error) && run != NULL)
      mo_controller_describe_fault(&next, "resume the job", run->runner->text);
    if (error == MO_OK)
      error = add_part(&reading);
    if (error == MO_OK)
      error = read_parent(&reading, &next);
    mo_controller_free(reading.controller);
    reading.controller = NULL;
  }
  return error == MO_ERR_NOT_FOUND ? MO_OK : error; /* no parent, or its file is not stored */
}
