#include "plant.h"
#include "plant_data.h"
#include "vector.h"

enum { N = SG_PLANT_N };

/* Triangles of a matrix held column by column, by Gauss with row pivots. */
static int factor(double a[N][N], int pivot[N]) {
    for (int k = 0; k < N; ++k) {
        int p = k;
        for (int i = k + 1; i < N; ++i)
            if (size(a[k][i]) > size(a[k][p])) p = i;
        pivot[k] = p;
        if (!(size(a[k][p]) > 0) || defect(&a[k][p], 1) != 0) return SG_PLANT_SINGULAR;
        if (p != k)
            for (int j = 0; j < N; ++j) {
                double other = a[j][k];
                a[j][k] = a[j][p];
                a[j][p] = other;
            }
        double inverse = 1 / a[k][k];
        for (int i = k + 1; i < N; ++i) a[k][i] *= inverse;
        for (int j = k + 1; j < N; ++j) add(-a[j][k], &a[k][k + 1], &a[j][k + 1], N - k - 1);
    }
    return SG_PLANT_OK;
}

static void solve(const double a[N][N], const int pivot[N], double b[N]) {
    for (int k = 0; k < N; ++k) {
        double other = b[k];
        b[k] = b[pivot[k]];
        b[pivot[k]] = other;
    }
    for (int k = 0; k < N - 1; ++k) add(-b[k], &a[k][k + 1], &b[k + 1], N - k - 1);
    for (int k = N - 1; k >= 0; --k) {
        b[k] /= a[k][k];
        add(-b[k], a[k], b, k);
    }
}

/* A w + B u + f */
static void force(const sg_plant *plant, const double *u, double r[N]) {
    for (int i = 0; i < N; ++i) r[i] = LOAD[i];
    for (int j = 0; j < SG_PLANT_INPUTS; ++j) add(u[j], B[j], r, N);
    for (int j = 0; j < N; ++j) add(plant->w[j], plant->A[j], r, N);
}

static int possible(const double *theta) {
    for (int l = 0; l < SG_PLANT_LAYERS; ++l) {
        double mu = theta[3 * l], lambda = theta[3 * l + 1], beta = theta[3 * l + 2];
        if (l >= SG_PLANT_MATERIALS) { /* an own parameter, whose lambda is 0 */
            if (!(mu >= 0 && beta >= 0) || lambda < 0 || lambda > 0) return 0;
            continue;
        }
        if (!(mu > 0 && lambda > -2 * mu / 3 && beta >= 0) || (!SG_PLANT_DAMPED && beta > 0)) return 0;
    }
    return 1;
}

static void copy(const double x[N][N], double y[N][N]) {
    for (int j = 0; j < N; ++j)
        for (int i = 0; i < N; ++i) y[j][i] = x[j][i];
}

static void add_matrix(double factor, const double x[N][N], double y[N][N]) {
    for (int j = 0; j < N; ++j) add(factor, x[j], y[j], N);
}

/* Assemble and factor for a possible material. */
static int assemble(sg_plant *plant, const double *theta) {
    for (int i = 0; i < SG_PLANT_THETA; ++i) plant->theta[i] = theta[i];
    copy(A_0, plant->A);
#if SG_PLANT_VISCOUS_E
    copy(E_0, plant->E);
#endif
    for (int l = 0; l < SG_PLANT_LAYERS; ++l) {
        double mu = theta[3 * l], lambda = theta[3 * l + 1];
        add_matrix(mu, A_MU[l], plant->A);
        add_matrix(lambda, A_LAMBDA[l], plant->A);
#if SG_PLANT_DAMPED
        double beta = theta[3 * l + 2];
#if SG_PLANT_VISCOUS_E
        add_matrix(beta * mu, E_BETA_MU[l], plant->E);
        add_matrix(beta * lambda, E_BETA_LAMBDA[l], plant->E);
#else
        add_matrix(beta * mu, A_BETA_MU[l], plant->A);
        add_matrix(beta * lambda, A_BETA_LAMBDA[l], plant->A);
#endif
#endif
    }
    for (int j = 0; j < N; ++j) {
#if SG_PLANT_VISCOUS_E
        for (int i = 0; i < N; ++i) plant->step[j][i] = plant->E[j][i] - SG_PLANT_TICK / 2 * plant->A[j][i];
#else
        for (int i = 0; i < N; ++i) plant->step[j][i] = -SG_PLANT_TICK / 2 * plant->A[j][i];
        plant->step[j][j] += 1;
#endif
    }
    int status = factor(plant->step, plant->pivot);
#if SG_PLANT_VISCOUS_E
    if (status == SG_PLANT_OK) status = factor(plant->E, plant->pivot_E);
#endif
    return status;
}

int sg_plant_material(sg_plant *plant, const double theta[SG_PLANT_THETA]) {
    double last[SG_PLANT_THETA];
    if (defect(theta, SG_PLANT_THETA) != 0) return SG_PLANT_NOT_FINITE;
    if (!possible(theta)) return SG_PLANT_MATERIAL;
    for (int i = 0; i < SG_PLANT_THETA; ++i) last[i] = plant->theta[i];
    int status = assemble(plant, theta);
    if (status != SG_PLANT_OK) assemble(plant, last);
    return status;
}

void sg_plant_start(sg_plant *plant) {
    for (int i = 0; i < N; ++i) plant->w[i] = START[i];
    assemble(plant, THETA);
}

int sg_plant_tick(sg_plant *plant, const double u[SG_PLANT_INPUTS]) {
    double r[N];
    if (defect(u, SG_PLANT_INPUTS) != 0) return SG_PLANT_NOT_FINITE;
    force(plant, u, r);
    solve(plant->step, plant->pivot, r);
    for (int i = 0; i < N; ++i) r[i] = plant->w[i] + SG_PLANT_TICK * r[i];
    if (defect(r, N) != 0) return SG_PLANT_DIVERGED;
    for (int i = 0; i < N; ++i) plant->w[i] = r[i];
    return SG_PLANT_OK;
}

void sg_plant_outputs(const sg_plant *plant, double y[SG_PLANT_OUTPUTS]) {
    for (int i = 0; i < SG_PLANT_OUTPUTS; ++i) y[i] = 0;
    for (int j = 0; j < N; ++j) add(plant->w[j], C[j], y, SG_PLANT_OUTPUTS);
}

int sg_plant_rate(const sg_plant *plant, const double u[SG_PLANT_INPUTS], double rate[SG_PLANT_N]) {
    if (defect(u, SG_PLANT_INPUTS) != 0) return SG_PLANT_NOT_FINITE;
    force(plant, u, rate);
#if SG_PLANT_VISCOUS_E
    solve(plant->E, plant->pivot_E, rate);
#endif
    return defect(rate, N) != 0 ? SG_PLANT_DIVERGED : SG_PLANT_OK;
}

const char *sg_plant_message(int status) {
    switch (status) {
    case SG_PLANT_OK: return "done";
    case SG_PLANT_NOT_FINITE: return "an input is not a finite number; nothing has changed";
    case SG_PLANT_MATERIAL:
        return SG_PLANT_DAMPED ? "no elastic material: mu must be > 0, lambda > -2 mu / 3 and beta >= 0, own parameters >= 0"
                               : "no material of this model: mu must be > 0, lambda > -2 mu / 3 and beta = 0, for the "
                                 "model was reduced without damping";
    case SG_PLANT_SINGULAR: return "the step has no solution with this material; the last one stays";
    case SG_PLANT_DIVERGED: return "the state is no longer finite: the model is unstable with this material";
    default: return "no number of this model";
    }
}
