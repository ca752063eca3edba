// SPDX-License-Identifier: GPL-3.0-or-later
// The few vector operations the tile kernels are written in. HOLOREEL_LANES (4 or 8) is set by the translation unit, and
// everything lives in a namespace of that width, so the two builds never share a symbol.
#pragma once

#include <stdint.h>

#if HOLOREEL_LANES == 8 || defined(__SSE4_1__)
#include <immintrin.h>
#elif defined(__ARM_NEON)
#include <arm_neon.h>
#endif

#define HOLOREEL_INLINE static inline __attribute__((always_inline))
#define HOLOREEL_INLINE_MEMBER inline __attribute__((always_inline))

namespace holoreel {
namespace HOLOREEL_NAMESPACE {

constexpr int kLanes = HOLOREEL_LANES;

#if HOLOREEL_LANES == 8

using F = __m256;
using Mask = __m256;
HOLOREEL_INLINE F set1(float x) { return _mm256_set1_ps(x); }
HOLOREEL_INLINE F centers() { return _mm256_setr_ps(-3.5f, -2.5f, -1.5f, -0.5f, 0.5f, 1.5f, 2.5f, 3.5f); }
HOLOREEL_INLINE F load(const float* p) { return _mm256_loadu_ps(p); }
HOLOREEL_INLINE void store(float* p, F a) { _mm256_storeu_ps(p, a); }
HOLOREEL_INLINE F add(F a, F b) { return _mm256_add_ps(a, b); }
HOLOREEL_INLINE F sub(F a, F b) { return _mm256_sub_ps(a, b); }
HOLOREEL_INLINE F mul(F a, F b) { return _mm256_mul_ps(a, b); }
HOLOREEL_INLINE F div(F a, F b) { return _mm256_div_ps(a, b); }
HOLOREEL_INLINE F sqrt(F a) { return _mm256_sqrt_ps(a); }
HOLOREEL_INLINE F min(F a, F b) { return _mm256_min_ps(a, b); }
HOLOREEL_INLINE F max(F a, F b) { return _mm256_max_ps(a, b); }
HOLOREEL_INLINE F fma(F a, F b, F c) { return _mm256_fmadd_ps(a, b, c); }
HOLOREEL_INLINE F fnma(F a, F b, F c) { return _mm256_fnmadd_ps(a, b, c); }
HOLOREEL_INLINE F negate(F a) { return _mm256_xor_ps(a, _mm256_set1_ps(-0.0f)); }
HOLOREEL_INLINE F abs(F a) { return _mm256_andnot_ps(_mm256_set1_ps(-0.0f), a); }
HOLOREEL_INLINE Mask ge(F a, F b) { return _mm256_cmp_ps(a, b, _CMP_GE_OQ); }
HOLOREEL_INLINE Mask gt(F a, F b) { return _mm256_cmp_ps(a, b, _CMP_GT_OQ); }
HOLOREEL_INLINE Mask both(Mask a, Mask b) { return _mm256_and_ps(a, b); }
HOLOREEL_INLINE F keep(Mask m, F a) { return _mm256_and_ps(m, a); }
HOLOREEL_INLINE F select(Mask m, F a, F b) { return _mm256_blendv_ps(b, a, m); }
HOLOREEL_INLINE bool any(Mask m) { return _mm256_movemask_ps(m) != 0; }
// p = n + fraction with n the nearest integer; returns n in the place of a float's exponent.
HOLOREEL_INLINE F split_power(F p, F& fraction) {
    const __m256i n = _mm256_cvtps_epi32(p);
    fraction = _mm256_sub_ps(p, _mm256_cvtepi32_ps(n));
    return _mm256_castsi256_ps(_mm256_slli_epi32(n, 23));
}
HOLOREEL_INLINE F add_exponent(F a, F shifted) {
    return _mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(a), _mm256_castps_si256(shifted)));
}
// The sums over lanes of kLanes vectors.
HOLOREEL_INLINE void sum_lanes(const F* a, float* out) {
    const F x0 = _mm256_hadd_ps(a[0], a[1]), x1 = _mm256_hadd_ps(a[2], a[3]);
    const F x2 = _mm256_hadd_ps(a[4], a[5]), x3 = _mm256_hadd_ps(a[6], a[7]);
    const F y0 = _mm256_hadd_ps(x0, x1), y1 = _mm256_hadd_ps(x2, x3);
    store(out, _mm256_add_ps(_mm256_permute2f128_ps(y0, y1, 0x20), _mm256_permute2f128_ps(y0, y1, 0x31)));
}
HOLOREEL_INLINE float sum_one(F a) {
    __m128 x = _mm_add_ps(_mm256_castps256_ps128(a), _mm256_extractf128_ps(a, 1));
    x = _mm_add_ps(x, _mm_movehl_ps(x, x));
    return _mm_cvtss_f32(_mm_add_ss(x, _mm_movehdup_ps(x)));
}

#elif defined(__SSE4_1__)

