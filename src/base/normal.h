/* normal.h: quantiles of the normal distribution without libm, so that every machine computes the
 * same bits. */
#ifndef MORPHO_BASE_NORMAL_H
#define MORPHO_BASE_NORMAL_H

/* Natural logarithm of a positive, finite, normal double: error below 2 ulp. */
double mo_natural_log(double x);

/* z with P(N(0, 1) < z) = p, 0 < p < 1, to about 1e-16 relative. */
double mo_normal_quantile(double p);

#endif
