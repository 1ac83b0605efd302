/* live.c: see live.h. To miss nothing at the start, it fetches the sequence of the newest event,
 * then the job, then the events after that sequence. */
#include "live.h"

#include <string.h>

#include "commands.h"
#include "follow.h"
#include "table.h"

static void draw(struct live *live, bool now)
{
  screen_draw(&live->screen, now, live->kind->write, live);
}

void live_line(const struct live *live, const json_t *at, const char *words)
{
  screen_event(&live->screen, live->ctl, at, words);
}

int live_load(struct live *live)
{
  int status = live->kind->load(live);
  if (status != STATUS_OK)
    return status;
  live->finished = is_final(text_of(live->job, "state"));
  live->told_s = monotonic_s();
  return STATUS_OK;
}

static int show_event(void *context, const char *type, const char *data)
{
  struct live *live = context;
  bool now = false;
  int status = strcmp(type, "reset") == 0 ? live_load(live) : STATUS_OK;
  json_t *event = json_loads(data, 0, NULL);
  if (status == STATUS_OK)
    status = live->kind->event(live, type, json_object_get(event, "at"),
                               json_object_get(event, "data"), &now);
  json_decref(event);
  draw(live, now || live->finished);
  return status > STATUS_OK || (live->finished && status == STATUS_OK);
}

/* Fetches the state, and reports what changed without an event. */
static int look_again(void *context)
{
  struct live *live = context;
  char phase[64], reason[320];
  snprintf(phase, sizeof(phase), "%s", text_of(live->job, "phase"));
  snprintf(reason, sizeof(reason), "%s", text_of(live->job, "reason"));
  int status = live_load(live);
  if (status != STATUS_OK)
    return status;
  live->kind->changed(live, phase, reason);
  draw(live, true);
  return STATUS_OK;
}

static int notice(void *context)
{
  struct live *live = context;
  int status = STATUS_OK;
  if (monotonic_s() - live->told_s > live->kind->ask_s)
    status = look_again(live);
  return status != STATUS_OK || live->finished;
}

static bool is_finished(void *context)
{
  const struct live *live = context;
  return live->finished;
}

void live_print_controller(const struct live *live, const json_t *controller)
{
  if (json_is_object(controller) && !live->ctl->quiet)
    print_plain_line(stdout, "controller %s: sha256:%s", text_of(controller, "name"),
                     text_of(controller, "sha256"));
}

int live_watch(struct live *live)
{
  const char *id = live->id, *noun = live->kind->noun, *command = live->kind->command;
  int64_t newest = -1;
  live->screen = screen_open(live->ctl);
  catch_interrupts(); /* before the first output */
  int status = newest_event(live->ctl, &newest);
  if (status == STATUS_OK)
    status = live_load(live);
  if (status == STATUS_OK) {
    live->kind->begin(live);
    draw(live, true);
  }
  struct follow follow = {.ctl = live->ctl,
                          .job = id,
                          .after = newest,
                          .event = show_event,
                          .alive = notice,
                          .broken = look_again,
                          .ended = is_finished,
                          .context = live};
  if (status == STATUS_OK && !live->finished)
    status = follow_events(&follow);
  if (status == STATUS_INTERRUPTED && !live->ctl->quiet)
    print_plain_line(stderr,
                     "The %s goes on. To watch it again: morphoctl %s watch %s; to set it aside: "
                     "morphoctl %s pause %s; to stop it: morphoctl %s cancel %s",
                     noun, command, id, command, id, command, id);
  else if (status == STATUS_OK && live->finished)
    status = live->kind->finish(live);
  else if (status == STATUS_OK)
    status = STATUS_ERROR; /* the error was already reported */
  return status;
}
