/* cmd_atlas.c: atlas list, show, download, upload, delete, map, compare, histogram. */
#include <stdlib.h>
#include <string.h>

#include "commands.h"
#include "differences.h"
#include "download.h"
#include "results.h"

#define ATLAS_TYPE      "application/octet-stream"
#define ATLAS_BYTES_MAX ((size_t)4 << 30)
#define BAR_COLUMNS     40
#define BINS_MAX        1024
#define MAP_BINS_MAX    64

const char *atlas_path(const struct ctl *ctl, const char *below)
{
  return path_to("/v1/atlases/%s%s", escape(ctl->operands[0]), below);
}

/* ---- list and show ---- */

void run_atlas_list(struct ctl *ctl)
{
  const json_t *list = get_json(ctl, "/v1/atlases"), *item;
  size_t i;
  print_items(ctl, list,
              "atlas={name}|>voxels={voxels_max}|>bodies={bodies:,}|orientations={orientations}"
              "|>environments={environments:#}|>best={best.score:.4f}|>size={bytes:MB} MB"
              "|written={modified_at:time}");
  json_array_foreach(json_object_get(list, "unreadable"), i, item)
  {
    if (!ctl->json && !ctl->quiet)
      print_plain_line(stderr, "%s cannot be used: %s", text_of(item, "name"),
                       text_of(item, "reason"));
  }
}

static void print_atlas(const struct ctl *ctl, const json_t *atlas)
{
  static const struct fact facts[] = {
      {"atlas", "{name}"},
      {"bodies", "{bodies:,}, of at most {voxels_max} voxel{voxels_max:s}"},
      {"workspace", "{workspace.0} × {workspace.1} × {workspace.2} voxels"},
      {"orientations", "{orientations}"},
      {"environments", "{environments:#}"},
      {"measures", "[{measured}]"},
      {"controller", "sha256:{controller}"},
      {"physics", "{physics}"},
      {"class", "{fingerprint}"},
      {"local optima", "[{optima:,}]"},
      {"file", "{bytes:MB} MB, written {modified_at:time}"},
      {"best", "{best.id}, score {best.score:.4f}"},
      {NULL, NULL}};
  json_t *copy = keep(json_copy((json_t *)atlas));
  json_object_set_new(copy, "measured", json_string(words_of(json_object_get(atlas, "measures"))));
  print_facts(ctl, copy, facts);
  putchar('\n');
  print_table(stdout, ctl, json_object_get(atlas, "sizes"),
              ">voxels={voxels}|>bodies={bodies:,}|>best={best.score:.4f}|>median={median:.4f}"
              "|best body={best.id}");
}

void run_atlas_show(struct ctl *ctl)
{
  show(ctl, atlas_path(ctl, ""), print_atlas);
}

/* ---- files ---- */

void run_atlas_download(struct ctl *ctl)
{
  const char *output = option_text(ctl, "output", NULL);
  if (output == NULL)
    output = keep(format_text("%s.atlas", ctl->operands[0]));
  download(ctl, atlas_path(ctl, "/file"), ATLAS_TYPE, output, "an atlas");
}

void run_atlas_upload(struct ctl *ctl)
{
  size_t n;
  long code;
  const char *bytes = read_input(ctl->operands[1], ATLAS_BYTES_MAX, &n);
  const json_t *atlas = keep(send_json(ctl,
                                       &(struct request){.method = "PUT",
                                                         .path = atlas_path(ctl, "/file"),
                                                         .content_type = ATLAS_TYPE,
                                                         .body = bytes,
                                                         .body_bytes = n},
                                       &code));
  tell(ctl, atlas,
       code == 201 ? "atlas {name} stored: {bodies:,} [{bodies=1}body|bodies]"
                   : "atlas {name} replaced by this file: {bodies:,} [{bodies=1}body|bodies]");
}

void run_atlas_delete(struct ctl *ctl)
{
  act(ctl, (struct request){.method = "DELETE", .path = atlas_path(ctl, "")},
      path_to("atlas %s is deleted", ctl->operands[0]));
}

/* ---- distributions ---- */

/* Prints a line of the histogram: a bin, its bodies of all sizes, and a bar. */
static void print_bin(const struct ctl *ctl, const json_t *histogram, size_t bin, double most)
{
  const json_t *edges = json_object_get(histogram, "edges"), *row;
  char text[32];
  int64_t n = 0;
  size_t i;
  json_array_foreach(json_object_get(histogram, "counts"), i, row)
  {
    n += json_integer_value(json_array_get(row, bin));
  }
  printf("%8.4f … %8.4f %12s  ", json_number_value(json_array_get(edges, bin)),
         json_number_value(json_array_get(edges, bin + 1)), count_text(n, text));
  for (int column = 0; column < (int)(BAR_COLUMNS * (double)n / most + 0.5); column++)
    fputs(ctl->utf8 ? "█" : "#", stdout);
  putchar('\n');
}

