/* One precision and one dimension of the reference; limit.c includes this file four times with REAL, D and NAME set.

   The work of one step, the same as Scene.step does for three rules: the rules' sums over all others on a torus
   (minimum image), each rule with a radius of its own; the wish limited to max_force; semi-implicit Euler; the speed
   and the displacement limited to max_speed; back into the torus. W agents side by side in a vector register. */

#define VEC NAME(vec)
#define ALL NAME(all)
#define LESS NAME(less)
#define KEEP NAME(keep)
#define ADD NAME(add)
#define ONE_MORE NAME(one_more)
#define W ((long)(sizeof(VEC) / sizeof(REAL)))
#if BYTES == 64
typedef VECTOR VEC, NAME(many);
typedef MASK NAME(mask);
static inline VEC ALL(REAL a) { return JOINED(_mm512_set1_, SUFFIX)(a); }
static inline VEC KEEP(NAME(mask) m, VEC v) { return JOINED(_mm512_maskz_mov_, SUFFIX)(m, v); }
static inline VEC ADD(NAME(mask) m, VEC a, VEC b) { return JOINED(_mm512_mask_add_, SUFFIX)(a, m, a, b); }
static inline long NAME(lanes)(NAME(mask) m) { return m; }
static inline VEC NAME(inverse)(NAME(mask) m, VEC a) { return JOINED(_mm512_maskz_div_, SUFFIX)(m, ALL(1), a); }
static inline NAME(mask) LESS(VEC a, VEC b) { return JOINED(JOINED(_mm512_cmp_, SUFFIX), _mask)(a, b, _CMP_LT_OQ); }
static inline VEC NAME(root)(VEC v) { return JOINED(_mm512_sqrt_, SUFFIX)(v); }
static inline VEC NAME(whole)(VEC v) { return JOINED(_mm512_roundscale_, SUFFIX)(v, _MM_FROUND_TO_NEG_INF); }
static inline VEC ONE_MORE(NAME(mask) m, VEC a) { return ADD(m, a, ALL(1)); }
static inline VEC NAME(number)(VEC a) { return a; }
#else /* a mask is a vector of integers: -1, or 0; and so is what is counted */
typedef INTEGER NAME(mask) __attribute__((vector_size(BYTES)));
typedef NAME(mask) NAME(many);
#if BYTES == 32
typedef VECTOR VEC;
static inline VEC ALL(REAL a) { return JOINED(_mm256_set1_, SUFFIX)(a); }
static inline long NAME(lanes)(NAME(mask) m) { return JOINED(_mm256_movemask_, SUFFIX)((VEC)m); }
static inline VEC NAME(root)(VEC v) { return JOINED(_mm256_sqrt_, SUFFIX)(v); }
static inline VEC NAME(whole)(VEC v) { return JOINED(_mm256_floor_, SUFFIX)(v); }
static inline NAME(mask) LESS(VEC a, VEC b) { return (NAME(mask))JOINED(_mm256_cmp_, SUFFIX)(a, b, _CMP_LT_OQ); }
#else
typedef REAL VEC __attribute__((vector_size(BYTES)));
static inline VEC ALL(REAL a) { VEC v = {0}; return v + a; }
static inline long NAME(lanes)(NAME(mask) m) { long b = 0; for (int l = 0; l < W; l++) b |= (m[l] & 1L) << l; return b; }
static inline VEC NAME(root)(VEC v) { for (int l = 0; l < W; l++) v[l] = SQRT(v[l]); return v; }
static inline VEC NAME(whole)(VEC v) { for (int l = 0; l < W; l++) v[l] = FLOOR(v[l]); return v; }
static inline NAME(mask) LESS(VEC a, VEC b) { return a < b; }
#endif
static inline VEC KEEP(NAME(mask) m, VEC v) { return (VEC)((NAME(mask))v & m); }
static inline VEC ADD(NAME(mask) m, VEC a, VEC b) { return a + KEEP(m, b); }
static inline VEC NAME(inverse)(NAME(mask) m, VEC a) { return KEEP(m, 1 / a); }
static inline NAME(mask) ONE_MORE(NAME(mask) m, NAME(mask) a) { return a - m; }
static inline VEC NAME(number)(NAME(mask) a) { return __builtin_convertvector(a, VEC); }
#endif

typedef struct { VEC push[D], speed[D], centre[D]; NAME(many) mates, company; } NAME(sums);
typedef struct { VEC x[D], v[D], t[D]; } NAME(block);
typedef struct { REAL size, apart, agree, near, w_apart, w_agree, w_near, force, speed, dt; } NAME(rules);

/* One candidate against a block: `image` asks for the nearest periodic image. A block meets itself too, in lane `self`
   (-1 is none). Agents in one place part along the difference of their ties: seldom, so that a branch costs nothing. */
