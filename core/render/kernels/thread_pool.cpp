// SPDX-License-Identifier: GPL-3.0-or-later
#include "thread_pool.hpp"

#include <algorithm>
#include <unistd.h>

namespace holoreel {

ThreadPool::ThreadPool(int threads) {
    for (int i = 1; i < threads; i++) workers_.emplace_back([this] { work(); });
}

ThreadPool::~ThreadPool() {
    {
        std::lock_guard<std::mutex> lock(mutex_);
        stop_ = true;
    }
    wake_.notify_all();
    for (auto& worker : workers_) worker.join();
}

void ThreadPool::drain(const Task& task) {
    try {
        for (int64_t i; (i = next_.fetch_add(1, std::memory_order_relaxed)) < count_;) task(i);
    } catch (...) {
        next_.store(count_, std::memory_order_relaxed);
        std::lock_guard<std::mutex> lock(mutex_);
        if (!error_) error_ = std::current_exception();
    }
}

void ThreadPool::work() {
    uint64_t seen = 0;
    std::unique_lock<std::mutex> lock(mutex_);
    for (;;) {
        wake_.wait(lock, [&] { return stop_ || (task_ && generation_ != seen); });
        if (stop_) return;
        seen = generation_;
        const Task& task = *task_;
        busy_++;
        lock.unlock();
        drain(task);
        lock.lock();
        if (--busy_ == 0) idle_.notify_one();
    }
}

void ThreadPool::run(int64_t count, const Task& task) {
    if (workers_.empty() || count <= 1) {
        for (int64_t i = 0; i < count; i++) task(i);
        return;
    }
    {
        std::lock_guard<std::mutex> lock(mutex_);
        task_ = &task;
        count_ = count;
        next_.store(0, std::memory_order_relaxed);
        error_ = nullptr;
        generation_++;
    }
    wake_.notify_all();
    drain(task);
    std::unique_lock<std::mutex> lock(mutex_);
    task_ = nullptr;  // a worker that wakes only now has nothing left to do, and nobody waits for it
    idle_.wait(lock, [&] { return busy_ == 0; });
    if (error_) std::rethrow_exception(error_);
}

namespace {

std::mutex pool_mutex;
ThreadPool* current = nullptr;
pid_t owner = 0;
int wanted = 1;

}  // namespace

ThreadPool& pool() {
    std::lock_guard<std::mutex> lock(pool_mutex);
    if (owner != getpid()) current = nullptr;  // the parent's threads are not here to be joined
    if (!current || current->threads() != wanted) {
        delete current;
        current = new ThreadPool(wanted);
        owner = getpid();
    }
    return *current;
}

void set_threads(int threads) {
    std::lock_guard<std::mutex> lock(pool_mutex);
    wanted = std::clamp(threads, 1, 256);
}

int get_threads() {
    std::lock_guard<std::mutex> lock(pool_mutex);
    return wanted;
}

}  // namespace holoreel
