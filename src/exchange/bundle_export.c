/* bundle_export.c: makes a bundle of campaigns that have ended, member by member, while the client
 * reads it. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "exchange/bundle.h"
#include "exchange/bundle_scores.h"
#include "exchange/values.h"
#include "store/campaigns.h"
#include "store/store.h"
#include "store/worlds.h"

_Static_assert(MO_BUNDLE_PART_ROWS <= MO_PAGE_MAX, "a part is one page of a list");

enum phase {
  HEAD,
  CONTROLLERS,
  CAMPAIGN,
  ENVIRONMENTS,
  DESIGNS,
  GENERATIONS,
  LEARNING,
  SCORES,
  RECORDINGS,
  END
};

struct mo_bundle_export {
  struct mo_store *store;
  char program[48];
  int64_t *ids;
  uint32_t n, i; /* i: the current campaign */
  enum phase phase;
  struct mo_archive_writer *writer; /* NULL: only the digest is needed */
  struct mo_text digest;
  struct mo_bundle_scores *scores; /* of a design */
  uint32_t scored_number;          /* number of that design, plus 1 */
  uint32_t n_controllers;          /* written so far */
  struct mo_sha256 *controllers;
  struct mo_campaign_status status;
  int64_t after; /* the last number or generation written in this phase */
  uint32_t step, parts;
  bool with_recordings;
  struct mo_bundle_recordings *recordings; /* of the campaign */
  int64_t *evaluations;                    /* (n_evaluations); recordings->n of them are written so
                                              far */
  uint32_t n_evaluations;
  struct mo_text member;
};

/* Creates an export, and takes ownership of the ids. Returns NULL if memory runs out. */
static struct mo_bundle_export *create(struct mo_store *store, int64_t *ids, uint32_t n)
{
  struct mo_bundle_export *export = calloc(1, sizeof(*export));
  if (export == NULL) {
    free(ids);
    return NULL;
  }
  *export = (struct mo_bundle_export){.store = store, .ids = ids, .n = n};
  export->controllers = calloc(2 * (size_t)n + 1, sizeof(*export->controllers));
  export->recordings = calloc(1, sizeof(*export->recordings));
  export->scores = mo_bundle_scores_create();
  if (export->controllers == NULL || export->recordings == NULL || export->scores == NULL) {
    mo_bundle_export_free(export);
    return NULL;
  }
  return export;
}

struct mo_bundle_export *mo_bundle_export_create(struct mo_store *store, const char *program,
                                                 int64_t *ids, uint32_t n, bool with_recordings)
{
  struct mo_bundle_export *export = create(store, ids, n);
  if (export == NULL)
    return NULL;
  export->with_recordings = with_recordings;
  snprintf(export->program, sizeof(export->program), "%s", program);
  export->writer = mo_archive_create();
  if (export->writer == NULL) {
    mo_bundle_export_free(export);
    return NULL;
  }
  return export;
}

void mo_bundle_export_free(void *context)
{
  struct mo_bundle_export *export = context;
  mo_archive_writer_free(export->writer);
  mo_text_free(&export->member);
  mo_text_free(&export->digest);
  mo_bundle_scores_free(export->scores);
  free(export->controllers);
  free(export->recordings);
  free(export->evaluations);
  free(export->ids);
  free(export);
}

/* Adds the current member, if it is not empty, to the archive, or its hash to the digest. part: its
 * folder if it is numbered, otherwise its name. */
