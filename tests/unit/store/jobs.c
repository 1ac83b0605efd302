/* jobs.c: stored jobs: keys, states, events, recordings. Whether requests are read back unchanged,
 * also in pages, is tested over HTTP; the cost of pages is tested in lists.c. */
#include "by_hand.h"
#include "one_store.h"

static void answers_a_repeated_key(void)
{
  struct mo_evaluation_request submission = draw_evaluation(3, 1);
  int64_t id = 0, again = 0;
  bool replayed;
  submission.job.key.text = "key-1";
  mo_sha256_of("body", 4, &submission.job.key.sha256);
  CHECK_OK(mo_store_submit(store, &submission, &id, &replayed));
  CHECK(!replayed);
  CHECK_OK(mo_store_submit(store, &submission, &again, &replayed));
  CHECK(replayed && again == id);
  CHECK_OK(mo_store_replay(store, &submission.job.key, &again));
  CHECK_INT(
      mo_store_replay(store, &(struct mo_request_key){"key-2", submission.job.key.sha256}, &again),
      MO_ERR_NOT_FOUND);
  mo_sha256_of("other", 5, &submission.job.key.sha256);
  CHECK_INT(mo_store_submit(store, &submission, &again, &replayed), MO_ERR_CONFLICT);
  CHECK_INT(mo_store_replay(store, &submission.job.key, &again), MO_ERR_CONFLICT);
  /* Keys expire. */
  REQUIRE_OK(reopen_after("UPDATE idempotency_keys SET created_us=created_us-90000000000"));
  for (int i = 0; i < 1200; i++) { /* enough events to trigger pruning */
    enum mo_job_state before;
    CHECK_OK(
        mo_store_change_job(store, id, i % 2 == 0 ? MO_CHANGE_PAUSE : MO_CHANGE_RESUME, &before));
  }
  usleep(50000);
  CHECK_INT(mo_store_replay(store, &submission.job.key, &again), MO_ERR_NOT_FOUND);
}

static void changes_states(void)
{
  struct mo_evaluation_request submission = draw_evaluation(4, 1);
  struct mo_job job;
  enum mo_job_state before;
  struct mo_job_update update = {.step = MO_STEP_START};
  struct mo_save save = {.updates = &update, .n_updates = 1};
  int64_t id = submit_evaluation(&submission);
  update.job = id;
  CHECK_INT(mo_store_change_job(store, 99, MO_CHANGE_PAUSE, &before), MO_ERR_NOT_FOUND);
  CHECK_OK(mo_store_change_job(store, id, MO_CHANGE_RESUME, &before));
  CHECK_INT(before, MO_JOB_QUEUED);
  CHECK_OK(mo_store_change_job(store, id, MO_CHANGE_PAUSE, &before));
  CHECK_OK(save_and_wait(&save));
  CHECK(!update.applied); /* a paused job does not start */
  CHECK_OK(mo_store_change_job(store, id, MO_CHANGE_PAUSE, &before));
  CHECK_INT(before, MO_JOB_PAUSED);
  CHECK_OK(mo_store_change_job(store, id, MO_CHANGE_RESUME, &before));
  CHECK_OK(save_and_wait(&save));
  CHECK(update.applied);
  job = job_of(id);
  CHECK_INT(job.state, MO_JOB_RUNNING);
  CHECK(job.started_us > 0);
  /* After an error of the runner, a job is retried twice, then parked. */
  update.step = MO_STEP_RETRY;
  update.error = MO_ERR_NO_MEMORY;
  update.max_attempts = 2;
  snprintf(update.error_text, sizeof(update.error_text), "ran out");
  CHECK_OK(save_and_wait(&save));
  CHECK_INT(update.state, MO_JOB_QUEUED);
  update.step = MO_STEP_START;
  CHECK_OK(save_and_wait(&save));
  update.step = MO_STEP_RETRY;
  CHECK_OK(save_and_wait(&save));
  CHECK_INT(update.state, MO_JOB_FAILED);
  job = job_of(id);
  CHECK_INT(job.attempts, 2);
  CHECK_INT(job.error, MO_ERR_NO_MEMORY);
  CHECK_TEXT(job.error_text, "ran out");
  CHECK(job.finished_us > 0);
  CHECK_INT(mo_store_change_job(store, id, MO_CHANGE_CANCEL, &before), MO_ERR_CONFLICT);
  /* A job that another opening of the store started cannot be ended by this one. */
  id = submit_evaluation(&submission);
  update = (struct mo_job_update){.job = id, .step = MO_STEP_START};
  CHECK_OK(save_and_wait(&save));
  REQUIRE_OK(reopen());
  update.step = MO_STEP_SUCCEED;
  CHECK_OK(save_and_wait(&save));
  CHECK(!update.applied);
  /* The process restarts after a crash, and the marker blames the job. */
  CHECK_OK(mo_store_requeue(store, id, 3, "signal 11"));
  job = job_of(id);
  CHECK_INT(job.state, MO_JOB_QUEUED);
  CHECK_INT(job.attempts, 1);
  for (int i = 0; i < 2; i++) {
    update.step = MO_STEP_START;
    CHECK_OK(save_and_wait(&save));
    CHECK(update.applied);
    CHECK_OK(mo_store_requeue(store, i == 0 ? 0 : id, 2, "signal 11"));
  }
  job = job_of(id);
  CHECK_INT(job.state, MO_JOB_FAILED);
  CHECK_TEXT(job.error_text, "signal 11");
}

