/* The plan of a controller, made again at the first tick of every interval: min |c|^2 / 2 subject to G c <= h by a dual
   active set; where gaps have a price, e' = 1 + price e of every interval and obstacle with e'^2 / 2 beside it. G is
   made at the start, a row serves every later interval: a_r F^m D by the lag m. Rows of the active set are kept as an
   orthonormal basis and a triangle, one row in or out at a time.

   Part of controller.c; see SG_PLAN_... in controller_size.h. */
#ifndef SG_PLAN_CONTROLLER_H
#define SG_PLAN_CONTROLLER_H

enum {
    PN = SG_PLAN_N, PH = SG_PLAN_INTERVALS, PC = PH * M, PS = SG_PLAN_OBSTACLES * PH, PV = PC + PS,
    PR = SG_PLAN_ROWS, PK = SG_PLAN_MODES, PP = SG_PLAN_PARTS, NEAR = M + PK
};
enum { FOUND, INFEASIBLE, TOO_MANY };

#define VIOLATION 1e-13 /* of a unit row, over 1 + |c|: rounding of G c is a few times 1e-16 */
#define DEPENDENT 1e-10 /* part of a unit row outside the span of the active ones that is rounding */
#define KEEPS 1e-9      /* of the unit of a limit: rounding of a plan that keeps it with equality */
#define DIAGONAL 0.41421356237309515 /* sqrt(2) - 1 */

static double dot(const double *x, const double *y, int n) {
    double sum = 0;
    for (int i = 0; i < n; ++i) sum += x[i] * y[i];
    return sum;
}

/* The square root, by Newton steps from above until they no longer fall. */
static double root(double x) {
    if (!(x > 0)) return 0;
    double y = x > 1 ? x : 1;
    for (;;) {
        double next = (y + x / y) / 2;
        if (!(next < y)) return y;
        y = next;
    }
}

/* y += A x with columns of n entries, `stride` apart; four at a time, so that y is read and written less often. */
static void apply_columns(const double *A, int stride, const double *x, int columns, double *restrict y, int n) {
    int j = 0;
    for (; j + 4 <= columns; j += 4) {
        const double *restrict a = A + (long)j * stride, *restrict b = a + stride, *restrict c = b + stride,
                     *restrict d = c + stride;
        for (int i = 0; i < n; ++i) {
            double sum = y[i] + x[j] * a[i];
            sum += x[j + 1] * b[i];
            sum += x[j + 2] * c[i];
            y[i] = sum + x[j + 3] * d[i];
        }
    }
    for (; j < columns; ++j) add(x[j], A + (long)j * stride, y, n);
}

static int kind_of(long k) { return k < PH ? (int)k : PH; }

/* x an interval later. */
static void along_way(double x[PN], const double *c) {
    double next[PN] = {0};
    apply_columns(&PLAN_F[0][0], PN, x, PN, next, PN);
    apply_columns(&PLAN_D[0][0], PN, c, M, next, PN);
    for (int i = 0; i < PN; ++i) x[i] = next[i];
}

