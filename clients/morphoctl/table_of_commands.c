/* table_of_commands.c: all commands with their options and help, in the order of the help text. */
#include "atlas_commands.h"
#include "certificate_commands.h"
#include "commands.h"
#include "live.h"
#include "settings.inc"
#include "shared_options.h"

static const struct option_spec eval_options[] = {
    {CONTROLLER},
    {TASK},
    {ENVIRONMENTS},
    {PHYSICS},
    {PRECISION},
    RULES(""),
    {"random", 0, "N",
     "Score N random bodies in addition to any given ones: up to 10,000, or 1,000,000 if none are "
     "given."},
    {"seed", 0, "SEED", "Seed of the random bodies (default: 1)."},
    {"first", 0, "N", "Index of the first of the seed's 1,000,000 bodies (default: 0)."},
    {"record", 0, "LIST",
     "What to record, separated by commas: com (the center of mass), masses, actuation (of each "
     "spring), contacts (with the ground)."},
    {"record-stride", 0, "STEPS", "Steps between two recorded frames (default: 10)."},
    {"output", 'o', "FOLDER",
     "Folder for recorded trajectories, as NumPy files, and evaluation.json."},
    FILM,
    {"priority", 0, "interactive|batch", "Default: interactive up to 64 rollouts, else batch.",
     "priority"},
    {WEIGHT},
    {DEVICE},
    {LABEL},
    {EXPERIMENT},
    {"wait", 0, NULL, "Wait for the result (the default)."},
    {"no-wait", 0, NULL, "Print the id of the evaluation and do not wait."},
    {"sort", 0, "input|score", "Order of the table (default: input; with --best: score)."},
    {"top", 0, "N", "Show only the N best (default with --best K: K)."},
    {"best", 0, "K",
     "Compute complete scores only for the K best; the others are cut short and get lower bounds.",
     "best", FIELD_WHOLE},
    {"error", 0, NULL,
     "Estimate the error of each score: the interval that contains its limit of small steps (at "
     "six "
     "times the cost), and the environments in which rounding decides."},
    {"measures", 0, "LIST",
     "Numbers that describe the rollouts, shown as means in the table: all, or names separated by "
     "commas, such as displacement_m,air_share,work_j."},
    {"tolerance", 0, "ERROR",
     "Choose time step and precision for each design, so that the estimated error of its score is "
     "at most ERROR, such as 0.01 (takes 6 to 186 times as many steps).",
     "tolerance", FIELD_REAL},
    {KEY("evaluation")},
    {NULL}};
static const struct option_spec verify_options[] = {
    {CONTROLLER},
    {TASK},
    {ENVIRONMENTS},
    {PHYSICS},
    {PRECISION},
    {"evaluation", 0, "ID", "Verify all designs of an earlier evaluation, with its settings."},
    {NULL}};
static const struct option_spec design_list_options[] = {
    {"sort", 0, "id|score",
     "id: in order of arrival (default); score: designs with a score on the paper's test set, best "
     "first, one row per orientation."},
    {"order", 0, "ascending|descending", "descending: newest or worst first."},
    {"controller", 'c', "NAME", "Controller of the scores (default: default)."},
    {"environments", 'e', "SET", "Set of environments of the scores (default: paper-test)."},
    {"physics", 'p', "default|paper", "Physics of the scores: the default, or the paper's."},
    {"limit", 'n', "N", "Maximum number (default: 100)."},
    {UNLIMITED},
    {NULL}};
static const struct option_spec bundle_export_options[] = {
    {LABELED},
    {OF_EXPERIMENT},
    {"group", 'g', "ID",
     "Only the replicates of this group; its id is that of its first campaign."},
    {"recordings", 0, NULL, "Include evaluations' recordings of the designs."},
    {NULL}};
static const struct option_spec scores_export_options[] = {
    {"controller", 'c', "NAME", "Only scores of this controller."},
    {"class", 0, "TEXT", "Only scores of this class, the fingerprint that design show prints."},
    {"since", 0, "TIME",
     "Only scores computed at this time or later, in UTC: 2026-11-21T11:34:04Z."},
    {NULL}};
static const struct option_spec bundle_import_options[] = {
    {"recompute", 0, "N",
     "Then recompute the scores of the N best designs of each campaign, 1 to 1000. Exit status "
     "3 if one differs."},
    {NULL}};
static const struct option_spec export_options[] = {
    {"output", 'o', "FILE", "Output file (default: -, standard output)."},
    {"format", 'f', "csv|ndjson|newick|columns",
     "The format (default: from the suffix of FILE: .csv, .ndjson, .jsonl or .nwk; csv for "
     "standard output or a name without a suffix; other suffixes need --format). newick is for "
     "phylogenies."},
    {NULL}};
