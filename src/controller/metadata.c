/* metadata.c: reads metadata entries whose value is itself JSON. */
#include <jansson.h>
#include <stdbool.h>

#include <morpho/controller.h>

int mo_controller_get_metadata_number(const struct mo_controller *controller, const char *key,
                                      const char *member, uint64_t *number)
{
  const char *text = mo_controller_get_metadata(controller, key);
  json_error_t why;
  if (text == NULL)
    return MO_ERR_NOT_FOUND;
  json_t *object = json_loads(text, JSON_REJECT_DUPLICATES, &why);
  if (object == NULL)
    return json_error_code(&why) == json_error_out_of_memory ? MO_ERR_NO_MEMORY : MO_ERR_FORMAT;
  const json_t *value = json_object_get(object, member);
  const bool found = json_is_integer(value) && json_integer_value(value) >= 0;
  if (found)
    *number = (uint64_t)json_integer_value(value);
  json_decref(object);
  return found ? MO_OK : MO_ERR_FORMAT;
}