static inline void NAME(meet)(NAME(sums) *s, const NAME(block) *me, const REAL *xj, const REAL *vj,
                              const REAL *tj, int image, long self, const NAME(rules) *p) {
    VEC d[D], square;
    for (int k = 0; k < D; k++) {
        d[k] = ALL(xj[k]) - me->x[k];
        if (image) d[k] -= p->size * (d[k] * (1 / p->size) + ONES - ONES); /* to the nearest whole number of boxes */
        square = k ? square + d[k] * d[k] : d[k] * d[k];
    }
    NAME(mask) agree = LESS(square, ALL(p->agree * p->agree)), near = LESS(square, ALL(p->near * p->near));
    NAME(mask) apart = LESS(ALL((REAL)1e-30), square), close = LESS(square, ALL(p->apart * p->apart));
    VEC share = KEEP(apart & close, -1 / square);
    for (int k = 0; k < D; k++) {
        s->push[k] += d[k] * share;
        s->speed[k] = ADD(agree, s->speed[k], ALL(vj[k]));
        s->centre[k] = ADD(near, s->centre[k], d[k]);
    }
    s->mates = ONE_MORE(agree, s->mates);
    s->company = ONE_MORE(near, s->company);
    NAME(mask) one_place = LESS(square, ALL((REAL)1e-30));
    if (__builtin_expect(NAME(lanes)(one_place) & ~(self < 0 ? 0L : 1L << self), 0))
        for (int k = 0; k < D; k++) s->push[k] = ADD(one_place, s->push[k], me->t[k] - ALL(tj[k]));
}

/* 1 where the square of a length is within a limit, else by how much the length is to be multiplied. */
static inline VEC NAME(cut)(REAL limit, VEC square) {
    VEC one = ALL(1);
    return one + KEEP(LESS(ALL(limit * limit), square), limit / NAME(root)(square) - one);
}

/* A block as it is now, and nothing summed up yet. */
static inline NAME(block) NAME(begin)(const REAL *now, long padded, long first, NAME(sums) *s) {
    NAME(block) me;
    memset(s, 0, sizeof *s);
    for (int k = 0; k < D; k++) {
        memcpy(&me.x[k], now + k * padded + first, sizeof(VEC));
        memcpy(&me.v[k], now + (D + k) * padded + first, sizeof(VEC));
        memcpy(&me.t[k], now + (2 * D + k) * padded + first, sizeof(VEC));
    }
    return me;
}

/* Sums (oneself counts among one's mates and company) -> wish -> velocity and position of a block, put into `next`. */
static inline void NAME(move)(const NAME(sums) *s, const NAME(block) *me, const NAME(rules) *p, REAL *next, long padded,
                              long first) {
    VEC one = ALL(1), wish[D], square = ALL(0), fast = ALL(0);
    VEC others = NAME(number)(s->mates) - one, all = NAME(number)(s->company) - one;
    NAME(mask) some = LESS(ALL(0), others);
    VEC mates = NAME(inverse)(some, others), company = NAME(inverse)(LESS(ALL(0), all), all);
    for (int k = 0; k < D; k++) {
        VEC agree = (s->speed[k] - me->v[k]) * mates - KEEP(some, me->v[k]);
        wish[k] = p->w_apart * s->push[k] + p->w_agree * agree + p->w_near * (s->centre[k] * company);
        square += wish[k] * wish[k];
    }
    VEC cut = p->dt * NAME(cut)(p->force, square), v[D];
    for (int k = 0; k < D; k++) {
        v[k] = me->v[k] + wish[k] * cut;
        fast += v[k] * v[k];
    }
    VEC slow = NAME(cut)(p->speed, fast); /* who is not too fast does not go too far either */
    for (int k = 0; k < D; k++) {
        v[k] *= slow;
        VEC x = me->x[k] + p->dt * v[k];
        x -= p->size * NAME(whole)(x * (1 / p->size));
        x = KEEP(LESS(x, ALL(p->size)) & LESS(ALL(-1), x), x);
        memcpy(next + k * padded + first, &x, sizeof(VEC));
        memcpy(next + (D + k) * padded + first, &v[k], sizeof(VEC));
    }
}

/* B worlds of N agents, brute force; x and v are (D, B, N) and updated in place, ties (D, N) are directions of all
   worlds. A world does all its steps at once. */
