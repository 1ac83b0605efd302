/* runs.h: the commands, each a function in a cmd_*.c file; table_of_commands.c lists them. */
#ifndef MORPHOCTL_RUNS_H
#define MORPHOCTL_RUNS_H

#include "ctl.h"

command_function run_eval, run_verify, run_design_show, run_design_draw, run_design_random,
    run_design_made /* mutate, cross, canonical */, run_job_show,
    run_job_change /* cancel, pause, resume */, run_job_weight, run_job_prune, run_job_text,
    run_job_archive, run_job_delete, run_usage, run_watch, run_wait, run_train_start, run_live_show,
    run_live_watch, run_atlas_build, run_atlas_list, run_atlas_show, run_atlas_body,
    run_atlas_neighbors, run_atlas_ascent, run_atlas_similar, run_atlas_best, run_atlas_optima,
    run_atlas_histogram, run_atlas_map, run_atlas_compare, run_atlas_download, run_atlas_upload,
    run_atlas_delete, run_train_export, run_train_each, run_train_compare, run_campaign_start,
    run_campaign_extend, run_campaign_compare, run_campaign_champions, run_campaign_export,
    run_controller_info, run_controller_get, run_controller_put, run_controller_delete, run_list,
    run_status, run_devices, run_version, run_completion, run_film, run_picture, run_dashboard,
    run_export, run_study_ask, run_study_tell, run_study_sampler, run_study_finish,
    run_bundle_export, run_bundle_import, run_bundle_verify, run_scores_export, run_scores_import,
    run_fleet, run_fleet_drain, run_fleet_verify, run_certify, run_certificate,
    run_fleet_launch /* slurm, systemd, kubernetes */;

#endif