#define WALKERS                                                                                    \
  {CONTROLLER}, {TASK}, {ENVIRONMENTS},                                                            \
      {"environment", 0, "N", "Which of the environments, from 0 (default: 0)."}, {PHYSICS},       \
      {"random", 0, "N", "Draw N random bodies in addition to the given ones."},                   \
      {"seed", 0, "SEED", "Seed of the random bodies (default: 1)."},                              \
  {                                                                                                \
    "output", 'o', "FILE", "Output file."                                                          \
  }
static const struct option_spec film_options[] = {WALKERS, LOOK, RATE, {NULL}};
static const struct option_spec picture_options[] = {
    WALKERS,
    LOOK,
    {"time", 0, "S", "Seconds after the start (default: 2, or the end of a shorter rollout)."},
    {NULL}};
#define SEED "seed", 0, "SEED", "Seed (default: 1).", "seed", FIELD_WHOLE
static const struct option_spec random_options[] = {
    {"count", 'n', "N", "Number of bodies, up to 10,000 (default: 1).", "count", FIELD_WHOLE},
    {SEED},
    {"first", 0, "N", "Index of the first of the seed's 1,000,000 bodies (default: 0).", "first",
     FIELD_WHOLE},
    {NULL}};
static const struct option_spec mutate_options[] = {
    {"children", 0, "N", "Number of mutants of each design (default: 1).", "children", FIELD_WHOLE},
    {"rate", 0, "X", "Probability that a voxel flips, 0.001 to 0.5 (default: 1/144).", "rate",
     FIELD_REAL},
    {SEED},
    RULES(""),
    {NULL}};
static const struct option_spec made_options[] = {RULES(""), {NULL}};
static const struct option_spec job_list_options[] = {{STATE("jobs")}, FILTERED,    {OF_USER},
                                                      {NEWEST},        {UNLIMITED}, {NULL}};
static const struct option_spec job_text_options[] = {{"remove", 0, NULL, "Delete the text."},
                                                      {NULL}};
static const struct option_spec job_delete_options[] = {{"yes", 'y', NULL, "Do not ask."}, {NULL}};
static const struct option_spec usage_options[] = {
    {"by", 0, "label|experiment|submitted_by|kind", "How to group the sums (default: label)."},
    {NULL}};
static const struct option_spec job_show_options[] = {
    {"results", 'r', NULL, "Also show the results."}, {NULL}};
static const struct option_spec watch_options[] = {
    {"after", 0, "EVENT", "Start after this event; 0: with the oldest event still kept."}, {NULL}};
static const struct option_spec wait_options[] = {
    {"run", 0, "COMMAND",
     "Then run this with sh. MORPHOD_JOBS has the ids; MORPHOD_STATE is succeeded, or the state of "
     "the first job that did not succeed."},
    {NULL}};
static const struct option_spec train_start_options[] = {
    {"preset", 0, "workstation|phototaxis|paper|robust",
     "Source of all options that you leave out: workstation, the defaults below (default); "
     "phototaxis, as the shipped controller was pretrained; paper, as in the paper; robust, "
     "phototaxis in worlds that vary.",
     "preset"},
    {"name", 0, "NAME", "Name of the resulting controller (default: training-ID).", "name"},
    {"controller", 'c', "NAME",
     "Controller to start from: a name or sha256:<64 digits> (default: random weights; finetune: "
     "default).",
     "controller"},
    {"random", 0, "N", "finetune: N random bodies in addition to the given ones."},
    {"random-seed", 0, "SEED", "Seed of these bodies (default: 1)."},
    {"population", 0, "JOB",
     "finetune: the designs of an evaluation that has succeeded, or the newest population of a "
     "campaign, best first."},
    {"best", 0, "N", "Only the N best of the population (default: all)."},
    {"atlas", 0, "NAME",
     "finetune: bodies from the whole ranking of an atlas, one from each of --count equally large "
     "parts."},
    {"count", 0, "N", "Number of bodies from the atlas, 1 to 10000."},
    {"atlas-seed", 0, "SEED", "Decides which body of each part is drawn (default: 1)."},
    {"each", 0, NULL,
     "finetune: each design learns individually, starting from the same controller, and is scored "
     "before and after (train each)."},
    {"keep", 0, "none|all",
     "With --each: which controllers the server stores, as NAME-POSITION (default: none).", "keep"},
    {"keep-best", 0, "N", "With --each: store only the controllers with the N best scores.", "best",
     FIELD_WHOLE},
    {"schedule", 0, "NAME",
     "Learning rate: one-cosine (default), finetune-cosine (default of finetune), paper-pretrain, "
     "paper-finetune, paper-simultaneous; or restarts, cosine or constant, with the options "
     "below."},
    {"environments", 'e', "SET|FILE",
     "Learn in a set such as morpho-12-walk, or in a JSON file with a list of environments, also "
     "with tasks; - is standard input (default: random terrains and lights)."},
    {"tasks", 0, "TASK,...",
     "Learn these tasks in random terrains: photo, photo-auc, walk, climb, circle, path, shuttle, "
     "pursue (default: photo)."},
    TRAINING_OPTIONS{VARY("vary")},
    {PHYSICS},
    {"validate-every", 0, "STEPS",
     "Score the held-out set every STEPS steps; 0: never (default: 50).", "validation.every_steps",
     FIELD_WHOLE},
    {"validation-designs", 0, "N", "Number of designs in the held-out set (default: 64).",
     "validation.designs", FIELD_WHOLE},
    {"validation-environments", 0, "N",
     "Number of environments in the held-out set (default: 8). Not with --environments: validation "
     "then uses all of them.",
     "validation.environments", FIELD_WHOLE},
    {"checkpoint-steps", 0, "N", "Save the state every N steps; 0: only by time (default: 0).",
     "checkpoint.every_steps", FIELD_WHOLE},
    {"checkpoint-seconds", 0, "N",
     "Save the state every N seconds; 0: only by steps (default: 60).", "checkpoint.every_s",
     FIELD_WHOLE},
    {"checkpoint-keep", 0, "N", "Keep the newest N checkpoints, 1 to 100 (default: 3).",
     "checkpoint.keep", FIELD_WHOLE},
    OF_LONG_JOBS("training", "train"),
    {NULL}};
