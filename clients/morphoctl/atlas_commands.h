/* atlas_commands.h: the rows of the table of commands for atlases, with their options. Only
 * table_of_commands.c includes it. */
#ifndef MORPHOCTL_ATLAS_COMMANDS_H
#define MORPHOCTL_ATLAS_COMMANDS_H

#include "runs.h"
#include "shared_options.h"

/* Options of the queries of atlases. */
#define AT_POSITION                                                                                \
  "position", 0, "N", "The body at this position in the order of the atlas, instead of DESIGN."
#define STEPS                                                                                      \
  "steps", 0, "LIST",                                                                              \
      "Steps that lead to a neighbor, separated by commas: add, remove, move (default: "           \
      "add,remove)."
#define OF_VOXELS "voxels", 0, "N", "Only bodies of N voxels."
#define BY_MEASURE                                                                                 \
  "measure", 0, "NAME", "A measure of the atlas, such as mean_speed_m_per_s, instead of the score."
static const struct option_spec atlas_body_options[] = {
    {AT_POSITION},
    {STEPS},
    {"changes", 0, "N", "How many of the best changes to list, 0 to 64 (default: 8)."},
    {NULL}};
static const struct option_spec atlas_steps_options[] = {{AT_POSITION}, {STEPS}, {NULL}};
static const struct option_spec atlas_similar_options[] = {
    {AT_POSITION}, {"limit", 'n', "N", "Maximum number, best first (default: 100)."}, {NULL}};
static const struct option_spec atlas_best_options[] = {
    {OF_VOXELS},
    {BY_MEASURE},
    {"order", 0, "descending|ascending",
     "With --measure: highest values first (default), or lowest."},
    {"lo", 0, "X", "Only bodies with a score (with --measure, a value) of at least X."},
    {"hi", 0, "X", "Only bodies with a score (with --measure, a value) below X."},
    {"score-lo", 0, "SCORE", "With --measure: only bodies with a score of at least this."},
    {"score-hi", 0, "SCORE", "With --measure: only bodies with a score below this."},
    {"limit", 'n', "N", "Maximum number, in the order of the list (default: 20)."},
    {NULL}};
static const struct option_spec atlas_optima_options[] = {
    {"limit", 'n', "N", "Maximum number, largest basins first, up to 500 (default: 20)."}, {NULL}};
static const struct option_spec atlas_histogram_options[] = {
    {OF_VOXELS},
    {BY_MEASURE},
    {"bins", 0, "N", "Number of bins, 1 to 1024 (default: 20)."},
    {"lo", 0, "X", "Where the first bin begins (default: the lowest score or value)."},
    {"hi", 0, "X", "Where the last bin ends (default: right above the highest score or value)."},
    {NULL}};
static const struct option_spec atlas_map_options[] = {
    {"bins", 0, "N", "Number of bins of score and measure, 1 to 64 (default: 24)."}, {NULL}};
static const struct option_spec atlas_compare_options[] = {
    {"bins", 0, "N", "Number of bins of each score, 1 to 64 (default: 24)."}, {NULL}};
static const struct option_spec atlas_download_options[] = {
    {"output", 'o', "FILE", "Where to save it; - is standard output (default: NAME.atlas)."},
    {NULL}};

static const struct option_spec atlas_build_options[] = {
    {"voxels", 'n', "N", "Maximum number of voxels in a body, 1 to 10 (required).", "voxels",
     FIELD_WHOLE},
    {"task", 't', "TASK",
     "A task of the suite morpho-12, such as walk, in its ten selection worlds.", "task"},
    {ENVIRONMENTS},
    {"orientations", 0, "images|canonical",
     "images: score all distinct images of a body, at most eight, and store the mean (default). "
     "canonical: score only its canonical form, in about an eighth of the time.",
     "orientations"},
    {"measures", 0, "LIST",
     "Measures to store: all, or names separated by commas, such as "
     "displacement_m,mean_speed_m_per_s. Each adds 4 bytes per body to the file."},
    {"name", 0, "NAME",
     "Name of the atlas (default: the task and the number of voxels, such as walk-10).", "name"},
    {CONTROLLER},
    {PHYSICS},
    {"wait", 'w', NULL, "Wait until the atlas is built, and print its name."},
    {WEIGHT},
    {DEVICE},
    {LABEL},
    {EXPERIMENT},
    {KEY("job")},
    {NULL}};