void NAME(worlds)(REAL *restrict x, REAL *restrict v, const REAL *restrict ties, long worlds, long n, long steps,
                  const REAL *numbers) {
    const NAME(rules) p = *(const NAME(rules) *)numbers;
    long plane = worlds * n, padded = (n + W - 1) / W * W, all = 3 * D * padded;
    REAL *now = scratch(0, all * sizeof(REAL)), *next = scratch(1, all * sizeof(REAL));
    memset(now, 0, all * sizeof(REAL));
    memset(next, 0, all * sizeof(REAL));
    for (int k = 0; k < D; k++) {
        memcpy(now + (2 * D + k) * padded, ties + k * n, n * sizeof(REAL));
        memcpy(next + (2 * D + k) * padded, ties + k * n, n * sizeof(REAL));
    }
    for (long b = 0; b < worlds; b++) {
        for (int k = 0; k < D; k++) {
            memcpy(now + k * padded, x + k * plane + b * n, n * sizeof(REAL));
            memcpy(now + (D + k) * padded, v + k * plane + b * n, n * sizeof(REAL));
        }
        for (long t = 0; t < steps; t++) {
            for (long first = 0; first < n; first += W) {
                NAME(sums) s;
                NAME(block) me = NAME(begin)(now, padded, first, &s);
                for (long j = 0; j < n; j++) {
                    REAL xj[D], vj[D], tj[D];
                    for (int k = 0; k < D; k++) {
                        xj[k] = now[k * padded + j], vj[k] = now[(D + k) * padded + j];
                        tj[k] = now[(2 * D + k) * padded + j];
                    }
                    NAME(meet)(&s, &me, xj, vj, tj, 1, j - first < W ? j - first : -1, &p);
                }
                NAME(move)(&s, &me, &p, next, padded, first);
            }
            REAL *swap = now;
            now = next, next = swap;
        }
        for (int k = 0; k < D; k++) {
            memcpy(x + k * plane + b * n, now + k * padded, n * sizeof(REAL));
            memcpy(v + k * plane + b * n, now + (D + k) * padded, n * sizeof(REAL));
        }
    }
}

/* One large world: agents sorted by cell, (3 D, padded) each in `now` and `next`, and where each cell begins. Rows of
   cells are a reach high; a cell is a third of a reach long, so that a block meets few agents out of its reach. */
#define FINE 3
typedef struct {
    long n, padded, nx, ny, rows;
    REAL *now, *next;
    int *who, *whose, *cell, *start; /* whose agents those of now and next are */
    struct NAME(record) { REAL numbers[3 * D]; int who; } *records;
} NAME(grid);

/* Find the cell of each agent of `next`, and how many there are in those before it: at start[c + 1] for cell c. */
static void NAME(count)(NAME(grid) *g, REAL size) {
    const REAL *restrict x = g->next, across = g->nx / size, along = g->ny / size;
    int *restrict cell = g->cell, nx = (int)g->nx, ny = (int)g->ny;
    memset(g->start, 0, (g->nx * g->rows + 2) * sizeof(int));
    for (long i = 0; i < g->n; i++) {
        int c = (int)(x[i] * across), row = 0;
        for (int k = D - 1; k > 0; k--) {
            int part = (int)(x[k * g->padded + i] * along);
            row = row * ny + (part < ny ? part : ny - 1);
        }
        cell[i] = row * nx + (c < nx ? c : nx - 1);
    }
    for (long i = 0; i < g->n; i++) g->start[cell[i] + 2]++;
    for (long c = 0; c < g->nx * g->rows; c++) g->start[c + 2] += g->start[c + 1];
}

/* Sort `next` into `now`, from the order of ids: whole records, so that each agent is one distant cache line. */
static void NAME(gather)(NAME(grid) *g) {
    for (long i = 0; i < g->n; i++) {
        struct NAME(record) r = {.who = (int)i};
        for (int k = 0; k < 3 * D; k++) r.numbers[k] = g->next[k * g->padded + i];
        g->records[g->start[g->cell[i] + 1]++] = r;
    }
    for (long i = 0; i < g->n; i++) {
        for (int k = 0; k < 3 * D; k++) g->now[k * g->padded + i] = g->records[i].numbers[k];
        g->who[i] = g->records[i].who;
    }
}

/* The same from the order of the step before: nobody goes far. */
static void NAME(settle)(NAME(grid) *g) {
    for (long i = 0; i < g->n; i++) {
        long to = g->start[g->cell[i] + 1]++;
        g->who[to] = g->whose[i];
        for (int k = 0; k < 3 * D; k++) g->now[k * g->padded + to] = g->next[k * g->padded + i];
    }
}

/* Put `next` back into the order of ids. */
static void NAME(scatter)(NAME(grid) *g, REAL *restrict x, REAL *restrict v) {
    for (long i = 0; i < g->n; i++)
        for (int k = 0; k < 2 * D; k++) g->records[g->who[i]].numbers[k] = g->next[k * g->padded + i];
    for (long i = 0; i < g->n; i++)
        for (int k = 0; k < D; k++) {
            x[k * g->n + i] = g->records[i].numbers[k];
            v[k * g->n + i] = g->records[i].numbers[D + k];
        }
}