static const struct option_spec train_list_options[] = {
    {STATE("trainings")}, FILTERED, {OF_USER}, {NEWEST}, {UNLIMITED}, {NULL}};
static const struct option_spec train_export_options[] = {
    {"output", 'o', "FILE",
     "File of the controller (default: training-ID-step-N.safetensors; -: standard output)."},
    {"step", 0, "N",
     "The controller of the checkpoint of this step (default: the result, or the newest "
     "checkpoint)."},
    {"curve", 0, "FILE",
     "The curve as CSV, a line per step; -: standard output. Without --output, no controller."},
    {"validations", 0, "FILE",
     "The validations as CSV; -: standard output. Without --output, no controller."},
    {NULL}};
static const struct option_spec train_each_options[] = {
    {"csv", 0, NULL, "Print the designs as CSV."}, {NULL}};
static const struct option_spec train_prune_options[] = {
    {"step", 0, "N", "Only the checkpoint of this step."}, {NULL}};
static const struct option_spec train_compare_options[] = {
    {"seed", 0, "SEED", "Seed of the held-out set (default: 1)."},
    {"designs", 'd', "N", "Number of designs in the set, 2 to 1,000 (default: 64)."},
    {"environments", 0, "N", "Number of environments per design, 1 to 64 (default: 16)."},
    {PHYSICS},
    {NULL}};
static const struct option_spec campaign_start_options[] = {
    {"preset", 0, "paper|workstation|demo",
     "8192, 512 (default) or 64 designs, with a suitable number of generations.", "preset"},
    {"replicates", 'r', "N",
     "Start N campaigns with consecutive seeds from SEED, 1 to 100 (default: 1).", "replicates",
     FIELD_WHOLE},
    {"controller", 'c', "NAME",
     "A name or sha256:<64 digits>; random: random weights (default: default; simultaneous: "
     "random).",
     "controller"},
    {TASK},
    {ENVIRONMENTS},
    RULES("initial."),
    {"from", 0, "CAMPAIGN",
     "Start with the newest population of another campaign; designs that do not fit the workspace "
     "are left out and counted."},
    {"if-exists", 0, "create|return",
     "For a study: create another one (default), or return the open one with exactly "
     "this label, which must have the settings given here.",
     "if_exists"},
    {"own-score", 0, "NAME",
     "For a study: rank the designs by a score that you send with study tell; lower is better. "
     "NAME "
     "is its name, e.g. work_per_meter.",
     "own_score.name"},
    {"own-score-unit", 0, "UNIT", "Unit of that score, e.g. J/m (default: none).",
     "own_score.unit"},
    {"measures", 0, "LIST",
     "Measure the rollouts of each design: all, or names separated by commas, such as "
     "displacement_m,air_share,work_j. Tables of designs have the means."},
    {"select-by", 0, "MEASURE,max|min",
     "Select by the mean of a measure, such as displacement_m,max, not by the loss."},
    {"aggregate", 0, "KIND[:NUMBER]",
     "How the losses of a design over the environments become its score: mean (default), "
     "quantile:LEVEL (default: 0.9), cvar:LEVEL (mean of the worst 1 - LEVEL of the losses; "
     "default: 0.9), mean-sd:WEIGHT (mean plus WEIGHT standard deviations, default: 1; no "
     "racing)."},
    {"re-evaluate", 0, "EVERY[:ENVIRONMENTS]",
     "Every EVERY generations, and in the last one, score the best designs again in fresh worlds "
     "(default: 64) that are not used for selection: scores without luck."},
    {"workspace", 0, "X,Y,Z", "Box in voxels that bodies must fit (default: 6,6,4)."},
    {"no-exclusions", 0, NULL, "Allow bodies that the controller was pretrained on."},
    {"schedule", 0, "NAME",
     "Learning rate: one-cosine, finetune-cosine, paper-pretrain, paper-finetune (default of "
     "few-shot), paper-simultaneous (default of simultaneous); or restarts, cosine or constant, "
     "with the options below."},
    CAMPAIGN_OPTIONS{"checkpoint-seconds", 0, "N",
                     "Save the state of learning every N seconds; 0: at its end (default: 60).",
                     "learning.checkpoint_every_s", FIELD_WHOLE},
    {"worlds", 0, "random|environments|tasks",
     "Where robots learn: in random environments, in those of the campaign (default if any has a "
     "task, damage, factors, a drop, or a terrain other than rough or flat), or in random ones "
     "with their tasks.",
     "learning.worlds"},
    {VARY("learning.vary")},
    {PHYSICS},
    {"name", 0, "NAME",
     "Name of the controller that a learning campaign produces (default: campaign-ID).", "name"},
    OF_LONG_JOBS("campaign", "campaign"),
    {NULL}};
