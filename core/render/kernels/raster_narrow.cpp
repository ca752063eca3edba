// SPDX-License-Identifier: GPL-3.0-or-later
// Four lanes. On x86 this file alone is compiled with SSE4.1.
#define HOLOREEL_LANES 4
#define HOLOREEL_NAMESPACE narrow
#include "raster_kernels.hpp"

namespace holoreel {

const RasterKernels* narrow_kernels() { return &narrow::kernels; }

}  // namespace holoreel
