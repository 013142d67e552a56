// SPDX-License-Identifier: Apache-2.0
// The CUDA kernels of what happens to the map at keyframes besides insertion: first values of new rows, first labels, new
// classes, rows that go. Pointers lead to device memory. Calls only start work on the caller's
// stream; those with a status return 0 or a cudaError_t.
#pragma once
#include <cstddef>
#include <cstdint>

#include "abi/export.hpp"

namespace ggslam::cuda {

// Most arrays of a map.
constexpr int kMostArrays = 32;

// Words of 4 bytes that all become the same.
struct WordFill {
  std::uint32_t* words;
  std::int64_t count;
  std::uint32_t value;
};

struct FillJob {
  WordFill fills[kMostArrays];
  void* stream;
  std::int32_t device, count;  // of fills
};

// Objects that Gaussians show by their votes.
struct VoteLabelJob {
  const std::int32_t* vote_ids;  // [count, slots]
  const float* vote_weights;     // [count, slots]
  std::int32_t* labels;          // [count], the id with the most weight, of equal ones the first; 0 where there is none
  void* stream;
  std::int64_t count;
  std::int32_t device, slots;
};

// First votes and identity vectors of new Gaussians.
struct BirthLabelJob {
  const std::int32_t* labels;    // [count], object of each, 0 = unknown; null: what is under the pixel that it comes from
  const std::int32_t* pixels;    // [count], flat indices
  const std::uint16_t* mask;     // [H, W], 0 = unlabelled; null: nothing is labelled
  const std::int32_t* alias;     // [65536], what ids have become
  const std::int32_t* class_of;  // [65536], number of each id's class, -1 = none
  const float* class_rows;       // [classes, channels + 1], weights, then the bias
  std::int32_t* vote_ids;        // [count, slots], zero, as
  float* vote_weights;           // [count, slots]
  float* features;               // [count, channels]; null: they stay
  void* stream;
  float vote, code_length;
  std::int32_t device, count, channels, slots;
};

constexpr int kMostNewClasses = 16;
constexpr int kMostNewWeights = 512;

// Classes that are added to a classifier. The numbers travel as arguments of the kernel: no memory of the host is read
// later.
struct NewClassJob {
  float* rows;             // [classes, channels + 1], weights, then the bias, which becomes 0
  std::int32_t* ids;       // [classes], object of each
  std::int32_t* class_of;  // [65536]
  void* stream;
  std::int32_t device, first, count, channels;  // count * channels <= kMostNewWeights
  std::int32_t new_ids[kMostNewClasses];
  float weights[kMostNewWeights];
};

// Which Gaussians are of use.
struct PruneJob {
  const float *means, *log_scales, *opacity_logits;  // [count, 3], [count, 3], [count]
  std::uint8_t* stays;                               // [count], 0 where they are transparent, huge or nowhere
  void* stream;
  std::int64_t count;
  float least_logit, largest_log_scale;  // beyond these
  std::int32_t device;
};

// An array of rows of whole words of 4 bytes.
struct RowArray {
  std::uint32_t* rows;
  std::int64_t words;  // of a row
};

// Rows that go; those that stay move to the front, in their order.
struct RowsJob {
  const std::uint8_t* stays;  // [count], 0: the row goes
  std::int32_t* kept;         // [1], how many stay
  RowArray arrays[kMostArrays];
  void* workspace;
  void* stream;
  std::int64_t count;
  std::int32_t device, array_count;
};

}  // namespace ggslam::cuda

GGSLAM_EXPORT int ggslam_cuda_fill_words(const ggslam::cuda::FillJob* job);

// Fills `labels`.
GGSLAM_EXPORT int ggslam_cuda_vote_labels(const ggslam::cuda::VoteLabelJob* job);

// Fills votes and vectors.
GGSLAM_EXPORT int ggslam_cuda_birth_labels(const ggslam::cuda::BirthLabelJob* job);

// Writes rows, ids and numbers of the new classes.
GGSLAM_EXPORT int ggslam_cuda_new_classes(const ggslam::cuda::NewClassJob* job);

// Fills `stays`.
GGSLAM_EXPORT int ggslam_cuda_prune(const ggslam::cuda::PruneJob* job);

// Bytes of memory that rows move by way of. Asks for count and arrays.
GGSLAM_EXPORT std::int64_t ggslam_cuda_rows_bytes(const ggslam::cuda::RowsJob* job);

// Numbers the rows that stay, and fills `kept`.
GGSLAM_EXPORT int ggslam_cuda_choose_rows(const ggslam::cuda::RowsJob* job);

// Moves the rows chosen by the call before it with the same job, of which `kept` is the number.
GGSLAM_EXPORT int ggslam_cuda_move_rows(const ggslam::cuda::RowsJob* job, std::int64_t kept);
