/* live.c: see live.h. To miss nothing at the start, it fetches the sequence of the newest event,
 * then the job, then the events after that sequence. */
#include "live.h"

#include <inttypes.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <time.h>
#include <unistd.h>

#include "commands.h"
#include "follow.h"

#define REDRAW_S 0.1

/* ---- the view ---- */

void view_lines(FILE *file, int columns, const char *text)
{
  do {
    int n = 0;
    for (int width = 0; text[n] != 0 && text[n] != '\n'; n++) {
      width += ((unsigned char)text[n] & 0xc0) != 0x80;
      if (width > columns)
        break;
    }
    fprintf(file, "%.*s\033[K\n", n, text);
    text += strcspn(text, "\n");
    text += *text == '\n';
  } while (*text != 0);
}

void view_words(FILE *file, int columns, const json_t *json, const char *words)
{
  char *text = text_from(json, words);
  view_lines(file, columns, text);
  free(text);
}

/* Redraws the view, at most ten times per second unless `now` is set. */
static void draw(struct live *live, bool now)
{
  struct winsize window = {0};
  if (!live->is_drawn || (!now && monotonic_s() - live->drawn_s < REDRAW_S))
    return;
  bool known =
      ioctl(STDOUT_FILENO, TIOCGWINSZ, &window) == 0 && window.ws_col > 0 && window.ws_row > 0;
  int columns = known ? window.ws_col : 80, rows = known ? window.ws_row : 24;
  char *text = NULL;
  size_t size = 0;
  FILE *file = need(open_memstream(&text, &size));
  live->kind->write(live, file, columns, rows);
  close_text(file);
  if (live->n_lines > 0 && live->n_columns == columns)
    printf("\033[%dA\r", live->n_lines);
  else if (live->n_lines > 0)
    fputs("\033[H\033[2J", stdout); /* the width changed, and with it the position of lines */
  printf("%s\033[J", text);
  fflush(stdout);
  live->n_lines = 0;
  for (size_t i = 0; i < size; i++)
    live->n_lines += text[i] == '\n';
  live->n_columns = columns;
  live->drawn_s = monotonic_s();
  free(text);
}

void live_line(const struct live *live, const json_t *at, const char *text)
{
  char now[32] = "";
  const time_t seconds = time(NULL);
  struct tm local;
  if (live->is_drawn || live->ctl->quiet)
    return;
  if (at == NULL && localtime_r(&seconds, &local) != NULL)
    (void)strftime(now, sizeof(now), "%Y-%m-%d %H:%M:%S %Z", &local);
  char *time = json_is_string(at) ? text_from(at, "{:time}") : NULL;
  printf("%-23s  ", time != NULL ? time : now);
  print_plain_line(stdout, "%s", text);
  fflush(stdout);
  free(time);
}

void live_words(const struct live *live, const json_t *at, const json_t *json, const char *words)
{
  char *text = text_from(json, words);
  live_line(live, at, text);
  free(text);
}

/* ---- the state ---- */

void live_load(struct live *live)
{
  const struct request request = {.method = "GET",
                                  .path = path_to("/v1/%ss/%s", live->kind->noun, live->id)};
  json_t *job = send_json(live->ctl, &request, NULL);
  json_decref(live->job);
  live->job = job;
  live->kind->load(live);
  live->finished = is_final(text_of(live->job, "state"));
  live->event_s = monotonic_s();
}

static int show_event(void *context, const char *type, const char *data)
{
  struct live *live = context;
  bool now = false;
  if (strcmp(type, "reset") == 0)
    live_load(live);
  json_t *event = json_loads(data, 0, NULL);
  const bool may_end = live->kind->event(live, type, event, &now);
  json_decref(event);
  draw(live, now || live->finished);
  return live->finished && may_end;
}

/* Fetches the state, and reports changes without an event. Returns whether the job has ended. */
static bool look_again(void *context)
{
  struct live *live = context;
  char phase[64], reason[320];
  snprintf(phase, sizeof(phase), "%s", text_of(live->job, "phase"));
  snprintf(reason, sizeof(reason), "%s", text_of(live->job, "reason"));
  live_load(live);
  live->kind->changed(live, phase, reason);
  draw(live, true);
  return live->finished;
}

