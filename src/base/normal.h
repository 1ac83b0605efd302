/* normal.h: quantiles of the normal distribution, without libm so that all machines compute the
 * same bits. */
#ifndef MORPHO_BASE_NORMAL_H
#define MORPHO_BASE_NORMAL_H

/* Returns the natural logarithm of a positive, finite, normal double; error below 2 ulp. */
double mo_natural_log(double x);

/* Returns z with P(N(0, 1) < z) = p, for 0 < p < 1, to about 1e-16 relative. */
double mo_normal_quantile(double p);

#endif
