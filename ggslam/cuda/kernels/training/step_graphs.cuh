// SPDX-License-Identifier: Apache-2.0
// Graphs of the pieces of training steps, of the jobs that were used last.
#pragma once
#include <algorithm>
#include <array>
#include <cstring>
#include <iterator>

#include "abi/cuda/training.hpp"
#include "common/recorded_work.cuh"

namespace ggslam::cuda {

// What is recorded by itself: a step, or, where a lesson is in its midst, what comes before and after that.
enum StepPiece { kWholeStep, kWholeBoundedStep, kBeforeLesson, kAfterLesson, kAfterLessonBounded, kStepPieces };

constexpr int kKeptJobs = 4;

// The graphs of some jobs. A job's pieces are started kernel by kernel at first: recording pays off if a job is used
// again. Of jobs that are forgotten the graphs serve those that come.
class StepGraphs {
 public:
  explicit StepGraphs(int device) : device_(device) {}
  ~StepGraphs() {
    if (recording_ != nullptr) cudaStreamDestroy(recording_);
  }
  StepGraphs(const StepGraphs&) = delete;
  StepGraphs& operator=(const StepGraphs&) = delete;

  int device() const { return device_; }
  const GraphCounts& counts() const { return counts_; }

  // A stream on which nothing is executed: where torch works by default, nothing can be recorded.
  cudaError_t begin() { return cudaStreamCreateWithFlags(&recording_, cudaStreamNonBlocking); }

  // From now on pieces are those of this job, as the caller gave it.
  void choose(const TrainingJob& given) {
    Bytes bytes;
    TrainingJob job = given;
    job.rendering.stream = nullptr;  // graphs can be started on any, and rates are those of the steps
    std::fill(std::begin(job.adam.rates), std::end(job.adam.rates), 0.0f);
    std::memcpy(bytes.data(), &job, sizeof(job));
    ++time_;
    Kept* oldest = &kept_[0];
    for (Kept& kept : kept_) {
      if (kept.used > 0 && kept.bytes == bytes) {
        kept.used = time_;
        chosen_ = &kept;
        return;
      }
      if (kept.used < oldest->used) oldest = &kept;
    }
    oldest->bytes = bytes;
    oldest->used = time_;
    for (Piece& piece : oldest->pieces) {
      piece.work.expire();
      piece.was_used = false;
    }
    chosen_ = oldest;
  }

  // Starts a piece of the chosen job on a stream; start(stream) starts its kernels there, always the same ones.
  template <class Start>
  int run(StepPiece number, cudaStream_t stream, const Start& start) {
    Piece& piece = chosen_->pieces[number];
    if (!piece.work.is_ready() && piece.was_used && counts_.refused == 0) {
      const Recorded recorded = piece.work.record(recording_, [&] { return start(recording_); });
      ++(recorded == Recorded::kMade      ? counts_.made
         : recorded == Recorded::kChanged ? counts_.changed
                                          : counts_.refused);
    }
    piece.was_used = true;
    if (piece.work.is_ready()) {
      ++counts_.started;
      return piece.work.launch(stream);
    }
    ++counts_.plain;
    return start(stream);
  }

 private:
  using Bytes = std::array<unsigned char, sizeof(TrainingJob)>;
  struct Piece {
    RecordedWork work;
    bool was_used = false;
  };
  struct Kept {
    Bytes bytes = {};
    std::uint64_t used = 0;  // when, 0: never
    Piece pieces[kStepPieces];
  };

  int device_;
  cudaStream_t recording_ = nullptr;
  std::uint64_t time_ = 0;
  Kept kept_[kKeptJobs];
  Kept* chosen_ = nullptr;
  GraphCounts counts_ = {};
};

}  // namespace ggslam::cuda