/* Coefficients of all rows by lag, the latest last, their sizes, and the largest bend of the swings that are allowed. */
static void make_rows(sg_plan *p) {
    for (int r = 0; r < PR; ++r) {
        double row[PN], next[PN], sum = 0;
        for (int i = 0; i < PN; ++i) row[i] = PLAN_A[i][r];
        for (int s = 0; s < M; ++s) p->coefficients[PC - M + s][r] = PLAN_NOW[s][r];
        for (int lag = 1; lag < PH; ++lag) {
            for (int s = 0; s < M; ++s) p->coefficients[PC - M * (lag + 1) + s][r] = dot(row, PLAN_D[s], PN);
            for (int i = 0; i < PN; ++i) next[i] = dot(row, PLAN_F[i], PN);
            for (int i = 0; i < PN; ++i) row[i] = next[i];
        }
        for (int b = 0; b < PC; ++b) sum += p->coefficients[b][r] * p->coefficients[b][r];
        p->size[r] = sum > 0 ? root(sum) : 1;
    }
    for (int own = 0; own <= PH; ++own)
        for (int r = PLAN_FIRST[own]; r < PLAN_FIRST[own + 1]; ++r) {
            double one = dot(PLAN_LEAVES[r], PLAN_MOST[own][PLAN_PART[r][0]], PK);
            double other = dot(PLAN_LEAVES[r], PLAN_MOST[own][PLAN_PART[r][1]], PK);
            p->bend[r] = one > other ? one : other;
            for (int m = 0; m < PK; ++m) {
                double most = 0;
                for (int i = 0; i < PP; ++i)
                    if (PLAN_MOST[own][i][m] > most) most = PLAN_MOST[own][i][m];
                p->bend[r] += PLAN_SPREAD[r][m] * (PLAN_BOX[own][M + m] + PLAN_BETWEEN[m] * most);
            }
            p->bend[r] *= 1 + KEEPS;
        }
}

/* Right-hand sides of the horizon that begins at an interval in state x. */
static void begin_program(sg_plan *p, long interval, const double *x) {
    double state[PN], none[M] = {0};
    for (int i = 0; i < PN; ++i) state[i] = x[i];
    p->offset[0] = 0;
    for (int k = 0; k < PH; ++k) {
        int own = kind_of(interval + k), first = PLAN_FIRST[own], rows = PLAN_FIRST[own + 1] - first;
        double *h = p->h + p->offset[k];
        p->first[k] = first;
        for (int i = 0; i < rows; ++i) h[i] = PLAN_FREE[first + i], p->at[p->offset[k] + i] = (short)k;
        apply_columns(&PLAN_A[0][first], PR, state, PN, h, rows);
        p->offset[k + 1] = p->offset[k] + rows;
        along_way(state, none);
    }
}

/* Row i of a program as g, of size one, with its right-hand side; negative numbers are those of the slacks. */
static double row_of(const sg_plan *p, int i, int soft, double *g) {
    double h, sum = 0;
    for (int b = 0; b < PV; ++b) g[b] = 0;
    if (i < 0) return g[PC - 1 - i] = -1, -1;
    int k = p->at[i], r = p->first[k] + i - p->offset[k], gap = PLAN_OBSTACLE[r];
    for (int b = 0; b < M * (k + 1); ++b) g[b] = -p->coefficients[PC - M * (k + 1) + b][r];
    h = p->h[i];
    if (soft && gap >= 0) g[PC + gap * PH + k] = -1 / SG_PLAN_PRICE, h -= 1 / SG_PLAN_PRICE;
    for (int b = 0; b < PV; ++b) sum += g[b] * g[b];
    if (!(sum > 0)) return h;
    sum = root(sum);
    for (int b = 0; b < PV; ++b) g[b] /= sum;
    return h / sum;
}

/* What g has outside the rows that are active, and its entries along them; the square of what is left. */
static double outside(const sg_plan *p, int n, double *g, double *along) {
    for (int i = 0; i < p->count; ++i) along[i] = 0;
    for (int twice = 0; twice < 2; ++twice)
        for (int i = 0; i < p->count; ++i) {
            double part = dot(p->Q[i], g, n);
            along[i] += part;
            add(-part, p->Q[i], g, n);
        }
    return dot(g, g, n);
}

static void append(sg_plan *p, int row, double h, double multiplier, int n, const double *left, double square,
                   const double *along) {
    int last = p->count++;
    double length = root(square);
    for (int b = 0; b < n; ++b) p->Q[last][b] = left[b] / length;
    for (int i = 0; i < last; ++i) p->R[last][i] = along[i];
    p->R[last][last] = length;
    p->row[last] = row;
    p->right[last] = h;
    p->multiplier[last] = multiplier;
}

