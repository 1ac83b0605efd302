/* cmd_film.c: "film" and "picture", and --film of other commands: draws robots without a display.
 *
 * The rollouts come from the server as scenes: computed for the request and not stored, or recorded
 * by an evaluation. A film is a folder of PNG files, a Y4M stream, or any format into which ffmpeg,
 * if it is installed, converts such a stream. */
#include <errno.h>
#include <inttypes.h>
#include <math.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <unistd.h>

#include "../film/raster.h"
#include "commands.h"
#include "results.h"

#define ROBOTS_MAX     16
#define LAST_S         1.0 /* how long the last frame stays */
#define DURATION_MAX_S 3600
#define FRAME_S        0.02 /* between two recorded frames */
#define GAP            2    /* pixels between two views */

struct film {
  struct scene scene;
  struct reply replies[ROBOTS_MAX];                /* hold the scene's bytes */
  uint32_t width, height, view_width, view_height; /* pixels of the whole, of a robot's view */
  struct raster *raster;                           /* of one robot's view */
  uint8_t *tile, *frame;                           /* (height, width, 3) of a view, of the whole */
  bool light;
  double rate, yaw, pitch, distance_m;
};

/* ---- the rollouts ---- */

static int64_t option_environment(const struct ctl *ctl)
{
  return option_number(ctl, "environment", 0, 63, 0);
}

/* Selects one environment of the set or file in --environments. */
static void choose_environment(struct ctl *ctl, json_t *request)
{
  const json_t *listed = json_object_get(request, "environments");
  if (json_is_object(listed))
    fail(STATUS_USAGE, "film needs a set or a list of environments; to film varied ones, run an "
                       "evaluation and film it");
  if (!json_is_array(listed)) {
    const char *set = escape(listed != NULL ? json_string_value(listed) : "paper-test");
    listed = json_object_get(get_json(ctl, "/v1/environment-sets/%s", set), "items");
  }
  json_t *chosen = json_array_get(listed, (size_t)option_environment(ctl));
  if (chosen == NULL)
    fail(STATUS_USAGE, "--environment: there are %zu environments, counted from 0",
         json_array_size(listed));
  json_object_del(chosen, "sha256");
  json_object_set_new(request, "environments", json_pack("[O]", chosen));
}

/* Returns the steps between two frames; a recording has at least two. */
static json_int_t stride_of(const json_t *request)
{
  const json_t *physics = json_object_get(request, "physics");
  const json_t *dt_s = json_object_get(physics, "dt_s"),
               *n_steps = json_object_get(physics, "n_steps");
  const bool is_paper = json_is_string(physics);
  const double step_s = json_is_number(dt_s) ? json_number_value(dt_s)
                        : is_paper           ? 0.004
                                             : 0.002,
               steps = json_is_number(n_steps) ? json_number_value(n_steps)
                       : is_paper              ? 1000
                                               : 2000,
               stride = step_s > 0 ? fmin(round(FRAME_S / step_s), steps) : 1;
  return stride > 1 ? (json_int_t)stride : 1;
}

static void load_scene(struct ctl *ctl, struct film *film)
{
  const struct designs designs = given_designs(ctl, 0, random_of(ctl, "seed", ROBOTS_MAX));
  const size_t n = json_array_size(designs.list);
  if (n < 1 || n > ROBOTS_MAX)
    fail(STATUS_USAGE, "a film has 1 to %d robots, got %zu", ROBOTS_MAX, n);
  json_t *request = keep(json_pack("{s:O,s:[s]}", "designs", designs.list, "record", "masses"));
  request_fill(ctl, request);
  json_object_set_new(request, "record_stride", json_integer(stride_of(request)));
  choose_environment(ctl, request);
  struct request how = json_request("POST", "/v1/rollouts", request);
  struct reply *reply = &film->replies[0];
  how.accept = "application/vnd.morphod.scene";
  transport_send(ctl, &how, reply);
  film->scene = scene_read(reply->body, reply->body_bytes);
  say_orientations(ctl, film->scene.designs);
}

/* ---- drawing ---- */

static double option_real(const struct ctl *ctl, const char *name, double low, double high,
                          double otherwise)
{
  const char *text = option_text(ctl, name, NULL);
  char *end = NULL;
  if (text == NULL)
    return otherwise;
  const double value = strtod(text, &end);
  if (end == text || *end != '\0' || !(value >= low && value <= high))
    fail(STATUS_USAGE, "--%s must be a number from %g to %g, got \"%s\"", name, low, high, text);
  return value;
}

