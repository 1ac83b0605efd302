/* shared_options.h: options that several commands share, for the tables of commands. */
#ifndef MORPHOCTL_SHARED_OPTIONS_H
#define MORPHOCTL_SHARED_OPTIONS_H

#include "ctl.h"

#define CONTROLLER                                                                                 \
  "controller", 'c', "NAME", "Controller: a name or sha256:<64 digits> (default: default).",       \
      "controller"
#define PRECISION                                                                                  \
  "precision", 0, "float32|float64", "Precision of the simulation (default: float32).", "precision"
#define PHYSICS                                                                                    \
  "physics", 'p', "KEY=VALUE|paper",                                                               \
      "One physics setting, e.g. dt_s=0.001; can be repeated. paper: all of the paper's settings."
#define ENVIRONMENTS                                                                               \
  "environments", 'e', "SET|FILE",                                                                 \
      "paper-test (default), a set of morpho-12 such as morpho-12-walk, or a JSON file with a "    \
      "list "                                                                                      \
      "of environments; - is standard input."
#define TASK                                                                                       \
  "task", 't', "TASK",                                                                             \
      "A task of the suite morpho-12, such as walk, in its ten worlds to select with: short for "  \
      "-e morpho-12-TASK."
#define WEIGHT                                                                                     \
  "weight", 0, "X",                                                                                \
      "Share of the cores relative to other batch jobs, 0.001 to 1000 (default: 1).", "weight",    \
      FIELD_REAL
#define DEVICE                                                                                     \
  "device", 0, "auto|cpu|cuda",                                                                    \
      "Where to run: CPU, GPU, or GPU if available and worthwhile (default: auto).", "device"
#define KEY(job)                                                                                   \
  "idempotency-key", 0, "KEY",                                                                     \
      "A repeated request with the same key returns the same " job " (default: a new key)."
#define VARY(place)                                                                                \
  "vary", 0, "NAME=LOW:HIGH",                                                                      \
      "Learn in worlds that vary, drawn from a range, e.g. friction=0.5:1.2; NAME: a factor "      \
      "(stiffness, mass, drag, gravity, actuation or friction), drop_m or slope_degrees; can be "  \
      "repeated.",                                                                                 \
      place, FIELD_RANGES
/* Options of films: how they are drawn; and options for the film of an evaluation. */
#define LOOK                                                                                       \
  {"size", 0, "WxH", "Pixels of the film or picture (default: 960x540)."},                         \
      {"light", 0, NULL, "Draw on a bright background (default: dark)."},                          \
      {"yaw", 0, "DEGREES", "Rotation of the camera away from the light (default: 20)."},          \
      {"pitch", 0, "DEGREES", "Height of the camera above the horizon (default: 23)."},            \
  {                                                                                                \
    "distance", 0, "M", "Distance of the camera in meters (default: 2.2)."                         \
  }
#define RATE                                                                                       \
  {                                                                                                \
    "rate", 0, "FPS", "Frames per second of a film (default: 25)."                                 \
  }
#define FILM                                                                                       \
  {"film", 0, "FILE",                                                                              \
   "Then draw the recordings of up to 16 designs, the best ones if there are more: film.mp4 (or "  \
   "another that ffmpeg makes), film.y4m, or a folder that ends with / for PNG files."},           \
      {"environment", 0, "N", "Which of the environments the film shows, from 0 (default: 0)."},   \
      LOOK, RATE
/* How to treat invalid designs. */
#define RULES(place)                                                                               \
  {"on-fault", 0, "refuse|skip",                                                                   \
   "How to treat an invalid design: refuse the request, or skip the design (default: refuse).",    \
   place "on_fault"},                                                                              \
  {                                                                                                \
    "repair", 0, "none|largest",                                                                   \
        "Body in several pieces: reject it, or keep the largest piece (default: none).",           \
        place "repair"                                                                             \
  }
#define LABEL      "label", 'l', "TEXT", "A label to find the job by.", "label"
#define EXPERIMENT "experiment", 0, "NAME", "Experiment that the job belongs to.", "experiment"
/* Options for both commands that start long jobs. */
#define OF_LONG_JOBS(job, command)                                                                 \
  {"priority", 0, "interactive|batch", "Default: batch.", "priority"}, {WEIGHT}, {DEVICE},         \
      {LABEL}, {EXPERIMENT},                                                                       \
      {"watch", 'w', NULL, "Watch it until it ends, as " command " watch does."},                  \
  {                                                                                                \
    KEY(job)                                                                                       \
  }
/* Options of lists. */
#define STATE(jobs)                                                                                \
  "state", 0, "STATE",                                                                             \
      "Only " jobs " that are queued, running, paused, succeeded, failed or cancelled."
#define LABELED       "label", 'l', "TEXT", "Only jobs with this label; a final * matches anything."
#define SEARCHED      "search", 0, "TEXT", "Only jobs whose label contains this text."
#define OF_EXPERIMENT "experiment", 0, "NAME", "Only jobs of this experiment."
#define FILTERED                                                                                   \
  {LABELED}, {SEARCHED}, {OF_EXPERIMENT},                                                          \
  {                                                                                                \
    "archived", 0, "true|all", "true: only archived jobs; all: archived and others."               \
  }
#define OF_USER   "submitted-by", 0, "NAME", "Only jobs submitted with this token."
#define NEWEST    "limit", 'n', "N", "Maximum number, newest first (default: 50)."
#define UNLIMITED "all", 'a', NULL, "No limit."

#endif
