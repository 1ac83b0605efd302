/* slurm.h: what Slurm says of the job that this process belongs to. */
#ifndef MORPHO_DAEMON_SLURM_H
#define MORPHO_DAEMON_SLURM_H

#include <stdint.h>

/* Returns when the job's time ends: seconds since 1970; 0: unknown, or it has no limit. */
int64_t slurm_job_end_s(void);

#endif