/* clang-format off */
#define ATLAS_COMMANDS \
  {"atlas build", "", "Score all bodies of at most N voxels, and store the scores in a file.", \
   run_atlas_build, \
   "There are 1,057,222 bodies of at most 10 voxels. The build is a job of the server, which " \
   "continues without morphoctl and after a crash; job pause, resume and cancel control it. " \
   "Without --wait, prints the id of the job.", \
   atlas_build_options}, \
  {"atlas list", "", "List the atlases on the server.", run_atlas_list}, \
  {"atlas show", "NAME", "Show an atlas, with the best body of each size.", run_atlas_show}, \
  {"atlas body", "NAME [DESIGN]", "Show how a body ranks among all bodies.", run_atlas_body, \
   "Shows its score, rank and percentile, its measures if the atlas has any, and the best bodies " \
   "one step away. DESIGN is one design, given as for eval.", \
   atlas_body_options}, \
  {"atlas neighbors", "NAME [DESIGN]", "List the bodies one step away from a body.", \
   run_atlas_neighbors, "Lists them best first.", atlas_steps_options}, \
  {"atlas ascent", "NAME [DESIGN]", "Follow the best changes to a local optimum.", \
   run_atlas_ascent, NULL, atlas_steps_options}, \
  {"atlas similar", "NAME [DESIGN]", "List the bodies one or two steps away from a body.", \
   run_atlas_similar, "A step adds or removes a voxel. Lists them best first.", \
   atlas_similar_options}, \
  {"atlas best", "NAME", "List the best bodies.", run_atlas_best, \
   "Of all sizes, or of one (--voxels). --lo and --hi limit the score. With --measure, lists the " \
   "bodies with the highest values; --lo and --hi then limit the value, and --score-lo and " \
   "--score-hi the score.", \
   atlas_best_options}, \
  {"atlas optima", "NAME", "List the local optima with the largest basins.", run_atlas_optima, \
   "The basin of an optimum is the number of bodies whose steepest ascent by adding and removing " \
   "voxels ends at it. The first call computes all basins, which takes a few seconds.", \
   atlas_optima_options}, \
  {"atlas histogram", "NAME", "Show the distribution of the scores or of a measure.", \
   run_atlas_histogram, NULL, \
   atlas_histogram_options}, \
  {"atlas map", "NAME MEASURE", "Show how a measure relates to the score.", run_atlas_map, \
   "Prints a map of all bodies, with the score downward and the measure to the right, and the " \
   "rank correlation of both (Kendall's tau-b).", \
   atlas_map_options}, \
  {"atlas compare", "A B", "Compare the scores of the same bodies in two atlases.", \
   run_atlas_compare, \
   "Prints Kendall's rank correlation (tau-b) over the bodies in both, and a map of their " \
   "scores, with A downward and B to the right.", \
   atlas_compare_options}, \
  {"atlas download", "NAME", "Download an atlas file.", run_atlas_download, \
   "The Python package reads it without a server.", atlas_download_options}, \
  {"atlas upload", "NAME FILE", "Store a file as an atlas.", run_atlas_upload, \
   "The server checks the whole file first. An existing atlas with this name is replaced. As " \
   "FILE, - is standard input."}, \
  {"atlas delete", "NAME", "Delete an atlas.", run_atlas_delete, \
   "A deleted atlas cannot be restored."}
/* clang-format on */

#endif
