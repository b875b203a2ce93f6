// Threads that stay alive between rounds of work.
#pragma once
#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <functional>
#include <mutex>
#include <thread>
#include <vector>
#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace naosim {

// What another module needs to work on a pool's threads; its address is handed over as a number.
struct Threads {
  void* pool;
  void (*run)(void* pool, int count, void (*job)(void* context, int index), void* context);
};

// A job for every index below a count.
struct Round {
  std::function<void(int)> job;
  int count = 0;
  std::atomic<int> next{0}, done{0};
};

// Runs rounds of work with the calling thread and `threads - 1` helpers.
//
// A round takes microseconds and the next one follows soon, so a waiting thread looks for the event for a moment before it sleeps: to be
// woken up takes as long as a round. With fewer processors than threads it sleeps at once.
//
// One thread calls at a time. A job must not throw.
class ThreadPool {
 public:
  // Threads that take part, the caller's included.
  int size() const { return static_cast<int>(helpers_.size()) + 1; }

  explicit ThreadPool(int threads) : spins_(static_cast<int>(std::thread::hardware_concurrency()) >= threads) {
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

  // Run a job for every index. While a round that began is unfinished, the caller does it alone: helpers have work.
  void run(int count, const std::function<void(int)>& job) {
    if (helpers_.empty() || count < 2 || !rounds_.empty()) {
      for (int k = 0; k < count; ++k) job(k);
      return;
    }
    Round round;
    round.job = [&job](int index) { job(index); };
    round.count = count;
    begin(round);
    finish(round);
  }

  // Helpers work on the round from now on, after those that began before; it must stay where it is until it is finished.
  void begin(Round& round) {
    round.next = round.done = 0;
    bool asleep;
    {
      std::lock_guard<std::mutex> lock(mutex_);
      rounds_.push_back(&round);
      ++begun_;
      asleep = sleepers_ > 0;
    }
    if (asleep) start_.notify_all();
  }

  // Do what is left of a round, and return when all of it is done. While helpers are at its last jobs, do some of later rounds.
  void finish(Round& round) {
    for (int k = round.next.fetch_add(1); k < round.count; k = round.next.fetch_add(1)) {
      round.job(k);
      ++round.done;
    }
    const auto finished = [&] { return round.done == round.count; };
    while (!finished() && work()) {
    }
    const bool seen = spin(finished);
    std::unique_lock<std::mutex> lock(mutex_);
    if (!seen) done_.wait(lock, finished);
    rounds_.erase(std::find(rounds_.begin(), rounds_.end(), &round));
  }

  // For work of others between rounds; nullptr if there are no helpers.
  const Threads* table() const { return helpers_.empty() ? nullptr : &table_; }

 private:
  static constexpr std::chrono::microseconds kSpin{100};

  // Return whether the event came while this thread looked for it.
  template <class Event>
  bool spin(Event event) const {
    if (!spins_) return event();
    const auto end = std::chrono::steady_clock::now() + kSpin;
    do {
      for (int k = 0; k < 64; ++k) {
        if (event()) return true;
#if defined(__x86_64__)
        _mm_pause();
#endif
      }
    } while (std::chrono::steady_clock::now() < end);
    return false;
  }

  // Do one index of the first round that has any left; return whether there was one.
  bool work() {
    Round* round = nullptr;
    int index = 0;
    {
      // locked, so that a round is not finished and gone between the look at it and the index
      std::lock_guard<std::mutex> lock(mutex_);
      for (Round* each : rounds_) {
        if (each->next >= each->count) continue;
        index = each->next.fetch_add(1);
        if (index >= each->count) continue;
        round = each;
        break;
      }
    }
    if (round == nullptr) return false;
    const int count = round->count;
    round->job(index);
    if (round->done.fetch_add(1) + 1 == count) {  // the round may be gone from here on
      // locked, so that the caller cannot fall asleep between its check and this
      std::lock_guard<std::mutex> lock(mutex_);
      done_.notify_one();
    }
    return true;
  }

  void help() {
    std::uint64_t seen = 0;
    const auto called = [&] { return stop_ || begun_ != seen; };
    for (;;) {
      if (!spin(called)) {
        std::unique_lock<std::mutex> lock(mutex_);
        ++sleepers_;
        start_.wait(lock, called);
        --sleepers_;
      }
      if (stop_) return;
      seen = begun_;
      while (work()) {
      }
    }
  }

  static void run_plain(void* pool, int count, void (*job)(void*, int), void* context) {
    static_cast<ThreadPool*>(pool)->run(count, [=](int index) { job(context, index); });
  }

  const bool spins_;
  const Threads table_{this, run_plain};
  std::mutex mutex_;
  std::condition_variable start_, done_;
  std::vector<Round*> rounds_;  // that began, the oldest first; helpers look with the mutex
  int sleepers_ = 0;
  std::atomic<std::uint64_t> begun_{0};
  std::atomic<bool> stop_{false};
  std::vector<std::thread> helpers_;  // last: they use the rest
};

}  // namespace naosim