static double duration_s(const struct film *film)
{
  uint32_t frames = 1;
  for (uint32_t i = 0; i < film->scene.n_rollouts; i++)
    if (film->scene.rollouts[i].n_frames > frames)
      frames = film->scene.rollouts[i].n_frames;
  return (frames - 1) * film->scene.frame_s;
}

static bool is_side(uint32_t pixels)
{
  return pixels >= 64 && pixels <= RASTER_SIDE_MAX;
}

static void read_look(struct ctl *ctl, struct film *film)
{
  const char *size = option_text(ctl, "size", "960x540");
  int end = 0;
  /* NOLINTNEXTLINE(cert-err34-c): 5 digits fit */
  if (sscanf(size, "%5ux%5u%n", &film->width, &film->height, &end) != 2 || size[end] != 0 ||
      !is_side(film->width) || !is_side(film->height))
    fail(STATUS_USAGE, "--size must be WIDTHxHEIGHT with 64 to %d pixels each, got \"%s\"",
         RASTER_SIDE_MAX, size);
  film->light = option_is_set(ctl, "light");
  film->rate = option_real(ctl, "rate", 1, 120, 25);
  film->distance_m = option_real(ctl, "distance", 0.4, 14, 2.2);
  film->yaw = option_real(ctl, "yaw", -360, 360, 20) * M_PI / 180;
  film->pitch = option_real(ctl, "pitch", 1, 88, 23) * M_PI / 180;
}

static void lay_out(struct film *film)
{
  if (film->scene.n_rollouts > ROBOTS_MAX || !(duration_s(film) <= DURATION_MAX_S))
    fail(STATUS_ERROR, "the server sent more than was requested");
  /* Views side by side, about as wide as the picture. */
  const uint32_t n = film->scene.n_rollouts;
  const uint32_t columns = n <= 1 ? 1 : n <= 4 ? 2 : n <= 9 ? 3 : 4;
  const uint32_t rows = n > columns ? (n + columns - 1) / columns : 1;
  film->view_width = film->width / columns;
  film->view_height = film->height / rows;
  film->raster = raster_create(film->view_width, film->view_height);
  const size_t bytes = (size_t)film->width * film->height * 3 + 1;
  film->tile = keep(calloc(bytes, 1));
  film->frame = keep(calloc(bytes, 1));
  for (size_t i = 0; i < (size_t)film->width * film->height; i++)
    raster_background(film->light, film->frame + 3 * i);
}

static void prepare(struct ctl *ctl, struct film *film)
{
  read_look(ctl, film);
  load_scene(ctl, film);
  lay_out(film);
}

static void draw(struct film *film, double time_s)
{
  const uint32_t width = film->view_width, height = film->view_height;
  const uint32_t gap = film->scene.n_rollouts > 1 ? GAP : 0;
  uint32_t left = 0, top = 0;
  for (uint32_t i = 0; i < film->scene.n_rollouts; i++) {
    struct raster_camera camera = {
        .yaw = film->yaw, .pitch = film->pitch, .distance_m = film->distance_m};
    raster_center(&film->scene, i, time_s, camera.target_m);
    raster_draw(film->raster, &film->scene, i, time_s, &camera, film->light, film->tile);
    for (uint32_t y = 0; y < height - gap; y++)
      memcpy(film->frame + ((size_t)(top + y) * film->width + left) * 3,
             film->tile + (size_t)y * width * 3, (size_t)(width - gap) * 3);
    left += width;
    if (left + width > film->width) {
      left = 0;
      top += height;
    }
  }
}

static void save_png(const struct film *film, const char *path)
{
  size_t size;
  unsigned char *file = png_encode(film->frame, film->width, film->height, &size);
  save_output(path, "", 0, file, size);
  free(file);
}

/* ---- films ---- */

/* Writes a frame of a Y4M stream: full resolution for brightness and both colors. */
static bool put_y4m(const struct film *film, FILE *file)
{
  const size_t n = (size_t)film->width * film->height;
  /* ITU-R BT.601, the default of players. */
  static const double weights[3][4] = {
      {16, 65.481, 128.553, 24.966}, {128, -37.797, -74.203, 112}, {128, 112, -93.786, -18.214}};
  fputs("FRAME\n", file);
  for (int plane = 0; plane < 3; plane++) {
    const double *w = weights[plane];
    for (size_t i = 0; i < n; i++) {
      const uint8_t *rgb = film->frame + 3 * i;
      putc((int)(w[0] + (w[1] * rgb[0] + w[2] * rgb[1] + w[3] * rgb[2]) / 255 + 0.5), file);
    }
  }
  return !ferror(file);
}

