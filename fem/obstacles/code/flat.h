/* The step before half-spaces, see contact.c: its data, and what it needs before it goes on. */
#include "swept.h"

enum { MODES = 8 }; /* freedoms of a hand, at most */
enum { DONE, TAKE, ENTER, BALANCE, SOLVE, SWEEP, UNSOLVED, UNSETTLED };
#define SURE 1e-2 /* pivot over its diagonal above which a solution is within 1e-13 */
enum { BEGIN, UNTOUCHED, ROWS, FORCES, TAKEN, AFTER };

typedef struct {
  int p, d, n_s, obstacles; /* boundary nodes, axes, freedoms of the hand, half-spaces */
  int m;                    /* tangents with friction */
  int n, whole;             /* rows here of the step, whether they are all rows */
  int here;                 /* rows here of the state */
  int k, ld;                /* contact rows, and columns of W, L, A and LA */
  int count_columns;        /* of S^-1 N' */
  int feels, compiled;      /* whether the hand feels the tissue; whether the small problem is solved here */
  double dt, s, kappa;      /* step, 2 / dt, 1 + alpha dt / 2 */
  double extent, rounding;  /* size of the body, rounding of a gap over its coordinates */
  double at_rest;           /* rounding of a velocity over the largest */
  int most, most_each;      /* rounds of a step, and of the small problem for each row */
  const double *X, *T;      /* places at rest (p, d), modes of the hand (p d, n_s) */
  const double *modes;      /* the same modes, one after the other (n_s, p d) */
  double *places;           /* room for places (p d) */
  const double *along;      /* normals of the half-spaces, each before its tangents (obstacles, 1 + m, d) */
  const int *at;            /* row here of each unknown of the boundary, -1 where another rank has it (p d) */
  const int *rows;          /* the same of the state, where one rank has all (p d) */
  double *w, *r;            /* half the change of z in the step, and its right-hand side (n) */
  double *z, *low;          /* displacement of the boundary, and what it lacks (p d) */
  double *moved, *v;        /* its half change in the step and its velocity (p d) */
  double *qs, *vs, *cs;     /* hand, its velocity (steps + 1, n_s) and its load (steps, n_s) */
  const double *q, *q0;     /* hand at the end of the step and at the start of it (n_s) */
  const double *slide;      /* way of the half-spaces in the step (obstacles, d) */
  double *level, *rate;     /* n.x of the half-spaces at the end of the step (obstacles), velocities (obstacles, d) */
  double *gap, *after;      /* gaps before and at the end of the step (obstacles, p) */
  char *entered;            /* whether a pair has a row (obstacles, p) */
  char *lately;             /* 1 of a pair that touched in the last step, and 2 where that changed then (obstacles, p) */
  double *least;            /* least gaps at the end (obstacles) */
  const int *row;           /* obstacle, node, column and direction of each contact row, 0 for the normal (k, 4) */
  const int *kind;          /* sets of the pairs, see friction.c; 0 without friction */
  const double *columns;    /* S^-1 N' on the rows here, a column after the other (.., n) */
  const double *W;          /* N S^-1 N', with the hand's part where it feels the tissue (k, k) */
  double *free, *x, *b;     /* right-hand side of the small problem, forces, velocities to stop (k) */
  double rubbed;            /* work of friction on slipping nodes in the step: that on others is rounding */
  double *change;           /* what the last forces added to that of each column */
  double entries;           /* that a solve reads: where columns have more, it is taken instead of them */
  const Swept *swept;       /* F N' instead of S^-1 N', or 0 */
  int ahead;                /* whether y is known in the place of w when a step begins */
  const double *B, *Y, *G;  /* of a hand that feels the tissue: directions times reach (columns, n_s), S^-1 G, or F G, and G
                               (n_s, n) */
  const double *inverse;    /* L^-1 of its equation (n_s, n_s) */
  int *count, *order, *side; /* small problem, see `softgrasp_complement` */
  double *L, *to, *room;
  long *tally;
  int stage, round, pressed; /* where the step is, its rounds, whether a row may be pressed */
  double largest;           /* coordinate at the last look */
  double tol, depth, reached; /* tolerance of gaps, depth from which pairs enter, largest gap of pressed rows */
  double fastest, still;    /* largest velocity of a pressed node so far, and what is at rest against it */
  int struck, stopping, ridged; /* rows with a column of M^-1, rows of the factor LA, whether it has a ridge */
  int *stopped;             /* which */
  const double *A;          /* N M^-1 N', with the hand's part (struck, struck) */
  double *LA, *y;           /* factor of A at the stopped rows, impulses (k) */
  const Swept *mass;        /* first sweeps of the mass of one component, or 0 */
  const int *column;        /* column of each row in them, or else its node (struck) */
  int nodes, ways;          /* of all ranks; axes that an impulse has, or 1 along one direction */
  const double *only;       /* that direction */
  double *given;            /* what is to be solved for each axis: the sums of first sweeps, or the impulses (d, nodes) */
  const double *found;      /* its solution, the jump of the velocity, in the order of the mass (d, nodes) */
  const int *place;         /* where the nodes here are in that order (here / d) */
  const double *starts;     /* M^-1 G on the boundary (p d, n_s) */
  const double *reach, *X_hand; /* N (T - M^-1 G) (struck, n_s), M^-1 G here (n_s, here) */
  const double *H, *GX;     /* (M_hand + M_rigid - G'M^-1 G)^-1, G'M^-1 G (n_s, n_s) */
  double *pulled;           /* G'v before the impulse (n_s) */
  double *force, *impulse, *touching, *chattering, *hand, *kick, *gaps; /* tables of the run, see Tables */
  double *energy;           /* work, energy dissipated at first touch, by impulses, by friction (4) */
} Flat;
