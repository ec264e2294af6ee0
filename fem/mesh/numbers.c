/* Numbers of a text, read as strictly as they are written by programs: anything else is left to a slower reader. */
#include <float.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

typedef struct {
  long long size, most, commas; /* bytes of the text, room for numbers, and whether commas part them */
  const char *text;             /* ends before a byte of no number */
  double *real;                 /* the numbers */
  int32_t *whole;               /* or these, of digits only, where it is not 0 */
  int32_t *line;                /* how many stand in each line, or 0 */
} Numbers;

static const double TEN[] = {1e0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8, 1e9, 1e10, 1e11,
                             1e12, 1e13, 1e14, 1e15, 1e16, 1e17, 1e18, 1e19, 1e20, 1e21, 1e22};

static int digit(char c) { return c >= '0' && c <= '9'; }

/* A decimal number from `at` on, correctly rounded; returns where it ends, 0 where none stands. */
static const char *decimal(const char *at, double *value) {
  const char *p = at + (*at == '-' || *at == '+');
  uint64_t digits = 0;
  long long tens = 0, count = 0;
  for (; digit(*p); p++, count++) digits = 10 * digits + (uint64_t)(*p - '0');
  if (*p == '.')
    for (p++; digit(*p); p++, count++, tens--) digits = 10 * digits + (uint64_t)(*p - '0');
  if (!count) return 0;
  if (*p == 'e' || *p == 'E') {
    const char *q = p + 1;
    const int minus = *q == '-';
    long long power = 0;
    q += *q == '-' || *q == '+';
    if (!digit(*q)) return 0;
    for (; digit(*q); q++) power = power > 9999 ? power : 10 * power + (*q - '0');
    tens += minus ? -power : power, p = q;
  }
#if LDBL_MANT_DIG == 64
  /* Digits and power are exact with 64 bits, and what one operation rounds to them gives the nearest double, but where
     it lies half-way between two (the last 11 bits: a one and zeros). */
  if (count <= 19 && tens >= -22 && tens <= 22) {
    const long double x = tens < 0 ? (long double)digits / TEN[-tens] : (long double)digits * TEN[tens];
    uint64_t bits;
    memcpy(&bits, &x, sizeof bits);
    if ((bits & 0x7ff) != 0x400) {
      *value = *at == '-' ? -(double)x : (double)x;
      return p;
    }
  }
#endif
  char *end;
  *value = strtod(at, &end); /* in a locale with decimal commas it ends too early */
  return end == p ? p : 0;
}

static const char *integer(const char *at, int32_t *value) {
  const char *p = at;
  int64_t digits = 0;
  for (; digit(*p) && p - at < 11; p++) digits = 10 * digits + (*p - '0');
  *value = (int32_t)digits;
  return p == at || digit(*p) || digits > INT32_MAX ? 0 : p;
}

/* The number at `p`; with commas the first of a line is one of digits only. Returns where it ends, or 0. */
static const char *number(const Numbers *n, const char *p, long long place, int first) {
  int32_t digits;
  if (n->whole) return integer(p, n->whole + place);
  const char *end = decimal(p, n->real + place);
  return first && n->commas && integer(p, &digits) != end ? 0 : end;
}

/* Reads numbers to the end of the text or until there is no room; how many, -1: something else stands there. Of the text
   `size` is what was read then, and `most` the number of its lines. */
long long softgrasp_numbers(Numbers *n) {
  const char *p = n->text, *end = p + n->size;
  long long count = 0, before = 0, lines = 0;
  int parted = 1; /* whether a number may follow */
  for (; p <= end && count < n->most; p++) {
    if (p == end || *p == '\n') {
      /* a comma may end a line of whole numbers */
      if (parted && n->commas && !n->whole && count > before) return -1;
      if (n->line) n->line[lines] = (int32_t)(count - before);
      lines++;
      before = count, parted = 1;
    } else if (*p == ' ' || *p == '\t' || *p == '\r') {
      parted |= !n->commas;
    } else {
      if (!parted || !(p = number(n, p, count, count == before))) return -1;
      count++;
      parted = n->commas && *p == ',';
      p -= !parted;
    }
  }
  n->size = p < end ? p - n->text : n->size;
  n->most = lines;
  return count;
}
