// SPDX-License-Identifier: GPL-3.0-or-later
// Aligned memory that is kept between pictures: fresh pages cost more than the work done on them.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <new>

namespace holoreel {

template <class T>
class Buffer {
public:
    Buffer() = default;
    ~Buffer() { std::free(data_); }
    Buffer(const Buffer&) = delete;
    Buffer& operator=(const Buffer&) = delete;

    // Makes room for `count` values; the old contents are lost. Throws std::bad_alloc.
    void reserve(size_t count) {
        if (count <= capacity_) return;
        if (count > SIZE_MAX / sizeof(T) / 2) throw std::bad_alloc();
        const size_t room = count + count / 4;
        std::free(data_);
        capacity_ = 0;
        data_ = static_cast<T*>(std::aligned_alloc(64, (room * sizeof(T) + 63) / 64 * 64));
        if (!data_) throw std::bad_alloc();
        capacity_ = room;
    }

    T* data() { return data_; }
    const T* data() const { return data_; }
    T& operator[](size_t i) { return data_[i]; }
    const T& operator[](size_t i) const { return data_[i]; }
    size_t bytes() const { return capacity_ * sizeof(T); }

private:
    T* data_ = nullptr;
    size_t capacity_ = 0;
};

}  // namespace holoreel
