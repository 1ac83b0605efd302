/* cmd_controller.c: controller list, info, get, put, delete. */
#include <inttypes.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "commands.h"
#include "table.h"
#include "transport.h"

#define CONTROLLER_BYTES_MAX ((size_t)4 << 30)

/* below: "" or "/file". */
static int controller_path(const char *name, const char *below, char **path)
{
  char *escaped = escape(name);
  int n = escaped != NULL ? asprintf(path, "/v1/controllers/%s%s", escaped, below) : -1;
  free(escaped);
  return n >= 0 ? STATUS_OK : complain(STATUS_ERROR, "out of memory");
}

static void add_controller(struct table *table, const json_t *controller)
{
  char parameters[32], bytes[32], time[32];
  const char *cells[] = {text_of(controller, "name"),
                         text_of(controller, "sensor"),
                         count_text(number_of(controller, "parameters"), parameters),
                         count_text(number_of(controller, "bytes"), bytes),
                         time_text(json_object_get(controller, "stored_at"), time),
                         text_of(controller, "sha256")};
  table_add(table, cells);
}

int run_controller_list(struct ctl *ctl)
{
  json_t *items = NULL;
  int status = collect(ctl, "/v1/controllers", 0, &items);
  return print_list(ctl, status, items, "name|sensor|>parameters|>bytes|stored|sha256",
                    add_controller);
}

static void print_controller(const struct ctl *ctl, const json_t *controller)
{
  char a[32];
  const json_t *workspace = json_object_get(controller, "workspace");
  if (*text_of(controller, "name") != 0)
    print_fact(ctl, "name", "%s", text_of(controller, "name"));
  print_fact(ctl, "sha256", "%s", text_of(controller, "sha256"));
  print_fact(ctl, "sensor", "%s", text_of(controller, "sensor"));
  print_fact(ctl, "workspace",
             "%" JSON_INTEGER_FORMAT " × %" JSON_INTEGER_FORMAT " × %" JSON_INTEGER_FORMAT
             " voxels",
             json_integer_value(json_array_get(workspace, 0)),
             json_integer_value(json_array_get(workspace, 1)),
             json_integer_value(json_array_get(workspace, 2)));
  print_fact(ctl, "parameters", "%s", count_text(number_of(controller, "parameters"), a));
  print_fact(ctl, "bytes", "%s", count_text(number_of(controller, "bytes"), a));
  print_fact(ctl, "stored", "%s", time_text(json_object_get(controller, "stored_at"), a));
  const char *key;
  json_t *value;
  json_t *metadata = json_object_get(controller, "metadata");
  json_object_foreach(metadata, key, value)
  {
    const char *text = json_string_value(value);
    print_plain_line(stdout, "  %s: %.200s%s", key, text != NULL ? text : "",
                     text != NULL && strlen(text) > 200 ? "…" : "");
  }
}

int run_controller_info(struct ctl *ctl)
{
  char *path = NULL;
  json_t *controller = NULL;
  int status = controller_path(ctl->operands[0], "", &path);
  if (status == STATUS_OK)
    status = transport_get_json(ctl, path, 0, &controller);
  if (status == STATUS_OK && ctl->json)
    print_json(controller);
  else if (status == STATUS_OK)
    print_controller(ctl, controller);
  json_decref(controller);
  free(path);
  return status;
}

int run_controller_get(struct ctl *ctl)
{
  const char *name = ctl->operands[0], *output = option_text(ctl, "output", NULL);
  char *path = NULL, *file_name = NULL;
  struct reply reply = {0};
  int status = controller_path(name, "/file", &path);
  if (status == STATUS_OK && output == NULL && asprintf(&file_name, "%s.safetensors", name) < 0)
    status = complain(STATUS_ERROR, "out of memory");
  if (output == NULL)
    output = file_name;
  bool standard = output != NULL && strcmp(output, "-") == 0;
  if (status == STATUS_OK && standard && isatty(STDOUT_FILENO))
    status = complain(STATUS_USAGE, "a controller is not for a terminal: give --output FILE");
  if (status == STATUS_OK)
    status = transport_send(
        ctl, &(struct request){.method = "GET", .path = path, .accept = "application/octet-stream"},
        &reply);
  if (status == STATUS_OK) {
    status = save_output(output, reply.body != NULL ? reply.body : "", reply.body_bytes);
    if (status == STATUS_OK && !standard && !ctl->quiet)
      fprintf(stderr, "%s: %zu bytes\n", output, reply.body_bytes);
  }
  reply_free(&reply);
  free(path);
  free(file_name);
  return status;
}

int run_controller_put(struct ctl *ctl)
{
  char *path = NULL, *bytes = NULL;
  size_t n = 0;
  struct reply reply = {0};
  int status = controller_path(ctl->operands[0], "/file", &path);
  if (status == STATUS_OK)
    status = read_input(ctl->operands[1], CONTROLLER_BYTES_MAX, &bytes, &n);
  if (status == STATUS_OK)
    status = transport_send(ctl,
                            &(struct request){.method = "PUT",
                                              .path = path,
                                              .content_type = "application/octet-stream",
                                              .body = bytes,
                                              .body_bytes = n},
                            &reply);
  json_t *controller = status == STATUS_OK ? reply_json(&reply) : NULL;
  if (status == STATUS_OK && controller == NULL)
    status = STATUS_ERROR;
  if (controller != NULL && ctl->json)
    print_json(controller);
  else if (controller != NULL && !ctl->quiet)
    print_plain_line(stdout, "controller %s %s: sha256:%s", text_of(controller, "name"),
                     reply.status == 201 ? "stored" : "now stands for this file",
                     text_of(controller, "sha256"));
  json_decref(controller);
  reply_free(&reply);
  free(bytes);
  free(path);
  return status;
}

int run_controller_delete(struct ctl *ctl)
{
  char *path = NULL;
  struct reply reply = {0};
  int status = controller_path(ctl->operands[0], "", &path);
  if (status == STATUS_OK)
    status = transport_send(ctl, &(struct request){.method = "DELETE", .path = path}, &reply);
  if (status == STATUS_OK && !ctl->quiet && !ctl->json)
    printf("%s %s is gone\n",
           strncmp(ctl->operands[0], "sha256:", 7) == 0 ? "the file" : "the name",
           ctl->operands[0]);
  reply_free(&reply);
  free(path);
  return status;
}
