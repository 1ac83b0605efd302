/* atlases.c: lists, describes, sends, stores and deletes atlas files. */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "api/atlas_json.h"
#include "atlas/file.h"
#include "base/files.h"
#include "http/download.h"

#define PIECE_BYTES ((size_t)128 << 10)

/* ---- descriptions ---- */

/* Appends an atlas as an object. */
static int write_atlas(struct mo_api *api, struct mo_text *text, const char *name,
                       struct mo_message *message)
{
  uint64_t optima = UINT64_MAX;
  const int error = mo_atlas_describe(&api->atlases, name, text, &optima, message);
  if (error != MO_OK)
    return error;
  if (optima != UINT64_MAX)
    mo_text_member_count(text, "optima", optima);
  else
    mo_text_member(text, "optima", NULL);
  mo_text_add(text, "}");
  return MO_OK;
}

static void reply_atlas(struct mo_request *request, unsigned status, const char *name)
{
  struct mo_text text = {0};
  struct mo_message message = {""};
  const int error = write_atlas(mo_api_of(request), &text, name, &message);
  if (error != MO_OK) {
    mo_text_free(&text);
    mo_atlas_refuse(request, name, error, &message);
    return;
  }
  mo_reply_json(request, status, &text);
  mo_reply_etag_of_body(request);
}

void mo_api_get_atlas(struct mo_request *request)
{
  reply_atlas(request, 200, request->parameters[0]);
}

/* Appends a file that cannot be used to the list of unusable files. */
static void note_unreadable(struct mo_api *api, struct mo_text *text, const char *name,
                            const char *reason)
{
  struct stat status;
  char *path = mo_store_atlas_path(api->store, name);
  const bool is_file = path != NULL && stat(path, &status) == 0 && S_ISREG(status.st_mode);
  mo_text_object(text);
  mo_text_member(text, "name", name);
  mo_text_member_count(text, "bytes", is_file ? (uint64_t)status.st_size : 0);
  mo_text_member(text, "reason", reason);
  mo_text_add(text, "}");
  free(path);
}

void mo_api_list_atlases(struct mo_request *request)
{
  struct mo_api *api = mo_api_of(request);
  struct mo_atlas_name *names = NULL;
  struct mo_text text = {0}, unreadable = {0};
  uint32_t n = 0;
  int error = mo_store_atlas_names(api->store, &names, &n);
  mo_text_add(&text, "{\"items\":[");
  mo_text_add(&unreadable, "[");
  for (uint32_t i = 0; i < n && error == MO_OK; i++) {
    struct mo_message message = {""};
    mo_text_next(&text);
    const size_t before = text.size;
    error = write_atlas(api, &text, names[i].text, &message);
    if (error == MO_OK)
      continue;
    text.size = before > 0 && text.data[before - 1] == ',' ? before - 1 : before;
    const bool is_unusable = error == MO_ERR_FORMAT || error == MO_ERR_UNSUPPORTED ||
                             error == MO_ERR_CORRUPT || error == MO_ERR_IO;
    if (is_unusable)
      note_unreadable(api, &unreadable, names[i].text, message.text);
    if (is_unusable || error == MO_ERR_NOT_FOUND) /* it was deleted in the meantime */
      error = MO_OK;
  }
  mo_text_add(&text, "],\"unreadable\":");
  mo_text_add(&unreadable, "]}");
  mo_text_bytes(&text, unreadable.data, unreadable.size);
  text.failed = text.failed || unreadable.failed;
  mo_text_free(&unreadable);
  free(names);
  mo_reply_text(request, error, &text, "list");
}

/* ---- the file ---- */

struct sending {
  int fd;
  uint64_t at, bytes;
};

static void end_sending(void *context)
{
  struct sending *sending = context;
  (void)close(sending->fd);
  free(sending);
}

static int send_more(void *context, struct mo_text *text)
{
  struct sending *sending = context;
  const uint64_t left = sending->bytes - sending->at;
  const size_t n = left < PIECE_BYTES ? (size_t)left : PIECE_BYTES;
  char *piece = malloc(n + 1);
  const int error =
      piece != NULL ? mo_file_read_at(sending->fd, sending->at, n, piece) : MO_ERR_NO_MEMORY;
  if (error == MO_OK)
    mo_text_bytes(text, piece, n);
  free(piece);
  sending->at += n;
  return error != MO_OK ? error : sending->at < sending->bytes;
}

