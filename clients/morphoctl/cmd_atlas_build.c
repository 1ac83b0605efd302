/* cmd_atlas_build.c: atlas build: scores all bodies, as a job of the server. */
#include <string.h>

#include "commands.h"

void run_atlas_build(struct ctl *ctl)
{
  const bool wait = option_is_set(ctl, "wait");
  if (!option_is_set(ctl, "voxels"))
    fail(STATUS_USAGE, "--voxels N is required: the maximum number of voxels in a body, 1 to 10");
  json_t *request = keep(json_object());
  request_fill(ctl, request);
  request_fill_measures(ctl, request);
  const json_t *job = post_job(ctl, "/v1/atlases", request, 0);
  if (wait) {
    await_job(ctl, job, "atlas");
    job = get_json(ctl, "/v1/jobs/%s", text_of(job, "id"));
  }
  if (ctl->json)
    print_json(job);
  else
    print_from(stdout, job, wait ? "{atlas.name}" : "{id}");
  if (wait) {
    expect_success("job", job);
    if (!ctl->json && !ctl->quiet)
      print_from(stderr, job,
                 "atlas {atlas.name}: {atlas.bodies_done:,} [{atlas.bodies_done=1}body|bodies], "
                 "{atlas.rollouts_done:,} rollout{atlas.rollouts_done:s}");
  } else if (!ctl->json && !ctl->quiet) {
    print_from(stderr, job,
               "job {id} accepted; it builds the atlas {atlas.name}: morphoctl watch {id}");
  }
}
