/* number.h: numbers in text. Different numbers always have different texts, so that no message
 * contradicts itself. */
#ifndef MORPHO_BASE_NUMBER_H
#define MORPHO_BASE_NUMBER_H

#define MO_NUMBER_BYTES 32

/* Writes a number as a short text that reads back as the same number, with six digits or more where
 * the number has them. The decimal point does not depend on the locale. */
const char *mo_number_text(double value, char text[MO_NUMBER_BYTES]);
/* Makes the same text as an argument of "%s"; valid until the end of the block. */
#define MO_NUMBER(value) mo_number_text((value), (char[MO_NUMBER_BYTES]){0})

/* Returns the value of a hexadecimal digit; −1: it is none. */
int mo_hex_digit(char c);

#endif