/* Only a job that has ended can report that all rollouts diverged. */
static void warns_of_divergence(void)
{
  struct mo_evaluation_request submission = draw_evaluation(4, 1);
  const int64_t id = submit_evaluation(&submission);
  struct mo_job_update updates[] = {
      {.job = id, .step = MO_STEP_START},
      {.job = id, .step = MO_STEP_PROGRESS, .done = 16, .diverged = 16, .total = 100},
      {.job = id, .step = MO_STEP_SUCCEED, .done = 100, .diverged = 100, .total = 100}};
  struct mo_save save = {.updates = updates, .n_updates = 2};
  CHECK_OK(save_and_wait(&save));
  struct mo_job job = job_of(id);
  REQUIRE(job.n_warnings == 1);
  CHECK_TEXT(job.warnings[0].code, "diverged");
  CHECK_HAS(job.warnings[0].detail, "16 of 16 rollouts so far diverged");
  save = (struct mo_save){.updates = &updates[2], .n_updates = 1};
  CHECK_OK(save_and_wait(&save));
  job = job_of(id);
  REQUIRE(job.n_warnings == 1);
  CHECK_TEXT(job.warnings[0].code, "all_diverged");
  CHECK_HAS(job.warnings[0].detail, "every rollout diverged (100)");
}

static void warns_of_acting_in_every_step(void)
{
  struct mo_physics physics = mo_default_physics();
  struct mo_warning warnings[MO_PHYSICS_WARNINGS_MAX];
  REQUIRE(mo_warn_of_physics(&physics, warnings) == 1);
  CHECK_TEXT(warnings[0].code, "every_step");
  CHECK(warnings[0].of_request);
  CHECK_HAS(warnings[0].detail, "acts at every step of 0.002 s; ");
  physics.scheme.control_period_s = MO_DEFAULT_CONTROL_PERIOD_S;
  CHECK_INT(mo_warn_of_physics(&physics, warnings), 0);
  physics = mo_paper_physics();
  physics.scheme.integrator = MO_INTEGRATOR_SPLIT;
  CHECK_INT(mo_warn_of_physics(&physics, warnings), 0);
}

/* Only a time step of the request with the default number of steps changes the duration by
 * accident. */
static void warns_of_other_durations(void)
{
  struct mo_physics physics = mo_default_physics();
  struct mo_warning warnings[MO_PHYSICS_WARNINGS_MAX];
  physics.scheme.control_period_s = MO_DEFAULT_CONTROL_PERIOD_S;
  physics.scheme.dt_s = 0.001;
  REQUIRE(mo_warn_of_physics(&physics, warnings) == 1);
  CHECK_TEXT(warnings[0].code, "other_duration");
  CHECK(warnings[0].of_request);
  CHECK_TEXT(warnings[0].detail,
             "with dt_s 0.001, the default n_steps of 2000 makes rollouts last 2 s instead of 4 s; "
             "to keep the duration, set n_steps to 4000");
  physics.scheme.n_steps = 4000;
  CHECK_INT(mo_warn_of_physics(&physics, warnings), 0);
  physics = mo_paper_physics();
  physics.scheme.dt_s = 0.003;
  REQUIRE(mo_warn_of_physics(&physics, warnings) == 1);
  CHECK_HAS(warnings[0].detail, "default n_steps of 1000 makes rollouts last 3 s instead of 4 s");
  physics.scheme.n_steps = 10; /* clearly on purpose */
  CHECK_INT(mo_warn_of_physics(&physics, warnings), 0);
}