static void print_histogram(const struct ctl *ctl, const json_t *histogram)
{
  const json_t *counts = json_object_get(histogram, "counts"), *row;
  const size_t bins = json_array_size(json_array_get(counts, 0));
  double most = 1;
  int64_t outside = 0;
  size_t i;
  char text[32];
  for (size_t bin = 0; bin < bins; bin++) {
    double n = 0;
    json_array_foreach(counts, i, row)
    {
      n += (double)json_integer_value(json_array_get(row, bin));
    }
    most = n > most ? n : most;
  }
  for (size_t bin = 0; bin < bins; bin++)
    print_bin(ctl, histogram, bin, most);
  json_array_foreach(json_object_get(histogram, "outside"), i, row)
  {
    outside += json_integer_value(row);
  }
  if (outside > 0)
    printf("%31s  outside all bins, or %s\n", count_text(outside, text),
           option_is_set(ctl, "measure") ? "without a value" : "diverged");
}

void run_atlas_histogram(struct ctl *ctl)
{
  static const char *const filters[] = {"voxels", "measure", "lo", "hi", NULL};
  const int64_t bins = option_number(ctl, "bins", 1, BINS_MAX, 20);
  show(ctl,
       path_with(ctl, path_to("%s?bins=%d", atlas_path(ctl, "/histogram"), (int)bins), filters),
       print_histogram);
}

/* Prints the histogram of two numbers as shades: the first one, with these edges, downward, the
 * second to the right. */
static void print_map(const struct ctl *ctl, const json_t *comparison, const char *edges)
{
  static const char *const fine[] = {" ", "░", "▒", "▓", "█"}, *const plain[] = {" ", ".", "+", "*",
                                                                                 "#"};
  const json_t *counts = json_object_get(comparison, "counts"), *row, *count;
  double most = 1;
  size_t i, k;
  json_array_foreach(counts, i, row)
  {
    json_array_foreach(row, k, count)
    {
      most = json_number_value(count) > most ? json_number_value(count) : most;
    }
  }
  json_array_foreach(counts, i, row)
  {
    printf("%8.4f  ", json_number_value(json_array_get(json_object_get(comparison, edges), i)));
    json_array_foreach(row, k, count)
    {
      const double n = json_number_value(count);
      int shade = n > 0 ? 1 : 0;
      for (double above = most / 64; shade > 0 && shade < 4 && n > above; above *= 4)
        shade++;
      const char *words = (ctl->utf8 ? fine : plain)[shade];
      printf("%s%s", words, words);
    }
    putchar('\n');
  }
}

static void print_comparison(const struct ctl *ctl, const json_t *comparison)
{
  static const struct fact facts[] = {
      {"bodies", "{bodies:,} in both[; {outside>0:,} diverged in one or both]"},
      {"Kendall's tau", "{kendall_tau:.4f}"},
      {"downward", "{a}"},
      {"to the right", "{b}, from {edges_b.0:.4f}"},
      {NULL, NULL}};
  print_facts(ctl, comparison, facts);
  putchar('\n');
  print_map(ctl, comparison, "edges_a");
}

static void print_measure(const struct ctl *ctl, const json_t *map)
{
  static const struct fact facts[] = {
      {"bodies", "{bodies:,} with a value[; {without_value>0:,} without]"},
      {"Kendall's tau", "{kendall_tau:.4f}"},
      {"downward", "score"},
      {"to the right", "{measure}, from {edges_measure.0:.4f}"},
      {NULL, NULL}};
  print_facts(ctl, map, facts);
  putchar('\n');
  print_map(ctl, map, "edges_score");
}

void run_atlas_map(struct ctl *ctl)
{
  const int64_t bins = option_number(ctl, "bins", 1, MAP_BINS_MAX, 24);
  show(ctl,
       path_to("%s?measure=%s&bins=%d", atlas_path(ctl, "/map"), escape(ctl->operands[1]),
               (int)bins),
       print_measure);
}

void run_atlas_compare(struct ctl *ctl)
{
  const int64_t bins = option_number(ctl, "bins", 1, MAP_BINS_MAX, 24);
  require_distinct(ctl, "atlas");
  show(ctl,
       path_to("%s?with=%s&bins=%d", atlas_path(ctl, "/compare"), escape(ctl->operands[1]),
               (int)bins),
       print_comparison);
}
