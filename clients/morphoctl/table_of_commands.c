/* table_of_commands.c: every command with its options and its help; the order is that of the help text. */
#include "commands.h"

static const struct option_spec eval_options[] = {
    SCORE_OPTIONS,
    {"random", 0, "N", "Score N random bodies (besides those given)."},
    {"seed", 0, "SEED", "Seed of the random bodies (default: 1)."},
    {"record", 0, "com,masses", "Record the path of the centre of mass, of all masses, or both."},
    {"record-stride", 0, "STEPS", "Steps between two recorded frames (default: 10)."},
    {"output", 'o', "FOLDER", "Where to put recorded trajectories, as NumPy files, and evaluation.json."},
    {"label", 'l', "TEXT", "A label to find the job by."},
    {"priority", 0, "interactive|batch", "Default: interactive up to 64 rollouts, else batch."},
    {"wait", 0, NULL, "Wait for the result (the default)."},
    {"no-wait", 0, NULL, "Print the id of the evaluation and do not wait."},
    {"sort", 0, "input|score", "Order of the table (default: input)."},
    {"top", 0, "N", "Only the N best of the table."},
    {"idempotency-key", 0, "KEY",
     "Repeating the same request with the same key gives the same evaluation (default: a new key)."},
    {NULL, 0, NULL, NULL}};
static const struct option_spec verify_options[] = {
    SCORE_OPTIONS,
    {"evaluation", 0, "ID", "Verify all designs of an earlier evaluation, with its settings."},
    {NULL, 0, NULL, NULL}};
static const struct option_spec design_list_options[] = {
    {"sort", 0, "id|score",
     "id: as the designs came (default); score: best first, those with a score on the paper's test set, a row per "
     "orientation."},
    {"controller", 'c', "NAME", "Controller of the scores (default: default)."},
    {"limit", 'n', "N", "At most so many (default: 100)."},
    {"all", 'a', NULL, "No limit."},
    {NULL, 0, NULL, NULL}};
static const struct option_spec random_options[] = {
    {"count", 'n', "N", "How many (default: 1)."}, {"seed", 0, "SEED", "Seed (default: 1)."}, {NULL, 0, NULL, NULL}};
static const struct option_spec job_list_options[] = {
    {"state", 0, "STATE", "Only jobs that are queued, running, paused, succeeded, failed or cancelled."},
    {"limit", 'n', "N", "At most so many, newest first (default: 50)."},
    {"all", 'a', NULL, "No limit."},
    {NULL, 0, NULL, NULL}};
static const struct option_spec job_show_options[] = {{"results", 'r', NULL, "The results, too."},
                                                      {NULL, 0, NULL, NULL}};
static const struct option_spec watch_options[] = {
    {"after", 0, "EVENT", "Begin behind this event; 0: with the oldest that is kept."}, {NULL, 0, NULL, NULL}};
static const struct option_spec controller_get_options[] = {
    {"output", 'o', "FILE", "Where to put it (default: NAME.safetensors; -: standard output)."}, {NULL, 0, NULL, NULL}};

#define MANY ((size_t)-1)

const struct command commands[] = {
    {"eval", "[DESIGN]...", "Score designs.",
     "A DESIGN is a file, - for standard input (also without any operand), 144 digits 0 and 1, or an id. Files hold, "
     "in any "
     "mixture: JSON designs, alone, one per line or in lists ({\"cells\": [[x,y,z], ...]}, {\"voxels\": \"0100...\"}, "
     "{\"id\": "
     "\"...\"}, each perhaps with a \"name\"), lists of cells [[x,y,z], ...], 144 digits 0 and 1, or ids. # begins a "
     "comment. "
     "The score is the mean over the environments of (distance to the light at the end) / (at the start): lower is "
     "better, 1 is "
     "standing still.",
     eval_options, 0, MANY, run_eval},
    {"verify", "[DESIGN]...", "Recompute stored scores and compare the bits.",
     "Exit status 0 if all stored losses have the same bits, 3 if some differ or nothing is stored. Of an id, every "
     "stored "
     "orientation is verified.",
     verify_options, 0, MANY, run_verify},
    {"design show", "ID", "Show a design: its body, layer by layer, and its scores.", NULL, NULL, 1, 1,
     run_design_show},
    {"design list", "", "List designs.", NULL, design_list_options, 0, 0, run_design_list},
    {"design draw", "[DESIGN]...", "Draw designs of files without asking the server.", NULL, NULL, 0, MANY,
     run_design_draw},
    {"design random", "", "Print random bodies, one JSON design per line.",
     "Bodies grow voxel by voxel from one; the same seed gives the same bodies.", random_options, 0, 0,
     run_design_random},
    {"job list", "", "List jobs, newest first.", NULL, job_list_options, 0, 0, run_job_list},
    {"job show", "ID", "Show a job.", NULL, job_show_options, 1, 1, run_job_show},
    {"job cancel", "ID...", "Cancel jobs.", "Scores that are stored already stay.", NULL, 1, MANY, run_job_cancel},
    {"job pause", "ID...", "Set jobs aside.", NULL, NULL, 1, MANY, run_job_pause},
    {"job resume", "ID...", "Go on with paused jobs.", NULL, NULL, 1, MANY, run_job_resume},
    {"watch", "[JOB]", "Follow a job to its end, or all events.",
     "With --json one event per line. After a break the stream goes on where it was. Exit status of a job: 0 if it "
     "succeeded, 3 "
     "if not.",
     watch_options, 0, 1, run_watch},
    {"controller list", "", "List controllers.", NULL, NULL, 0, 0, run_controller_list},
    {"controller info", "NAME", "Show a controller.", NULL, NULL, 1, 1, run_controller_info},
    {"controller get", "NAME", "Fetch a controller's safetensors file.", NULL, controller_get_options, 1, 1,
     run_controller_get},
    {"controller put", "NAME FILE", "Store a safetensors file as a controller.",
     "A name that exists is pointed at the new file; scores keep the hash of the file they were made with.", NULL, 2, 2,
     run_controller_put},
    {"controller delete", "NAME", "Take a name away.", NULL, NULL, 1, 1, run_controller_delete},
    {"status", "", "Show whether the server is ready and what it does.", NULL, NULL, 0, 0, run_status},
    {"version", "", "Print the version.", NULL, NULL, 0, 0, run_version},
    {"completion", "", "Print completion for bash.", "Use: source <(morphoctl completion)", NULL, 0, 0, run_completion},
};
const size_t n_commands = sizeof(commands) / sizeof(commands[0]);
