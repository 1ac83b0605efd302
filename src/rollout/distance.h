/* distance.h: the length of a vector in the plane, with the same bits everywhere. */
#ifndef MORPHO_ROLLOUT_DISTANCE_H
#define MORPHO_ROLLOUT_DISTANCE_H

/* Returns the length of (dx, dy), accurate to one unit in the last place. The hypot functions of C
 * libraries may differ from each other in that place. This function has the same bits everywhere,
 * because losses and the clipping during training depend on them. */
double mo_distance(double dx_m, double dy_m);

#endif
