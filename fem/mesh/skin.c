/* One pass over the simplices of a mesh: the shape of each, and which nodes lie on the boundary. */
#include <math.h>
#include <stdint.h>

typedef struct {
  long long cells, d;   /* number of simplices, 2 or 3 */
  const int64_t *nodes; /* of the simplices, d + 1 each */
  const double *x;      /* coordinates, d each [m] */
  double *shape;        /* signed volume over (longest edge)^d of each simplex, or 0 */
  uint64_t *fold;       /* by node: 0 inside, or 0 to leave it out */
} Skin;

static uint64_t mixed(uint64_t k) { /* splitmix64 */
  k += 0x9e3779b97f4a7c15u;
  k = (k ^ (k >> 30)) * 0xbf58476d1ce4e5b9u;
  k = (k ^ (k >> 27)) * 0x94d049bb133111ebu;
  return k ^ (k >> 31);
}

static double shape_of(const double *x, const int64_t *node, long long d) {
  double e[3][3] = {{0}}, longest = 0, volume;
  for (long long i = 0; i <= d; i++)
    for (long long j = 0; j < i; j++) {
      double square = 0;
      for (long long k = 0; k < d; k++) {
        const double step = x[node[i] * d + k] - x[node[j] * d + k];
        square += step * step;
        if (!j) e[i - 1][k] = step;
      }
      if (square > longest) longest = square;
    }
  if (d == 2) volume = (e[0][0] * e[1][1] - e[0][1] * e[1][0]) / 2;
  else
    volume = (e[0][0] * (e[1][1] * e[2][2] - e[1][2] * e[2][1]) + e[0][1] * (e[1][2] * e[2][0] - e[1][0] * e[2][2]) +
              e[0][2] * (e[1][0] * e[2][1] - e[1][1] * e[2][0])) / 6;
  return longest > 0 ? volume / (d == 2 ? longest : longest * sqrt(longest)) : volume;
}

void softgrasp_skin(const Skin *s) {
  const long long d = s->d;
  for (long long c = 0; c < s->cells; c++) {
    const int64_t *node = s->nodes + c * (d + 1);
    if (s->shape) s->shape[c] = shape_of(s->x, node, d);
    if (!s->fold) continue;
    uint64_t key[4], all = 0, every = 0;
    for (long long i = 0; i <= d; i++) all += key[i] = mixed((uint64_t)node[i]);
    for (long long i = 0; i <= d; i++) every ^= key[i] = mixed(all - key[i]); /* of the facet without this node */
    for (long long i = 0; i <= d; i++) s->fold[node[i]] ^= every ^ key[i]; /* those of two cells cancel */
  }
}