static int add(struct mo_bundle_export *export, const char *part, bool is_numbered,
               struct mo_text *out)
{
  char own[MO_ARCHIVE_NAME_BYTES], name[32 + MO_ARCHIVE_NAME_BYTES];
  struct mo_sha256 sha256;
  int error = export->member.failed ? MO_ERR_NO_MEMORY : MO_OK;
  snprintf(own, sizeof(own), is_numbered ? "%s/%08u.ndjson" : "%s", part, export->parts);
  export->parts += is_numbered;
  if (error == MO_OK && export->member.size > 0 && export->writer == NULL) {
    mo_sha256_of(export->member.data, export->member.size, &sha256);
    mo_text_format(&export->digest, "%s  %s\n", MO_SHA256_HEX(&sha256), own);
  } else if (error == MO_OK && export->member.size > 0) {
    snprintf(name, sizeof(name), "campaigns/%lld/%s", (long long)export->ids[export->i], own);
    error = mo_archive_add(export->writer, name, export->member.data, export->member.size, out);
  }
  export->member.size = 0;
  return error;
}

static void next_phase(struct mo_bundle_export *export)
{
  export->phase++;
  export->after = -1;
  export->step = export->parts = 0;
}

/* ---- head and controllers ---- */

static int write_head(struct mo_bundle_export *export, struct mo_text *out)
{
  struct mo_text *text = &export->member;
  struct mo_bundle_head head = {
      .format = "morphod-bundle", .version = MO_BUNDLE_VERSION, .n = export->n};
  snprintf(head.program, sizeof(head.program), "%s", export->program);
  memcpy(head.campaigns, export->ids, export->n * sizeof(*export->ids));
  mo_fields_write_object(text, &mo_bundle_head_fields, &head);
  mo_text_add(text, "\n");
  const int error =
      text->failed ? MO_ERR_NO_MEMORY
                   : mo_archive_add(export->writer, "bundle.json", text->data, text->size, out);
  text->size = 0;
  next_phase(export);
  return error;
}

static int write_controller(struct mo_bundle_export *export, const struct mo_sha256 *sha256,
                            struct mo_text *out)
{
  char name[MO_ARCHIVE_NAME_BYTES];
  uint8_t *bytes = NULL;
  size_t size = 0;
  for (uint32_t i = 0; i < export->n_controllers; i++)
    if (mo_sha256_equal(&export->controllers[i], sha256))
      return MO_OK;
  export->controllers[export->n_controllers++] = *sha256;
  mo_bundle_weights_name(sha256, name);
  int error = mo_store_controller_bytes(export->store, sha256, &bytes, &size);
  if (error == MO_OK)
    error = mo_archive_add(export->writer, name, bytes, size, out);
  free(bytes);
  return error;
}

/* Writes the controllers of one campaign. */
static int write_controllers(struct mo_bundle_export *export, struct mo_text *out)
{
  const struct mo_campaign_status *status = &export->status;
  int error = mo_store_campaign(export->store, export->ids[export->i], &export->status);
  if (error == MO_OK && status->job.has_controller)
    error = write_controller(export, &status->job.controller_sha256, out);
  if (error == MO_OK && status->job.has_result)
    error = write_controller(export, &status->job.result_sha256, out);
  if (++export->i == export->n) {
    export->i = 0;
    next_phase(export);
  }
  return error;
}

/* ---- a campaign ---- */

int mo_bundle_describe(struct mo_store *store, int64_t id, struct mo_campaign_status *status,
                       struct mo_imported_campaign *campaign)
{
  const int error = mo_store_campaign(store, id, status);
  if (error != MO_OK)
    return error;
  if (!mo_job_state_is_final(status->job.state))
    return MO_ERR_CONFLICT;
  *campaign = (struct mo_imported_campaign){.record = status->record,
                                            .state = status->job.state,
                                            .has_label = status->job.has_label,
                                            .weight = status->job.weight,
                                            .back_end = status->job.back_end,
                                            .created_us = status->job.created_us,
                                            .started_us = status->job.started_us,
                                            .finished_us = status->job.finished_us,
                                            .generation = status->generation,
                                            .n_designs = status->n_designs,
                                            .diversity_max = status->diversity_max,
                                            .end = status->end,
                                            .has_controller = status->job.has_controller,
                                            .controller_sha256 = status->job.controller_sha256,
                                            .has_result = status->job.has_result,
                                            .result_sha256 = status->job.result_sha256,
                                            .source = {mo_store_id(store), id, {{0}}}};
  campaign->record.settings.sensor = status->job.sensor;
  memcpy(campaign->label, status->job.label, sizeof(campaign->label));
  memcpy(campaign->experiment, status->job.experiment, sizeof(campaign->experiment));
  memcpy(campaign->note, status->job.note, sizeof(campaign->note));
  memcpy(campaign->controller_name, status->job.controller_name, sizeof(campaign->controller_name));
  if (status->source_campaign > 0)
    campaign->source =
        (struct mo_import_source){.store = status->source_store, .job = status->source_campaign};
  return MO_OK;
}

