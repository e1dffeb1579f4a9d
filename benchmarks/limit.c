/* The limit: three-rule boids as one writes them by hand in C for this one purpose; see limit.py, limit_kernel.h. */
#include <math.h>
#include <stdlib.h>
#include <string.h>
#ifdef __AVX512F__
#include <immintrin.h>
#endif

/* Memory that is kept from call to call, as flockenv keeps its own: for one thread. */
static void *scratch(int slot, size_t bytes) {
    static void *kept[7];
    static size_t sizes[7];
    if (sizes[slot] < bytes) {
        free(kept[slot]);
        sizes[slot] = (bytes + 63) / 64 * 64;
        kept[slot] = aligned_alloc(64, sizes[slot]);
        memset(kept[slot], 0, sizes[slot]);
    }
    return kept[slot];
}

#define JOIN(a, b) a##b
#define JOINED(a, b) JOIN(a, b)

#define REAL float
#define SUFFIX ps
#define VECTOR __m512
#define MASK __mmask16
#define INTEGER int
#define SQRT sqrtf
#define FLOOR floorf
#define D 2
#define NAME(x) JOINED(x, _f32_2d)
#include "limit_kernel.h"
#undef D
#undef NAME
#define D 3
#define NAME(x) JOINED(x, _f32_3d)
#include "limit_kernel.h"
#undef D
#undef NAME
#undef REAL
#undef SUFFIX
#undef VECTOR
#undef MASK
#undef INTEGER
#undef SQRT
#undef FLOOR

#define REAL double
#define SUFFIX pd
#define VECTOR __m512d
#define MASK __mmask8
#define INTEGER long
#define SQRT sqrt
#define FLOOR floor
#define D 2
#define NAME(x) JOINED(x, _f64_2d)
#include "limit_kernel.h"
#undef D
#undef NAME
#define D 3
#define NAME(x) JOINED(x, _f64_3d)
#include "limit_kernel.h"
