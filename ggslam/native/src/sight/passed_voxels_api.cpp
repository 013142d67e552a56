// SPDX-License-Identifier: Apache-2.0
// Entry point of what a newer view says of earlier ones where it looks past places in some voxels. Most views have none:
// they are found by the least margin that there may be, before it is measured how far depths differ.
#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

#include "common/context.hpp"
#include "common/guard.hpp"
#include "sight/places.hpp"

namespace ggslam {
namespace {

constexpr std::int64_t kVoxelOffset = 1 << 20;
constexpr int kVoxelBits = 21;
constexpr uint8_t kSeed = 2;  // a flagged place that lies in a voxel

// Whether places of an earlier view lie in the voxels.
class InVoxels {
 public:
  InVoxels(const PassedVoxelsJob& job, std::size_t view)
      : job_(job), camera_(job.earlier[view]), T_(job.T_world_earlier + 12 * view) {}

  bool operator()(std::size_t place) const {
    const std::size_t width = static_cast<std::size_t>(camera_.width);
    const float d = camera_.depth[place];
    const double x = (static_cast<float>(place % width) - camera_.cx) / camera_.fx * d;
    const double y = (static_cast<float>(place / width) - camera_.cy) / camera_.fy * d;
    std::int64_t key = 0;
    for (int axis = 0; axis < 3; ++axis) {
      const double* T = T_ + 4 * axis;
      const double cell = std::floor((T[0] * x + T[1] * y + T[2] * d + T[3]) / job_.voxel);
      if (!(std::fabs(cell) < kVoxelOffset)) return false;
      key = key << kVoxelBits | (static_cast<std::int64_t>(cell) + kVoxelOffset);
    }
    return std::binary_search(job_.voxels, job_.voxels + job_.voxel_count, key);
  }

