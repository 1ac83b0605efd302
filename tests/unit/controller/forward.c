/* forward.c: the network against closed forms, and against itself on subsets of springs. */
#include "../make.h"

#include "controller/tape.h"
#include <morpho/random.h>

/* Long double, in textbook order: an independent computation of the same numbers. */
static void textbook(const struct mo_controller *c, const double *inputs, double *outputs)
{
  long double x[1024], y[1024];
  uint32_t width = c->n_inputs;
  for (uint32_t j = 0; j < width; j++)
    x[j] = (long double)inputs[j];
  for (int l = 0; l < 4; l++) {
    const uint32_t n = l < 3 ? 256 : c->n_springs;
    for (uint32_t i = 0; i < n; i++) {
      y[i] = (long double)c->bias[l][i];
      for (uint32_t j = width; j-- > 0;)
        y[i] += (long double)c->weight[l][(size_t)i * width + j] * x[j];
    }
    if (l == 3)
      break;
    long double mean = 0, variance = 0;
    for (uint32_t i = 0; i < n; i++)
      mean += y[i] / n;
    for (uint32_t i = 0; i < n; i++)
      variance += (y[i] - mean) * (y[i] - mean) / n;
    for (uint32_t i = 0; i < n; i++) {
      const long double z =
          (y[i] - mean) / sqrtl(variance + 1e-5L) * (long double)c->norm_gain[l][i] +
          (long double)c->norm_shift[l][i];
      x[i] = z > 0 ? z : 0;
    }
    width = n;
  }
  for (uint32_t i = 0; i < c->n_springs; i++)
    outputs[i] = (double)tanhl(y[i]);
}

static void against_textbook(void)
{
  struct mo_controller *c = make_controller((struct mo_workspace){2, 1, 2}, MO_SENSOR_INVERSE_SQRT);
  mo_controller_randomize(c, 7);
  struct mo_random random = dice(1, 0, 0);
  for (int l = 0; l < 4; l++)
    for (uint32_t i = 0; i < (l < 3 ? 256 : c->n_springs); i++) {
      c->bias[l][i] = (float)mo_random_normal(&random);
      if (l < 3) {
        c->norm_gain[l][i] = (float)mo_random_normal(&random);
        c->norm_shift[l][i] = (float)mo_random_normal(&random);
      }
    }
  double expected[256], memory[5000], few[5000];
  REQUIRE(c->n_springs <= 256 && mo_controller_tape_doubles(c, c->n_springs) <= 5000);
  struct mo_controller_tape all = mo_controller_tape_place(c, c->n_springs, memory),
                            some = mo_controller_tape_place(c, 3, few);
  for (int trial = 0; trial < 20; trial++) {
    double largest = 0;
    for (uint32_t j = 0; j < c->n_inputs; j++)
      all.input[j] = some.input[j] = mo_random_normal(&random);
    mo_controller_forward(c, NULL, c->n_springs, &all);
    textbook(c, all.input, expected);
    for (uint32_t i = 0; i < c->n_springs; i++) {
      CHECK_NEAR(all.output[i], expected[i], 1e-12);
      largest = fmax(largest, fabs(all.output[i]));
    }
    CHECK(largest > 0.1 && largest <= 1);
    const uint32_t springs[3] = {c->n_springs - 1, 0, 17};
    mo_controller_forward(c, springs, 3, &some);
    for (int i = 0; i < 3; i++)
      CHECK(some.output[i] == all.output[springs[i]]); /* bit for bit */
  }
}

/* With zero matrices a hidden layer is ReLU(shift), whatever its bias: the normalized part of a
 * constant layer is 0. */
static void closed_form(void)
{
  struct mo_controller *c = make_controller((struct mo_workspace){1, 1, 1}, MO_SENSOR_INVERSE_SQRT);
  for (int i = 0; i < 256; i++) {
    c->bias[2][i] = 3.0F;
    c->norm_shift[2][i] = i % 2 ? 0.25F : -0.25F;
    c->weight[3][i] = 1.0F / 64; /* spring 0 */
  }
  c->bias[3][1] = 0.5F;
  double memory[5000] = {1, 2, 3};
  struct mo_controller_tape tape = mo_controller_tape_place(c, c->n_springs, memory);
  mo_controller_forward(c, NULL, c->n_springs, &tape);
  CHECK_NEAR(tape.output[0], tanh(128 * 0.25 / 64), 1e-15);
  CHECK_NEAR(tape.output[1], tanh(0.5), 1e-15);
  CHECK_NEAR(tape.output[2], 0, 0);
}

static const struct check_case cases[] = {
    {"closed form", closed_form}, {"the network against a textbook version", against_textbook}};
CHECK_MAIN(cases)
