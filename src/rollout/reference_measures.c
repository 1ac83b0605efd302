/* reference_measures.c: observes the float64 rollout for the measures, by the definitions in
 * docs/model.md. */
#include "rollout/reference_measures.h"

#include "rollout/damage.h"
#include "rollout/scene.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

static void pose_of(const struct mo_reference_measures *m, const struct mo_body *body,
                    const double *position_m, struct mo_pose *pose)
{
  mo_scene_com(position_m, body->n_masses, pose->com_m);
  pose->turn[0] = pose->turn[1] = 0;
  for (uint32_t i = 0; i < body->n_masses; i++) {
    const double *p = position_m + 3 * (size_t)i, *row = m->rows[i];
    pose->turn[0] += row[0] * p[0] + row[1] * p[1];
    pose->turn[1] += row[0] * p[1] - row[1] * p[0];
  }
}

/* Begins the observer, or continues that of a state. */
static void begin(struct mo_reference_measures *m, const struct mo_reference *r,
                  const struct mo_state *from)
{
  struct mo_pose pose;
  mo_window_observer(&r->window, from, r->begun, r->body, r->environment, r->physics,
                     r->com_start_m, &m->observer);
  if (from == NULL)
    return;
  m->touches = memchr(from->contacts, 1, from->n_masses) != NULL;
  if (r->begun < r->window.first_step) {
    for (uint32_t v = 0; v < from->n_voxels; v++)
      m->inverted[v] = from->inverted[v] != 0;
    return;
  }
  pose_of(m, r->body, r->position_m, &pose);
  mo_observer_pose(&m->observer, &pose);
}

int mo_reference_measures_init(struct mo_reference_measures *measures,
                               struct mo_reference *reference, const struct mo_state *from,
                               const struct mo_measuring *measuring)
{
  const struct mo_body *body = reference->body;
  *measures = (struct mo_reference_measures){0};
  const bool wanted = measuring != NULL && measuring->set != 0;
  measures->set = mo_task_measures(&reference->environment->task);
  if (wanted) {
    measures->set |= measuring->set;
    measures->wanted = measuring->set;
    measures->values = measuring->values[0];
  }
  if (measures->set == 0)
    return MO_OK;
  reference->works = true;
  measures->rows = calloc(body->n_masses, sizeof(*measures->rows));
  measures->halves = calloc(body->n_masses, sizeof(*measures->halves));
  measures->inverted = calloc(body->n_voxels, sizeof(*measures->inverted));
  if (measures->rows == NULL || measures->halves == NULL || measures->inverted == NULL)
    return MO_ERR_NO_MEMORY;
  mo_measuring_frame(body, measures->rows);
  mo_measuring_halves(body, measures->halves);
  begin(measures, reference, from);
  return MO_OK;
}

void mo_reference_measures_done(struct mo_reference_measures *measures)
{
  free(measures->rows);
  free(measures->halves);
  free(measures->inverted);
  *measures = (struct mo_reference_measures){0};
}

/* Observes the strain of the springs. */
static void observe_springs(struct mo_reference_measures *m, const struct mo_reference *r,
                            const double *position_m, uint32_t step)
{
  const struct mo_body *body = r->body;
  for (uint32_t s = 0; s < body->n_springs; s++) {
    if (mo_damage_lasts(r->cut, r->cut_step, step, s))
      continue;
    const double *a = position_m + 3 * (size_t)body->spring_a[s],
                 *b = position_m + 3 * (size_t)body->spring_b[s], rest = body->spring_rest_m[s];
    const double d[3] = {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
    const double length = sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
    m->observer.strain = fmax(m->observer.strain, fabs(length / rest - 1));
  }
}

/* Counts the voxels whose mean edges along x, y and z are left-handed now and were at the previous
 * instant. */
static void observe_voxels(struct mo_reference_measures *m, const struct mo_body *body,
                           const double *position_m)
{
  uint32_t count = 0;
  for (uint32_t v = 0; v < body->n_voxels; v++) {
    double e[3][3] = {{0}};
    for (uint32_t k = 0; k < 8; k++) {
      const double *p = position_m + 3 * (size_t)body->voxel_mass[8 * (size_t)v + k];
      for (uint32_t edge = 0; edge < 3; edge++)
        for (int axis = 0; axis < 3; axis++)
          e[edge][axis] += (k >> (2 - edge) & 1) != 0 ? p[axis] : -p[axis];
    }
    const double volume = e[0][0] * (e[1][1] * e[2][2] - e[1][2] * e[2][1]) +
                          e[0][1] * (e[1][2] * e[2][0] - e[1][0] * e[2][2]) +
                          e[0][2] * (e[1][0] * e[2][1] - e[1][1] * e[2][0]);
    count += volume < 0 && m->inverted[v];
    m->inverted[v] = volume < 0;
  }
  if (count > m->observer.inverted)
    m->observer.inverted = count;
}

static void observe_contacts(struct mo_reference_measures *m, const struct mo_reference *r)
{
  for (uint32_t i = 0; i < r->body->n_masses; i++)
    if (r->contacts[i] != 0) {
      m->observer.contacts++;
      m->observer.front_2 += m->halves[i][0];
      m->observer.left_2 += m->halves[i][1];
    }
}

void mo_reference_observe(struct mo_reference_measures *measures,
                          const struct mo_reference *reference, uint32_t step)
{
  struct mo_reference_measures *m = measures;
  const struct mo_reference *r = reference;
  if (m->set == 0)
    return;
  const bool touches = memchr(r->contacts, 1, r->body->n_masses) != NULL;
  m->observer.air_steps += !touches;
  m->observer.hops += m->touches && !touches;
  m->touches = touches;
  if (step % r->control_steps != 0)
    return;
  const double *position_m = r->tape->position_m; /* at the start of the step */
  struct mo_pose pose;
  pose_of(m, r->body, position_m, &pose);
  if (step > r->begun)
    mo_observe(&m->observer, &pose);
  observe_springs(m, r, position_m, step);
  observe_voxels(m, r->body, position_m);
  observe_contacts(m, r);
}

const double *mo_reference_measures_finish(struct mo_reference_measures *measures,
                                           const struct mo_reference *reference,
                                           const struct mo_outcome *outcome)
{
  struct mo_reference_measures *m = measures;
  if (m->set == 0)
    return NULL;
  struct mo_pose pose;
  double up[3] = {0, 0, 0};
  pose_of(m, reference->body, reference->position_m, &pose);
  mo_observe(&m->observer, &pose);
  for (uint32_t i = 0; i < reference->body->n_masses; i++)
    for (int axis = 0; axis < 3; axis++)
      up[axis] += m->rows[i][2] * reference->position_m[3 * (size_t)i + (size_t)axis];
  m->observer.work_j = reference->work_j;
  mo_observer_finish(&m->observer, outcome->diverged_step != 0, up, m->observed);
  if (m->values != NULL)
    mo_measures_round(m->wanted, m->observed, m->values);
  return m->observed;
}

void mo_reference_measures_save(const struct mo_reference_measures *measures, unsigned observed,
                                struct mo_state *to)
{
  const struct mo_observer *o = &measures->observer;
  struct mo_state_tally *t = &to->tally;
  mo_window_save_observer(o, observed, t);
  if (measures->set == 0)
    return;
  if ((observed & MO_OBSERVE_SPRINGS) != 0) {
    t->strain = o->strain;
    t->strain_square = o->strain * o->strain;
  }
  for (uint32_t v = 0; (observed & MO_OBSERVE_VOXELS) != 0 && v < to->n_voxels; v++)
    to->inverted[v] = measures->inverted[v];
}