/* Move the agents of one row of cells from `now` to `next`; candidates are contiguous ranges of 3 (9) rows. It is not
   inlined, because GCC then spills what a block holds in registers. */
static __attribute__((noinline)) void NAME(row)(const NAME(grid) *g, long row, const NAME(rules) *rules) {
    const NAME(rules) p = *rules;
    const REAL *restrict now = g->now;
    long nx = g->nx, ny = g->ny, padded = g->padded, y = row % ny, z = row / ny, around = 0, at = 0;
    const int *begin[9], *mine = g->start + row * nx;
    REAL shift[9][3] = {0};
    for (long dz = D == 3 ? -1 : 0; dz <= (D == 3 ? 1 : 0); dz++)
        for (long dy = -1; dy <= 1; dy++, around++) {
            long west = y + dy < 0, east = y + dy == ny, below = D == 3 && z + dz < 0, above = D == 3 && z + dz == ny;
            long yy = y + dy + ny * (west - east), zz = z + dz + ny * (below - above);
            shift[around][1] = p.size * (east - west);
            shift[around][2] = p.size * (above - below);
            begin[around] = g->start + (zz * ny + yy) * nx;
        }
    for (long first = mine[0], stop = mine[nx]; first < stop; first += W) {
        long end = first + W < stop ? first + W : stop;
        while (mine[at + 1] <= first) at++;
        long west = at - FINE, east = at;
        while (mine[east + 1] < end) east++;
        east += FINE;
        NAME(sums) s;
        NAME(block) me = NAME(begin)(now, padded, first, &s);
        for (int r = 0; r < around; r++)
            for (int piece = west < 0 ? -1 : 0; piece <= (east >= nx); piece++) { /* -1 and 1: around the edge */
                long from = piece < 0 ? west + nx : piece > 0 || west < 0 ? 0 : west;
                long to = piece < 0 ? nx : piece > 0 ? east - nx + 1 : east >= nx ? nx : east + 1;
                REAL near[D] = {piece * p.size};
                for (int k = 1; k < D; k++) near[k] = shift[r][k];
                for (long j = begin[r][from], last = begin[r][to]; j < last; j++) {
                    REAL xj[D], vj[D], tj[D];
                    for (int k = 0; k < D; k++) {
                        xj[k] = now[k * padded + j] + near[k], vj[k] = now[(D + k) * padded + j];
                        tj[k] = now[(2 * D + k) * padded + j];
                    }
                    NAME(meet)(&s, &me, xj, vj, tj, 0, j - first < W ? j - first : -1, &p);
                }
            }
        NAME(move)(&s, &me, &p, g->next, padded, first);
        for (int k = 0; k < D; k++) /* whoever comes after `stop` is written by the next row */
            memcpy(g->next + (2 * D + k) * padded + first, &me.t[k], sizeof(VEC));
    }
}

/* One world of N agents; x and v are (D, N) and updated in place. Agents stay sorted by cell from step to step. */
void NAME(crowd)(REAL *restrict x, REAL *restrict v, const REAL *restrict ties, long n, long steps,
                 const REAL *numbers) {
    const NAME(rules) p = *(const NAME(rules) *)numbers;
    REAL reach = p.near > p.agree ? p.near : p.agree;
    if (p.apart > reach) reach = p.apart;
    NAME(grid) g = {.n = n, .padded = n + W, .ny = (long)(p.size / (reach * (REAL)1.001))};
    g.nx = FINE * g.ny, g.rows = D == 3 ? g.ny * g.ny : g.ny;
    g.now = scratch(0, 3 * D * g.padded * sizeof(REAL)), g.next = scratch(1, 3 * D * g.padded * sizeof(REAL));
    g.who = scratch(2, n * sizeof(int)), g.whose = scratch(3, n * sizeof(int)), g.cell = scratch(4, n * sizeof(int));
    g.start = scratch(5, (g.nx * g.rows + 2) * sizeof(int)), g.records = scratch(6, n * sizeof(struct NAME(record)));
    for (int k = 0; k < D; k++) {
        memcpy(g.next + k * g.padded, x + k * n, n * sizeof(REAL));
        memcpy(g.next + (D + k) * g.padded, v + k * n, n * sizeof(REAL));
        memcpy(g.next + (2 * D + k) * g.padded, ties + k * n, n * sizeof(REAL));
    }
    for (long t = 0; t < steps; t++) {
        int *swap = g.who;
        g.who = g.whose, g.whose = swap;
        NAME(count)(&g, p.size);
        if (t == 0) NAME(gather)(&g); else NAME(settle)(&g);
        for (long row = 0; row < g.rows; row++) NAME(row)(&g, row, &p);
    }
    if (steps > 0) NAME(scatter)(&g, x, v);
}

#undef FINE
#undef W
#undef VEC
#undef ALL
#undef LESS
#undef KEEP
#undef ADD
#undef ONE_MORE
