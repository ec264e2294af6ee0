/* b <- J^-1 b in numbers of type REAL, from LAPACK's factor LU of the transpose of J by columns, so that the matrix is
   written, and the factor read, along rows of J. Included once for each type, under the name BACK. */
static REAL DOT(int n, const REAL *a, const REAL *b) {
  enum { LANES_ = 64 / sizeof(REAL) };
  REAL s[LANES_] = {0}, r = 0;
  int i = 0;
  for (; i + LANES_ <= n; i += LANES_)
    for (int k = 0; k < LANES_; k++) s[k] += a[i + k] * b[i + k];
  for (; i < n; i++) r += a[i] * b[i];
  for (int k = 0; k < LANES_; k++) r += s[k];
  return r;
}

static void BACK(int n, const REAL *LU, const int *pivot, REAL *b) {
  for (int j = 0; j < n; j++) b[j] = (b[j] - DOT(j, LU + (size_t)j * n, b)) / LU[(size_t)j * n + j];
  for (int j = n - 2; j >= 0; j--) b[j] -= DOT(n - 1 - j, LU + (size_t)j * n + j + 1, b + j + 1);
  for (int j = n - 1; j >= 0; j--) {
    const REAL t = b[pivot[j]];
    b[pivot[j]] = b[j];
    b[j] = t;
  }
}