static bool notice(void *context)
{
  struct live *live = context;
  const bool late = monotonic_s() - live->event_s > live->kind->ask_s;
  return (late && look_again(live)) || live->finished;
}

/* ---- commands ---- */

/* Follows the job to its end. An interrupt ends only the command, not the job. */
static void watch(struct live *live)
{
  const char *id = live->ctl->operands[0], *command = live->kind->command;
  live->is_drawn = live->ctl->terminal && !live->ctl->quiet;
  /* Before the first output. */
  catch_interrupts(
      live->ctl->quiet
          ? NULL
          : keep(format_text(
                "The %s continues. To resume watching: morphoctl %s watch %s; to pause it: "
                "morphoctl %s pause %s; to stop it: morphoctl %s cancel %s",
                live->kind->noun, command, id, command, id, command, id)));
  /* The number of the newest event, as reported by a page that starts after it. */
  const json_t *page =
      get_json(live->ctl, "/v1/events?format=json&limit=1&after=999999999999999999");
  live_load(live);
  live->kind->begin(live);
  draw(live, true);
  struct follow follow = {.ctl = live->ctl,
                          .job = id,
                          .after = strtoll(text_of(page, "newest"), NULL, 10),
                          .event = show_event,
                          .alive = notice,
                          .broken = look_again,
                          .context = live};
  if (!live->finished)
    follow_events(&follow);
  live->kind->finish(live);
}

static void show_once(struct live *live)
{
  if (live->ctl->json) {
    print_json(get_json(live->ctl, "/v1/%ss/%s", live->kind->noun, live->id));
    return;
  }
  live_load(live);
  live->kind->print(live);
}

/* Runs a command on the job in the first operand. */
static void run(struct ctl *ctl, void (*command)(struct live *live))
{
  struct live *live = keep(calloc(1, ctl->command->live->size));
  live->kind = ctl->command->live;
  live->ctl = ctl;
  live->id = job_id(ctl->operands[0]);
  command(live);
}

void run_live_watch(struct ctl *ctl)
{
  if (ctl->json)
    run_watch(ctl);
  else
    run(ctl, watch);
}

void run_live_show(struct ctl *ctl)
{
  run(ctl, show_once);
}

/* Reports how many founders of a campaign were skipped, and the reason for the first one. */
static void print_left_out(const json_t *job)
{
  const json_t *note, *first = NULL;
  size_t i, n = 0;
  json_array_foreach(json_object_get(job, "founders"), i, note)
  {
    if (!json_is_object(json_object_get(note, "fault")))
      continue;
    first = first != NULL ? first : note;
    n++;
  }
  if (n == 0)
    return;
  print_plain(stderr, "%zu of the initial designs %s left out; random bodies replace them. ", n,
              n == 1 ? "is" : "are");
  print_from(stderr, first, "The first: {fault.detail}");
}

void live_start(struct ctl *ctl, const json_t *request)
{
  const struct live_kind *kind = ctl->command->live;
  const bool watches = option_is_set(ctl, "watch");
  const json_t *job = post_job(ctl, path_to("/v1/%ss", kind->noun), request, 0);
  const char *id = text_of(job, "id");
  if (ctl->json && !watches) {
    print_json(job);
    return;
  }
  const int64_t replicates = number_of(json_object_get(job, "group"), "replicates");
  for (int64_t i = 0; i < (replicates > 1 ? replicates : 1) && !watches; i++)
    printf("%" PRId64 "\n", (int64_t)strtoll(id, NULL, 10) + i);
  if (!ctl->quiet && !ctl->json) {
    fill_template(stderr, job, kind->accepted);
    if (!watches)
      print_plain(stderr, "; morphoctl %s watch %s", kind->command, id);
    fputc('\n', stderr);
    print_left_out(job);
    say_orientations(ctl, json_object_get(job, "notes"));
    say_orientations(ctl, json_object_get(job, "founders"));
    complain_of_warnings(kind->noun, job); /* the ones that the request causes */
  }
  if (!watches)
    return;
  ctl->operands[0] = id;
  ctl->n_operands = 1;
  run_live_watch(ctl);
}
