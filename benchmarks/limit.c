/* The limit: three-rule boids as one writes them by hand in C for this one purpose; see limit.py, limit_kernel.h. */
#include <math.h>
#include <stdlib.h>
#include <string.h>
#if defined(__AVX512F__)
#include <immintrin.h>
#define BYTES 64
#define FORM "AVX-512 intrinsics"
#elif defined(__AVX2__) && defined(__FMA__)
#include <immintrin.h>
#define BYTES 32
#define FORM "AVX2 intrinsics"
#else
#define BYTES 16
#define FORM "vectors of 16 bytes as GCC makes them: no limit on any machine"
#endif

/* What it is written in on this machine. */
const char *form(void) { return FORM; }

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
#define INTEGER int
#if BYTES == 64
#define VECTOR __m512
#define MASK __mmask16
#elif BYTES == 32
#define VECTOR __m256
#endif
#define SQRT sqrtf
#define FLOOR floorf
#define ONES 0x1.8p23f /* its last digit counts ones */
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
#undef ONES

#define REAL double
#define SUFFIX pd
#define INTEGER long
#if BYTES == 64
#define VECTOR __m512d
#define MASK __mmask8
#elif BYTES == 32
#define VECTOR __m256d
#endif
#define SQRT sqrt
#define FLOOR floor
#define ONES 0x1.8p52
#define D 2
#define NAME(x) JOINED(x, _f64_2d)
#include "limit_kernel.h"
#undef D
#undef NAME
#define D 3
#define NAME(x) JOINED(x, _f64_3d)
#include "limit_kernel.h"