static const struct option_spec campaign_list_options[] = {
    {STATE("campaigns")},
    FILTERED,
    {OF_USER},
    {"group", 'g', "ID",
     "Only the replicates of this group; its id is that of its first campaign."},
    {NEWEST},
    {UNLIMITED},
    {NULL}};
static const struct option_spec campaign_champions_options[] = {
    {"count", 'n', "N", "Number of designs, 1 to 1000 (default: 12)."},
    {"generation", 0, "G", "From this generation (default: the newest)."},
    {"output", 'o', "FOLDER",
     "Also run them in the campaign's environments, and save the recordings in this folder, as "
     "NumPy files."},
    {"record", 0, "LIST", "What to record: com (default), masses, actuation, contacts."},
    {"record-stride", 0, "STEPS", "Steps between two recorded frames (default: 10)."},
    FILM,
    {NULL}};
static const struct option_spec campaign_export_options[] = {
    {"curve", 0, "FILE",
     "Statistics of each generation as CSV; - is standard output, here and below."},
    {"population", 0, "FILE",
     "Designs of a generation, best first, in the format that eval and train start read."},
    {"generation", 0, "G", "With --population: this generation (default: the newest)."},
    {"phylogeny", 0, "FILE", "Every design ever born, as CSV in the ALife data standard."},
    {"newick", 0, "FILE", "The tree of first parents in Newick format."},
    {"learning", 0, "FILE", "Every step of learning as CSV."},
    {"replicates", 0, "FILE",
     "Mean, minimum and maximum over the replicates, by generation, as CSV."},
    {NULL}};
static const struct option_spec study_ask_options[] = {
    {"random", 0, NULL,
     "Random bodies; otherwise mutants and recombinants, once designs are born."},
    {"parents", 0, "LIST",
     "Numbers of the designs to vary, separated by commas (default: all living ones)."},
    {NULL}};
static const struct option_spec study_tell_options[] = {
    {"batch", 0, "N", "Number of the batch (default: the next one)."},
    {"survivors", 0, "LIST",
     "Numbers of the designs that survive, separated by commas (default: the study selects)."},
    {"sampler", 0, "FILE", "State of the sampler, up to 16 MiB, for study sampler to return."},
    RULES(""),
    {NULL}};
static const struct option_spec study_sampler_options[] = {
    {"output", 'o', "FILE", "Output file (default: standard output)."}, {NULL}};
static const struct option_spec controller_get_options[] = {
    {"output", 'o', "FILE", "Output file (default: NAME.safetensors; -: standard output)."},
    {NULL}};
static const struct option_spec fleet_options[] = {
    {"all", 'a', NULL, "Include the newest sessions that have ended."}, {NULL}};

static const struct option_spec fleet_drain_options[] = {
    {"older", 0, NULL, "All workers with an older version than the server's."},
    {"version", 0, "VERSION", "All workers with this version."},
    {"within", 0, "SECONDS", "Seconds to wait for each worker (default: 60)."},
    {NULL}};
static const struct option_spec fleet_verify_options[] = {
    {"repair", 0, NULL, "Replace the losses and measures that differ."}, {NULL}};

