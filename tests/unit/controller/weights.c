/* weights.c: a controller in memory: sizes, views, initial weights, metadata, names. */
#include "../make.h"

#include <morpho/controller.h>

#include "base/words.h"

static const struct mo_workspace tiny = {1, 1, 1};

static void sizes(void)
{
  struct mo_controller *c = make_controller(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT);
  CHECK_INT(c->n_parameters, 620912);
  CHECK_INT(c->n_inputs, 250);
  CHECK_INT(c->n_springs, 1648);
  CHECK_INT((uintptr_t)c->parameters % 64, 0);
  /* The views are in file order and end where the buffer ends. */
  CHECK(c->weight[0] == c->parameters);
  CHECK(c->bias[0] == c->weight[0] + 256 * 250);
  CHECK(c->norm_gain[0] == c->bias[0] + 256);
  CHECK(c->norm_shift[0] == c->norm_gain[0] + 256);
  CHECK(c->weight[1] == c->norm_shift[0] + 256);
  CHECK(c->weight[3] == c->norm_shift[2] + 256);
  CHECK(c->bias[3] + 1648 == c->parameters + c->n_parameters);
  for (size_t i = 0; i < c->n_parameters; i++) {
    const float *p = c->parameters + i;
    const int gain = (p >= c->norm_gain[0] && p < c->norm_gain[0] + 256) ||
                     (p >= c->norm_gain[1] && p < c->norm_gain[1] + 256) ||
                     (p >= c->norm_gain[2] && p < c->norm_gain[2] + 256);
    REQUIRE(*p == (gain ? 1.0F : 0.0F));
  }
  mo_controller_free(NULL);
}

static void refuses_sizes(void)
{
  struct mo_controller *c = NULL;
  CHECK_INT(mo_controller_create((struct mo_workspace){0, 1, 1}, MO_SENSOR_INVERSE_SQRT, &c),
            MO_ERR_RANGE);
  CHECK_INT(mo_controller_create((struct mo_workspace){1024, 1024, 2}, MO_SENSOR_INVERSE_SQRT, &c),
            MO_ERR_LIMIT);
  /* Allowed as a body, but its controller would exceed the largest file. */
  CHECK_INT(mo_controller_create((struct mo_workspace){101, 101, 101}, MO_SENSOR_INVERSE_SQRT, &c),
            MO_ERR_LIMIT);
  CHECK_INT(mo_controller_create(tiny, (enum mo_sensor)7, &c), MO_ERR_INVALID);
  CHECK(c == NULL);
}

static void randomize(void)
{
  struct mo_controller *a = make_random_controller(MO_SENSOR_INVERSE_SQRT, 42);
  struct mo_controller *b = make_controller(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT);
  b->bias[0][3] = 5.0F;
  b->norm_shift[1][3] = 5.0F;
  mo_controller_randomize(b, 42);
  CHECK(SAME(a->parameters, b->parameters, a->n_parameters));
  mo_controller_randomize(b, 43);
  CHECK(!SAME(a->weight[1], b->weight[1], 65536));
  CHECK(!SAME(a->weight[1], a->weight[2], 65536));
  const int fan_in[] = {250, 256, 256, 256}, fan_out[] = {256, 256, 256, 1648};
  for (int l = 0; l < 4; l++) {
    const size_t n = (size_t)fan_in[l] * (size_t)fan_out[l];
    const double bound = sqrt(6.0 / (fan_in[l] + fan_out[l]));
    double mean = 0, square = 0, largest = 0;
    for (size_t i = 0; i < n; i++) {
      const double w = (double)a->weight[l][i];
      mean += w / (double)n;
      square += w * w / (double)n;
      largest = fmax(largest, fabs(w));
    }
    CHECK(largest <= bound * (1 + 1e-7) && largest > bound * 0.999);
    CHECK_NEAR(mean, 0, 5 * bound / sqrt(3.0 * (double)n));
    CHECK_NEAR(square / (bound * bound / 3), 1, 0.02);
  }
  for (int i = 0; i < 256; i++)
    REQUIRE(a->bias[0][i] == 0 && a->norm_gain[2][i] == 1 && a->norm_shift[2][i] == 0);
}

