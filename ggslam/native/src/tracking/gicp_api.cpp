// SPDX-License-Identifier: Apache-2.0
// Alignment of a frame's points to a target: Levenberg-Marquardt from the coarse voxels to the fine ones, with an
// optional photometric part. Sums run over fixed blocks of points in a fixed order, so that the result is the same
// for any number of threads.
#include <algorithm>
#include <cmath>
#include <cstring>

#include "common/guard.hpp"
#include "common/vector.hpp"
#include "tracking/gicp_target.hpp"

GGSLAM_DECLARE_KERNEL(void linearize_block(const LinearizeArgs& args, std::size_t begin, std::size_t end,
                                           AlignSums* sums))
GGSLAM_DECLARE_KERNEL(void plane_information_block(const LinearizeArgs& args, std::size_t begin, std::size_t end,
                                                   PlaneSums* sums))
GGSLAM_DECLARE_KERNEL(void photometric_block(const PhotometricArgs& args, std::size_t begin, std::size_t end,
                                             PhotometricSums* sums))

namespace ggslam {
namespace {

constexpr int kUnknowns = 8;          // twist, gain, bias
constexpr std::size_t kBlockPoints = 256;
constexpr double kAcceptedRise = 1.05;

struct RigidPose {
  Mat3d rotation;
  Vec3d translation;
};

// The first three rows of a 4 x 4 transform.
RigidPose pose_of(const double* rows) {
  RigidPose pose;
  for (int i = 0; i < 3; ++i) pose.rotation.row[i] = Vec3d::from(rows + 4 * i), pose.translation[i] = rows[4 * i + 3];
  return pose;
}

// Moves a pose by a twist (v, w) about the camera centre: the axes turn by exp(w) (Rodrigues' formula), the centre moves
// by v alone. To first order that is the exponential of the twist, and it keeps its two parts apart.
RigidPose move(const RigidPose& pose, const double* twist) {
  const Vec3d w = Vec3d::from(twist + 3);
  const double angle = length(w);
  const bool small = angle < 1e-6;
  const double a = small ? 1 - angle * angle / 6 : std::sin(angle) / angle;
  const double b = small ? 0.5 - angle * angle / 24 : (1 - std::cos(angle)) / (angle * angle);
  const Mat3d k = Mat3d::cross_product(w);
  const Mat3d turn = Mat3d::identity() + a * k + b * (k * k);
  return {turn * pose.rotation, pose.translation + Vec3d::from(twist)};
}

template <typename Args>
void set_pose(const RigidPose& pose, Args& args) {
  cast<float>(pose.rotation).to(args.rotation);
  cast<float>(pose.translation).to(args.translation);
}

// Gram-Schmidt on the rows: rounding of a dozen products is all there is to remove.
Mat3d orthonormalize(const Mat3d& r) {
  const Vec3d x = normalize(r.row[0]);
  const Vec3d y = normalize(r.row[1] - dot(x, r.row[1]) * x);
  return {{x, y, cross(x, y)}};
}

// Solves (H + damping diag(H)) x = b for the first n unknowns by Cholesky; false if H is not positive.
bool solve(const double h[kUnknowns][kUnknowns], const double* b, double damping, int n, double* x) {
  double l[kUnknowns][kUnknowns] = {};
  for (int i = 0; i < n; ++i)
    for (int j = 0; j <= i; ++j) {
      double sum = h[i][j] + (i == j ? damping * h[i][i] + 1e-12 : 0.0);
      for (int k = 0; k < j; ++k) sum -= l[i][k] * l[j][k];
      if (i == j && !(sum > 0)) return false;
      l[i][j] = i == j ? std::sqrt(sum) : sum / l[j][j];
    }
  for (int i = 0; i < n; ++i) {
    x[i] = b[i];
    for (int k = 0; k < i; ++k) x[i] -= l[i][k] * x[k];
    x[i] /= l[i][i];
  }
  for (int i = n - 1; i >= 0; --i) {
    for (int k = i + 1; k < n; ++k) x[i] -= l[k][i] * x[k];
    x[i] /= l[i][i];
  }
  return true;
}

void unpack(const double* upper, int n, double* full) {
  for (int i = 0, k = 0; i < n; ++i)
    for (int j = i; j < n; ++j, ++k) full[n * i + j] = full[n * j + i] = upper[k];
}

struct System {
  double h[kUnknowns][kUnknowns];
  double b[kUnknowns];
  double cost;  // per unit of weight
  int matches;
  double photometric_count, photometric_absolute;
};

class Aligner {
 public:
  Aligner(Context& context, const AlignPoints& points, const GicpTarget& target, const AlignSettings& settings,
          const PhotometricPoints* photometric_points, const PhotometricReferenceView* reference, int32_t* match,
          float* squared_distance)
      : context_(context), target_(target), settings_(settings) {
    args_.points = points;
    args_.settings = settings;
    args_.match = match;
    args_.squared_distance = squared_distance;
    if (reference && photometric_points && photometric_points->count > 0) {
      photometric_.points = *photometric_points;
      photometric_.reference = *reference;
      photometric_.huber = settings.huber;
      photometric_.depth_tolerance = settings.depth_tolerance;
      has_reference_ = true;
    }
  }