using F = __m128;
using Mask = __m128;
HOLOREEL_INLINE F set1(float x) { return _mm_set1_ps(x); }
HOLOREEL_INLINE F centers() { return _mm_setr_ps(-1.5f, -0.5f, 0.5f, 1.5f); }
HOLOREEL_INLINE F load(const float* p) { return _mm_loadu_ps(p); }
HOLOREEL_INLINE void store(float* p, F a) { _mm_storeu_ps(p, a); }
HOLOREEL_INLINE F add(F a, F b) { return _mm_add_ps(a, b); }
HOLOREEL_INLINE F sub(F a, F b) { return _mm_sub_ps(a, b); }
HOLOREEL_INLINE F mul(F a, F b) { return _mm_mul_ps(a, b); }
HOLOREEL_INLINE F div(F a, F b) { return _mm_div_ps(a, b); }
HOLOREEL_INLINE F sqrt(F a) { return _mm_sqrt_ps(a); }
HOLOREEL_INLINE F min(F a, F b) { return _mm_min_ps(a, b); }
HOLOREEL_INLINE F max(F a, F b) { return _mm_max_ps(a, b); }
HOLOREEL_INLINE F fma(F a, F b, F c) { return _mm_add_ps(_mm_mul_ps(a, b), c); }
HOLOREEL_INLINE F fnma(F a, F b, F c) { return _mm_sub_ps(c, _mm_mul_ps(a, b)); }
HOLOREEL_INLINE F negate(F a) { return _mm_xor_ps(a, _mm_set1_ps(-0.0f)); }
HOLOREEL_INLINE F abs(F a) { return _mm_andnot_ps(_mm_set1_ps(-0.0f), a); }
HOLOREEL_INLINE Mask ge(F a, F b) { return _mm_cmpge_ps(a, b); }
HOLOREEL_INLINE Mask gt(F a, F b) { return _mm_cmpgt_ps(a, b); }
HOLOREEL_INLINE Mask both(Mask a, Mask b) { return _mm_and_ps(a, b); }
HOLOREEL_INLINE F keep(Mask m, F a) { return _mm_and_ps(m, a); }
HOLOREEL_INLINE F select(Mask m, F a, F b) { return _mm_blendv_ps(b, a, m); }
HOLOREEL_INLINE bool any(Mask m) { return _mm_movemask_ps(m) != 0; }
HOLOREEL_INLINE F split_power(F p, F& fraction) {
    const __m128i n = _mm_cvtps_epi32(p);
    fraction = _mm_sub_ps(p, _mm_cvtepi32_ps(n));
    return _mm_castsi128_ps(_mm_slli_epi32(n, 23));
}
HOLOREEL_INLINE F add_exponent(F a, F shifted) {
    return _mm_castsi128_ps(_mm_add_epi32(_mm_castps_si128(a), _mm_castps_si128(shifted)));
}
HOLOREEL_INLINE void sum_lanes(const F* a, float* out) {
    store(out, _mm_hadd_ps(_mm_hadd_ps(a[0], a[1]), _mm_hadd_ps(a[2], a[3])));
}
HOLOREEL_INLINE float sum_one(F a) {
    const F x = _mm_add_ps(a, _mm_movehl_ps(a, a));
    return _mm_cvtss_f32(_mm_add_ss(x, _mm_movehdup_ps(x)));
}

#elif defined(__ARM_NEON) && defined(__aarch64__)

using F = float32x4_t;
using Mask = uint32x4_t;
HOLOREEL_INLINE F set1(float x) { return vdupq_n_f32(x); }
HOLOREEL_INLINE F load(const float* p) { return vld1q_f32(p); }
HOLOREEL_INLINE F centers() {
    const float values[4] = {-1.5f, -0.5f, 0.5f, 1.5f};
    return load(values);
}
HOLOREEL_INLINE void store(float* p, F a) { vst1q_f32(p, a); }
HOLOREEL_INLINE F add(F a, F b) { return vaddq_f32(a, b); }
HOLOREEL_INLINE F sub(F a, F b) { return vsubq_f32(a, b); }
HOLOREEL_INLINE F mul(F a, F b) { return vmulq_f32(a, b); }
HOLOREEL_INLINE F div(F a, F b) { return vdivq_f32(a, b); }
HOLOREEL_INLINE F sqrt(F a) { return vsqrtq_f32(a); }
HOLOREEL_INLINE F min(F a, F b) { return vminq_f32(a, b); }
HOLOREEL_INLINE F max(F a, F b) { return vmaxq_f32(a, b); }
HOLOREEL_INLINE F fma(F a, F b, F c) { return vfmaq_f32(c, a, b); }
HOLOREEL_INLINE F fnma(F a, F b, F c) { return vfmsq_f32(c, a, b); }
HOLOREEL_INLINE F negate(F a) { return vnegq_f32(a); }
HOLOREEL_INLINE F abs(F a) { return vabsq_f32(a); }
HOLOREEL_INLINE Mask ge(F a, F b) { return vcgeq_f32(a, b); }
HOLOREEL_INLINE Mask gt(F a, F b) { return vcgtq_f32(a, b); }
HOLOREEL_INLINE Mask both(Mask a, Mask b) { return vandq_u32(a, b); }
HOLOREEL_INLINE F keep(Mask m, F a) { return vreinterpretq_f32_u32(vandq_u32(m, vreinterpretq_u32_f32(a))); }
HOLOREEL_INLINE F select(Mask m, F a, F b) { return vbslq_f32(m, a, b); }
HOLOREEL_INLINE bool any(Mask m) { return vmaxvq_u32(m) != 0; }
HOLOREEL_INLINE F split_power(F p, F& fraction) {
    const int32x4_t n = vcvtnq_s32_f32(p);
    fraction = vsubq_f32(p, vcvtq_f32_s32(n));
    return vreinterpretq_f32_s32(vshlq_n_s32(n, 23));
}
HOLOREEL_INLINE F add_exponent(F a, F shifted) {
    return vreinterpretq_f32_s32(vaddq_s32(vreinterpretq_s32_f32(a), vreinterpretq_s32_f32(shifted)));
}
HOLOREEL_INLINE void sum_lanes(const F* a, float* out) {
    store(out, vpaddq_f32(vpaddq_f32(a[0], a[1]), vpaddq_f32(a[2], a[3])));
}
HOLOREEL_INLINE float sum_one(F a) { return vaddvq_f32(a); }

