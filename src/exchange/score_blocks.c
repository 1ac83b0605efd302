/* score_blocks.c: writes and reads blocks of scores. Their lines have the form of the lines in
 * bundles. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "exchange/bundle_line.h"
#include "exchange/score_block.h"
#include "exchange/values.h"
#include "rollout/physics.h"

#define MAGIC 0x184D2A5DU /* of a frame that zstd skips */

/* The members, in their order. The names of score members contain the number of their condition. */
enum part { HEAD, WEIGHTS, CONDITIONS, ENVIRONMENTS, DESIGNS, SCORES, PARTS };
static const char *const parts[] = {
    [HEAD] = "scores.json",
    [WEIGHTS] = "controllers/",
    [CONDITIONS] = "conditions.ndjson",
    [ENVIRONMENTS] = "environments.ndjson",
    [DESIGNS] = "designs.ndjson",
    [SCORES] = "scores/",
};
static const char *const precisions[] = {[MO_FLOAT32] = "float32", [MO_FLOAT64] = "float64", NULL};

/* ---- lines ---- */

#define AT(member) offsetof(struct mo_score_block, member)
static const struct mo_field head_rows[] = {
    {"store", MO_FIELD_OWN, 0, AT(store), .own = &mo_line_store},
    {"host", MO_FIELD_TEXT, 0, AT(host), .min = 1,
     .max = sizeof(((struct mo_score_block *)NULL)->host) - 1},
    {"block", MO_FIELD_COUNT, 0, AT(number), .max = UINT32_MAX},
    {"last", MO_FIELD_FLAG, 0, AT(is_last)},
};
#undef AT

static void write_physics_hash(struct mo_text *text, const void *value)
{
  const struct mo_scored_condition *condition = value;
  struct mo_sha256 hash;
  mo_physics_hash(&condition->physics, condition->precision, condition->sensor, &hash);
  mo_hash_field.write(text, &hash);
}
static const struct mo_field_own physics_hash = {.read = mo_line_skip, .write = write_physics_hash};

#define AT(member) offsetof(struct mo_scored_condition, member)
static const struct mo_field condition_rows[] = {
    {"controller", MO_FIELD_OWN, 0, AT(controller), .own = &mo_hash_field},
    {"sensor", MO_FIELD_WORD, 0, AT(sensor), .words = mo_sensor_words},
    {"precision", MO_FIELD_WORD, 0, AT(precision), .words = precisions},
    {"physics_sha256", MO_FIELD_OWN, 0, 0, .own = &physics_hash},
    {"physics", MO_FIELD_GROUP, 0, AT(physics), .group = &mo_physics_fields},
};
#undef AT
static const struct mo_field design_rows[] = {
    {"genotype", MO_FIELD_OWN, 0, offsetof(struct mo_scored_design, genotype),
     .own = &mo_line_genotype},
};
static const struct mo_fields head_fields = MO_FIELDS(head_rows),
                              condition_fields = MO_FIELDS(condition_rows),
                              design_fields = MO_FIELDS(design_rows);

/* ---- writing ---- */

/* Writes the line of an item of a part to an empty text. */
static void write_line(const struct mo_score_block *block, enum part part, uint32_t i,
                       struct mo_text *line)
{
  if (part == CONDITIONS)
    mo_fields_write_object(line, &condition_fields, &block->conditions[i]);
  else if (part == ENVIRONMENTS)
    mo_environment_write(line, &block->environments[i]);
  else if (part == DESIGNS)
    mo_fields_write_object(line, &design_fields, &block->designs[i]);
  else
    mo_bundle_write_score(line, &block->scores[i]);
}

/* Adds the lines of a part as a member; for scores, only those with this condition. */
static int add_lines(struct mo_archive_writer *writer, const struct mo_score_block *block,
                     enum part part, uint32_t condition, uint32_t n, struct mo_text *out)
{
  struct mo_text member = {0}, line = {0};
  char name[MO_ARCHIVE_NAME_BYTES];
  int error = MO_OK;
  for (uint32_t i = 0; i < n; i++)
    if (part != SCORES || block->condition_of[i] == condition) {
      line.size = 0;
      write_line(block, part, i, &line);
      mo_text_bytes(&member, line.data, line.size);
      mo_text_add(&member, "\n");
    }
  snprintf(name, sizeof(name), part == SCORES ? "%s%08u.ndjson" : "%s", parts[part], condition);
  if (member.failed || line.failed)
    error = MO_ERR_NO_MEMORY;
  else if (member.size > 0)
    error = mo_archive_add(writer, name, member.data, member.size, out);
  mo_text_free(&line);
  mo_text_free(&member);
  return error;
}