  // Runs both levels from `pose`; the last accepted linearisation stays in `system()` and in the match arrays.
  void run(RigidPose& pose, AlignResult& result) {
    const int step = std::max(1, args_.points.count / std::max(1, settings_.coarse_points));
    bool converged = false;
    if (settings_.coarse_iterations > 0) {
      choose_level(1, static_cast<float>(settings_.coarse_kernel_factor), step, false);
      result.coarse_iterations = descend(pose, settings_.coarse_iterations, 10, &converged);
    }
    choose_level(0, 1, 1, has_reference_);
    result.fine_iterations = descend(pose, settings_.fine_iterations, 1, &converged);
    result.converged = converged;
    pose.rotation = orthonormalize(pose.rotation);
    report(pose, result);
  }

 private:
  void choose_level(int level, float kernel_factor, int step, bool photometric) {
    args_.level = target_.contents(level).view;
    args_.kernel_factor = kernel_factor;
    args_.point_step = step;
    use_photometric_ = photometric;
    total_weight_ = 0;
    for (int i = 0; i < args_.points.count; i += step) total_weight_ += args_.points.weights[i];
    // The coarse level is only a start: its leftover points must not look like matches of the fine one.
    std::fill_n(args_.match, args_.points.count, -1);
    searched_at_.assign(3 * static_cast<std::size_t>(args_.points.count), NAN);
    args_.searched_at = searched_at_.data();
    std::fill_n(args_.squared_distance, args_.points.count, INFINITY);
  }

  // Levenberg-Marquardt; returns the number of linearisations.
  int descend(RigidPose& pose, int iterations, double tolerance_factor, bool* converged) {
    double damping = 1e-6;
    *converged = false;
    System current = linearize(pose, gain_, bias_);
    int evaluations = 1;
    while (evaluations < iterations) {
      double x[kUnknowns] = {0};
      const int unknowns = use_photometric_ && current.photometric_count > 50 ? 8 : 6;
      if (current.matches < settings_.min_matches || !solve(current.h, current.b, damping, unknowns, x)) return evaluations;
      const RigidPose candidate = move(pose, x);
      const double gain = gain_ + x[6], bias = bias_ + x[7];
      *converged = is_small(x, tolerance_factor);
      if (*converged) {
        pose = candidate, gain_ = gain, bias_ = bias;
        return evaluations;
      }
      const System next = linearize(candidate, gain, bias);
      ++evaluations;
      // Matches change from step to step, which lets the cost rise a little on the way down. Refusing such steps
      // stops short of the minimum in the directions that few points see.
      if (next.cost <= current.cost * kAcceptedRise && next.matches >= settings_.min_matches) {
        pose = candidate, gain_ = gain, bias_ = bias;
        current = next;
        damping = std::max(damping * 0.1, 1e-9);
      } else {
        if (damping > 1e3) return evaluations;
        damping = std::max(damping * 100, 1e-3);
      }
    }
    return evaluations;
  }

  bool is_small(const double* x, double factor) const {
    return length(Vec3d::from(x)) < factor * settings_.translation_tolerance &&
           length(Vec3d::from(x + 3)) < factor * settings_.rotation_tolerance;
  }