#define OF_WORKERS                                                                                 \
  {"fleet", 0, "URL", "Address at which workers reach the daemon's fleet_listen."},                \
      {"worker-token-file", 0, "PATH", "File with the workers' token, on their machine."},         \
      {"pin", 0, "sha256//BASE64", "Hash of the daemon's public key."},                            \
  {                                                                                                \
    "cpus", 0, "N", "Processors of a worker (default: 8; systemd: all)."                           \
  }
#define MANY_WORKERS "workers", 0, "N", "Number of workers (default: 4)."
static const struct option_spec fleet_slurm_options[] = {
    OF_WORKERS,
    {MANY_WORKERS},
    {"time", 0, "TIME", "Time limit of a job (default: 1-00:00:00)."},
    {"idle", 0, "TIME", "A worker leaves after this time without work (default: 10min)."},
    {NULL}};
static const struct option_spec fleet_systemd_options[] = {OF_WORKERS, {NULL}};
static const struct option_spec fleet_kubernetes_options[] = {
    OF_WORKERS,
    {MANY_WORKERS},
    {"image", 0, "IMAGE", "Container image with the morphod package."},
    {NULL}};

static const struct option_spec suite_options[] = {
    {CONTROLLER},
    {PHYSICS},
    {PRECISION},
    RULES(""),
    {"held-out", 0, NULL,
     "Use the 64 held-out worlds of each task, for reports, instead of the ten selection worlds."},
    {"campaign", 0, "ID",
     "Score the champions of this campaign, with its physics and, unless --controller is given, "
     "the controller that scored them."},
    {"count", 'n', "N", "With --campaign: number of champions, 1 to 1000 (default: 12)."},
    {"random", 0, "N", "Score N random bodies in addition to the given ones."},
    {"seed", 0, "SEED", "Seed of the random bodies (default: 1)."},
    {"first", 0, "N", "Index of the first of the seed's 1,000,000 bodies (default: 0)."},
    {"no-wait", 0, NULL, "Print the id as soon as the evaluation is stored."},
    {WEIGHT},
    {DEVICE},
    {LABEL},
    {EXPERIMENT},
    {KEY("evaluation")},
    {NULL}};
static const struct option_spec suite_picture_options[] = {
    {"output", 'o', "FILE", "Write it here; - is standard output (default: suite-ID.svg)."},
    {"designs", 0, "LIST",
     "Up to 6 designs by number, from 0, separated by commas (default: the 6 with the lowest "
     "mean loss)."},
    {"theme", 0, "THEME", "light (default) or dark."},
    {"width", 0, "PIXELS",
     "Width, 320 to 2000 (default: 760). Below 620, the legend is below the axes."},
    {NULL}};