static int write_campaign(struct mo_bundle_export *export, struct mo_text *out)
{
  struct mo_imported_campaign *campaign = calloc(1, sizeof(*campaign));
  int error = campaign != NULL ? mo_bundle_describe(export->store, export->ids[export->i],
                                                    &export->status, campaign)
                               : MO_ERR_NO_MEMORY; /* MO_ERR_CONFLICT: it was extended in the
                                                    * meantime */
  if (error == MO_OK) {
    mo_fields_write_object(&export->member, &mo_bundle_campaign_fields, campaign);
    error = add(export, "campaign.json", false, out);
  }
  free(campaign);
  next_phase(export);
  return error;
}

static int write_environments(struct mo_bundle_export *export, struct mo_text *out)
{
  struct mo_environment *environments = NULL;
  uint32_t n = 0;
  const int error = mo_store_job_environments(export->store, export->ids[export->i],
                                              MO_JOB_CAMPAIGN, &environments, &n);
  for (uint32_t i = 0; error == MO_OK && i < n; i++) {
    struct mo_text line = {0};
    mo_environment_write(&line, &environments[i]);
    mo_text_add(&line, "\n");
    mo_text_bytes(&export->member, line.data, line.size);
    mo_text_free(&line);
  }
  mo_environments_free(environments, n);
  next_phase(export);
  return error == MO_OK ? add(export, "environments.ndjson", false, out) : error;
}

static int write_designs(struct mo_bundle_export *export, struct mo_text *out)
{
  struct mo_campaign_design *rows = malloc(MO_BUNDLE_PART_ROWS * sizeof(*rows));
  const int64_t n = rows != NULL
                        ? mo_store_campaign_designs(export->store, export->ids[export->i],
                                                    export->after, rows, MO_BUNDLE_PART_ROWS)
                        : MO_ERR_NO_MEMORY;
  for (int64_t i = 0; i < n; i++) {
    mo_bundle_write_design(&export->member, &rows[i]);
    mo_text_add(&export->member, "\n");
    export->after = rows[i].number;
  }
  free(rows);
  const int error = n < 0 ? (int)n : add(export, "designs", true, out);
  if (n < MO_BUNDLE_PART_ROWS)
    next_phase(export);
  return error;
}

/* Writes generations until the member is large enough. */
static int write_generations(struct mo_bundle_export *export, struct mo_text *out)
{
  const int64_t id = export->ids[export->i];
  int error = MO_OK;
  while (error == MO_OK && export->after < export->status.generation &&
         export->member.size < MO_BUNDLE_PART_BYTES) {
    struct mo_campaign_generation row;
    struct mo_campaign_member *members = NULL;
    struct mo_re_evaluated held_out[MO_ELITE_MAX];
    uint32_t n = 0;
    int64_t n_held_out = 0;
    const int64_t read =
        mo_store_campaign_generations(export->store, id, export->after, 1, &row, 1);
    error = read < 0 ? (int)read : read == 0 ? MO_ERR_CORRUPT : MO_OK;
    if (error == MO_OK)
      error = mo_store_campaign_members(export->store, id, row.generation, &members, &n);
    if (error == MO_OK && row.held_out.designs > 0)
      n_held_out = mo_store_campaign_held_out(export->store, id, row.generation, held_out);
    if (n_held_out < 0)
      error = (int)n_held_out;
    if (error == MO_OK) {
      mo_bundle_write_generation(&export->member, &row, members, n, held_out, (uint32_t)n_held_out);
      mo_text_add(&export->member, "\n");
    }
    free(members);
    export->after++;
  }
  if (error == MO_OK)
    error = add(export, "generations", true, out);
  if (export->after >= export->status.generation)
    next_phase(export);
  return error;
}