static void metadata(void)
{
  struct mo_controller *c = make_controller(tiny, MO_SENSOR_INVERSE_SQUARE);
  CHECK_TEXT(mo_controller_get_metadata(c, "sensor"), "inverse_square");
  CHECK_TEXT(mo_controller_get_metadata(c, "workspace"), "1x1x1");
  CHECK_TEXT(mo_controller_get_metadata(c, "mass_order"), "x-major lattice (x*2+y)*2+z");
  CHECK_TEXT(mo_controller_get_metadata(c, "spring_order"), "lexicographic endpoint pairs");
  CHECK(mo_controller_get_metadata(c, "absent") == NULL);
  CHECK_INT(mo_controller_set_metadata(c, "note", "one"), MO_OK);
  CHECK_INT(mo_controller_set_metadata(c, "note", "two"), MO_OK);
  CHECK_TEXT(mo_controller_get_metadata(c, "note"), "two");
  CHECK_INT(c->n_metadata, 5);
  /* Metadata that describes the weights cannot be falsified. */
  CHECK_INT(mo_controller_set_metadata(c, "sensor", "inverse_sqrt"), MO_ERR_CONFLICT);
  CHECK_INT(mo_controller_set_metadata(c, "sensor", "inverse_square"), MO_OK);
  CHECK_INT(mo_controller_set_metadata(c, "workspace", "2x1x1"), MO_ERR_CONFLICT);
  CHECK_INT(mo_controller_set_metadata(c, "mass_order", "z-major"), MO_ERR_CONFLICT);
  const char *const good[] = {"",
                              "\x7f",
                              "\xc2\x80",
                              "\xdf\xbf",
                              "\xe0\xa0\x80",
                              "\xed\x9f\xbf",
                              "\xee\x80\x80",
                              "\xf0\x90\x80\x80",
                              "\xf4\x8f\xbf\xbf"};
  const char *const bad[] = {"\xff",
                             "\x80",
                             "a\xc2",
                             "\xc0\x80",
                             "\xc1\xbf",
                             "\xe0\x9f\xbf",
                             "\xed\xa0\x80",
                             "\xed\xbf\xbf",
                             "\xf0\x8f\xbf\xbf",
                             "\xf4\x90\x80\x80",
                             "\xe2\x82",
                             "\xf8\x88\x80\x80\x80"};
  for (size_t i = 0; i < COUNT(good); i++)
    CHECK_INT(mo_controller_set_metadata(c, "note", good[i]), MO_OK);
  for (size_t i = 0; i < COUNT(bad); i++)
    CHECK_INT(mo_controller_set_metadata(c, "note", bad[i]), MO_ERR_INVALID);
  CHECK_INT(mo_controller_set_metadata(c, "\xc3", "x"), MO_ERR_INVALID);
  CHECK_INT(mo_controller_set_metadata(c, "note", NULL), MO_ERR_INVALID);
  char *longest = make_zeros(65538, 1);
  memset(longest, 'a', 65537);
  CHECK_INT(mo_controller_set_metadata(c, "note", longest), MO_ERR_LIMIT);
  longest[65536] = '\0';
  CHECK_INT(mo_controller_set_metadata(c, "note", longest), MO_OK);
  char key[16];
  for (int i = 0; i < 1019; i++) {
    snprintf(key, sizeof(key), "k%d", i);
    REQUIRE(mo_controller_set_metadata(c, key, "") == MO_OK);
  }
  CHECK_INT(mo_controller_set_metadata(c, "one more", ""), MO_ERR_LIMIT);
  CHECK_INT(mo_controller_set_metadata(c, "note", "still possible"), MO_OK);
}

static void sensors(void)
{
  CHECK_INT(mo_word_index(mo_sensor_words, "inverse_square"), MO_SENSOR_INVERSE_SQUARE);
  CHECK_INT(mo_word_index(mo_sensor_words, "inverse_sqrt"), MO_SENSOR_INVERSE_SQRT);
  CHECK_INT(mo_word_index(mo_sensor_words, "Inverse_sqrt"), MO_ERR_NOT_FOUND);
  CHECK_TEXT(mo_sensor_name(MO_SENSOR_INVERSE_SQUARE), "inverse_square");
  CHECK_TEXT(mo_sensor_name((enum mo_sensor)9), "unknown");
}

static const struct check_case cases[] = {{"sizes and views", sizes},
                                          {"sizes that are refused", refuses_sizes},
                                          {"Xavier-uniform weights from a seed", randomize},
                                          {"metadata", metadata},
                                          {"sensor names", sensors}};
CHECK_MAIN(cases)