static void write_head(struct mo_text *text, const struct mo_score_block *block,
                       const char *program)
{
  mo_text_format(text, "{\"format\":\"morphod-scores\",\"version\":%d", MO_SCORES_VERSION);
  mo_text_member(text, "program", program);
  mo_fields_write(text, &head_fields, block);
  mo_text_add(text, "}");
}

static int add_members(struct mo_archive_writer *writer, const struct mo_score_block *block,
                       const char *program, struct mo_text *out)
{
  struct mo_text head = {0};
  char name[MO_ARCHIVE_NAME_BYTES];
  write_head(&head, block, program);
  mo_text_add(&head, "\n");
  int error = head.failed ? MO_ERR_NO_MEMORY
                          : mo_archive_add(writer, parts[HEAD], head.data, head.size, out);
  mo_text_free(&head);
  if (error == MO_OK && block->weights != NULL) {
    mo_bundle_weights_name(&block->weights_sha256, name);
    error = mo_archive_add(writer, name, block->weights, block->weights_size, out);
  }
  if (error == MO_OK)
    error = add_lines(writer, block, CONDITIONS, 0, block->n_conditions, out);
  if (error == MO_OK)
    error = add_lines(writer, block, ENVIRONMENTS, 0, block->n_environments, out);
  if (error == MO_OK)
    error = add_lines(writer, block, DESIGNS, 0, block->n_designs, out);
  for (uint32_t i = 0; i < block->n_conditions && error == MO_OK; i++)
    error = add_lines(writer, block, SCORES, i, block->n_scores, out);
  return error == MO_OK ? mo_archive_end(writer, out) : error;
}

int mo_score_block_write(const struct mo_score_block *block, const char *program,
                         struct mo_text *out)
{
  struct mo_archive_writer *writer = mo_archive_create();
  struct mo_text archive = {0};
  int error = writer != NULL ? add_members(writer, block, program, &archive) : MO_ERR_NO_MEMORY;
  if (error == MO_OK) {
    const uint32_t head[] = {MAGIC, 4, (uint32_t)archive.size};
    _Static_assert(sizeof(head) == MO_SCORES_HEAD, "the head of a block");
    mo_text_bytes(out, head, sizeof(head));
    mo_text_bytes(out, archive.data, archive.size);
  }
  mo_text_free(&archive);
  mo_archive_writer_free(writer);
  return error == MO_OK && out->failed ? MO_ERR_NO_MEMORY : error;
}

/* ---- reading ---- */

struct reading {
  struct mo_score_block *block;
  struct mo_archive_member member;
  struct mo_bundle_lines *lines;
  struct mo_message *message;
  enum part part;     /* part of the previous member; PARTS: none */
  uint32_t condition; /* of the current score member */
};

static int read_head(struct reading *reading)
{
  struct mo_score_block *block = reading->block;
  struct mo_bundle_lines *lines = reading->lines;
  struct mo_archive_member *member = &reading->member;
  struct mo_json_slice key;
  char expected[80], program[64] = "";
  size_t at = 0, size;
  char *line = NULL;
  snprintf(expected, sizeof(expected), "{\"format\":\"morphod-scores\",\"version\":%d,",
           MO_SCORES_VERSION);
  if (strncmp(member->bytes, expected, strlen(expected)) != 0 ||
      !mo_archive_line(member, &at, &line, &size) || at != member->size)
    return mo_archive_refuse(member, 0, "this program does not support this version of scores",
                             reading->message);
  struct mo_json *json = mo_line_begin(lines, line, size);
  if (mo_json_object(json))
    while (mo_json_member(json, &key)) {
      if (mo_json_is(key, "program"))
        mo_line_text(json, program, sizeof(program));
      else if (!mo_fields_read_member(json, key, &head_fields, block))
        mo_json_skip(json);
    }
  int error = mo_line_end(lines, reading->message);
  if (error == MO_OK) {
    write_head(&lines->again, block, program);
    error = mo_line_compare(lines, line, size, reading->message);
  }
  if (error == MO_OK && (block->host[0] == '\0' || strpbrk(block->host, "\"\\") != NULL))
    error = mo_fail(reading->message, MO_ERR_FORMAT, "the host is invalid");
  return error == MO_ERR_FORMAT
             ? mo_archive_refuse(member, 1, reading->message->text, reading->message)
             : error;
}

