// SPDX-License-Identifier: GPL-3.0-or-later
// A row of a table in the compiler's vectors of 4, 8 or 16 floats. Included by each width's translation unit, in a namespace of
// its own.
#pragma once

#include <cstring>

#include "simd.hpp"

namespace holoreel {
namespace HOLOREEL_NAMESPACE {

template <int C> struct RowOf;
template <> struct RowOf<4> { typedef float type __attribute__((vector_size(16))); };
template <> struct RowOf<8> { typedef float type __attribute__((vector_size(32))); };
template <> struct RowOf<16> { typedef float type __attribute__((vector_size(64))); };

template <int C> HOLOREEL_INLINE typename RowOf<C>::type load_row(const float* p) {
    typename RowOf<C>::type row;
    std::memcpy(&row, p, sizeof row);
    return row;
}
template <int C> HOLOREEL_INLINE void store_row(float* p, typename RowOf<C>::type row) { std::memcpy(p, &row, sizeof row); }
template <int C> HOLOREEL_INLINE float sum_row(typename RowOf<C>::type row) {
    float sum = 0;
    for (int c = 0; c < C; c++) sum += row[c];
    return sum;
}

}  // namespace HOLOREEL_NAMESPACE
}  // namespace holoreel
