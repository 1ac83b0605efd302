/* cmd_scores.c: scores as files: exported from a server, and imported into another one. A file is a
 * sequence of blocks, each preceded by 12 bytes with its length. Blocks are sent one by one, so
 * neither side ever holds more than one. */
#include <errno.h>
#include <inttypes.h>
#include <stdlib.h>
#include <string.h>

#include "commands.h"
#include "download.h"

#define SCORES_TYPE "application/zstd"
#define MAGIC       0x184D2A5DU /* of a frame that zstd skips */
#define HEAD_BYTES  12
#define BLOCK_MAX   ((size_t)96 << 20)

/* ---- export ---- */

void run_scores_export(struct ctl *ctl)
{
  static const char *const filters[] = {"controller", "class", "since", NULL};
  download(ctl, path_with(ctl, "/v1/scores", filters), SCORES_TYPE,
           ctl->n_operands > 0 ? ctl->operands[0] : "-", "scores are");
}

/* ---- import ---- */

struct sending {
  struct ctl *ctl;
  const char *name;
  FILE *file;
  uint64_t at; /* where the next block begins */
  json_t *sum;
  bool is_last; /* the newest block that was imported */
};

/* Reads the next block, of *size bytes (malloc); *size is 0 at the end of the file. */
static int read_block(const struct sending *sending, char **block, size_t *size)
{
  uint32_t head[HEAD_BYTES / 4] = {0};
  const size_t n = fread(head, 1, sizeof(head), sending->file);
  *size = 0;
  *block = NULL;
  if (n == 0 && !ferror(sending->file))
    return STATUS_OK;
  if (n == sizeof(head) && (head[0] != MAGIC || head[1] != 4 || head[2] > BLOCK_MAX))
    return complain(STATUS_USAGE, "%s: no block of scores begins at byte %" PRIu64, sending->name,
                    sending->at);
  *size = sizeof(head) + head[2];
  *block = need(malloc(*size));
  memcpy(*block, head, sizeof(head));
  if (n == sizeof(head) && fread(*block + sizeof(head), 1, head[2], sending->file) == head[2])
    return STATUS_OK;
  return ferror(sending->file)
             ? complain(STATUS_USAGE, "%s: %s", sending->name, strerror(errno))
             : complain(STATUS_USAGE, "%s ends early, in the block at byte %" PRIu64, sending->name,
                        sending->at);
}

static int send_block(struct sending *sending, const char *block, size_t size)
{
  static const char *const counts[] = {"blocks", "new", "known", "different"};
  json_t *entered;
  const int status = try_json(sending->ctl,
                              &(struct request){.method = "POST",
                                                .path = "/v1/scores",
                                                .content_type = SCORES_TYPE,
                                                .body = block,
                                                .body_bytes = size},
                              NULL, &entered);
  if (status != STATUS_OK)
    return complain(status, "%s: the block at byte %" PRIu64 " was not imported", sending->name,
                    sending->at);
  for (size_t i = 0; i < sizeof(counts) / sizeof(counts[0]); i++)
    add_number(sending->sum, entered, counts[i]);
  json_object_set(sending->sum, "source", json_object_get(entered, "source"));
  json_array_extend(json_object_get(sending->sum, "differences"),
                    json_object_get(entered, "differences"));
  sending->is_last = json_is_true(json_object_get(entered, "last"));
  sending->at += size;
  show_bytes(sending->ctl, "entered", sending->at);
  json_decref(entered);
  return STATUS_OK;
}

static int send_file(struct sending *sending)
{
  int status = STATUS_OK;
  size_t size = 1;
  while (status == STATUS_OK && size > 0) {
    char *block = NULL;
    status = interrupted() ? STATUS_INTERRUPTED : read_block(sending, &block, &size);
    if (status == STATUS_OK && size > 0)
      status = send_block(sending, block, size);
    free(block);
  }
  show_bytes(sending->ctl, NULL, 0);
  return status == STATUS_OK && !sending->is_last
             ? complain(STATUS_USAGE, "%s ends early: its last block is missing", sending->name)
             : status;
}

void run_scores_import(struct ctl *ctl)
{
  const char *path = ctl->operands[0];
  const bool standard = strcmp(path, "-") == 0;
  struct sending sending = {
      .ctl = ctl,
      .name = standard ? "standard input" : path,
      .file = standard ? stdin : fopen(path, "re"),
      .sum = keep(json_pack("{s:i,s:n,s:i,s:i,s:i,s:[]}", "blocks", 0, "source", "new", 0, "known",
                            0, "different", 0, "differences"))};
  if (sending.file == NULL)
    fail(STATUS_USAGE, "%s: %s", path, strerror(errno));
  catch_interrupts(NULL);
  const int status = send_file(&sending);
  if (!standard)
    fclose(sending.file);
  print_differences(ctl, json_object_get(sending.sum, "differences"));
  if (sending.at > 0) /* imported scores stay, no matter what followed */
    tell(ctl, sending.sum,
         "{new:,} rollout{new:s} [{new=1}is|are] new, {known:,} were known[, {different>0:,} are "
         "stored with different bits and were left out], from store {source.store} on "
         "{source.host}");
  leave(status == STATUS_OK && number_of(sending.sum, "different") > 0 ? STATUS_NEGATIVE : status);
}