static int read_weights(struct reading *reading)
{
  struct mo_score_block *block = reading->block;
  const struct mo_archive_member *member = &reading->member;
  const int error = mo_bundle_read_weights(member, &block->controller, reading->message);
  if (error != MO_OK)
    return error;
  block->weights = malloc(member->size);
  if (block->weights == NULL)
    return MO_ERR_NO_MEMORY;
  memcpy(block->weights, member->bytes, member->size);
  block->weights_size = member->size;
  block->weights_sha256 = member->sha256;
  return MO_OK;
}

static int check_condition(const void *condition, struct mo_message *message)
{
  const struct mo_physics *physics = &((const struct mo_scored_condition *)condition)->physics;
  return mo_physics_check(physics, message) == MO_OK ? MO_OK : MO_ERR_FORMAT;
}

static int read_design(struct mo_bundle_lines *lines, const char *line, size_t size,
                       struct mo_scored_design *design, struct mo_message *message)
{
  memset(design, 0, sizeof(*design));
  const int error = mo_line_read(lines, line, size, &design_fields, design, NULL, message);
  if (error == MO_OK)
    design->form = mo_genotype_form(&design->genotype);
  return error;
}

/* Returns the reason why a score does not belong to the block, or NULL if it does. */
static const char *check_score(const struct mo_score_block *block, uint32_t condition,
                               const struct mo_campaign_score *score)
{
  if (score->number >= block->n_designs)
    return "the score must belong to a design of the block";
  for (uint32_t k = 0; k < score->n; k++) {
    if (score->environments[k] >= block->n_environments ||
        score->diverged_steps[k] > block->conditions[condition].physics.scheme.n_steps)
      return "unknown environment, or a step beyond the last";
    for (uint32_t i = 0; i < k; i++)
      if (score->environments[i] == score->environments[k])
        return "duplicate environment";
  }
  return NULL;
}

static int read_score(struct reading *reading, const char *line, size_t size,
                      struct mo_message *words)
{
  struct mo_score_block *block = reading->block;
  struct mo_campaign_score *score = &block->scores[block->n_scores];
  int error = mo_bundle_read_score(reading->lines, line, size, score, words);
  if (error == MO_OK && score->measures != NULL)
    error = mo_fail(words, MO_ERR_FORMAT, "a file of scores cannot have measures");
  if (error != MO_OK)
    return error;
  const char *fault = check_score(block, reading->condition, score);
  if (fault != NULL)
    return mo_fail(words, MO_ERR_FORMAT, "%s", fault);
  block->condition_of[block->n_scores++] = reading->condition;
  return MO_OK;
}

static int read_line(struct reading *reading, const char *line, size_t size,
                     struct mo_message *words)
{
  struct mo_score_block *block = reading->block;
  const struct {
    uint32_t n, max;
  } counts[PARTS] = {[CONDITIONS] = {block->n_conditions, MO_SCORED_CONDITIONS},
                     [ENVIRONMENTS] = {block->n_environments, MO_SCORED_ENVIRONMENTS},
                     [DESIGNS] = {block->n_designs, MO_SCORED_ROWS},
                     [SCORES] = {block->n_scores, MO_SCORED_ROWS}};
  struct mo_bundle_lines *lines = reading->lines;
  struct mo_scored_condition *condition;
  if (counts[reading->part].n == counts[reading->part].max)
    return mo_fail(words, MO_ERR_FORMAT, "a block may have at most %u lines of this kind",
                   counts[reading->part].max);
  switch (reading->part) {
  case CONDITIONS:
    condition = &block->conditions[block->n_conditions++];
    *condition = (struct mo_scored_condition){.physics = mo_paper_physics()};
    return mo_line_read(lines, line, size, &condition_fields, condition, check_condition, words);
  case ENVIRONMENTS:
    return mo_bundle_read_environment(lines, line, size,
                                      &block->environments[block->n_environments++], words);
  case DESIGNS: return read_design(lines, line, size, &block->designs[block->n_designs++], words);
  default: return read_score(reading, line, size, words);
  }
}

