/* Dense algebra in numbers of type REAL; included once for each type, under the names DOT, BACK and TIMES. */
#ifndef VECTORS
#define VECTORS
typedef double Vec_double __attribute__((vector_size(32)));
typedef float Vec_float __attribute__((vector_size(32)));
#endif

static REAL DOT(int n, const REAL *a, const REAL *b) {
  enum { MANY = 64 / sizeof(REAL) };
  REAL s[MANY] = {0}, r = 0;
  int i = 0;
  for (; i + MANY <= n; i += MANY)
    for (int k = 0; k < MANY; k++) s[k] += a[i + k] * b[i + k];
  for (; i < n; i++) r += a[i] * b[i];
  for (int k = 0; k < MANY; k++) r += s[k];
  return r;
}

/* b <- J^-1 b from LAPACK's factor LU of the transpose of J by columns, so that the matrix is written, and the factor
   read, along rows of J. */
static void BACK(int n, const REAL *LU, const int *pivot, REAL *b) {
  for (int j = 0; j < n; j++) b[j] = (b[j] - DOT(j, LU + (size_t)j * n, b)) / LU[(size_t)j * n + j];
  for (int j = n - 2; j >= 0; j--) b[j] -= DOT(n - 1 - j, LU + (size_t)j * n + j + 1, b + j + 1);
  for (int j = n - 1; j >= 0; j--) {
    const REAL t = b[pivot[j]];
    b[pivot[j]] = b[j];
    b[j] = t;
  }
}

/* v = M u of a symmetric matrix, larger than the caches: its lower half alone is read, four rows at a time, or the rows
   of the few numbers of u that are not 0. */
static void TIMES(int n, int ld, const REAL *M, const REAL *restrict u, REAL *restrict v) {
  enum { MANY = 32 / sizeof(REAL) };
  int full = 0, r = 0;
  for (int i = 0; i < n; i++) full += u[i] != 0;
  memset(v, 0, n * sizeof(REAL));
  if (2 * full < n) {
    const REAL *rows[4];
    REAL t[4];
    for (int i = 0, have = 0; i <= n; i++) {
      if (i < n && u[i] != 0) {
        rows[have] = M + (size_t)i * ld;
        t[have++] = u[i];
      }
      if (i == n && have)
        for (; have < 4; have++) rows[have] = M, t[have] = 0;
      if (have < 4) continue;
      have = 0;
      for (int j = 0; j < n; j++) v[j] += (t[0] * rows[0][j] + t[1] * rows[1][j]) + (t[2] * rows[2][j] + t[3] * rows[3][j]);
    }
    return;
  }
  for (; r + 4 <= n; r += 4) {
    const REAL *rows = M + (size_t)r * ld;
    VEC s[4] = {{0}, {0}, {0}, {0}}, w, x, y;
    REAL sums[4] = {0};
    int j = 0;
    for (; j + MANY <= r; j += MANY) {
      memcpy(&x, u + j, sizeof x);
      memcpy(&y, v + j, sizeof y);
      for (int l = 0; l < 4; l++) {
        memcpy(&w, rows + (size_t)l * ld + j, sizeof w);
        s[l] += w * x;
        y += w * u[r + l];
      }
      memcpy(v + j, &y, sizeof y);
    }
    for (int l = 0; l < 4; l++) {
      const REAL *row = rows + (size_t)l * ld;
      for (int i = 0; i < MANY; i++) sums[l] += s[l][i];
      for (int i = j; i < r + l; i++) {
        sums[l] += row[i] * u[i];
        v[i] += row[i] * u[r + l];
      }
      v[r + l] += sums[l] + row[r + l] * u[r + l];
    }
  }
  for (; r < n; r++) {
    const REAL *row = M + (size_t)r * ld;
    REAL sum = row[r] * u[r];
    for (int i = 0; i < r; i++) {
      sum += row[i] * u[i];
      v[i] += row[i] * u[r];
    }
    v[r] += sum;
  }
}