static int write_learning(struct mo_bundle_export *export, struct mo_text *out)
{
  struct mo_campaign_step *rows = malloc(MO_BUNDLE_PART_ROWS * sizeof(*rows));
  const int64_t n = rows != NULL
                        ? mo_store_campaign_steps(export->store, export->ids[export->i],
                                                  export->after > 0 ? (uint32_t) export->after : 0,
                                                  export->step, rows, MO_BUNDLE_PART_ROWS)
                        : MO_ERR_NO_MEMORY;
  int64_t i = 0;
  for (; i < n && rows[i].generation <= export->status.generation; i++) {
    mo_bundle_write_step(&export->member, &rows[i]);
    mo_text_add(&export->member, "\n");
    export->after = rows[i].generation;
    export->step = rows[i].step;
  }
  free(rows);
  const int error = n < 0 ? (int)n : add(export, "learning", true, out);
  if (i < MO_BUNDLE_PART_ROWS) /* any further steps belong to a generation that was never
                                * committed */
    next_phase(export);
  return error;
}

static int take_score(void *context, const struct mo_campaign_score *score)
{
  struct mo_bundle_export *export = context;
  struct mo_message message;
  if (export->scored_number != score->number + 1)
    mo_bundle_scores_begin(export->scores, score->number);
  export->scored_number = score->number + 1;
  const int added = mo_bundle_scores_add(export->scores, score, &message);
  if (added == 0 || added == MO_ERR_DUPLICATE)
    return MO_OK; /* the store also has these losses in another block */
  mo_bundle_write_score(&export->member, score);
  mo_text_add(&export->member, "\n");
  return export->member.failed ? MO_ERR_NO_MEMORY : MO_OK;
}

/* Writes the scores of some designs. Only scores of a controller that does not learn are stored. */
static int write_scores(struct mo_bundle_export *export, struct mo_text *out)
{
  const struct mo_campaign_status *status = &export->status;
  const uint32_t first = (uint32_t)(export->after + 1);
  int error = MO_OK;
  if (!mo_modes[status->record.settings.mode].learns && first < status->n_designs)
    error = mo_store_campaign_scores(export->store, export->ids[export->i], first,
                                     first + MO_BUNDLE_PART_ROWS - 1, take_score, export);
  export->after += MO_BUNDLE_PART_ROWS;
  if (error == MO_OK)
    error = add(export, "scores", true, out);
  if (!mo_modes[status->record.settings.mode].learns &&
      export->after + 1 < (int64_t)status->n_designs)
    return error;
  next_phase(export);
  return error;
}

/* ---- recordings, and the end of a campaign ---- */

/* Continues with the next campaign. */
static int end_campaign(struct mo_bundle_export *export)
{
  struct mo_campaign_status now;
  int error = mo_store_campaign(export->store, export->ids[export->i], &now);
  if (error == MO_OK && now.generation != export->status.generation)
    error = MO_ERR_CONFLICT; /* a client extended it while it was being read */
  free(export->evaluations);
  export->evaluations = NULL;
  *export->recordings = (struct mo_bundle_recordings){.n = 0};
  next_phase(export);
  if (++export->i < export->n)
    export->phase = CAMPAIGN;
  return error;
}

static int write_array(struct mo_bundle_export *export)
{
  struct mo_bundle_recordings *recordings = export->recordings;
  struct mo_trajectory *trajectory = NULL;
  int error = mo_store_trajectory(export->store, export->evaluations[recordings->n - 1],
                                  recordings->place, recordings->environment, &trajectory);
  if (error == MO_OK && trajectory->n_frames != recordings->frames)
    error = MO_ERR_CORRUPT;
  if (error == MO_OK) {
    recordings->n_masses = trajectory->n_masses;
    recordings->n_springs = trajectory->n_springs;
    error = mo_bundle_write_array(&export->member, recordings, &trajectory->recording);
  }
  mo_trajectory_free(trajectory);
  (void)mo_bundle_recordings_next(recordings);
  return error;
}

