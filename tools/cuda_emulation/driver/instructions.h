/* Instructions of PTX as C, for translated kernels. Registers hold bits: F, B, D and BD turn them to numbers and back.
 *
 * Source: PTX ISA 9.0, chapter 9.7. Subnormal float32 numbers are flushed to zero where the manual says .ftz.
 */
#pragma once
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include "executor.h"

#ifdef __TINYC__ /* lacks these */
static int count_bits(uint64_t x) { int n = 0; for (; x; x &= x - 1) n++; return n; }
static int leading_zeros(uint32_t x) { int n = 0; for (; !(x & 0x80000000u); x <<= 1) n++; return n; }
#define __builtin_popcount(x) count_bits((uint32_t) (x))
#define __builtin_popcountll count_bits
#define __builtin_clz leading_zeros
#define INLINE static inline
#else
#define INLINE static inline __attribute__((always_inline, unused))
#endif

/* ---- Bits and memory ------------------------------------------------------------------------------------------- */

INLINE float F(uint32_t bits) { float x; memcpy(&x, &bits, 4); return x; }
INLINE uint32_t B(float x) { uint32_t bits; memcpy(&bits, &x, 4); return bits; }
INLINE double D(uint64_t bits) { double x; memcpy(&x, &bits, 8); return x; }
INLINE uint64_t BD(double x) { uint64_t bits; memcpy(&bits, &x, 8); return bits; }
INLINE uint32_t flushed(uint32_t x) { return x & 0x7f800000u ? x : x & 0x80000000u; }
INLINE float FZ(uint32_t x) { return F(flushed(x)); }

#define LOAD(T, p) ({ T loaded; memcpy(&loaded, (const void *) (uintptr_t) (p), sizeof loaded); loaded; })
#define STORE(T, p, x) do { T stored = (T) (x); memcpy((void *) (uintptr_t) (p), &stored, sizeof stored); } while (0)
#define ATOMIC(T, p, expression) ({ T old = LOAD(T, p); STORE(T, p, expression); old; })
/* A device faults where a vector does not begin at a multiple of its size. */
#define ALIGNED(p, bytes) do { if ((uintptr_t) (p) % (bytes)) fault(bytes); } while (0)
static void fault(int bytes) {
    fprintf(stderr, "Emulated CUDA device: %d bytes do not lie at a multiple of their size.\n", bytes);
    abort();
}

/* ---- Approximate instructions: exact; with APPROXIMATE, off by as much as the manual allows ---------------------- */

#ifdef APPROXIMATE /* a hash of the operands decides how far, so that equal operands give equal results */
INLINE float near(double exact, uint64_t key, double ulps) {
    float rounded = (float) exact;
    if (!isfinite(rounded) || rounded == 0.0f) return rounded;
    key *= 0x9E3779B97F4A7C15ull;
    key = (key ^ key >> 29) * 0xBF58476D1CE4E5B9ull;
    double place = (key >> 32) / 4294967296.0 * 2.0 - 1.0;
    return (float) (exact + place * ulps * ldexp(1.0, ilogb(rounded) - 23));
}
#else
INLINE float near(double exact, uint64_t key, double ulps) { (void) key; (void) ulps; return (float) exact; }
#endif
INLINE uint32_t rcp_approx(uint32_t a) { return flushed(B(near(1.0 / FZ(a), a, 1.0))); }
INLINE uint32_t sqrt_approx(uint32_t a) { return flushed(B(near(sqrt(FZ(a)), a ^ 1ull << 40, 1.0))); }
INLINE uint32_t rsqrt_approx(uint32_t a) { return flushed(B(near(1.0 / sqrt(FZ(a)), a ^ 2ull << 40, 1.0))); }
INLINE uint32_t lg2_approx(uint32_t a) { return flushed(B(near(log2(FZ(a)), a ^ 3ull << 40, 1.0))); }
INLINE uint32_t ex2_approx(uint32_t a) {
    double x = FZ(a);
    return flushed(B(x == rint(x) ? (float) exp2(x) : near(exp2(x), a ^ 4ull << 40, 2.0)));
}
INLINE uint32_t div_approx(uint32_t a, uint32_t b) {
    double x = FZ(a), y = FZ(b);
    if (isfinite(y) && fabs(y) > 8.507059173023462e37) return isinf(x) ? 0x7fffffffu : (a ^ b) & 0x80000000u;
    return flushed(B(near(x / y, (uint64_t) a << 32 | b, 2.0)));
}
/* Has the first twenty bits of the fraction. */
INLINE uint64_t rcp_approx_f64(uint64_t a) { return BD(1.0 / D(a)) & 0xffffffff00000000ull; }

/* ---- Floating-point arithmetic --------------------------------------------------------------------------------- */

