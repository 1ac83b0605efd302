/* measures.c: the names of the measures, and functions of their values. */
#include "world/measures.h"

#include <math.h>

const struct mo_measure_info mo_measure_info[MO_MEASURES] = {
    {"displacement_m", "m", "Horizontal distance of the center of mass, from start to end.", 1e6},
    {"path_length_m", "m", "Length of the horizontal path of the center of mass.", 1e6},
    {"mean_speed_m_per_s", "m/s", "Path length over the time of the rollout.", 1e6},
    {"straightness", "", "Displacement over path length.", 1e6},
    {"heading_error_rad", "rad", "Angle from the direction to the light to the displacement.", 1e6},
    {"sideways_m", "m", "Displacement to the left of the direction to the light.", 1e6},
    {"peak_height_m", "m", "Largest height of the center of mass above the terrain.", 1e6},
    {"mean_height_m", "m", "Mean height of the center of mass above the terrain.", 1e6},
    {"tilt_rad", "rad", "Angle from the vertical to the body's up axis at the end.", 1e6},
    {"yaw_rate_rad_per_s", "rad/s", "Mean rate at which the body turns left.", 1e6},
    {"air_share", "", "Share of the steps in which the body does not touch the ground.", 1e6},
    {"contact_front_share", "", "Share of the contacts that the body's front half has.", 1e6},
    {"contact_back_share", "", "Share of the contacts that the body's back half has.", 1e6},
    {"contact_left_share", "", "Share of the contacts that the body's left half has.", 1e6},
    {"contact_right_share", "", "Share of the contacts that the body's right half has.", 1e6},
    {"hops_per_s", "1/s", "How often the body leaves the ground, per second.", 1e6},
    {"work_j", "J", "Positive work of the actuators on the springs.", 1e3},
    {"cost_of_transport", "", "Work over weight and path length.", 1e6},
    {"peak_strain", "", "Largest strain of a spring.", 1e6},
    {"inverted_voxels", "",
     "Largest number of voxels that are inside out at two consecutive instants.", 1},
};

double mo_measure_round(unsigned measure, double value)
{
  const double steps = mo_measure_info[measure].steps_in_one;
  return rint(value * steps) / steps + 0.0; /* + 0.0, so that it is never −0 */
}

bool mo_measure_is_round(unsigned measure, double value)
{
  return isfinite(value) && mo_measure_round(measure, value) == value;
}

uint32_t mo_measures_flags(const double measures[MO_MEASURES])
{
  uint32_t flags = 0;
  if (measures[MO_MEASURE_PEAK_STRAIN] > MO_PEAK_STRAIN_BOUND)
    flags |= MO_FLAG_OVERSTRAINED;
  if (measures[MO_MEASURE_INVERTED_VOXELS] > 0)
    flags |= MO_FLAG_INVERTED;
  return flags;
}
