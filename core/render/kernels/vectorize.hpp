// SPDX-License-Identifier: GPL-3.0-or-later
// Copies of a function for newer processors, made by the compiler and chosen when the library is loaded: on x86 Linux.
// Elsewhere there is one copy, and everything works the same.
#pragma once

// For plain loops over arrays. Products and sums stay separate (-ffp-contract=off), so all copies give the same bits.
#if defined(__x86_64__) && defined(__gnu_linux__)
#define HOLOREEL_CLONES __attribute__((target_clones("avx2", "default")))
#else
#define HOLOREEL_CLONES
#endif

// For heavier arithmetic, with everything it calls put inside (GCC only). Products and sums may be fused, so copies differ in
// the last bits.
#if defined(__x86_64__) && defined(__gnu_linux__) && !defined(__clang__) && __GNUC__ >= 12
#define HOLOREEL_HEAVY_CLONES __attribute__((target_clones("arch=x86-64-v3", "default"), flatten))
#else
#define HOLOREEL_HEAVY_CLONES
#endif