/* Writes the next evaluation, or the next array of the current one. */
static int write_recordings(struct mo_bundle_export *export, struct mo_text *out)
{
  struct mo_bundle_recordings *recordings = export->recordings;
  const int64_t id = export->ids[export->i];
  char name[MO_ARCHIVE_NAME_BYTES];
  uint64_t rollouts;
  int error = MO_OK;
  if (export->after < 0 && export->with_recordings &&
      !mo_modes[export->status.record.settings.mode].learns)
    error = mo_store_campaign_recordings(export->store, id, &export->evaluations,
                                         &export->n_evaluations, &rollouts);
  else if (export->after < 0)
    export->n_evaluations = 0;
  export->after = 0;
  if (error != MO_OK || (recordings->channel == 0 && recordings->n == export->n_evaluations))
    return error != MO_OK ? error : end_campaign(export);
  mo_bundle_recordings_name(recordings, name);
  if (recordings->channel != 0) {
    error = write_array(export);
  } else {
    error = mo_store_recorded_evaluation(export->store, id, export->evaluations[recordings->n],
                                         &recordings->evaluation);
    mo_fields_write_object(&export->member, &mo_bundle_evaluation_fields, &recordings->evaluation);
    mo_bundle_recordings_begin(recordings, &export->status.record.settings.physics);
  }
  return error == MO_OK ? add(export, name, false, out) : error;
}

/* Writes the next member, unless all are written. */
static int write_next(struct mo_bundle_export *export, struct mo_text *out)
{
  static int (*const write[])(struct mo_bundle_export * export,
                              struct mo_text * out) = {[HEAD] = write_head,
                                                       [CONTROLLERS] = write_controllers,
                                                       [CAMPAIGN] = write_campaign,
                                                       [ENVIRONMENTS] = write_environments,
                                                       [DESIGNS] = write_designs,
                                                       [GENERATIONS] = write_generations,
                                                       [LEARNING] = write_learning,
                                                       [SCORES] = write_scores,
                                                       [RECORDINGS] = write_recordings};
  return write[export->phase](export, out);
}

int mo_bundle_export_more(void *context, struct mo_text *text)
{
  struct mo_bundle_export *export = context;
  if (export->phase == END)
    return mo_archive_end(export->writer, text);
  const int error = write_next(export, text);
  return error != MO_OK ? error : 1;
}

int mo_bundle_digest(struct mo_store *store, int64_t id, bool (*is_over)(void *context),
                     void *context, struct mo_sha256 *digest)
{
  int64_t *ids = malloc(sizeof(*ids));
  struct mo_text nothing = {0};
  if (ids == NULL)
    return MO_ERR_NO_MEMORY;
  *ids = id;
  struct mo_bundle_export *export = create(store, ids, 1);
  if (export == NULL)
    return MO_ERR_NO_MEMORY;
  int error = mo_store_campaign(store, id, &export->status);
  export->phase = CAMPAIGN;
  next_phase(export);
  while (error >= 0 && export->phase < SCORES)
    error = is_over != NULL && is_over(context) ? MO_ERR_CANCELLED : write_next(export, &nothing);
  if (error == MO_OK && export->status.generation < 0)
    mo_bundle_digest_source(&export->digest,
                            &(struct mo_import_source){.store = mo_store_id(store), .job = id},
                            export->status.job.created_us);
  if (error == MO_OK && export->digest.failed)
    error = MO_ERR_NO_MEMORY;
  if (error == MO_OK)
    mo_sha256_of(export->digest.data, export->digest.size, digest);
  mo_bundle_export_free(export);
  return error;
}
