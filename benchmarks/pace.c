/* What this machine can do at most: independent vector operations, half of them fused multiply-adds; see limit.py. */
#if defined(__AVX512F__)
#define BYTES 64
#define REGISTER "+v"
#elif defined(__AVX__)
#define BYTES 32
#define REGISTER "+x"
#elif defined(__x86_64__)
#define BYTES 16
#define REGISTER "+x"
#else
#define BYTES 16
#define REGISTER "+w"
#endif

/* As many chains of each kind as there are registers for: they hide how long an operation takes. */
#define SIX(do) do(0) do(1) do(2) do(3) do(4) do(5)
#if BYTES == 64
#define CHAINS(do) SIX(do) do(6) do(7) do(8) do(9) do(10) do(11)
#define COUNT 12
#else
#define CHAINS(do) SIX(do) do(6)
#define COUNT 7
#endif
#define BEGIN(k) vector a##k = some, b##k = some;
#define GO_ON(k)              \
    a##k = a##k * some + some; \
    b##k = b##k + some;        \
    __asm__ volatile("" : REGISTER(a##k), REGISTER(b##k));

/* Return how many operations were done, each lane of a vector counted, and a multiply-add as one. */
#define OPERATIONS(name, REAL)                                   \
    long name(long rounds) {                                     \
        typedef REAL vector __attribute__((vector_size(BYTES))); \
        vector some = {0};                                       \
        some += (REAL)1.0000001;                                 \
        CHAINS(BEGIN)                                            \
        for (long r = 0; r < rounds; r++) { CHAINS(GO_ON) }      \
        return rounds * 2 * COUNT * (BYTES / (long)sizeof(REAL)); \
    }

OPERATIONS(operations_float32, float)
OPERATIONS(operations_float64, double)
