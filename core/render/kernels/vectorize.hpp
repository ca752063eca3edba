// SPDX-License-Identifier: GPL-3.0-or-later
// Plain loops that the compiler turns into vectors: on x86 Linux it makes an AVX2 copy too, chosen when the library is loaded.
// Products and sums stay separate (-ffp-contract=off), so both copies give the same bits.
#pragma once

#if defined(__x86_64__) && defined(__gnu_linux__)
#define HOLOREEL_CLONES __attribute__((target_clones("avx2", "default")))
#else
#define HOLOREEL_CLONES
#endif