INLINE uint32_t add_ftz(uint32_t a, uint32_t b) { return flushed(B(FZ(a) + FZ(b))); }
INLINE uint32_t sub_ftz(uint32_t a, uint32_t b) { return flushed(B(FZ(a) - FZ(b))); }
INLINE uint32_t mul_ftz(uint32_t a, uint32_t b) { return flushed(B(FZ(a) * FZ(b))); }
INLINE uint32_t fma_ftz(uint32_t a, uint32_t b, uint32_t c) { return flushed(B(fmaf(FZ(a), FZ(b), FZ(c)))); }
INLINE uint32_t neg_ftz(uint32_t a) { return flushed(a) ^ 0x80000000u; }

/* A NaN loses against a number, and -0 is less than +0. */
#define EXTREME(name, T, NUMBER, NOT_A_NUMBER, SIGN, FIRST_WINS, ZERO_FIRST) \
    INLINE T name(T a, T b) { \
        if (NUMBER(a) != NUMBER(a)) return NUMBER(b) != NUMBER(b) ? NOT_A_NUMBER : b; \
        if (NUMBER(b) != NUMBER(b)) return a; \
        if (NUMBER(a) == 0 && NUMBER(b) == 0) return (a >> SIGN) == ZERO_FIRST ? a : b; \
        return NUMBER(a) FIRST_WINS NUMBER(b) ? a : b; \
    }
EXTREME(min_f32, uint32_t, F, 0x7fffffffu, 31, <, 1)
EXTREME(max_f32, uint32_t, F, 0x7fffffffu, 31, >, 0)
EXTREME(min_f64, uint64_t, D, 0x7fffffffffffffffull, 63, <, 1)
EXTREME(max_f64, uint64_t, D, 0x7fffffffffffffffull, 63, >, 0)

#define CLAMPED(T, low, high) (x <= (double) (low) ? (T) (low) : x >= (double) (high) ? (T) (high) : (T) x)
INLINE uint32_t to_s32(double x) { return x != x ? 0 : (uint32_t) CLAMPED(int32_t, INT32_MIN, INT32_MAX); }
INLINE uint32_t to_u32(double x) { return x != x ? 0 : CLAMPED(uint32_t, 0, UINT32_MAX); }
INLINE uint64_t to_s64(double x) { return x != x ? 1ull << 63 : (uint64_t) CLAMPED(int64_t, INT64_MIN, INT64_MAX); }
INLINE uint64_t to_u64(double x) { return x != x ? 1ull << 63 : CLAMPED(uint64_t, 0, UINT64_MAX); }

/* ---- Integers -------------------------------------------------------------------------------------------------- */

INLINE uint32_t shl32(uint32_t a, uint32_t b) { return b > 31 ? 0 : a << b; }
INLINE uint32_t shr32(uint32_t a, uint32_t b) { return b > 31 ? 0 : a >> b; }
INLINE uint32_t sar32(uint32_t a, uint32_t b) { return (uint32_t) ((int32_t) a >> (b > 31 ? 31 : b)); }
INLINE uint64_t shl64(uint64_t a, uint32_t b) { return b > 63 ? 0 : a << b; }
INLINE uint64_t shr64(uint64_t a, uint32_t b) { return b > 63 ? 0 : a >> b; }
INLINE uint64_t sar64(uint64_t a, uint32_t b) { return (uint64_t) ((int64_t) a >> (b > 63 ? 63 : b)); }
INLINE uint32_t clz32(uint32_t a) { return a ? (uint32_t) __builtin_clz(a) : 32u; }
INLINE uint32_t bfind32(uint32_t a, int as_shift) { return !a ? 0xffffffffu : as_shift ? clz32(a) : 31u - clz32(a); }
INLINE uint32_t brev32(uint32_t a) {
    uint32_t reversed = 0;
    for (int i = 0; i < 32; i++) reversed |= (a >> i & 1u) << (31 - i);
    return reversed;
}
INLINE uint32_t bfe_u32(uint32_t a, uint32_t position, uint32_t length) {
    position &= 255;
    length &= 255;
    return position > 31 ? 0 : (a >> position) & (length > 31 ? 0xffffffffu : (1u << length) - 1);
}
INLINE uint32_t prmt(uint32_t a, uint32_t b, uint32_t selector) {
    uint64_t bytes = (uint64_t) b << 32 | a;
    uint32_t permuted = 0;
    for (int i = 0; i < 4; i++) {
        uint32_t choice = selector >> (4 * i) & 15, byte = bytes >> (8 * (choice & 7)) & 255;
        if (choice & 8) byte = byte & 128 ? 255 : 0;
        permuted |= byte << (8 * i);
    }
    return permuted;
}