static int read_lines(struct reading *reading)
{
  size_t at = 0, size;
  char *line;
  for (uint32_t n = 1; mo_archive_line(&reading->member, &at, &line, &size); n++) {
    struct mo_message words = {""};
    const int error = read_line(reading, line, size, &words);
    if (error != MO_OK)
      return error == MO_ERR_FORMAT
                 ? mo_archive_refuse(&reading->member, n, words.text, reading->message)
                 : error;
  }
  return MO_OK;
}

/* Finds the part of a member, which must follow the earlier ones. */
static bool find_part(struct reading *reading)
{
  const char *name = reading->member.name;
  char expected[MO_ARCHIVE_NAME_BYTES];
  enum part part = HEAD;
  while (part < PARTS && strncmp(name, parts[part], strlen(parts[part])) != 0)
    part++;
  if (part == PARTS || (part == HEAD) != (reading->part == PARTS) ||
      (part != HEAD && part < reading->part) || (part != SCORES && part == reading->part))
    return false;
  if (part == SCORES) { /* each condition appears once, in ascending order */
    uint32_t i = reading->part == SCORES ? reading->condition + 1 : 0;
    do
      snprintf(expected, sizeof(expected), "%s%08u.ndjson", parts[SCORES], i);
    while (strcmp(name, expected) != 0 && ++i < reading->block->n_conditions);
    if (i >= reading->block->n_conditions)
      return false;
    reading->condition = i;
  } else if (part != WEIGHTS && strcmp(name, parts[part]) != 0) {
    return false;
  }
  reading->part = part;
  return true;
}

static int read_members(struct reading *reading, struct mo_archive_reader *archive)
{
  int more = 1, error = MO_OK;
  while (error == MO_OK &&
         (more = mo_archive_next(archive, &reading->member, reading->message)) > 0) {
    if (!find_part(reading))
      error = mo_archive_refuse(&reading->member, 0, "not a member of a block, or out of order",
                                reading->message);
    else if (reading->part == HEAD)
      error = read_head(reading);
    else if (reading->part == WEIGHTS)
      error = read_weights(reading);
    else
      error = read_lines(reading);
  }
  if (error == MO_OK && more == 0 && reading->part == PARTS)
    error = mo_fail(reading->message, MO_ERR_FORMAT, "the block has no scores.json");
  return error != MO_OK ? error : more;
}

int mo_score_block_head(const char *bytes, size_t n, size_t *size, struct mo_message *message)
{
  uint32_t head[3];
  if (n < sizeof(head))
    return mo_fail(message, MO_ERR_FORMAT, "the file ends early");
  memcpy(head, bytes, sizeof(head));
  if (head[0] != MAGIC || head[1] != 4 || head[2] > MO_SCORES_BLOCK_MAX)
    return mo_fail(message, MO_ERR_FORMAT, "a block of scores must begin here");
  if (head[2] > n - sizeof(head))
    return mo_fail(message, MO_ERR_FORMAT, "the file ends early");
  *size = head[2];
  return MO_OK;
}

int mo_score_block_read(const char *bytes, size_t size, struct mo_score_block *block,
                        struct mo_message *message)
{
  struct mo_archive_reader *archive = mo_archive_open(bytes, size);
  struct reading reading = {.block = block,
                            .lines = mo_bundle_lines_create(NULL, false),
                            .message = message,
                            .part = PARTS};
  mo_score_block_clear(block);
  block->host[0] = '\0';
  int error =
      archive != NULL && reading.lines != NULL ? read_members(&reading, archive) : MO_ERR_NO_MEMORY;
  mo_bundle_lines_free(reading.lines);
  mo_archive_close(archive);
  return error;
}