/* Take a row out: rotations make the triangle whole again. */
static void drop(sg_plan *p, int out, int n) {
    int last = --p->count;
    for (int j = out; j < last; ++j) {
        for (int i = 0; i <= j + 1; ++i) p->R[j][i] = p->R[j + 1][i];
        p->row[j] = p->row[j + 1];
        p->right[j] = p->right[j + 1];
        p->multiplier[j] = p->multiplier[j + 1];
    }
    for (int j = out; j < last; ++j) {
        double a = p->R[j][j], b = p->R[j][j + 1], length = root(a * a + b * b), cosine = a / length, sine = b / length;
        for (int i = j; i < last; ++i) {
            double up = p->R[i][j], down = p->R[i][j + 1];
            p->R[i][j] = cosine * up + sine * down;
            p->R[i][j + 1] = cosine * down - sine * up;
        }
        for (int i = 0; i < n; ++i) {
            double up = p->Q[j][i], down = p->Q[j + 1][i];
            p->Q[j][i] = cosine * up + sine * down;
            p->Q[j + 1][i] = cosine * down - sine * up;
        }
    }
}

/* R'y = right, y of the active rows. */
static void forward(const sg_plan *p, double *y) {
    for (int i = 0; i < p->count; ++i) y[i] = (p->right[i] - dot(p->R[i], y, i)) / p->R[i][i];
}

/* R y = y */
static void backward(const sg_plan *p, double *y) {
    for (int i = p->count - 1; i >= 0; --i) {
        y[i] /= p->R[i][i];
        add(-y[i], p->R[i], y, i);
    }
}

/* The point nearest to the origin with equality in the active rows. */
static void point(sg_plan *p, int n) {
    double y[PV];
    forward(p, y);
    for (int b = 0; b < n; ++b) p->c[b] = 0;
    for (int i = 0; i < p->count; ++i) add(y[i], p->Q[i], p->c, n);
}

/* The active set of another program, less rows that are dependent or would pull. */
static void restart(sg_plan *p, const int *rows, int count, int soft, int n) {
    double g[PV], along[PV], y[PV];
    p->count = 0;
    for (int i = 0; i < count && p->count < n; ++i) {
        double h = row_of(p, rows[i], soft, g), square = outside(p, n, g, along);
        if (square > DEPENDENT * DEPENDENT) append(p, rows[i], h, 0, n, g, square, along);
    }
    for (int pulls = 1; pulls;) {
        pulls = 0;
        forward(p, y);
        backward(p, y);
        for (int i = 0; i < p->count; ++i) p->multiplier[i] = -y[i];
        for (int i = p->count - 1; i >= 0; --i)
            if (p->multiplier[i] < 0) drop(p, i, n), pulls = 1;
    }
}

/* What the plan leaves of rows begin, .., end - 1 of interval k in p->violation, and the violation of the block of rows
   that has the largest, by the size of each row; `worst` is the row of the largest of all so far. */
static double look(sg_plan *p, int k, int begin, int end, int soft, double *most, int *worst) {
    int r = p->first[k] + begin, at = p->offset[k] + begin, rows = end - begin;
    double *left = p->violation + at, largest = -1 / VIOLATION;
    for (int i = 0; i < rows; ++i) left[i] = p->h[at + i];
    apply_columns(&p->coefficients[PC - M * (k + 1)][r], PR, p->c, M * (k + 1), left, rows);
    for (int i = 0; i < rows; ++i) {
        int gap = PLAN_OBSTACLE[r + i];
        double over = -left[i] + (soft && gap >= 0 ? (1 - p->c[PC + gap * PH + k]) / SG_PLAN_PRICE : 0);
        over /= p->size[r + i];
        if (over > largest) largest = over;
        if (over > *most) *most = over, *worst = at + i;
    }
    return largest;
}

/* The row that is violated most, by the size of its row; -PV - 1 where all are kept. No violation changes by more than
   c moves: intervals whose rows were all kept by more than that, when they were looked at last, are left out. */
