/* cmd_controller.c: controller info, get, put, delete. */
#include <string.h>
#include <unistd.h>

#include "commands.h"

#define CONTROLLER_BYTES_MAX ((size_t)4 << 30)

/* Makes the path of the controller in the first operand. below: "" or "/file". */
static const char *controller_path(const struct ctl *ctl, const char *below)
{
  return path_to("/v1/controllers/%s%s", escape(ctl->operands[0]), below);
}

static void print_controller(const struct ctl *ctl, const json_t *controller)
{
  static const struct fact facts[] = {
      {"name", "{name}"},
      {"sha256", "{sha256}"},
      {"sensor", "{sensor}"},
      {"control", "[every {control_period_s} s|in every step]"},
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

void run_controller_info(struct ctl *ctl)
{
  show(ctl, controller_path(ctl, ""), print_controller);
}

void run_controller_get(struct ctl *ctl)
{
  const char *output = option_text(ctl, "output", NULL);
  if (output != NULL && strcmp(output, "-") == 0 && isatty(STDOUT_FILENO))
    fail(STATUS_USAGE, "a controller cannot be written to a terminal: give --output FILE");
  save_reply(ctl, controller_path(ctl, "/file"), "application/octet-stream",
             output != NULL ? output : path_to("%s.safetensors", ctl->operands[0]));
}

void run_controller_put(struct ctl *ctl)
{
  size_t n;
  long code;
  const char *bytes = read_input(ctl->operands[1], CONTROLLER_BYTES_MAX, &n);
  const json_t *controller =
      keep(send_json(ctl,
                     &(struct request){.method = "PUT",
                                       .path = controller_path(ctl, "/file"),
                                       .content_type = "application/octet-stream",
                                       .body = bytes,
                                       .body_bytes = n},
                     &code));
  tell(ctl, controller,
       code == 201 ? "controller {name} stored: sha256:{sha256}"
                   : "controller {name} now points to this file: sha256:{sha256}");
}

void run_controller_delete(struct ctl *ctl)
{
  const char *name = ctl->operands[0];
  act(ctl, (struct request){.method = "DELETE", .path = controller_path(ctl, "")},
      path_to("%s %s is gone", strncmp(name, "sha256:", 7) == 0 ? "the file" : "the name", name));
}