/* Opens the file of the atlas in the path. Returns false if it has replied. */
static bool open_file(struct mo_request *request, int *fd, struct stat *status)
{
  const char *name = request->parameters[0];
  char *path =
      mo_atlas_name_is_valid(name) ? mo_store_atlas_path(mo_api_of(request)->store, name) : NULL;
  struct mo_message message = {""};
  const int error = path != NULL                   ? mo_atlas_file_open(path, fd, status, &message)
                    : mo_atlas_name_is_valid(name) ? MO_ERR_NO_MEMORY
                                                   : MO_ERR_NOT_FOUND;
  free(path);
  if (error != MO_OK)
    mo_atlas_refuse(request, name, error, &message);
  return error == MO_OK;
}

void mo_api_get_atlas_file(struct mo_request *request)
{
  static const char *const types[] = {"application/octet-stream", NULL};
  struct stat status = {.st_size = 0};
  char tag[64];
  int fd = -1, form;
  if (!mo_accept(request, types, &form) || !open_file(request, &fd, &status))
    return;
  struct sending *sending = malloc(sizeof(*sending));
  if (sending == NULL) {
    (void)close(fd);
    mo_reply_error(request, MO_ERR_NO_MEMORY, "atlas");
    return;
  }
  *sending = (struct sending){.fd = fd, .bytes = (uint64_t)status.st_size};
  snprintf(tag, sizeof(tag), "%" PRIx64 "-%" PRIx64 "-%" PRIx64, (uint64_t)status.st_ino,
           (uint64_t)status.st_size,
           (uint64_t)status.st_mtim.tv_sec * 1000000000 + (uint64_t)status.st_mtim.tv_nsec);
  mo_download_open(request, types[form], tag, PIECE_BYTES, send_more, sending, end_sending);
}

void mo_api_put_atlas_file(struct mo_request *request)
{
  struct mo_api *api = mo_api_of(request);
  const char *name = request->parameters[0];
  struct mo_faults faults = {0};
  struct mo_message message = {""};
  bool created = false;
  if (!mo_check_content(request, "application/octet-stream", NULL))
    return;
  if (!mo_atlas_name_is_valid(name)) {
    mo_faults_add(&faults, MO_FAULT_PARAMETER, "name", "must be " MO_ATLAS_NAME_WORDS);
    mo_reply_problem(request, 422, &faults, NULL);
    return;
  }
  const int error =
      mo_store_atlas_put(api->store, name, request->body, request->body_size, &created, &message);
  if (error == MO_OK) {
    reply_atlas(request, created ? 201 : 200, name);
    if (request->reply.status == 404)
      mo_reply_problem(request, 409, NULL,
                       "The file was stored, but another request has already deleted it.");
    if (request->reply.status == 201)
      snprintf(request->reply.location, sizeof(request->reply.location), "/v1/atlases/%s", name);
  } else if (error == MO_ERR_FORMAT || error == MO_ERR_UNSUPPORTED || error == MO_ERR_CORRUPT) {
    mo_faults_add(&faults, MO_FAULT_BODY, "", "%s", message.text);
    mo_reply_problem(request, 422, &faults, "The file was refused, and nothing was stored: %s.",
                     message.text);
  } else if (error == MO_ERR_CONFLICT) {
    mo_reply_problem(request, 409, NULL, "Nothing was stored: %s.", message.text);
  } else {
    mo_reply_error(request, error, "atlas");
  }
}

void mo_api_delete_atlas(struct mo_request *request)
{
  const char *name = request->parameters[0];
  const int error = mo_atlas_name_is_valid(name)
                        ? mo_store_atlas_delete(mo_api_of(request)->store, name)
                        : MO_ERR_NOT_FOUND;
  if (error == MO_ERR_CONFLICT) {
    mo_reply_problem(request, 409, NULL, "Nothing was deleted: atlases/%s.atlas is %s.", name,
                     MO_ATLAS_IS_FOLDER);
    return;
  }
  if (error != MO_OK) {
    mo_reply_error(request, error, "atlas");
    return;
  }
  mo_atlas_forget(&mo_api_of(request)->atlases, name);
  mo_reply_static(request, 204, NULL, "", 0);
}