static int worst_row(sg_plan *p, int soft, double *most) {
    int worst = -PV - 1, whole = soft || !p->steps;
    double allowed = VIOLATION * (1 + root(dot(p->c, p->c, soft ? PV : PC))), moved = 0;
    *most = allowed;
    if (whole)
        for (int b = 0; b < PC; ++b) p->looked[b] = p->c[b];
    for (int b = 0; b < PC; ++b) moved += (p->c[b] - p->looked[b]) * (p->c[b] - p->looked[b]);
    p->whole = !soft && moved == 0;
    moved = root(moved);
    for (int k = 0; k < PH; ++k) {
        if (!whole && p->most[k] + moved <= allowed) continue;
        double largest = look(p, k, 0, p->offset[k + 1] - p->offset[k], soft, most, &worst);
        if (whole) p->most[k] = largest;
    }
    for (int i = 0; soft && i < PS; ++i) {
        double over = 1 - p->c[PC + i];
        if (over > *most) *most = over, worst = -1 - i;
    }
    return worst;
}

/* Raise the multiplier of a row until it holds, dropping rows whose multipliers reach zero. */
static int enter(sg_plan *p, int row, int soft, int n) {
    double g[PV], left[PV], along[PV], own = 0, h = row_of(p, row, soft, g), violation = dot(g, p->c, n) - h;
    for (;;) {
        for (int b = 0; b < n; ++b) left[b] = g[b];
        double square = outside(p, n, left, along), inside[PV], length = -1;
        int first = -1;
        for (int i = 0; i < p->count; ++i) inside[i] = along[i];
        backward(p, inside);
        for (int i = 0; i < p->count; ++i)
            if (inside[i] > 0 && (first < 0 || p->multiplier[i] / inside[i] < length))
                length = p->multiplier[i] / inside[i], first = i;
        int whole = square > DEPENDENT * DEPENDENT && (first < 0 || violation / square <= length);
        if (!whole && first < 0) return INFEASIBLE;
        if (whole) length = violation / square;
        for (int i = 0; i < p->count; ++i) p->multiplier[i] -= length * inside[i];
        own += length;
        violation -= length * square;
        if (whole) {
            for (int i = 0; i < p->count; ++i)
                if (p->multiplier[i] < 0) p->multiplier[i] = 0;
            if (p->count == n) return INFEASIBLE;
            append(p, row, h, own, n, left, square, along);
            return FOUND;
        }
        drop(p, first, n);
    }
}

/* The program that was begun, from the rows given. */
static int solve_program(sg_plan *p, const int *rows, int count, int soft) {
    int n = soft ? PV : PC;
    double most;
    restart(p, rows, count, soft, n);
    for (p->steps = 0; p->steps < SG_PLAN_STEPS; ++p->steps) {
        point(p, n);
        int worst = worst_row(p, soft, &most), active = worst < -PV;
        for (int i = 0; i < p->count; ++i) active |= p->row[i] == worst;
        if (active) return FOUND;
        if (enter(p, worst, soft, n) != FOUND) return INFEASIBLE;
    }
    return TOO_MANY;
}

