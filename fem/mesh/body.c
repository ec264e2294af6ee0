/* One pass over the simplices of a body: what each lattice cell holds of it, and where it ends. */
#include <stdint.h>

typedef struct {
  long long cells, d, marks, many; /* number of simplices, 2 or 3, number of marks, and of points in a simplex */
  const int64_t *nodes;            /* of the simplices, d + 1 each */
  const double *x;                 /* coordinates, d each [m] */
  const int32_t *mark;             /* of each simplex, or 0 */
  const int64_t *count;            /* lattice cells along each axis */
  const double *lines;             /* lattice lines, count + 1 of each axis [m] */
  const double *share;             /* barycentric coordinates of the points but the first, d each */
  double *fill;                    /* volume by lattice cell and mark */
  double *normal;                  /* nodal normals, the integral of phi_v n over the boundary, d each */
  double *parts;                   /* sum of the sizes of what a nodal normal adds up */
  double *least;                   /* least volume of a simplex */
} Body;

static long long below(const double *lines, long long count, double x) {
  long long low = 0, high = count;
  while (high - low > 1) {
    const long long middle = (low + high) / 2;
    if (x < lines[middle]) high = middle;
    else low = middle;
  }
  return low;
}

static double magnitude(double x) { return x < 0 ? -x : x; }

void softgrasp_body(const Body *b) {
  const long long d = b->d;
  const double share = d == 2 ? 0.5 : 1.0 / 6;
  for (long long c = 0; c < b->cells; c++) {
    const int64_t *node = b->nodes + c * (d + 1);
    const double *x0 = b->x + node[0] * d;
    double e[3][3], g[4][3], volume = 0; /* edges, and V grad phi of each corner */
    for (long long i = 0; i < d; i++)
      for (long long k = 0; k < d; k++) e[i][k] = b->x[node[i + 1] * d + k] - x0[k];
    if (d == 2) {
      g[1][0] = share * e[1][1], g[1][1] = -share * e[1][0];
      g[2][0] = -share * e[0][1], g[2][1] = share * e[0][0];
    } else {
      for (int i = 0; i < 3; i++) {
        const double *p = e[(i + 1) % 3], *q = e[(i + 2) % 3];
        for (int k = 0; k < 3; k++)
          g[i + 1][k] = share * (p[(k + 1) % 3] * q[(k + 2) % 3] - p[(k + 2) % 3] * q[(k + 1) % 3]);
      }
    }
    for (long long k = 0; k < d; k++) {
      volume += e[0][k] * g[1][k];
      g[0][k] = 0;
      for (long long i = 1; i <= d; i++) g[0][k] -= g[i][k];
    }
    if (!(volume >= *b->least)) *b->least = volume;
    for (long long m = 0; m < b->many; m++) { /* each point stands for as much of the simplex */
      long long place = 0;
      const double *lines = b->lines;
      for (long long k = 0; k < d; k++) {
        double at = x0[k];
        for (long long i = 0; i < d; i++) at += b->share[m * d + i] * e[i][k];
        place = place * b->count[k] + below(lines, b->count[k], at);
        lines += b->count[k] + 1;
      }
      b->fill[place * b->marks + (b->mark ? b->mark[c] : 0)] += volume / b->many;
    }
    for (long long i = 0; i <= d; i++)
      for (long long k = 0; k < d; k++) {
        b->normal[node[i] * d + k] += g[i][k];
        b->parts[node[i]] += magnitude(g[i][k]);
      }
  }
}