  // Runs a kernel over the blocks of `count` points; sums[i] belongs to block i.
  template <typename Sums, typename Kernel, typename Args>
  void over_blocks(const Args& args, std::size_t count, std::size_t block, Kernel kernel, std::vector<Sums>& sums) {
    const std::size_t blocks = (count + block - 1) / block;
    sums.resize(blocks);
    context_.pool.parallel_for(blocks, 1, [&](std::size_t first, std::size_t last, int) {
      for (std::size_t i = first; i < last; ++i) kernel(args, i * block, std::min(count, (i + 1) * block), &sums[i]);
    });
  }

  System linearize(const RigidPose& pose, double gain, double bias) {
    set_pose(pose, args_);
    over_blocks(args_, args_.points.count, kBlockPoints * args_.point_step, GGSLAM_DISPATCH(context_.isa, linearize_block),
                sums_);
    AlignSums total{};
    for (const AlignSums& s : sums_) {
      for (int k = 0; k < 21; ++k) total.h[k] += s.h[k];
      for (int k = 0; k < 6; ++k) total.b[k] += s.b[k];
      total.cost += s.cost;
      total.matches += s.matches;
    }
    System out{};
    double full[36];
    unpack(total.h, 6, full);
    const double f = 1 / std::max(total_weight_, 1e-30);
    for (int i = 0; i < 6; ++i) {
      out.b[i] = f * total.b[i];
      for (int j = 0; j < 6; ++j) out.h[i][j] = f * full[6 * i + j];
    }
    out.cost = f * total.cost;
    out.matches = static_cast<int>(total.matches);
    if (use_photometric_) add_photometric(pose, gain, bias, out);
    return out;
  }

  void add_photometric(const RigidPose& pose, double gain, double bias, System& out) {
    set_pose(pose, photometric_);
    photometric_.gain = static_cast<float>(gain);
    photometric_.bias = static_cast<float>(bias);
    over_blocks(photometric_, photometric_.points.count, kBlockPoints, GGSLAM_DISPATCH(context_.isa, photometric_block),
                photometric_sums_);
    PhotometricSums total{};
    for (const PhotometricSums& s : photometric_sums_) {
      for (int k = 0; k < 36; ++k) total.h[k] += s.h[k];
      for (int k = 0; k < 8; ++k) total.b[k] += s.b[k];
      total.cost += s.cost, total.count += s.count, total.absolute += s.absolute;
    }
    out.photometric_count = total.count;
    out.photometric_absolute = total.absolute;
    // A point that leaves the image costs what a badly fitting one costs.
    const double lost = photometric_.points.count - total.count;
    const double f = settings_.photometric_weight / photometric_.points.count;
    out.cost += f * (total.cost + lost * settings_.huber * settings_.huber);
    double full[64];
    unpack(total.h, 8, full);
    for (int i = 0; i < 8; ++i) {
      out.b[i] += f * total.b[i];
      for (int j = 0; j < 8; ++j) out.h[i][j] += f * full[8 * i + j];
    }
    // Weak prior on gain 1 and bias 0, so that an image without contrast leaves them where they are.
    const double prior = 1e-4 * settings_.photometric_weight;
    out.h[6][6] += prior, out.h[7][7] += prior;
    out.b[6] += prior * (1 - gain), out.b[7] -= prior * bias;
  }

  void report(const RigidPose& pose, AlignResult& result) {
    const System last = linearize(pose, gain_, bias_);
    over_blocks(args_, args_.points.count, kBlockPoints, GGSLAM_DISPATCH(context_.isa, plane_information_block),
                plane_sums_);
    PlaneSums total{};
    for (const PlaneSums& s : plane_sums_) {
      for (int k = 0; k < 21; ++k) total.information[k] += s.information[k];
      total.inliers += s.inliers, total.squared += s.squared;
    }
    unpack(total.information, 6, result.information);
    for (int i = 0; i < 6; ++i)
      for (int j = 0; j < 6; ++j) result.normal_matrix[6 * i + j] = last.h[i][j];
    result.cost = last.cost;
    result.matches = last.matches;
    result.inliers = static_cast<int>(total.inliers);
    result.overlap = total.inliers / std::max(1, args_.points.count);
    result.rmse = std::sqrt(total.squared / std::max(1.0, total.inliers));
    result.usable = last.matches >= settings_.min_matches;
    result.photometric_residual = last.photometric_absolute / std::max(1.0, last.photometric_count);
    result.photometric_share = has_reference_ ? last.photometric_count / photometric_.points.count : 0;
    result.gain = gain_, result.bias = bias_;
  }