static bool is_folder(const char *output)
{
  const size_t length = strlen(output);
  return length > 0 && output[length - 1] == '/';
}

static const char no_ffmpeg[] = "%s: ffmpeg is not installed; write a .y4m file or a folder of PNG "
                                "files (frames/) instead";

static bool ends_with(const char *name, const char *end)
{
  const size_t length = strlen(name);
  return length > strlen(end) && strcasecmp(name + length - strlen(end), end) == 0;
}

/* Returns whether ffmpeg makes the film, by the suffix of its name. */
static bool needs_ffmpeg(const char *output)
{
  return strcmp(output, "-") != 0 && !is_folder(output) && !ends_with(output, ".y4m");
}

/* Opens the target of the stream: standard output, a file, or ffmpeg. */
static FILE *open_stream(const char *output, pid_t *ffmpeg)
{
  int ends[2];
  signal(SIGPIPE, SIG_IGN); /* a reader that exits early is an error like any other */
  *ffmpeg = 0;
  if (strcmp(output, "-") == 0)
    return stdout;
  if (!needs_ffmpeg(output))
    return fopen(output, "we");
  if (pipe(ends) != 0)
    return NULL;
  *ffmpeg = fork();
  if (*ffmpeg == 0) {
    dup2(ends[0], STDIN_FILENO);
    close(ends[0]);
    close(ends[1]);
    /* Always a file, even if the name starts with a dash. */
    execlp("ffmpeg", "ffmpeg", "-loglevel", "error", "-y", "-f", "yuv4mpegpipe", "-i", "-",
           "-pix_fmt", "yuv420p", path_to("file:%s", output), (char *)NULL);
    _exit(127);
  }
  close(ends[0]);
  if (*ffmpeg > 0)
    return fdopen(ends[1], "w");
  close(ends[1]);
  return NULL;
}

static void close_stream(FILE *file, pid_t ffmpeg, const char *output, bool is_written)
{
  int status = 0;
  const bool flushed = file == stdout ? fflush(file) == 0 : fclose(file) == 0;
  if (ffmpeg > 0 && waitpid(ffmpeg, &status, 0) == ffmpeg && status != 0) {
    if (WIFEXITED(status) && WEXITSTATUS(status) == 127)
      fail(STATUS_ERROR, no_ffmpeg, output);
    fail(STATUS_ERROR, "ffmpeg could not write %s", output);
  }
  if (!is_written || !flushed)
    fail(STATUS_ERROR, "%s: %s", output, strerror(errno));
}

static void film_stream(struct film *film, const char *output, uint32_t n_frames)
{
  pid_t ffmpeg;
  FILE *file = open_stream(output, &ffmpeg);
  if (file == NULL)
    fail(STATUS_ERROR, "%s: %s", output, strerror(errno));
  bool good = fprintf(file, "YUV4MPEG2 W%u H%u F%u:1000 Ip A1:1 C444\n", film->width, film->height,
                      (unsigned)(film->rate * 1000 + 0.5)) > 0;
  for (uint32_t i = 0; i < n_frames && good && !interrupted(); i++) {
    draw(film, i / film->rate);
    good = put_y4m(film, file);
  }
  close_stream(file, ffmpeg, output, good);
}

static void film_folder(struct film *film, const char *folder, uint32_t n_frames)
{
  if (mkdir(folder, 0777) != 0 && errno != EEXIST)
    fail(STATUS_ERROR, "%s: %s", folder, strerror(errno));
  for (uint32_t i = 0; i < n_frames && !interrupted(); i++) {
    draw(film, i / film->rate);
    save_png(film, path_to("%s/%05u.png", folder, i));
  }
}

static void write_film(struct ctl *ctl, struct film *film, const char *output)
{
  catch_interrupts(NULL);
  const uint32_t n = (uint32_t)((duration_s(film) + LAST_S) * film->rate + 0.5);
  if (is_folder(output))
    film_folder(film, output, n);
  else
    film_stream(film, output, n);
  if (interrupted())
    leave(STATUS_INTERRUPTED);
  if (!ctl->quiet && strcmp(output, "-") != 0)
    print_plain_line(stderr, "%s: %u frames", output, n);
}