/* The longest warning fits, and its step is below the bound, rounded to two digits. */
static void warns_of_unstable_steps(void)
{
  struct mo_physics physics = mo_paper_physics();
  struct mo_warning warnings[MO_PHYSICS_WARNINGS_MAX], *const warning = warnings;
  CHECK_INT(mo_warn_of_physics(&physics, warnings), 0);
  physics.scheme.dt_s = 1.23456e-5;
  physics.constants.stiffness_n_per_m = 1.23456e8;
  physics.constants.mass_kg = 1.23456e-5;
  physics.constants.drag_per_s = 1234.56;
  physics.scheme.integrator = MO_INTEGRATOR_SPLIT;
  REQUIRE(mo_warn_of_physics(&physics, warnings) == 2);
  CHECK_TEXT(warning->code, "unstable_step");
  CHECK(warning->of_request);
  CHECK_TEXT(
      warning->detail,
      "dt_s 1.23456e-05 exceeds the linear stability bound of 1.83e-07 for "
      "stiffness_n_per_m 1.23456e+08, mass_kg 1.23456e-05, drag_per_s 1234.56 and integrator "
      "split: expect bodies to blow up; use a dt_s of at most 1.4e-07");
  CHECK(strlen(warning->detail) <= 230);
  physics = mo_paper_physics();
  const double bound = mo_stable_step_s(&physics, MO_EIGENVALUE_MAX);
  physics.scheme.n_steps = 999;
  physics.scheme.dt_s = 0.999 * bound;
  CHECK_INT(mo_warn_of_physics(&physics, warnings), 0);
  physics.scheme.dt_s = 1.001 * bound;
  CHECK_INT(mo_warn_of_physics(&physics, warnings), 1);
  CHECK_HAS(warning->detail, "bound of 0.00463 for");
  CHECK_HAS(warning->detail, "at most 0.0037");
}

struct received {
  int64_t sequences[64];
  size_t n;
};

static void receive_events(void *context, const struct mo_event *events, size_t n)
{
  struct received *received = context;
  for (size_t i = 0; i < n && received->n < 64; i++)
    received->sequences[received->n++] = events[i].sequence;
}

static void reports_changes(void)
{
  struct mo_evaluation_request submission = draw_evaluation(4, 1);
  struct received received = {.n = 0};
  struct mo_event events[32];
  int64_t id, oldest, newest, n;
  int handle;
  CHECK_OK(mo_store_subscribe(store, receive_events, &received, &handle));
  id = submit_evaluation(&submission);
  REQUIRE_OK(run_by_hand(id, made_up_loss));
  mo_store_unsubscribe(store, handle);
  id = submit_evaluation(&submission);
  CHECK_INT(received.n, 3);
  n = mo_store_events(store, 0, 0, events, 32, &oldest, &newest);
  REQUIRE(n == 5); /* the events: the controller, then created, started, finished, created */
  CHECK_TEXT(events[0].type, "controller.stored");
  CHECK_TEXT(events[1].type, "job.created");
  CHECK_TEXT(events[2].type, "job.started");
  CHECK_TEXT(events[3].type, "job.finished");
  CHECK_HAS(events[3].data, "\"succeeded\"");
  for (size_t i = 0; i < 3; i++)
    CHECK_INT(received.sequences[i], events[i + 1].sequence);
  CHECK_INT(oldest, events[0].sequence);
  CHECK_INT(newest, events[4].sequence);
  CHECK_INT(mo_store_events(store, events[1].sequence, 1, events, 32, NULL, NULL), 2);
  CHECK_INT(mo_store_events(store, newest, 0, events, 32, NULL, NULL), 0);
  /* After pruning, the oldest remaining event is reported. */
  mo_store_close(store);
  struct mo_store_config config =
      (struct mo_store_config){.path = fixture.path, .events_kept = 100};
  REQUIRE_OK(mo_store_open(&config, &store, NULL));
  for (int i = 0; i < 1200; i++)
    CHECK_OK(mo_store_change_job(store, id, i % 2 == 0 ? MO_CHANGE_PAUSE : MO_CHANGE_RESUME, NULL));
  usleep(50000);
  n = mo_store_events(store, 0, 0, events, 32, &oldest, &newest);
  CHECK(n == 32 && oldest > 900 && newest == 1205);
  CHECK_INT(events[0].sequence, oldest);
}

