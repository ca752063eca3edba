// SPDX-License-Identifier: GPL-3.0-or-later
// Persistent workers that sleep between jobs. Nothing spins, so the pool shares the cores politely with torch's own threads.
#pragma once

#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <exception>
#include <functional>
#include <mutex>
#include <thread>
#include <vector>

namespace holoreel {

class ThreadPool {
public:
    using Task = std::function<void(int64_t)>;

    explicit ThreadPool(int threads);
    ~ThreadPool();
    ThreadPool(const ThreadPool&) = delete;
    ThreadPool& operator=(const ThreadPool&) = delete;

    int threads() const { return static_cast<int>(workers_.size()) + 1; }

    // Calls task(0) ... task(count - 1), each once, on the caller and the workers; returns when all are done.
    // The first exception a task throws is thrown again here.
    void run(int64_t count, const Task& task);

private:
    void work();
    void drain(const Task& task);

    std::vector<std::thread> workers_;
    std::mutex mutex_;
    std::condition_variable wake_;
    std::condition_variable idle_;
    const Task* task_ = nullptr;
    uint64_t generation_ = 0;
    int busy_ = 0;
    bool stop_ = false;
    int64_t count_ = 0;
    std::atomic<int64_t> next_{0};
    std::exception_ptr error_;
};

// The pool of this process. After a fork the child gets a new one, since threads do not survive it.
ThreadPool& pool();
void set_threads(int threads);
int get_threads();

}  // namespace holoreel
