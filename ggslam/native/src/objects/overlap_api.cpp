// SPDX-License-Identifier: Apache-2.0
// Entry points of what segments share with the objects of a map.
#include <array>
#include <cmath>

#include "objects/images.hpp"
#include "objects/mask_runs.hpp"

namespace ggslam {
namespace {

// The objects of a view where the map shows the surface that was measured, as runs, by the names that they have now.
MaskRuns find_known(const OverlapJob& job) {
  std::vector<std::uint16_t> known(elements(job.height, job.width));
  for (std::size_t i = 0; i < known.size(); ++i) {
    const float shown = job.shown_depth[i], depth = job.depth[i], relative = job.tolerance_relative * depth;
    const float tolerance = relative < job.tolerance_m ? job.tolerance_m : relative;
    const bool same = (depth <= 0) | (std::fabs(shown - depth) < tolerance);  // no branches: compilers make vectors of it
    const bool is_known = (shown > 0) & same & (job.confidence[i] >= job.min_confidence);
    known[i] = static_cast<std::uint16_t>(job.ids[i] & -static_cast<int>(is_known));
  }
  MaskRuns found(known.data(), job.height, job.width);
  for (Run& run : found.runs) run.id = run.id ? job.renamed[run.id] : 0;
  return found;
}

// Numbers of the ids of a mask but 0, which is -1. Writes the ids and how many there are.
std::vector<std::int32_t> number_ids(const MaskRuns& mask, std::uint16_t* ids, std::int32_t& count) {
  std::vector<std::uint8_t> occurs(kIds);
  for (const Run& run : mask.runs) occurs[run.id] = 1;
  std::vector<std::int32_t> number(kIds, -1);
  count = 0;
  for (int id = 1; id < kIds; ++id)
    if (occurs[id]) ids[count] = static_cast<std::uint16_t>(id), number[id] = count++;
  return number;
}

void draw_numbers(const MaskRuns& mask, const std::vector<std::int32_t>& number, std::int32_t* image) {
  for (const Run& run : mask.runs) image = std::fill_n(image, run.end - run.begin, number[run.id]);
}

// The pixels of each segment, and those that it shares with each object.
void count_shared(const MaskRuns& segments, const std::vector<std::int32_t>& row, const MaskRuns& known,
                  const std::vector<std::int32_t>& column, const OverlapJob& job) {
  const std::int64_t pairs = static_cast<std::int64_t>(job.segment_count) * job.object_count;
  const bool is_room = pairs <= job.shared_room;
  std::fill_n(job.areas, job.segment_count, 0);
  if (is_room) std::fill_n(job.shared, pairs, 0);
  for (int y = 0; y < job.height; ++y)
    over_shared_columns(segments, y, known, y, [&](std::size_t k, std::size_t m, int begin, int end) {
      const std::int64_t segment = row[segments.runs[k].id], object = column[known.runs[m].id];
      if (segment >= 0) job.areas[segment] += end - begin;
      if (is_room && segment >= 0 && object >= 0) job.shared[segment * job.object_count + object] += end - begin;
    });
}

using IdPair = std::array<std::uint16_t, 2>;

// Different ids but 0 on neighbouring pixels.
std::vector<IdPair> find_touching(const MaskRuns& mask) {
  std::vector<IdPair> pairs;
  const auto note = [&](std::uint16_t a, std::uint16_t b) {
    const IdPair pair{std::min(a, b), std::max(a, b)};
    if (a != b && pair[0] > 0 && (pairs.empty() || pair != pairs.back())) pairs.push_back(pair);
  };
  for (int y = 0; y < mask.rows(); ++y) {
    for (std::size_t k = mask.row_begin[y] + 1; k < mask.row_begin[y + 1]; ++k)
      note(mask.runs[k - 1].id, mask.runs[k].id);
    if (y > 0)
      over_shared_columns(mask, y - 1, mask, y,
                          [&](std::size_t k, std::size_t m, int, int) { note(mask.runs[k].id, mask.runs[m].id); });
  }
  std::sort(pairs.begin(), pairs.end());
  pairs.erase(std::unique(pairs.begin(), pairs.end()), pairs.end());
  return pairs;
}

}  // namespace
}  // namespace ggslam

GGSLAM_EXPORT int ggslam_segment_overlap(ggslam::OverlapJob* job_) try {
  using namespace ggslam;
  OverlapJob& job = object_of<OverlapJob>(job_);
  check_size(job.height, job.width);
  const void* const arrays[] = {job.segments, job.ids, job.renamed, job.confidence,  job.shown_depth, job.depth,
                                job.row,      job.column, job.segment_ids, job.object_ids, job.areas};
  for (const void* array : arrays) check_array("images and tables", array, 1);
  check_array("shared", job.shared, job.shared_room), check_array("touching", job.touching, job.touching_room);
  const MaskRuns segments(job.segments, job.height, job.width);
  const MaskRuns known = find_known(job);
  const std::vector<std::int32_t> row = number_ids(segments, job.segment_ids, job.segment_count);
  const std::vector<std::int32_t> column = number_ids(known, job.object_ids, job.object_count);
  draw_numbers(segments, row, job.row);
  draw_numbers(known, column, job.column);
  count_shared(segments, row, known, column, job);
  const std::vector<IdPair> touching = find_touching(known);
  job.touching_count = static_cast<std::int64_t>(touching.size());
  if (job.touching_count <= job.touching_room && !touching.empty())
    std::copy_n(touching[0].data(), 2 * touching.size(), job.touching);
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_label_pairs(const ggslam::PairLabelsJob* job_) try {
  using namespace ggslam;
  const PairLabelsJob& job = object_of<PairLabelsJob>(job_);
  check_array("row", job.row, job.pixels), check_array("column", job.column, job.pixels);
  check_array("image", job.image, job.pixels);
  const std::int64_t across = std::int64_t{job.columns} + 1;
  check_array("labels", job.labels, static_cast<std::int64_t>(elements(std::int64_t{job.rows} + 1, across)));
  std::int32_t row = 0, column = 0;  // of the pixel before: neighbours are mostly alike
  std::uint16_t label = 0;
  for (std::int64_t i = 0; i < job.pixels; ++i) {
    if (i == 0 || job.row[i] != row || job.column[i] != column) {
      row = job.row[i], column = job.column[i];
      if (row < -1 || row >= job.rows || column < -1 || column >= job.columns)
        refuse("expected numbers below %d and %d, found %d and %d", job.rows, job.columns, row, column);
      label = job.labels[(row < 0 ? job.rows : row) * across + (column < 0 ? job.columns : column)];
    }
    job.image[i] = label;
  }
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_mark_ids(const uint16_t* ids, int64_t count, uint8_t* there) try {
  using namespace ggslam;
  check_array("ids", ids, count), check_array("there", there, kIds);
  std::fill_n(there, kIds, 0);
  for (std::int64_t i = 0; i < count; ++i) there[ids[i]] = 1;
  return 0;
} GGSLAM_CATCH_ALL
