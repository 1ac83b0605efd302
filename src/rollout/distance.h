/* distance.h: the length of a vector in the plane, with the same bits everywhere. */
#ifndef MORPHO_ROLLOUT_DISTANCE_H
#define MORPHO_ROLLOUT_DISTANCE_H

/* Returns the length of (dx, dy), within one unit of the last place. C libraries' hypot may differ
 * in that place; this has the same bits everywhere, on which losses and the clipping of a training
 * depend. */
double mo_distance(double dx_m, double dy_m);

#endif
