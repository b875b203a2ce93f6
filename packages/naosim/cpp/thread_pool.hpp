// Threads that stay alive between rounds of work.
#pragma once
#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <functional>
#include <mutex>
#include <thread>
#include <vector>

namespace naosim {

// Runs a job for every index with the calling thread and `threads - 1` helpers.
class ThreadPool {
 public:
  explicit ThreadPool(int threads) {
    for (int k = 1; k < threads; ++k) helpers_.emplace_back([this] { help(); });
  }

  ~ThreadPool() {
    {
      std::lock_guard<std::mutex> lock(mutex_);
      stop_ = true;
    }
    start_.notify_all();
    for (auto& helper : helpers_) helper.join();
  }

  ThreadPool(const ThreadPool&) = delete;
  ThreadPool& operator=(const ThreadPool&) = delete;

  void run(int count, const std::function<void(int)>& job) {
    if (helpers_.empty() || count < 2) {
      for (int k = 0; k < count; ++k) job(k);
      return;
    }
    {
      std::lock_guard<std::mutex> lock(mutex_);
      job_ = &job;
      count_ = count;
      next_ = 0;
      busy_ = static_cast<int>(helpers_.size());
      ++round_;
    }
    start_.notify_all();
    work();
    std::unique_lock<std::mutex> lock(mutex_);
    done_.wait(lock, [&] { return busy_ == 0; });
  }

 private:
  void work() {
    for (int k = next_.fetch_add(1); k < count_; k = next_.fetch_add(1)) (*job_)(k);
  }

  void help() {
    std::uint64_t seen = 0;
    std::unique_lock<std::mutex> lock(mutex_);
    for (;;) {
      start_.wait(lock, [&] { return stop_ || round_ != seen; });
      if (stop_) return;
      seen = round_;
      lock.unlock();
      work();
      lock.lock();
      if (--busy_ == 0) done_.notify_one();
    }
  }

  std::vector<std::thread> helpers_;
  std::mutex mutex_;
  std::condition_variable start_, done_;
  const std::function<void(int)>* job_ = nullptr;
  std::atomic<int> next_{0};
  int count_ = 0, busy_ = 0;
  std::uint64_t round_ = 0;
  bool stop_ = false;
};

}  // namespace naosim