const struct command commands[] = {
    {"eval", "[DESIGN]...", "Score designs.", run_eval,
     "A DESIGN is a file, - for standard input (also without any operand), 144 digits 0 and 1, a "
     "robot as shown in tables (ID@K: an id and an orientation, @0 to @7), or only an id, which "
     "means its orientation with the best stored score. Files contain any mixture of JSON designs, "
     "one per line or in lists ({\"cells\": [[x,y,z], ...]}, {\"voxels\": \"0100...\"}, {\"id\": "
     "\"...\"}, each optionally with a \"name\"), lists of cells [[x,y,z], ...], 144 digits 0 and "
     "1, robots or ids. # begins a comment. The score is the mean over the environments of "
     "(distance to the light at the end) / (at the start): lower is better, 1 is standing still.",
     eval_options},
    {"suite run", "[DESIGN]...", "Score designs in all tasks of the suite morpho-12.", run_suite,
     "A DESIGN is as for eval. The suite is one evaluation of the service, which continues if this "
     "command or the service is interrupted; job cancel stops it. Prints the mean values in the "
     "unit of each task (higher is better) and the mean loss over the tasks.",
     suite_options},
    {"suite show", "ID", "Show the table of an evaluation in the suite.", run_suite_show},
    {"suite picture", "ID", "Draw an evaluation in the suite as an SVG file.", run_suite_picture,
     "The picture has one axis per task and one polygon per design.", suite_picture_options},
    {"verify", "[DESIGN]...", "Recompute stored scores and compare the bits.", run_verify,
     "Exit status 0 if all stored losses have the same bits, 3 if some differ or nothing is "
     "stored. For an id without an orientation, every stored orientation is verified.",
     verify_options},
    {"design show", "ID", "Show a design: its body, layer by layer, and its scores.",
     run_design_show},
    {"design list", "", "List designs.", run_list, NULL, design_list_options},
    {"design draw", "[DESIGN]...", "Draw designs from files, without a server.", run_design_draw},
    {"film", "[DESIGN]...", "Film up to 16 robots, without a display.", run_film,
     "Simulates them in one environment and draws what happens. --output determines the format: "
     "film.mp4 (or another that ffmpeg makes, if it is installed), film.y4m, - for a y4m stream "
     "on standard output, or a folder, ending with /, for PNG files.",
     film_options},
    {"picture", "[DESIGN]...", "Draw up to 16 robots as they walk, without a display.", run_picture,
     "--output is a PNG file, or - for standard output.", picture_options},
    {"dashboard", "", "Print the address of the server's pages, including the token.",
     run_dashboard,
     "For a server on a unix socket, also prints the tunnel command for the machine with the "
     "browser."},
    {"design random", "", "Print random bodies, one JSON design per line.", run_design_random,
     "All are distinct; the same seed gives the same bodies.", random_options},
    {"design mutate", "[DESIGN]...", "Print mutants of designs, one JSON design per line.",
     run_design_made,
     "Each differs from all given designs and all other mutants; the same seed gives the same "
     "ones.",
     mutate_options},
    {"design cross", "[DESIGN]...", "Print children of pairs of designs, one per line.",
     run_design_made,
     "Crosses the first two designs, the next two, and so on. A child has the voxels that exactly "
     "one parent has.",
     made_options},
    {"design canonical", "[DESIGN]...", "Print ids of designs, one JSON design per line.",
     run_design_made, "Rotations about z and reflections in x and y of a body have one id.",
     made_options},
    {"job list", "", "List jobs, newest first.", run_list, NULL, job_list_options},
    {"job show", "ID", "Show a job.", run_job_show, NULL, job_show_options},
    {"job cancel", "ID...", "Cancel jobs.", run_job_change, "Scores stored so far are kept."},
    {"job pause", "ID...", "Pause jobs.", run_job_change},
    {"job resume", "ID...", "Resume paused jobs.", run_job_change,
     "This includes failed training runs and campaigns."},
    {"job prune", "ID...", "Delete the recordings of evaluations that have ended.", run_job_prune,
     "Scores are kept. The server deletes the oldest recordings automatically when all of them "
     "exceed its limit (max_recordings)."},
    {"job weight", "ID X", "Change a job's share of the cores.", run_job_weight,
     "0.001 to 1000; a job with twice the weight of another gets twice the time. It takes "
     "effect immediately, even while the job runs."},
    {"job label", "ID [TEXT]", "Set a job's label; without TEXT, print it.", run_job_text, NULL,
     job_text_options},
    {"job experiment", "ID [NAME]", "Set the experiment of a job; without NAME, print it.",
     run_job_text, NULL, job_text_options},
    {"job note", "ID [TEXT]", "Set a job's note; without TEXT, print it.", run_job_text,
     "Plain text of up to 1,000 characters. Retention rules keep jobs that have a note.",
     job_text_options},
    {"job archive", "ID...", "Hide jobs from lists.", run_job_archive, "Nothing else changes."},
    {"job restore", "ID...", "Show archived jobs in lists again.", run_job_archive},
    {"job delete", "ID...", "Permanently delete jobs that have ended.", run_job_delete,
     "Shows what will be deleted, and asks for confirmation. Designs, scores and controllers are "
     "kept. A job that another job needs is not deleted: exit status 3. Delete the first replicate "
     "of a group last.",
     job_delete_options},
    {"usage", "", "Show how much core and device time jobs have used.", run_usage,
     "Deleted jobs are included.", usage_options},
    {"watch", "[JOB]", "Follow a job to its end, or all events.", run_watch,
     "With --json, one event per line. After a lost connection it continues where it stopped. For "
     "a job, the exit status is 0 if it succeeded, 3 if not.",
     watch_options},
    {"wait", "JOB...", "Wait until jobs have ended.", run_wait,
     "Keeps waiting if the server restarts. Exit status: 0 if all succeeded, 3 if one failed, was "
     "cancelled or does not exist, 1 if the command of --run failed, 4 if the server was "
     "unreachable for an hour, or for the time in --retry. A paused job has not ended.",
     wait_options},
    {"train start", "pretrain|finetune [DESIGN]...", "Train a controller.", run_train_start,
     "pretrain: from random weights or a controller, on an endless stream of distinct random "
     "bodies. finetune: a controller, on the designs given (as those of eval), on random ones, on "
     "a population, or on bodies from an atlas. The training run is a job of the server, which "
     "continues without morphoctl, and after a crash.",
     train_start_options, &training_kind},
    {"train list", "", "List training runs, newest first.", run_list, NULL, train_list_options},
    {"train show", "ID", "Show a training run with its curve.", run_live_show, NULL, NULL,
     &training_kind},
    {"train watch", "ID", "Watch a training run until it ends.", run_live_watch,
     "Shows a live plot on a terminal, otherwise a line per event; with --json, the events. Ctrl-C "
     "leaves the job running. Exit status: 0 if it succeeded, 3 if not.",
     NULL, &training_kind},
    {"train pause", "ID...", "Pause training runs, with a checkpoint.", run_job_change},
    {"train resume", "ID...", "Resume training runs that are paused or have failed.",
     run_job_change},
    {"train cancel", "ID...", "Cancel trainings.", run_job_change,
     "Checkpoints are kept; train export fetches their controllers."},
    {"train export", "ID", "Fetch a training run's controller, final or so far, and its curves.",
     run_train_export, NULL, train_export_options},
    {"train each", "ID", "Show the designs that a training run finetuned individually.",
     run_train_each,
     "For a run of train start finetune --each: the score of each design with the controller that "
     "it started from, and with the controller that it learned, and how well the first predicts "
     "the second (Kendall's tau-b), with 95 % confidence intervals. Lower scores are better.",
     train_each_options},
    {"train prune", "ID...", "Delete checkpoints that are not needed.", run_job_prune,
     "Deletes all checkpoints of a finished training run, because its result is a separate "
     "controller; otherwise all but the newest, which is needed to resume. A checkpoint takes 12.4 "
     "MB. Deleted checkpoints can no longer be exported.",
     train_prune_options},
    {"train compare", "A B", "Compare two controllers on held-out designs.", run_train_compare,
     "Scores both controllers on designs and environments that are never used for pretraining, and "
     "shows the mean difference with its 95 % confidence interval (Student t), which holds for "
     "other designs in other environments. Lower scores are better. Settings of their training "
     "runs that differ are listed.",
     train_compare_options},
    {"campaign start", "zero-shot|few-shot|simultaneous|study [DESIGN]...", "Evolve a population.",
     run_campaign_start,
     "zero-shot: the controller is frozen. few-shot: it relearns in each generation. "
     "simultaneous: it learns along the way. study: children come only from study tell. DESIGNs "
     "(given as for eval) form the initial population; random bodies fill it up. The campaign is a "
     "job of the server, which continues without morphoctl and after a crash.",
     campaign_start_options, &campaign_kind},
    {"campaign list", "", "List campaigns, newest first.", run_list, NULL, campaign_list_options},
    {"campaign show", "ID", "Show a campaign with its curves.", run_live_show, NULL, NULL,
     &campaign_kind},
    {"campaign watch", "ID", "Watch a campaign until it ends.", run_live_watch,
     "Shows live curves and a table on a terminal, otherwise a line per generation; with --json, "
     "the events. Ctrl-C leaves the job running. Exit status: 0 if it succeeded, 3 if not.",
     NULL, &campaign_kind},
    {"campaign pause", "ID...", "Pause campaigns.", run_job_change},
    {"campaign resume", "ID...", "Resume campaigns that are paused or have failed.",
     run_job_change},
    {"campaign cancel", "ID...", "Cancel campaigns.", run_job_change,
     "Complete generations are kept."},
    {"campaign extend", "ID N", "Extend a campaign by N generations.", run_campaign_extend,
     "This also works after it has ended: the result is the same as if the campaign had been that "
     "long from the start."},
    {"campaign champions", "ID", "Show the best design and a sample over the ranking.",
     run_campaign_champions,
     "Ordered by how much they differ from each other: the mean Hamming distance to the others.",
     campaign_champions_options},
    {"campaign compare", "A B...", "Compare the best scores of campaigns.", run_campaign_compare,
     "Compares at the latest generation that all campaigns have reached: prints the mean of each "
     "over its replicates, and its difference from the first with a 95 % confidence interval "
     "(Welch). Replicates that failed or were cancelled are left out and listed. If you name two "
     "replicates of one group, each counts as a separate campaign. Settings that differ are "
     "listed; campaigns with different physics or environments are refused, because their scores "
     "are not comparable. Lower scores are better."},
    {"campaign export", "ID", "Fetch a campaign's curves, population and phylogeny.",
     run_campaign_export, NULL, campaign_export_options},
    {"campaign prune", "ID...", "Delete checkpoints of campaigns that have ended.", run_job_prune,
     "Frees 12.4 MB for each campaign that learned. Populations, phylogeny and the resulting "
     "controller are kept. Afterwards, a simultaneous campaign cannot be extended or resumed, and "
     "the champions of a campaign without a resulting controller cannot be recorded. Nothing is "
     "deleted for a campaign that has not ended."},
    ATLAS_COMMANDS,
    CERTIFICATE_COMMANDS,
    {"study ask", "ID N", "Ask a study for N bodies that it has never seen.", run_study_ask,
     "Prints children of its population as JSON, one per line, for study tell. Repeating the "
     "command gives the same bodies until the next batch. campaign start study creates a study; "
     "the other campaign commands also work for studies.",
     study_ask_options},
    {"study tell", "ID [FILE]", "Tell a study its next batch, and print the scores.",
     run_study_tell,
     "FILE (default: standard input) has children as JSON, one after the other or in lists: "
     "{\"body\": {\"cells\": [[x,y,z], ...]}, \"parents\": [3, 17], \"operator\": \"mine\", "
     "\"measures\": {\"reach\": 2}}, or only designs. In a study with --own-score each child has "
     "a \"score\". Sending the same batch again changes nothing.",
     study_tell_options},
    {"study sampler", "ID", "Fetch the state of a study's sampler.", run_study_sampler,
     "Returns the state sent with the newest committed batch. Exit status 3 if that batch had "
     "none.",
     study_sampler_options},
    {"study finish", "ID", "End a study.", run_study_finish,
     "It accepts no more batches after that."},
    {"export", "LIST", "Save any list, curve or phylogeny as a table.", run_export,
     "LIST is an API path after /v1/, with its parameters: jobs, designs?sort=score, "
     "campaigns/7/phylogeny, campaigns/generations?label=B (of several campaigns, in one table).",
     export_options},
    {"bundle export", "FILE [ID]...", "Save campaigns that have ended as one file.",
     run_bundle_export,
     "Includes their controllers, environments, settings, designs, generations, learning curves "
     "and scores.",
     bundle_export_options},
    {"bundle import", "FILE", "Import the campaigns of a bundle.", run_bundle_import,
     "If the bundle is damaged, nothing is imported. Campaigns that the server already has do "
     "not change.",
     bundle_import_options},
    {"bundle verify", "FILE", "Check a bundle, and list its contents.", run_bundle_verify,
     "The server checks every hash and every line, and stores nothing."},
    {"scores export", "[FILE]", "Save stored scores as one file.", run_scores_export,
     "Includes everything they depend on: bodies, environments, physics, weights, class, and who "
     "computed them. FILE is standard output by default.",
     scores_export_options},
    {"scores import", "FILE", "Import the scores in a file from another server.", run_scores_import,
     "Block by block; - is standard input. A score already stored with the same bits is skipped; "
     "one stored with different bits is kept and listed: exit status 3."},
    {"controller list", "", "List controllers.", run_list},
    {"controller info", "NAME", "Show a controller.", run_controller_info},
    {"controller get", "NAME", "Fetch a controller's safetensors file.", run_controller_get, NULL,
     controller_get_options},
    {"controller put", "NAME FILE", "Store a safetensors file as a controller.", run_controller_put,
     "An existing name is repointed to the new file; scores keep the hash of the file they were "
     "computed with."},
    {"controller delete", "NAME", "Remove a name, or delete a file.", run_controller_delete,
     "Removing a name keeps its file. sha256:… deletes a file that no name, job or score refers "
     "to."},
    {"devices", "", "Show the GPUs in use.", run_devices, "Exit status 3 if one is lost."},
    {"fleet slurm", "", "Print a Slurm job array that starts workers.", run_fleet_launch,
     "Prints the installed workers.sbatch, with the options filled in.", fleet_slurm_options},
    {"fleet systemd", "", "Print a systemd unit that runs a worker.", run_fleet_launch,
     "Save it as morphod-worker@.service; it is also part of the installation.",
     fleet_systemd_options},
    {"fleet kubernetes", "", "Print a Kubernetes Deployment of workers.", run_fleet_launch, NULL,
     fleet_kubernetes_options},
    {"fleet drain", "[ID]", "Stop giving work to a worker.", run_fleet_drain,
     "It finishes its leases and leaves. With --older or --version, workers are drained for an "
     "upgrade, one at a time: each exits with status 69 and reports the required version; this "
     "command then waits until it is back. Exit status 3 if one returns with the same version.",
     fleet_drain_options},
    {"fleet verify", "NAME@HOST", "Recompute the results of a worker.", run_fleet_verify,
     "The server recomputes the stored losses and measures of this origin, and lists those that "
     "differ. Exit status 3 if any do, unless they are repaired.",
     fleet_verify_options},
    {"fleet", "", "Show the workers on other machines.", run_fleet, NULL, fleet_options},
    {"status", "", "Show whether the server is ready and what it does.", run_status},
    {"version", "", "Print the version.", run_version},
    {"completion", "", "Print completion for bash.", run_completion,
     "Use: source <(morphoctl completion)"},
};
const size_t n_commands = sizeof(commands) / sizeof(commands[0]);