/* Whether the plan c from x is certain to keep every gap and limit for ever. */
static int judge_plan(sg_plan *p, long interval, const double *begin, const double *c) {
    double x[PN], off[PN], swings[PP][PK], beyond[PP + 1][PK], sum = 0;
    for (int i = 0; i < PN; ++i) x[i] = begin[i];
    for (int k = 0; k < PH; ++k, c += M) {
        int own = kind_of(interval + k), first = PLAN_FIRST[own], rows = PLAN_FIRST[own + 1] - first;
        double u[M] = {0}, *left = p->violation + p->offset[k], at_way[M];
        for (int i = 0; i < PN; ++i) off[i] = x[i] - PLAN_WAY[own][i];
        for (int s = 0; s < M; ++s) at_way[s] = c[s] - (own < PH ? PLAN_WAY_C[own][s] : 0);
        for (int i = 0; i <= PP; ++i) {
            double near[NEAR] = {0};
            apply_columns(&PLAN_NEAR_X[i][0][0], NEAR, off, PN, near, NEAR);
            apply_columns(&PLAN_NEAR_C[i][0][0], NEAR, at_way, M, near, NEAR);
            for (int j = 0; j < NEAR; ++j)
                if (!(size(near[j]) <= PLAN_BOX[own][j])) return 0;
            for (int m = 0; m < PK; ++m) beyond[i][m] = size(near[M + m]) - PLAN_REACH[own][i][m];
        }
        for (int i = 0; i < PP; ++i) {
            double pairs[2 * PK] = {0};
            apply_columns(&PLAN_SWING_X[i][0][0], 2 * PK, x, PN, pairs, 2 * PK);
            apply_columns(&PLAN_SWING_C[i][0][0], 2 * PK, c, M, pairs, 2 * PK);
            for (int m = 0; m < PK; ++m) {
                double a = size(pairs[2 * m]), b = size(pairs[2 * m + 1]);
                swings[i][m] = a > b ? a + DIAGONAL * b : b + DIAGONAL * a;
                if (!(swings[i][m] <= PLAN_MOST[own][i][m])) return 0;
            }
        }
        for (int i = 0; i <= PP; ++i)
            for (int m = 0; m < PK; ++m) {
                double a = swings[i > 0 ? i - 1 : 0][m], b = swings[i < PP ? i : PP - 1][m];
                beyond[i][m] += PLAN_BETWEEN[m] * (a > b ? a : b);
                if (!(beyond[i][m] > 0)) beyond[i][m] = 0;
            }
        apply_columns(&PLAN_K[0][0], M, x, PN, u, M);
        apply_columns(&PLAN_L[0][0], M, c, M, u, M);
        if (p->whole) { /* the rows of the program, with more room */
            for (int i = 0; i < rows; ++i) left[i] += PLAN_EXACT[first + i] - PLAN_FREE[first + i];
        } else {
            for (int i = 0; i < rows; ++i) left[i] = PLAN_EXACT[first + i];
            apply_columns(&PLAN_A[0][first], PR, x, PN, left, rows);
            apply_columns(&PLAN_NOW[0][first], PR, c, M, left, rows);
        }
        for (int i = 0; i < rows; ++i) {
            int r = first + i;
            if (PLAN_OBSTACLE[r] < 0) {
                if (!(left[i] >= -KEEPS)) return 0;
                continue;
            }
            double most = p->bend[r];
            for (int s = 0; s < M; ++s) most += size(PLAN_ALONG[r][s] * u[s]);
            if (left[i] >= most) continue;
            double one = dot(PLAN_LEAVES[r], swings[PLAN_PART[r][0]], PK);
            double other = dot(PLAN_LEAVES[r], swings[PLAN_PART[r][1]], PK), bend = one > other ? one : other;
            bend += dot(PLAN_ALONG[r], u, M);
            bend = (bend > 0 ? bend : 0) + dot(PLAN_SPREAD[r], beyond[PLAN_INSTANT[r]], PK);
            if (!(left[i] - bend >= 0)) return 0;
        }
        along_way(x, c);
    }
    for (int part = 0; part < 2; ++part) {
        double mode[PN] = {0};
        apply_columns(&PLAN_TAIL[part][0][0], PN, x, PN, mode, PN);
        for (int i = 0; i < PN; ++i) sum += size(mode[i]);
    }
    return sum <= 1;
}

static int taken(sg_plan *p, const double *x, const double *estimate, int outcome) {
    for (int i = 0; i < PN; ++i) p->x[i] = x[i];
    for (int b = 0; b < PC; ++b) p->now[b] = p->c[b];
    for (int i = 0; i < N; ++i) p->nominal[i] = estimate[i];
    return outcome;
}

/* Rows that stay active when an interval is gone. */
static void keep_rows(sg_plan *p, const int *rows, int count, int gone) {
    p->warm_count = 0;
    for (int i = 0; i < count; ++i)
        if (rows[i] >= gone) p->warm[p->warm_count++] = rows[i] - gone;
}

/* Choose the plan of an interval: a new one from the estimate, the last one, or one that gives up gaps. Without an
   estimate (NULL) the last one goes on. */
