/* certificate_commands.h: the rows of the table of commands for certificates, with their options.
 * Only table_of_commands.c includes it. */
#ifndef MORPHOCTL_CERTIFICATE_COMMANDS_H
#define MORPHOCTL_CERTIFICATE_COMMANDS_H

#include "runs.h"
#include "shared_options.h"

#define AS_CSV "csv", 0, NULL, "Print a row for each design and level, as CSV."
static const struct option_spec certify_options[] = {
    {"campaign", 0, "ID",
     "The best designs of this campaign's newest population, with its environments, its physics "
     "and its resulting controller (or, without one, the controller it started with) unless others "
     "are given."},
    {"evaluation", 0, "ID",
     "The best designs of this evaluation, with its environments, its physics and its controller "
     "unless others are given."},
    {"best", 'n', "N",
     "With --campaign or --evaluation: number of best designs, 1 to 256 (default: 20)."},
    RULES(""),
    {CONTROLLER},
    {TASK},
    {ENVIRONMENTS},
    {PHYSICS},
    {"axes", 0, "LIST",
     "What to change, separated by commas (default: all): precision, step, held_out, chance, "
     "stiffness, mass, drag, gravity, actuation, friction, drop, worlds.",
     "axes", FIELD_WORDS},
    {"seed", 0, "SEED", "Seed of the worlds and constants drawn (default: 1).", "seed",
     FIELD_WHOLE},
    {"held-out", 0, "N", "Number of worlds of the axis held_out, 2 to 1024 (default: 256).",
     "held_out", FIELD_WHOLE},
    {"worlds", 0, "N", "Number of worlds of the axis worlds, 2 to 256 (default: 64).", "worlds",
     FIELD_WHOLE},
    {"chance", 0, "N", "How often the axis chance repeats each world, 2 to 64 (default: 16).",
     "chance", FIELD_WHOLE},
    {"levels", 0, "LIST",
     "Factors of each constant, ascending, without 1, separated by commas (default: "
     "0.7,0.9,1.1,1.3).",
     "levels", FIELD_REALS},
    {"ranges", 0, "FACTOR=LOW:HIGH",
     "Range of a factor on the axis worlds (default: 0.7:1.3, of friction 1/3 to 4/3); FACTOR: "
     "stiffness, mass, drag, gravity, actuation or friction; can be repeated.",
     "ranges", FIELD_RANGES},
    {"top", 0, "N",
     "Number of best designs that the regret is for (default: a tenth of them, at least 1).", "top",
     FIELD_WHOLE},
    {"wait", 'w', NULL, "Wait until it is complete, and print its report."},
    {AS_CSV},
    {WEIGHT},
    {DEVICE},
    {LABEL},
    {EXPERIMENT},
    {KEY("job")},
    {NULL}};
static const struct option_spec certificate_options[] = {{AS_CSV}, {NULL}};
static const struct option_spec certificate_list_options[] = {
    {STATE("certificates")}, FILTERED, {OF_USER}, {NEWEST}, {UNLIMITED}, {NULL}};

/* clang-format off */
#define CERTIFICATE_COMMANDS \
  {"certify", "[DESIGN]...", "Measure how much the scores of designs depend on the simulation.", \
   run_certify, \
   "Scores up to 256 designs, given as for eval or taken as the best of a campaign or " \
   "evaluation, and scores them again with finer time steps, in fresh worlds, and with other " \
   "constants of the physics. The certificate is a job of the server, which continues without " \
   "morphoctl and after a crash. Without --wait, prints its id, for certificate.", \
   certify_options}, \
  {"certificate list", "", "List certificates, newest first.", run_list, NULL, \
   certificate_list_options}, \
  {"certificate", "ID", "Show the report of a certificate.", run_certificate, \
   "docs/trust.md explains it. While the job runs, the report covers the completed levels; " \
   "exit status 3 if there are none.", \
   certificate_options}
/* clang-format on */

#endif
