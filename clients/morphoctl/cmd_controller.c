/* cmd_controller.c: controller list, info, get, put, delete. */
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "commands.h"
#include "template.h"
#include "transport.h"

#define CONTROLLER_BYTES_MAX ((size_t)4 << 30)

/* Makes the path of the controller that the first operand names (malloc). below: "" or "/file". */
static char *controller_path(const struct ctl *ctl, const char *below)
{
  char *escaped = escape(ctl->operands[0]);
  char *path = format_text("/v1/controllers/%s%s", escaped, below);
  free(escaped);
  return path;
}

int run_controller_list(struct ctl *ctl)
{
  return list_items(ctl, "/v1/controllers", 0,
                    "name={name}|sensor={sensor}|>parameters={parameters:,}|>bytes={bytes:,}"
                    "|stored={stored_at:time}|sha256={sha256}");
}

static void print_controller(const struct ctl *ctl, const json_t *controller)
{
  static const struct fact facts[] = {
      {"name", "{name}"},
      {"sha256", "{sha256}"},
      {"sensor", "{sensor}"},
      {"workspace", "{workspace.0} × {workspace.1} × {workspace.2} voxels"},
      {"parameters", "{parameters:,}"},
      {"bytes", "{bytes:,}"},
      {"stored", "{stored_at:time}"},
      {NULL, NULL}};
  const char *key;
  json_t *value;
  print_facts(ctl, controller, facts);
  json_object_foreach(json_object_get(controller, "metadata"), key, value)
  {
    const char *text = json_string_value(value);
    print_plain_line(stdout, "  %s: %.200s%s", key, text != NULL ? text : "",
                     text != NULL && strlen(text) > 200 ? "…" : "");
  }
}

int run_controller_info(struct ctl *ctl)
{
  char *path = controller_path(ctl, "");
  int status = show(ctl, path, print_controller);
  free(path);
  return status;
}

int run_controller_get(struct ctl *ctl)
{
  const char *output = option_text(ctl, "output", NULL);
  if (output != NULL && strcmp(output, "-") == 0 && isatty(STDOUT_FILENO))
    return complain(STATUS_USAGE, "a controller is not for a terminal: give --output FILE");
  char *path = controller_path(ctl, "/file");
  char *file_name = format_text("%s.safetensors", ctl->operands[0]);
  int status =
      save_reply(ctl, path, "application/octet-stream", output != NULL ? output : file_name);
  free(path);
  free(file_name);
  return status;
}

int run_controller_put(struct ctl *ctl)
{
  char *path = controller_path(ctl, "/file"), *bytes = NULL;
  size_t n = 0;
  long code = 0;
  json_t *controller = NULL;
  int status = read_input(ctl->operands[1], CONTROLLER_BYTES_MAX, &bytes, &n);
  if (status == STATUS_OK)
    status = send_json(ctl,
                       &(struct request){.method = "PUT",
                                         .path = path,
                                         .content_type = "application/octet-stream",
                                         .body = bytes,
                                         .body_bytes = n},
                       &code, &controller);
  if (controller != NULL)
    tell(ctl, controller,
         code == 201 ? "controller {name} stored: sha256:{sha256}"
                     : "controller {name} now stands for this file: sha256:{sha256}");
  json_decref(controller);
  free(bytes);
  free(path);
  return status;
}

int run_controller_delete(struct ctl *ctl)
{
  const char *name = ctl->operands[0];
  char *path = controller_path(ctl, "");
  struct reply reply = {0};
  int status = transport_send(ctl, &(struct request){.method = "DELETE", .path = path}, &reply);
  if (status == STATUS_OK && !ctl->quiet && !ctl->json)
    printf("%s %s is gone\n", strncmp(name, "sha256:", 7) == 0 ? "the file" : "the name", name);
  reply_free(&reply);
  free(path);
  return status;
}
