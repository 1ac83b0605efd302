/* controllers.c: lists, returns, stores and deletes controllers by name. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "api/handlers.h"
#include "api/job_json.h"

/* Writes the description of a controller. Returns MO_OK or an error of the store. */
static int write_controller(struct mo_store *store, struct mo_text *text,
                            const struct mo_controller_record *record)
{
  char *metadata = NULL;
  int code = mo_store_controller_metadata(store, &record->sha256, &metadata);
  if (code != MO_OK)
    return code;
  mo_text_object(text);
  mo_text_member(text, "name", record->name[0] != '\0' ? record->name : NULL);
  mo_member_hash(text, "sha256", &record->sha256);
  mo_text_member_count(text, "bytes", record->size);
  mo_text_member_count(text, "parameters", record->n_parameters);
  mo_text_member(text, "sensor", mo_sensor_name(record->sensor));
  mo_text_name(text, "control_period_s");
  if (record->control_period_s > 0)
    mo_text_json_number(text, record->control_period_s);
  else
    mo_text_add(text, "null");
  mo_text_format(text, ",\"workspace\":[%u,%u,%u],\"metadata\":", record->workspace.nx,
                 record->workspace.ny, record->workspace.nz);
  mo_text_json_stored(text, metadata);
  mo_text_member_time(text, "stored_at", record->stored_us);
  mo_text_add(text, "}");
  free(metadata);
  return MO_OK;
}

static void reply_controller(struct mo_request *request, unsigned status,
                             const struct mo_controller_record *record)
{
  struct mo_text text = {0};
  int code = write_controller(mo_api_of(request)->store, &text, record);
  if (code != MO_OK) {
    mo_text_free(&text);
    mo_reply_error(request, code, "controller");
    return;
  }
  mo_reply_json(request, status, &text);
  mo_reply_etag_of_body(request);
}

void mo_api_list_controllers(struct mo_request *request)
{
  struct mo_store *store = mo_api_of(request)->store;
  const char *cursor = mo_query(request, "cursor");
  size_t limit;
  if (!mo_query_limit(request, &limit))
    return;
  if (cursor != NULL && mo_controller_name_check(cursor) != MO_OK) {
    mo_reply_bad_parameter(request, "cursor", MO_CURSOR_WORDS);
    return;
  }
  struct mo_controller_record *records = malloc(limit * sizeof(*records));
  int64_t n =
      records != NULL ? mo_store_controllers(store, cursor, records, limit) : MO_ERR_NO_MEMORY;
  struct mo_text text = {0};
  mo_text_add(&text, "{\"items\":[");
  int code = n < 0 ? (int)n : MO_OK;
  for (int64_t i = 0; i < n && code == MO_OK; i++)
    code = write_controller(store, &text, &records[i]);
  mo_text_add(&text, "]");
  mo_text_member(&text, "next_cursor", n > 0 && (size_t)n == limit ? records[n - 1].name : NULL);
  mo_text_add(&text, "}");
  free(records);
  mo_reply_text(request, code, &text, "page");
}

/* Reads the record of the controller in the path. Returns false if it has replied. */
static bool read_record(struct mo_request *request, struct mo_controller_record *record)
{
  int error = mo_store_controller(mo_api_of(request)->store, request->parameters[0], record);
  if (error == MO_ERR_FORMAT)
    error = MO_ERR_NOT_FOUND; /* not a valid name */
  if (error != MO_OK)
    mo_reply_error(request, error, "controller");
  return error == MO_OK;
}

void mo_api_get_controller(struct mo_request *request)
{
  struct mo_controller_record record;
  if (read_record(request, &record))
    reply_controller(request, 200, &record);
}

void mo_api_get_controller_file(struct mo_request *request)
{
  static const char *const types[] = {"application/octet-stream", "application/vnd.safetensors",
                                      NULL};
  struct mo_controller_record record;
  uint8_t *bytes = NULL;
  size_t size = 0;
  int form;
  if (!mo_accept(request, types, &form) || !read_record(request, &record))
    return;
  int error = mo_store_controller_bytes(mo_api_of(request)->store, &record.sha256, &bytes, &size);
  if (error == MO_ERR_CORRUPT) {
    mo_reply_problem(request, 500, NULL,
                     "The file controllers/%s.safetensors in the state folder of the service is "
                     "missing or damaged. A PUT of the same file, under any name, repairs it.",
                     MO_SHA256_HEX(&record.sha256));
  } else if (error != MO_OK) {
    mo_reply_error(request, error, "controller");
  } else {
    mo_reply_bytes(request, 200, types[form], (char *)bytes, size);
    mo_reply_etag(request, "%s", MO_SHA256_HEX(&record.sha256));
  }
}

void mo_api_put_controller_file(struct mo_request *request)
{
  struct mo_store *store = mo_api_of(request)->store;
  const char *name = request->parameters[0];
  struct mo_controller *controller = NULL;
  struct mo_controller_record record;
  struct mo_message message = {""};
  bool created = false;
  if (!mo_check_content(request, "application/octet-stream", "application/vnd.safetensors"))
    return;
  struct mo_faults faults = {0};
  int code = mo_controller_name_check(name);
  if (code == MO_ERR_FORMAT) {
    mo_faults_add(
        &faults, MO_FAULT_PARAMETER, "name",
        "must be 1 to 64 of a-z, 0-9, '.', '_' and '-', beginning with a letter or digit");
    mo_reply_problem(request, 422, &faults, NULL);
    return;
  }
  if (code == MO_OK)
    code = mo_controller_decode((const uint8_t *)request->body, request->body_size, &controller,
                                &message);
  if (code == MO_ERR_FORMAT || code == MO_ERR_LIMIT || code == MO_ERR_UNSUPPORTED ||
      code == MO_ERR_INVALID || code == MO_ERR_RANGE) {
    mo_faults_add(&faults, MO_FAULT_BODY, "", "%s", message.text);
    mo_reply_problem(request, 422, &faults, "The body is not a controller: %s.", message.text);
    return;
  }
  if (code == MO_OK)
    code = mo_store_controller_put(store, name, (const uint8_t *)request->body, request->body_size,
                                   controller, &record, &created);
  if (code == MO_OK)
    reply_controller(request, created ? 201 : 200, &record);
  else
    mo_reply_error(request, code, "controller");
  if (request->reply.status == 201)
    snprintf(request->reply.location, sizeof(request->reply.location), "/v1/controllers/%s", name);
  mo_controller_free(controller);
}

void mo_api_delete_controller(struct mo_request *request)
{
  const char *name = request->parameters[0];
  struct mo_store *store = mo_api_of(request)->store;
  struct mo_message message = {""};
  if (strcmp(name, "default") == 0) {
    mo_reply_problem(request, 409, NULL,
                     "The name default cannot be removed; use PUT to point it to another file.");
    return;
  }
  int code = strncmp(name, "sha256:", 7) == 0 ? mo_store_controller_delete(store, name, &message)
                                              : mo_store_controller_remove(store, name);
  if (code == MO_ERR_CONFLICT)
    mo_reply_problem(request, 409, NULL, "The file cannot be deleted: %s.", message.text);
  else if (code != MO_OK)
    mo_reply_error(request, code, "controller");
  else
    mo_reply_static(request, 204, NULL, "", 0);
}