#else  // any compiler with GCC's vector extensions

typedef float F __attribute__((vector_size(16)));
typedef int32_t Mask __attribute__((vector_size(16)));
HOLOREEL_INLINE F set1(float x) { return F{x, x, x, x}; }
HOLOREEL_INLINE F centers() { return F{-1.5f, -0.5f, 0.5f, 1.5f}; }
HOLOREEL_INLINE F load(const float* p) { return F{p[0], p[1], p[2], p[3]}; }
HOLOREEL_INLINE void store(float* p, F a) {
    for (int k = 0; k < 4; k++) p[k] = a[k];
}
HOLOREEL_INLINE F add(F a, F b) { return a + b; }
HOLOREEL_INLINE F sub(F a, F b) { return a - b; }
HOLOREEL_INLINE F mul(F a, F b) { return a * b; }
HOLOREEL_INLINE F div(F a, F b) { return a / b; }
HOLOREEL_INLINE F sqrt(F a) {
    for (int k = 0; k < 4; k++) a[k] = __builtin_sqrtf(a[k]);
    return a;
}
HOLOREEL_INLINE F fma(F a, F b, F c) { return a * b + c; }
HOLOREEL_INLINE F fnma(F a, F b, F c) { return c - a * b; }
HOLOREEL_INLINE F negate(F a) { return -a; }
HOLOREEL_INLINE Mask ge(F a, F b) { return a >= b; }
HOLOREEL_INLINE Mask gt(F a, F b) { return a > b; }
HOLOREEL_INLINE Mask both(Mask a, Mask b) { return a & b; }
HOLOREEL_INLINE F keep(Mask m, F a) { return (F)(m & (Mask)a); }
HOLOREEL_INLINE F select(Mask m, F a, F b) { return (F)((m & (Mask)a) | (~m & (Mask)b)); }
HOLOREEL_INLINE F min(F a, F b) { return select(a < b, a, b); }
HOLOREEL_INLINE F max(F a, F b) { return select(a > b, a, b); }
HOLOREEL_INLINE F abs(F a) { return (F)((Mask)a & 0x7fffffff); }
HOLOREEL_INLINE bool any(Mask m) { return (m[0] | m[1] | m[2] | m[3]) != 0; }
HOLOREEL_INLINE F split_power(F p, F& fraction) {
    Mask n;
    for (int k = 0; k < 4; k++) {
        n[k] = p[k] > -1e9f && p[k] < 1e9f ? static_cast<int32_t>(p[k] < 0 ? p[k] - 0.5f : p[k] + 0.5f) : 0;
        fraction[k] = p[k] - static_cast<float>(n[k]);
    }
    return (F)(n << 23);
}
HOLOREEL_INLINE F add_exponent(F a, F shifted) { return (F)((Mask)a + (Mask)shifted); }
HOLOREEL_INLINE float sum_one(F a) { return (a[0] + a[1]) + (a[2] + a[3]); }
HOLOREEL_INLINE void sum_lanes(const F* a, float* out) {
    for (int k = 0; k < 4; k++) out[k] = sum_one(a[k]);
}

#endif

// 2^p for -100 < p < 100 (elsewhere anything): 2^p = 2^n 2^f with |f| <= 1/2 and a polynomial of degree 5 that minimizes the
// relative error, 7.5e-8.
HOLOREEL_INLINE F exp2(F p) {
    F f;
    const F shifted = split_power(p, f);
    F r = fma(set1(0.001327647203f), f, set1(0.00967554148f));
    r = fma(r, f, set1(0.05550713275f));
    r = fma(r, f, set1(0.2402211972f));
    r = fma(r, f, set1(0.6931469671f));
    r = fma(r, f, set1(1.000000072f));
    return add_exponent(r, shifted);
}

}  // namespace HOLOREEL_NAMESPACE
}  // namespace holoreel