  Context& context_;
  const GicpTarget& target_;
  const AlignSettings settings_;
  LinearizeArgs args_{};
  PhotometricArgs photometric_{};
  std::vector<float> searched_at_;
  std::vector<AlignSums> sums_;
  std::vector<PlaneSums> plane_sums_;
  std::vector<PhotometricSums> photometric_sums_;
  double total_weight_ = 0, gain_ = 1, bias_ = 0;
  bool has_reference_ = false, use_photometric_ = false;
};

}  // namespace
}  // namespace ggslam

namespace {

void check_points(const ggslam::AlignPoints* pointer, const ggslam::AlignSettings* settings, const int32_t* match,
                  const float* squared_distance) {
  using namespace ggslam;
  const AlignPoints& points = object_of<AlignPoints>(pointer);
  const void* const arrays[] = {points.points, points.normals, points.covariances, points.weights, match, squared_distance};
  for (const void* array : arrays) check_array("points", array, points.count);
  if (points.depths) check_array("depths of points", points.depths, points.count);
  object_of<AlignSettings>(settings);
}

const ggslam::GicpTarget& check_target(const void* pointer) {
  const auto& target = ggslam::object_of<ggslam::GicpTarget>(pointer);
  if (!target.is_finished()) ggslam::refuse("target: it is not finished");
  return target;
}

void check_reference(const ggslam::PhotometricPoints* points, const ggslam::PhotometricReferenceView* reference) {
  using namespace ggslam;
  if (points == nullptr || reference == nullptr) return;
  check_array("photometric points", points->points, points->count);
  check_array("photometric points", points->intensity, points->count);
  check_range("reference width", reference->width, 1, kMostPixelsAlong);
  check_range("reference height", reference->height, 1, kMostPixelsAlong);
  check_array("reference", reference->pixels, 1);
}

}  // namespace

GGSLAM_EXPORT int ggslam_gicp_align(void* context, const void* target, const ggslam::AlignPoints* points,
                                    const ggslam::AlignSettings* settings,
                                    const ggslam::PhotometricPoints* photometric_points,
                                    const ggslam::PhotometricReferenceView* reference, const double* pose_guess,
                                    int32_t* match, float* squared_distance, ggslam::AlignResult* result) try {
  using namespace ggslam;
  check_points(points, settings, match, squared_distance);
  check_reference(photometric_points, reference);
  check_within("pose", pose_guess, 12, 1e9);
  RigidPose pose = pose_of(pose_guess);
  object_of<AlignResult>(result) = AlignResult{};
  Aligner(object_of<Context>(context), *points, check_target(target), *settings,
          photometric_points, reference, match, squared_distance)
      .run(pose, *result);
  for (int i = 0; i < 3; ++i) {
    pose.rotation.row[i].to(result->pose + 4 * i);
    result->pose[4 * i + 3] = pose.translation[i];
  }
  result->pose[15] = 1;
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT double ggslam_gicp_linearize(void* context_, const void* target_, const ggslam::AlignPoints* points,
                                           const ggslam::AlignSettings* settings, int level, const double* pose,
                                           int32_t* match, float* squared_distance, double* h, double* b) try {
  using namespace ggslam;
  [[maybe_unused]] const auto& context = object_of<Context>(context_);
  const auto& target = check_target(target_);
  check_points(points, settings, match, squared_distance);
  check_within("pose", pose, 12, 1e9);
  check_array("h", h, 36), check_array("b", b, 6);
  LinearizeArgs args{};
  args.points = *points;
  args.level = target.contents(level).view;
  args.settings = *settings;
  args.kernel_factor = level ? static_cast<float>(settings->coarse_kernel_factor) : 1;
  args.point_step = 1;
  args.match = match;
  args.squared_distance = squared_distance;
  set_pose(pose_of(pose), args);
  AlignSums sums{};
  GGSLAM_DISPATCH(context.isa, linearize_block)(args, 0, points->count, &sums);
  unpack(sums.h, 6, h);
  std::copy_n(sums.b, 6, b);
  return sums.cost;
} GGSLAM_CATCH_ALL
