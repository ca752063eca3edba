// SPDX-License-Identifier: GPL-3.0-or-later
// Eight lanes. This file alone is compiled with AVX2 and FMA; elsewhere than on x86 it is empty.
#include "draw.hpp"
#include "tables.hpp"

#if defined(__AVX2__) && defined(__FMA__)

#define HOLOREEL_LANES 8
#define HOLOREEL_NAMESPACE wide
#include "march_rays.hpp"
#include "shading.hpp"
#include "table_rows.hpp"

namespace holoreel {
namespace videorf {

const MarchKernels* wide_march(int channels) { return wide::march_of(channels); }
const TableKernels* wide_tables(int channels) { return wide::tables_of(channels); }
Shade wide_shade() { return wide::shade_group; }

}  // namespace videorf
}  // namespace holoreel

#else

namespace holoreel {
namespace videorf {

const MarchKernels* wide_march(int) { return nullptr; }
const TableKernels* wide_tables(int) { return nullptr; }
Shade wide_shade() { return nullptr; }

}  // namespace videorf
}  // namespace holoreel

#endif