 private:
  const PassedVoxelsJob& job_;
  const PlacesView& camera_;
  const double* T_;
};

// One thread's memory.
struct Scratch {
  PlacesScratch places;
  std::vector<uint8_t> flags;
  std::vector<std::size_t> pending;
};

// The places of a part of an image of flags: those connected to `first`, directly or by a corner, and how many of them
// are seeds. Their flags are cleared.
struct Part {
  int places, seeds;
};

Part take_part(std::size_t first, int height, int width, Scratch& scratch) {
  Part part{0, 0};
  uint8_t* const flags = scratch.flags.data();
  const auto take = [&](std::size_t place) {
    ++part.places, part.seeds += flags[place] == kSeed;
    flags[place] = 0, scratch.pending.push_back(place);
  };
  take(first);
  while (!scratch.pending.empty()) {
    const int row = static_cast<int>(scratch.pending.back()) / width;
    const int column = static_cast<int>(scratch.pending.back()) % width;
    scratch.pending.pop_back();
    for (int y = std::max(row - 1, 0); y <= std::min(row + 1, height - 1); ++y)
      for (int x = std::max(column - 1, 0); x <= std::min(column + 1, width - 1); ++x) {
        const std::size_t beside = static_cast<std::size_t>(y) * static_cast<std::size_t>(width) + x;
        if (flags[beside]) take(beside);
      }
  }
  return part;
}

// The kernels for the processor at hand.
struct Kernels {
  decltype(GGSLAM_DISPATCH(Isa::baseline, project_places)) project;
  decltype(GGSLAM_DISPATCH(Isa::baseline, look_up_places)) look_up;
  decltype(GGSLAM_DISPATCH(Isa::baseline, flag_perhaps_passed)) flag;
  decltype(GGSLAM_DISPATCH(Isa::baseline, judge_places)) judge;
};

// Of one earlier view; `beyond`: see `flag_perhaps_passed`.
PassedPlaces find_passed(const PassedVoxelsJob& job, std::size_t view, const float* beyond, const Kernels& kernels,
                         Scratch& scratch) {
  const PlacesView& earlier = job.earlier[view];
  const std::size_t count = static_cast<std::size_t>(earlier.height) * static_cast<std::size_t>(earlier.width);
  const InVoxels in_voxels(job, view);
  OtherPlacesView newest{job.newest, {}};
  std::copy_n(job.T_newest_earlier + 12 * view, 12, newest.T_this_view);
  const ProjectedPlaces places = scratch.places.places(count);
  std::vector<uint8_t>& flags = scratch.flags;
  flags.resize(count);
  kernels.project(earlier, newest, places);
  kernels.flag(job.rule, earlier, beyond, places, flags.data());
  const auto next_flag = [&](std::size_t from) {
    const void* const at = std::memchr(flags.data() + from, 1, count - from);
    return at == nullptr ? count : static_cast<std::size_t>(static_cast<const uint8_t*>(at) - flags.data());
  };
  std::size_t first = next_flag(0);
  while (first < count && !in_voxels(first)) first = next_flag(first + 1);
  if (first == count) return {0, 0};

  kernels.look_up(earlier, job.newest, places);
  uint8_t* const evidence = job.found + 5 * count * view;
  kernels.judge(job.rule, measured_share(job.rule, nullptr, job.newest, places, count), count, places, evidence);
  flags.assign(evidence, evidence + count);  // the first of the images: passed
  for (std::size_t i = next_flag(first); i < count; i = next_flag(i + 1))
    if (in_voxels(i)) flags[i] = kSeed;
  PassedPlaces passed{0, 0};
  for (std::size_t i = first; i < count; ++i) {
    if (flags[i] != kSeed) continue;
    const Part part = take_part(i, earlier.height, earlier.width, scratch);
    if (part.seeds < job.least_seeds * part.places) continue;
    passed.all += part.places, passed.largest = std::max(passed.largest, part.places);
  }
  return passed;
}

void check_job(const PassedVoxelsJob& job) {
  check_view("newest view", job.newest), check_rule(job.rule);
  check_array("earlier views", job.earlier, job.count), check_range("least_seeds", job.least_seeds, 0.0, 1.0);
  check_array("passed", job.passed, job.count), check_array("found", job.found, job.count);
  check_array("T_world_earlier", job.T_world_earlier, job.count);
  check_array("T_newest_earlier", job.T_newest_earlier, job.count);
  check_array("voxels", job.voxels, job.voxel_count), check_range("voxel", job.voxel, 1e-6, 1e6);
  for (int i = 0; i < job.count; ++i) {
    check_view("earlier view", job.earlier[i]);
    check_range("height", job.earlier[i].height, job.earlier[0].height, job.earlier[0].height);
    check_range("width", job.earlier[i].width, job.earlier[0].width, job.earlier[0].width);
    check_within("T_world_earlier", job.T_world_earlier + 12 * i, 12, 1e9);
    check_within("T_newest_earlier", job.T_newest_earlier + 12 * i, 12, 1e9);
  }
}

}  // namespace
}  // namespace ggslam

GGSLAM_EXPORT int ggslam_passed_voxels(void* context_, const ggslam::PassedVoxelsJob* job_) try {
  using namespace ggslam;
  Context& context = object_of<Context>(context_);
  const PassedVoxelsJob& job = object_of<PassedVoxelsJob>(job_);
  check_job(job);
  const Kernels kernels{GGSLAM_DISPATCH(context.isa, project_places), GGSLAM_DISPATCH(context.isa, look_up_places),
                        GGSLAM_DISPATCH(context.isa, flag_perhaps_passed), GGSLAM_DISPATCH(context.isa, judge_places)};
  const std::size_t places = static_cast<std::size_t>(job.newest.height) * static_cast<std::size_t>(job.newest.width);
  std::vector<float> beyond(places);
  for (std::size_t i = 0; i < places; ++i) beyond[i] = job.newest.whole[i] ? job.newest.near[i] : 0.f;
  std::vector<Scratch> scratch(static_cast<std::size_t>(context.pool.size()));
  context.pool.parallel_for(elements(job.count), 1, [&](std::size_t i, std::size_t, int thread) {
    job.passed[i] = find_passed(job, i, beyond.data(), kernels, scratch[static_cast<std::size_t>(thread)]);
  });
  return 0;
} GGSLAM_CATCH_ALL