void run_film(struct ctl *ctl)
{
  static struct film film;
  const char *output = option_text(ctl, "output", NULL);
  if (output == NULL)
    fail(STATUS_USAGE, "--output is missing: film.mp4, film.y4m, - or a folder that ends with /");
  prepare(ctl, &film);
  write_film(ctl, &film, output);
}

/* ---- films of evaluations ---- */

static bool has_ffmpeg(void)
{
  const char *path = getenv("PATH");
  while (path != NULL && *path != '\0') {
    const size_t length = strcspn(path, ":");
    char file[4096];
    snprintf(file, sizeof(file), "%.*s/ffmpeg", (int)length, path);
    if (access(file, X_OK) == 0)
      return true;
    path += length + (path[length] == ':');
  }
  return false;
}

void film_check(struct ctl *ctl)
{
  static const char *const looks[] = {"environment", "size",     "light", "yaw",
                                      "pitch",       "distance", "rate"};
  const char *output = option_text(ctl, "film", NULL);
  struct film film;
  for (size_t i = 0; i < sizeof(looks) / sizeof(looks[0]); i++)
    if (output == NULL && option_is_set(ctl, looks[i]))
      fail(STATUS_USAGE, "--%s needs --film", looks[i]);
  if (output == NULL)
    return;
  if (output[0] == '\0' || strcmp(output, "-") == 0)
    fail(STATUS_USAGE, "--film must be film.mp4, film.y4m, or a folder that ends with /");
  option_environment(ctl);
  read_look(ctl, &film);
  if (needs_ffmpeg(output) && !has_ffmpeg())
    fail(STATUS_ERROR, no_ffmpeg, "--film");
}

/* Selects the designs that a film shows: all, or the best ones, best first. Returns their
 * number. */
static size_t choose_designs(const json_t *results, size_t places[ROBOTS_MAX])
{
  const size_t n = json_array_size(results);
  struct ranked *order = rank_results(results, n > ROBOTS_MAX);
  size_t chosen = 0;
  for (size_t i = 0; i < n && chosen < ROBOTS_MAX; i++)
    if (!json_is_object(json_object_get(json_array_get(results, order[i].place), "fault")))
      places[chosen++] = order[i].place;
  return chosen;
}

static void load_recording(struct ctl *ctl, struct film *film, const char *evaluation,
                           size_t design, int64_t environment, struct reply *reply)
{
  const char *path = path_to("/v1/evaluations/%s/trajectories/%zu?environment=%" PRId64, evaluation,
                             design, environment);
  transport_get(ctl, path, "application/vnd.morphod.scene", reply);
  const struct scene scene = scene_read(reply->body, reply->body_bytes);
  scene_append(&film->scene, &scene);
}

void film_evaluation(struct ctl *ctl, const json_t *evaluation)
{
  static struct film film;
  const json_t *results = json_object_get(evaluation, "results");
  const size_t n = json_array_size(results);
  const size_t n_environments = json_array_size(value_at(results, "0.losses"));
  const char *output = option_text(ctl, "film", NULL);
  size_t places[ROBOTS_MAX];
  if (output == NULL)
    return;
  const int64_t environment = option_environment(ctl);
  if ((size_t)environment >= n_environments)
    fail(STATUS_USAGE, "--environment: there are %zu environments, counted from 0", n_environments);
  const size_t chosen = choose_designs(results, places);
  if (chosen < n && !ctl->quiet)
    print_plain_line(stderr, "the film shows the %zu best of %zu designs", chosen, n);
  read_look(ctl, &film);
  for (size_t i = 0; i < chosen; i++)
    load_recording(ctl, &film, text_of(evaluation, "id"), places[i], environment, &film.replies[i]);
  lay_out(&film);
  write_film(ctl, &film, output);
}

/* ---- pictures ---- */

void run_picture(struct ctl *ctl)
{
  static struct film film;
  const char *output = option_text(ctl, "output", NULL);
  const double asked_s = option_real(ctl, "time", 0, 1e6, -1);
  if (output == NULL)
    fail(STATUS_USAGE, "--output is missing: picture.png, or - for standard output");
  if (strcmp(output, "-") != 0 && !ends_with(output, ".png"))
    fail(STATUS_USAGE, "--output: a picture is a PNG file; name it .png, not \"%s\"", output);
  prepare(ctl, &film);
  const double end_s = duration_s(&film);
  if (asked_s > end_s)
    fail(STATUS_USAGE, "--time: the rollout ends after %g s; give a time up to that, not %g", end_s,
         asked_s);
  draw(&film, asked_s >= 0 ? asked_s : fmin(2, end_s));
  save_png(&film, output);
}