static void keeps_trajectories(void)
{
  struct mo_evaluation_request submission = draw_evaluation(4, 2);
  struct mo_trajectory *trajectory = NULL;
  double com[9] = {1, -0.0, NAN, 4, 5, 6, 7, 8, 9};
  float mass[18] = {0.1F, -0.0F, NAN};
  int8_t actuation[3] = {0, -127, 127};
  uint8_t contacts[6] = {0, 0, 1};
  struct mo_saved_trajectory saved = {.design_position = 1,
                                      .environment_position = 4,
                                      .frames = 3,
                                      .n_masses = 2,
                                      .n_springs = 1,
                                      .recording = {500, com, mass, actuation, contacts}};
  struct mo_save save = {.trajectories = &saved, .n_trajectories = 1};
  submission.record = (1U << MO_CHANNELS) - 1;
  int64_t id = submit_evaluation(&submission);
  saved.job = id;
  CHECK_OK(save_and_wait(&save));
  CHECK_INT(mo_store_trajectory(store, id, 1, 3, &trajectory), MO_ERR_NOT_FOUND);
  REQUIRE_OK(mo_store_trajectory(store, id, 1, 4, &trajectory));
  CHECK(memcmp(trajectory->recording.com_m, com, sizeof(com)) == 0);
  CHECK(memcmp(trajectory->recording.mass_m, mass, sizeof(mass)) == 0);
  CHECK(memcmp(trajectory->recording.actuation, actuation, sizeof(actuation)) == 0);
  CHECK(memcmp(trajectory->recording.contacts, contacts, sizeof(contacts)) == 0);
  CHECK(trajectory->recording.stride == 500 && trajectory->n_frames == 3);
  CHECK(trajectory->n_masses == 2 && trajectory->n_springs == 1 && trajectory->dt_s == 0.004);
  mo_trajectory_free(trajectory);
}

/* Only two of four recordings fit. The first is kept, because its evaluation has not ended. */
static void removes_the_oldest_recordings(void)
{
  struct mo_evaluation_request submission = draw_evaluation(4, 2);
  struct mo_trajectory *trajectory = NULL;
  struct mo_store_stats stats;
  double com[9] = {1};
  struct mo_saved_trajectory saved = {
      .frames = 3, .n_masses = 2, .recording = {.stride = 500, .com_m = com}};
  struct mo_save save = {.trajectories = &saved, .n_trajectories = 1};
  int64_t ids[4];
  uint64_t bytes = 0;
  REQUIRE_OK(reopen_with((struct mo_store_config){.max_recordings_bytes = 200}));
  submission.record = MO_RECORD_COM;
  for (int i = 0; i < 4; i++) {
    ids[i] = saved.job = submit_evaluation(&submission);
    CHECK_OK(save_and_wait(&save));
    CHECK_OK(save_and_wait(&save)); /* again present */
    CHECK_INT(job_of(ids[i]).recorded_bytes, sizeof(com));
    if (i > 0)
      CHECK_OK(change(ids[i], MO_CHANGE_CANCEL));
  }
  for (int i = 0; i < 500; i++) {
    mo_store_get_stats(store, &stats);
    if (stats.recordings_removed == 2)
      break;
    usleep(10000);
  }
  CHECK_INT(stats.recordings_removed, 2);
  CHECK_INT(stats.recordings_removed_bytes, 2 * sizeof(com));
  for (int i = 0; i < 4; i++) {
    const bool removed = i == 1 || i == 2;
    CHECK_INT(mo_store_trajectory(store, ids[i], 0, 0, &trajectory),
              removed ? MO_ERR_NOT_FOUND : MO_OK);
    if (!removed)
      mo_trajectory_free(trajectory);
    const struct mo_job job = job_of(ids[i]);
    CHECK_INT(job.recorded_bytes, removed ? 0 : sizeof(com));
    CHECK((job.recordings_removed_us > 0) == removed);
  }
  CHECK_INT(mo_store_trajectories_remove(store, ids[0], &bytes), MO_ERR_CONFLICT);
  CHECK_INT(mo_store_trajectories_remove(store, 99, &bytes), MO_ERR_NOT_FOUND);
  for (int i = 0; i < 2; i++) {
    CHECK_OK(mo_store_trajectories_remove(store, ids[3], &bytes));
    CHECK_INT(bytes, i == 0 ? sizeof(com) : 0);
  }
  CHECK_INT(mo_store_trajectory(store, ids[3], 0, 0, &trajectory), MO_ERR_NOT_FOUND);
}

static const struct check_case cases[] = {
    {"answers a repeated key with the same job", answers_a_repeated_key},
    {"changes states only as the machine allows", changes_states},
    {"warns of divergence", warns_of_divergence},
    {"warns of acting in every step", warns_of_acting_in_every_step},
    {"warns of other durations", warns_of_other_durations},
    {"warns of unstable steps", warns_of_unstable_steps},
    {"reports changes, in order, and prunes", reports_changes},
    {"keeps trajectories", keeps_trajectories},
    {"removes the oldest recordings", removes_the_oldest_recordings},
};
CHECK_MAIN_AROUND(cases, with_a_store)