static int choose_plan(sg_plan *p, long interval, const double *estimate) {
    double x[PN] = {0}, off[N], way[SG_PLAN_SEEN] = {0}, step[SG_PLAN_MAPPED] = {0};
    int own = kind_of(interval), gone = PLAN_FIRST[own + 1] - PLAN_FIRST[own], left = 0, start[PS + 1], result;
    if (!estimate) return keep_rows(p, p->warm, p->warm_count, gone), SG_PLAN_KEPT;
    for (int i = 0; i < N; ++i) off[i] = estimate[i] - REST_AT_TARGET[i];
    apply_columns(&PLAN_T[0][0], SG_PLAN_MAPPED, off, N, x, SG_PLAN_MAPPED);
    for (int i = SG_PLAN_MAPPED; i < PN; ++i) x[i] = p->x[i]; /* the last input */
    for (int i = 0; i < N; ++i) off[i] = estimate[i] - p->nominal[i];
    apply_columns(&PLAN_T[0][0], SG_PLAN_MAPPED, off, N, step, SG_PLAN_MAPPED);
    apply_columns(&PLAN_SEES[0][0], SG_PLAN_SEEN, step, SG_PLAN_MAPPED, way, SG_PLAN_SEEN);
    for (int i = 0; i < SG_PLAN_SEEN; ++i) left |= !(size(way[i]) <= PLAN_TUBE[i]);
    begin_program(p, interval, x);
    result = solve_program(p, p->warm, p->warm_count, 0);
    keep_rows(p, result == FOUND ? p->row : p->warm, result == FOUND ? p->count : p->warm_count, gone);
    p->limited += result == TOO_MANY;
    if (result == FOUND && judge_plan(p, interval, x, p->c)) return taken(p, x, estimate, SG_PLAN_NEW);
    if (!left) return SG_PLAN_KEPT;
    for (int i = 0; i < PS; ++i) start[i] = -1 - i;
    result = solve_program(p, start, PS, 1);
    p->limited += result == TOO_MANY;
    return result == FOUND && defect(p->c, PC) == 0 ? taken(p, x, estimate, SG_PLAN_SOFT) : SG_PLAN_KEPT;
}

static void start_plan(sg_plan *p) {
    for (int i = 0; i < PN; ++i) p->x[i] = PLAN_START[i];
    for (int k = 0; k < PH; ++k)
        for (int s = 0; s < M; ++s) p->now[M * k + s] = PLAN_BEGIN[k][s];
    for (int i = 0; i < N; ++i) p->nominal[i] = PLAN_REST[i];
    for (int i = 0; i < M; ++i) p->input[i] = U_BAR[i];
    make_rows(p);
}

/* The plan of an interval, its input, and the state at its end. */
static void begin_interval(sg_plan *p, long interval, const double *estimate) {
    ++p->outcomes[choose_plan(p, interval, estimate)];
    for (int i = 0; i < M; ++i) p->input[i] = U_BAR[i];
    apply_columns(&PLAN_K[0][0], M, p->x, PN, p->input, M);
    apply_columns(&PLAN_L[0][0], M, p->now, M, p->input, M);
    along_way(p->x, p->now);
    for (int b = 0; b < PC; ++b) p->now[b] = b + M < PC ? p->now[b + M] : 0;
}

/* u = u_nom + K (x^ - x_nom); an estimate that is old or not finite begins no plan. */
static void follow_plan(sg_plan *p, long tick, const double estimate[N], int fresh, double u[M]) {
    fresh = fresh && defect(estimate, N) == 0;
    if (tick % SG_PLAN_EVERY == 0) begin_interval(p, tick / SG_PLAN_EVERY, fresh ? estimate : 0);
    for (int i = 0; i < M; ++i) u[i] = p->input[i];
    for (int j = 0; j < N; ++j) add(estimate[j] - p->nominal[j], K[j], u, M);
    ahead(p->nominal, p->input);
}

#endif
