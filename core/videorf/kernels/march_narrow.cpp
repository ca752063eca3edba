// SPDX-License-Identifier: GPL-3.0-or-later
// Four lanes: SSE4.1, NEON, or whatever the compiler makes of vectors of four.
#define HOLOREEL_LANES 4
#define HOLOREEL_NAMESPACE narrow
#include "march_rays.hpp"
#include "shading.hpp"
#include "table_rows.hpp"

namespace holoreel {
namespace videorf {

const MarchKernels* narrow_march(int channels) { return narrow::march_of(channels); }
const TableKernels* narrow_tables(int channels) { return narrow::tables_of(channels); }
Shade narrow_shade() { return narrow::shade_group; }

}  // namespace videorf
}  // namespace holoreel
